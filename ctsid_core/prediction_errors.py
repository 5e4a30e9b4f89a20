# SPDX-License-Identifier: Apache-2.0
"""
Prediction errors of a model in the projected domain, their likelihood and derivatives.

    E  = Y - C X - D U,           X  = (s I - A bar)^-1 (B bar U + K Y)
    dE = -C dX - dC X - dD U,     dX = (s I - A bar)^-1 (dA X + dB U + dK E - K (dC X + dD U))

with A bar = A - K C ([HD] eq. 35); tail and ones are inputs like U. K = 0 is the output-error
form. In the innovation form E = H (Y - G U), H = I - C (s I - A bar)^-1 K, the errors are white;
because the lines fill a finite band, log det of their covariance must be joined by
-2 sum log|det H|, the Jacobian of the map from outputs to errors. Without that term a fit
diverges to ever faster predictors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.base import Array, Lines, Projection, as_real
from ctsid_core.pbsid import Matrices, solve

_FLOOR = 1e-20        # error power below this fraction of the output's counts as rounding


def simulate_lines(projection: Projection, m: Matrices) -> Lines:
    """Return the outputs of a model without noise, lines of shape (ny, L)."""
    drive = m.B @ projection.u + m.tail @ projection.tail + m.x_trim @ projection.ones
    x = _resolvent(m.A, projection.s, drive)
    y: Lines = m.C @ x + m.D @ projection.u + m.y_trim @ projection.ones
    return y


def prediction_errors(projection: Projection, m: Matrices) -> Lines:
    """Return E, lines of shape (ny, L); for K = 0 the simulation's."""
    x = _resolvent(m.A - m.K @ m.C, projection.s, _drive(projection, m))
    e: Lines = projection.y - m.C @ x - m.D @ projection.u - m.y_trim @ projection.ones
    return e


def _drive(projection: Projection, m: Matrices) -> Lines:
    drive: Lines = (m.B - m.K @ m.D) @ projection.u + m.tail @ projection.tail \
        + (m.x_trim - m.K @ m.y_trim) @ projection.ones + m.K @ projection.y
    return drive


def _resolvent(A: Array, s: Lines, drive: Lines) -> Lines:
    """Return (s I - A)^-1 drive per line, in modal coordinates where those are sound."""
    poles, modes = np.linalg.eig(A)
    if np.linalg.cond(modes) < 1e10:
        found: Lines = modes @ (np.linalg.solve(modes, drive) / (s - poles[:, np.newaxis]))
        return found
    systems = s[:, np.newaxis, np.newaxis] * np.eye(len(A)) - A
    return np.asarray(np.linalg.solve(systems, drive.T[:, :, np.newaxis])[:, :, 0].T)


def output_error_cost(projection: Projection, m: Matrices) -> float:
    """Return -2 log likelihood, up to a constant, of a simulation (noise of measurement only)."""
    error = as_real(projection.y - simulate_lines(projection, m))
    count = line_weights(projection).sum()
    variance = np.maximum(np.sum(error ** 2, axis=1) / count, _floor(projection))
    return float(count * np.log(variance).sum())


def _floor(projection: Projection) -> Array:
    floor: Array = _FLOOR * np.mean(as_real(projection.y) ** 2, axis=1) + 1e-300
    return floor


def innovation_cost(projection: Projection, m: Matrices) -> float:
    """
    Return -2 log likelihood, up to the same constant as the output error's, with the model's K.

    Infinite where a pole of the predictor is closer to the imaginary axis than the lines are to
    each other, or unstable: there the likelihood is that of a single line, and without bound.
    """
    closed = m.A - m.K @ m.C
    poles = np.linalg.eigvals(closed)
    if np.max(poles.real) > -float(np.abs(projection.s[1] - projection.s[0])):
        return np.inf
    count = line_weights(projection).sum()
    error = as_real(prediction_errors(projection, m))
    covariance = error @ error.T / count + np.diag(_floor(projection))
    # det H = det(s I - A) / det(s I - A bar), because A bar + K C = A
    spread = np.sum(np.log(np.abs(projection.s - np.linalg.eigvals(m.A)[:, np.newaxis]) + 1e-300)
                    - np.log(np.abs(projection.s - poles[:, np.newaxis])), axis=0)
    return float(count * np.linalg.slogdet(covariance)[1]
                 - 2.0 * line_weights(projection) @ spread)


def line_weights(projection: Projection) -> Array:
    """Return how many real numbers each line stands for: 2, but 1 at frequency zero."""
    return np.where(projection.s == 0.0, 1.0, 2.0)


def spread_gradient(projection: Projection, m: Matrices, feedthrough: bool) -> Array:
    """Return the gradient of -2 sum log|det H| by the entries that `jacobian` lists."""
    eye, weight = np.eye(len(m.A)), line_weights(projection)
    systems = projection.s[:, np.newaxis, np.newaxis] * eye
    open_loop = np.tensordot(weight, np.linalg.inv(systems - m.A), axes=1).real
    closed = np.tensordot(weight, np.linalg.inv(systems - (m.A - m.K @ m.C)), axes=1).real
    nu, ones = len(projection.u), len(projection.ones)
    B_size = len(m.A) * (nu + len(projection.tail) + ones)
    D_size = len(m.C) * (nu * feedthrough + ones)
    gradient: Array = -2.0 * np.concatenate((
        (closed - open_loop).T.ravel(), np.zeros(B_size), -(closed @ m.K).T.ravel(),
        np.zeros(D_size), -(m.C @ closed).T.ravel()))
    return gradient


def jacobian(projection: Projection, m: Matrices, feedthrough: bool, *,
             with_noise: bool) -> Array:
    """
    Return the derivatives of -E by the entries of A, [B tail x_trim], C, [D y_trim] (and K).

    Parameters
    ----------
    projection : Projection
    m : Matrices
    feedthrough : bool
        Whether the entries of D are free.
    with_noise : bool
        Whether those of K are.

    Returns
    -------
    ndarray, shape (ny, 2 L, parameters)
    """
    z = np.vstack((projection.u, projection.tail, projection.ones))
    direct = np.vstack((projection.u, projection.ones)) if feedthrough else projection.ones
    n, ny = len(m.A), len(m.C)
    systems = projection.s[:, np.newaxis, np.newaxis] * np.eye(n) - (m.A - m.K @ m.C)
    resolvent = np.linalg.inv(systems)
    x = (resolvent @ _drive(projection, m).T[:, :, np.newaxis])[:, :, 0].T
    gain = np.moveaxis(m.C @ resolvent, 0, 2)                     # (ny, n, L): C (s I - A bar)^-1
    through = np.eye(ny)[:, :, np.newaxis] - np.einsum('jil,ik->jkl', gain, m.K)
    blocks = [gain[:, :, np.newaxis] * x, gain[:, :, np.newaxis] * z,
              through[:, :, np.newaxis] * x, through[:, :, np.newaxis] * direct]
    if with_noise:
        e = projection.y - m.C @ x - m.D @ projection.u - m.y_trim @ projection.ones
        blocks.append(gain[:, :, np.newaxis] * e)
    stacked = np.concatenate([b.reshape(ny, -1, len(projection.s)) for b in blocks], axis=1)
    return np.swapaxes(as_real(stacked.reshape(-1, len(projection.s))).reshape(
        ny, stacked.shape[1], -1), 1, 2)


def line_fit(projection: Projection, m: Matrices) -> Array:
    """
    Return the simulation fit (NRMSE) of each output, in the band of the projection [%].

    Parameters
    ----------
    projection : Projection
        The data that the model was made from.
    m : Matrices
    """
    error = as_real(projection.y - simulate_lines(projection, m))
    return _nrmse(error, _without(as_real(projection.y), as_real(projection.ones)))


def unseen_fit(projection: Projection, m: Matrices) -> Array:
    """
    Return how much of each output the inputs explain in data that the model has not seen [%].

    Parameters
    ----------
    projection : Projection
    m : Matrices

    Notes
    -----
    The states at the ends of the data are not known and are estimated from them. Lest that
    counts as explanation, the error is compared with what a constant and the same free response
    leave of the outputs with no input at all: 100 (1 - |error| / |left without inputs|).
    """
    y, ones = as_real(projection.y), as_real(projection.ones)
    unit = np.maximum(np.linalg.norm(_without(y, ones), axis=1, keepdims=True), 1e-300)
    still = replace(m, tail=np.zeros((len(m.A), len(projection.tail))))
    error = (y - as_real(simulate_lines(projection, still))) / unit
    modes = [(as_real(_free(projection, m, i, part)) / unit).ravel()
             for i in range(len(m.A)) for part in range(len(projection.tail))]
    levels = [np.kron(row, one) for row in np.eye(len(y)) for one in ones]
    return _nrmse(_beyond(error, modes), _beyond(y / unit, [*modes, *levels]))


def _beyond(y: Array, rows: list[Array]) -> Array:
    """Return what a least-squares fit of rows, each over all outputs, leaves of the outputs."""
    if not rows:
        return y
    regressors, flat = np.stack(rows), y.reshape(1, -1)
    left: Array = (flat - solve(regressors, flat, 1e-10)[0] @ regressors).reshape(y.shape)
    return left


def _without(y: Array, ones: Array) -> Array:
    if not len(ones):
        return y
    moving: Array = y - (y @ ones.T) / np.sum(ones ** 2) * ones
    return moving


def _nrmse(error: Array, moving: Array) -> Array:
    size = np.maximum(np.linalg.norm(moving, axis=1), 1e-300)
    fit: Array = 100.0 * (1.0 - np.linalg.norm(error, axis=1) / size)
    return fit


def _free(projection: Projection, m: Matrices, i: int, part: int) -> Lines:
    """Return the outputs' lines if only state i is driven, by one part's tail."""
    start = np.zeros((len(m.A), len(projection.tail)))
    start[i, part] = 1.0
    quiet = replace(m, tail=start, B=np.zeros_like(m.B), D=np.zeros_like(m.D),
                    x_trim=np.zeros_like(m.x_trim), y_trim=np.zeros_like(m.y_trim))
    return simulate_lines(projection, quiet)
