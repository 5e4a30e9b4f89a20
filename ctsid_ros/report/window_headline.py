# SPDX-License-Identifier: Apache-2.0
"""
What a report on windows along a bag says first: whether one model is right for all of the bag.

The verdict on a model is one on its window. The word for the bag is that of the kept model only
where no window contradicts it: CHANGED if the plant did, within windows or from models to models;
PARTLY where a window is rejected though its inputs move. Then the sentence says when, and why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

from ctsid_core.judge.cross_check import DEVIATIONS, agreement
from ctsid_core.judge.rules import KNOWN
from ctsid_core.model.cross_check_result import Agreement
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import Grade
from ctsid_ros.report.document import Headline
from ctsid_ros.report.headline import Run
from ctsid_ros.report.tables import number, percent
from ctsid_ros.report.window_figures import ChangeSeen, Windows, changes

CHANGED, PARTLY = 'CHANGED', 'PARTLY'
_QUIET = (Status.OK, Status.NO_EXCITATION)     # at rest nothing is contradicted
_MOST = 3       # stretches, and changes, that are named


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
        which = f'the window {self.start:.1f} to {self.end:.1f} s is' if self.count == 1 else \
            f'the {self.count} windows in {self.start:.1f} to {self.end:.1f} s are'
        return f'{which} rejected ({self.status.name}): {self.reason}'


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
    """Models that differ from the kept one beyond chance: from, to [s], by most [1]."""

    start: float
    end: float
    difference: float
    difference_std: float

    @property
    def words(self) -> str:
        """Where, and by how much."""
        return (f'Other models than the kept one are right for {self.start:.1f} to {self.end:.1f} '
                f's: their responses differ by {percent(100 * self.difference)} ± '
                f'{number(100 * self.difference_std, 2)} %.')


def unlike(windows: Windows, place: int) -> list[Unlike]:
    """
    Return where accepted models contradict the kept one.

    They do in windows next to each other, of which two share no data, and by more than what
    matters and beyond chance.

    Parameters
    ----------
    windows : Windows
    place : int
        Of the kept model.
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
            found.append(Unlike(float(start), float(end), most.difference, most.difference_std))
    return found


def _contradicts(seen: Agreement) -> bool:
    return seen.difference > KNOWN and seen.difference > DEVIATIONS * seen.difference_std


def word(windows: Windows, place: int, away: Sequence[Unlike]) -> str:
    """Return the word for the bag: the grade of the kept model, CHANGED, or PARTLY."""
    kept = windows.estimates[place]
    if not kept.ok:
        return kept.verdict.grade.name
    if changes(windows) or away:
        return CHANGED
    return PARTLY if faults(windows) else kept.verdict.grade.name


def window_headline(first: Headline, windows: Windows, place: int, which: str, run: Run
                    ) -> Headline:
    """
    Return the headline of a bag from that of the model that is kept.

    Parameters
    ----------
    first : Headline
        Of the model.
    windows : Windows
        Their reasons count seconds after the start of the bag.
    place : int
        Of the window that the model is of.
    which : str
        Why that one.
    run : Run
    """
    kept, seen, away = windows.estimates[place], changes(windows), unlike(windows, place)
    found = [f for f in faults(windows) if not (seen and f.status is Status.CHANGED)]
    span = f'{windows.starts[place]:.1f} to {windows.ends[place]:.1f} s'
    kept_words = (f'{_kept(kept)} window {place + 1} ({span}{_side(kept, seen, windows, place)}), '
                  f'{which}: {first.sentence}')
    sentence = ' '.join((*_changed(seen), *(one.words for one in away[:_MOST]), _counts(windows),
                         *_faults(found if kept.ok else []), kept_words))
    facts = (('accepted windows', f'{sum(e.ok for e in windows.estimates)} of '
              f'{len(windows.estimates)}'),
             *([('changes at [s]', ', '.join(f'{c.time:.1f}' for c in seen[:_MOST])
                 + ', ...' * (len(seen) > _MOST))] if seen else []))
    told = replace(first, grade=word(windows, place, away), sentence=sentence,
                   facts=(*first.facts, *facts))
    if kept.ok and seen and windows.starts[place] < seen[-1].time:
        return replace(told, purpose='a model of the plant as it is after the last change',
                       command=run.command('identify', '--start', f'{seen[-1].time:.1f}'))
    if away and not seen:
        length = f'{away[-1].end - away[-1].start:.1f}'
        return replace(told, purpose='a model of the plant where it is another one',
                       command=run.command('identify', '--start', f'{away[-1].start:.1f}',
                                           '--duration', length))
    return told


def _changed(seen: Sequence[ChangeSeen]) -> tuple[str, ...]:
    if not seen:
        return ()
    times = ', '.join(f'{c.time:.1f}' for c in seen[:_MOST]) + (
        f' and {len(seen) - _MOST} more times' if len(seen) > _MOST else '')
    return (f'The plant changed about {times} s after the start of the bag: no one model is right '
            'for all of it.',)


def _counts(windows: Windows) -> str:
    grades = [e.verdict.grade for e in windows.estimates]
    counts = ', '.join(f'{grades.count(g)} {g.name}' for g in Grade if g in grades)
    still = sum(e.status is Status.NO_EXCITATION for e in windows.estimates)
    rest = f' (no input moves in {still})' if still else ''
    return f'{len(grades)} window{"s" if len(grades) > 1 else ""}: {counts}{rest}.'


def _faults(found: Sequence[Fault]) -> list[str]:
    longest = sorted(sorted(found, key=lambda f: -f.count)[:_MOST], key=lambda f: f.start)
    more = len(found) - len(longest)
    said = [f'{f.words[0].upper()}{f.words[1:]}' for f in longest]
    return said + ([f'{more} more such stretches are below.'] if more else [])


def _kept(kept: Estimate) -> str:
    return 'Kept is the model of' if kept.ok else 'None has a model; shown is'


def _side(kept: Estimate, seen: Sequence[ChangeSeen], windows: Windows, place: int) -> str:
    """Return on which side of the changes the kept window lies."""
    if not seen or not kept.ok:
        return ''
    before = [c for c in seen if c.time >= windows.ends[place]]
    after = [c for c in seen if c.time <= windows.starts[place]]
    if len(before) == len(seen):
        return ', before the change' if len(seen) == 1 else ', before the first change'
    if len(after) == len(seen):
        return ', after the change' if len(seen) == 1 else ', after the last change'
    return ', between changes'
