# SPDX-License-Identifier: Apache-2.0
"""
What the windows along a bag say together: whether one model is right for all of it.

The verdict on a model is one on its window. The word for the bag is that of the kept model only
where no window contradicts it: CHANGED if the plant did, within windows or from models to models;
PARTLY where a window is rejected though its inputs move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
import math
from typing import TYPE_CHECKING

import numpy as np

from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.cross_check import DEVIATIONS, agreement
from ctsid_core.judge.rules import KNOWN
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import Agreement
from ctsid_ros.replay.clock import by_bag_clock

if TYPE_CHECKING:
    from ctsid_ros.replay.replay import Result

CHANGED, PARTLY = 'CHANGED', 'PARTLY'
_QUIET = (Status.OK, Status.NO_EXCITATION)     # at rest nothing is contradicted
_MOST = 3       # stretches, and changes, that are named


@dataclass(frozen=True)
class Windows:
    """
    Estimates along a bag, and where they lie.

    Parameters
    ----------
    estimates : sequence of Estimate
    starts, ends : ndarray
        Of each window, after the start of the bag [s].
    next_fits : ndarray, shape (number of windows, ny)
        Fit on the first later window that shares no data with it [%]; NaN where there is none.
    """

    estimates: Sequence[Estimate]
    starts: Array
    ends: Array
    next_fits: Array

    @classmethod
    def of(cls, results: Sequence[Result], zero_ns: int) -> Windows:
        """Return what a replay gave, by a clock that begins at `zero_ns`."""
        found = [by_bag_clock(r.estimate, zero_ns) for r in results]
        starts, ends = ((np.array([getattr(e, key) - zero_ns for e in found]) * 1e-9)
                        for key in ('start_ns', 'end_ns'))
        return cls(found, starts, ends, np.array([r.next_fit for r in results]))

    @property
    def middles(self) -> Array:
        """Middle of each window [s]."""
        middles: Array = 0.5 * (self.starts + self.ends)
        return middles


@dataclass(frozen=True)
class ChangeSeen:
    """
    A change of the plant.

    Parameters
    ----------
    time : float
        When, after the start of the bag [s].
    cost : float
        Part of the motion that one model of both misses and two do not [%].
    one, two : (float, float)
        Fits of one model, and of two, before and after [%].
    rejects : bool
        Whether the window is rejected for it; else it is a note.
    """

    time: float
    cost: float
    one: tuple[float, float]
    two: tuple[float, float]
    rejects: bool = True

    @property
    def words(self) -> str:
        """The change in a sentence."""
        one, two = (' and '.join(f'{v:.1f}' for v in pair) for pair in (self.one, self.two))
        known = '' if math.isnan(self.one[0]) else (
            f': one model fits {one} % before and after, two models {two} %')
        lost = f'one model of both misses {self.cost:.1f} % of the motion that two do not'
        if not self.rejects:
            return (f'Perhaps the plant changed a little about {self.time:.1f} s after the start '
                    f'of the bag{known}; {lost}, too little to reject it.')
        return (f'The plant changed about {self.time:.1f} s after the start of the bag'
                f'{known}; {lost}.')


def changes(windows: Windows) -> list[ChangeSeen]:
    """Return the changes that windows show, each as the window shows it that it costs most."""
    found = [(s, change) for e, s, t in zip(windows.estimates, windows.starts, windows.ends,
                                            strict=True)
             if (change := change_of(e, float(s), float(t))) is not None]
    found.sort(key=lambda pair: -pair[1].cost)
    length = float(np.median(windows.ends - windows.starts)) if len(windows.ends) else 0.0
    kept: list[ChangeSeen] = []
    for _, one in found:
        if all(abs(one.time - other.time) > 0.5 * length for other in kept):
            kept.append(one)
    return sorted(kept, key=lambda c: c.time)


def change_of(estimate: Estimate, start: float, end: float) -> ChangeSeen | None:
    """Return the change that a window from start to end [s] shows, if it is worth a word."""
    numbers, cost = estimate.statistics, estimate.verdict.change_cost
    share = numbers.get('change_share', math.nan)
    rejects = estimate.status is Status.CHANGED
    # What is rejected for a graver fault, like a sensor that hangs, says nothing of the plant.
    if not (rejects or (estimate.ok and cost > NOTED)) or not math.isfinite(share):
        return None
    fits = {who: (numbers.get(f'change_fit_{who}_before', math.nan),
                  numbers.get(f'change_fit_{who}_after', math.nan)) for who in ('one', 'two')}
    return ChangeSeen(start + share * (end - start), cost, fits['one'], fits['two'],
                      rejects)


@dataclass(frozen=True)
class Fault:
    """Windows after each other that are rejected for one reason: from, to [s], how many."""

    status: Status
    start: float
    end: float
    count: int
    reason: str

    @property
    def words(self) -> str:
        """When, and why first."""
        span = f'{self.start:.1f} to {self.end:.1f} s'
        if self.count == 1:
            return f'the window {span} is rejected ({self.status.name}): {self.reason}'
        return (f'the {self.count} windows in {span} are rejected ({self.status.name}), the first '
                f'one because: {self.reason}')


def faults(windows: Windows) -> list[Fault]:
    """Return the stretches of windows that are rejected although inputs move."""
    rows = list(zip(windows.estimates, windows.starts.tolist(), windows.ends.tolist(),
                    strict=True))
    found = []
    for status, group in groupby(rows, key=lambda row: row[0].status):
        run = list(group)
        if status not in _QUIET:
            found.append(Fault(status, run[0][1], run[-1][2], len(run),
                               run[0][0].verdict.reason))
    return found


@dataclass(frozen=True)
class Unlike:
    """Models that differ from another one beyond chance: from, to [s], by most [1]."""

    start: float
    end: float
    difference: float
    difference_std: float
    other: str = 'the kept one'

    @property
    def words(self) -> str:
        """Where, and by how much."""
        return (f'Other models than {self.other} are right for {self.start:.1f} to {self.end:.1f} '
                f's: their responses differ by {100 * self.difference:.1f} ± '
                f'{100 * self.difference_std:.1f} %.')


def unlike(windows: Windows, place: int, other: str = Unlike.other) -> list[Unlike]:
    """
    Return where accepted models contradict the kept one, or another one.

    They do in windows next to each other, of which two share no data, and by more than what
    matters and beyond chance.

    Parameters
    ----------
    windows : Windows
    place : int
        Of the kept model, or another one.
    other : str
        Which, in words.
    """
    kept = windows.estimates[place]
    if not kept.ok:
        return []
    rows = [(k, agreement(kept, e, e.settings.method)) for k, e in enumerate(windows.estimates)
            if e.ok]
    found = []
    for away, group in groupby(rows, key=lambda row: _contradicts(row[1])):
        run = list(group)
        start, end = windows.starts[run[0][0]], windows.ends[run[-1][0]]
        if away and windows.ends[run[0][0]] <= windows.starts[run[-1][0]]:
            most = max((a for _, a in run), key=lambda a: a.difference)
            found.append(Unlike(float(start), float(end), most.difference, most.difference_std,
                                other))
    return found


def _contradicts(seen: Agreement) -> bool:
    return seen.difference > KNOWN and seen.difference > DEVIATIONS * seen.difference_std


@dataclass(frozen=True)
class Along:
    """
    What holds for a whole bag.

    Parameters
    ----------
    word : str
        The grade of the kept model, CHANGED, or PARTLY.
    changes : list of ChangeSeen
        Those for which a window is rejected.
    unlike : list of Unlike
    faults : list of Fault
    """

    word: str
    changes: list[ChangeSeen]
    unlike: list[Unlike]
    faults: list[Fault]

    @property
    def changed(self) -> tuple[str, ...]:
        """That the plant changed, in sentences."""
        return (*_changed(self.changes), *(one.words for one in self.unlike[:_MOST]))

    @property
    def failed(self) -> tuple[str, ...]:
        """Which windows are rejected though inputs move, in sentences."""
        return tuple(_faults(self.faults))


def along(windows: Windows, place: int) -> Along:
    """
    Return what holds for a whole bag.

    Parameters
    ----------
    windows : Windows
    place : int
        Of the kept model; if it is rejected, nothing but the word is told.
    """
    kept = windows.estimates[place]
    if not kept.ok:
        return Along(kept.verdict.grade.name, changes(windows), [], [])
    away, first = unlike(windows, place), next(
        k for k, e in enumerate(windows.estimates) if e.ok)
    if not away and first != place:
        # Of a plant that drifts a model from the middle is hardly another one than any.
        away = unlike(windows, first, f'that of window {first + 1}')
    seen, found = changes(windows), faults(windows)
    seen = [c for c in seen if c.rejects]
    grade = CHANGED if seen or away else PARTLY if found else kept.verdict.grade.name
    return Along(grade, seen, away, [f for f in found
                                     if not (seen and f.status is Status.CHANGED)])


def side(windows: Windows, place: int, seen: Sequence[ChangeSeen]) -> str:
    """Return on which side of changes a window lies; nothing if it has one, or there are none."""
    before = sum(c.time >= windows.ends[place] for c in seen)
    after = sum(c.time <= windows.starts[place] for c in seen)
    if not seen or before + after < len(seen):
        return ''
    if before and after:
        return 'between changes'
    which = '' if len(seen) == 1 else 'first ' if before else 'last '
    return f'{"before" if before else "after"} the {which}change'


def _changed(seen: Sequence[ChangeSeen]) -> tuple[str, ...]:
    if not seen:
        return ()
    times = ', '.join(f'{c.time:.1f}' for c in seen[:_MOST]) + (
        f' and {len(seen) - _MOST} more times' if len(seen) > _MOST else '')
    return (f'The plant changed about {times} s after the start of the bag: no one model is right '
            'for all of it.',)


def _faults(found: Sequence[Fault]) -> list[str]:
    longest = sorted(sorted(found, key=lambda f: -f.count)[:_MOST], key=lambda f: f.start)
    more = len(found) - len(longest)
    said = [f'{f.words[0].upper()}{f.words[1:]}' for f in longest]
    return said + ([f'{more} more such stretches are below.'] if more else [])
