# SPDX-License-Identifier: Apache-2.0
"""
The likelihoods of many models of one order at once.

Each is what `prediction_errors.py` says of one model. Arrays of a candidate are small, so that
most of the time goes into calls; stacked arrays need one call for all candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.likelihood.prediction_errors import (
    innovation_cost,
    least_power,
    log_det,
    output_error_cost,
    spread,
)
from ctsid_core.likelihood.window_ends import LEAST_DAMPING, ends_cost, line_distance
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import SOUND, away
from ctsid_core.linear.types import Array, Lines


@dataclass(frozen=True)
class _Stack:
    """Models one behind the other, each entry of `Matrices` of shape (k, ...)."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    tail: Array
    x_trim: Array
    y_trim: Array


def innovation_costs(projection: Projection, models: Sequence[Matrices]) -> Array:
    """
    Return `innovation_cost` of each model.

    Parameters
    ----------
    projection : Projection
    models : sequence of Matrices
        Of the same order.

    Returns
    -------
    ndarray, shape (k,)
        -2 log likelihood, infinite where a model is not admissible.
    """
    if len(models) < 2:
        return np.array([innovation_cost(projection, m) for m in models])
    stack = _stacked(models)
    found = _errors(projection, stack, with_noise=True)
    if found is None:
        return np.array([innovation_cost(projection, m) for m in models])
    errors, closed, sound = found
    real = errors.view(np.float64)
    covariance = real @ real.transpose(0, 2, 1) / projection.count
    plant = np.linalg.eigvals(stack.A).astype(complex)
    costs = np.full(len(models), np.inf)
    good = np.max(closed.real, axis=1) <= -LEAST_DAMPING * line_distance(projection)
    costs[good] = (projection.count * log_det(projection, covariance[good])
                   + spread(projection, plant[good], closed[good])
                   + ends_cost(projection, closed[good], plant[good]))
    for i in np.flatnonzero(~sound):
        costs[i] = innovation_cost(projection, models[int(i)])
    return costs


def output_error_costs(projection: Projection, models: Sequence[Matrices]) -> Array:
    """
    Return `output_error_cost` of each model.

    Parameters
    ----------
    projection : Projection
    models : sequence of Matrices
        Of the same order.

    Returns
    -------
    ndarray, shape (k,)
    """
    found = _errors(projection, _stacked(models), with_noise=False) if len(models) > 1 else None
    if found is None:
        return np.array([output_error_cost(projection, m) for m in models])
    errors, _, sound = found
    real = errors.view(np.float64)
    power = np.einsum('kij,kij->ki', real, real) / projection.count
    costs: Array = projection.count * np.log(
        np.maximum(power, least_power(projection))).sum(axis=1)
    for i in np.flatnonzero(~sound):
        costs[i] = output_error_cost(projection, models[int(i)])
    return costs


def _stacked(models: Sequence[Matrices]) -> _Stack:
    return _Stack(*(np.stack([getattr(m, name) for m in models])
                    for name in ('A', 'B', 'C', 'D', 'K', 'tail', 'x_trim', 'y_trim')))


def _errors(projection: Projection, m: _Stack, *, with_noise: bool,
            ) -> tuple[Lines, NDArray[np.complex128], NDArray[np.bool_]] | None:
    """
    Return all errors (k, ny, L), the predictors' poles (k, n), and which have sound modes.

    None if the modes of one of them cannot be computed.
    """
    if not with_noise:
        m = replace(m, K=np.zeros_like(m.K))
    poles, modes = np.linalg.eig(m.A - m.K @ m.C)
    try:
        inverse = np.linalg.inv(modes)
    except np.linalg.LinAlgError:
        return None
    size = np.linalg.norm(modes, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
    signals = as_real(projection.signals)
    enter = np.concatenate((m.B - m.K @ m.D, m.tail, m.x_trim - m.K @ m.y_trim, m.K), axis=2)
    drive = (enter @ signals).view(np.complex128)
    x = modes @ ((inverse @ drive) * away(projection.s - poles[:, :, np.newaxis]))
    leave = np.concatenate((m.D, np.zeros((*m.D.shape[:2], m.tail.shape[2])), m.y_trim), axis=2)
    direct = leave @ signals[:leave.shape[2]]
    errors = np.ascontiguousarray(projection.y - m.C @ x - direct.view(np.complex128))
    return errors, poles.astype(complex), size < SOUND
