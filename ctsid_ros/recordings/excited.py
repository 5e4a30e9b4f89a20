# SPDX-License-Identifier: Apache-2.0
"""Where an input excites a plant: the intervals of a recording that are worth identifying."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array, Mask
from ctsid_ros.recordings.excerpts import Clock, unit_of_time
from ctsid_ros.recordings.guess_pairs import moving_sum

# In units of time: a second of a robot, ten samples of what is slower, see `unit_of_time`.
_SMOOTH = 0.05  # an input is averaged so long to either side; what is faster moves no robot
_POWER = 1.0  # and the power of its derivative so long
_BEFORE = 1.0  # is added, for the trim
# In the same, or in usual times from one move to the next where these are longer: people wait
# until a plant has answered.
_MERGE = 10.0  # a shorter pause is part of an experiment; to keep it costs little
_AFTER = 3.0  # is added, for the response to the last move
_SHORTEST = 5.0  # with the unit of time that is 50 samples
_MOVE = 0.1  # of the usual size of a move: less is noise
_MOVES = 10  # waits in a recording, at least
_CONTRAST = 10.0  # loud over quiet power, below which all is one experiment
_ANSWERED = 0.1  # of what an output has moved, from where it stays: it has answered
_STAYS = 0.3  # of it: an output that moves by more in the second half of a rest does not answer
_FLOOR = 1e-4  # of the loud power: what is quieter counts as at rest
_STILL = 0.3  # of the deviation where it moves fast: what keeps nearer to its mean rests
_ALL = 0.8  # of the time: an experiment that lasts longer is all of the recording


@dataclass(frozen=True)
class Stretch:
    """
    An interval in which an input moves.

    Parameters
    ----------
    start, end : float
        After the start of the bag [s].
    power : float
        Of the input's derivative, over that of its quiet part.
    energy : float
        Share of the energy of the input's derivative that is in this interval.
    """

    start: float
    end: float
    power: float
    energy: float


def pace(u: Array, clock: Clock) -> float:
    """Return how long an input usually waits from one move to the next [s]; 0 if it never does."""
    moves = np.abs(np.nan_to_num(np.diff(u)))
    moves[np.array(clock.starts[1:], int) - 1] = 0.0
    at = np.flatnonzero(moves > _MOVE * np.sqrt(_usual(moves ** 2)))
    found = _usual(np.diff(clock.time[at]), moves[at[:-1]] ** 2)
    # Two large steps, to take off and to land, are no pace, whatever is between them.
    return found if _MOVES * found < len(clock.time) * clock.step else 0.0


def _usual(values: Array, weights: Array | None = None) -> float:
    """Return the median, each value as often as its weight says, or its own size: rest is not."""
    order = np.argsort(values)
    total = np.cumsum((values if weights is None else weights)[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)]) if len(total) else 0.0


def excited(u: Array, clock: Clock, period: float = 0.0,
            outputs: Sequence[Array] = ()) -> tuple[Stretch, ...]:
    """
    Return the stretches in which an input moves much more than at rest, in order of time.

    Each lasts until outputs have answered, or the input moves again.

    Parameters
    ----------
    u : ndarray, shape (N,)
        At the ticks of the clock; NaN where not known.
    clock : Clock
    period : float, optional
        Between the samples of what answers, if that is longer than a tick [s].
    outputs : sequence of ndarray, shape (N,), optional
        What answers, at the ticks of the clock; NaN where not known.

    Returns
    -------
    tuple of Stretch
        None if the input moves alike all the time, or nearly so.
    """
    power = _power(u, clock)
    loud, quiet = _usual(power), float(np.quantile(power, 0.1))
    quiet = max(quiet, _FLOOR * loud)
    if loud <= 0.0 or loud < _CONTRAST * quiet:
        return ()
    unit = max(unit_of_time(max(clock.step, period)), pace(u, clock))
    active = _and_slow_motion(u, power > np.sqrt(loud * quiet), clock, _MERGE * unit)
    answered, slowest = _and_answers(active, clock, outputs)
    before, found = max(_BEFORE * unit_of_time(clock.step), slowest), []
    for part in clock.parts:
        for start, end in _merged(clock.time[part][answered[part]], _MERGE * unit):
            low, high = clock.time[part][[0, -1]]
            inside = (clock.time >= start) & (clock.time <= end)
            last = float(clock.time[np.flatnonzero(active & inside)[-1]])
            found.append(Stretch(max(start - before, float(low)),
                                 min(max(end, last + _AFTER * unit), float(high)),
                                 float(power[inside].mean() / quiet),
                                 float(power[inside].sum() / power.sum())))
    found = [s for s in found if s.end - s.start >= _SHORTEST * unit]
    total = len(clock.time) * clock.step
    return () if sum(s.end - s.start for s in found) > _ALL * total else tuple(found)


def _and_slow_motion(u: Array, active: Mask, clock: Clock, longest: float) -> Mask:
    """
    Return where an input moves fast, and between that where it moves as far, only slower.

    A sweep of one amplitude begins so. What is held rests, wherever that is.
    """
    found, size = active.copy(), _STILL * float(np.nanstd(u[active]))
    pieces = np.floor((clock.time - clock.time[0]) / longest)
    for part in clock.parts:
        edges = np.flatnonzero(np.diff(active[part]) | (np.diff(pieces[part]) > 0)) + 1
        for rest in np.split(np.arange(part.start, part.stop), edges):
            known = u[rest][np.isfinite(u[rest])]
            if len(known) and not active[rest[0]]:
                found[rest] = np.std(known) > size
    return found


def _and_answers(active: Mask, clock: Clock, outputs: Sequence[Array]) -> tuple[Mask, float]:
    """
    Return where an input moves or outputs still answer, and how long they do at most [s].

    Until they are near where they stay. As long at rest before a move tells it from the past.
    """
    found, longest = active.copy(), 0
    for part in clock.parts:
        edges = np.flatnonzero(np.diff(active[part])) + 1
        ticks = np.split(np.arange(part.start, part.stop), edges)
        for rest in ticks[2 - int(active[part.start])::2]:      # after moves
            for y in outputs:
                known = rest[np.isfinite(y[rest])]
                half = len(known) // 2
                left = np.abs(y[known] - np.median(y[known[half:]])) if len(known) else known
                most = left.max(initial=0.0)
                if left[half:].max(initial=0.0) > _STAYS * most:    # it wanders, and answers not
                    continue
                late = int(max(known[left > _ANSWERED * most] - rest[0], default=0))
                found[rest[:late]], longest = True, max(longest, late)
    return found, longest * clock.step


def _power(u: Array, clock: Clock) -> Array:
    """Return the power of the derivative of an input below 10 Hz, about a second long."""
    power = np.zeros(len(u))
    near, wide = (max(int(t * clock.unit), 1) for t in (_SMOOTH, _POWER))
    for part in clock.parts:
        own = u[part]
        known = np.flatnonzero(np.isfinite(own))
        if len(known) > 2 * near:
            filled = np.interp(np.arange(len(own)), known, own[known])
            smooth = moving_sum(filled, near) / moving_sum(np.ones(len(own)), near)
            power[part] = moving_sum(np.gradient(smooth, clock.step) ** 2, wide)
    return power


def _merged(times: Array, pause: float) -> list[tuple[float, float]]:
    """Return intervals that hold these ticks; those with short pauses between them are one."""
    if not len(times):
        return []
    cuts = np.flatnonzero(np.diff(times) > pause)
    starts, ends = times[np.r_[0, cuts + 1]], times[np.r_[cuts, len(times) - 1]]
    return [(float(a), float(b)) for a, b in zip(starts, ends, strict=True)]


def together(found: Sequence[Sequence[Stretch]]) -> tuple[Stretch, ...]:
    """
    Return the stretches in which any of several inputs moves, in order of time.

    Parameters
    ----------
    found : sequence of sequences of Stretch
        Those of each input; none where it moves alike all the time: so do all of them then.
    """
    if not all(found):
        return ()
    merged: list[Stretch] = []
    for one in sorted((s for own in found for s in own), key=lambda s: s.start):
        if merged and one.start <= merged[-1].end:
            last = merged.pop()
            one = Stretch(last.start, max(last.end, one.end), max(last.power, one.power),
                          max(last.energy, one.energy))
        merged.append(one)
    return tuple(merged)
