# SPDX-License-Identifier: Apache-2.0
"""
Realisations of one system: modal, balanced, and with dead time approximated.

Functions of arrays; transformations are returned as T of the new states z = T x.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial

import numpy as np
from scipy.linalg import block_diag, cholesky, schur, solve_continuous_lyapunov, solve_sylvester

from ctsid_core.errors import DataError
from ctsid_core.linear.matrix_functions import SOUND, modes
from ctsid_core.linear.types import Array, ComplexArray, Places

# Poles this close to the imaginary axis, over |A|, have no Gramian worth the name; it is also how
# far rounding moves a double pole.
UNDAMPED = 1e-8


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


def _signs(c: ComplexArray) -> complex:
    # c1 + c2/sqrt(2) + ...: unlike the largest entry it does not switch between outputs, and
    # unlike the plain sum it is not zero for antisymmetric modes of symmetric sensors.
    return complex(c @ (1 / np.sqrt(np.arange(1, len(c) + 1))))


def modal(A: Array, C: Array) -> tuple[Array, Array]:
    """
    Return T to real modal states, scaled and signed as `StateSpace.modal` says, and the new A.

    Raises `DataError` if A has no usable basis of eigenvectors.
    """
    found = modes(A, SOUND)
    if found is None:
        raise DataError('poles coincide too closely for a modal form (the eigenvectors of A are '
                        'dependent); identify with a lower order')
    rows, blocks = [], []
    for k in pole_order(found.values):
        pole, c = found.values[k], C @ found.right[:, k]
        size, turn = np.linalg.norm(c), _signs(c)
        # An unobservable mode has no column of C to be scaled by: leave it as it is.
        scale = size * turn / abs(turn) if size and turn else 1.0
        row = scale * found.left[k]
        if pole.imag > 0:  # y = Re(c z) = Re(c) Re(z) - Im(c) Im(z); the second state is -Im(z)
            rows += [row.real, -row.imag]
            blocks.append(np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
        else:
            rows.append(row.real)
            blocks.append(np.array([[pole.real]]))
    shape = A.shape
    return np.array(rows).reshape(shape), np.asarray(block_diag(*blocks)).reshape(shape)


def _split(A: Array) -> tuple[Array, int]:
    # T that decouples A into unstable (first) and stable states, and how many are unstable
    limit = -UNDAMPED * float(np.linalg.norm(A))
    form, Z, unstable = schur(A, sort=lambda re, im=0.0: re >= limit)
    if unstable in (0, len(A)):
        return np.asarray(Z.T), int(unstable)
    X = solve_sylvester(form[:unstable, :unstable], -form[unstable:, unstable:],
                        -form[:unstable, unstable:])
    decouple = np.eye(len(A))
    decouple[:unstable, unstable:] = -X
    return decouple @ Z.T, int(unstable)


def _root(gramian: Array) -> Array:
    symmetric = (gramian + gramian.T) / 2
    try:
        return np.asarray(cholesky(symmetric, lower=True))
    except np.linalg.LinAlgError:  # semidefinite to rounding
        values, vectors = np.linalg.eigh(symmetric)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def balancing(A: Array, B: Array, C: Array) -> Array:
    """
    Return T that balances the stable part, the unstable one first; shape (n, n).

    Square-root method: A. C. Antoulas, "Approximation of Large-Scale Dynamical Systems", SIAM
    2005, section 7.3. Raises `DataError` if the stable part is not minimal.
    """
    if not len(A):
        return np.empty((0, 0))
    T, unstable = _split(A)
    inverse = np.linalg.inv(T)
    stable = slice(unstable, None)
    A, B, C = (T @ A @ inverse)[stable, stable], (T @ B)[stable], (C @ inverse)[:, stable]
    R = _root(solve_continuous_lyapunov(A, -B @ B.T))      # R R^T and L L^T are the Gramians
    L = _root(solve_continuous_lyapunov(A.T, -C.T @ C))
    U, sigma, _ = np.linalg.svd(L.T @ R)
    if len(sigma) and not sigma[-1] > len(T) * np.finfo(float).eps * sigma[0]:
        raise DataError(f'a state is not controllable or not observable (smallest Hankel singular '
                        f'value {sigma[-1]:.1e}, largest {sigma[0]:.1e}), so it cannot be '
                        'balanced; identify with a lower order')
    balance = (U / np.sqrt(sigma)).T @ L.T
    columns = np.linalg.solve(balance.T, C.T)
    signs = np.array([-1.0 if _signs(c.astype(complex)).real < 0 else 1.0 for c in columns])
    return np.asarray(block_diag(np.eye(unstable), signs[:, np.newaxis] * balance) @ T)


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
