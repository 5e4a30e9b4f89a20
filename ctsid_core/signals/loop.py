# SPDX-License-Identifier: Apache-2.0
"""
Whether a controller computes the inputs: these hear the outputs.

What is noise in the outputs is then in the inputs, too: the outputs' past tells more of how an
input changes than its own past does (Granger 1969, Econometrica 37).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.types import Array
from ctsid_core.signals.actuators import unramped
from ctsid_core.signals.record import Record, Signal

_PAST = 20            # samples of an input, over which the outputs are looked at
_EACH = 6             # changes for each number, at least
_MOST = 5000          # samples of an input that are looked at, the last ones
_TOLERANCE = 1e-10    # of regressors that depend on each other
SMOOTH = 1e-10        # power of changes that its own past does not tell: less, and it tells all
MOVING = 1.5          # intervals that an input rests for as a rule: no longer, and it never rests
_HEARS = 8.0          # deviations of what numbers gain by chance, that outputs have to tell
NEWEST = 5            # outputs, that a controller answers most: with 20 loops tell half as clearly
_USUAL = 20.0         # times the median size of changes, to which larger ones are clipped


def in_loop(records: Sequence[Record]) -> bool:
    """
    Return whether inputs seem to be a controller's, which hears the outputs.

    Their past tells more, beyond chance, of how an input changes than its own past does: then what
    is noise in them is in the input, too. Asked of the samples at which it changes, for a slow
    controller's command may be sent again, and of changes of a usual size, for a few jumps of a
    set point outweigh all others.
    """
    for record in records:
        for signal in unramped(record.inputs, record.commands):
            outputs, changes, _ = outputs_before(signal, record, False)
            if any(_hears(own[own != 0.0], outputs[np.append(True, own != 0.0)])
                   for own in changes):
                return True
    return False


def _hears(changes: Array, outputs: Array) -> bool:
    """Return whether outputs (N, ny) tell of changes (N - 1,): of each those before it."""
    past = past_of(outputs)
    newest = min(NEWEST, past)
    return past > 0 and heard(changes, newest_of(outputs, newest), past) is not None


def past_of(outputs: Array) -> int:
    """Return how many changes before count, beside outputs (N, ny)."""
    count, ny = outputs.shape
    return int(min(_PAST, max(count - 1, 0) // (_EACH * (ny + 1))))


def newest_of(outputs: Array, count: int) -> Array:
    """Return so many outputs (N, ny) up to each, ny times the latest last."""
    seen = sliding_window_view(outputs, count, axis=0)
    return seen.reshape(len(seen), -1)


def heard(changes: Array, seen: Array, past: int) -> tuple[Array, Array] | None:
    """
    Return how changes (N,) depend on so many before and on what is `seen`, if that tells.

    The last row of `seen` (M, k) is of the last change. Weights (past,), the latest first, and
    (k,).
    """
    if not np.median(np.abs(changes)):          # it mostly rests
        return None
    count = min(len(changes) - past, len(seen))
    own = clipped(changes)[-count - past:]
    before = np.hstack((sliding_window_view(own, past)[:-1], seen[-count:]))
    (weights,), (left,) = _regressed(before, own[np.newaxis, past:])
    least = SMOOTH * float(np.mean(own ** 2))
    gain = count * np.log((left_alone(own, past) + least) / (left + least))
    tells = gain > _HEARS * np.sqrt(2.0 * seen.shape[1])
    return (weights[past - 1::-1], weights[past:-1]) if tells else None


def clipped(changes: Array) -> Array:
    """Return changes, none larger than usual: a few jumps of a set point outweigh all others."""
    moves = np.abs(changes[changes != 0.0])
    most = _USUAL * float(np.median(moves)) if len(moves) else 0.0
    return np.clip(changes, -most, most)


def never_rest(records: Sequence[Record]) -> bool:
    """Return whether an input moves all the time, as what a controller sends does."""
    return any(rest <= MOVING * signal.period for record in records for signal in record.inputs
               for rest in resting_times(signal, record))


def resting_times(signal: Signal, record: Record) -> list[float]:
    """Return for how long each channel rests while outputs move: longer half of the time [s]."""
    rows = signal.rows(record.start, record.end)
    times, values = signal.time[rows], signal.values[rows]
    if not len(times):
        return [np.inf] * signal.width
    moves = np.sort(np.concatenate([s.time[1:][(np.diff(s.values, axis=0) != 0.0).all(axis=1)]
                                    for s in record.outputs]))
    found = []
    for own in values.T:
        starts = times[np.append(True, np.diff(own) != 0.0)]
        ends = np.append(starts[1:], record.end)
        first, last = (np.searchsorted(moves, t) for t in (starts, ends))
        rests = np.sort(np.where(last > first, ends - starts, 0.0))
        half = np.searchsorted(np.cumsum(rests), 0.5 * np.sum(rests))
        found.append(float(rests[half]))
    return found


def outputs_before(signal: Signal, record: Record, at_once: bool) -> tuple[Array, Array, int]:
    """Return outputs before the samples of an input, its changes, and how far to look back."""
    rows = signal.rows(record.start, record.end)
    times, values = signal.time[rows][-_MOST:], signal.values[rows][-_MOST:]
    # What an input is computed from has the same stamp or an earlier one.
    side: Literal['left', 'right'] = 'left' if at_once else 'right'
    last = [np.maximum(np.searchsorted(s.time, times, side=side) - 1, 0) for s in record.outputs]
    outputs = np.column_stack([s.values[at] for s, at in zip(record.outputs, last, strict=True)])
    return outputs, np.diff(values, axis=0).T, min(_PAST, len(times) // (_EACH * outputs.shape[1]))


def left_alone(own: Array, past: int) -> float:
    """Return the mean square of what its own past does not tell of a sequence."""
    _, left = regressed_on_past(own[:-1, np.newaxis], own[np.newaxis, 1:], past)
    return float(left[0])


def regressed_on_past(regressors: Array, targets: Array, past: int) -> tuple[Array, Array]:
    """
    Return how targets (m, N) depend on so many rows (N, k) up to each, and what is left.

    Weights (m, past k), and the mean squares of what is left (m,).
    """
    weights, left = _regressed(lagged(regressors, past), targets[:, past - 1:])
    return weights[:, :-1], left


def lagged(rows: Array, count: int) -> Array:
    """Return so many rows (N, k) up to each, the latest first, (N - count + 1, count k)."""
    seen = sliding_window_view(rows, count, axis=0)[:, :, ::-1].swapaxes(1, 2)
    return seen.reshape(len(seen), -1)


def _regressed(known: Array, wanted: Array) -> tuple[Array, Array]:
    """Return the weights of rows (N, k), and of 1, in targets (m, N), and what is left of each."""
    rows = np.column_stack((known, np.ones(len(known)))).T
    weights = least_norm(rows, wanted, _TOLERANCE)
    left = np.sum((wanted - weights @ rows) ** 2, axis=1) / max(len(known) - len(rows), 1)
    return weights, left
