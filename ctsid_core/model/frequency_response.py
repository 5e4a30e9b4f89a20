# SPDX-License-Identifier: Apache-2.0
"""
Frequency response of a state-space model, also exactly at its poles.

One complex Schur form A = Z T Z^H (unitary, so backward stable) serves all frequencies: per
frequency only a triangular system is left (A. J. Laub, "Efficient multivariable frequency
response computations", IEEE Trans. Automatic Control 26, 1981, with T for the Hessenberg form).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import matrix_balance, schur

from ctsid_core.linear.types import Array, ComplexArray

CIRCLE = 64  # points of the circle around a pole
SEEN = 1e-10  # a principal part below this fraction of |C row| |B column| or entry is rounding


def transfer(A: Array, B: Array, C: Array, D: Array, delay: Sequence[float],
             omega: Array) -> ComplexArray:
    """Return (C (j omega I - A)^-1 B + D) exp(-j omega delay), shape (M, ny, nu)."""
    s = np.asarray(1j * omega, dtype=complex)
    late: ComplexArray = np.exp(-s[:, np.newaxis, np.newaxis] * np.asarray(delay))
    if not len(A):
        return np.asarray(D * late)
    scaled, (scale, _) = matrix_balance(A, permute=False, separate=True)
    T, Z = schur(scaled, output='complex')
    left, right = (C * scale) @ Z, Z.conj().T @ (B / scale[:, np.newaxis])
    response: ComplexArray = (_triangular(T, left, right, s) + D) * late
    poles = np.diag(T)
    rounding = len(A) * np.finfo(float).eps * np.linalg.norm(scaled)
    for k in np.flatnonzero(np.abs(s[:, np.newaxis] - poles).min(axis=1) <= rounding):
        value = _at_pole(T, left, right, s[k], rounding) + D
        response[k] = np.where(np.isfinite(value), value * late[k], value)
    return response


def _triangular(T: ComplexArray, left: ComplexArray, right: ComplexArray,
                s: ComplexArray) -> ComplexArray:
    # left (s I - T)^-1 right by back substitution, one row of T at a time for all s
    n = len(T)
    x = np.empty((n, len(s), right.shape[1]), dtype=complex)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        for k in range(n - 1, -1, -1):
            known = np.tensordot(T[k, k + 1:], x[k + 1:], axes=1)
            x[k] = (right[k] + known) / (s - T[k, k])[:, np.newaxis]
        return np.asarray(np.moveaxis(np.tensordot(left, x, axes=1), 0, 1))


def _at_pole(T: ComplexArray, left: ComplexArray, right: ComplexArray, s: complex,
             rounding: float) -> ComplexArray:
    # Laurent series around s from a circle that encloses only the poles at s: an entry with a
    # principal part is infinite there, any other is its mean over the circle.
    distance = np.abs(np.diag(T) - s)
    others = distance[distance > max(1e-4 * float(distance.max()), rounding)]
    radius = others.min() / 2 if others.size else 1.0
    circle = np.exp(2j * np.pi * np.arange(CIRCLE) / CIRCLE)
    values = _triangular(T, left, right, np.asarray(s + radius * circle, dtype=complex))
    series = np.fft.fft(values, axis=0) / CIRCLE
    principal = np.abs(series[CIRCLE - len(T):]).max(axis=0)
    size = np.linalg.norm(left, axis=1)[:, np.newaxis] * np.linalg.norm(right, axis=0) / radius
    seen = principal > SEEN * np.maximum(np.abs(values).max(axis=0), size)
    return np.where(seen, complex(np.inf, np.nan), series[0])
