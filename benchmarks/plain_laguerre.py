# SPDX-License-Identifier: Apache-2.0
"""
CT-PBSID with Laguerre projections done as they are defined: a reference that owes ctsid nothing.

Seen from every instant, signals are multiplied with each Laguerre function at every sample that
follows, and summed (weights of Gregory, h^4). At stamps that are uniform the functions are the
same for all instants: either they are evaluated anew for each, as at any stamps, or kept.
Bergamasco and Lovera 2011, IET Control Theory & Applications 5; [HD] sections 1 and 2.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FIRST = (3 / 8, 7 / 6, 23 / 24)    # Gregory's weights of the first samples
_BLOCK = 1024                       # instants taken at a time


def laguerre(count: int, a: float, t: Array) -> Array:
    """Return sqrt(2 a) exp(-a t) L_k(2 a t), shape (count, N)."""
    x = 2.0 * a * t
    found = np.empty((count, len(t)))
    found[0] = np.sqrt(2.0 * a) * np.exp(-a * t)
    found[1] = (1.0 - x) * found[0]
    for k in range(1, count - 1):
        found[k + 1] = ((2.0 * k + 1.0 - x) * found[k] - k * found[k - 1]) / (k + 1.0)
    return found


def projections(t: Array, z: Array, a: float, count: int, ahead: int, keep: bool) -> Array:
    """
    Return the coefficients of signals seen from all instants that have so many samples ahead.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Uniform stamps [s].
    z : ndarray, shape (m, N)
    a : float
        Laguerre pole [rad/s].
    count : int
        Number of functions.
    ahead : int
        Samples that a function is summed over.
    keep : bool
        Whether the functions are evaluated once, or for every instant.

    Returns
    -------
    ndarray, shape (N - ahead, count, m)
    """
    weight = np.full(ahead, t[1] - t[0])
    weight[:3] *= _FIRST
    instants = len(t) - ahead
    found = np.empty((instants, count, len(z)))
    if not keep:
        for i in range(instants):
            part = slice(i, i + ahead)
            found[i] = (laguerre(count, a, t[part] - t[i]) * weight) @ z[:, part].T
        return found
    functions = (laguerre(count, a, t[:ahead] - t[0]) * weight).T
    for j, row in enumerate(z):
        windows = sliding_window_view(row, ahead)
        for i in range(0, instants, _BLOCK):
            part = slice(i, min(i + _BLOCK, instants))
            found[part, :, j] = np.ascontiguousarray(windows[part]) @ functions
    return found


def poles(t: Array, u: Array, y: Array, *, order: int, a: float, past: int, length: float,
          keep: bool) -> NDArray[np.complex128]:
    """
    Return the poles of a model of given order, past and future window alike.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Uniform stamps of all signals [s].
    u, y : ndarray, shapes (nu, N), (ny, N)
    order : int
    a : float
        Laguerre pole [rad/s].
    past : int
        p.
    length : float
        After which the functions have decayed [s].
    keep : bool
        See `projections`.

    Returns
    -------
    ndarray, shape (order,)
        [rad/s].
    """
    z = np.vstack((u, y))
    ahead = int(np.ceil(length / (t[1] - t[0])))
    levels = projections(t, z, a, past + 2, ahead, keep)
    levels = levels - levels.mean(axis=0)                          # trim
    nu, nz = len(u), len(z)
    R = np.linalg.qr(levels.reshape(len(levels), -1), mode='r').T
    level = R.reshape(past + 2, nz, -1)
    Z, after = level[:past].reshape(past * nz, -1), level[1:past + 1].reshape(past * nz, -1)
    now = level[past]
    theta = _fit(np.vstack((Z, now[:nu])), now[nu:])[:, :past * nz]
    gamma = np.vstack([np.hstack((np.zeros((len(y), i * nz)), theta[:, :(past - i) * nz]))
                       for i in range(past)])
    left, s, _ = np.linalg.svd(gamma @ Z, full_matrices=False)
    to_state = (left[:, :order] / np.sqrt(s[:order])).T @ gamma
    x, x_next = to_state @ Z, to_state @ after
    output = np.vstack((x, now[:nu]))
    error = now[nu:] - _fit(output, now[nu:]) @ output
    A = _fit(np.vstack((output, error)), x_next)[:, :order]
    ones = np.eye(order)
    found: NDArray[np.complex128] = np.linalg.eigvals(a * np.linalg.solve(A - ones, A + ones))
    return found


def _fit(regressors: Array, targets: Array) -> Array:
    found: Array = np.linalg.lstsq(regressors.T, targets.T, rcond=1e-10)[0].T
    return found
