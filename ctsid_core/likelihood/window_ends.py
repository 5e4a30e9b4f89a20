# SPDX-License-Identifier: Apache-2.0
"""
What a likelihood owes to the states at the ends of the window.

These states are free. A pole of the predictor that decays more slowly than the lines are apart
lets them explain a whole line: the likelihood then grows without bound, and on the way there it
prefers predictors of long memory. The restricted likelihood (Patterson and Thompson 1971,
Biometrika 58) integrates over what is free and adds log det of its information, for one output

    - sum_ij log |p_i + p_j| - sum_i log tanh(pi d_i),

p the poles of the predictor, d their damping in units of the distance of the lines: the first sum
is the determinant of an observability Gramian, the second the correction for lines instead of an
integral. Less the first sum for the poles of the plant, as far as the window resolves them:
states are measured by what they contribute to the outputs of a simulation, and without K next to
nothing is added where all poles decay within the window.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection
from ctsid_core.linear.resolvent import Resolvent
from ctsid_core.linear.types import Array

LEAST_DAMPING = 0.1   # of a predictor, in distances of lines

_Poles = NDArray[np.complex128]


def line_distance(projection: Projection) -> float:
    """
    Return how far the first lines are apart [rad/s]: what the window resolves.

    Of several records, what the longest one does.
    """
    return min(float(np.abs(p.s[1] - p.s[0])) for p in projection.records)


def ends_cost(projection: Projection, predictor: _Poles, plant: _Poles) -> Array:
    """
    Return what the ends of the window add to -2 log likelihood.

    Parameters
    ----------
    projection : Projection
    predictor : ndarray, shape (..., n)
        Poles of A - K C, stable [rad/s]; any number of models.
    plant : ndarray, shape (..., n)
        Those of A.
    """
    cost, gramian = np.zeros(predictor.shape[:-1]), _gramian(predictor)
    for record in projection.records:
        apart = line_distance(record)
        known = gramian - _gramian(_resolved(plant, apart))
        known -= np.log(np.tanh(-np.pi * predictor.real / apart)).sum(axis=-1)
        cost = cost + len(record.tail) * known
    return np.asarray(cost)


def ends_cost_of_simulation(projection: Projection, plant: _Poles) -> float:
    """Return the same for K = 0, where growing poles count like decaying ones."""
    damping = np.maximum(np.abs(plant.real), LEAST_DAMPING * line_distance(projection))
    poles = np.asarray(1j * plant.imag - damping, dtype=complex)
    return float(ends_cost(projection, poles, plant))


def ends_slopes(projection: Projection, predictor: Resolvent,
                plant: Resolvent) -> tuple[Array, Array]:
    """
    Return the derivatives of `ends_cost`.

    Parameters
    ----------
    projection : Projection
    predictor, plant : Resolvent
        Of A - K C and of A.

    Returns
    -------
    by_predictor, by_plant : ndarray, shape (n, n)
        S, where trace(S dA) is the change with the matrix A; zero where poles coincide.
    """
    p = predictor.poles
    by_predictor, by_plant = np.zeros(len(p), dtype=complex), np.zeros(len(p), dtype=complex)
    for record in projection.records:
        apart, count = line_distance(record), len(record.tail)
        q = _resolved(plant.poles, apart)
        by_predictor += count * (_gramian_slope(p) + 2.0 * np.pi / apart / np.sinh(
            np.minimum(-2.0 * np.pi * p.real / apart, 300.0)))
        slope = _gramian_slope(q)
        by_plant -= count * (slope.real * plant.poles.real / q.real + 1j * slope.imag)
    return _by_matrix(predictor, by_predictor), _by_matrix(plant, by_plant)


def _gramian(p: _Poles) -> Array:
    sums = np.abs(p[..., :, np.newaxis] + p[..., np.newaxis, :])
    return np.asarray(-np.log(sums).sum(axis=(-2, -1)))


def _gramian_slope(p: _Poles) -> _Poles:
    slope: _Poles = -2.0 * np.sum(1.0 / (p[:, np.newaxis] + p), axis=1)
    return slope


def _resolved(poles: _Poles, apart: float) -> _Poles:
    """Return poles with the damping, be it negative, that the window makes of theirs."""
    found: _Poles = -np.hypot(poles.real, apart) + 1j * poles.imag
    return found


def _by_matrix(at: Resolvent, by_pole: _Poles) -> Array:
    if at.modes is None or at.inverse is None:
        return np.zeros((len(at.poles), len(at.poles)))
    found: Array = ((at.modes * by_pole) @ at.inverse).real
    return found
