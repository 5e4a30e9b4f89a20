# SPDX-License-Identifier: Apache-2.0
"""`ctsid compare`: what all methods make of the same data, side by side."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import time

import numpy as np
from numpy.typing import NDArray

from ctsid_core.estimate import Estimate
from ctsid_core.identify import identify
from ctsid_core.settings import METHODS, Settings
from ctsid_core.signals import Record
from ctsid_core.statespace import StateSpace
from ctsid_ros.bag import open_bag
from ctsid_ros.document import Bullets, Section, to_text
from ctsid_ros.playback import read_record
from ctsid_ros.progress import progress
from ctsid_ros.tables import Table, number, percent
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    NO_MODEL,
    add_bag,
    add_interval,
    add_params,
    add_style,
    config_for,
    interval_of,
    named,
    tell,
)

HELP = 'identify one interval of a bag by all methods, side by side'
EPILOG = ('example: ctsid compare flight.mcap --params params.yaml --duration 20\n'
          '         (methods that have little in common and agree are a reason for trust)')
_FREQUENCIES = 60


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    add_params(parser)
    add_interval(parser)
    add_style(parser)


@dataclass(frozen=True)
class Contender:
    """
    What one method made of the data.

    Parameters
    ----------
    method : str
    estimate : Estimate
    seconds : float
        Of processor time.
    differs : float
        Root mean square difference of its frequency response from that of the first method, over
        the latter, in the band that is excited; NaN if either has no model.
    """

    method: str
    estimate: Estimate
    seconds: float
    differs: float

    @property
    def model(self) -> StateSpace | None:
        """The model, accepted or not."""
        return self.estimate.model or self.estimate.rejected_model


def command(args: argparse.Namespace) -> int:
    """Read, identify by every method, tell."""
    with open_bag(args.bag) as bag:
        config = config_for(args, bag)
        with progress('reading', quiet=args.quiet) as advance:
            data = read_record(bag, config, interval_of(args), advance=advance)
    found = compare(data.record, config.settings)
    if args.json:
        tell({'verb': 'compare', 'bag': named(args.bag), 'methods': [_document(c) for c in found]})
    else:
        print(to_text(_sections(found)))
    return ACCEPTED if found[0].estimate.ok else NO_MODEL


def compare(record: Record, settings: Settings) -> list[Contender]:
    """
    Return what every method makes of a record, HD-PBSID first.

    Parameters
    ----------
    record : Record
    settings : Settings
        Dead times that HD-PBSID finds are given to the others, which do not look for any.
    """
    found: list[Contender] = []
    for method in METHODS:
        begin = time.process_time()
        estimate = identify(record, settings.replace(method=method))
        seconds = time.process_time() - begin
        differs = _difference(found[0].estimate, estimate) if found else 0.0
        found.append(Contender(method, estimate, seconds, differs))
        first = found[0].model
        if first is not None:
            settings = settings.replace(delay=first.delay)
    return found


def _difference(first: Estimate, other: Estimate) -> float:
    """Return how much frequency responses differ where the inputs excite."""
    a, b = (e.model or e.rejected_model for e in (first, other))
    ends = [end for x in first.verdict.excitation for end in (x.low, x.high) if end > 0.0]
    if a is None or b is None or not ends:
        return float('nan')
    omega = np.geomspace(min(ends), max(ends), _FREQUENCIES)
    one, two = a.frequency_response(omega), b.frequency_response(omega)
    return float(np.sqrt(np.mean(np.abs(two - one) ** 2) / np.mean(np.abs(one) ** 2)))


def _sections(found: list[Contender]) -> list[Section]:
    rows = tuple((c.method, c.estimate.verdict.grade.name, str(c.model.n) if c.model else '-',
                  _fits(c.estimate.fit), _fits(c.estimate.held_out_fit),
                  '-' if c is found[0] else percent(100 * c.differs), number(c.seconds, 2))
                 for c in found)
    head = ('method', 'verdict', 'order', 'fit [%]', 'held-out fit [%]',
            f'differs from {found[0].method} [%]', 'time [s]')
    poles = tuple((c.method, *_pole(c, k)) for c in found if c.model
                  for k in range(c.model.n) if c.model.poles[k].imag <= 0.0)
    reasons = tuple(f'{c.method}: {c.estimate.verdict.reason}' for c in found)
    table = Table(('method', 'pole [rad/s]', 'std'), poles, ('method',))
    return [Section('Methods side by side', (Table(head, rows, ('method', 'verdict')),)),
            *([Section('Poles', (table,))] if poles else []),
            Section('Verdicts', (Bullets(reasons),))]


def _fits(values: NDArray[np.float64]) -> str:
    return ', '.join(percent(value) for value in values) or '-'


def _pole(c: Contender, k: int) -> tuple[str, str]:
    assert c.model is not None
    pole, std = c.model.poles[k], c.estimate.pole_std
    words = number(pole.real, 4) + (f' ± {number(-pole.imag, 4)}j' if pole.imag else '')
    return words, number(float(std[k]), 2) if len(std) > k else '-'


def _document(c: Contender) -> dict[str, object]:
    return {'method': c.method, 'status': c.estimate.status.name,
            'verdict': c.estimate.verdict.grade.name, 'reason': c.estimate.verdict.reason,
            'poles': list(c.model.poles) if c.model else [], 'pole_std': c.estimate.pole_std,
            'fit': c.estimate.fit, 'held_out_fit': c.estimate.held_out_fit,
            'differs': c.differs, 'seconds': c.seconds}
