# SPDX-License-Identifier: Apache-2.0
"""`ctsid replay`: models in sliding windows along a bag, as the live node would find them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctsid_ros.errors import BagError
from ctsid_ros.progress import progress
from ctsid_ros.replay.results import (
    MODEL,
    PAGE,
    REPORT,
    SERIES,
    TABLE,
    TOPICS_BAG,
    bag_name,
    origin,
    results_folder,
    write_results,
)
from ctsid_ros.report.document import Bullets, Headline, Section, next_text, to_markdown, to_text
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    INTERRUPTED,
    NO_MODEL,
    add_bag,
    add_budget,
    add_changes,
    add_interval,
    add_jobs,
    add_params,
    add_results,
    add_style,
    better_pairs,
    config_for,
    interval_of,
    named,
    read_truth,
    run_of,
    say,
    tell,
)

if TYPE_CHECKING:
    from ctsid_core.model.statespace import StateSpace
    from ctsid_ros.recordings.bag import Bag
    from ctsid_ros.replay.along import Along, Windows
    from ctsid_ros.replay.replay import Replay, Result

HELP = 'identify models in sliding windows along a bag'
EPILOG = """example: ctsid replay flight.mcap --params params.yaml --out results/flight

The windows are those of the parameter file (window.length, window.stride). None is skipped; each
model is tested on the first later window that shares no data with it ("next fit"). Ctrl-C ends
the run early and keeps the results so far. Long windows are identified on all cores, with the same
results to the last bit.

estimates.mcap has what the node would have published, stamped at the ends of the windows; config/
has layouts that plot it in Foxglove and PlotJuggler."""

_INTRODUCTION = ('Each window gives its own model. Its "next fit" is its simulation fit on the '
                 'first later window that shares no data with it.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    add_params(parser)
    add_changes(parser)
    add_interval(parser)
    parser.add_argument('--truth', metavar='FILE',
                        help='model.json of the true plant, to compare with (of a simulation)')
    add_budget(parser)
    add_jobs(parser)
    add_results(parser)
    add_style(parser)


def command(args: argparse.Namespace) -> int:
    """Replay, write, print."""
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.replay.replay import Replay
    from ctsid_ros.workers import cores

    truth = read_truth(args)
    with open_bag(args.bag, args.time) as bag:
        _look_for_several(args.bag)
        config = config_for(args, bag)
        with results_folder(args.out, args.bag, config.settings.method, force=args.force) as out:
            run = Replay(bag, config, interval_of(args), args.jobs or cores())
            interrupted = _run(run, args.quiet)
            if not run.results:
                say('interrupted before the first window was complete: there are no results')
                return INTERRUPTED
            report = _Report(run, bag, args, truth)
            first = report.write(out)
    if args.json:
        tell({**report.document(out, interrupted), 'next': first.command})
    else:
        print(to_text(report.sections()))
        print(f'\n{next_text(first)}\n\nResults: {out}/ ({PAGE} has the plots)')
    if interrupted:
        count = len(run.results)
        say(f'interrupted: the results are those of the first {count} '
            f'window{"" if count == 1 else "s"}')
        return INTERRUPTED
    return NO_MODEL if run.best is None else ACCEPTED


def _look_for_several(bags: Sequence[str]) -> None:
    """Say so if a folder has several recordings: windows across their ends have gaps."""
    from ctsid_ros.recordings.grouping import recordings

    groups: list[tuple[str, ...]] = []
    with suppress(BagError):  # which a replay does not mind
        groups = recordings(bags) if len(bags) == 1 else []
    if len(groups) > 1:
        say(f'these are {len(groups)} recordings, apart in time, replayed one after the other: '
            + '; '.join(named(group) for group in groups)
            + '; `ctsid batch` replays each by itself, on all cores')


def _run(run: Replay, quiet: bool) -> bool:
    """Run to the end; return whether it was interrupted."""
    try:
        with progress('replaying', quiet=quiet) as advance:
            run.run(advance)
    except KeyboardInterrupt:
        return True
    return False


class _Report:
    """What a replay gave, as sections, files and JSON."""

    def __init__(self, run: Replay, bag: Bag, args: argparse.Namespace, truth: StateSpace | None
                 ) -> None:
        from ctsid_ros.replay.clock import by_bag_clock, zero_ns
        from ctsid_ros.report.headline import Better

        self.args, self.truth, self.played = args, truth, run.played
        self.zero_ns = zero_ns(bag, run.results[0].estimate.start_ns)
        self.results = [replace(r, tracked=replace(r.tracked, estimate=by_bag_clock(
            r.estimate, self.zero_ns))) for r in run.results]
        best = len(run.results) - 1 if run.best is None else run.best
        self.run, self.best, self.number = run, self.results[best], best + 1
        self.better = Better() if run.best is not None else better_pairs(
            args.bag, args.time, run.played.config)
        self.notes = tuple(dict.fromkeys((*bag.notes, *self.played.complaints)))

    @property
    def model(self) -> StateSpace | None:
        return self.best.estimate.model or self.best.estimate.rejected_model

    def sections(self, *, verdict: bool = True) -> list[Section]:
        from ctsid_ros.replay.along import side
        from ctsid_ros.report.dead_time import delay_words, looked_for
        from ctsid_ros.report.sections import (
            channel_section,
            choice_section,
            complaint_section,
            remark_section,
            status_section,
            truth_section,
            window_section,
        )

        estimate, settings = self.best.estimate, self.played.config.settings
        count = len(self.results)
        title = (f'{named(self.args.bag)}: {count} window{"s" if count > 1 else ""} of '
                 f'{settings.window_length:g} s, one every {settings.window_stride:g} s')
        if (left := round(self.run.left, 1)) > 0.0:
            title += f'; the last {left:g} s are in none'
        sections = [self._changes(), Section(title, (_INTRODUCTION,)), channel_section(
            self.played, delays=delay_words(estimate, self.played.config)),
                    window_section(self.results, self.zero_ns, self.number - 1, [
                        side(self.windows, k, self.along.changes) for k in range(count)]),
                    status_section(self.results),
                    self._best_section(verdict=verdict)]
        if self.truth:
            sections.append(truth_section(estimate, self.results, self.truth))
        return [*sections, choice_section(estimate), complaint_section(self.notes),
                remark_section(estimate, self.best.next_fit, delay_sought=looked_for(
                    estimate, settings))]

    def _which(self) -> str:
        return 'of those about best on unseen data the one of fewest states' \
            if self.best.tested else \
            'the best on its own held-out data' if self.best.estimate.ok else 'the last one'

    def _best_section(self, *, verdict: bool) -> Section:
        from ctsid_ros.report.sections import fit_table, model_section

        estimate, model = self.best.estimate, self.model
        section = model_section(estimate,
                                f'Model of window {self.number}, {self._which()}: {MODEL}',
                                verdict=verdict)
        if model is None:
            return section
        table = fit_table(estimate, model, next_fit=self.best.next_fit)
        return replace(section, parts=(*section.parts[:-1], table))

    def write(self, out: Path) -> Headline:
        """Write all files, and return what the report says first."""
        from ctsid_core.model.storage import save_series, to_json
        from ctsid_ros.export.estimates_bag import write_estimates
        from ctsid_ros.report.explorer import window_series
        from ctsid_ros.report.headline import headline, repeat_section
        from ctsid_ros.report.page import to_html
        from ctsid_ros.report.responses import excited
        from ctsid_ros.report.sections import bode_section
        from ctsid_ros.report.window_headline import window_headline

        estimate, stored = self.best.estimate, self.run.results
        metadata = origin(self.played.config, self.args.bag, {
            'start': self.args.start, 'duration': self.args.duration, 'window': self.number})
        span = ((t - self.zero_ns) * 1e-9 for t in (estimate.start_ns, estimate.end_ns))
        run = run_of(self.args, str(out / MODEL), (next(span), next(span)))
        first = window_headline(headline(estimate, run, self._facts(), self.better), self.windows,
                                self.number - 1, self._which(), run)
        numbers = self.sections(verdict=False)
        if self.model:
            numbers.append(bode_section(self.model, covariance=estimate.covariance,
                                        band=excited(estimate)))
        numbers.append(repeat_section(run, metadata))
        title = f'Models along {bag_name(self.args.bag)}'
        write_results(out, {MODEL: to_json(stored[self.number - 1].estimate, metadata),
                            REPORT: to_markdown(title, numbers, first),
                            PAGE: to_html(title, [*self._drawn(), *numbers], first,
                                          window_series(self.windows))})
        for name in (SERIES, TABLE):
            save_series(out / name, [r.estimate for r in stored],
                        columns=self._columns(), force=True)
        write_estimates(out / TOPICS_BAG, self.played.config, [r.tracked for r in stored])
        return first

    def _facts(self) -> list[tuple[str, str]]:
        from ctsid_ros.report.tables import fit_words

        return [('next fit [%]', fit_words(self.best.next_fit)),
                ('window', f'{self.number} of {len(self.results)}')]

    def _changes(self) -> Section:
        from ctsid_ros.replay.along import changes

        found = (*(change.words for change in changes(self.windows)),
                 *(one.words for one in self.along.unlike))
        return Section('Changes of the plant', (Bullets(found),) if found else ())

    @cached_property
    def windows(self) -> Windows:
        """The windows as they are drawn."""
        from ctsid_ros.replay.along import Windows

        return Windows.of(self.results, self.zero_ns)

    @cached_property
    def along(self) -> Along:
        """What holds for the whole bag."""
        from ctsid_ros.replay.along import along

        return along(self.windows, self.number - 1)

    def _columns(self) -> dict[str, Sequence[float]]:
        """Return what the series has beside the estimates."""
        names = next((m.output_names for m in (e.model or e.rejected_model for e in
                                               (r.estimate for r in self.results)) if m), ())
        columns: dict[str, Sequence[float]] = {
            'realisation': [r.tracked.realisation for r in self.results]}
        for i, name in enumerate(names):
            columns[f'fresh_fit_{name} [%]'] = [float(r.tracked.fresh_fit[i])
                                                for r in self.results]
            columns[f'next_fit_{name} [%]'] = [float(r.next_fit[i]) for r in self.results]
        return columns

    def _drawn(self) -> list[Section]:
        from ctsid_core.model.validation import simulation
        from ctsid_ros.report.document import Explorer, Figure, Gallery
        from ctsid_ros.report.model_page import (
            Shown,
            marked,
            output_section,
            raw_section,
            residual_sections,
            response_sections,
            sampling_section,
            simulated,
        )
        from ctsid_ros.report.window_figures import gain_figures, window_figure

        estimate, settings, windows = self.best.estimate, self.played.config.settings, self.windows
        along: Figure = window_figure(windows, self.truth)
        gains = tuple(gain_figures(windows))
        sections = [Section('Models along the bag', (along, *([Gallery(gains, min(len(gains), 3))]
                                                              if gains else []))),
                    Section('One window', (Explorer(self.number - 1),))]
        record = self.run.record(self.number - 1)
        offset = (record.epoch_ns - self.zero_ns) * 1e-9
        if self.model is None:
            return [*sections, raw_section(record, offset, settings),
                    sampling_section(record, offset, self.played.counts)]
        part = simulated(self.model, record, f'Window {self.number}, of which the model is',
                         estimate, estimate.fit)
        shown = Shown(record, self.model, (part,), offset)
        drawn = [output_section(shown, settings, estimate), *response_sections(
            {'identified': (self.model, estimate.covariance)}, shown, estimate, self.truth),
            *residual_sections(shown, simulation(self.model, record, trim='refit'), part.fit)]
        return [*sections, *marked(drawn, estimate),
                sampling_section(record, offset, self.played.counts)]

    def document(self, out: Path, interrupted: bool) -> Mapping[str, Any]:
        from dataclasses import asdict

        from ctsid_ros.replay.along import changes

        found = self.along
        return {'verb': 'replay', 'bag': named(self.args.bag), 'results': out,
                'interrupted': interrupted, 'verdict': found.word,
                'changes': [asdict(c) for c in changes(self.windows)],
                'unlike': [asdict(one) for one in found.unlike],
                'accepted': sum(r.estimate.ok for r in self.results),
                'good': sum(r.estimate.good for r in self.results),
                'best_window': self.number if self.best.estimate.ok else None,
                'seconds_left': self.run.left,
                'windows': [self._window(i, r) for i, r in enumerate(self.results, 1)],
                'true_poles': self.truth.poles if self.truth else None,
                'notes': self.notes}

    def _window(self, index: int, result: Result) -> dict[str, Any]:
        from ctsid_core.model.model_json import describe

        estimate, tracked = result.estimate, result.tracked
        span = ((t - self.zero_ns) * 1e-9 for t in (estimate.start_ns, estimate.end_ns))
        return {'window': index, **dict(zip(('from', 'to'), span, strict=True)),
                'start_ns': estimate.start_ns, 'end_ns': estimate.end_ns,
                'status': estimate.status.name, 'message': estimate.status.value,
                'verdict': describe(estimate.verdict),
                'order': estimate.model.n if estimate.model else None,
                'poles': estimate.model.poles if estimate.model else [],
                'pole_std': estimate.pole_std, 'fit': estimate.fit,
                'held_out_fit': estimate.held_out_fit, 'fresh_fit': tracked.fresh_fit,
                'next_fit': result.next_fit, 'condition': estimate.condition,
                'realisation': tracked.realisation, 'modes': tracked.modes,
                'eigenvalues': tracked.eigenvalues, 'eigenvalue_std': tracked.eigenvalue_std}
