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
import shlex
from typing import Any

import numpy as np

from ctsid_ros.batch.bags import vehicle
from ctsid_ros.batch.outliers import FAR, FEWEST, Numbers, outliers
from ctsid_ros.batch.rows import UNREAD, Rows, made_of, read_rows
from ctsid_ros.replay.along import CHANGED, PARTLY
from ctsid_ros.report.document import Bullets, Figure, Headline, Section
from ctsid_ros.report.drawing import COLORS, Axes, Curve, Drawing
from ctsid_ros.report.tables import Table, gain_text, number, percent, pole_text, thinned
from ctsid_ros.report.words import spreadsheet

GRADES = ('GOOD', 'WEAK', 'REJECT')
FAILED = 'FAILED'
# Words for bags, the gravest first: in this order they are told.
WORDS = (CHANGED, PARTLY, 'REJECT', FAILED, 'WEAK', 'GOOD')
_COLUMNS = ('recorded', 'window', 'verdict', 'best', 'order', 'poles', 'gains', 'fits',
            'delays', 'bag_verdict', 'bag_reason', 'failure')
_GAINS = {'gain': '', 'gain_std': '', 'rate_gain': ' [1/s]', 'rate_gain_std': ' [1/s]'}
_MOST_ROWS = 300    # of a table on the page; bags.csv has all
_MOST_GAINS = 4     # in a cell of it
_MOST_NAMED = 40    # bags in a list
_MOST_TOLD = 3      # bags in the first sentence
_DAY = 86_400e9     # ns
_MARGIN = 0.05      # of the span of dates, on either side
_UNITS = (('hours', 3600e9), ('minutes', 60e9), ('seconds', 1e9))    # [ns]
_DATED = 946_684_800 * 10**9    # ns, 2000-01-01: a log whose clock began at its start is before
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
    verdict : str
        The word for the bag, as on the page of its replay; FAILED if there is no window.
    reason : str
        Why it is not GOOD, by the clock of the bag; of a GOOD one, what its model passed.
    failure : str
        Why there is no window; empty if there are.
    content : str
        A hash of the bag; empty if it is not known.
    """

    bag: str
    vehicle: str
    recorded_ns: int
    grades: Mapping[str, int]
    best: Mapping[str, Any]
    verdict: str
    reason: str
    failure: str
    content: str = ''

    @property
    def windows(self) -> int:
        """How many windows there are."""
        return sum(self.grades.values())

    @property
    def date(self) -> str:
        """Day of the recording, UTC; empty if its times are no dates."""
        return datetime.fromtimestamp(self.recorded_ns // 10**9, UTC).strftime('%Y-%m-%d') \
            if self.recorded_ns >= _DATED else ''

    @property
    def poles(self) -> list[dict[str, float | None]]:
        """Poles of the kept model, one of each pair, slow ones first."""
        found = [p for p in self.best.get('poles') or [] if p['im'] >= 0.0]
        return sorted(found, key=lambda p: (p['natural_frequency'], p['im']))


def flight(bag: str, path: Path, pattern: str = '') -> Flight:
    """Return what came of a bag, from the file of its rows."""
    rows, made = read_rows(path, _COLUMNS), made_of(path)
    best: Mapping[str, Any] = next((row for row in rows if row['best']), {})
    first = rows[0]
    return Flight(bag, vehicle(bag, pattern), first['recorded'] or 0, _grades(rows), best,
                  first['bag_verdict'] or FAILED, first['bag_reason'] or '',
                  first['failure'] or '', made.content if made and made.content != UNREAD else '')


def copies(flights: Sequence[Flight]) -> dict[str, str]:
    """Return the bags that are the same as one before, to the byte, and which that is."""
    first: dict[str, str] = {}
    found: dict[str, str] = {}
    for f in flights:
        if f.content and first.setdefault(f.content, f.bag) != f.bag:
            found[f.bag] = first[f.content]
    return found


def _grades(rows: Rows) -> dict[str, int]:
    given = [row['verdict'] for row in rows]
    return {grade: given.count(grade) for grade in GRADES}


def odd_ones(flights: Sequence[Flight]) -> dict[str, str]:
    """Return bags with other numbers than most of their vehicle, or of all if it has few."""
    same = copies(flights)
    flights = [f for f in flights if f.bag not in same]
    own = {f.bag: Numbers(np.array([complex(p['re'] or 0.0, p['im'] or 0.0) for p in f.poles]),
                          np.array([_known(p['std']) for p in f.poles]),
                          {f'{word.replace("_", " ")} of {g["input"]} to {g["output"]}':
                           (_known(g[word]), _known(g[f'{word}_std']))
                           for g in f.best.get('gains') or [] for word in ('gain', 'rate_gain')})
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
    paths = [(f'{word}_{spreadsheet(u)}_to_{spreadsheet(y)}{unit}', word, (u, y))
             for u, y in dict.fromkeys((g['input'], g['output']) for f in flights
                                       for g in f.best.get('gains') or [])
             for word, unit in _GAINS.items()]
    head = ['bag', 'vehicle', 'date', 'verdict', 'windows', *(g.lower() for g in GRADES),
            'best_window', 'order',
            *(f'pole{k}_{n} [rad/s]' for k in range(1, most + 1) for n in names),
            *(head for head, _, _ in paths),
            *(f'fit_{spreadsheet(name)} [%]' for name in outputs),
            *(f'delay_{spreadsheet(name)} [s]' for name in inputs), 'outlier', 'copy_of', 'reason',
            'failure']
    same = copies(flights)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(head)
    for f in flights:
        poles = [p[n] for p in f.best.get('poles') or [] for n in names]
        fits = {e['output']: e['fit'] for e in f.best.get('fits') or []}
        delays = {e['input']: e['delay'] for e in f.best.get('delays') or []}
        gains = {(word, (g['input'], g['output'])): g[word]
                 for g in f.best.get('gains') or [] for word in _GAINS}
        writer.writerow([
            spreadsheet(f.bag, whole=True), spreadsheet(f.vehicle), f.date, f.verdict, f.windows,
            *f.grades.values(), f.best.get('window', ''), f.best.get('order', ''), *poles,
            *[''] * (3 * most - len(poles)),
            *(gains.get((word, path)) for _, word, path in paths),
            *(fits.get(name) for name in outputs), *(delays.get(name) for name in inputs),
            odd.get(f.bag, ''), spreadsheet(same.get(f.bag, ''), whole=True),
            spreadsheet(f.reason, whole=True),
            spreadsheet(f.failure, whole=True)])
    return stream.getvalue()


def sections(flights: Sequence[Flight], odd: Mapping[str, str]) -> list[Section]:
    """Return what is said of all bags, on the terminal and on the page."""
    shown = _names([f.bag for f in flights])
    return [
        Section('Bags to look at', _bullets([_why(f, shown) for f in _doubtful(flights)])),
        _counts(flights), _vehicles(flights),
        Section('Bags with other poles or gains than most', _bullets(
            [f'{shown[bag]}: {why}' for bag, why in odd.items()])),
        *_copies(flights, shown), *_figures(flights, shown), _bags(flights, shown)]


def _copies(flights: Sequence[Flight], shown: Mapping[str, str]) -> list[Section]:
    """Return which bags are the same recording: they count as one experiment only."""
    said = [f'{shown[bag]} is {shown[first]} under another name'
            for bag, first in copies(flights).items()]
    return [Section('Bags that are the same recording to the byte', (
        'They have the same rows, and are compared with others once. Leave all but one of each '
        'out, or correct the folder of the vehicle that did not fly.', *_bullets(said)))] \
        if said else []


def _doubtful(flights: Sequence[Flight]) -> list[Flight]:
    """Return the bags that are not GOOD, the gravest first."""
    return sorted((f for f in flights if f.verdict != 'GOOD'),
                  key=lambda f: WORDS.index(f.verdict))


def _why(f: Flight, shown: Mapping[str, str]) -> str:
    return f'{shown[f.bag]}, {f.verdict}: {f.failure or f.reason}'


def batch_headline(flights: Sequence[Flight], odd: Mapping[str, str], params: str,
                   many: Sequence[str]) -> Headline:
    """
    Return the word for all bags, the reason, and the command that looks at the worst of them.

    Parameters
    ----------
    flights : sequence of Flight
    odd : mapping of str to str
        Bags with other poles or gains than most.
    params : str
        The parameter file.
    many : sequence of str
        The bags as they were named.
    """
    shown, doubtful = _names([f.bag for f in flights]), _doubtful(flights)
    found = [f.verdict for f in flights]
    word = found[0] if len(set(found)) == 1 else PARTLY if any(f.best for f in flights) else \
        'REJECT'
    said = [_counted(flights)]
    said += [_why(f, shown) for f in doubtful[:1]]
    if len(doubtful) > 1:
        said.append(_and_more([f'{shown[f.bag]} ({f.verdict})' for f in doubtful[1:]])
                    + ': see below.')
    if same := copies(flights):
        said.append('The same recording twice: ' + _and_more(
            [f'{shown[bag]} ({shown[first]})' for bag, first in same.items()]) + '.')
    if odd:
        said.append('Other poles than most: ' + _and_more([shown[bag] for bag in odd]) + '.')
    readable = [f for f in doubtful if not f.failure]
    asked = [*[f.bag for f in readable], *odd, *[f.bag for f in doubtful if f.failure]]
    whole = ('ctsid', 'identify', *many, '--params', params)
    if not asked:
        purpose, line = 'one model of all of them, if they are of one plant', whole
    elif asked[0] in {f.bag for f in doubtful if f.failure}:
        purpose, line = f'what is wrong with {shown[asked[0]]}', ('ctsid', 'info', asked[0])
    else:
        purpose, line = f'every window of {shown[asked[0]]}, with plots', (
            'ctsid', 'replay', asked[0], '--params', params)
    facts = [(f'{w} bags', str(found.count(w))) for w in WORDS if w in found]
    return Headline(word, ' '.join(said), shlex.join(line), (
        ('bags', str(len(flights))), *facts,
        ('windows ' + '/'.join(GRADES), ' / '.join(
            str(sum(f.grades[g] for f in flights)) for g in GRADES))), purpose)


def _and_more(names: list[str]) -> str:
    more = len(names) - _MOST_TOLD
    return ', '.join(names[:_MOST_TOLD]) + (f' and {more} more' if more > 0 else '')


def _counted(flights: Sequence[Flight]) -> str:
    found = [f.verdict for f in flights]
    counts = ', '.join(f'{found.count(w)} {w}' for w in reversed(WORDS) if w in found)
    return f'{len(flights)} bag{"s" * (len(flights) != 1)}: {counts}.'


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
    meaning = ('CHANGED: the plant, or a signal, is not the same all along. PARTLY: windows are '
               'rejected though inputs move, as after a sensor that died. REJECT: no window has a '
               'model. FAILED: no window at all. ') if _doubtful(flights) else ''
    return Section('Bags by verdict', (
        f'{_counted(flights)} {meaning}Of each bag the poles are those of its best window (as of '
        '`ctsid replay`).',))


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
        ('vehicle', 'bags', 'recorded', *(f'{g} windows' for g in GRADES), 'failed bags',
         'slowest mode, median [rad/s]'),
        tuple(rows), ('vehicle', 'recorded')),))


def _slowest(flights: Sequence[Flight]) -> str:
    found = [_known(f.poles[0]['natural_frequency']) for f in flights if f.poles]
    return number(float(np.median(found))) if found else '-'


def _bags(flights: Sequence[Flight], shown: Mapping[str, str]) -> Section:
    rows = [(shown[f.bag], f.vehicle or '-', f.date or '-', f.verdict,
             ' / '.join(str(n) for n in f.grades.values()), str(f.best.get('order', '-')),
             ', '.join(_pole(p) for p in f.poles) or '-', _gains(f),
             ' / '.join(percent(_known(e['fit'])) for e in f.best.get('fits') or []) or '-')
            for f in flights]
    head = ('bag', 'vehicle', 'date', 'verdict', '/'.join(GRADES), 'order', 'poles [rad/s]',
            'gain', 'fit [%]')
    few = () if len(rows) <= _MOST_ROWS else (
        f'About {_MOST_ROWS} of {len(rows)} bags; bags.csv has all.',)
    return Section('All bags', (*few, Table(head, thinned(rows, _MOST_ROWS),
                                            ('bag', 'vehicle', 'date', 'verdict',
                                             'poles [rad/s]'))),
                   brief=len(rows) <= _MOST_NAMED)


def _pole(pole: Mapping[str, float | None]) -> str:
    text = pole_text(complex(pole['re'] or 0.0, pole['im'] or 0.0))
    std = _known(pole['std'])
    return text if math.isnan(std) else f'{text} (std {number(std, 2)})'


def _gains(f: Flight) -> str:
    """Return the gains of all inputs to the first output, to the next, ..., as far as they go."""
    found = [gain_text(_known(g['gain'] if rate is None else rate),
                       _known(g['gain_std'] if rate is None else g['rate_gain_std']),
                       rate is not None)
             for g in f.best.get('gains') or [] for rate in (g['rate_gain'],)]
    return ' / '.join(found[:_MOST_GAINS]) + ' / ...' * (len(found) > _MOST_GAINS) or '-'


def _figures(flights: Sequence[Flight], shown: Mapping[str, str]) -> list[Section]:
    known = [f for f in flights if f.poles]
    if not known:
        return []
    places, across, limits = _across(known, flights)
    curves: dict[str, list[Curve]] = {'natural_frequency': [], 'damping': []}
    crosses = []
    for k, name in enumerate(dict.fromkeys(f.vehicle for f in known)):
        own = [(f, p) for f in known if f.vehicle == name for p in f.poles]
        color = 1 + k % (len(COLORS) - 1)
        at = np.array([places[f.bag] for f, _ in own])
        texts = [f'{", ".join(filter(None, (shown[f.bag], f.date)))}: {_pole(p)} rad/s'
                 for f, p in own]
        for key, found in curves.items():
            found.append(_dots(own, key, at, name, color, texts))
        crosses.append(Curve(np.array([p['re'] for _, p in own], float),
                             np.array([p['im'] for _, p in own], float), name or '-', color,
                             'cross', texts=texts))
    sizes = [p['natural_frequency'] for f in known for p in f.poles if p['natural_frequency']]
    apart = bool(sizes) and max(sizes) > _APART * min(sizes)
    along = Drawing((
        Axes(curves['natural_frequency'], 'natural frequency [rad/s]', y_log=apart,
             x_dates=bool(limits), x_limits=limits),
        Axes(curves['damping'], 'damping ratio', across, x_dates=bool(limits),
             x_limits=limits)), wide=True)
    plane = Drawing((Axes(crosses, 'imaginary part [rad/s]', 'real part [rad/s]',
                          marks=[(0.0, '')], height=300.0),))
    return [Section('Poles by vehicle and date', (
        Figure(along, 'Of the best window of each bag; bars are two standard deviations.'),
        Figure(plane, 'Right of the dashed line a pole is unstable.', 'Poles')), brief=False)]


def _across(known: Sequence[Flight], flights: Sequence[Flight]
            ) -> tuple[dict[str, float], str, tuple[float, float] | None]:
    """Return where bags are along the axis of time, its label, and its limits if it has dates."""
    if not all(f.date for f in known):
        order = {f.bag: float(k) for k, f in enumerate(flights, 1)}
        return order, 'number of the bag in the table (not all have dates)', None
    times = [f.recorded_ns for f in flights if f.date]
    first, span = min(times), max(times) - min(times)
    if span >= _DAY:
        return ({f.bag: f.recorded_ns / _DAY for f in known}, 'recorded (UTC)',
                ((first - _MARGIN * span) / _DAY, (first + (1.0 + _MARGIN) * span) / _DAY))
    word, unit = next(((w, u) for w, u in _UNITS if span >= 2.0 * u), _UNITS[-1])
    return {f.bag: (f.recorded_ns - first) / unit for f in known}, f'{word} after the first bag', \
        None


def _dots(own: Sequence[tuple[Flight, Mapping[str, float | None]]], key: str, at: np.ndarray,
          name: str, color: int, texts: Sequence[str]) -> Curve:
    values = np.array([p[key] for _, p in own], float)
    std = np.array([p[f'{key}_std'] for _, p in own], float)
    # Real poles have the damping 1, or -1 if they are unstable: no news.
    values = values if key != 'damping' else np.where([p['im'] for _, p in own], values, np.nan)
    return Curve(at, values, name or '-', color, 'dots', values - 2 * std, values + 2 * std,
                 bars=True, texts=texts)


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def words(flights: Sequence[Flight]) -> list[dict[str, Any]]:
    """Return what came of each bag, for JSON."""
    same = copies(flights)
    return [{'bag': f.bag, 'vehicle': f.vehicle, 'date': f.date, 'verdict': f.verdict,
             'reason': f.reason, 'windows': f.windows,
             **{g.lower(): n for g, n in f.grades.items()},
             'best_window': f.best.get('window'), 'order': f.best.get('order'),
             'poles': f.best.get('poles') or [], 'gains': f.best.get('gains') or [],
             'fits': f.best.get('fits') or [],
             'delays': f.best.get('delays') or [], 'failure': f.failure,
             'copy_of': same.get(f.bag)} for f in flights]


def explained() -> Section:
    """Return how outliers are found."""
    return Section('', ('A bag has other poles or gains than most if one is more than '
                        f'{FAR:g} standard deviations (of the bags, robust, and its own, '
                        'together) from the median; '
                        'bags of the same vehicle are compared, if at least '
                        f'{FEWEST} have a model, else all.',), brief=False)
