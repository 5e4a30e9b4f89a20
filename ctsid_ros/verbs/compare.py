# SPDX-License-Identifier: Apache-2.0
"""`ctsid compare`: methods and orders on the same data, or stored models, side by side."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
import shlex
import time
from typing import TYPE_CHECKING, Any

from ctsid_core.errors import SettingsError
from ctsid_ros.progress import Advance, progress, silent, working
from ctsid_ros.report.document import Section, next_text, to_text
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    NO_MODEL,
    add_bag,
    add_changes,
    add_interval,
    add_params,
    add_results,
    add_style,
    changed,
    check_channels,
    config_for,
    interval_of,
    is_model,
    model_file,
    named,
    of_this_bag,
    read_models,
    read_params,
    run_of,
    tell,
)

if TYPE_CHECKING:
    from ctsid_core.model.estimate import Estimate
    from ctsid_core.model.statespace import StateSpace
    from ctsid_core.settings import Settings
    from ctsid_core.signals.record import Record
    from ctsid_ros.config.channels import Config
    from ctsid_ros.recordings.playback import Recorded
    from ctsid_ros.report.comparison import Contender, Order
    from ctsid_ros.report.document import Headline
    from ctsid_ros.report.headline import Run

HELP = 'compare methods and orders on a bag, or stored models with each other'
EPILOG = """example: ctsid compare flight.mcap --params params.yaml --duration 20
         (all methods, and the orders around the chosen one, on the same data)
example: ctsid compare results/monday/model.json results/tuesday/model.json wednesday.mcap
         (stored models in the same drawings, and how each explains another bag)

With the same wrong setting all methods err alike. Where standard deviations leave room for a
difference that matters, models neither agree nor differ: "cannot tell". `validation.cross_check`
lets one of them take part in every verdict."""
TABLE = 'comparison.csv'
_ABOVE = 2      # so many orders above the chosen one are tried


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser, 'several are the parts of one recording. Models (model.json, or a folder of '
            'results with one) among them are compared with each other, on the bag if there is '
            'one')
    add_params(parser)
    add_changes(parser)
    add_interval(parser)
    parser.add_argument('--orders', type=_orders, metavar='N:M', help='orders that are tried '
                        f'beside each other [default: 1 to {_ABOVE} above the chosen one]')
    add_results(parser)
    add_style(parser)


def _orders(text: str) -> range:
    low, _, high = text.partition(':')
    if not (low.isdecimal() and (high or low).isdecimal() and 0 < int(low) <= int(high or low)):
        raise argparse.ArgumentTypeError(f'{text!r} is not N:M, two orders from 1 upwards')
    return range(int(low), int(high or low) + 1)


@dataclass(frozen=True)
class Compared:
    """
    What was compared.

    Parameters
    ----------
    found : sequence of Contender
    kind : str
        What they are: method, model.
    data : Recorded or None
        What they are compared on.
    offset : float
        Of its times, after the start of the bag [s].
    notes : tuple of str
        On the data.
    orders : mapping of int to Order
        Of the first method; empty if none were tried.
    files : mapping of str to str
        Of stored models, by their names.
    """

    found: Sequence[Contender]
    kind: str
    data: Recorded | None = None
    offset: float = 0.0
    notes: tuple[str, ...] = ()
    orders: Mapping[int, Order] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)

    @property
    def told(self) -> Sequence[Contender]:
        """The same as people are told of it: instants by the clock of the bag."""
        from ctsid_ros.replay.clock import by_bag_clock

        if self.kind != 'method' or self.data is None:
            return self.found
        start_ns = self.data.record.epoch_ns - round(self.offset * 1e9)
        return [replace(c, estimate=by_bag_clock(c.estimate, start_ns)) for c in self.found]


def command(args: argparse.Namespace) -> int:
    """Read, identify or load, write, print."""
    models = [path for path in args.bag if is_model(path)]
    bags = [path for path in args.bag if path not in models]
    if models:
        if args.orders:
            raise SettingsError(['--orders is for a bag without models; they have theirs'])
        return of_models(models, bags, args, 'compare')
    return _of_methods(args)


def of_models(paths: Sequence[str], bags: Sequence[str], args: argparse.Namespace, verb: str
              ) -> int:
    """Compare stored models; on a bag, if there is one. The verb names the folder of results."""
    from ctsid_core.judge.cross_check import agreement
    from ctsid_core.model.storage import load_metadata
    from ctsid_ros.replay.results import results_folder
    from ctsid_ros.report.comparison import Contender, document

    files = [model_file(p) for p in paths]
    models = read_models(files)
    (_, first), *_ = models.items()
    found = [Contender(name, e, None if e is first else replace(
        agreement(first, e, e.settings.method), method=name)) for name, e in models.items()]
    compared = Compared(found, 'model', files=dict(zip(models, files, strict=True)))
    if bags:
        config = changed(args, read_params(args.params) if args.params else _config(
            [load_metadata(f) for f in files], first, files[0]))
        check_channels(_model(first), config, files[0])
        compared = _on_data(compared, config, bags, args, files[0])
    args.bag = [*bags]
    with results_folder(args.out, bags or [str(Path(files[0]).resolve().parent)], verb,
                        force=args.force) as out, working('writing the report', quiet=args.quiet):
        told = _write(out, compared, args, f'{len(found)} models' + (
            f' on {named(bags)}' if bags else ''))
    if args.json:
        tell({'verb': verb, 'bag': named(bags) if bags else None, 'results': out,
              'reference': found[0].name, 'notes': compared.notes,
              'models': [{'name': c.name, 'file': f, **document(c)}
                         for c, f in zip(compared.found, files, strict=True)]})
    else:
        _print(compared, out, told)
    return ACCEPTED if any(c.estimate.ok for c in found) else NO_MODEL


def _config(metadata: Sequence[Mapping[str, object]], first: Estimate, path: str) -> Config:
    """Return the channels of the first model that names them."""
    from ctsid_ros.replay.results import config_of

    known = next((m for m in metadata if m.get('channels')), metadata[0])
    return config_of(known, first.settings, path)


def _on_data(compared: Compared, config: Config, bags: Sequence[str], args: argparse.Namespace,
             path: str) -> Compared:
    """Return models, of which `path` is the first, with what each makes of a bag."""
    from ctsid_core.bases.preparation import without_corrupt
    from ctsid_core.model.validation import prediction, simulation
    from ctsid_core.search.own_past import AHEAD, HORIZONS
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.report.outputs import Part
    from ctsid_ros.verbs.simulate import check_dead_times

    with open_bag(bags, getattr(args, 'time', ())) as bag:  # `show` has none
        config = config if args.params else of_this_bag(bag, config, path)
        data, offset, notes = _read(bag, config, args)
    models = [_model(c.estimate) for c in compared.found]
    record, spikes = without_corrupt(data.record, config.settings, *models)
    for model in models:
        check_dead_times(model, record)
    # All on the same samples.
    start = max(record.start, *(record.known_from(model.delay) for model in models))
    late = max((d for model in models for d in model.delay), default=0.0)
    record = record.between(start, record.end, lead=late)
    predicted = any(c.estimate.ok and c.estimate.by_predictions for c in compared.found)
    found = []
    for c in compared.found:
        assert c.model is not None
        ahead = prediction(c.model, record, HORIZONS[AHEAD])
        simulated = simulation(c.model, record, trim='refit')
        how = f'predicted {HORIZONS[AHEAD]} samples ahead' if predicted else 'simulated'
        drawn = ahead if predicted else simulated
        found.append(replace(c, simulated=simulated.fit, ahead=ahead.fit,
                             part=Part('These data', drawn, drawn.fit, how)))
    return replace(compared, found=found, data=data, offset=offset, notes=(*notes, *spikes))


def _read(bag: Any, config: Config, args: argparse.Namespace
          ) -> tuple[Recorded, float, tuple[str, ...]]:
    """Return the record, the offset of its times after the start of the bag [s], and notes."""
    from ctsid_ros.recordings.playback import read_record
    from ctsid_ros.replay.clock import zero_ns

    with progress('reading', quiet=args.quiet) as advance:
        data = read_record(bag, config, interval_of(args), advance=advance)
    epoch_ns = data.record.epoch_ns
    return data, (epoch_ns - zero_ns(bag, epoch_ns)) * 1e-9, (*bag.notes, *data.complaints)


def _of_methods(args: argparse.Namespace) -> int:
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.replay.results import bag_name, results_folder
    from ctsid_ros.report.comparison import document, reference

    with open_bag(args.bag, args.time) as bag:
        config = config_for(args, bag)
        with results_folder(args.out, args.bag, 'compare', force=args.force) as out:
            data, offset, notes = _read(bag, config, args)
            with progress('identifying', quiet=args.quiet) as advance:
                found = compare(data.record, config.settings, advance)
                orders = compare_orders(data.record, config.settings, found, args.orders, advance)
            compared = Compared(found, 'method', data, offset, notes, orders)
            with working('writing the report', quiet=args.quiet):
                told = _write(out, compared, args, f'{len(found)} methods on {bag_name(args.bag)}')
    if args.json:
        tell({'verb': 'compare', 'bag': named(args.bag), 'results': out,
              'reference': reference(found), 'notes': notes,
              'methods': [{'method': c.name, **document(c), 'seconds': c.seconds}
                          for c in found],
              'orders': [{'order': n, 'verdict': o.estimate.verdict.grade.name, 'fit': o.fit,
                          'held_out_fit': o.held_out_fit} for n, o in orders.items()]})
    else:
        _print(compared, out, told)
    return ACCEPTED if any(c.estimate.ok for c in found) else NO_MODEL


def compare(record: Record, settings: Settings, advance: Advance = silent) -> list[Contender]:
    """
    Return the model of every method from a record, HD-PBSID first.

    Parameters
    ----------
    record : Record
    settings : Settings
        Dead times that HD-PBSID finds are given to the others, which do not look for any. The
        order, if it is not given, each method chooses for itself.
    advance : callable, optional
        Called with the progress.
    """
    from ctsid_core.identify import identify
    from ctsid_core.judge.cross_check import agreement
    from ctsid_core.settings import METHODS, UNCHECKED
    from ctsid_ros.report.comparison import Contender
    from ctsid_ros.report.model_page import simulated

    settings = settings.replace(cross_check=UNCHECKED)
    found: list[Contender] = []
    first: Estimate | None = None
    for k, method in enumerate(METHODS):
        advance(0.6 * k / len(METHODS), method)
        begin = time.process_time()
        estimate = identify(record, settings.replace(method=method))
        seconds = time.process_time() - begin
        model = estimate.model or estimate.rejected_model
        part = None if model is None else simulated(model, record, method, estimate, estimate.fit)
        found.append(Contender(method, estimate,
                               agreement(first, estimate, method) if first else None, seconds,
                               part))
        if first is None and model is not None:
            first, settings = estimate, settings.replace(delay=model.delay).with_actuators(
                model.actuators)
    return found


def compare_orders(record: Record, settings: Settings, found: Sequence[Contender],
                   wanted: range | None = None, advance: Advance = silent
                   ) -> dict[int, Order]:
    """
    Return the model of each order by the method of the first that has a model.

    Parameters
    ----------
    record : Record
    settings : Settings
    found : sequence of Contender
        By methods. The first of them with a model is taken as it is at its own order; its dead
        times are given to the other orders.
    wanted : range, optional
        Of orders; else from 1 to two above that of the model.
    advance : callable, optional
        Called with the progress.
    """
    from ctsid_core.identify import identify
    from ctsid_core.settings import UNCHECKED
    from ctsid_ros.report.comparison import leader, order_of

    lead = leader(found)
    if lead.model is None:
        return {}
    highest = max(settings.max_order, lead.model.n)
    orders = wanted or range(1, min(lead.model.n + _ABOVE, highest) + 1)
    settings = settings.replace(method=lead.name, delay=lead.model.delay,
                                cross_check=UNCHECKED).with_actuators(lead.model.actuators)
    tried = {}
    for k, order in enumerate(orders):
        advance(0.6 + 0.4 * k / len(orders), f'order {order}')
        estimate = lead.estimate if order == lead.model.n else identify(
            record, settings.replace(order=order, max_order=max(order, settings.max_order)))
        tried[order] = order_of(estimate, record, lead.estimate)
    return tried


def _numbers(compared: Compared) -> list[Section]:
    """Return the sections of the terminal and of the report."""
    from ctsid_ros.report.comparison import (
        leader,
        order_sections,
        pole_section,
        table_section,
        verdict_section,
    )
    from ctsid_ros.report.sections import complaint_section

    found, lead = compared.told, leader(compared.found)
    return [table_section(found, compared.kind), pole_section(found, compared.kind),
            *order_sections(compared.orders, lead.model.n if lead.model else 0),
            verdict_section(found), complaint_section(compared.notes)]


def _print(compared: Compared, out: Path, told: Headline) -> None:
    from ctsid_ros.replay.results import PAGE

    print(to_text(_numbers(compared)))
    after = f'\n{next_text(told)}\n' if told.command else ''
    print(f'{after}\nResults: {out}/ ({PAGE} has the plots)')


def _write(out: Path, compared: Compared, args: argparse.Namespace, title: str) -> Headline:
    """Write the report, the table, and the models; return what the report says first."""
    from ctsid_core.model.storage import to_json
    from ctsid_core.settings import METHODS
    from ctsid_ros.config.origin import package_version
    from ctsid_ros.replay.results import PAGE, REPORT, origin, write_results
    from ctsid_ros.report.comparison import as_csv, drawn_sections, leader, order_series
    from ctsid_ros.report.document import to_markdown
    from ctsid_ros.report.headline import repeat_section
    from ctsid_ros.report.model_page import raw_section, sampling_section
    from ctsid_ros.report.page import to_html

    found, data, lead, run = compared.found, compared.data, leader(compared.found), run_of(args)
    for method in METHODS if args.force else ():
        (out / f'{method}.json').unlink(missing_ok=True)
    files, more, kept = {TABLE: as_csv(found, compared.kind)}, [], ''
    told: dict[str, object] = {'ctsid': package_version(), 'bag': []}
    drawn = [*drawn_sections(found, data.record if data else None, compared.offset)]
    if data is not None:
        told = origin(data.config, args.bag, {'start': args.start, 'duration': args.duration})
        drawn = drawn or [raw_section(data.record, compared.offset, data.config.settings)]
        more = [sampling_section(data.record, compared.offset, data.counts)]
        if compared.kind == 'method':
            files |= {f'{c.name}.json': to_json(c.estimate, told) for c in found if c.model}
            kept = f'{lead.name}.json' if lead.model else ''
    first, (table, *numbers) = _headline(compared, run), _numbers(compared)
    choice = [s for s in numbers if s.title in ('Which order', 'One order')]
    rest = [s for s in numbers if s not in choice]
    last = [*more, repeat_section(run, told, kept)]
    orders = order_series(compared.orders, lead.model.n if lead.model else 0)
    write_results(out, {
        **files, REPORT: to_markdown(title, [table, *numbers, *last], first),
        PAGE: to_html(title, [table, *choice, *drawn, *rest, *last], first, orders)})
    return first


def _headline(compared: Compared, run: Run) -> Headline:
    """Return what a comparison says first."""
    from ctsid_ros.report.comparison import agreeing, leader
    from ctsid_ros.report.headline import headline

    found, lead = compared.told, leader(compared.told)
    if compared.kind == 'model':
        return _headline_of_models(compared, run)
    first = headline(lead.estimate, run, [('methods that agree', agreeing(found))])
    first = replace(first, sentence=f'{lead.name}: {first.sentence}')
    return replace(first, command=run.command('identify'), purpose='one model, with every test '
                   'of it') if lead.estimate.good else first


def _headline_of_models(compared: Compared, run: Run) -> Headline:
    from ctsid_ros.report.comparison import agreeing, leader
    from ctsid_ros.report.document import Headline
    from ctsid_ros.report.tables import fit_words

    found, lead = compared.found, leader(compared.found)
    on_data = [c for c in found if c.simulated is not None]
    facts = [('verdicts', ', '.join(c.estimate.verdict.grade.name for c in found))]
    if len(found) > 1:
        facts.append((f'models that agree with {found[0].name}', agreeing(found)))
    if not on_data:
        words = ' '.join(f'{c.name}: {a.problem}' if a.problem else a.words
                         for c in found if (a := c.agreement))
        return Headline(lead.estimate.verdict.grade.name, words or lead.estimate.verdict.reason,
                        '', tuple(facts))
    lead = max(on_data, key=_mean_fit)
    outputs = ', '.join(_model(lead.estimate).output_names)
    words = (f'{lead.name} explains most of {outputs} on these data, {_words(lead)} %, simulated '
             'from the inputs alone with constant offsets fitted to them'
             + ''.join(f'; {c.name} {_words(c)} %' for c in on_data if c is not lead)
             + f'. {lead.name}: {lead.estimate.verdict.reason}')
    facts += [(f'simulation fit on these data [%], {c.name}', fit_words(c.simulated))
              for c in on_data if c.simulated is not None]
    return Headline(lead.estimate.verdict.grade.name, words, shlex.join(
        ('ctsid', 'simulate', compared.files[lead.name], *run.bags)), tuple(facts),
                    f'where on these data {lead.name} fits, and where not')


def _words(c: Contender) -> str:
    from ctsid_ros.report.tables import fit_words

    assert c.simulated is not None
    return fit_words(c.simulated)


def _mean_fit(c: Contender) -> float:
    """Return the mean fit on these data [%]; what diverged is last."""
    mean = float(c.simulated.mean()) if c.simulated is not None else math.nan
    return mean if math.isfinite(mean) else -math.inf


def _model(estimate: Estimate) -> StateSpace:
    """Return the model, accepted or rejected, which is known to be there."""
    model = estimate.model or estimate.rejected_model
    assert model is not None
    return model
