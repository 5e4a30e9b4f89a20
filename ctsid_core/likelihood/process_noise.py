# SPDX-License-Identifier: Apache-2.0
"""
A first guess of the process noise: what leaves the residuals that a simulation leaves.

The power of these residuals, line by line, is that of measurement noise plus that of every cause
of motion, seen through the plant,

    |e|^2 = r + sum_i q_i |C (s I - A)^-1 g_i|^2,     q_i >= 0

a linear regression. Causes are the modes, each driven separately, and the inputs. Their sum is the
Q of a Riccati equation, which gives K. From there the maximum of the likelihood is near.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solve_continuous_are
from scipy.optimize import nnls

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.likelihood.prediction_errors import jacobian, predict, simulate_lines
from ctsid_core.likelihood.refine import by_parameter
from ctsid_core.likelihood.window_ends import line_distance
from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import resolvent
from ctsid_core.linear.types import Array, Lines

_SMOOTHING = 9        # lines over which the residuals' power is averaged at first
_ROUNDS = 3           # of the regression, weighted by what the last one found
_QUIET = 0.05         # of the residuals' power is measurement noise at least
_WORTH = 0.5          # of Schwarz's price of K is gained at least, or else there is no K
_NOTHING = 1e-6       # residuals over outputs that are those of the basis, and of rounding
_DAMPED = 1.5         # distances of lines: least damping of the predictor


def with_process_noise(projection: Projection, m: Matrices,
                       feedthrough: bool) -> Matrices | None:
    """
    Give a simulation's model the K of the process noise that its residuals show, if any.

    Parameters
    ----------
    projection : Projection
    m : Matrices
        Its K does not matter.
    feedthrough : bool

    Returns
    -------
    Matrices or None
        With the same A and C, and the B, D, trim and tail that go with K best. None if residuals
        are white or nothing, or if the Riccati equation has no solution.
    """
    error = projection.y - simulate_lines(projection, m)
    size = np.sqrt(np.mean(as_real(error) ** 2, axis=1)) + 1e-150
    if projection.bent and (size <= _NOTHING * np.sqrt(
            np.mean(as_real(projection.y) ** 2, axis=1))).all():
        return None
    power = 0.5 * np.sum(np.abs(error / size[:, np.newaxis]) ** 2, axis=0)
    gain = resolvent(m.A, projection.s).outputs(m.C) / size[:, np.newaxis]
    causes = _causes(m)
    shapes = np.stack([np.full(len(power), float(len(size))),
                       *(_power_through(gain, Q) for Q in causes)])
    weights = _shares(shapes, power, [len(record.s) for record in projection.records])
    if _surplus(power, weights @ shapes, projection.weights) < _WORTH * m.K.size * np.log(
            projection.count * len(size)):
        return None
    C, quiet = m.C / size[:, np.newaxis], _QUIET * power.mean() / len(size)
    R = max(float(weights[0]), quiet) * np.eye(len(size))
    Q = np.tensordot(weights[1:], causes, axes=1)
    Q += 1e-9 * (np.trace(Q) + 1e-300) * np.eye(len(Q))
    A = m.A + _DAMPED * line_distance(projection) * np.eye(len(Q))
    try:
        P = solve_continuous_are(A.T, C.T, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return None
    K = np.linalg.solve(R, C @ P).T / size
    return with_linear_entries(projection, replace(m, K=K), feedthrough)


def _surplus(power: Array, level: Array, weights: Array) -> float:
    """Return how much more likely lines are with powers that vary than with one for all."""
    mean = np.full_like(power, np.average(power, weights=weights))
    return float(weights @ (np.log(mean / level) + power / mean - power / level))


def _causes(m: Matrices) -> Array:
    """Return what each mode and each input, driven by white noise, adds to Q."""
    poles, modes = np.linalg.eig(m.A)
    columns = np.hstack((modes[:, poles.imag >= 0.0], m.B))
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.stack([np.outer(g, g.conj()).real for g in columns.T])


def _power_through(gain: Lines, Q: Array) -> Array:
    """Return the power that white noise Q of the states gives the outputs, line by line."""
    through = np.tensordot(Q, gain, axes=1)
    power: Array = np.sum(through * gain.conj(), axis=(0, 1)).real
    return power


def _smoothed(power: Array) -> Array:
    half = _SMOOTHING // 2
    padded = np.pad(power, half, mode='reflect' if len(power) > half else 'edge')
    return np.convolve(padded, np.full(_SMOOTHING, 1.0 / _SMOOTHING), 'valid')


def _shares(shapes: Array, power: Array, lengths: list[int]) -> Array:
    """
    Return the weights >= 0 with which shapes (k, L) explain the power (L,) of noise best.

    The lines of each record, `lengths` many, are neighbours.
    """
    scale = shapes.mean(axis=1) + 1e-300
    shapes = shapes / scale[:, np.newaxis]
    level = np.concatenate([_smoothed(own) for own in
                            np.split(power, np.cumsum(lengths)[:-1])])
    found = np.zeros(len(shapes))
    for _ in range(_ROUNDS):            # the deviation of a line's power is in proportion to it
        try:
            found = nnls((shapes / level).T, power / level)[0]
        except RuntimeError:            # no end of its iterations
            break
        level = np.maximum(found @ shapes, 1e-3 * power.mean())
    return np.asarray(found / scale)


def with_linear_entries(projection: Projection, m: Matrices, feedthrough: bool, *,
                        ends_only: bool = False) -> Matrices:
    """Return the model with the best B, D, trim and tail (or tail alone), given the rest."""
    prediction = predict(projection, m, resolvent(m.A - m.K @ m.C, projection.s))
    error = as_real(prediction.error)
    size = np.sqrt(np.mean(error ** 2, axis=1)) + 1e-150
    rows = by_parameter(jacobian(projection, m, feedthrough, with_noise=False,
                                 whiten=np.diag(1.0 / size), prediction=prediction))
    entries = FreeEntries.of(m, feedthrough)
    linear = entries.mask('tail') if ends_only else \
        entries.mask('B', 'tail', 'x_trim', 'D', 'y_trim')
    step = np.zeros(len(rows))
    whitened = (error / size[:, np.newaxis]).reshape(1, -1)
    step[linear] = least_norm(rows[linear], whitened, 1e-9)[0]
    return entries.moved(m, step)
