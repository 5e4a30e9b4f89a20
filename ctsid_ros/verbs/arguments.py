# SPDX-License-Identifier: Apache-2.0
"""What several verbs share: their arguments, the config, and how results are printed."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
import json
import math
from pathlib import Path
import sys
from typing import TYPE_CHECKING, Any

from ctsid_core.errors import DataError, SettingsError, StorageError

if TYPE_CHECKING:
    from ctsid_core.model.estimate import Estimate
    from ctsid_core.model.statespace import StateSpace
    from ctsid_ros.config.channels import Config
    from ctsid_ros.recordings.bag import Bag
    from ctsid_ros.recordings.guess_ranking import Pair
    from ctsid_ros.recordings.playback import Interval
    from ctsid_ros.report.headline import Better, Run

ACCEPTED, NO_MODEL, INTERRUPTED = 0, 3, 130


def seconds(text: str) -> float:
    """Parse a time that is not negative [s]."""
    return _number(text, 0.0, 'zero or more')


def positive_seconds(text: str) -> float:
    """Parse a positive time [s]."""
    return _number(text, math.ulp(0.0), 'more than zero')


def _number(text: str, least: float, wanted: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r} is not a number of seconds, {wanted}')
    return value


def steps(text: str) -> int:
    """Parse a positive whole number."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number, 1 or more')
    return int(text)


def bag_path(text: str) -> str:
    """Return a bag; of a folder that has none itself but one in a subfolder, that one."""
    if not Path(text).is_dir():
        return text
    from ctsid_ros.recordings.files import only_inside

    return str(only_inside(Path(text)) or text)


def add_bag(parser: argparse.ArgumentParser,
            several: str = 'several are the parts of one recording') -> None:
    """Add the bag, and what several of them mean."""
    parser.add_argument('bag', nargs='+', metavar='BAG', type=bag_path,
                        help='rosbag2 folder, .mcap, .db3 or ROS 1 .bag file, PX4 .ulg, '
                        f'ArduPilot .bin, .csv, .parquet, or a URL of one; {several}')
    parser.add_argument('--time', action='append', default=[], metavar='COLUMN', help='column of '
                        'a table that is the time, such as t or t:ms, once for each; or the rate '
                        'of rows that have none, such as 100Hz [default: by name, unit and values]'
                        )


def bag_words(args: argparse.Namespace, bags: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the bags, or some of them, and their times as another command line needs them."""
    times = getattr(args, 'time', ())
    return (*(bags or args.bag), *(word for column in times for word in ('--time', column)))


def span(text: str) -> Interval:
    """Parse START:END [s]."""
    start, colon, end = text.partition(':')
    first = seconds(start or '0')
    last = seconds(end) if end else math.inf
    if not colon or last <= first:
        raise argparse.ArgumentTypeError(f'{text!r} is not START:END, two numbers of seconds, the '
                                         'second the larger')
    from ctsid_ros.recordings.playback import Interval

    return Interval(first, last - first)


def add_interval(parser: argparse.ArgumentParser) -> None:
    """Add the interval."""
    parser.add_argument('--start', type=seconds, default=0.0, metavar='S',
                        help='where to begin, after the first message of the bag [s, default 0]')
    parser.add_argument('--duration', type=positive_seconds, default=math.inf, metavar='S',
                        help='how much to take [s, default: to the end]')


def add_params(parser: argparse.ArgumentParser) -> None:
    """Add the parameter file."""
    parser.add_argument('--params', metavar='FILE', help='ROS parameter file with channels and '
                        'settings; `ctsid init` writes one [default: its guess]')


def add_changes(parser: argparse.ArgumentParser) -> None:
    """Add parameters with other values than the file, or the guess, gives them."""
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', dest='changes',
                        help='a parameter with another value, such as order=4, delay=auto or '
                        'torque.hold=zoh; may be given several times')


def add_signals(parser: argparse.ArgumentParser) -> None:
    """Add which signals to take; see `signal_words`."""
    for role in ('input', 'output'):
        parser.add_argument(
            f'--{role}', action='append', default=[], metavar='FIELD',
            help=f"{role} of the model, as `ctsid info` names it: FIELD, 'TOPIC FIELD' or TOPIC, "
            f"with * for anything and [0:3] for several; once for each [default: chosen from the "
            'data]')


def signal_words(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the signals that were named as another command line needs them."""
    return tuple(word for role in ('input', 'output') for text in getattr(args, role)
                 for word in (f'--{role}', text))


def add_pick(parser: argparse.ArgumentParser) -> None:
    """Add which of the guessed pairs to take."""
    parser.add_argument('--pick', type=steps, default=1, metavar='N',
                        help='which of the pairs to take that are shown [default: 1, the best]')


def add_budget(parser: argparse.ArgumentParser) -> None:
    """Add the budget of an identification."""
    parser.add_argument('--budget', type=seconds, metavar='S', help='processor time that one '
                        'identification may take [s, default: that of the parameter file]')


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add how many processes compute."""
    parser.add_argument('--jobs', type=steps, metavar='N',
                        help='processes that identify [default: one for each core]')


def add_results(parser: argparse.ArgumentParser) -> None:
    """Add the folder of results."""
    parser.add_argument('--out', metavar='DIR', help='folder for the results [default '
                        'results/<bag>-<method>-<UTC>]')
    parser.add_argument('--force', action='store_true', help='replace the results in that folder')


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add the folder of a report, of verbs that write no model."""
    parser.add_argument('--out', metavar='DIR', help='folder for report.md and report.html '
                        '[default: none is written]')
    parser.add_argument('--force', action='store_true', help='replace the report in that folder')


def add_style(parser: argparse.ArgumentParser, *, quiet: bool = True) -> None:
    """Add how to print the result."""
    parser.add_argument('--json', action='store_true',
                        help='print the result as JSON instead of tables')
    if quiet:
        parser.add_argument('--quiet', action='store_true', help='show no progress')


def interval_of(args: argparse.Namespace) -> Interval:
    """Return the interval that the arguments name."""
    from ctsid_ros.recordings.playback import Interval

    return Interval(args.start, args.duration)


def config_for(args: argparse.Namespace, bag: Bag) -> Config:
    """Return the config of --params, or else a guess, and say so; as it is changed, if it is."""
    return changed(args, read_params(args.params) if args.params is not None else _guessed(bag))


def changed(args: argparse.Namespace, config: Config) -> Config:
    """Return a config with the parameters of --set, and the budget, if given."""
    from ctsid_ros.config.parameter_file import with_parameters

    changes, budget = getattr(args, 'changes', ()), getattr(args, 'budget', None)
    config = with_parameters(config, changes) if changes else config
    return config if budget is None else replace(
        config, settings=config.settings.replace(budget=budget))


def _guessed(bag: Bag) -> Config:
    from ctsid_ros.recordings.guess import guess
    from ctsid_ros.recordings.survey import survey

    guessed = guess(bag, survey(bag))
    inputs, outputs = (', '.join(f'{c.topic} {c.field}' for c in channels) for channels in
                       (guessed.config.inputs, guessed.config.outputs))
    say(f'no --params given, so the channels are guessed: {inputs} acts, {outputs} is measured; '
        '`ctsid init` writes this guess to a file, to correct it')
    return guessed.config


def better_pairs(bags: Sequence[str], time: Sequence[str], config: Config) -> Better:
    """Return the pairs of which a recording says more than of those that gave no model."""
    from ctsid_ros.errors import BagError
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.guess import better, by_names, scalars
    from ctsid_ros.report.headline import Better

    pairs: Sequence[Pair] = ()
    with suppress(BagError), open_bag(bags, time) as bag:      # the results go without
        pairs = better(bag, config)
        keys = {'input': by_names(bag, scalars(config.inputs)),
                'output': by_names(bag, scalars(config.outputs))}
    kept: tuple[str, ...] = ()
    for side in ('input', 'output'):
        if pairs and all(getattr(p, side).key in keys[side] for p in pairs):
            kept = (f'--{side}', ' '.join(getattr(pairs[0], side).key))
    return Better(tuple(
        f'{" ".join(p.input.key)} -> {" ".join(p.output.key)} '
        f'({100 * p.explained.past:.0f} % explained)' for p in pairs), kept)


def read_params(path: str) -> Config:
    """Read a parameter file; faults are reported with its name."""
    from ctsid_ros.config.parameter_file import read_config

    try:
        return read_config(path)
    except SettingsError as error:
        faults = [fault if path in fault else f'{path}: {fault}' for fault in error.faults]
        raise SettingsError(faults) from None


def run_of(args: argparse.Namespace, model: str = '',
           span: tuple[float, float] = (0.0, math.inf)) -> Run:
    """Return what a report says of its making: the command line, bags, parameters, model."""
    from ctsid_ros.report.headline import Run

    start, duration = getattr(args, 'start', 0.0), getattr(args, 'duration', math.inf)
    several = [(i.start, i.start + i.duration) for i in getattr(args, 'interval', None) or ()]
    if several:
        start = min(first for first, _ in several)
        duration = max(last for _, last in several) - start
    interval = interval_words(start, duration)
    chosen = tuple(word for first, last in several for word in (
        '--interval', f'{first:.10g}:{last:.10g}')) if len(several) > 1 else interval
    return Run(args.command_line, bag_words(args), args.params, model, span, interval, chosen,
               changes=tuple(getattr(args, 'changes', ())))


def interval_words(start: float, duration: float) -> tuple[str, ...]:
    """Return the arguments that choose an interval; none for all of a recording."""
    return (*(('--start', f'{start:.10g}') if start else ()),
            *(('--duration', f'{duration:.10g}') if math.isfinite(duration) else ()))


def read_truth(args: argparse.Namespace) -> StateSpace | None:
    """Return the model that --truth names, if it is given."""
    if not args.truth:
        return None
    from ctsid_core.model.storage import load_model

    return load_model(args.truth)


def is_model(path: str) -> bool:
    """Return whether a path names a model.json, or a folder of results that has one."""
    return path.endswith('.json') or (Path(path) / 'model.json').is_file()


def model_file(path: str) -> str:
    """Return the model file that a path names: itself, or that of a folder of results."""
    return str(Path(path) / 'model.json') if Path(path).is_dir() else path


def read_models(paths: Sequence[str]) -> dict[str, Estimate]:
    """
    Return the estimates of model files by short names: those of their folders, or of the files.

    Raises
    ------
    StorageError
        If a file holds no model.
    DataError
        If they cannot be drawn together: too many, or of other inputs or outputs.
    """
    from ctsid_core.model.storage import load_estimate
    from ctsid_ros.report.drawing import MOST_MODELS

    if len(paths) > MOST_MODELS:
        raise DataError(f'these are {len(paths)} models; in one drawing {MOST_MODELS} can be told '
                        'apart: give fewer')
    found: dict[str, Estimate] = {}
    for path in paths:
        estimate = load_estimate(path)
        if (estimate.model or estimate.rejected_model) is None:
            raise StorageError(f'{path} holds no model ({estimate.status.name}): '
                               f'{estimate.verdict.reason}')
        file = Path(path)
        name = (file.resolve().parent.name if file.name == 'model.json' else file.stem) or 'model'
        name = f'{name} (rejected)' if estimate.model is None else name
        key = path if name in found else name
        if key in found:
            raise DataError(f'{path} is given more than once')
        found[key] = estimate
    found = _under_one_name(found, paths)
    names = {name: (m.input_names, m.output_names) for name, e in found.items()
             if (m := e.model or e.rejected_model)}
    if len(set(names.values())) > 1:
        own = [{*u, *y} for u, y in names.values()]
        apart = sorted({one for some in own for one in some if not all(one in o for o in own)})
        raise DataError('the models have other inputs or outputs: ' + '; '.join(
            f'{name}: {", ".join(u)} to {", ".join(y)}' for name, (u, y) in names.items())
            + f'; not in all of them: {", ".join(apart) or "none, but their order differs"}. '
            'Choose models that are alike. Where one signal has two names, identify once more '
            'with a parameter file that gives its channel the name of the other model (`field` '
            'says where it is, the name is free)')
    return found


def _under_one_name(found: dict[str, Estimate], paths: Sequence[str]) -> dict[str, Estimate]:
    """Return estimates with the names of the first where signals are those of the first."""
    from ctsid_core.model.storage import load_metadata

    def sources(path: str) -> list[tuple[object, ...]] | None:
        listed = load_metadata(path).get('channels')
        return [tuple(c.get(key) for key in ('role', 'topic', 'field', 'unit')) for c in listed] \
            if isinstance(listed, list) and all(isinstance(c, dict) for c in listed) else None

    known = [sources(path) for path in paths]
    first = next(iter(found.values()))
    given = first.model or first.rejected_model
    assert given is not None
    names = {'input_names': given.input_names, 'output_names': given.output_names}
    return {name: replace(estimate, **{
        which: replace(model, **names) for which in ('model', 'rejected_model')
        if (model := getattr(estimate, which)) is not None and own and own == known[0]
        and (model.nu, model.ny) == (given.nu, given.ny)})
        for (name, estimate), own in zip(found.items(), known, strict=True)}


def check_channels(model: StateSpace, config: Config, path: str) -> None:
    """Raise `DataError` if the channels are not those of the model."""
    for what, names, channels in (('inputs', model.input_names, config.inputs),
                                  ('outputs', model.output_names, config.outputs)):
        if any(channel.path.is_open for channel in channels):
            continue  # its width is known from the bag only; the simulation will check it
        given = tuple(name for channel in channels for name in channel.scalar_names)
        if len(given) != len(names) or (all(names) and given != names):
            raise DataError(f'the {what} of {path} are {", ".join(names)}, but those of the '
                            f'channels are {", ".join(given)}; give a parameter file with '
                            'the names of the model, such as its own, with --params')


def of_this_bag(bag: Bag, config: Config, path: str) -> Config:
    """Return the channels of a model as this bag has them; `BagError` says what to do if not."""
    from ctsid_ros.errors import BagError
    from ctsid_ros.recordings.playback import fit_config

    try:
        return fit_config(bag, config)
    except BagError as error:
        raise BagError(f'{error}\nThese are the channels of {path}, which is compared with what '
                       'was measured: the recording needs all its inputs and outputs. Where a '
                       'signal has another name there, give --params FILE: the same channels, '
                       'with their `topic` and `field` here') from None


def say(text: str) -> None:
    """Print something that is not the result, to stderr."""
    from ctsid_ros.report.words import lines

    print(f'ctsid: {lines(text)}', file=sys.stderr, flush=True)


def tell(value: Mapping[str, Any]) -> None:
    """Print a result as JSON."""
    print(json.dumps(plain(value), indent=2, allow_nan=False))


def plain(value: Any) -> Any:
    """Return what JSON has words for; null for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if hasattr(value, 'tolist'):  # an array, or a number of NumPy's
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def date(stamp_ns: int) -> str:
    """Return a stamp as a date, UTC; '' where it cannot be one."""
    if not 10**9 < stamp_ns // 10**9 < 2**32:
        return ''
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime('%Y-%m-%d %H:%M:%S UTC')


def named(bags: Sequence[str]) -> str:
    """Return the bag as the user named it."""
    return bags[0] if len(bags) == 1 else f'{bags[0]} and {len(bags) - 1} more'
