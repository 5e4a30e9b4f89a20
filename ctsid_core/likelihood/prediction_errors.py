# SPDX-License-Identifier: Apache-2.0
"""
Prediction errors of a model in the projected domain, their likelihood and derivatives.

    E  = Y - C X - D U,           X  = (s I - A bar)^-1 (B bar U + K Y)
    dE = -C dX - dC X - dD U,     dX = (s I - A bar)^-1 (dA X + dB U + dK E - K (dC X + dD U))

with A bar = A - K C ([HD] eq. 35); tail and ones are inputs like U. K = 0 is the output-error
form. In the innovation form E = H (Y - G U), H = I - C (s I - A bar)^-1 K, the errors are white;
because the lines fill a finite band, log det of their covariance must be joined by
-2 sum log|det H|, the Jacobian of the map from outputs to errors. Without that term a fit
diverges to ever faster predictors; without that of `window_ends.py`, to ever slower ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection, as_real, real_times
from ctsid_core.likelihood.window_ends import LEAST_DAMPING, ends_cost, ends_slopes, line_distance
from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.least_squares import solve
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import Resolvent, resolvent
from ctsid_core.linear.types import Array, Lines

ROUNDING = 1e-20        # error power below this fraction of the output's counts as rounding
OWN = 1e-12           # share of each output's error power that no other output can predict


@dataclass(frozen=True)
class Prediction:
    """
    A model's predictions of the lines, and what their derivatives need.

    Parameters
    ----------
    resolvent : Resolvent
        Of A - K C.
    x : ndarray, shape (n, L)
        The states' lines.
    error : ndarray, shape (ny, L)
        E.
    """

    resolvent: Resolvent
    x: Lines
    error: Lines


@dataclass(frozen=True)
class Likelihood:
    """
    The likelihood of a model, and what its derivatives need.

    Parameters
    ----------
    cost : float
        -2 log likelihood, up to a constant; infinite if the model is not admissible.
    prediction : Prediction or None
        None if the model is not admissible.
    poles : ndarray, shape (n,)
        Of A [rad/s].
    """

    cost: float
    prediction: Prediction | None
    poles: NDArray[np.complex128]


def simulate_lines(projection: Projection, m: Matrices) -> Lines:
    """Return the outputs of a model without noise, lines of shape (ny, L)."""
    simulated: Lines = projection.y - simulation(projection, m).error
    return simulated


def simulation(projection: Projection, m: Matrices) -> Prediction:
    """Return what a model predicts if its K counts as zero."""
    drive = real_times(np.hstack((m.B, m.tail, m.x_trim)),
                       projection.signals[:len(projection.signals) - len(m.C)])
    return _prediction(projection, m, resolvent(m.A, projection.s), drive)


def prediction_errors(projection: Projection, m: Matrices) -> Lines:
    """Return E, lines of shape (ny, L); for K = 0 the simulation's."""
    return predict(projection, m, resolvent(m.A - m.K @ m.C, projection.s)).error


def predict(projection: Projection, m: Matrices, closed: Resolvent) -> Prediction:
    """Return what a model predicts with its K; `closed` is the resolvent of A - K C."""
    drive = real_times(np.hstack((m.B - m.K @ m.D, m.tail, m.x_trim - m.K @ m.y_trim, m.K)),
                       projection.signals)
    return _prediction(projection, m, closed, drive)


def _prediction(projection: Projection, m: Matrices, closed: Resolvent,
                drive: Lines) -> Prediction:
    x = closed.states(drive)
    nu, y = len(projection.u), len(projection.signals) - len(m.C)
    e = projection.y - real_times(m.C, x) - real_times(m.D, projection.signals[:nu])
    if len(projection.ones):
        e -= m.y_trim @ projection.signals[y - len(projection.ones):y]
    return Prediction(closed, x, e)


def noise_power(projection: Projection, m: Matrices) -> Array:
    """Return the power of the noise that a model's K stands for, (ny, L), each of mean 1."""
    error = as_real(prediction_errors(projection, m))
    covariance = error @ error.T / projection.count
    through = np.tensordot(m.K.T, resolvent(m.A, projection.s).outputs(m.C), axes=1)
    through += np.eye(len(m.C))[:, :, np.newaxis]              # by innovation, output, line
    driven = np.tensordot(covariance, through, axes=1)
    power: Array = np.sum(driven * through.conj(), axis=0).real
    return power / np.mean(power, axis=1, keepdims=True)


def output_error_cost(projection: Projection, m: Matrices) -> float:
    """Return -2 log likelihood, up to a constant, of a simulation (noise of measurement only)."""
    return output_error(projection, m).cost


def output_error(projection: Projection, m: Matrices) -> Likelihood:
    """Return the likelihood of a simulation, with what its derivatives need."""
    prediction, count = simulation(projection, m), projection.count
    error = as_real(prediction.error)
    variance = np.maximum(np.einsum('ij,ij->i', error, error) / count, least_power(projection))
    return Likelihood(float(count * np.log(variance).sum()), prediction,
                      prediction.resolvent.poles)


def log_det(projection: Projection, covariance: Array) -> Array:
    """
    Return log det of covariances of the errors over outputs.

    Parameters
    ----------
    projection : Projection
    covariance : ndarray, shape (..., ny, ny)
        Each may be singular: without noise, errors of a missing state are the same in all outputs.

    Returns
    -------
    ndarray, shape (...)
    """
    own = OWN * np.diagonal(covariance, axis1=-2, axis2=-1) + least_power(projection)
    own = own[..., np.newaxis] * np.eye(own.shape[-1])
    return np.asarray(np.linalg.slogdet(covariance + own)[1])


def least_power(projection: Projection) -> Array:
    """Return the power of each output below which errors are rounding (ny,)."""
    y = as_real(projection.y)
    floor: Array = ROUNDING * np.einsum('ij,ij->i', y, y) / y.shape[1] + 1e-300
    return floor


def innovation_cost(projection: Projection, m: Matrices) -> float:
    """
    Return -2 log likelihood, up to the same constant as the output error's, with the model's K.

    Infinite where the predictor is unstable, or its memory far longer than the window.
    """
    return innovation(projection, m).cost


def innovation(projection: Projection, m: Matrices) -> Likelihood:
    """Return the likelihood with the model's K, with what its derivatives need."""
    closed = resolvent(m.A - m.K @ m.C, projection.s)
    poles = np.linalg.eigvals(m.A).astype(complex)
    if np.max(closed.poles.real) > -LEAST_DAMPING * line_distance(projection):
        return Likelihood(np.inf, None, poles)
    prediction = predict(projection, m, closed)
    error = as_real(prediction.error)
    cost = projection.count * float(log_det(projection, error @ error.T / projection.count))
    cost += float(spread(projection, poles, closed.poles))
    cost += float(ends_cost(projection, closed.poles.astype(complex), poles))
    return Likelihood(cost, prediction, poles)


def spread(projection: Projection, poles: NDArray[np.complex128],
           closed: NDArray[np.complex128]) -> Array:
    """
    Return -2 sum log|det H|.

    Parameters
    ----------
    projection : Projection
    poles, closed : ndarray, shape (..., n)
        Of A and of A - K C [rad/s]; any number of models.
    """
    # det H = det(s I - A) / det(s I - A bar), because A bar + K C = A
    ratio = np.sum(np.log(np.abs(projection.s - poles[..., np.newaxis]) + 1e-300)
                   - np.log(np.abs(projection.s - closed[..., np.newaxis])), axis=-2)
    return np.asarray(-2.0 * ratio @ line_weights(projection))


def line_weights(projection: Projection) -> Array:
    """Return how many real numbers each line stands for: 2, but 1 at frequency zero."""
    return projection.weights


def spread_gradient(projection: Projection, m: Matrices, feedthrough: bool,
                    closed: Resolvent | None = None) -> Array:
    """
    Return the gradient of what `innovation_cost` adds to the errors' log det.

    Parameters
    ----------
    projection : Projection
    m : Matrices
    feedthrough : bool
    closed : Resolvent, optional
        Of A - K C, if it is at hand.

    Returns
    -------
    ndarray
        By the entries that `jacobian` lists.
    """
    closed = closed or resolvent(m.A - m.K @ m.C, projection.s)
    plant, weights = resolvent(m.A, projection.s), line_weights(projection)
    by_predictor, by_plant = ends_slopes(projection, closed, plant)
    by_predictor = by_predictor - 2.0 * closed.sum(weights)
    by_plant = by_plant + 2.0 * plant.sum(weights)
    entries = FreeEntries.of(m, feedthrough, noise=True)
    gradient = np.zeros(entries.count)
    A, _, C, _, K = entries.split(gradient)     # views
    A[:], C[:], K[:] = (by_predictor + by_plant).T, -(by_predictor @ m.K).T, \
        -(m.C @ by_predictor).T
    return gradient


def jacobian(projection: Projection, m: Matrices, feedthrough: bool, *, with_noise: bool,
             whiten: Array | None = None, prediction: Prediction | None = None) -> Array:
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
    whiten : ndarray, shape (ny, ny), optional
        Multiplies E.
    prediction : Prediction, optional
        Of the model, if it is at hand.

    Returns
    -------
    ndarray, shape (ny, 2 L, parameters)
        A view of an array whose first axis is that of the parameters.
    """
    if prediction is None:
        prediction = predict(projection, m, resolvent(m.A - m.K @ m.C, projection.s))
    z = projection.signals[:len(projection.signals) - len(m.C)]
    direct = np.vstack((projection.u, projection.ones)) if feedthrough else projection.ones
    outer = np.eye(len(m.C)) if whiten is None else whiten
    # By entry (i, j): i first, then the outputs, then the lines; j are the rows they multiply.
    gain = prediction.resolvent.outputs(outer @ m.C)              # C (s I - A bar)^-1
    through = outer.T[:, :, np.newaxis] - real_times(
        m.K.T, gain.reshape(len(m.A), -1)).reshape(len(m.C), len(m.C), -1)
    blocks = [(gain, prediction.x), (gain, z), (through, prediction.x), (through, direct)]
    if with_noise:
        blocks.append((gain, prediction.error))
    return np.moveaxis(as_real(_products(blocks)), 0, -1)


def _products(blocks: list[tuple[Lines, Lines]]) -> Lines:
    """Return left[i] right[j] for all i and j of all blocks, (sum of i j, ny, L)."""
    sizes = [len(left) * len(right) for left, right in blocks]
    out = np.empty((sum(sizes), *blocks[0][0].shape[1:]), dtype=complex)
    first = 0
    for (left, right), size in zip(blocks, sizes, strict=True):
        np.multiply(left[:, np.newaxis], right[:, np.newaxis],
                    out=out[first:first + size].reshape(len(left), len(right), *out.shape[1:]))
        first += size
    return out


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
    return _nrmse(error, without_level(as_real(projection.y), as_real(projection.ones)))


def unseen_fit(projection: Projection, m: Matrices, *, trimmed: bool = True) -> Array:
    """Return the first result of `unseen` [%]."""
    return unseen(projection, m, trimmed=trimmed)[0]


def unseen(projection: Projection, m: Matrices, *,
           trimmed: bool = True) -> tuple[Array, Array]:
    """
    Return how well a model simulates data that it has not seen.

    Parameters
    ----------
    projection : Projection
    m : Matrices
    trimmed : bool
        Whether the model knows the trim of the data; else it is estimated, too.

    Returns
    -------
    fit : ndarray, shape (ny,)
        How much of each output the inputs explain [%].
    density : ndarray, shape (ny,)
        Of the simulation's errors, as white noise has it [unit^2 s].

    Notes
    -----
    The states at the ends of the data are not known and are estimated from them. Lest that
    counts as explanation, the error is compared with what a constant and the same free response
    leave of the outputs with no input at all: 100 (1 - |error| / |left without inputs|).
    """
    y, ones = as_real(projection.y), as_real(projection.ones)
    unit = np.maximum(np.linalg.norm(without_level(y, ones), axis=1, keepdims=True), 1e-300)
    if not trimmed:
        m = replace(m, x_trim=np.zeros((len(m.A), len(ones))),
                    y_trim=np.zeros((len(m.C), len(ones))))
    still = replace(m, tail=np.zeros((len(m.A), len(projection.tail))))
    error = (y - as_real(simulate_lines(projection, still))) / unit
    modes = [(as_real(_free(projection, m, i, part)) / unit).ravel()
             for i in range(len(m.A)) for part in range(len(projection.tail))]
    levels = [np.kron(row, one) for row in np.eye(len(y)) for one in ones]
    free = modes if trimmed else [*modes, *levels]
    error = _beyond(error, free)
    spare = max(projection.count - len(free) / len(y), 1.0)
    density: Array = projection.unit * np.sum((error * unit) ** 2, axis=1) / spare
    return _nrmse(error, _beyond(y / unit, [*modes, *levels])), density


def predicted_fit(projection: Projection, m: Matrices) -> Array:
    """
    Return by how much the inputs make predictions of each output better [%].

    Parameters
    ----------
    projection : Projection
    m : Matrices
        With its K.

    Notes
    -----
    100 (1 - |E| / |E if inputs do nothing|). For an unstable plant with process noise: a
    simulation of it means nothing.
    """
    error, blind = _with_and_without_level(projection, m)
    return _nrmse(error, blind)


def unseen_predicted_fit(projection: Projection, m: Matrices) -> Array:
    """
    Return the same in data that the model has not seen.

    What the unknown state at the ends of the data can explain counts for neither.
    """
    m = replace(m, tail=np.zeros((len(m.A), len(projection.tail))))
    closed = resolvent(m.A - m.K @ m.C, projection.s)
    error, blind = _with_and_without_level(projection, m)
    unit = np.maximum(np.linalg.norm(blind, axis=1, keepdims=True), 1e-300)
    modes = []
    for tail in projection.tail:
        for state in np.eye(len(m.A)):
            response = real_times(m.C, closed.states(state[:, np.newaxis] * tail))
            modes.append((as_real(response) / unit).ravel())
    return _nrmse(_beyond(error / unit, modes), _beyond(blind / unit, modes))


def _with_and_without_level(projection: Projection, m: Matrices) -> tuple[Array, Array]:
    """Return the prediction errors of a model, and of the same without effect of inputs."""
    silent = replace(m, B=np.zeros_like(m.B), D=np.zeros_like(m.D))
    return (as_real(prediction_errors(projection, m)),
            as_real(prediction_errors(projection, silent)))


def _beyond(y: Array, rows: list[Array]) -> Array:
    """Return what a least-squares fit of rows, each over all outputs, leaves of the outputs."""
    if not rows:
        return y
    regressors, flat = np.stack(rows), y.reshape(1, -1)
    left: Array = (flat - solve(regressors, flat, 1e-10)[0] @ regressors).reshape(y.shape)
    return left


def without_level(y: Array, ones: Array) -> Array:
    """Return rows without what a constant explains of them."""
    if not len(ones):
        return y
    moving: Array = y - (y @ ones.T) / np.sum(ones ** 2, axis=1) @ ones
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
