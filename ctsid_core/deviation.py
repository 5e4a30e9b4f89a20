# SPDX-License-Identifier: Apache-2.0
"""
The standard deviation of the poles, and of dead times that were estimated.

Errors of an innovation form are white if the model is right, and the covariance is the
Cramer-Rao bound. Residuals of a simulation need not be: whatever gusts leave is coloured. Their
power is therefore taken from the residuals, smoothed over neighbouring lines and corrected for
what the fit has taken out of them, and the covariance is the 'sandwich' of the derivatives with
it (White 1980, Econometrica 48; MacKinnon and White 1985, J. Econometrics 29, HC2).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.base import Array, Projection
from ctsid_core.delay_columns import delay_columns
from ctsid_core.matrix_functions import svd
from ctsid_core.pbsid import Matrices
from ctsid_core.process_noise import driven
from ctsid_core.refine import whitened, whitener
from ctsid_core.window_ends import line_distance

_RANK = 1e-7          # relative singular value of the Jacobian below which a direction is gauge
_SMOOTHING = 9        # lines over which the power of residuals is averaged
_PASSES = 3           # of a regression that weights outputs by what the last one left of them
_RESOLVED = 2.0       # distances of lines: a notch of the noise that is narrower is filled


def pole_deviation(projection: Projection, m: Matrices, feedthrough: bool, *,
                   process_noise: bool | None = None) -> Array:
    """
    Return the asymptotic standard deviation of the poles, in the order of `eigvals(m.A)`.

    Parameters
    ----------
    projection : Projection
    m : Matrices
    feedthrough : bool
    process_noise : bool, optional
        Whether the poles were found with the model's K, or by a simulation; by default what K
        says: 0 means a simulation.

    Returns
    -------
    ndarray, shape (n,)
        Square root of the expected |error|^2 [rad/s]; a plain subspace estimate scatters more.
    """
    return deviations(projection, m, feedthrough, process_noise=process_noise)[0]


def deviations(projection: Projection, m: Matrices, feedthrough: bool, *,
               process_noise: bool | None = None) -> tuple[Array, Array]:
    """
    Return the asymptotic standard deviations of the poles and of the dead times.

    Parameters
    ----------
    projection : Projection
        With `slopes` if dead times were estimated: what is not known of them makes poles less
        certain, too.
    m, feedthrough, process_noise
        As for `pole_deviation`.

    Returns
    -------
    poles : ndarray, shape (n,)
        As `pole_deviation`.
    delays : ndarray, shape (nu,)
        [s]; 0 where a dead time is known.
    """
    noisy = bool(np.any(m.K)) if process_noise is None else process_noise
    change = _pole_change(m)
    if noisy:
        root = _root_with_noise(projection, m, feedthrough)
    else:
        if np.any(m.K):         # the states at the ends of the window are those of a predictor
            m = replace(m, K=np.zeros_like(m.K))
            for _ in range(_PASSES):
                m = driven(projection, m, feedthrough)
        root = _root_of_simulation(projection, m, feedthrough)
    late = np.zeros(m.B.shape[1])
    if projection.slopes is not None:
        late = np.linalg.norm(root[:, -len(late):], axis=0)
    return np.linalg.norm(change @ root[:, :change.shape[1]].T, axis=1), late


def _columns(projection: Projection, m: Matrices, feedthrough: bool, *,
             with_noise: bool) -> tuple[Array, Array]:
    """Return the whitened Jacobian, last the columns of the dead times, and the errors."""
    flat, error = whitened(projection, m, feedthrough, with_noise=with_noise)
    if projection.slopes is not None:
        late = delay_columns(projection, m, whitener(projection, m)[0])
        flat = np.hstack((flat, late))
    return flat, error


def _root_with_noise(projection: Projection, m: Matrices, feedthrough: bool) -> Array:
    """
    Return a root of the covariance of an innovation form's parameters, covariance = root^T root.

    A slow pole of the predictor is a notch in the spectrum of the noise, and where it is found
    narrower than lines can tell, the lines in it would seem to say more than they do.
    """
    flat, error = _columns(projection, m, feedthrough, with_noise=True)
    flat *= np.tile(np.repeat(_trust(projection, m), 2), len(m.C))[:, np.newaxis]
    s, right, norm = _directions(flat.T)
    spare = max(1.0 - len(s) / len(error), len(m.C) / len(error))
    root: Array = right / s[:, np.newaxis] / norm / np.sqrt(spare)
    return root


def _trust(projection: Projection, m: Matrices) -> Array:
    """Return what to multiply each line with, as if all notches were as wide as is resolved."""
    found = np.linalg.eigvals(m.A - m.K @ m.C)
    wide = -np.hypot(found.real, _RESOLVED * line_distance(projection)) + 1j * found.imag
    ratio = np.abs(projection.s - found[:, np.newaxis]) / np.abs(projection.s -
                                                                 wide[:, np.newaxis])
    return np.asarray(np.prod(ratio, axis=0))


def _root_of_simulation(projection: Projection, m: Matrices, feedthrough: bool) -> Array:
    """Return a root of the sandwich covariance of a simulation's parameters."""
    flat, error = _columns(projection, m, feedthrough, with_noise=False)
    s, right, norm = _directions(flat.T)
    basis = (flat / norm) @ right.T / s
    spared = np.maximum(1.0 - np.einsum('ij,ij->i', basis, basis), len(s) / len(error))
    power = (error ** 2 / spared).reshape(len(m.C), -1, 2).mean(axis=2)
    size = np.repeat(np.sqrt(_smoothed(power)).ravel(), 2)
    root: Array = (size[:, np.newaxis] * basis) @ (right / s[:, np.newaxis] / norm)
    return root


def _smoothed(power: Array) -> Array:
    """Return the running mean over lines of each output's power (ny, L)."""
    half = max(min(_SMOOTHING // 2, power.shape[1] - 2), 0)
    sums = np.cumsum(np.pad(power, ((0, 0), (half + 1, half)), mode='reflect'), axis=1)
    mean: Array = (sums[:, 2 * half + 1:] - sums[:, :-2 * half - 1]) / (2 * half + 1)
    return mean


def _pole_change(m: Matrices) -> Array:
    """Return the derivatives of the poles by the entries of A, (n, n^2)."""
    _, modes = np.linalg.eig(m.A)
    left = np.linalg.inv(modes)
    return np.stack([np.outer(left[i], modes[:, i]).ravel() for i in range(len(m.A))])


def _directions(rows: Array) -> tuple[Array, Array, Array]:
    """
    Return the directions in which the data determine the parameters.

    Parameters
    ----------
    rows : ndarray, shape (parameters, N)
        Jacobian. Rows of zeros belong to entries that do not move.

    Returns
    -------
    s : ndarray, shape (r,)
        Singular values.
    right : ndarray, shape (r, parameters)
        Directions.
    norm : ndarray, shape (parameters,)
        What the rows were divided by.
    """
    norm = np.sqrt(np.einsum('ij,ij->i', rows, rows))
    norm[norm == 0.0] = np.inf
    _, s, right = svd(np.linalg.qr(rows.T / norm, mode='r'))
    kept = s > _RANK * s[0]
    return s[kept], right[kept], norm
