# SPDX-License-Identifier: Apache-2.0
"""
Maximum likelihood from an initial model.

All entries of A, B, C, D (and K) move; the n^2 directions that change the realisation only are the
null space of the Jacobian, and steps of least norm leave them alone (data-driven local
coordinates: McKelvey, Helmersson and Ribarits 2004, Automatica 40).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.likelihood.levenberg_marquardt import (
    LEAST_DAMPING,
    NormalEquations,
    climb,
    normal_equations,
)
from ctsid_core.likelihood.prediction_errors import (
    OWN,
    Prediction,
    innovation,
    jacobian,
    output_error,
    output_error_cost,
    predict,
    prediction_errors,
    spread_gradient,
)
from ctsid_core.likelihood.record_equations import equation_work, record_equations
from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.least_squares import solve
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import away, resolvent
from ctsid_core.linear.types import Array, Lines

_REDUNDANT = 1e-9     # the trim acts through every state alike, and through y: dependent
_DAMPING = 1e-5       # of an innovation form's first step, relative
MOST_WORK = 1e9           # multiplications of one step beyond which models are not refined


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
        return away(s - pole.real)
    first, second = away(s - pole), away(s - pole.conjugate())
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
                        limit: float = np.inf, steps: int = 10,
                        rival: float = np.inf) -> tuple[Matrices, float]:
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
        At most.
    rival : float
        Cost of another model: given up as soon as it is clear that it will not be beaten.

    Returns
    -------
    model : Matrices
        With K = 0.
    cost : float
        -2 log likelihood.
    """
    def curvature(m: Matrices, prediction: Prediction) -> NormalEquations:
        error = as_real(prediction.error)
        size = np.sqrt(np.mean(error ** 2, axis=1)) + 1e-150
        if projection.members:
            return record_equations(projection, m, prediction, np.diag(1.0 / size), feedthrough,
                                    with_noise=False)
        columns = jacobian(projection, m, feedthrough, with_noise=False,
                           whiten=np.diag(1.0 / size), prediction=prediction)
        return normal_equations(by_parameter(columns), (error / size[:, np.newaxis]).ravel())

    still = replace(start, K=np.zeros_like(start.K))
    return climb(still, lambda m: output_error(projection, m), curvature,
                 FreeEntries.of(still, feedthrough).moved, limit=limit, steps=steps,
                 damping=LEAST_DAMPING, rival=rival)


def best_simulation(projection: Projection, start: Matrices, poles: NDArray[np.complex128],
                    feedthrough: bool, limit: float, good: float = -np.inf,
                    ) -> tuple[Matrices, float]:
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
    good : float
        Cost of a model from the poles that needs no rival from another start.

    Notes
    -----
    Models too large to be refined (`affordable`) are returned as they are.
    """
    if not affordable(projection, len(poles)):
        still = replace(start, K=np.zeros_like(start.K))
        return still, output_error_cost(projection, still)
    starts = [start]
    if distinct(poles):
        starts.append(realise_poles(projection, poles, feedthrough))
    model, cost = refine_output_error(projection, starts[-1], feedthrough, limit)
    for other in starts[:-1] if cost > good else ():
        found = refine_output_error(projection, other, feedthrough, limit, rival=cost)
        model, cost = min((model, cost), found, key=lambda pair: pair[1])
    return model, cost


def distinct(poles: NDArray[np.complex128]) -> bool:
    """Return whether no two poles are the same, so that they have a modal form."""
    return len(set(np.round(poles, 12))) == len(poles)


def affordable(projection: Projection, n: int) -> bool:
    """Return whether models of order n, with so many signals, are refined at all."""
    return equation_work(projection, n) < MOST_WORK


def by_parameter(columns: Array) -> Array:
    """Return a Jacobian (ny, 2 L, parameters) with a row for each parameter: a view."""
    return np.moveaxis(columns, -1, 0).reshape(columns.shape[2], -1)


def refine_innovation(projection: Projection, start: Matrices, feedthrough: bool, *,
                      limit: float = np.inf, plant: bool = True, steps: int = 20,
                      rival: float = np.inf) -> tuple[Matrices, float]:
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
        At most.
    rival : float
        Cost of another model: given up as soon as it is clear that it will not be beaten.

    Returns
    -------
    model : Matrices
    cost : float
        -2 log likelihood; infinite if the start is not admissible (see `innovation_cost`).
    """
    def curvature(m: Matrices, prediction: Prediction) -> NormalEquations | None:
        return _curvature(projection, m, prediction, feedthrough, plant)

    entries = FreeEntries.of(start, feedthrough, noise=True)
    return climb(start, lambda m: innovation(projection, m), curvature, entries.moved,
                 limit=limit, steps=steps, damping=_DAMPING, rival=rival)


def growth(m: Matrices) -> float:
    """Return the largest real part of the poles [rad/s]."""
    return float(np.max(np.linalg.eigvals(m.A).real))


def _curvature(projection: Projection, m: Matrices, prediction: Prediction, feedthrough: bool,
               plant: bool) -> NormalEquations | None:
    """Return the equations of an innovation form's step; None at the border of the computable."""
    free = None if plant else \
        FreeEntries.of(m, feedthrough, noise=True).mask('K', 'tail').astype(float)
    if projection.members:
        found = record_equations(
            projection, m, prediction,
            whitener_of(projection, as_real(prediction.error)), feedthrough, with_noise=True,
            free=free)
        if not (np.isfinite(found.gram).all() and np.isfinite(found.pull).all()):
            return None
    else:
        rows, error = _whitened(projection, m, prediction, feedthrough, with_noise=True)
        if free is not None:
            rows *= free[:, np.newaxis]
        if not (np.isfinite(rows).all() and np.isfinite(error).all()):
            return None
        found = normal_equations(rows, error)
    gradient = spread_gradient(projection, m, feedthrough, prediction.resolvent)
    return replace(found, pull=found.pull - 0.5 * gradient / found.norm)


def whitened(projection: Projection, m: Matrices, feedthrough: bool, *,
             with_noise: bool) -> tuple[Array, Array]:
    """Return Jacobian (ny N, parameters) and errors (ny N,), of unit covariance over outputs."""
    closed = resolvent(m.A - m.K @ m.C, projection.s)
    rows, error = _whitened(projection, m, predict(projection, m, closed), feedthrough,
                            with_noise=with_noise)
    return rows.T, error


def _whitened(projection: Projection, m: Matrices, prediction: Prediction, feedthrough: bool, *,
              with_noise: bool) -> tuple[Array, Array]:
    """Return the same, but the Jacobian with a row for each parameter."""
    error = as_real(prediction.error)
    whiten = whitener_of(projection, error)
    columns = jacobian(projection, m, feedthrough, with_noise=with_noise, whiten=whiten,
                       prediction=prediction)
    return by_parameter(columns), (whiten @ error).ravel()


def whitener(projection: Projection, m: Matrices) -> tuple[Array, Array]:
    """Return what makes the errors' covariance over outputs one (ny, ny), and the errors."""
    error = as_real(prediction_errors(projection, m))
    return whitener_of(projection, error), error


def whitener_of(projection: Projection, error: Array) -> Array:
    """Return what makes the covariance over outputs of errors (ny, 2 L) one."""
    covariance = error @ error.T / projection.count
    scale = np.sqrt(np.diag(covariance)) + 1e-150
    root = np.linalg.cholesky(covariance / np.outer(scale, scale) + OWN * np.eye(len(scale)))
    whiten: Array = np.linalg.inv(root) / scale
    return whiten


