# SPDX-License-Identifier: Apache-2.0
"""Identified beside true poles, window by window, and what all of them amount to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import textwrap

import numpy as np

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_ros.report.tracks import Mode, match, modes, modes_of

# A pole is right if nearer to the true one than so many standard deviations. A flight has some 50
# of GOOD models; of 960 poles of 59 flights 9 were beyond 3, and none beyond 3.5.
DEVIATIONS = 4.0
# A model is GOOD again at the latest in this window after the change. One or two may be taken for
# straddling it, for its instant is an estimate as well; the next one waits for a second to agree.
AGAIN = 4


@dataclass(frozen=True)
class Truth:
    """The plant from `since_ns` on [ns]."""

    since_ns: int
    model: StateSpace


@dataclass(frozen=True)
class Comparison:
    """
    The modes of one model beside those of a true one.

    Parameters
    ----------
    pairs : tuple of (Mode, Mode)
        True and identified.
    missing, extra : tuple of Mode
        Only true; only identified.
    """

    pairs: tuple[tuple[Mode, Mode], ...]
    missing: tuple[Mode, ...] = ()
    extra: tuple[Mode, ...] = ()

    @property
    def distance(self) -> float:
        """Largest distance of a pole from its true one, in reported standard deviations."""
        if self.missing or self.extra:
            return float('inf')
        return max(distance(*pair) for pair in self.pairs)


def distance(true: Mode, found: Mode) -> float:
    """Return the distance of two poles in standard deviations; infinite if that is unknown."""
    gap = abs(found.pole - true.pole)
    return gap / found.std if found.std > 0 else float('inf')


@dataclass(frozen=True)
class Window:
    """
    A window, and its model beside the truth.

    Parameters
    ----------
    estimate : Estimate
    phase : str
        before, straddling or after the change of the plant.
    comparison : Comparison or None
        With the truth, if there is a model; of a straddling window with the nearer one.
    verdict : str
        Of the tuner.
    """

    estimate: Estimate
    phase: str
    comparison: Comparison | None
    verdict: str = ''

    @property
    def right(self) -> bool:
        """Whether there is a model, and all its poles are those of the plant."""
        return self.comparison is not None and self.comparison.distance <= DEVIATIONS


def compare(model: StateSpace, estimate: Estimate) -> Comparison:
    """Return the modes of an estimate beside those of the true model."""
    true, found = modes(model), modes_of(estimate)
    pairs = match([mode.pole for mode in true], [mode.pole for mode in found])
    return Comparison(
        tuple((true[i], found[j]) for i, j in pairs.items()),
        tuple(mode for i, mode in enumerate(true) if i not in pairs),
        tuple(mode for j, mode in enumerate(found) if j not in pairs.values()))


def judge(estimate: Estimate, truths: Sequence[Truth], verdict: str = '') -> Window:
    """
    Compare a window with the truth of its time.

    Parameters
    ----------
    estimate : Estimate
    truths : sequence of Truth
        At least one, in order of time; the first counts for earlier times too.
    verdict : str
    """
    first, last = (max((i for i, truth in enumerate(truths) if truth.since_ns <= time_ns),
                       default=0) for time_ns in (estimate.start_ns, estimate.end_ns))
    phase = 'straddling' if first != last else 'after' if first else 'before'
    comparison = None
    if estimate.ok:
        comparison = min((compare(truth.model, estimate) for truth in truths[first:last + 1]),
                         key=lambda c: c.distance)
    return Window(estimate, phase, comparison, verdict)


def line(window: Window, start_ns: int) -> str:
    """Return a line about a window; times count from `start_ns`."""
    end = (window.estimate.end_ns - start_ns) * 1e-9
    parts = [f'{end:5.1f} s  {window.phase:10}  {_word(window.estimate):13}']
    if window.comparison is not None:
        parts += [f'{_pole(true)}: {_pole(found)} ± {found.std:.2g} ({distance(true, found):.1f})'
                  for true, found in window.comparison.pairs]
        parts += [f'{_pole(mode)}: not found' for mode in window.comparison.missing]
        parts += [f'not there: {_pole(mode)} ± {mode.std:.2g}'
                  for mode in window.comparison.extra]
    verdict = textwrap.shorten(window.verdict or 'nothing', 100, placeholder=' ...')
    return '  '.join(parts) + f'\n         tuner: {verdict}'


def summary(windows: Sequence[Window]) -> tuple[list[str], bool]:
    """
    Return what the windows amount to, as lines, and whether it is as promised.

    What a consumer of models relies on: no GOOD model is wrong, the change is noticed, and models
    are GOOD again soon after it. One that is WEAK or rejected may be wrong: it says its doubts.
    """
    lines = [_counts(phase, [window for window in windows if window.phase == phase])
             for phase in ('before', 'straddling', 'after')]
    wrong = sum(window.estimate.good and not window.right for window in windows)
    used = sum(window.verdict.startswith('Accepted') and not window.right for window in windows)
    lines += [f'GOOD models that are wrong, by more than {DEVIATIONS:g} reported standard '
              f'deviations: {wrong}', f'wrong models that the tuner used: {used}']
    broken = _broken(windows)
    lines.append(f'NOT as promised: {"; ".join(broken)}' if broken else
                 'as promised: no GOOD model is wrong, the change is noticed, and models are GOOD '
                 f'again within {AGAIN} windows after it')
    return lines, not broken


def _broken(windows: Sequence[Window]) -> list[str]:
    """Return which promises are broken."""
    good = {phase: [window.estimate.good for window in windows if window.phase == phase]
            for phase in ('before', 'after')}
    changed = any(window.estimate.status is Status.CHANGED and window.phase != 'before'
                  for window in windows)
    return [what for what, kept in (
        ('a GOOD model is wrong', all(w.right for w in windows if w.estimate.good)),
        ('the tuner used a wrong model',
         all(w.right for w in windows if w.verdict.startswith('Accepted'))),
        ('no model was GOOD before the change', any(good['before'])),
        ('no window noticed the change', changed),
        (f'no model was GOOD within {AGAIN} windows after the change',
         any(good['after'][:AGAIN]))) if not kept]


def _counts(phase: str, windows: Sequence[Window]) -> str:
    """Return how often what was said of windows, and how far off the worst pole is."""
    said = [_said(window) for window in windows]
    counts = ', '.join(f'{said.count(words)} {words}' for words in dict.fromkeys(said))
    far = max((w.comparison.distance for w in windows if w.comparison), default=float('nan'))
    worst = '' if np.isnan(far) else f' (the worst pole at {far:.1f} standard deviations)'
    return f'{phase} the change: {len(windows)} windows{": " if counts else ""}{counts}{worst}'


def _said(window: Window) -> str:
    if not window.estimate.ok:
        return window.estimate.status.name
    return f'{_word(window.estimate)} {"and right" if window.right else "but WRONG"}'


def _word(estimate: Estimate) -> str:
    """Return the grade of an accepted model, else why there is none."""
    return estimate.verdict.grade.name if estimate.ok else estimate.status.name


def _pole(mode: Mode) -> str:
    pole = mode.pole
    return f'{pole.real:#.3g}{pole.imag:+#.3g}j' if pole.imag else f'{pole.real:#.3g}'
