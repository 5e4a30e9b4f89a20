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
interval earlier. That is asked where outputs of before are heard all the same: a set point that is
drawn at will hinges on nothing.

References
----------
Ljung, System Identification, 2nd edition, section 13.4 (closed loop, informative data).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctsid_core.likelihood.output_error import climb_roughly, fit_at
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Excitation
from ctsid_core.search.by_prediction import plant_of
from ctsid_core.search.solution import Solution
from ctsid_core.signals.actuators import unramped
from ctsid_core.signals.loop import (
    MOVING,
    NEWEST,
    SMOOTH,
    clipped,
    heard,
    in_loop,
    lagged,
    left_alone,
    newest_of,
    outputs_before,
    past_of,
    regressed_on_past,
    resting_times,
)
from ctsid_core.signals.record import Record, Signal

_HIGH = 0.1           # of the Nyquist frequency of the input, up to which ...
_FREQUENCIES = 40     # ... so many frequencies are looked at
_NEWS = 1e-6          # of the part of outputs that their past does not tell (in power)
_NOISY = 0.5          # of how a command changes, in power: what its own past does not tell
_SAME, _TOLD = 1e-10, 1e-8     # of instruments, and of what these tell of outputs: less is none
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
    # A controller with sensors of its own hears another noise than is recorded: where samples do
    # not tell of it, means do.
    # Strictly before an input are outputs that may follow it at once.
    before = bool(model.D.any()) and not same_instant
    found = np.full((len(records), model.nu), np.inf)
    for row, record in zip(found, records, strict=True):
        j = 0
        for signal in unramped(record.inputs, record.commands):
            rests = resting_times(signal, record) if same_instant else [0.0] * signal.width
            outputs, changes, past = outputs_before(signal, record, before)
            answers = _answers(outputs, changes, past, signal.period)
            means = [None] * len(answers) if model.D.any() or None not in answers else \
                _in_means(outputs, changes, signal.period)
            for rest, one, other in zip(rests, answers, means, strict=True):
                answer = one or other
                if answer is not None and rest <= MOVING * signal.period:
                    row[j] = _distance(answer, model, j, excited[j])
                j += 1
    return np.asarray(found.min(axis=0))


def stamp_sensitivity(solution: Solution, excited: Sequence[Excitation]) -> float:
    """
    Return by how much the response changes if outputs were one interval earlier than they are.

    One of the inputs, within which commands are computed. The median over the excited band of the
    change over the response; 0 where outputs may follow inputs at once, where no controller is
    heard, and of what simulations found, which stamps hardly change.
    """
    samples, fit, free = solution.source
    parts, last = solution.part.parts, solution.part.last
    step = max(s.period for s in parts[last].record.inputs)
    low = min(one.low for one in excited)
    high = min(max(one.high for one in excited), _HIGH * np.pi / step)
    if solution.plant is None or solution.settings.feedthrough or not 0.0 < low < high \
            or not in_loop([p.record for p in parts]) \
            or samples.effort.leaves_out('whether the model hinges on stamps'):
        return 0.0
    count = len(parts[last].record.inputs)
    other = replace(samples, records=tuple(replace(r, inputs=(
        *(replace(s, time=s.time + step) for s in r.inputs[:count]), *r.inputs[count:]))
        for r in samples.records))
    omega = np.geomspace(low, high, _FREQUENCIES)
    with suppress(np.linalg.LinAlgError):
        moved = climb_roughly(other, fit_at(other, *fit.model.nonlinear, free, fit), free)
        plants = [(plant_of(one, samples, last, np.inf), one.model.delay) for one in (fit, moved)]
        if any(m is None for m, _ in plants):
            return 0.0
        own, changed = (StateSpace(m.A, m.B, m.C, m.D, delay=tuple(late[:m.B.shape[1]].tolist())
                                   ).frequency_response(omega)
                        for m, late in plants if m is not None)
        return float(np.median(np.linalg.norm(changed - own, axis=(1, 2))
                               / np.linalg.norm(own, axis=(1, 2))))
    return 0.0                                  # nothing is known of it


def holds(records: Sequence[Record], growth: float, at_once: bool) -> bool:
    """
    Return whether any input could hold a mode which grows as exp(growth t) [rad/s].

    One that is computed from the outputs has what is new in them, and does not as a rule rest for
    long while they move and that mode grows. `at_once`: outputs follow inputs at once.
    """
    return any(follows and growth * rest < _RESTS
               for record in records for signal in record.inputs
               for follows, rest in zip(_has_news(signal, record, at_once),
                                        resting_times(signal, record), strict=True))


def _has_news(signal: Signal, record: Record, at_once: bool) -> list[bool]:
    """Return whether what a channel's past does not tell of it is of the size of the outputs'."""
    outputs, changes, past = outputs_before(signal, record, at_once)
    if not past:
        return [True] * signal.width

    def news(own: Array) -> float:
        return left_alone(own, past) / max(float(np.mean(own ** 2)), 1e-300)
    least = _NEWS * min(map(news, np.diff(outputs, axis=0).T))
    return [news(own) >= least for own in changes]


class _Answer(NamedTuple):
    """What adds to each change of an input, the latest first, every `step` [s]."""

    outputs: Array      # (past, ny)
    own: Array          # of its changes before, (past,)
    step: float
    shortest: float     # of what it tells of [s]


def _distance(answer: _Answer, model: StateSpace, j: int, excited: Excitation) -> float:
    """Return the distance, given what computes the input."""
    outputs, own, step, shortest = answer
    high = min(excited.high, _HIGH * np.pi / shortest)
    if not 0.0 < excited.low < high:
        return np.inf
    omega = np.geomspace(excited.low, high, _FREQUENCIES)

    def lags(first: int, count: int) -> ComplexArray:
        return np.exp(-1j * np.outer(omega, step * np.arange(first, first + count)))
    # Changes add up, and the sum is held.
    added = 1j * omega * step * (1.0 - lags(1, len(own)) @ own)
    controller: ComplexArray = lags(0, len(outputs)) @ outputs / added[:, np.newaxis]
    rows = np.einsum('fi,fij->fj', controller, model.frequency_response(omega))
    rows[:, j] -= 1.0
    return float(np.median(np.linalg.norm(rows, axis=1)))


def _answers(outputs: Array, changes: Array, past: int, step: float) -> list[_Answer | None]:
    """Return what outputs before it add to each change of a channel, if they tell."""
    news = _news_of(outputs, changes) if past else outputs[:0]
    if not len(news):
        return [None] * len(changes)
    _, left = regressed_on_past(outputs[1:], changes, past)
    found: list[_Answer | None] = []
    for own, power in zip(changes, left, strict=True):
        weights, (rest,) = regressed_on_past(own[:-1, np.newaxis], own[np.newaxis, 1:], past)
        tells = power < rest and rest > SMOOTH * np.mean(own ** 2)
        found.append(_Answer(_by_news(outputs[1:], own, news, weights[0]), np.zeros(0), step, step)
                     if tells else None)
    return found


def _news_of(outputs: Array, changes: Array) -> Array:
    """Return what the past of outputs and channels does not tell of the last outputs (M, ny)."""
    known, new = np.hstack((outputs[1:-1], changes[:, :-1].T)), outputs[2:]
    past = past_of(known)
    if not past:
        return outputs[:0]
    weights, left = regressed_on_past(known, new.T, past)
    if np.any(left <= SMOOTH * np.mean(np.diff(outputs, axis=0) ** 2, axis=0)):
        return outputs[:0]                              # they are rounding
    return np.asarray(new[past - 1:] - lagged(known, past) @ weights.T)


def _by_news(outputs: Array, own: Array, news: Array, weights: Array) -> Array:
    """Return the weights of outputs (past, ny) in changes, with their news as instruments."""
    # A smooth set point is told by outputs, too, by way of the plant: what they add to it would be
    # one over that, of whatever loop. Both are filtered by what makes the changes white.
    past = len(weights)

    def white(rows: Array) -> Array:
        seen = lagged(rows, past + 1).reshape(-1, past + 1, rows.shape[1])
        return np.asarray(np.tensordot(seen, np.append(1.0, -weights), (1, 0)))
    lags, changes, by = lagged(white(outputs), past), white(clipped(own)[:, np.newaxis]), lagged(
        news, min(2 * past, len(news)))
    count = min(len(lags), len(by))
    lags, changes, by = ((rows - rows.mean(axis=0)).T for rows in (
        lags[-count:], changes[-count:], by[-count:]))
    told = least_norm(by, lags, _SAME) @ by
    return np.asarray(least_norm(told, changes, _TOLD)[0].reshape(past, -1))


def _in_means(outputs: Array, changes: Array, step: float) -> list[_Answer | None]:
    """Return what means of outputs before it add to each change of a channel, if they tell."""
    past, ny = past_of(outputs), outputs.shape[1]
    if past < NEWEST:
        return [None] * len(changes)
    means = newest_of(outputs, NEWEST ** 2)
    means = means.reshape(len(means), -1, NEWEST).mean(axis=2)
    found: list[_Answer | None] = []
    for own in changes:
        noisy = left_alone(own, past) > _NOISY * float(np.mean(own ** 2))
        answer = heard(own, means, past) if noisy else None
        found.append(None if answer is None else _Answer(
            np.repeat(answer[1].reshape(ny, NEWEST)[:, ::-1].T / NEWEST, NEWEST, axis=0),
            answer[0], step, NEWEST * step))
    return found
