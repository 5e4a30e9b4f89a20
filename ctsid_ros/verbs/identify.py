# SPDX-License-Identifier: Apache-2.0
"""`ctsid identify`: one model of an interval of a bag."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ctsid_core.advice import advise
from ctsid_core.estimate import Estimate
from ctsid_core.identify import identify
from ctsid_core.signals import Record
from ctsid_core.statespace import StateSpace
from ctsid_core.storage import load_model, save_series, to_json
from ctsid_core.validation import Validation, residual_tests, simulation
from ctsid_ros.bag import open_bag
from ctsid_ros.document import Section, to_html, to_markdown, to_text
from ctsid_ros.experiment import experiment_section
from ctsid_ros.figures import output_figures
from ctsid_ros.playback import Recorded, read_record
from ctsid_ros.progress import progress
from ctsid_ros.report import (
    advice_section,
    bode_section,
    channel_section,
    choice_section,
    complaint_section,
    gain_section,
    model_section,
    residual_section,
    response_section,
    truth_section,
)
from ctsid_ros.results import (
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
from ctsid_ros.tables import Table, percent
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    NO_MODEL,
    add_bag,
    add_interval,
    add_params,
    add_results,
    add_style,
    config_for,
    interval_of,
    named,
    seconds,
    tell,
    zero_ns,
)

HELP = 'identify one model from an interval of a bag'
EPILOG = ('example: ctsid identify flight.mcap --params params.yaml --test-from 60\n'
          '         (one model of the first 60 s, tested on all that follows)')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    add_params(parser)
    add_interval(parser)
    parser.add_argument('--test-from', type=seconds, metavar='S',
                        help='do not learn from what comes later than this, but test the model '
                        'on it [s after the first message of the bag]')
    parser.add_argument('--truth', metavar='FILE',
                        help='model.json of the true plant, to compare with (of a simulation)')
    add_results(parser)
    add_style(parser)


@dataclass(frozen=True)
class Outcome:
    """What one identification gave."""

    data: Recorded
    estimate: Estimate
    offset: float  # of the record's times, after the start of the bag [s]
    tested: Record | None  # unseen data
    test: Validation | None  # on these, with the trim of the model
    refitted: Validation | None  # and with a trim of their own

    @property
    def model(self) -> StateSpace | None:
        """The model, accepted or not."""
        return self.estimate.model or self.estimate.rejected_model

    @property
    def learnt(self) -> Record:
        """What the model was identified from."""
        record = self.data.record
        return record if math.isnan(self.data.split) else \
            record.between(record.start, self.data.split)


def command(args: argparse.Namespace) -> int:
    """Read, identify, test, write, tell."""
    truth = load_model(args.truth) if args.truth else None
    with open_bag(args.bag) as bag:
        config = config_for(args, bag)
        with results_folder(args.out, args.bag, config.settings.method, force=args.force) as out:
            with progress('reading', quiet=args.quiet) as advance:
                data = read_record(bag, config, interval_of(args), split=args.test_from,
                                   advance=advance)
            start = data.record.epoch_ns
            outcome = _identify(data, (start - zero_ns(bag, start)) * 1e-9)
            notes = (*bag.notes, *data.complaints, *outcome.estimate.notes)
            _write(out, outcome, args, notes, truth)
    if args.json:
        tell(_document(outcome, args, notes, out))
    else:
        print(to_text(_sections(outcome, notes, truth)))
        print(f'\nResults: {out}/ ({PAGE} has the plots)')
    return ACCEPTED if outcome.estimate.ok else NO_MODEL


def _identify(data: Recorded, offset: float) -> Outcome:
    record, settings = data.record, data.config.settings
    part, tested = record, None
    if not math.isnan(data.split):
        lead = max(settings.delays(record.nu))
        part = record.between(record.start, data.split)
        tested = record.between(data.split, record.end, lead=lead)
    estimate = identify(part, settings)
    model = estimate.model or estimate.rejected_model
    if model is None or tested is None:
        return Outcome(data, estimate, offset, tested, None, None)
    return Outcome(data, estimate, offset, tested, simulation(model, tested),
                   simulation(model, tested, trim='refit'))


def _sections(outcome: Outcome, notes: tuple[str, ...], truth: StateSpace | None
              ) -> list[Section]:
    estimate, model = outcome.estimate, outcome.model
    fit = outcome.test.fit if outcome.test else np.empty(0)
    record = outcome.data.record
    end = record.end if math.isnan(outcome.data.split) else outcome.data.split
    title = (f'Model of {record.start + outcome.offset:.1f} to {end + outcome.offset:.1f} s: '
             + (estimate.status.value if estimate.ok else estimate.status.name))
    sections = [channel_section(outcome.data), model_section(estimate, title)]
    if model:
        sections += [_test_section(outcome, model), gain_section(model, estimate.covariance)]
        sections += [truth_section(estimate, (), truth)] if truth else []
    return [*sections, choice_section(estimate, brief=True), complaint_section(notes),
            advice_section(estimate, fit, outcome.data.complaints)]


def _test_section(outcome: Outcome, model: StateSpace) -> Section:
    if outcome.test is None or outcome.refitted is None or outcome.tested is None:
        return Section('', ())
    rows = tuple((name, percent(outcome.test.fit[i]), percent(outcome.refitted.fit[i]))
                 for i, name in enumerate(model.output_names))
    first, last = (t + outcome.offset for t in (outcome.tested.start, outcome.tested.end))
    return Section(f'Test on data the model has not seen, {first:.1f} to {last:.1f} s', (Table(
        ('output', 'simulation fit [%]', 'with trim refitted [%]'), rows, ('output',)),))


def _write(out: Path, outcome: Outcome, args: argparse.Namespace, notes: tuple[str, ...],
           truth: StateSpace | None) -> None:
    estimate, title = outcome.estimate, f'One model of {bag_name(args.bag)}'
    sections = _sections(outcome, notes, truth)
    if outcome.model:
        tested = outcome.tested or outcome.data.record
        sections.append(residual_section(residual_tests(outcome.model, tested), outcome.model))
        sections.append(experiment_section(advise(estimate, outcome.learnt), brief=False))
        sections.append(bode_section(outcome.model,
                                     covariance=estimate.covariance))
    metadata = origin(outcome.data.config, args.bag, _interval(args))
    write_results(out, {
        MODEL: to_json(estimate, metadata),
        REPORT: to_markdown(title, sections),
        PAGE: to_html(title, [*sections[:2], *_figures(outcome, truth), *sections[2:]])})
    for name in (SERIES, TABLE):
        save_series(out / name, [estimate], force=True)


def _figures(outcome: Outcome, truth: StateSpace | None) -> list[Section]:
    model = outcome.model
    if model is None:
        return []
    found = outcome.test or simulation(model, outcome.data.record)
    what = 'Data the model has not seen' if outcome.test else 'The data it was identified from'
    return [Section('Measured and simulated',
                    tuple(output_figures(model, found, outcome.offset, what))),
            response_section(model, found, truth, outcome.estimate.covariance)]


def _interval(args: argparse.Namespace) -> dict[str, object]:
    return {'start': args.start, 'duration': args.duration, 'test_from': args.test_from}


def _document(outcome: Outcome, args: argparse.Namespace, notes: tuple[str, ...], out: Path
              ) -> Mapping[str, Any]:
    estimate = outcome.estimate
    test = None
    if outcome.test and outcome.refitted and outcome.tested:
        test = {'from': outcome.tested.start + outcome.offset,
                'to': outcome.tested.end + outcome.offset, 'fit': outcome.test.fit,
                'fit_trim_refitted': outcome.refitted.fit, 'vaf': outcome.test.vaf}
    return {'verb': 'identify', 'bag': named(args.bag), 'results': out,
            'status': estimate.status.name, 'accepted': estimate.ok, 'test': test,
            'notes': notes, 'estimate': json.loads(to_json(
                estimate, origin(outcome.data.config, args.bag, _interval(args))))}
