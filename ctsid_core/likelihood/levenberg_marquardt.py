# SPDX-License-Identifier: Apache-2.0
"""
Levenberg-Marquardt: damped Gauss-Newton steps to the maximum of a likelihood.

The equations of a step are products of derivatives. They have half the digits of a factorisation
of the derivatives themselves; that slows the last steps in directions which the data hardly tell,
but the gradient is as exact as ever, and so is where they end. Damping, however small, keeps steps
from ctsid_core.linear.types import Array
from where the products say nothing: the realisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array

LEAST_DAMPING = 1e-13   # relative: rounding of the products
_LEAST_GAIN = 1e-2      # -2 log likelihood: smaller gains are not worth another step
_NEAR = 1.0             # promised gain below which a step's promise can be relied on
_HOPE = 10.0            # times its promise: the most that the third step and all later ones gain
_BEYOND = 1e150         # numbers whose squares are near the end of the range
_TRIES = 8              # of a step, with ten times the damping each

P = TypeVar('P')
Predicted = TypeVar('Predicted', covariant=True)


class Likelihood(Protocol[Predicted]):
    """What a model is worth, and what was found on the way (None: not admissible)."""

    @property
    def cost(self) -> float:
        """-2 log likelihood."""

    @property
    def prediction(self) -> Predicted | None:
        """What the equations of a step need."""

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Of A [rad/s]."""


@dataclass(frozen=True)
class NormalEquations:
    """
    Products of the derivatives, scaled to unit norm, among each other and with the errors.

    Parameters
    ----------
    gram : ndarray, shape (parameters, parameters)
    pull : ndarray, shape (parameters,)
        Half the slope of the likelihood.
    norm : ndarray, shape (parameters,)
        What the derivatives were divided by; infinite where a parameter does nothing.
    """

    gram: Array
    pull: Array
    norm: Array


def normal_equations(rows: Array, error: Array) -> NormalEquations:
    """Return the equations of a step for derivatives (parameters, N) and errors (N,)."""
    with np.errstate(over='ignore'):
        gram = rows @ rows.T
    if not np.isfinite(gram).all() and np.isfinite(rows).all():
        # Beyond the range of squares: of unit norm first.
        norm = np.linalg.norm(rows / _BEYOND, axis=1) * _BEYOND
        found = normal_equations(rows / np.where(norm > 0.0, norm, 1.0)[:, np.newaxis], error)
        return NormalEquations(found.gram, found.pull, np.where(norm > 0.0, norm, np.inf))
    norm = np.sqrt(np.diag(gram))
    norm[norm == 0.0] = np.inf
    return NormalEquations(gram / norm / norm[:, np.newaxis], (rows @ error) / norm, norm)


def scaled_equations(gram: Array, pull: Array) -> NormalEquations:
    """Return the equations of a step for products of derivatives that are not of unit norm."""
    norm = np.sqrt(np.diag(gram))
    norm[norm == 0.0] = np.inf
    return NormalEquations(gram / norm / norm[:, np.newaxis], pull / norm, norm)


def _damped(equations: NormalEquations, damping: float) -> Array:
    """
    Return the solution of (gram + damping) step = pull.

    The damping is relative to the norm of the products, and raised if rounding asks for it.
    """
    gram = equations.gram
    least = max(damping, LEAST_DAMPING) * np.linalg.norm(gram)
    for more in (1.0, 1e2, 1e4):
        _, step, info = dposv(gram + more * least * np.eye(len(gram)), equations.pull)
        if info == 0:
            return np.asarray(step)
    return np.zeros_like(equations.pull)


def climb(model: Matrices, likelihood: Callable[[Matrices], Likelihood[P]],
          curvature: Callable[[Matrices, P], NormalEquations | None],
          move: Callable[[Matrices, Array], Matrices], *, limit: float, steps: int,
          damping: float, rival: float = np.inf) -> tuple[Matrices, float]:
    """
    Take a model to the maximum of a likelihood by damped Gauss-Newton steps.

    Parameters
    ----------
    model : Matrices
    likelihood : callable
        Of a model.
    curvature : callable
        From a model and its prediction to the equations of a step; None where there are none.
    move : callable
        Adds a step to the parameters of a model.
    limit : float
        Steps may not take the real part of a pole beyond this [rad/s].
    steps : int
        At most.
    damping : float
        Of the first step, relative.
    rival : float
        Cost of another model: given up as soon as it is clear that it will not be beaten.

    Returns
    -------
    model : Matrices
    cost : float
        -2 log likelihood.
    """
    here, before = likelihood(model), 0.0
    for made in range(steps):
        equations = curvature(model, here.prediction) if here.prediction else None
        if equations is None:
            break
        for _try in range(_TRIES):
            step = _damped(equations, damping)
            promise = float(equations.pull @ step)
            hope = promise if promise < _NEAR else _HOPE * promise if made > 1 else np.inf
            if here.cost - hope > rival - _LEAST_GAIN:
                return model, here.cost
            trial = move(model, step / equations.norm)
            there = likelihood(trial)
            if there.cost < here.cost and np.max(there.poles.real) <= limit:
                break
            if promise < _LEAST_GAIN:
                return model, here.cost
            damping = 10.0 * max(damping, 1e-8)
        else:
            break
        model, gain, here, damping = trial, here.cost - there.cost, there, 0.1 * damping
        if _arrived(gain, before, promise):
            break
        before = gain
    return model, here.cost


def _arrived(gain: float, before: float, promise: float) -> bool:
    """
    Return whether the next step is not worth its while.

    Its gain is extrapolated from the last two; but in a curved valley gains are small on the way,
    of steps that promised much.
    """
    slow = promise < _NEAR and gain * gain < _LEAST_GAIN * min(before, _NEAR)
    return gain < _LEAST_GAIN or slow
