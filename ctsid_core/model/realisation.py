# SPDX-License-Identifier: Apache-2.0
"""
Functions of a realisation A, B, C, D: frequency response, other states, dead time approximated.

Of arrays; transformations are returned as T of the new states z = T x.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_continuous_lyapunov

from ctsid_core.errors import DataError
from ctsid_core.linear.matrix_functions import balanced
from ctsid_core.linear.types import Array, ComplexArray, Places

_CIRCLE = 64  # points of the circle around a pole
_SEEN = 1e-10  # a principal part below this fraction of |C row| |B column| or entry is rounding


def regular(T: Array) -> bool:
    """Return whether T has an inverse to rounding, whatever the units of its rows and columns."""
    rows = T / np.maximum(np.linalg.norm(T, axis=1, keepdims=True), 1e-300)
    both = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    return bool(np.linalg.cond(both) < 1 / np.finfo(float).eps)


def pole_order(values: ComplexArray) -> Places:
    """Return the order of poles: by magnitude, |imag|, real part, imag."""
    return np.lexsort((values.imag, values.real, np.abs(values.imag), np.abs(values)))


def state_changes(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
    """Return the slopes of A + X A - A X, B + X B and C - C X, a column for each entry of X."""
    one = np.eye(len(A))
    A_slope: Array = np.kron(one, A.T) - np.kron(A, one)
    return A_slope, np.asarray(np.kron(one, B.T)), np.asarray(-np.kron(C, one))


def _root(gramian: Array) -> Array:
    symmetric = (gramian + gramian.T) / 2
    try:
        return np.asarray(cholesky(symmetric, lower=True))
    except np.linalg.LinAlgError:  # semidefinite to rounding
        values, vectors = np.linalg.eigh(symmetric)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def balancing(A: Array, B: Array, C: Array) -> Array:
    """
    Return T that balances a stable system; shape (n, n).

    Square-root method: A. C. Antoulas, "Approximation of Large-Scale Dynamical Systems", SIAM
    2005, section 7.3. Signed such that c1 + c2/sqrt(2) + c3/sqrt(3) + ... is positive, with c a
    column of C: unlike the largest entry it does not switch between outputs, and unlike the plain
    sum it is not zero for antisymmetric modes of symmetric sensors. Raises `DataError` if the
    system is not minimal.
    """
    R = _root(solve_continuous_lyapunov(A, -B @ B.T))      # R R^T and L L^T are the Gramians
    L = _root(solve_continuous_lyapunov(A.T, -C.T @ C))
    U, sigma, _ = np.linalg.svd(L.T @ R)
    if not sigma[-1] > len(A) * np.finfo(float).eps * sigma[0]:
        raise DataError(f'a state is not controllable or not observable (smallest Hankel singular '
                        f'value {sigma[-1]:.1e}, largest {sigma[0]:.1e}), so it cannot be '
                        'balanced; identify with a lower order')
    balance = (U / np.sqrt(sigma)).T @ L.T
    columns = np.linalg.solve(balance.T, C.T)
    signs = np.where(columns @ (1 / np.sqrt(np.arange(1, len(C) + 1))) < 0.0, -1.0, 1.0)
    return np.asarray(signs[:, np.newaxis] * balance)


def with_pade(A: Array, B: Array, C: Array, D: Array, delay: Sequence[float],
              order: int) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D with a Pade filter of the given order before every late input."""
    n, ny = len(A), len(C)
    late = [j for j, d in enumerate(delay) if d > 0 and order > 0]
    extra = order * len(late)
    A, B = block_diag(A, np.zeros((extra, extra))), np.vstack([B, np.zeros((extra, B.shape[1]))])
    C, D = np.hstack([C, np.zeros((ny, extra))]), D.copy()
    a, b, c, d = _pade(order)
    for k, j in enumerate(late):
        rows = slice(n + k * order, n + (k + 1) * order)
        A[:n, rows], C[:, rows] = np.outer(B[:n, j], c), np.outer(D[:, j], c)
        B[:n, j] *= d
        D[:, j] *= d
        A[rows, rows], B[rows, j] = a / delay[j], b / delay[j]
    return A, B, C, D


def _pade(order: int) -> tuple[Array, Array, Array, float]:
    # e^-q = P(-q) / P(q), P(q) = sum_k c_k q^k (G. H. Golub, C. F. Van Loan, "Matrix
    # Computations", 4th edition, section 9.3.1), in controllable canonical form
    c = np.array([factorial(2 * order - k) * factorial(order)
                  / (factorial(2 * order) * factorial(k) * factorial(order - k))
                  for k in range(order + 1)])
    denominator, numerator = c / c[-1], c * (-1.0) ** np.arange(order + 1) / c[-1]
    through = float(numerator[-1])
    a, b = np.eye(order, k=1), np.zeros(order)
    if order:
        a[-1], b[-1] = -denominator[:-1], 1.0
    return a, b, (numerator - through * denominator)[:-1], through


def transfer(A: Array, B: Array, C: Array, D: Array, delay: Sequence[float],
             omega: Array) -> ComplexArray:
    """Return (C (j omega I - A)^-1 B + D) exp(-j omega delay), shape (M, ny, nu)."""
    s = np.asarray(1j * omega, dtype=complex)
    late: ComplexArray = np.exp(-s[:, np.newaxis, np.newaxis] * np.asarray(delay))
    if not len(A):
        return np.asarray(D * late)
    scaled, scale = balanced(A)
    B, C = B / scale[:, np.newaxis], C * scale
    poles: ComplexArray = np.linalg.eigvals(scaled).astype(complex)
    rounding = len(A) * np.finfo(float).eps * np.linalg.norm(scaled)
    distance: Array = np.abs(s[:, np.newaxis] - poles)
    near = (distance.min(axis=1) <= rounding) | (np.linalg.slogdet(_system(scaled, s))[0] == 0.0)
    response = np.empty((len(s), *D.shape), dtype=complex)
    response[~near] = C @ np.linalg.solve(_system(scaled, s[~near]), B[np.newaxis])
    for k in np.flatnonzero(near):
        response[k] = _at_pole(scaled, B, C, s[k], distance[k], rounding)
    response += D
    return np.where(np.isfinite(response), response * late, response)


def _system(A: Array, s: ComplexArray) -> ComplexArray:
    return np.asarray(s[:, np.newaxis, np.newaxis] * np.eye(len(A)) - A)


def _at_pole(A: Array, B: Array, C: Array, s: complex, distance: Array,
             rounding: float) -> ComplexArray:
    # Laurent series around s from a circle that encloses only the poles at s: an entry with a
    # principal part is infinite there, any other is its mean over the circle.
    others = distance[distance > max(1e-4 * float(np.max(distance)), rounding)]
    radius = float(np.min(others)) / 2 if len(others) else 1.0
    circle = np.exp(2j * np.pi * np.arange(_CIRCLE) / _CIRCLE)
    values = C @ np.linalg.solve(_system(A, np.asarray(s + radius * circle)), B[np.newaxis])
    series = np.fft.fft(values, axis=0) / _CIRCLE
    principal = np.abs(series[_CIRCLE - len(A):]).max(axis=0)
    size = np.linalg.norm(C, axis=1)[:, np.newaxis] * np.linalg.norm(B, axis=0) / radius
    seen = principal > _SEEN * np.maximum(np.abs(values).max(axis=0), size)
    return np.where(seen, complex(np.inf, np.nan), series[0])
