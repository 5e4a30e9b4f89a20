# SPDX-License-Identifier: Apache-2.0
"""
Inputs that drift: what they explain, states need not.

A battery that sags and a motor that warms up change a gain while it is recorded, and clocks that
run apart change a dead time. Of a plant whose numbers move in a straight line within a record the
output is, to first order, that of one which stands still and has each input twice: as it is, and
multiplied by the time from the middle of the record on, with residues of their own; and that time,
for what a gain that drifts makes of an input's mean. For a gain before the plant and held inputs
that is exact; dead times it follows to first order, as far as no input acts on an output at once.

References
----------
Niedzwiecki 2000, Identification of Time-Varying Processes, chapter 6 (basis functions).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from ctsid_core.likelihood.output_error import Fit, Free, Guess, climb_roughly, fit_at, fit_states
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array
from ctsid_core.search.tried import SEARCH, Tried, beats, parameters, price, tried
from ctsid_core.signals.record import Signal

_LEFT = 0.3           # power of errors, noise apart, that a drift may leave of that before
_INSTANTS = 200       # at which that is asked
_LIKE = 0.8           # of a straight line in time, that inputs explain: it is theirs then
_APART = 2.0          # times the power of the errors of one model, that those of the mean may have


def drifting(samples: Samples, one: Tried, free: Free, rival: float = np.inf) -> Tried | None:
    """
    Return a model of the same order with inputs that drift, or None if they do not.

    They do where that is worth its numbers, and explains most of what is not noise. Given up where
    it will not reach the cost of a rival.
    """
    m, both, free = one.fit.model, _with_time(samples), free_with_time(free)
    wider = (0, 0), (0, samples.nu + 1)
    near = Guess(replace(m, b=np.pad(m.b, wider), D=np.pad(m.D, wider)), one.fit.power)
    with suppress(np.linalg.LinAlgError):
        start = fit_at(both, m.poles, delays_with_time(m.delay), free, near)
        more = parameters(both, start, free) - one.parameters
        rival = min(rival, one.fit.cost - price(samples) * more)
        found = tried(both, climb_roughly(both, start, free, rival), free)
        if beats(found, one) and found.unexplained ** 2 < _LEFT * one.unexplained ** 2:
            return found
    return None


def mean_of(samples: Samples, one: Tried, free: Free) -> tuple[Tried, Tried | None]:
    """
    Return the mean of what drifts, with it what drifts, or a model as it is; and what drifts.

    It is the model in the middle of the record: one that stands still is pulled to when inputs
    move most, and its poles stand in for what drifts. Where records do not tell the middle, the
    mean explains them less well than one model does, offsets that drift apart.
    """
    both = None if samples.effort.beyond(SEARCH) else drifting(samples, one, free)
    if both is None or np.any(both.samples.mean(standing(
            both.samples, both.fit, free_with_time(free)).power) > _APART * one.power):
        return replace(one, drifting=None), both
    m, nu = both.fit.model, samples.nu
    m = replace(m, b=m.b[:, :nu], D=m.D[:, :nu], delay=m.delay[:nu])
    return replace(tried(samples, fit_states(samples, m, free), free), drifting=both), both


def standing(samples: Samples, fit: Fit, free: Free) -> Fit:
    """Return a model with time among its inputs as if these stood still; offsets may drift."""
    m, still = fit.model, np.arange(samples.nu) < samples.nu // 2
    still[-1] = True
    return fit_states(samples, replace(m, b=m.b * still, D=m.D * still), free)


def free_with_time(free: Free) -> Free:
    """Return what is free where time is among the inputs: no further dead times."""
    return replace(free, delays=free.delays + (False,) * (len(free.delays) + 1))


def delays_with_time(delay: Array) -> Array:
    """Return the dead times where time is among the inputs: those times it have the same ones."""
    return np.append(delay, [*delay, 0.0])


def _with_time(samples: Samples) -> Samples:
    """Return samples with more inputs: those that there are, times the time, and that."""
    records = []
    for r in samples.records:
        start, end = r.span
        middle, length = 0.5 * (start + end), (end - start) or 1.0
        more = [replace(s, values=s.values * ((s.time - middle) / length)[:, np.newaxis])
                for s in r.inputs]
        # Time by itself is no further input where one is much like it already.
        line = np.array([[-0.5], [0.5]]) * (max(
            _like_time(s, start, end) for s in r.inputs) < _LIKE)
        more.append(Signal(start + np.array([0.0, length]), line, 'linear'))
        records.append(replace(r, inputs=(*r.inputs, *more)))
    return replace(samples, records=tuple(records), nu=2 * samples.nu + 1)


def _like_time(signal: Signal, start: float, end: float) -> float:
    """Return how much of a straight line in time the channels of a signal explain, 0 to 1."""
    time = np.linspace(start, end, _INSTANTS)
    at = np.maximum(np.searchsorted(signal.time, time, side='right') - 1, 0)
    values = np.column_stack((signal.values[at], np.ones(len(time))))
    time -= time.mean()
    left = time - values @ np.linalg.lstsq(values, time, rcond=None)[0]
    return 1.0 - float(left @ left) / max(float(time @ time), 1e-300)
