# SPDX-License-Identifier: Apache-2.0
"""`ctsid simulate`: how well a stored model simulates and predicts another bag."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ctsid_core.errors import StorageError
from ctsid_ros.errors import BagError
from ctsid_ros.progress import progress
from ctsid_ros.report.document import GLOSSARY, Section, to_text
from ctsid_ros.report.tables import Table, number, percent
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    NO_MODEL,
    add_bag,
    add_interval,
    add_params,
    add_report,
    add_style,
    check_channels,
    interval_of,
    model_file,
    named,
    of_this_bag,
    read_params,
    run_of,
    say,
    steps,
    tell,
)

_GROWS = 3.0          # times e within a record: no simulation tells more
_LESS = 0.67          # of the error: a timeout that leaves less is suggested
_DATED = 10 ** 17     # ns: of a clock that is set, and did not begin with 0

if TYPE_CHECKING:
    from ctsid_core.linear.types import Array
    from ctsid_core.model.estimate import Estimate
    from ctsid_core.model.statespace import StateSpace
    from ctsid_core.model.validation import Validation
    from ctsid_core.signals.record import Record
    from ctsid_ros.recordings.bag import Bag
    from ctsid_ros.recordings.playback import Recorded

HELP = 'show how well a stored model simulates and predicts a bag'
EPILOG = 'example: ctsid simulate results/demo/model.json another_flight.mcap --horizon 1 10 100'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('model', metavar='MODEL', type=model_file,
                        help='a model.json, or a folder of results that has one')
    add_bag(parser)
    add_params(parser)
    add_interval(parser)
    parser.add_argument('--horizon', type=steps, nargs='+', default=[1, 10], metavar='K',
                        help='prediction horizons: so many samples of the output ahead '
                        '[default 1 10]')
    parser.add_argument('--trim', choices=('refit', 'model'), default='refit',
                        help='offsets of the outputs: refit = fitted to this bag (it may have '
                        'another operating point), model = those of the model [default refit]')
    parser.add_argument('--rejected', action='store_true',
                        help='simulate a model that was rejected, too; the exit code is 3 then')
    add_report(parser)
    add_style(parser)


@dataclass(frozen=True)
class _Outcome:
    """What a comparison gave."""

    model: StateSpace
    data: Recorded
    simulated: Validation
    predicted: Mapping[int, Validation]
    first: float  # interval, after the start of the bag [s]
    last: float


def command(args: argparse.Namespace) -> int:
    """Read, simulate, print."""
    from ctsid_core.bases.preparation import moving, without_corrupt
    from ctsid_core.judge.rules import retested
    from ctsid_core.model.storage import load_estimate, load_metadata
    from ctsid_core.search.held_out import as_judged, failure
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.playback import read_record
    from ctsid_ros.replay.results import config_of

    estimate, origin = load_estimate(args.model), load_metadata(args.model)
    model = model_of(estimate, args.model, 'simulate', rejected=args.rejected)
    config = read_params(args.params) if args.params else config_of(
        origin, estimate.settings, args.model)
    check_channels(model, config, args.model)
    with open_bag(args.bag, args.time) as bag:
        config = config if args.params else of_this_bag(bag, config, args.model)
        with progress('reading', quiet=args.quiet) as advance:
            data = read_record(bag, config, interval_of(args), advance=advance)
        check_dead_times(model, data.record)
        record, spikes = without_corrupt(data.record, config.settings, model)
        outcome = _compare(model, replace(data, record=record), args, bag)
        rests = record.nu > 0 and not moving(record, config.settings)[0]
        shared = _shared(estimate, record, args.bag, origin)
        failed = '' if rests else failure(
            estimate, as_judged(estimate, outcome.model, record)
            if estimate.by_predictions else outcome.simulated, record,
            partly=0.0 < shared < record.duration - max(s.period for s in record.outputs))
        estimate = retested(estimate, failed)
        notes = (*_own_data(shared, record),
                 *_unsimulated(outcome.simulated),
                 *timeouts_suggested(model, record, outcome.simulated, args.trim), *rests * (
            'no input moves in this recording, which tells nothing of the model: choose another, '
            'or a part in which they move',),
                 *([f'{failed}; `{_again(args)}` makes a model of this recording, `ctsid compare` '
                    'of both shows what has changed'] if failed else []), *bag.notes,
                 *data.complaints, *spikes,
                 *(note for v in outcome.predicted.values() for note in v.notes))
    why = '' if estimate.ok else estimate.verdict.reason
    if args.out is not None:
        _write(estimate, outcome, args, notes)
    if args.json:
        tell({**_document(outcome, args, notes), 'accepted': estimate.ok,
              'reason': estimate.verdict.reason})
    else:
        rejected = [Section(f'REJECTED ({estimate.status.name})', (why,))] if why else []
        print(to_text([*rejected, *_sections(outcome, args, notes)]))
    return NO_MODEL if why else ACCEPTED


def _again(args: argparse.Namespace) -> str:
    """Return the command that makes a model of the recording."""
    beside = Path(args.model).with_name('params.yaml')
    params = args.params or (str(beside) if beside.exists() else 'params.yaml')
    return replace(run_of(args), params=params).command('identify')


def model_of(estimate: Estimate, path: str, verb: str, *, rejected: bool) -> StateSpace:
    """
    Return the model of an estimate; a rejected one only if it is asked for.

    Raises
    ------
    StorageError
        If there is none, or it was rejected.
    """
    if estimate.model is not None:
        return estimate.model
    why = f'{path} holds no accepted model ({estimate.status.name}): {estimate.verdict.reason}'
    if estimate.rejected_model is None:
        raise StorageError(why)
    if not rejected:
        raise StorageError(f'{why} Add --rejected to {verb} the rejected one all the same.')
    return estimate.rejected_model


def check_dead_times(model: StateSpace, record: Record) -> None:
    """Raise `BagError` if an input acts on nothing of a record, for it acts too late."""
    first = [s.time[0] for s in record.inputs for _ in range(s.width)]
    for name, delay, start in zip(model.input_names, model.delay, first, strict=True):
        if start + delay >= record.end:
            raise BagError(f'input {name} acts {delay:.3g} s later, after the end of these '
                           f'{record.duration:.3g} s of data; choose a longer recording or part')


def _shared(estimate: Estimate, record: Record, bags: Sequence[str],
            origin: Mapping[str, object]) -> float:
    """
    Return how much of these data a model was identified from, as their times say [s].

    Of a clock that began with 0 they say so only in the file that it was identified from.
    """
    from ctsid_ros.replay.results import bag_hash

    start, end = (record.epoch_ns + round(1e9 * t) for t in (record.start, record.end))
    parts = {one.number: (one.start_ns, one.end_ns) for one in estimate.records} or {
        1: (estimate.start_ns, estimate.end_ns)}
    both = {k: min(end, last) - max(start, first) for k, (first, last) in parts.items()
            if min(end, last) > max(start, first)}
    if both and start < _DATED and (
            (own := bag_hash(bags)) is None or own != origin.get('sha256')):
        records = origin.get('records')
        known = [one.get('sha256') for one in records] if isinstance(records, list) else []
        both = {k: ns for k, ns in both.items() if own and own in known[k - 1:k]}
    return sum(both.values()) * 1e-9


def _own_data(shared: float, record: Record) -> tuple[str, ...]:
    """Return that a model was identified from so much of these data [s], if from any."""
    return () if not shared else (
        f'by their stamps {shared:.1f} s of these {record.duration:.1f} s are what the '
        'model was identified from: its fit there is no test; give a recording that it has '
        'not seen',)


def _unsimulated(simulated: Validation) -> tuple[str, ...]:
    return () if any(map(math.isfinite, simulated.fit.tolist())) else (
        'the plant grows by itself and cannot be simulated for so long: predictions tell how good '
        'the model is, at the horizons that matter to you (`--horizon`)',)


def timeouts_suggested(model: StateSpace, record: Record, found: Validation,
                       trim: Literal['refit', 'model'] = 'refit') -> tuple[str, ...]:
    """Return that a timeout of an input would explain clearly more of a record, if one would."""
    from ctsid_core.model.validation import simulation
    from ctsid_core.search.commands import TIMEOUTS
    from ctsid_core.signals.gaps import silences
    from ctsid_core.signals.record import placed

    if any(model.timeout) or not silences(record):
        return ()
    each = [(float(min(simulation(replace(model, actuators=tuple(
        own._replace(timeout=timeout * (j in range(k.start, k.stop)))
        for j, own in enumerate(model.actuators))), record, trim=trim).fit)),
             model.input_names[k.start], timeout)
        for _, k in placed(record.inputs) for timeout in TIMEOUTS]
    fit, name, timeout = max(each)
    return () if not _LESS * (100.0 - min(found.fit)) > 100.0 - fit else (
        f'with a timeout of about {timeout:.2g} s of input {name} it would be {fit:.0f} %: a '
        f'driver seems to stop the robot while {name} is silent; a model made with '
        f'`{name.partition("[")[0]}.timeout: {timeout:.2g}` knows of that',)


def _compare(model: StateSpace, data: Recorded, args: argparse.Namespace, bag: Bag) -> _Outcome:
    import numpy as np

    from ctsid_core.model.validation import predictions, simulation
    from ctsid_ros.replay.clock import zero_ns

    record = data.record
    offset = (record.epoch_ns - zero_ns(bag, record.epoch_ns)) * 1e-9
    simulated = simulation(model, record, trim=args.trim)
    if max(model.poles.real, default=0.0) * record.duration > _GROWS:
        # Its best solution within the record knows the end as well as the beginning.
        nothing = np.full(model.ny, np.nan)
        simulated = replace(simulated, fit=nothing, vaf=nothing)
    model = replace(model, y_trim=model.y_trim + simulated.offset)
    return _Outcome(model, data, simulated, predictions(model, record, args.horizon),
                    record.start + offset, record.end + offset)


def _sections(outcome: _Outcome, args: argparse.Namespace, notes: tuple[str, ...]
              ) -> list[Section]:
    from ctsid_core.signals.actuators import in_words
    from ctsid_ros.report.sections import channel_section, complaint_section

    columns: dict[str, Array] = {
        'simulation fit [%]': outcome.simulated.fit, 'VAF [%]': outcome.simulated.vaf}
    periods = [s.period for s in outcome.data.record.outputs]
    for k, found in outcome.predicted.items():
        ahead = ' or '.join(dict.fromkeys(number(k * p, 2) for p in periods))
        columns[f'fit {k} ahead ({ahead} s) [%]'] = found.fit
    rows = tuple((name, *(percent(v[i]) for v in columns.values()))
                 for i, name in enumerate(outcome.model.output_names))
    late: dict[str, list[str]] = {}
    for name, delay in zip(outcome.model.input_names, outcome.model.delay, strict=True):
        late.setdefault(name.partition('[')[0], []).append(number(delay))
    delays = {name: ', '.join(dict.fromkeys(found)) for name, found in late.items()}
    title = f'{args.model} on {named(args.bag)}, {outcome.first:.1f} to {outcome.last:.1f} s'
    return [Section(title, (Table(('output', *columns), rows, ('output',)), _trim(args.trim))),
            channel_section(outcome.data, delays=delays), complaint_section((
                *notes, *in_words(outcome.model.input_names, outcome.model.actuators,
                                  outcome.model.input_units)))]


def _write(estimate: Estimate, outcome: _Outcome, args: argparse.Namespace,
           notes: tuple[str, ...]) -> None:
    """Write the report."""
    import numpy as np

    from ctsid_ros.replay.results import PAGE, REPORT, bag_name, make_folder, origin, write_report
    from ctsid_ros.report.document import Headline, to_markdown
    from ctsid_ros.report.headline import repeat_section
    from ctsid_ros.report.model_page import (
        Shown,
        marked,
        output_section,
        residual_sections,
        response_sections,
        sampling_section,
    )
    from ctsid_ros.report.outputs import Part
    from ctsid_ros.report.page import to_html
    from ctsid_ros.report.tables import fit_words

    model, record, found = outcome.model, outcome.data.record, outcome.simulated
    run = run_of(args)
    offset = outcome.first - record.start
    explains = (f'The model explains {fit_words(found.fit)} % of {", ".join(model.output_names)} '
                'here, simulated from the inputs alone; its own data, '
                f'{fit_words(estimate.fit)} %. ')
    words = explains * (not estimate.verdict.reason.startswith('The model explains')) \
        + estimate.verdict.reason
    first = Headline(estimate.verdict.grade.name, words, run.command('identify'),
                     (('simulation fit [%]', fit_words(found.fit)),
                      ('VAF [%]', fit_words(found.vaf))),
                     'a model of this recording itself, to compare')
    shown = Shown(record, model, (Part('These data, simulated', found, found.fit),), offset)
    fits: dict[float, Array] = {}
    for k, ahead in outcome.predicted.items():
        fits[k * max(s.period for s in record.outputs)] = ahead.fit
    fits = dict(sorted(fits.items())) if all(np.isfinite(list(fits))) else {}
    metadata = origin(outcome.data.config, args.bag, {'start': outcome.first,
                                                      'end': outcome.last})
    numbers = [*_sections(outcome, args, notes), repeat_section(run, metadata)]
    drawn = [*marked((output_section(shown, outcome.data.config.settings),
                      *residual_sections(shown, found, found.fit, fits),
                      *response_sections({'the model': (model, estimate.covariance)}, shown)),
                     estimate), sampling_section(record, offset, outcome.data.counts)]
    title = f'{bag_name([args.model])} on {bag_name(args.bag)}'
    folder = make_folder(args.out, args.bag, 'simulate', force=args.force)
    write_report(folder, {REPORT: to_markdown(title, numbers, first),
                          PAGE: to_html(title, [*drawn, *numbers], first)})
    say(f'wrote {folder / PAGE}')


def _trim(trim: str) -> str:
    if trim == 'refit':
        return ('The offsets of the outputs, in simulations and predictions, are fitted to this '
                'bag, because it may have another operating point (--trim model keeps those of '
                'the model). A fit of '
                f'100 % is perfect, 0 % no better than a constant. {GLOSSARY}')
    return ('The offsets of the outputs are those of the model (--trim refit fits them to this '
            f'bag). A fit of 100 % is perfect, 0 % no better than a constant. {GLOSSARY}')


def _document(outcome: _Outcome, args: argparse.Namespace, notes: tuple[str, ...]
              ) -> dict[str, Any]:
    return {'verb': 'simulate', 'model': args.model, 'bag': named(args.bag), 'trim': args.trim,
            'from': outcome.first, 'to': outcome.last, 'outputs': outcome.model.output_names,
            'fit': outcome.simulated.fit, 'vaf': outcome.simulated.vaf,
            'prediction': {str(k): {'fit': v.fit, 'vaf': v.vaf}
                           for k, v in outcome.predicted.items()}, 'notes': notes}
