# SPDX-License-Identifier: Apache-2.0
"""What a batch gave: a table of all bags, and sections of a page over them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import csv
from dataclasses import dataclass
from datetime import UTC, datetime
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from ctsid_ros.batch.bags import vehicle
from ctsid_ros.batch.outliers import FAR, FEWEST, Poles, outliers
from ctsid_ros.batch.rows import Rows, read_rows
from ctsid_ros.report.document import Bullets, Figure, Section
from ctsid_ros.report.drawing import COLORS, Axes, Curve, Drawing
from ctsid_ros.report.tables import Table, number, percent, pole_text, thinned

GRADES = ('GOOD', 'WEAK', 'REJECT')
_COLUMNS = ('recorded', 'window', 'verdict', 'reason', 'best', 'order', 'poles', 'fits', 'delays',
            'failure')
_MOST_ROWS = 300    # of a table on the page; bags.csv has all
_MOST_NAMED = 40    # bags in a list
_DAY = 86_400e9     # [ns]
_APART = 5.0        # frequencies that differ by more have a logarithmic axis


@dataclass(frozen=True)
class Flight:
    """
    What came of one bag.

    Parameters
    ----------
    bag, vehicle : str
    recorded_ns : int
        When its first message was recorded; 0 if it could not be read.
    grades : mapping of str to int
        Windows with each verdict.
    best : mapping
        The row of the window whose model is kept; empty if no model was accepted.
    reason : str
        Of the verdict on the first window, where no model was accepted.
    failure : str
        Why there is no window; empty if there are.
    """

    bag: str
    vehicle: str
    recorded_ns: int
    grades: Mapping[str, int]
    best: Mapping[str, Any]
    reason: str
    failure: str

    @property
    def windows(self) -> int:
        """How many windows there are."""
        return sum(self.grades.values())

    @property
    def date(self) -> str:
        """Day of the recording, UTC."""
        return datetime.fromtimestamp(self.recorded_ns // 10**9, UTC).strftime('%Y-%m-%d') \
            if self.recorded_ns else ''

    @property
    def poles(self) -> list[dict[str, float | None]]:
        """Poles of the kept model, one of each pair, slow ones first."""
        found = [p for p in self.best.get('poles') or [] if p['im'] >= 0.0]
        return sorted(found, key=lambda p: (p['natural_frequency'], p['im']))


def flight(bag: str, path: Path, pattern: str = '') -> Flight:
    """Return what came of a bag, from the file of its rows."""
    rows = read_rows(path, _COLUMNS)
    best: Mapping[str, Any] = next((row for row in rows if row['best']), {})
    return Flight(bag, vehicle(bag, pattern), rows[0]['recorded'] or 0, _grades(rows), best,
                  '' if best else rows[0]['reason'] or '', rows[0]['failure'] or '')


def _grades(rows: Rows) -> dict[str, int]:
    given = [row['verdict'] for row in rows]
    return {grade: given.count(grade) for grade in GRADES}


def odd_ones(flights: Sequence[Flight]) -> dict[str, str]:
    """Return the bags with other poles than most of the same vehicle, or of all if it has few."""
    own = {f.bag: Poles(np.array([complex(p['re'] or 0.0, p['im'] or 0.0) for p in f.poles]),
                        np.array([_known(p['std']) for p in f.poles]))
           for f in flights if f.poles}
    found: dict[str, str] = {}
    rest: list[str] = []
    for name in dict.fromkeys(f.vehicle for f in flights):
        bags = [f.bag for f in flights if f.vehicle == name and f.bag in own]
        if len(bags) < FEWEST:
            rest += bags
        else:
            found |= outliers({bag: own[bag] for bag in bags})
    every = outliers(own) if rest else {}
    return found | {bag: every[bag] for bag in rest if bag in every}


def table(flights: Sequence[Flight], odd: Mapping[str, str]) -> str:
    """Return the table of all bags as CSV: a row for each."""
    most = max((len(f.best.get('poles') or []) for f in flights), default=0)
    outputs, inputs = (list(dict.fromkeys(
        entry[word] for f in flights for entry in f.best.get(column) or []))
        for column, word in (('fits', 'output'), ('delays', 'input')))
    names = ('re', 'im', 'std')
    head = ['bag', 'vehicle', 'date', 'windows', *(g.lower() for g in GRADES), 'best_window',
            'order', *(f'pole{k}_{n} [rad/s]' for k in range(1, most + 1) for n in names),
            *(f'fit_{name} [%]' for name in outputs), *(f'delay_{name} [s]' for name in inputs),
            'outlier', 'reason', 'failure']
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(head)
    for f in flights:
        poles = [p[n] for p in f.best.get('poles') or [] for n in names]
        fits = {e['output']: e['fit'] for e in f.best.get('fits') or []}
        delays = {e['input']: e['delay'] for e in f.best.get('delays') or []}
        writer.writerow([
            f.bag, f.vehicle, f.date, f.windows, *f.grades.values(), f.best.get('window', ''),
            f.best.get('order', ''), *poles, *[''] * (3 * most - len(poles)),
            *(fits.get(name) for name in outputs), *(delays.get(name) for name in inputs),
            odd.get(f.bag, ''), f.reason, f.failure])
    return stream.getvalue()


def sections(flights: Sequence[Flight], odd: Mapping[str, str]) -> list[Section]:
    """Return what is said of all bags, on the terminal and on the page."""
    shown = _names([f.bag for f in flights])
    failed = [f for f in flights if f.failure]
    return [
        _counts(flights), _vehicles(flights),
        Section('Bags with other poles than most', _bullets(
            [f'{shown[bag]}: {why}' for bag, why in odd.items()])),
        Section('Bags that gave no window', _bullets(
            [f'{shown[f.bag]}: {f.failure}' for f in failed])),
        *_figures(flights, shown), _bags(flights, shown)]


def _bullets(items: list[str]) -> tuple[Bullets, ...]:
    more = len(items) - _MOST_NAMED
    listed = items[:_MOST_NAMED] + ([f'and {more} more, see bags.csv'] if more > 0 else [])
    return (Bullets(tuple(listed)),) if listed else ()


def _names(bags: Sequence[str]) -> dict[str, str]:
    """Return bags by paths without the folder that all of them are in."""
    folders = [Path(bag).parent.parts for bag in bags]
    shared = 0
    while all(len(f) > shared and f[shared] == folders[0][shared] for f in folders):
        shared += 1
    return {bag: str(Path(*Path(bag).parts[shared:])) for bag in bags}


def _counts(flights: Sequence[Flight]) -> Section:
    failed = sum(bool(f.failure) for f in flights)
    none = sum(not f.best and not f.failure for f in flights)
    return Section(f'{len(flights)} bag{"s" * (len(flights) != 1)}', (
        f'{len(flights) - failed - none} gave an accepted model, {none} none that the data '
        f'support, {failed} no window at all. Of each bag the poles are those of its best window '
        '(as of `ctsid replay`).',))


def _vehicles(flights: Sequence[Flight]) -> Section:
    rows = []
    for name in dict.fromkeys(f.vehicle for f in flights):
        own = [f for f in flights if f.vehicle == name]
        dates = sorted({f.date for f in own if f.date})
        span = ' to '.join(dict.fromkeys((*dates[:1], *dates[-1:])))
        rows.append((name or '-', str(len(own)), span,
                     *(str(sum(f.grades[g] for f in own)) for g in GRADES),
                     str(sum(bool(f.failure) for f in own)), _slowest(own)))
    return Section('Vehicles', (Table(
        ('vehicle', 'bags', 'recorded', *GRADES, 'failed', 'slowest mode, median [rad/s]'),
        tuple(rows), ('vehicle', 'recorded')),))


def _slowest(flights: Sequence[Flight]) -> str:
    found = [_known(f.poles[0]['natural_frequency']) for f in flights if f.poles]
    return number(float(np.median(found))) if found else '-'


def _bags(flights: Sequence[Flight], shown: Mapping[str, str]) -> Section:
    rows = [(shown[f.bag], f.vehicle or '-', f.date or '-',
             ' / '.join(str(n) for n in f.grades.values()), str(f.best.get('order', '-')),
             ', '.join(_pole(p) for p in f.poles) or ('failed' if f.failure else 'no model'),
             ' / '.join(percent(_known(e['fit'])) for e in f.best.get('fits') or []) or '-')
            for f in flights]
    head = ('bag', 'vehicle', 'date', '/'.join(GRADES), 'order', 'poles [rad/s]', 'fit [%]')
    few = () if len(rows) <= _MOST_ROWS else (
        f'About {_MOST_ROWS} of {len(rows)} bags; bags.csv has all.',)
    return Section('All bags', (*few, Table(head, thinned(rows, _MOST_ROWS),
                                            ('bag', 'vehicle', 'date', 'poles [rad/s]'))),
                   brief=len(rows) <= _MOST_NAMED)


def _pole(pole: Mapping[str, float | None]) -> str:
    text = pole_text(complex(pole['re'] or 0.0, pole['im'] or 0.0))
    std = _known(pole['std'])
    return text if math.isnan(std) else f'{text} (std {number(std, 2)})'


def _figures(flights: Sequence[Flight], shown: Mapping[str, str]) -> list[Section]:
    known = [f for f in flights if f.poles]
    if not known:
        return []
    first = min(f.recorded_ns for f in known)
    day = next(f.date for f in known if f.recorded_ns == first)
    curves: dict[str, list[Curve]] = {'natural_frequency': [], 'damping': []}
    crosses = []
    for k, name in enumerate(dict.fromkeys(f.vehicle for f in known)):
        own = [(f, p) for f in known if f.vehicle == name for p in f.poles]
        color = 1 + k % (len(COLORS) - 1)
        days = np.array([(f.recorded_ns - first) / _DAY for f, _ in own])
        texts = [f'{shown[f.bag]}, {f.date}: {_pole(p)} rad/s' for f, p in own]
        for key, found in curves.items():
            found.append(_dots(own, key, days, name, color, texts))
        crosses.append(Curve(np.array([p['re'] for _, p in own], float),
                             np.array([p['im'] for _, p in own], float), name or '-', color,
                             'cross', texts=texts))
    across = f'days after {day}'
    sizes = [p['natural_frequency'] for f in known for p in f.poles if p['natural_frequency']]
    apart = bool(sizes) and max(sizes) > _APART * min(sizes)
    along = Drawing((
        Axes(curves['natural_frequency'], 'natural frequency [rad/s]', y_log=apart),
        Axes(curves['damping'], 'damping ratio', across)), wide=True)
    plane = Drawing((Axes(crosses, 'imaginary part [rad/s]', 'real part [rad/s]',
                          marks=[(0.0, '')], height=300.0),))
    return [Section('Poles by vehicle and date', (
        Figure(along, 'Of the best window of each bag; bars are two standard deviations.'),
        Figure(plane, 'Right of the dashed line a pole is unstable.', 'Poles')), brief=False)]


def _dots(own: Sequence[tuple[Flight, Mapping[str, float | None]]], key: str, days: np.ndarray,
          name: str, color: int, texts: Sequence[str]) -> Curve:
    values = np.array([p[key] for _, p in own], float)
    std = np.array([p[f'{key}_std'] for _, p in own], float)
    # Real poles have the damping 1, or -1 if they are unstable: no news.
    values = values if key != 'damping' else np.where([p['im'] for _, p in own], values, np.nan)
    return Curve(days, values, name or '-', color, 'dots', values - 2 * std, values + 2 * std,
                 bars=True, texts=texts)


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def words(flights: Sequence[Flight]) -> list[dict[str, Any]]:
    """Return what came of each bag, for JSON."""
    return [{'bag': f.bag, 'vehicle': f.vehicle, 'date': f.date, 'windows': f.windows,
             **{g.lower(): n for g, n in f.grades.items()},
             'best_window': f.best.get('window'), 'order': f.best.get('order'),
             'poles': f.best.get('poles') or [], 'fits': f.best.get('fits') or [],
             'delays': f.best.get('delays') or [], 'failure': f.failure} for f in flights]


def explained() -> Section:
    """Return how outliers are found."""
    return Section('', (f'A bag has other poles than most if one is more than {FAR:g} standard '
                        'deviations (of the bags, robust, and its own, together) from the median; '
                        'bags of the same vehicle are compared, if at least '
                        f'{FEWEST} have a model, else all.',), brief=False)
