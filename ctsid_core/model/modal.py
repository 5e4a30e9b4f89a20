# SPDX-License-Identifier: Apache-2.0
"""
Responses of modes to sampled inputs at any stamps, and their derivatives by the pole, exactly.

Between the stamps of an input (later by its dead time) it is a polynomial, so that a mode
dz/dt = p z + u goes from stamp to stamp, and on to any time in between, a distance h later, by

    z+ = phi_0(p h) z + sum_j h^(j+1) phi_(j+1)(p h) u^(j)                                   (1)

and its derivative by p, with phi_j' = phi_j - j phi_(j+1), by

    s+ = phi_0(p h) (s + h z) + sum_j h^(j+2) phi_(j+1)'(p h) u^(j).                         (2)

The functions phi are those of `linear/matrix_functions.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial
from typing import NamedTuple

import numpy as np

from ctsid_core.linear.matrix_functions import phi
from ctsid_core.linear.recursion import chain
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.simulation import input_polynomials
from ctsid_core.signals.record import Signal


class ModeResponses(NamedTuple):
    """
    What inputs do to modes that start at rest.

    Parameters
    ----------
    responses, slopes : ndarray, shape (m, nu, N)
        Of each mode to each input, and their derivatives by the pole (empty unless wanted).
    inputs, rates : ndarray, shape (nu, N)
        The inputs after their dead time, at a jump the new value, and their derivatives.
    first : ndarray, shape (nu,)
        The inputs at the start.
    """

    responses: ComplexArray
    slopes: ComplexArray
    inputs: Array
    rates: Array
    first: Array


def mode_responses(poles: ComplexArray, inputs: Sequence[Signal], delay: Array | Sequence[float],
                   start: float, times: Array, *, slopes: bool = True) -> ModeResponses:
    """
    Return what inputs do to modes that are at rest at the start.

    Parameters
    ----------
    poles : ndarray, shape (m,)
        [rad/s]
    inputs : sequence of Signal
        Together nu channels.
    delay : sequence of float, length nu
        [s]
    start : float
        [s]
    times : ndarray, shape (N,)
        In any order, none before the start [s].
    slopes : bool
        Whether the derivatives are wanted.
    """
    m, nu = len(poles), sum(s.width for s in inputs)
    z = np.empty((m, nu, len(times)), dtype=complex)
    dz = np.empty((m, nu if slopes else 0, len(times)), dtype=complex)
    u, first, place = np.empty((2, nu, len(times))), np.empty(nu), 0
    last = float(np.max(times)) if len(times) else start
    for signal in inputs:
        own = np.asarray(delay[place:place + signal.width], dtype=float)
        for d in (own[:1] if len(own) == 1 else np.unique(own)):
            wanted = np.flatnonzero(own == d)
            part = signal if len(wanted) == signal.width else Signal(
                signal.time, signal.values[:, wanted], signal.hold)
            to = place + wanted
            found = _of_signal(poles, part, float(d), start, times, last, slopes)
            z[:, to], first[to] = found.responses, found.first
            u[0, to], u[1, to] = found.inputs, found.rates
            if slopes:
                dz[:, to] = found.slopes
        place += signal.width
    return ModeResponses(z, dz, u[0], u[1], first)


def _of_signal(poles: ComplexArray, signal: Signal, delay: float, start: float, times: Array,
               last: float, slopes: bool) -> ModeResponses:
    stamps = signal.time + delay
    knots = np.concatenate(([start], stamps[(stamps > start) & (stamps < last)]))
    v = input_polynomials((signal,), (delay,) * signal.width, knots)     # (degree + 1, K, w)
    first = v[0, 0]
    place = np.maximum(np.searchsorted(knots, times, side='right') - 1, 0)
    steps = len(knots) - 1
    h = np.concatenate((np.diff(knots), times - knots[place]))
    v = np.concatenate((v[:, :steps], v[:, place]), axis=1)              # of each step
    f = phi(h * poles[:, np.newaxis], len(v) + slopes)                   # (m, steps + N)
    push = np.zeros((len(poles), v.shape[2], len(h)), dtype=complex)
    turn = np.zeros_like(push) if slopes else push
    power = np.ones_like(h)
    for j, derivative in enumerate(v):
        power = power * h
        force = (derivative * power[:, np.newaxis]).T
        push += f[j + 1][:, np.newaxis] * force
        if slopes:
            turn += (f[j + 1] - (j + 1) * f[j + 2])[:, np.newaxis] * (h * force)
    z = chain(f[0][:, :steps], push[:, :, :steps])
    out = f[0][:, np.newaxis, steps:] * z[:, :, place] + push[:, :, steps:]
    bent = out[:, :0]
    if slopes:
        lag = (h * f[0])[:, np.newaxis]
        s = chain(f[0][:, :steps], lag[:, :, :steps] * z[:, :, :-1] + turn[:, :, :steps])
        bent = f[0][:, np.newaxis, steps:] * s[:, :, place] \
            + lag[:, :, steps:] * z[:, :, place] + turn[:, :, steps:]
    u, rate = np.zeros_like(v[0, steps:]), np.zeros_like(v[0, steps:])
    for j, derivative in enumerate(v[:, steps:]):
        u += derivative * (h[steps:, np.newaxis] ** j / factorial(j))
        if j:
            rate += derivative * (h[steps:, np.newaxis] ** (j - 1) / factorial(j - 1))
    return ModeResponses(out, bent, u.T, rate.T, first)
