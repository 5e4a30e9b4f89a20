# SPDX-License-Identifier: Apache-2.0
"""
Step response of a model, and how well it is known.

For a unit step of an input, and tau = t - d after its dead time,

    dx/dtau = A x + B,    y = C x + D,    x(0) = 0                                          (1)

and to first order a change dA, dB, dC, dD, dd of the entries changes it by

    d(dx)/dtau = A dx + dA x + dB,    dy = C dx + dC x + dD - C (A x + B) dd                (2)

which is summed over the rows of the root of the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.statespace import StateSpace

_SETTLED = 5.0      # time constants of the slowest pole until its response has settled
_UNSETTLED = 3.0    # ... that are shown of a pole that never settles
_STILL = 1e-9       # of the fastest pole: a slower one integrates
_LONGEST = 3000.0   # time constants of the fastest pole: more cannot be seen


@dataclass(frozen=True)
class StepResponse:
    """Response of each output to a unit step of each input."""

    times: Array   # (K,): after the dead time of the input [s]
    values: Array  # (K, ny, nu)
    std: Array     # (K, ny, nu): standard deviation; NaN where it is not known


def horizon(model: StateSpace) -> float:
    """Return how long a step response is worth looking at, after the dead time [s]."""
    poles = model.poles
    fastest = float(np.max(np.abs(poles), initial=0.0))
    if not fastest > 0.0:
        return 1.0
    settling = -poles.real[poles.real < -_STILL * fastest]
    rising = poles.real[poles.real > _STILL * fastest]
    if len(rising):
        return min(_UNSETTLED / float(np.max(rising)), _LONGEST / fastest)
    slowest = float(np.min(settling)) if len(settling) else fastest / _SETTLED
    return min(_SETTLED / slowest, _LONGEST / fastest)


def step_response(model: StateSpace, covariance: Covariance | None = None, *,
                  length: float | None = None, count: int = 200) -> StepResponse:
    """
    Return the step response (1) at `count` equal steps of time, with its deviation (2).

    Over `length` after the dead time [s]; as long as it moves if not given.
    """
    times = np.linspace(0.0, length if length is not None else horizon(model), count)
    n, nu, ny = model.n, model.nu, model.ny
    e = covariance.entries if covariance is not None else None
    rows = len(e.A) if e is not None else 0
    # The states, and of each row of the root what it changes of them, beside a constant 1.
    F = np.zeros((max(rows, 1), 2 * n + nu, 2 * n + nu))
    F[:, :n, :n] = F[:, n:2 * n, n:2 * n] = model.A
    F[:, :n, 2 * n:] = model.B
    if e is not None and rows:
        F[:, n:2 * n, :n], F[:, n:2 * n, 2 * n:] = e.A, e.B
    forward = expm(F * (times[1] - times[0]))
    state = np.concatenate((np.zeros((len(F), 2 * n, nu)),
                            np.broadcast_to(np.eye(nu), (len(F), nu, nu))), axis=1)
    values, changes = np.empty((count, ny, nu)), np.zeros((count, rows, ny, nu))
    with np.errstate(over='ignore', invalid='ignore'):
        for k in range(count):
            x, dx = state[0, :n], state[:, n:2 * n]
            values[k] = model.C @ x + model.D
            if e is not None and rows:
                slope = model.C @ (model.A @ x + model.B)
                changes[k] = model.C @ dx + e.C @ x + e.D - slope * e.delay[:, np.newaxis]
            state = forward @ state
        std = np.sqrt(np.sum(changes ** 2, axis=1)) if e is not None else \
            np.full_like(values, np.nan)
    return StepResponse(times, values, std)
