# SPDX-License-Identifier: Apache-2.0
"""
Whether a model is that of the controller: minus one over it.

Where a controller holds a plant in place, inputs and outputs tell of the controller, u = -C y, at
least as much as of the plant, and y = -u / C fits well. The controller is what the outputs' past
tells of how an input changes, if it tells more of that than the input's own past; and 1 + G C is
near 0 then. Of a right model it is one over the sensitivity of the loop, which a controller that
is any good keeps well away from 0.

A plant that grows is held by a controller, or would not be there to be recorded. Where none can
be a mode that grows is that of a filter: what is filtered forward and backward in time
(`filtfilt`, a centred mean) answers before it is asked, and a stable mode that runs backward is,
forward, one that grows.

Where outputs are stamped late, what a controller computes from one has an earlier stamp than it:
the input then seems to move first, the plant is minus one over the controller again, and no past
tells. But such a model hinges on the stamps: a plant's response hardly changes if outputs are an
interval earlier.

References
----------
Ljung, System Identification, 2nd edition, section 13.4 (closed loop, informative data).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Literal

import numpy as np

from ctsid_core.likelihood.output_error import climb_roughly, fit_at
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Excitation
from ctsid_core.search.by_prediction import plant_of
from ctsid_core.search.solution import Solution
from ctsid_core.signals.actuators import unramped
from ctsid_core.signals.record import Record, Signal

_PAST = 20            # samples of an input, over which the outputs are looked at
_EACH = 6             # changes for each number, at least
_MOST = 5000          # samples of an input that are looked at, the last ones
_TOLERANCE = 1e-10    # of regressors that depend on each other
_SMOOTH = 1e-10       # power of changes that its own past does not tell: less, and it tells all
_HIGH = 0.1           # of the Nyquist frequency of the input, up to which ...
_FREQUENCIES = 40     # ... so many frequencies are looked at
_NEWS = 1e-6          # of the part of outputs that their past does not tell (in power)
_MOVING = 1.5         # intervals that an input rests for as a rule: no longer, and it never rests
_HEARS = 8.0          # deviations of what numbers gain by chance, that outputs have to tell
_RESTS = 0.85         # times e that a mode grows while the input that holds it rests, as a rule


def distance_to_controller(records: Sequence[Record], model: StateSpace,
                           excited: Sequence[Excitation], same_instant: bool = False) -> Array:
    """
    Return how far a model is from minus one over the controller, for each input, (nu,).

    The median over the excited band of the size of the input's row of 1 + C G, every octave alike,
    of the record with the least. Infinite if the outputs' past tells no more of how the input
    changes than its own past does: then no controller is seen. If outputs follow the inputs at
    once, outputs of the same instant tell of both: they count for `same_instant` alone, and of
    inputs that never rest while outputs move, as a controller that answers at once does not.
    """
    before = bool(model.D.any()) and not same_instant
    found = np.full((len(records), model.nu), np.inf)
    for row, record in zip(found, records, strict=True):
        j = 0
        for signal in unramped(record.inputs, record.commands):
            rests = _rests(signal, record) if same_instant else [0.0] * signal.width
            for answer, rest in zip(_answers(signal, record, before), rests, strict=True):
                if answer is not None and rest <= _MOVING * signal.period:
                    row[j] = _distance(answer, signal.period, model, j, excited[j])
                j += 1
    return np.asarray(found.min(axis=0))


def stamp_sensitivity(solution: Solution, excited: Sequence[Excitation]) -> float:
    """
    Return by how much the response changes if outputs were one interval earlier than they are.

    One of the inputs, within which commands are computed. The median over the excited band of the
    change over the response; 0 where outputs may follow inputs at once, and of what simulations
    found, which stamps hardly change.
    """
    samples, fit, free = solution.source
    parts, last = solution.part.parts, solution.part.last
    step = max(s.period for s in parts[last].record.inputs)
    low = min(one.low for one in excited)
    high = min(max(one.high for one in excited), _HIGH * np.pi / step)
    if solution.plant is None or solution.settings.feedthrough or not 0.0 < low < high \
            or samples.effort.leaves_out('whether the model hinges on stamps'):
        return 0.0
    count = len(parts[last].record.inputs)
    other = replace(samples, records=tuple(replace(r, inputs=(
        *(replace(s, time=s.time + step) for s in r.inputs[:count]), *r.inputs[count:]))
        for r in samples.records))
    omega = np.geomspace(low, high, _FREQUENCIES)
    with suppress(np.linalg.LinAlgError):
        moved = climb_roughly(other, fit_at(other, fit.model.poles, fit.model.delay, free, fit),
                              free)
        plants = [(plant_of(one, samples, last, np.inf), one.model.delay) for one in (fit, moved)]
        if any(m is None for m, _ in plants):
            return 0.0
        own, changed = (StateSpace(m.A, m.B, m.C, m.D, delay=tuple(late[:m.B.shape[1]].tolist())
                                   ).frequency_response(omega)
                        for m, late in plants if m is not None)
        return float(np.median(np.linalg.norm(changed - own, axis=(1, 2))
                               / np.linalg.norm(own, axis=(1, 2))))
    return 0.0                                  # nothing is known of it


def never_rest(records: Sequence[Record]) -> bool:
    """Return whether an input moves all the time, as what a controller sends does."""
    return any(rest <= _MOVING * signal.period for record in records for signal in record.inputs
               for rest in _rests(signal, record))


def in_loop(records: Sequence[Record]) -> bool:
    """Return whether inputs seem to be a controller's: one never rests, and hears the outputs."""
    return never_rest(records) and hears(records)


def hears(records: Sequence[Record]) -> bool:
    """
    Return whether outputs tell more of how an input changes than its own past does, beyond chance.

    Then what is noise in them is in the input, too (Granger 1969, Econometrica 37).
    """
    for record in records:
        for signal in unramped(record.inputs, record.commands):
            outputs, changes, _ = _before(signal, record, False)
            count, ny = outputs.shape
            past = min(_PAST // ny, (count - 1) // (_EACH * (ny + 1)))
            for own in changes if past > 0 else ():
                alone = _alone(own, past)
                _, (left,) = _told(np.column_stack((own[:-1], outputs[2:])), own[np.newaxis, 1:],
                                   past)
                least = _SMOOTH * float(np.mean(own ** 2))
                gain = (count - past) * np.log((alone + least) / (left + least))
                if gain > _HEARS * np.sqrt(2.0 * past * ny):
                    return True
    return False


def holds(records: Sequence[Record], growth: float, at_once: bool) -> bool:
    """
    Return whether any input could hold a mode which grows as exp(growth t) [rad/s].

    One that is computed from the outputs has what is new in them, and does not as a rule rest for
    long while they move and that mode grows. `at_once`: outputs follow inputs at once.
    """
    return any(follows and growth * rest < _RESTS
               for record in records for signal in record.inputs
               for follows, rest in zip(_has_news(signal, record, at_once),
                                        _rests(signal, record), strict=True))


def _has_news(signal: Signal, record: Record, at_once: bool) -> list[bool]:
    """Return whether what a channel's past does not tell of it is of the size of the outputs'."""
    outputs, changes, past = _before(signal, record, at_once)
    if not past:
        return [True] * signal.width

    def news(own: Array) -> float:
        return _alone(own, past) / max(float(np.mean(own ** 2)), 1e-300)
    least = _NEWS * min(map(news, np.diff(outputs, axis=0).T))
    return [news(own) >= least for own in changes]


def _rests(signal: Signal, record: Record) -> list[float]:
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


def _distance(answer: Array, step: float, model: StateSpace, j: int, excited: Excitation) -> float:
    """Return the distance, given what the outputs add to each change of the input, (past, ny)."""
    high = min(excited.high, _HIGH * np.pi / step)
    if not 0.0 < excited.low < high:
        return np.inf
    omega = np.geomspace(excited.low, high, _FREQUENCIES)
    lags = np.exp(-1j * np.outer(omega, step * np.arange(len(answer))))
    # Changes add up, and the sum is held.
    controller: ComplexArray = lags @ answer / (1j * omega * step)[:, np.newaxis]
    rows = np.einsum('fi,fij->fj', controller, model.frequency_response(omega))
    rows[:, j] -= 1.0
    return float(np.median(np.linalg.norm(rows, axis=1)))


def _answers(signal: Signal, record: Record, at_once: bool) -> list[Array | None]:
    """
    Return what outputs before it add to each change of a channel, (past, ny), if they tell.

    Strictly before it if outputs follow the inputs `at_once`.
    """
    outputs, changes, past = _before(signal, record, at_once)
    if not past:
        return [None] * signal.width
    weights, left = _told(outputs[1:], changes, past)
    found: list[Array | None] = []
    for own, power, w in zip(changes, left, weights, strict=True):
        rest = _alone(own, past)
        tells = power < rest and rest > _SMOOTH * np.mean(own ** 2)
        found.append(w.reshape(past, -1) if tells else None)
    return found


def _before(signal: Signal, record: Record, at_once: bool) -> tuple[Array, Array, int]:
    """Return outputs before the samples of an input, its changes, and how far to look back."""
    rows = signal.rows(record.start, record.end)
    times, values = signal.time[rows][-_MOST:], signal.values[rows][-_MOST:]
    # What an input is computed from has the same stamp or an earlier one.
    side: Literal['left', 'right'] = 'left' if at_once else 'right'
    last = [np.maximum(np.searchsorted(s.time, times, side=side) - 1, 0)
            for s in record.outputs]
    outputs = np.column_stack([s.values[at] for s, at in zip(record.outputs, last, strict=True)])
    return outputs, np.diff(values, axis=0).T, min(
        _PAST, len(times) // (_EACH * outputs.shape[1]))


def _alone(own: Array, past: int) -> float:
    """Return the mean square of what its own past does not tell of a sequence."""
    _, left = _told(own[:-1, np.newaxis], own[np.newaxis, 1:], past)
    return float(left[0])


def _told(regressors: Array, targets: Array, past: int) -> tuple[Array, Array]:
    """
    Return how targets (m, N) depend on so many rows (N, k) up to each, and what is left.

    Weights (m, past k), and the mean squares of what is left (m,).
    """
    count = targets.shape[1] - past + 1
    known = np.vstack([*(regressors[past - 1 - k:past - 1 - k + count].T for k in range(past)),
                       np.ones((1, count))])
    wanted = targets[:, past - 1:]
    weights = least_norm(known, wanted, _TOLERANCE)
    left = np.sum((wanted - weights @ known) ** 2, axis=1) / max(count - len(known), 1)
    return weights[:, :-1], left
