# SPDX-License-Identifier: Apache-2.0
"""
What a model does with a constant input: its gains in the end, and the step response until then.

With one pole p at 0, as far as is known, outputs settle or move at a constant rate:

    y(t) -> sum_j C P_j B u / -p_j + D u + t C P B u,   P_j, P the projectors on the modes.     (1)

Its rate C P B is known where the DC gain, C P B / -p + ..., is not. To first order P changes by

    dP = P dA S + S dA P,   S = sum_j P_j / (p - p_j).                                          (2)

(T. Kato, "Perturbation Theory for Linear Operators", chapter II, section 2.) For a unit step of an
input, and tau = t - d after its dead time,

    dx/dtau = A x + B,    y = C x + D,    x(0) = 0                                              (3)

and to first order a change dA, dB, dC, dD, dd of the entries changes it by

    d(dx)/dtau = A dx + dA x + dB,    dy = C dx + dC x + dD - C (A x + B) dd                    (4)

which is summed over the rows of the root of the covariance, and over what rivals do otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.linalg import expm

from ctsid_core.linear.types import Array, Mask
from ctsid_core.model.covariance import Covariance, gain_deviation, modes
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Signal

_TOLD = 3.0         # standard deviations from 0: a pole nearer to it may integrate
_ROUNDING = 1e-9    # of the fastest pole: what is slower is 0
_SETTLED = 10.0     # time constants of the slowest other mode
_LASTS = 5.0        # time constants of the slowest pole that a step response is shown
_GROWS = 3.0        # ... of the fastest one that grows
_LONGEST = 3000.0   # time constants of the fastest pole: more cannot be seen
_NOTHING = 0.1      # of the largest response: a gain known to less is known


@dataclass(frozen=True, eq=False)
class Gains:
    """What a constant input does to each output, in the end; NaN where that is not known."""

    value: Array    # (ny, nu): gains, or rates [1/s] where `rate` says so
    std: Array      # (ny, nu): their standard deviations
    rate: Mask      # (ny, nu): whether outputs move on, by so much a second for each input unit
    pole: float = math.nan  # of the mode that integrates [rad/s], 0 as far as is known; or NaN
    # Whether one is less sure than it is large, and than the response is large elsewhere
    vague: bool = False


def gains(model: StateSpace, covariance: Covariance | None = None) -> Gains | None:
    """Return the gains of a model; None where it has none, for a mode grows or two integrate."""
    if not (model.poles.real < 0.0).all():
        return _integrating(model, covariance)
    value, none = model.dc_gain, np.zeros((model.ny, model.nu), dtype=bool)
    if covariance is None:
        return Gains(value, np.full(value.shape, np.nan), none)
    std = gain_deviation(covariance, model)
    # Beside what the response is elsewhere a gain may be known to be nothing.
    most = np.abs(model.frequency_response(model.natural_frequency)).max(axis=0, initial=0.0)
    size = np.maximum(np.abs(value), _NOTHING * most)
    told = _TOLD * std <= size
    moving = None if told.all() else _integrating(model, covariance)
    # A gain that is told is of no mode that integrates: poles near each other are less known.
    return moving if moving and not (moving.rate & told).any() else Gains(
        value, std, none, vague=bool((std > size).any()))


def grows(model: StateSpace, covariance: Covariance | None = None) -> bool:
    """Return whether a mode grows, as far as is known."""
    return bool((model.poles.real > _uncertain(model, covariance)).any())


def _uncertain(model: StateSpace, covariance: Covariance | None) -> Array:
    """Return how far from 0 each pole may be and be at 0, (n,) [rad/s]."""
    # To first order, as deviations of gains are: a fast mode that is hardly known takes with it no
    # slow one that is.
    size = np.abs(model.poles)
    std = np.zeros(model.n) if covariance is None else \
        np.linalg.norm(covariance.pole_changes(model), axis=0)
    return np.asarray(np.maximum(_TOLD * std, _ROUNDING * np.max(size, initial=0.0)))


def _integrating(model: StateSpace, covariance: Covariance | None) -> Gains | None:
    """Return the gains (1) if modes that nobody tells from 0 move outputs at constant rates."""
    if not model.n:
        return None
    poles, right = modes(model.A)
    try:
        left = np.linalg.inv(right)
    except np.linalg.LinAlgError:
        return None
    far = _uncertain(model, covariance)[
        np.argmin(np.abs(model.poles - poles[:, np.newaxis]), axis=1)]
    still = np.abs(poles) <= far
    rest = ~still
    if not still.any() or (poles[rest].real >= 0.0).any():
        return None
    own, _ = np.linalg.qr(right[:, still])
    # Beside each other, as of axes that are alike, and not one behind another
    if np.linalg.norm(own.conj().T @ model.A @ own, 2) > np.max(far[still]):
        return None
    pole = float(np.mean(poles[still].real))
    others = right[:, rest] / (pole - poles[rest]) @ left[rest]                 # S in (2)
    P = right[:, still] @ left[still]
    value = (model.C @ P @ model.B).real
    gain = (model.C @ (right[:, rest] / -poles[rest]) @ left[rest] @ model.B).real + model.D
    std = np.full(value.shape, np.nan)
    if covariance is not None:
        e = covariance.entries
        dP = P @ e.A @ others + others @ e.A @ P
        std = np.linalg.norm(
            e.C @ P @ model.B + model.C @ dP @ model.B + model.C @ P @ e.B, axis=0)
    # While the other modes settle, and for some time more, it moves an output so far.
    slowest = np.min(np.abs(poles[rest]), initial=np.inf)
    moves = (value != 0.0) if not rest.any() else \
        _SETTLED * np.abs(value) >= np.abs(gain) * slowest
    if not (moves & ~(_TOLD * std > np.abs(value))).any():
        return None         # as of two modes that are alike
    return Gains(np.where(moves, value, gain), np.where(moves, std, np.nan), moves, pole)


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
    settling = -poles.real[poles.real < -_ROUNDING * fastest]
    rising = poles.real[poles.real > _ROUNDING * fastest]
    if len(rising):
        return min(_GROWS / float(np.max(rising)), _LONGEST / fastest)
    slowest = float(np.min(settling)) if len(settling) else fastest / _LASTS
    return min(_LASTS / slowest, _LONGEST / fastest)


def step_response(model: StateSpace, covariance: Covariance | None = None, *,
                  length: float | None = None, count: int = 200) -> StepResponse:
    """
    Return the step response (3) at `count` equal steps of time, with its deviation (4).

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
        if covariance is None:
            return StepResponse(times, values, np.full_like(values, np.nan))
        apart = [share * (_stepped(other, model.delay, times) - values) ** 2
                 for share, other in covariance.rivals]
        variance = sum((one for one in apart if np.isfinite(one).all()),
                       np.sum(changes ** 2, axis=1))
    return StepResponse(times, values, np.sqrt(variance))


def _stepped(model: StateSpace, late: Sequence[float], times: Array) -> Array:
    """Return what unit steps do at times (K,) after as late as another model has each, [s]."""
    model = replace(model, x_trim=np.zeros(model.n), y_trim=np.zeros(model.ny))
    before = -1.0 - max(late, default=0.0)
    return np.stack([model.simulate(
        [Signal(np.array([before, -delay]), np.eye(model.nu)[j] * [[0.0], [1.0]], 'zoh')],
        np.concatenate(([before], times)))[1:] for j, delay in enumerate(late)], axis=2)
