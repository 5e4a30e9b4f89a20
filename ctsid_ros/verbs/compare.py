# SPDX-License-Identifier: Apache-2.0
"""`ctsid compare`: the models of all methods from the same data, side by side."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
import math
import time
from typing import TYPE_CHECKING

from ctsid_ros.progress import Advance, progress, silent
from ctsid_ros.report.document import GLOSSARY, Bullets, Section, to_text
from ctsid_ros.report.tables import Table, number, percent, plus_minus, pole_text
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    NO_MODEL,
    add_bag,
    add_interval,
    add_params,
    add_report,
    add_style,
    config_for,
    interval_of,
    named,
    run_of,
    say,
    tell,
    zero_ns,
)

if TYPE_CHECKING:
    from ctsid_core.linear.types import Array
    from ctsid_core.model.cross_check_result import Agreement
    from ctsid_core.model.estimate import Estimate
    from ctsid_core.model.statespace import StateSpace
    from ctsid_core.settings import Settings
    from ctsid_core.signals.record import Record
    from ctsid_ros.recordings.playback import Recorded

HELP = 'identify one interval of a bag by all methods, side by side'
EPILOG = ('example: ctsid compare flight.mcap --params params.yaml --duration 20\n'
          '         (with the same wrong setting all methods err alike; a large standard\n'
          '         deviation hides any difference, so look at the percentage;\n'
          '         `validation.cross_check` lets one of them take part in every verdict)')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    add_params(parser)
    add_interval(parser)
    add_report(parser)
    add_style(parser)


@dataclass(frozen=True)
class Contender:
    """
    The result of one method on the data.

    Parameters
    ----------
    method : str
    estimate : Estimate
    seconds : float
        Of processor time.
    agreement : Agreement or None
        With the first method that has a model; None for that one and those before it.
    """

    method: str
    estimate: Estimate
    seconds: float
    agreement: Agreement | None

    @property
    def model(self) -> StateSpace | None:
        """The model, accepted or not."""
        return self.estimate.model or self.estimate.rejected_model


def command(args: argparse.Namespace) -> int:
    """Read, identify by every method, print."""
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.playback import read_record
    from ctsid_ros.report.sections import complaint_section

    with open_bag(args.bag, args.time) as bag:
        config = config_for(args, bag)
        with progress('reading', quiet=args.quiet) as advance:
            data = read_record(bag, config, interval_of(args), advance=advance)
        notes = (*bag.notes, *data.complaints)
        epoch_ns = data.record.epoch_ns
        offset = (epoch_ns - zero_ns(bag, epoch_ns)) * 1e-9
    with progress('identifying', quiet=args.quiet) as advance:
        found = compare(data.record, config.settings, advance)
    if args.out is not None:
        _write(found, data, offset, args, notes)
    if args.json:
        tell({'verb': 'compare', 'bag': named(args.bag), 'reference': _reference(found),
              'notes': notes, 'methods': [_document(c) for c in found]})
    else:
        print(to_text([*_sections(found), complaint_section(notes)]))
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

    settings = settings.replace(cross_check=UNCHECKED)
    found: list[Contender] = []
    first: Estimate | None = None
    for k, method in enumerate(METHODS):
        advance(k / len(METHODS), method)
        begin = time.process_time()
        estimate = identify(record, settings.replace(method=method))
        seconds = time.process_time() - begin
        found.append(Contender(method, estimate, seconds,
                               agreement(first, estimate, method) if first else None))
        model = found[-1].model
        if first is None and model is not None:
            first, settings = estimate, settings.replace(delay=model.delay)
    return found


def _write(found: Sequence[Contender], data: Recorded, offset: float, args: argparse.Namespace,
           notes: tuple[str, ...]) -> None:
    """Write the report."""
    from dataclasses import replace

    from ctsid_core.settings import METHODS
    from ctsid_ros.replay.results import (
        PAGE,
        REPORT,
        bag_name,
        make_folder,
        origin,
        write_report,
    )
    from ctsid_ros.report.document import to_markdown
    from ctsid_ros.report.headline import headline, repeat_section
    from ctsid_ros.report.model_page import (
        Shown,
        output_section,
        raw_section,
        response_sections,
        sampling_section,
        simulated,
    )
    from ctsid_ros.report.page import to_html
    from ctsid_ros.report.sections import complaint_section

    record, settings, run = data.record, data.config.settings, run_of(args)
    with_model = [c for c in found if c.model is not None]
    lead = next((c for c in with_model if c.estimate.ok), (*with_model, *found)[0])
    first = headline(lead.estimate, run, [('methods that agree', _agreeing(found))])
    first = replace(first, sentence=f'{lead.method}: {first.sentence}',
                    command=run.command('identify') if lead.estimate.ok else first.command)
    drawn = [raw_section(record, offset, settings)]
    if lead.model is not None:
        models = {c.method: (c.model, c.estimate.covariance) for c in with_model
                  if c.model is not None}
        parts = [simulated(c.model, record, c.method, c.estimate, c.estimate.fit)
                 for c in with_model if c.model is not None]
        every = [Shown(record, c.model, (part,), offset, f', {c.method}')
                 for c, part in zip(with_model, parts, strict=True) if c.model is not None]
        drawn = [*response_sections(models, every[0], lead.estimate),
                 *(output_section(shown, settings) for shown in every)]
    numbers = [*_sections(found), complaint_section(notes), repeat_section(run, origin(
        data.config, args.bag, {'start': args.start, 'duration': args.duration}))]
    title = f'{len(METHODS)} methods on {bag_name(args.bag)}'
    folder = make_folder(args.out, args.bag, 'compare', force=args.force)
    write_report(folder, {REPORT: to_markdown(title, numbers, first),
                          PAGE: to_html(title, [*numbers[:1], *drawn,
                                                sampling_section(record, offset, data.counts),
                                        *numbers[1:]],
                                        first)})
    say(f'wrote {folder / PAGE}')


def _agreeing(found: Sequence[Contender]) -> str:
    asked = [c.agreement for c in found if c.agreement is not None]
    return f'{sum(a.agrees for a in asked)} of {len(asked)}'


def _reference(found: Sequence[Contender]) -> str | None:
    """Return the method that the others are compared with."""
    return next((c.method for c in found if c.model is not None), None)


def _sections(found: Sequence[Contender]) -> list[Section]:
    reference = _reference(found)
    rows = tuple((c.method, c.estimate.verdict.grade.name, str(c.model.n) if c.model else '-',
                  _fits(c.estimate.fit), _fits(c.estimate.held_out_fit), *_differs(c.agreement),
                  number(c.seconds, 2)) for c in found)
    head = ('method', 'verdict', 'order', 'fit [%]', 'held-out fit [%]', 'agrees',
            'difference [%]', 'difference / std', 'time [s]')
    poles = tuple((c.method, *_pole(c, k)) for c in found if c.model
                  for k in range(c.model.n) if c.model.poles[k].imag <= 0.0)
    reasons = tuple(f'{c.method}: {c.estimate.verdict.reason}' for c in found)
    words = [] if reference is None else [
        f'Difference: of the frequency response from that of {reference}, relative to its size, '
        'the largest in the excited band; and the same over the standard deviation of both. It '
        'agrees if one of the two is small everywhere (5 %, 3 standard deviations). '
        f'{GLOSSARY}']
    return [Section('Methods side by side',
                    (Table(head, rows, ('method', 'verdict', 'agrees')), *words)),
            *([Section('Poles', (Table(('method', 'pole [rad/s]', 'std', 'dead time [s]'), poles,
                                       ('method',)),))] if poles else []),
            Section('Verdicts', (Bullets(reasons),))]


def _fits(values: Array) -> str:
    return ', '.join(percent(value) for value in values) or '-'


def _differs(a: Agreement | None) -> tuple[str, str, str]:
    if a is None or math.isnan(a.relative):
        return '-', '-', '-'
    return 'yes' if a.agrees else 'no', percent(100.0 * a.relative), number(a.deviations, 2)


def _pole(c: Contender, k: int) -> tuple[str, str, str]:
    assert c.model is not None
    std, late = c.estimate.pole_std, c.estimate.delay_std
    dead = ', '.join(plus_minus(d, s, 3) for d, s in zip(c.model.delay, late, strict=True)) \
        if k == 0 or not any(c.model.poles[:k].imag <= 0.0) else ''
    return pole_text(c.model.poles[k]), number(float(std[k]), 2) if len(std) > k else '-', dead


def _document(c: Contender) -> dict[str, object]:
    a = c.agreement
    return {'method': c.method, 'status': c.estimate.status.name,
            'verdict': c.estimate.verdict.grade.name, 'reason': c.estimate.verdict.reason,
            'order': c.model.n if c.model else None,
            'poles': list(c.model.poles) if c.model else [], 'pole_std': c.estimate.pole_std,
            'delay': c.model.delay if c.model else [],
            'fit': c.estimate.fit, 'held_out_fit': c.estimate.held_out_fit,
            'agrees': a.agrees if a else None,
            **({'differs': a.relative, 'deviations': a.deviations} if a else
               dict.fromkeys(('differs', 'deviations'), 0.0 if c.model else math.nan)),
            'input': a.input if a else '', 'frequency': a.frequency if a else math.nan,
            'seconds': c.seconds}
