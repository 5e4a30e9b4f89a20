# SPDX-License-Identifier: Apache-2.0
"""
Information of the data on a model's entries: the root of their covariance.

Errors of an innovation form are white if the model is right, and the covariance is the
Cramer-Rao bound. Residuals of a simulation need not be: whatever gusts leave is coloured. Their
power is therefore taken from the residuals, corrected for what the fit has taken out of them and
smoothed over neighbouring lines, as many as the data ask for (Hurvich 1985, J. Am. Stat. Assoc.
80), and the covariance is the 'sandwich' of the derivatives with it (White 1980, Econometrica 48;
MacKinnon and White 1985, J. Econometrics 29, HC2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.projection import Projection
from ctsid_core.likelihood.delay_columns import delay_columns
from ctsid_core.likelihood.process_noise import with_linear_entries
from ctsid_core.likelihood.refine import whitened, whitener
from ctsid_core.likelihood.window_ends import line_distance
from ctsid_core.linear.free_entries import GAUGE, FreeEntries
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.matrix_functions import svd
from ctsid_core.linear.tall_qr import triangle
from ctsid_core.linear.types import Array, Lines
from ctsid_core.model.covariance import Entries

_WIDTHS = (9, 27, 81)  # lines over which the power of residuals is averaged; or over all
_PASSES = 3           # of a regression that weights outputs by what the last one left of them
_RESOLVED = 2.0       # distances of lines: a notch of the noise that is narrower is filled


def entry_changes(projection: Projection, m: Matrices, feedthrough: bool, *,
                  process_noise: bool | None = None) -> Entries:
    """
    Return the root of the asymptotic covariance of a model's entries, as rows of changes.

    Parameters
    ----------
    projection : Projection
    m : Matrices
    feedthrough : bool
    process_noise : bool, optional
        Whether the model was found with its K, or by a simulation; by default what K says: 0
        means a simulation.

    Returns
    -------
    Entries
        Of A, B, C, D and the dead times; zeros for those that are known. A plain subspace
        estimate scatters more.
    """
    noisy = bool(np.any(m.K)) if process_noise is None else process_noise
    if not noisy:
        m = without_gain(projection, m, feedthrough)
    root = information(projection, m, feedthrough, noisy).root
    return entries_of(root, m, feedthrough, delays=projection.slopes is not None)


@dataclass(frozen=True)
class Information:
    """
    Information of the data on a model's parameters, in the order of `jacobian`.

    Parameters
    ----------
    s : ndarray, shape (r,)
        Singular values of the scaled derivatives.
    right : ndarray, shape (r, parameters)
        Directions in which the data determine the scaled parameters.
    norm : ndarray, shape (parameters,)
        What the derivatives were divided by; infinite for entries that do not move.
    basis : ndarray, shape (ny 2 L, r)
        Orthonormal: the derivatives of the whitened errors are basis s right norm.
    size : ndarray, shape (ny 2 L,) or (1,)
        Deviation of these errors.
    """

    s: Array
    right: Array
    norm: Array
    basis: Array
    size: Array

    @property
    def root(self) -> Array:
        """A root of the covariance of the parameters, root^T root."""
        change = self.right / self.s[:, np.newaxis] / self.norm
        if len(self.size) == 1:
            return np.asarray(self.size * change)
        few = triangle(self.size[:, np.newaxis] * self.basis)
        return np.asarray(few @ change)


def without_gain(projection: Projection, m: Matrices, feedthrough: bool) -> Matrices:
    """Return a model for simulations: without K, and with the tail that goes with that."""
    if not np.any(m.K):
        return m
    m = replace(m, K=np.zeros_like(m.K))    # the tail was that of a predictor
    for _ in range(_PASSES):
        m = with_linear_entries(projection, m, feedthrough)
    return m


def information(projection: Projection, m: Matrices, feedthrough: bool,
                noisy: bool) -> Information:
    """
    Return the information on the parameters of an innovation form, or of a simulation.

    A slow pole of the predictor is a notch in the spectrum of the noise, and where it is found
    narrower than lines can tell, the lines in it would seem to say more than they do.
    """
    flat, error = _columns(projection, m, feedthrough, with_noise=noisy)
    if noisy:
        widths = [trust(record.s, line_distance(record), m) for record in projection.records]
        flat *= np.tile(np.repeat(np.concatenate(widths), 2), len(m.C))[:, np.newaxis]
    s, right, norm = _directions(flat.T)
    basis = (flat / norm) @ right.T / s
    if noisy:
        spare = max(1.0 - len(s) / len(error), len(m.C) / len(error))
        return Information(s, right, norm, basis, np.array([1.0 / np.sqrt(spare)]))
    spared = np.maximum(1.0 - np.einsum('ij,ij->i', basis, basis), len(s) / len(error))
    power = (error ** 2 / spared).reshape(len(m.C), -1, 2).mean(axis=2)
    ends = np.cumsum([len(record.s) for record in projection.records])[:-1]
    smooth = np.hstack([_smoothed(own) for own in np.split(power, ends, axis=1)])
    return Information(s, right, norm, basis, np.repeat(np.sqrt(smooth).ravel(), 2))


def trust(s: Lines, apart: float, m: Matrices) -> Array:
    """
    Return what to multiply lines with, as if all notches were as wide as is resolved.

    Parameters
    ----------
    s : ndarray, shape (L,)
    apart : float
        Distance of the lines [rad/s].
    m : Matrices
    """
    found = np.linalg.eigvals(m.A - m.K @ m.C)
    wide = -np.hypot(found.real, _RESOLVED * apart) + 1j * found.imag
    ratio = np.abs(s - found[:, np.newaxis]) / np.abs(s - wide[:, np.newaxis])
    return np.asarray(np.prod(ratio, axis=0))


def entries_of(root: Array, m: Matrices, feedthrough: bool, *, delays: bool) -> Entries:
    """
    Return rows of changes by matrix, without tail, trim and K.

    Parameters
    ----------
    root : ndarray, shape (r, parameters)
        In the order of `jacobian`; the last columns are those of the dead times, if any.
    m : Matrices
    feedthrough : bool
    delays : bool
        Whether there are any.
    """
    entries, nu = FreeEntries.of(m, feedthrough), m.B.shape[1]
    D = entries.part(root, 'D') if feedthrough else np.zeros((len(root), *m.D.shape))
    late = root[:, -nu:] if delays else np.zeros((len(root), nu))
    return Entries(entries.part(root, 'A'), entries.part(root, 'B'), entries.part(root, 'C'),
                   D, late)


def pole_deviation(projection: Projection, m: Matrices, feedthrough: bool, *,
                   process_noise: bool | None = None) -> Array:
    """
    Return the asymptotic standard deviation of the poles, in the order of `eigvals(m.A)`.

    Returns
    -------
    ndarray, shape (n,)
        Square root of the expected |error|^2 [rad/s]; parameters as of `entry_changes`.
    """
    changes = entry_changes(projection, m, feedthrough, process_noise=process_noise)
    _, modes = np.linalg.eig(m.A)
    moved = np.einsum('ia,rab,bi->ri', np.linalg.inv(modes), changes.A, modes, optimize=True)
    deviation: Array = np.linalg.norm(moved, axis=0)
    return deviation


def _columns(projection: Projection, m: Matrices, feedthrough: bool, *,
             with_noise: bool) -> tuple[Array, Array]:
    """Return the whitened Jacobian, last the columns of the dead times, and the errors."""
    flat, error = whitened(projection, m, feedthrough, with_noise=with_noise)
    if projection.slopes is not None:
        late = delay_columns(projection, m, whitener(projection, m)[0])
        flat = np.hstack((flat, late))
    return flat, error


def _smoothed(power: Array) -> Array:
    """
    Return the running mean over lines of each output's power (ny, L).

    A mean of many lines is known better, one of few keeps more of the colour: of several widths
    that is taken under which lines are likeliest by the mean of their neighbours.
    """
    means, costs = [], []
    for width in (*(w for w in _WIDTHS if w < power.shape[1]), np.inf):
        mean, others = _running_mean(power, width)
        others = np.maximum(others, 1e-300)
        means.append(mean)
        costs.append(np.sum(np.log(others) + power / others, axis=1))
    best = np.argmin(costs, axis=0)
    found: Array = np.stack(means)[best, np.arange(len(power))]
    return found


def _running_mean(power: Array, width: float) -> tuple[Array, Array]:
    """Return the mean over lines around each, and the same without the line itself."""
    if width == np.inf:
        total, count = np.sum(power, axis=1, keepdims=True) + 0.0 * power, power.shape[1]
    else:
        half, count = int(width) // 2, int(width)
        sums = np.cumsum(np.pad(power, ((0, 0), (half + 1, half)), mode='reflect'), axis=1)
        total = sums[:, count:] - sums[:, :-count]
    return total / count, (total - power) / max(count - 1, 1)


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
    _, s, right = svd(triangle(rows.T / norm))
    kept = s > GAUGE * s[0]
    return s[kept], right[kept], norm
