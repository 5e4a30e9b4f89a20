# SPDX-License-Identifier: Apache-2.0
"""
Cramer-Rao bounds of the poles from raw samples, independent of how ctsid estimates them.

No unbiased estimator that knows as little scatters less. What is not known beside the poles, as
for ctsid: all other entries of the model, the state at the first sample, the trim and the levels
of the noise.

Measurement noise alone (`output_error_bound`): the samples are normal with the simulation as
their mean, whose derivatives are exact (`model/modal.py`). White noise's level has no
information in common with the mean.

Process noise, closed loop (`innovation_bound`): the samples' likelihood is that of the
prediction errors e_k of the Kalman filter, here in its stationary form

    x_(k+1) = F x_k + G_0 u_k + G_1 (u_(k+1) - u_k) + L e_k        e_k = y_k - C x_k - D u_k

with F, G_0, G_1 of the continuous-time model for inputs that are held (G_1 = 0) or on straight
lines. The intensity of the noise acts through L and the errors' covariance only, and these are
free. The derivatives of e_k obey the differentiated recursion, those of F and G are Frechet
derivatives of a matrix exponential.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm, expm_frechet, solve_discrete_are

from ctsid_core.errors import DataError
from ctsid_core.linear.matrix_functions import SOUND, Modes, modes
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.modal import steps_of
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Signal

_RANK = 1e-9          # singular value, relative, below which a direction changes nothing
_ORDER = {'zoh': 1, 'linear': 2}


def output_error_bound(model: StateSpace, x0: Array, inputs: Sequence[Signal], times: Array,
                       noise: Array, *, feedthrough: bool = True, trim: bool = True) -> Array:
    """
    Return the bound of each pole with measurement noise alone.

    Parameters
    ----------
    model : StateSpace
        The true one, without coinciding poles.
    x0 : ndarray, shape (n,)
        Its state at the first sample.
    inputs : sequence of Signal
        What acted, with what it did between its samples.
    times : ndarray, shape (N,)
        Of the outputs' samples [s].
    noise : ndarray, shape (ny,)
        Standard deviation of the samples.
    feedthrough, trim : bool
        Whether D and the trim are among what is not known.

    Returns
    -------
    ndarray, shape (n,)
        sqrt(E |error|^2) of each pole, in the order of `model.poles` [rad/s].
    """
    found = _modes(model)
    at = steps_of(inputs, model.delay, float(times[0]), times)
    responses, slopes = at.responses(found.values)
    b, start = found.left @ model.B, found.left @ x0
    since = times - times[0]
    free = np.exp(found.values[:, np.newaxis] * since)
    by_pole = np.einsum('mj,mjt->mt', b, slopes) + start[:, np.newaxis] * since * free
    motion = np.einsum('mj,mjt->mt', b, responses) + start[:, np.newaxis] * free
    real = found.values.imag == 0.0
    moves = [*by_pole, *responses.reshape(-1, len(times)), *free]
    modes_of = [*range(len(b)), *np.repeat(np.arange(len(b)), model.nu), *range(len(b))]
    direct = [*(at.inputs if feedthrough else ()), *(np.ones((1, len(times))) if trim else ())]
    blocks = []
    for i, c in enumerate(model.C @ found.right):
        own = [column for move, k in zip(moves, modes_of, strict=True)
               for column in _parts(c[k] * move, real[k])]
        apart = [column for move, k in zip(motion, real, strict=True)
                 for column in _parts(move, k)] + direct
        others = np.zeros((model.ny, len(apart), len(times)))
        others[i] = apart
        blocks.append(np.vstack((own, others.reshape(-1, len(times)))).T / noise[i])
    rows = np.concatenate(blocks)
    return _of_poles(_covariance(rows, np.eye(model.n, rows.shape[1])), model)


def _modes(model: StateSpace) -> Modes:
    found = modes(model.A, SOUND)
    if found is None:
        raise DataError('`model` has poles that coincide: there are no derivatives by each of '
                        'them; move one of them a little')
    return found


def _parts(column: ComplexArray, real: bool) -> list[Array]:
    """Return derivatives by real and imaginary part of what a complex column is one by."""
    return [column.real] if real else [column.real, -column.imag]


def _of_poles(covariance: Array, model: StateSpace) -> Array:
    """Return root mean squares of poles, in the order of `model.poles`, from real numbers."""
    found = _modes(model)
    spread, first = [], 0
    for p in found.values:
        width = 1 if p.imag == 0.0 else 2
        spread.append(np.sqrt(np.trace(covariance[first:first + width, first:first + width])))
        first += width
    at = [np.argmin(np.abs(found.values - complex(p.real, abs(p.imag)))) for p in model.poles]
    return np.array(spread)[at]


def _covariance(rows: Array, change: Array) -> Array:
    """
    Return the bound of the covariance of what depends on the parameters.

    Parameters
    ----------
    rows : ndarray, shape (N, parameters)
        Derivatives of samples of unit variance.
    change : ndarray, shape (wanted, parameters)
        Derivatives of what is wanted, in which directions that move no sample have no part.
    """
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0.0] = 1.0
    r = np.linalg.qr(rows / norm, mode='r')
    _, s, right = np.linalg.svd(r)
    kept = s > _RANK * s[0]
    part = (right[kept] / s[kept, np.newaxis] / norm) @ change.T
    covariance: Array = part.T @ part
    return covariance


def stationary_gain(model: StateSpace, intensity: Array, noise: Array,
                    step: float) -> tuple[Array, Array]:
    """
    Return the Kalman gain L and the covariance of the prediction errors.

    Parameters
    ----------
    model : StateSpace
    intensity : ndarray, shape (n, n)
        Of the white noise that drives the states [state^2 / s].
    noise : ndarray, shape (ny,)
        Standard deviation of the samples.
    step : float
        Between samples [s].
    """
    n = model.n
    joined = expm(step * np.block([[-model.A, intensity], [np.zeros((n, n)), model.A.T]]))
    F = joined[n:, n:].T                                       # Van Loan 1978
    Q = F @ joined[:n, n:]
    Q = 0.5 * (Q + Q.T) + 1e-18 * np.trace(model.C.T @ model.C) * np.eye(n)
    R = np.diag(noise ** 2)
    P = solve_discrete_are(F.T, model.C.T, Q, R)
    S = model.C @ P @ model.C.T + R
    return F @ P @ np.linalg.solve(S, model.C).T, S


def innovations(model: StateSpace, L: Array, u: Array, y: Array, step: float, hold: str,
                x0: Array, *, feedthrough: bool) -> tuple[Array, Array]:
    """
    Return prediction errors and their derivatives by all that they depend on.

    Parameters
    ----------
    model : StateSpace
    L : ndarray, shape (n, ny)
        Gain of the stationary Kalman filter, per sample.
    u, y : ndarray, shapes (N, nu), (N, ny)
        Uniform samples at the same times.
    step : float
        Between them [s].
    hold : {'zoh', 'linear'}
        What inputs do between samples.
    x0 : ndarray, shape (n,)
        State at the first sample.
    feedthrough : bool
        Whether D is free.

    Returns
    -------
    e : ndarray, shape (N, ny)
    slopes : ndarray, shape (N, ny, parameters)
        By the entries of A, B, C, x0, L, the trim of the outputs and D.
    """
    n, nu, ny, order = model.n, model.nu, model.ny, _ORDER[hold]
    drive = [u[:-1], np.diff(u, axis=0)][:order]
    system, moves = _discretised(model, step, order)
    F, G = system[:n, :n], [system[:n, n + i * nu:n + (i + 1) * nu] for i in range(order)]
    steady = sum((v @ g.T for v, g in zip(drive, G, strict=True)), np.zeros(()))
    count = [n * n, n * nu, ny * n, n, n * ny, ny, ny * nu * feedthrough]
    first = np.concatenate(([0], np.cumsum(count)))
    x, dx = x0.copy(), np.zeros((n, first[-1]))
    dx[:, first[3]:first[4]] = np.eye(n)
    closed, e, slopes = F - L @ model.C, np.empty((len(y), ny)), np.empty((len(y), ny, first[-1]))
    each = np.eye(ny)
    for k in range(len(y)):
        e[k] = y[k] - model.C @ x - model.D @ u[k] - model.y_trim
        own = np.zeros((ny, first[-1]))                     # -de by what the outputs depend on
        own[:, first[2]:first[3]] = np.kron(each, x)
        own[:, first[5]:first[6]] = each
        if feedthrough:
            own[:, first[6]:] = np.kron(each, u[k])
        slopes[k] = -model.C @ dx - own
        if k + 1 == len(y):
            break
        joined = np.concatenate((x, *(v[k] for v in drive)))
        dx = closed @ dx - L @ own
        dx[:, :first[2]] += np.einsum('pij,j->ip', moves, joined)
        dx[:, first[4]:first[5]] += np.kron(np.eye(n), e[k])
        x = F @ x + steady[k] + L @ e[k]
    return e, slopes


def _discretised(model: StateSpace, step: float, order: int) -> tuple[Array, Array]:
    """Return [F G_0 G_1] (n, n + order nu) and its derivatives by the entries of A and of B."""
    n, nu = model.n, model.nu
    size = n + order * nu
    joined = np.zeros((size, size))
    joined[:n, :n], joined[:n, n:n + nu] = model.A, model.B
    if order == 2:
        joined[n:n + nu, n + nu:] = np.eye(nu) / step
    places = [(i, j) for i in range(n) for j in range(n)]
    places += [(i, n + j) for i in range(n) for j in range(nu)]
    moves = np.empty((len(places), n, size))
    for move, place in zip(moves, places, strict=True):
        E = np.zeros((size, size))
        E[place] = step
        move[:] = expm_frechet(joined * step, E, compute_expm=False)[:n]
    return expm(joined * step)[:n], moves


def innovation_bound(model: StateSpace, L: Array, covariance: Array,
                     runs: Sequence[tuple[Array, Array, Array]], step: float, hold: str, *,
                     feedthrough: bool = False, gain_known: bool = False) -> Array:
    """
    Return the bound of each pole from uniform samples with process noise, in any loop.

    Parameters
    ----------
    model : StateSpace
        The true one.
    L : ndarray, shape (n, ny)
        See `stationary_gain`.
    covariance : ndarray, shape (ny, ny)
        Of the prediction errors.
    runs : sequence of (u, y, x0), shapes (N, nu), (N, ny), (n,)
        Samples, and the state at the first one, of runs of the experiment. Information is an
        expectation over noise: that of a single run has correlations by chance between what the
        inputs and what the noise causes, and the slower the plant the more.
    step : float
        [s]
    hold : {'zoh', 'linear'}
    feedthrough : bool
        Whether D is among what is not known.
    gain_known : bool
        Whether L is known.

    Returns
    -------
    ndarray, shape (n,)
        sqrt(E |error|^2) of one run, in the order of `model.poles` [rad/s].
    """
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    n, nu, ny = model.n, model.nu, model.ny
    gain = n * (n + nu + ny + 1)
    rows = []
    for u, y, x0 in runs:
        _, slopes = innovations(model, L, u, y, step, hold, x0, feedthrough=feedthrough)
        if gain_known:
            slopes[:, :, gain:gain + n * ny] = 0.0
        flat = np.einsum('ij,kjp->kip', whiten, slopes).reshape(-1, slopes.shape[2])
        rows.append(np.linalg.qr(flat, mode='r'))
    change = np.zeros((2 * n, rows[0].shape[1]))
    change[:, :n * n] = pole_slopes(model)
    found = len(rows) * np.diag(_covariance(np.concatenate(rows), change))
    spread: Array = np.sqrt(found[:n] + found[n:])
    return spread


def pole_slopes(model: StateSpace) -> Array:
    """Return the derivatives of poles' real, then imaginary parts by the entries of A."""
    values, vectors = np.linalg.eig(model.A)
    left = np.linalg.inv(vectors)
    at = [np.argmin(np.abs(values - p)) for p in model.poles]
    slopes = np.stack([np.outer(left[i], vectors[:, i]).ravel() for i in at])
    return np.concatenate((slopes.real, slopes.imag))
