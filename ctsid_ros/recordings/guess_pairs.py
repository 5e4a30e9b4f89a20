# SPDX-License-Identifier: Apache-2.0
"""
How well one scalar of a bag explains another, and which of the two comes first.

For each pair two impulse responses are fitted by least squares, as steps that grow longer with
the lag: one that knows the past of the input only, one that knows its future only. Judged is the
share of the output's motion that they explain in parts of the data that they were not fitted to.
A plant explains from the past; what follows its output is explained from the future.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.recordings.excerpts import Clock

_LONGEST = 10.0  # units of time: of an impulse response
_SHARE = 0.125  # of the data: it is not longer than this either
STEPS = 22  # of an impulse response
_SLOW = 20.0  # units of time: motion slower than this is trim, battery and wind
_ROWS = 4000  # ticks that are compared
_FOLDS = 6
_RIDGES = (1e-5, 1e-3, 1e-1)  # relative to the mean power of the regressors
_FEWEST_ROWS = 100
_LOCAL = 8.0  # units of time: within which the size of the motion is measured
_REST = 10  # ticks at the start that tell the noise of a signal at rest
_LEAVES = 5.0  # standard deviations of that noise: what is farther away is at rest no longer,
_BEGUN = 0.1  # and has begun to move from so much of its range on: gusts before are no beginning
_NOISY = 0.3  # of the range: a signal that has to move so far to be seen tells nothing
_QUIET = 0.3  # of the usual size of motion where there is some: less is not scaled up to it


@dataclass(frozen=True)
class Explained:
    """
    What an input explains of an output.

    Parameters
    ----------
    past, future : float
        Share of the output's motion that the past of the input explains in unseen data, and that
        its future does: 0 to 1.
    overlap : float
        How long both are known [s].

    All are NaN where the two were not compared.
    """

    past: float = float('nan')
    future: float = float('nan')
    overlap: float = float('nan')


def without_slow(values: Array, clock: Clock) -> Array:
    """Return a signal without its mean over `_SLOW` units of time around each tick; NaN stays."""
    result = np.full(len(values), np.nan)
    for part in clock.parts:
        known = np.isfinite(values[part])
        if known.any():
            half = max(int(min(_SLOW * clock.unit, len(known) / 3) / 2), 1)
            result[part] = values[part] - moving_sum(np.where(known, values[part], 0.0), half) \
                / np.maximum(moving_sum(known.astype(float), half), 0.5)
    return result


def moving_sum(values: Array, half: int) -> Array:
    """Return the sums over `half` ticks to either side."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    return np.asarray(total[np.minimum(at + half + 1, len(values))]
                      - total[np.maximum(at - half, 0)])


def effective_frequencies(values: Array, clock: Clock) -> float:
    """Return over how many lines of its spectrum a signal is spread: 2 for a single sine."""
    found = 0.0
    moved = np.nan_to_num(without_slow(values, clock))
    for part in clock.parts:
        own = moved[part]
        power = np.abs(np.fft.rfft(own * np.hanning(len(own)))) ** 2
        total = float(np.sum(power ** 2))
        found = max(found, float(np.sum(power)) ** 2 / total if total > 0 else 0.0)
    return found


def begins_before(one: Array, other: Array) -> bool:
    """
    Whether both signals rest at first, and one begins to move before the other does.

    Both have to be away from their rest by the same share of their range. What left its noise in
    the first half of the time until then, or soon, was not at rest, but moved slowly.
    """
    known = np.flatnonzero(np.isfinite(one) & np.isfinite(other))
    signals = [values[known] for values in (one, other)]
    if len(known) <= _REST or any(np.ptp(x) == 0 for x in signals):
        return False
    away = [np.abs(x - x[:_REST].mean()) / np.ptp(x) for x in signals]
    noise = [_LEAVES * float(np.std(x[:_REST]) / np.ptp(x)) for x in signals]
    share = max(_BEGUN, *noise)
    first, second = (_exceeds(x, share) for x in away)
    rests = all(2 * _exceeds(x, own) >= max(_exceeds(x, share), 6 * _REST)
                for x, own in zip(away, noise, strict=True))
    return rests and share < _NOISY and first < second


def _exceeds(values: Array, limit: float) -> int:
    """Return from which tick on two in a row exceed a limit; 0 if none do."""
    return int(np.argmax(np.minimum(values[:-1], values[1:]) > limit))


class Comparison:
    """
    Compares inputs with outputs on a common clock.

    Parameters
    ----------
    clock : Clock
    outputs : sequence of ndarray, shape (N,)
        NaN where not known.
    """

    def __init__(self, clock: Clock, outputs: Sequence[Array]) -> None:
        self._clock = clock
        shortest = min(p.stop - p.start for p in clock.parts)
        reach = max(min(_LONGEST * clock.unit, _SHARE * len(clock.time), shortest / 3), 4.0)
        edges = np.unique(np.round(np.geomspace(1.0, reach, STEPS)).astype(int))
        self._edges = np.concatenate([[0], edges])
        inside = np.zeros(len(clock.time), bool)
        for part in clock.parts:     # what came before and comes after is known
            inside[part.start + edges[-1]:part.stop - edges[-1]] = True
        self._rows = np.flatnonzero(inside)[::max(int(inside.sum() / _ROWS), 1)]
        self._outputs = [self._output(y) for y in outputs]
        table = np.nan_to_num(np.array([y for y, _ in self._outputs])).T
        self._table = table / np.maximum(table.std(axis=0), 1e-300) if len(table) else table

    @property
    def possible(self) -> bool:
        """Whether there is enough to compare."""
        return len(self._rows) >= _FEWEST_ROWS

    def screened(self, u: Array) -> Array:
        """Return about which share of each output's motion the past of an input explains."""
        past, _, known = self._input(u)
        if known.sum() < _FEWEST_ROWS:
            return np.zeros(len(self._outputs))
        return _held_out(past[known], self._table[known])

    def explained(self, u: Array, outputs: Sequence[int],
                  beside: Sequence[Array] = ()) -> list[Explained]:
        """
        Return what an input explains of some outputs.

        Parameters
        ----------
        u : ndarray, shape (N,)
            Held at the ticks; NaN where not known.
        outputs : sequence of int
            Their numbers.
        beside : sequence of ndarray, shape (N,), optional
            Further inputs, of which the past is known in any case.
        """
        past, future, known = self._input(u)
        for other in beside:
            more, _, known_too = self._input(other)
            past, future = np.hstack((more, past)), np.hstack((more, future))
            known = known & known_too
        return [self._explained(past, future, known, number) for number in outputs]

    def _explained(self, past: Array, future: Array, known_u: NDArray[np.bool_], number: int
                   ) -> Explained:
        y, weight = self._outputs[number]
        known = known_u & np.isfinite(y)
        overlap = float(known.sum()) / max(len(self._rows), 1) * len(
            self._clock.time) * self._clock.step
        if known.sum() < _FEWEST_ROWS:
            return Explained(overlap=overlap)
        target, weight = (y * weight)[known, np.newaxis], weight[known, np.newaxis]
        before, after = (float(_held_out(lagged[known] * weight, target)[0])
                         for lagged in (past, future))
        return Explained(before, after, overlap)

    def _output(self, y: Array) -> tuple[Array, Array]:
        """Return an output at the rows, and their weights: very large motion counts less."""
        y = without_slow(y, self._clock)
        power = np.nan_to_num(y) ** 2
        local = np.empty(len(y))
        half = max(int(_LOCAL / 2 * self._clock.unit), 1)
        for part in self._clock.parts:
            local[part] = moving_sum(power[part], half) / moving_sum(
                np.ones(part.stop - part.start), half)
        usual = float(np.mean(local)) / max(float(np.mean(np.sqrt(local))), 1e-300)
        floor = (_QUIET * usual) ** 2 or 1.0
        return y[self._rows], 1.0 / np.sqrt(local[self._rows] + floor)

    def _input(self, u: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return past and future of an input at the rows, and where all of both is known."""
        u = without_slow(u, self._clock)
        missing = np.concatenate([[0], np.cumsum(~np.isfinite(u))])
        reach = int(self._edges[-1])
        known = missing[self._rows + reach] == missing[np.maximum(self._rows - reach, 0)]
        past, future = self._lagged(np.nan_to_num(u))
        return past, future, known

    def _lagged(self, u: Array) -> tuple[Array, Array]:
        """Return means of the input over the steps of a response: of its past, its future."""
        total = np.concatenate([[0.0], np.cumsum(u)])
        rows, edges = self._rows[:, np.newaxis], self._edges
        before, after = total[rows - edges + 1], total[rows + edges + 1]
        width = np.diff(edges)
        return (before[:, :-1] - before[:, 1:]) / width, (after[:, 1:] - after[:, :-1]) / width


def _held_out(regressors: Array, targets: Array) -> Array:
    """Return which share of each target is explained in parts left out of the fit."""
    parts = _folds(regressors[:, 0], targets)
    grams = np.array([regressors[p].T @ regressors[p] for p in parts])
    rights = np.array([regressors[p].T @ targets[p] for p in parts])
    gram, right = grams.sum(0), rights.sum(0)
    scale = float(np.trace(gram)) / len(gram)
    power = np.sum(targets ** 2, axis=0)
    best = np.zeros(targets.shape[1])
    if scale <= 0.0:
        return best
    for ridge in _RIDGES:
        fits = np.linalg.solve(gram - grams + ridge * scale * np.eye(len(gram)), right - rights)
        # |y - X h|^2 by the sums that are there already
        left = power - 2 * np.sum(fits * rights, axis=(0, 1)) + np.einsum(
            'fin,fij,fjn->n', fits, grams, fits, optimize=True)
        best = np.maximum(best, 1.0 - left / np.where(power > 0, power, np.inf))
    return np.where(power > 0, best, 0.0)


def _folds(u: Array, targets: Array) -> list[slice]:
    """Divide the rows where there is as much motion in each part: an experiment may be short."""
    moved = np.zeros(len(u))
    for motion in (u ** 2, np.mean(targets ** 2, axis=1)):
        moved += np.cumsum(motion) / max(float(motion.sum()), 1e-300)
    inner = np.searchsorted(moved, 2.0 * np.arange(1, _FOLDS) / _FOLDS)
    cuts = [0, *inner.tolist(), len(u)]
    return [slice(*pair) for pair in zip(cuts[:-1], cuts[1:], strict=True)]
