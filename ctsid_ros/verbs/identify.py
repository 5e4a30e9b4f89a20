# SPDX-License-Identifier: Apache-2.0
"""`ctsid identify`: one model of an interval of a bag, or of several recordings."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import json
import math
from pathlib import Path
import re
from typing import TYPE_CHECKING, Any

from ctsid_core.errors import SettingsError
from ctsid_ros.errors import BagError
from ctsid_ros.progress import Advance, progress, working
from ctsid_ros.replay.results import (
    MODEL,
    PAGE,
    REPORT,
    SERIES,
    TABLE,
    bag_name,
    origin,
    results_folder,
    write_results,
)
from ctsid_ros.report.document import Headline, Section, next_text, to_markdown, to_text
from ctsid_ros.report.tables import Table, percent
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    NO_MODEL,
    add_bag,
    add_budget,
    add_changes,
    add_interval,
    add_params,
    add_results,
    add_style,
    bag_words,
    better_pairs,
    config_for,
    interval_of,
    interval_words,
    named,
    read_params,
    read_truth,
    run_of,
    say,
    seconds,
    span,
    tell,
)

if TYPE_CHECKING:
    from ctsid_core.linear.types import Array
    from ctsid_core.model.estimate import Estimate
    from ctsid_core.model.statespace import StateSpace
    from ctsid_core.model.validation import Validation
    from ctsid_core.signals.record import Record
    from ctsid_ros.config.channels import Config
    from ctsid_ros.recordings.playback import Interval, Recorded
    from ctsid_ros.report.headline import Run
    from ctsid_ros.report.model_page import Shown

HELP = 'identify one model from one or several recordings'
EPILOG = ('example: ctsid identify flight.mcap --params params.yaml --test-from 60\n'
          '         (one model of the first 60 s, tested on the rest)\n'
          'example: ctsid identify monday tuesday --params params.yaml\n'
          '         (one model of two flights, each with constant offsets of its own)')
_SEVERAL = ('several that overlap or follow each other within a second are the parts of one '
            'recording; else each is a recording of its own, and one model of all is made, with '
            'constant offsets (a trim) for each')
_MOST_DRAWN = 6  # records


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser, _SEVERAL)
    add_params(parser)
    add_changes(parser)
    add_interval(parser)
    parser.add_argument('--interval', type=span, action='append', metavar='START:END',
                        help='take this part of each recording [s after its first message]; may '
                        'be given several times: one model of all parts, with offsets for each')
    parser.add_argument('--test-from', type=seconds, metavar='S',
                        help='identify from the data before this time only, and test the model '
                        'on the rest [s after the first message of each recording]')
    parser.add_argument('--truth', metavar='FILE',
                        help='model.json of the true plant, to compare with (of a simulation)')
    add_budget(parser)
    add_results(parser)
    add_style(parser)


@dataclass(frozen=True)
class Source:
    """
    Where a record comes from, and which part of it is kept for a test.

    Parameters
    ----------
    bags : tuple of str
        The parts of its recording.
    interval : Interval
        Of it.
    data : Recorded
    offset : float
        Of the record's times, after the start of the bag [s].
    notes : tuple of str
        On the bag and its messages.
    """

    bags: tuple[str, ...]
    interval: Interval
    data: Recorded
    offset: float
    notes: tuple[str, ...]

    @property
    def learnt(self) -> Record:
        """The part that the model is identified from."""
        record, split = self.data.record, self.data.split
        return record if math.isnan(split) else self._part(record.start, split)

    @property
    def tested(self) -> Record | None:
        """The part that it is tested on."""
        record, split = self.data.record, self.data.split
        return None if math.isnan(split) else self._part(split, record.end)

    def _part(self, start: float, end: float) -> Record:
        """Return a part of the record, and what acts in it of the inputs before."""
        record, split = self.data.record, self.data.split
        return record.between(start, end, lead=self.data.config.settings.longest_delay(
            record.nu, split - record.start))

    @property
    def span(self) -> tuple[float, float]:
        """Start and end of what was learnt from, after the start of the bag [s]."""
        record, split = self.data.record, self.data.split
        end = record.end if math.isnan(split) else split
        return record.start + self.offset, end + self.offset


@dataclass(frozen=True)
class Test:
    """
    A test of the model on unseen data: its simulation, offsets fitted to them, or predictions.

    `failed`: what is wrong, or nothing.
    """

    source: Source
    record: Record
    test: Validation
    failed: str


@dataclass(frozen=True)
class Outcome:
    """What one identification gave."""

    sources: tuple[Source, ...]
    estimate: Estimate
    tests: tuple[Test, ...]

    @property
    def model(self) -> StateSpace | None:
        """The model, accepted or not."""
        return self.estimate.model or self.estimate.rejected_model

    @property
    def told(self) -> Estimate:
        """The estimate as people are told of it: instants by the clock of the bag."""
        from ctsid_ros.replay.clock import by_bag_clock

        if len(self.sources) > 1:
            reason = re.sub(r'\brecord (\d+)', lambda found: f'{found[0]} ('
                            f'{named(self.sources[int(found[1]) - 1].bags)})',
                            self.estimate.verdict.reason)
            return replace(self.estimate, verdict=replace(self.estimate.verdict, reason=reason))
        start_ns = self.estimate.start_ns - round(self.sources[0].span[0] * 1e9)
        return by_bag_clock(self.estimate, start_ns)

    @property
    def config(self) -> Config:
        """Channels and settings."""
        return self.sources[0].data.config

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the data and the estimate."""
        several = len(self.sources) > 1
        own = [f'record {i}: {note}' if several else note
               for i, source in enumerate(self.sources, 1) for note in source.notes]
        return (*own, *self.told.notes)


def command(args: argparse.Namespace) -> int:
    """Read, identify, test, write, print."""
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.grouping import recordings
    from ctsid_ros.recordings.playback import Interval
    from ctsid_ros.report.headline import Better, headline

    truth = read_truth(args)
    intervals = _intervals(args)
    groups = recordings(args.bag, _topics(args), say, args.time)
    with open_bag(groups[0], args.time) as bag:
        config = config_for(args, bag)
    if len(groups) > 1:
        say(f'these are {len(groups)} recordings of their own: one model of all, with constant '
            'offsets (a trim) of each: ' + '; '.join(named(group) for group in groups)
            + '; `ctsid batch` makes models of each by itself')
    with results_folder(args.out, args.bag, config.settings.method, force=args.force) as out:
        with progress('reading', quiet=args.quiet) as advance:
            sources = [_read(group, args.time, config, interval, args.test_from, advance)
                       for group in groups for interval in intervals]
        with working(_task(sources), quiet=args.quiet):
            outcome = _identify(tuple(sources), args.test_from)
        outcome = _noted(outcome, getattr(args, 'doubts', ()))
        if getattr(args, 'whole', False) and outcome.estimate.ok:
            with progress('reading all of it', quiet=args.quiet) as advance:
                outcome = _noted(outcome, _on_all(outcome, _read(
                    groups[0], args.time, config, Interval(), None, advance)))
        with working('writing the report', quiet=args.quiet):
            better = Better() if outcome.estimate.ok else better_pairs(
                groups[0], args.time, outcome.config)
            run = _run(outcome, args, str(out / MODEL))
            first = headline(outcome.told, run, _facts(outcome), better)
            _write(out, outcome, args, truth, run, first)
    if args.json:
        tell({**_document(outcome, args, out), 'next': first.command})
    else:
        print(to_text(_sections(outcome, truth)))
        print(f'\n{next_text(first)}\n\nResults: {out}/ ({PAGE} has the plots)')
    return ACCEPTED if outcome.estimate.ok else NO_MODEL


def _run(outcome: Outcome, args: argparse.Namespace, model: str) -> Run:
    run, sources = run_of(args, model, outcome.sources[0].span), outcome.sources
    return replace(run, records=tuple(
        replace(run, bags=bag_words(args, s.bags), span=s.span, interval=words, chosen=words)
        for s in sources for words in [interval_words(s.interval.start, s.interval.duration)]
        ) if len(sources) > 1 else ())


def _task(sources: Sequence[Source]) -> str:
    """Return what is being done, and how long it may take."""
    records = [s.data.record for s in sources]
    samples = sum(len(signal.time) for r in records for signal in (*r.inputs, *r.outputs))
    budget = sources[0].data.config.settings.budget
    length = sum(r.duration for r in records)
    return (f'identifying one model of {length:.0f} s of data, {samples} samples' + (
            f', in about {budget:g} s of processor' if budget else ''))


def _intervals(args: argparse.Namespace) -> list[Interval]:
    if not args.interval:
        return [interval_of(args)]
    if args.start or math.isfinite(args.duration) or args.test_from is not None:
        raise SettingsError(['--interval says all; do not add --start, --duration or --test-from'])
    intervals = sorted(args.interval, key=lambda interval: interval.start)
    for one, other in zip(intervals[:-1], intervals[1:], strict=True):
        if one.start + one.duration > other.start:
            raise SettingsError([f'--interval {other.start:g}:... begins before the one at '
                                 f'{one.start:g} s ends; data in both would count twice'])
    return list(args.interval)


def _topics(args: argparse.Namespace) -> set[str]:
    return {c.topic for c in read_params(args.params).channels} if args.params else set()


def _read(bags: tuple[str, ...], time: Sequence[str], config: Config, interval: Interval,
          split: float | None, advance: Advance) -> Source:
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.playback import read_record
    from ctsid_ros.replay.clock import zero_ns

    with open_bag(bags, time) as bag:
        if split is not None and split >= (bag.end_ns - bag.start_ns) * 1e-9 > 0.0:
            split = None  # all of a recording so short is learnt from
        try:
            data = read_record(bag, config, interval, split=split, advance=advance)
        except BagError as error:
            raise BagError(f'{named(bags)}: {error}') from None
        start = data.record.epoch_ns
        return Source(bags, interval, data, (start - zero_ns(bag, start)) * 1e-9,
                      (*bag.notes, *data.complaints))


def _identify(sources: tuple[Source, ...], split: float | None) -> Outcome:
    if split is not None and all(math.isnan(s.data.split) for s in sources):
        raise BagError(f'no recording is longer than {split:g} s; choose another time to split at')
    from ctsid_core.bases.preparation import without_corrupt
    from ctsid_core.identify import identify
    from ctsid_core.judge.rules import retested
    from ctsid_core.search.held_out import as_judged, failure

    estimate = identify([s.learnt for s in sources], sources[0].data.config.settings)
    model, tests = estimate.model or estimate.rejected_model, []
    for number, source in enumerate(sources, 1):
        tested = source.tested
        if model is not None and tested is not None:
            whole, tested = (without_corrupt(record, estimate.settings, model)[0]
                             for record in (source.data.record, tested))
            own = estimate.trimmed(model, number)
            found = as_judged(estimate, own, tested, trim='refit')
            tests.append(Test(source, tested, found, failure(estimate, found, whole)))
    failed = next((t for t in tests if t.failed), None)
    if failed is not None:
        which = f'of record {sources.index(failed.source) + 1} ' if len(sources) > 1 else ''
        estimate = retested(estimate, f'on data {which}that it has not seen {failed.failed}')
    return Outcome(sources, estimate, tuple(tests))


def _noted(outcome: Outcome, notes: tuple[str, ...]) -> Outcome:
    """Return an outcome whose estimate has further notes, before its own."""
    estimate = outcome.estimate
    return replace(outcome, estimate=replace(estimate, notes=(*notes, *estimate.notes)))


def _on_all(outcome: Outcome, source: Source) -> tuple[str, ...]:
    """Return how much a model that is of parts of a recording explains of all of it, in words."""
    from ctsid_core.bases.preparation import without_corrupt
    from ctsid_core.search.held_out import as_judged
    from ctsid_ros.report.tables import fit_words

    estimate = outcome.estimate
    assert estimate.model is not None
    whole, _ = without_corrupt(source.data.record, estimate.settings, estimate.model)
    found = as_judged(estimate, estimate.model, whole, trim='refit')
    own = sum(s.data.record.duration for s in outcome.sources)
    return (f'the model is of {own:.0f} s in which the inputs excite the plant; of all '
            f'{whole.duration:.0f} s of the recording, with offsets fitted to them, it explains '
            f'{fit_words(found.fit)} %',)


def _sections(outcome: Outcome, truth: StateSpace | None, *, verdict: bool = True
              ) -> list[Section]:
    import numpy as np

    from ctsid_ros.report.dead_time import delay_words, looked_for
    from ctsid_ros.report.sections import (
        channel_section,
        choice_section,
        complaint_section,
        gain_section,
        model_section,
        record_section,
        remark_section,
        truth_section,
    )

    estimate, model, sources = outcome.told, outcome.model, outcome.sources
    fits = [t.test.fit for t in outcome.tests]
    fit = np.min(fits, axis=0) if fits else np.empty(0)
    start, end = (round(t, 1) + 0.0 for t in sources[0].span)        # no -0.0
    what = f'{start:.1f} to {end:.1f} s' if len(sources) == 1 else f'{len(sources)} records'
    title = f'Model of {what}: ' + (estimate.status.value if estimate.ok else
                                    estimate.status.name)
    delays = delay_words(estimate, outcome.config)
    sections = [channel_section(sources[0].data, delays=delays)]
    if len(sources) > 1:
        sections = [record_section(estimate, [(named(s.bags), *s.span) for s in sources]),
                    *(channel_section(s.data, f'Signals of record {i}', brief=i == 1,
                                      delays=delays)
                      for i, s in enumerate(sources, 1))]
    sections.append(model_section(estimate, title, verdict=verdict))
    if model:
        sections += [*(_test_section(t, model, outcome) for t in outcome.tests),
                     gain_section(model, estimate.covariance)]
        sections += [truth_section(estimate, (), truth)] if truth else []
    return [*sections, choice_section(estimate, brief=True), complaint_section(outcome.notes),
            remark_section(estimate, fit, delay_sought=looked_for(
                estimate, outcome.config.settings))]


def _test_section(test: Test, model: StateSpace, outcome: Outcome) -> Section:
    ahead = _ahead(outcome.estimate)
    how = f'fit, {ahead} [%]' if ahead else 'simulation fit, offsets refitted [%]'
    rows = tuple((name, percent(test.test.fit[i])) for i, name in enumerate(model.output_names))
    words = [f'Failed: {test.failed}.'] if test.failed else []
    first, last = (t + test.source.offset for t in (test.record.start, test.record.end))
    whose = f' of record {outcome.sources.index(test.source) + 1}' \
        if len(outcome.sources) > 1 else ''
    return Section(f'Test on data{whose} the model has not seen, {first:.1f} to {last:.1f} s', (
        *words, Table(('output', how), rows, ('output',))))


def _ahead(estimate: Estimate) -> str:
    """Return how far ahead the predictions are that the fits of a model are of, if they are."""
    from ctsid_core.search.own_past import AHEAD, HORIZONS

    return f'predicted {HORIZONS[AHEAD]} samples ahead' if estimate.by_predictions else ''


def _write(out: Path, outcome: Outcome, args: argparse.Namespace,
           truth: StateSpace | None, run: Run, first: Headline) -> None:
    from ctsid_core.model.storage import save_series, to_json
    from ctsid_ros.report.headline import repeat_section
    from ctsid_ros.report.page import to_html

    estimate, title = outcome.estimate, f'One model of {bag_name(args.bag)}'
    if len(outcome.sources) > 1:
        title = f'One model of {len(outcome.sources)} records'
    found = _origin(outcome, args)
    numbers = [*_sections(outcome, truth, verdict=False), *_numbers(outcome),
               repeat_section(run, found)]
    write_results(out, {
        MODEL: to_json(estimate, found),
        REPORT: to_markdown(title, numbers, first),
        PAGE: to_html(title, [*_drawn(outcome, truth), *numbers], first)})
    for name in (SERIES, TABLE):
        save_series(out / name, [estimate], force=True)


def _facts(outcome: Outcome) -> list[tuple[str, str]]:
    from ctsid_ros.report.tables import fit_words

    if not outcome.estimate.ok:
        return []
    return [('fit on unseen data [%]' + (f', record {outcome.sources.index(t.source) + 1}'
                                         if len(outcome.sources) > 1 else ''),
             fit_words(t.test.fit)) for t in outcome.tests]


def _numbers(outcome: Outcome) -> list[Section]:
    """Return what is too long for the terminal."""
    from ctsid_core.advice.advice import advise
    from ctsid_core.model.validation import residual_tests
    from ctsid_ros.report.experiment import experiment_section, helps
    from ctsid_ros.report.responses import excited
    from ctsid_ros.report.sections import bode_section, residual_section

    estimate, model, sections = outcome.estimate, outcome.model, []
    if model is None:
        return []
    predicted = estimate.by_predictions
    for number, record in _shown(outcome):
        own = estimate.trimmed(model, number)
        tests = residual_tests(own, record, residuals='prediction' if predicted else 'simulation')
        if len(outcome.sources) == 1 and not outcome.tests:   # the same data: the same number
            tests = replace(tests, whiteness=estimate.verdict.whiteness)
        sections.append(residual_section(tests, own, predicted=predicted))
    if len(outcome.sources) == 1:
        advice = advise(estimate, outcome.sources[0].learnt)
        if helps(estimate, advice):
            sections.append(experiment_section(advice, brief=False, rejected=not estimate.ok))
    sections.append(bode_section(model, covariance=estimate.covariance, band=excited(estimate)))
    return sections


def _shown(outcome: Outcome) -> list[tuple[int, Record]]:
    """
    Return the numbers of the first records, and of each what was not learnt from, or all.

    Without corrupt samples: the residuals of one would hide all others.
    """
    from ctsid_core.bases.preparation import without_corrupt

    return [(i, without_corrupt(s.tested or s.data.record, outcome.config.settings,
                                *filter(None, (outcome.model,)))[0])
            for i, s in enumerate(outcome.sources[:_MOST_DRAWN], 1)]


def _drawn(outcome: Outcome, truth: StateSpace | None) -> list[Section]:
    from ctsid_core.model.validation import simulation
    from ctsid_ros.report.model_page import (
        marked,
        output_section,
        raw_section,
        residual_sections,
        response_sections,
        sampling_section,
    )

    first = outcome.sources[0]
    sampling = sampling_section(first.data.record, first.offset, first.data.counts)
    if outcome.model is None:
        return [raw_section(first.data.record, first.offset, outcome.config.settings), sampling]
    estimate = outcome.estimate
    tested = _shown(outcome)
    shown = [_of_record(outcome, number) for number, _ in tested]
    sections = [output_section(one, outcome.config.settings, estimate) for one in shown]
    sections += response_sections({'identified': (outcome.model, estimate.covariance)}, shown[0],
                                  estimate, truth)
    last = shown[0].parts[-1]
    own = replace(shown[0], record=tested[0][1])
    sections += residual_sections(own, simulation(own.model, own.record, trim='refit'), last.fit)
    return [*marked(sections, estimate), sampling]


def _of_record(outcome: Outcome, number: int) -> Shown:
    """Return a record with what the model makes of what it has learnt from, and of the rest."""
    from ctsid_ros.report.model_page import Shown, simulated
    from ctsid_ros.report.outputs import Part

    source, several = outcome.sources[number - 1], len(outcome.sources) > 1
    assert outcome.model is not None
    own = outcome.estimate.trimmed(outcome.model, number)
    parts = [simulated(own, source.learnt, 'The data it was identified from', outcome.estimate,
                       _fit_on(outcome.estimate, number))]
    how = _ahead(outcome.estimate) or 'simulated'
    parts += [Part(f'Data the model has not seen (shaded), {how}', t.test, t.test.fit, how)
              for t in outcome.tests if t.source is source]
    return Shown(source.data.record, own, parts, source.offset,
                 f', record {number}' if several else '')


def _fit_on(estimate: Estimate, number: int) -> Array:
    """Return the fits on one of the records that a model was identified from [%]."""
    return next((r.fit for r in estimate.records if r.number == number), estimate.fit)


def _origin(outcome: Outcome, args: argparse.Namespace) -> dict[str, object]:
    from ctsid_ros.replay.results import bag_hash

    several = outcome.sources if len(outcome.sources) > 1 else ()
    known = {bags: bag_hash(bags) for bags in {s.bags for s in several}}
    records = [{'bag': [Path(b).name for b in s.bags], 'sha256': known[s.bags],
                'start': s.span[0], 'end': s.span[1]} for s in several]
    return origin(outcome.config, args.bag, _interval(args), records)


def _interval(args: argparse.Namespace) -> dict[str, object]:
    several = {'intervals': [[i.start, i.start + i.duration] for i in args.interval]} \
        if args.interval else {}
    return {'start': args.start, 'duration': args.duration, 'test_from': args.test_from, **several}


def _document(outcome: Outcome, args: argparse.Namespace, out: Path) -> Mapping[str, Any]:
    from ctsid_core.model.storage import to_json

    estimate = outcome.estimate
    tests = [{'from': t.record.start + t.source.offset, 'to': t.record.end + t.source.offset,
              'passed': not t.failed, 'fit': t.test.fit, 'vaf': t.test.vaf}
             for t in outcome.tests]
    several: dict[str, Any] = {} if len(outcome.sources) == 1 else {
        'records': [{'bag': s.bags, 'from': s.span[0], 'to': s.span[1]} for s in outcome.sources],
        'tests': [t | {'record': outcome.sources.index(found.source) + 1}
                  for t, found in zip(tests, outcome.tests, strict=True)]}
    return {'verb': 'identify', 'bag': named(args.bag), 'results': out,
            'status': estimate.status.name, 'accepted': estimate.ok,
            'test': tests[0] if tests and not several else None, **several,
            'notes': outcome.notes,
            'estimate': json.loads(to_json(estimate, _origin(outcome, args)))}
