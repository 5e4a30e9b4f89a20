# SPDX-License-Identifier: Apache-2.0
"""
Maximum likelihood from an initial model, and the deviation of the poles that goes with it.

All entries of A, B, C, D (and K) move; the n^2 directions that change the realisation only are the
null space of the Jacobian, and steps and covariances of least norm leave them alone (data-driven
local coordinates: McKelvey, Helmersson and Ribarits 2004, Automatica 40).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.base import Array, Lines, Projection, as_real
from ctsid_core.matrix_functions import svd
from ctsid_core.pbsid import Matrices, solve
from ctsid_core.prediction_errors import (
    innovation_cost,
    jacobian,
    line_weights,
    output_error_cost,
    prediction_errors,
    spread_gradient,
)

_RANK = 1e-7          # relative singular value of the Jacobian below which a direction is gauge
_REDUNDANT = 1e-9     # the trim acts through every state alike, and through y: dependent
_LEAST_GAIN = 1e-2    # -2 log likelihood: smaller gains are not worth another step
_HALVINGS = 5
_WORK = 1e9           # multiplications of one step beyond which models are not refined
_DAMPINGS = 8         # tries with ten times the damping each


def realise_poles(projection: Projection, poles: NDArray[np.complex128],
                  feedthrough: bool) -> Matrices:
    """
    Return the model in modal form whose simulation with given poles explains the outputs best.

    Parameters
    ----------
    projection : Projection
    poles : ndarray, shape (n,)
        Real, or in conjugate pairs, distinct [rad/s].
    feedthrough : bool

    Notes
    -----
    Residues are linear in the data; each is then replaced by its nearest matrix of rank one.
    """
    z = np.vstack((projection.u, projection.tail, projection.ones))
    direct = np.vstack((projection.u, projection.ones)) if feedthrough else projection.ones
    upper = poles[poles.imag >= 0.0]
    blocks = [z * _shape(p, projection.s, part) for p in upper for part in _parts(p)]
    theta, _ = solve(as_real(np.vstack((*blocks, direct))), as_real(projection.y), _REDUNDANT)
    size = 1.0 / np.maximum(np.linalg.norm(projection.y, axis=1), 1e-300)
    reach = np.maximum(np.linalg.norm(z, axis=1), 1e-300)
    rows, width, first = [], len(z), 0
    for p in upper:
        residue = theta[:, first:first + width].astype(complex)
        if p.imag > 0.0:
            residue = residue - 1j * theta[:, first + width:first + 2 * width]
        first += width * len(_parts(p))
        left, s, right = np.linalg.svd(size[:, np.newaxis] * residue * reach)
        root = np.sqrt(s[0])
        rows.append((p, root * left[:, 0] / size, root * right[0] / reach))
    return _modal(rows, theta[:, first:], projection, feedthrough)


def _parts(pole: complex) -> tuple[int, ...]:
    return (0, 1) if pole.imag > 0.0 else (0,)


def _shape(pole: complex, s: Lines, part: int) -> Lines:
    """
    Return a real pole's 1/(s - p), or a pair's combinations with real weights r1, r2.

    r1 and r2 belong to the residue r1 - i r2 at p: Re r / ((s-p)(s-p*)) in partial fractions.
    """
    if pole.imag == 0.0:
        return 1.0 / (s - pole.real)
    first, second = 1.0 / (s - pole), 1.0 / (s - pole.conjugate())
    shape: Lines = first + second if part == 0 else -1j * (first - second)
    return shape


def _modal(rows: list[tuple[complex, NDArray[np.complex128], NDArray[np.complex128]]],
           direct: Array, projection: Projection, feedthrough: bool) -> Matrices:
    """Join modes (pole, output direction, input direction) in a real block-diagonal model."""
    A_blocks, B_rows, C_columns = [], [], []
    for p, c, b in rows:
        if p.imag == 0.0:
            A_blocks.append(np.array([[p.real]]))
            B_rows.append(b.real[np.newaxis])
            C_columns.append(c.real[:, np.newaxis])
        else:
            A_blocks.append(np.array([[p.real, -p.imag], [p.imag, p.real]]))
            B_rows.append(np.stack((b.real, b.imag)))
            C_columns.append(np.stack((2.0 * c.real, -2.0 * c.imag), axis=1))
    n = sum(len(block) for block in A_blocks)
    A, first = np.zeros((n, n)), 0
    for block in A_blocks:
        A[first:first + len(block), first:first + len(block)] = block
        first += len(block)
    B, C = np.vstack(B_rows), np.hstack(C_columns)
    nu, tail, ny = len(projection.u), len(projection.tail), len(projection.y)
    feed = direct[:, :nu] if feedthrough else np.zeros((ny, nu))
    return Matrices(A=A, B=B[:, :nu], C=C, D=feed, K=np.zeros((n, ny)), tail=B[:, nu:nu + tail],
                    x_trim=B[:, nu + tail:], y_trim=direct[:, nu * feedthrough:])


def refine_output_error(projection: Projection, start: Matrices, feedthrough: bool,
                        limit: float = np.inf, steps: int = 10) -> tuple[Matrices, float]:
    """
    Take a model to the maximum of the output-error likelihood.

    Parameters
    ----------
    projection : Projection
    start : Matrices
    feedthrough : bool
    limit : float
        Steps may not take the real part of a pole beyond this [rad/s].
    steps : int
        Gauss-Newton steps at most.

    Returns
    -------
    model : Matrices
        With K = 0.
    cost : float
        -2 log likelihood.
    """
    model = replace(start, K=np.zeros_like(start.K))
    cost = output_error_cost(projection, model)
    for _ in range(steps):
        step = _gauss_newton(projection, model, feedthrough)
        for halving in range(_HALVINGS):
            trial = _moved(model, step * 0.5 ** halving, feedthrough)
            new = output_error_cost(projection, trial)
            if new < cost and growth(trial) <= limit:
                break
        else:
            return model, cost
        model, gain, cost = trial, cost - new, new
        if gain < _LEAST_GAIN:
            break
    return model, cost


def best_simulation(projection: Projection, start: Matrices, poles: NDArray[np.complex128],
                    feedthrough: bool, limit: float) -> tuple[Matrices, float]:
    """
    Return the output-error maximum reached from a model and from given poles, and its cost.

    Parameters
    ----------
    projection : Projection
    start : Matrices
    poles : ndarray, shape (n,)
        From which a second start is made if they are distinct [rad/s].
    feedthrough : bool
    limit : float
        Largest real part allowed to a pole [rad/s].

    Notes
    -----
    Models too large to be refined (`affordable`) are returned as they are.
    """
    if not affordable(projection, len(poles)):
        still = replace(start, K=np.zeros_like(start.K))
        return still, output_error_cost(projection, still)
    starts = [start]
    if len(set(np.round(poles, 12))) == len(poles):
        starts.append(realise_poles(projection, poles, feedthrough))
    return min((refine_output_error(projection, s, feedthrough, limit) for s in starts),
               key=lambda found: found[1])


def affordable(projection: Projection, n: int) -> bool:
    """Return whether models of order n, with so many signals, are refined at all."""
    ny, driven = len(projection.y), len(projection.u) + len(projection.tail) + len(projection.ones)
    parameters = n * (n + driven + 2 * ny) + ny * driven
    return bool(2.0 * len(projection.s) * ny * parameters ** 2 < _WORK)


def _gauss_newton(projection: Projection, m: Matrices, feedthrough: bool) -> Array:
    error = as_real(prediction_errors(projection, m))
    size = np.sqrt(np.mean(error ** 2, axis=1, keepdims=True)) + 1e-150
    columns = jacobian(projection, m, feedthrough, with_noise=False) / size[:, np.newaxis]
    left, s, right, norm = _directions(columns.reshape(-1, columns.shape[2]),
                                       (error / size).ravel())
    found: Array = right.T @ (left / s) / norm
    return found


def _directions(flat: Array, error: Array) -> tuple[Array, Array, Array, Array]:
    """
    Return what of the errors lies along each direction that the data determine.

    Parameters
    ----------
    flat : ndarray, shape (N, parameters)
        Jacobian; columns of zeros belong to entries that do not move.
    error : ndarray, shape (N,)

    Returns
    -------
    along, s : ndarray, shape (r,)
        Left singular vectors times the errors, and singular values.
    right : ndarray, shape (r, parameters)
    norm : ndarray, shape (parameters,)
        What the columns were divided by.
    """
    norm = np.linalg.norm(flat, axis=0)
    norm[norm == 0.0] = np.inf
    size = np.linalg.norm(error) + 1e-300
    triangle = np.linalg.qr(np.column_stack((flat / norm, error / size)), mode='r')
    left, s, right = svd(triangle[:, :-1])
    kept = s > _RANK * s[0]
    return size * (triangle[:, -1] @ left[:, kept]), s[kept], right[kept], norm


def refine_innovation(projection: Projection, start: Matrices, feedthrough: bool, *,
                      limit: float = np.inf, plant: bool = True,
                      steps: int = 20) -> tuple[Matrices, float]:
    """
    Take a model with its K to the maximum of the innovation-form likelihood.

    Parameters
    ----------
    projection : Projection
    start : Matrices
    feedthrough : bool
    limit : float
        Steps may not take the real part of a pole beyond this [rad/s].
    plant : bool
        Whether A, B, C and D move, or K and the states at the ends of the window only.
    steps : int
        Levenberg-Marquardt steps at most.

    Returns
    -------
    model : Matrices
    cost : float
        -2 log likelihood; infinite if the start is not admissible (see `innovation_cost`).
    """
    model, cost, damping = start, innovation_cost(projection, start), 1e-5
    if not np.isfinite(cost):
        return model, cost
    for _ in range(steps):
        found = _curvature(projection, model, feedthrough, plant)
        if found is None:
            return model, cost
        right, s, pull, norm = found
        for _try in range(_DAMPINGS):
            step = right.T @ (pull / (s ** 2 + damping * s[0] ** 2)) / norm
            trial = _moved(model, step, feedthrough)
            new = innovation_cost(projection, trial)
            if new < cost and growth(trial) <= limit:
                break
            damping = 10.0 * max(damping, 1e-8)
        else:
            return model, cost
        model, gain, cost, damping = trial, cost - new, new, 0.1 * damping
        if gain < _LEAST_GAIN:
            break
    return model, cost


def growth(m: Matrices) -> float:
    """Return the largest real part of the poles [rad/s]."""
    return float(np.max(np.linalg.eigvals(m.A).real))


def _curvature(projection: Projection, m: Matrices, feedthrough: bool, plant: bool,
               ) -> tuple[Array, Array, Array, Array] | None:
    """
    Return the scaled Jacobian's right singular vectors and values, the pull, the scaling.

    None if the model is at the border of what can be computed.
    """
    flat, error = _whitened(projection, m, feedthrough, with_noise=True)
    if not plant:
        flat = flat * _noise_entries(m, flat.shape[1])
    if not (np.isfinite(flat).all() and np.isfinite(error).all()):
        return None
    along, s, right, norm = _directions(flat, error)
    gradient = spread_gradient(projection, m, feedthrough) / norm
    return right, s, s * along - 0.5 * right @ gradient, norm


def _noise_entries(m: Matrices, parameters: int) -> Array:
    """Return 1 for the entries of K and of the tail in the order of `jacobian`, else 0."""
    n, nu = m.B.shape
    width = nu + m.tail.shape[1] + m.x_trim.shape[1]
    B = np.zeros((n, width))
    B[:, nu:nu + m.tail.shape[1]] = 1.0
    mask = np.zeros(parameters)
    mask[n * n:n * n + n * width] = B.ravel()
    mask[parameters - m.K.size:] = 1.0
    return mask


def _whitened(projection: Projection, m: Matrices, feedthrough: bool, *,
              with_noise: bool) -> tuple[Array, Array]:
    """Return Jacobian (ny N, parameters) and errors (ny N,), of unit covariance over outputs."""
    error = as_real(prediction_errors(projection, m))
    covariance = error @ error.T / line_weights(projection).sum()
    scale = np.sqrt(np.diag(covariance)) + 1e-150
    root = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    whiten = np.linalg.inv(root) / scale
    columns = jacobian(projection, m, feedthrough, with_noise=with_noise)
    flat = np.tensordot(whiten, columns, axes=1).reshape(-1, columns.shape[2])
    return flat, (whiten @ error).ravel()


def _moved(m: Matrices, step: Array, feedthrough: bool) -> Matrices:
    """Add a step to the entries of a model, in the order in which `jacobian` lists them."""
    n, ny, nu = len(m.A), len(m.C), m.B.shape[1]
    tail, ones, feed = m.tail.shape[1], m.x_trim.shape[1], nu * feedthrough
    sizes = [n * n, n * (nu + tail + ones), ny * n, ny * (feed + ones)]
    dA, dB, dC, dD, dK = np.split(step, np.cumsum(sizes))
    B, D = dB.reshape(n, -1), dD.reshape(ny, -1)
    return replace(
        m, A=m.A + dA.reshape(n, n), C=m.C + dC.reshape(ny, n), B=m.B + B[:, :nu],
        tail=m.tail + B[:, nu:nu + tail], x_trim=m.x_trim + B[:, nu + tail:],
        D=m.D + D[:, :feed] if feed else m.D, y_trim=m.y_trim + D[:, feed:],
        K=m.K + dK.reshape(n, ny) if len(dK) else m.K)


def pole_deviation(projection: Projection, m: Matrices, feedthrough: bool) -> Array:
    """
    Return the asymptotic standard deviation of the poles, in the order of `eigvals(m.A)`.

    Parameters
    ----------
    projection : Projection
    m : Matrices
        K = 0 means output error.
    feedthrough : bool

    Returns
    -------
    ndarray, shape (n,)
        Square root of the expected |error|^2 of an efficient estimator (the Cramer-Rao bound at
        this model and its noise level) [rad/s]; a plain subspace estimate scatters more.
    """
    flat, error = _whitened(projection, m, feedthrough, with_noise=bool(np.any(m.K)))
    _, s, right, norm = _directions(flat, error)
    spare = max(1.0 - len(s) / len(flat), len(m.C) / len(flat))
    root = right / s[:, np.newaxis] / norm                        # covariance = root^T root
    _, modes = np.linalg.eig(m.A)
    left = np.linalg.inv(modes)
    n = len(m.A)
    change = np.stack([np.outer(left[i], modes[:, i]).ravel() for i in range(n)])
    deviation: Array = np.linalg.norm(change @ root[:, :n * n].T, axis=1) / np.sqrt(spare)
    return deviation
