# SPDX-License-Identifier: Apache-2.0
"""What a report on windows along a bag says first: what holds for all of it, and which model."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import Grade
from ctsid_ros.replay.along import PARTLY, Windows, along, side
from ctsid_ros.report.document import Headline
from ctsid_ros.report.headline import Run

_MOST = 3       # changes whose times are named


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
    kept, all_of_it = windows.estimates[place], along(windows, place)
    seen, away = all_of_it.changes, all_of_it.unlike
    span = f'{windows.starts[place]:z.1f} to {windows.ends[place]:.1f} s'
    where = side(windows, place, seen)
    span += f', {where}' if kept.ok and where else ''
    kept_words = f'{_kept(kept)} window {place + 1} ({span}), {which}: {first.sentence}'
    sentence = ' '.join((*all_of_it.changed, _counts(windows), *all_of_it.failed, kept_words))
    facts = (('windows with a model', f'{sum(e.ok for e in windows.estimates)} of '
              f'{len(windows.estimates)}'),
             *([('changes at [s]', ', '.join(f'{c.time:.1f}' for c in seen[:_MOST])
                 + ', ...' * (len(seen) > _MOST))] if seen else []))
    told = replace(first, grade=all_of_it.word, sentence=sentence,
                   facts=(*first.facts, *facts))
    if kept.ok and seen and windows.starts[place] < seen[-1].time:
        return replace(told, purpose='a model of the plant as it is after the last change',
                       command=run.command('identify', '--start', f'{seen[-1].time:z.1f}'))
    if away and not seen:
        length = f'{away[-1].end - away[-1].start:.1f}'
        return replace(told, purpose='a model of the plant where it is another one',
                       command=run.command('identify', '--start', f'{away[-1].start:z.1f}',
                                           '--duration', length))
    if all_of_it.word == PARTLY:
        start, end = _longest(windows)
        return replace(told, purpose='one model of the longest part without a fault, '
                       f'{start:z.1f} to {end:.1f} s', command=run.command(
                           'identify', '--start', f'{start:z.1f}', '--duration',
                           f'{end - start:.1f}'))
    return told


def _longest(windows: Windows) -> tuple[float, float]:
    """Return from when to when most accepted windows follow each other [s]."""
    runs = [[k for k, _ in group] for ok, group in groupby(
        enumerate(windows.estimates), key=lambda pair: pair[1].ok) if ok]
    best = max(runs, key=len)
    return float(windows.starts[best[0]]), float(windows.ends[best[-1]])


def _counts(windows: Windows) -> str:
    grades = [e.verdict.grade for e in windows.estimates]
    counts = ', '.join(f'{grades.count(g)} {g.name}' for g in Grade if g in grades)
    still = sum(e.status is Status.NO_EXCITATION for e in windows.estimates)
    rest = f' (no input moves in {still})' if still else ''
    return f'{len(grades)} window{"s" if len(grades) > 1 else ""}: {counts}{rest}.'


def _kept(kept: Estimate) -> str:
    return 'Kept is the model of' if kept.ok else 'None has a model; shown is'
