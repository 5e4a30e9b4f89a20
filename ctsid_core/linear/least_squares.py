# SPDX-License-Identifier: Apache-2.0
"""Least squares of least norm, where regressors may be dependent, and factorisations for them."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from scipy.linalg.lapack import dgelsy, dgeqrf, dpstrf

from ctsid_core.linear.types import Array

_BLOCK = 32             # columns that LAPACK factorises at a time
_DEPENDENT = 1e-4       # part of a column that others do not explain: less is none


def solve(regressors: Array, targets: Array, tolerance: float) -> tuple[Array, float]:
    """
    Return Theta of least norm with targets = Theta regressors, and the condition number.

    Of regressors (r, N), targets (m, N): Theta (m, r). Rows are scaled to unit norm first, and
    singular values below the tolerance, relative to the largest, count as zero: noise-free data
    make the regressors exactly dependent. The condition is of the directions that were kept.
    """
    norm = np.sqrt(np.einsum('ij,ij->i', regressors, regressors))
    norm[norm == 0.0] = 1.0
    regressors = regressors / norm[:, np.newaxis]
    left, s, right = svd(regressors)
    rank = int(np.count_nonzero(s > tolerance * s[0])) if len(s) else 0
    theta = ((targets @ right[:rank].T) / s[:rank]) @ left[:, :rank].T / norm
    return theta, float(s[0] / s[rank - 1]) if rank else 1.0


def least_norm(regressors: Array, targets: Array, tolerance: float) -> Array:
    """
    Return the same Theta as `solve`, a third of the time, by a factorisation with pivoting.

    The inverse of the tolerance is the largest condition number of the directions that are kept.
    """
    r, count = regressors.shape
    if not 0 < r <= count:
        return solve(regressors, targets, tolerance)[0]
    norm = np.sqrt(np.einsum('ij,ij->i', regressors, regressors))
    norm[norm == 0.0] = 1.0
    work = 4 * r + 1 + _BLOCK * (r + 1) + 2 * len(targets)
    _, theta, _, _, _ = dgelsy((regressors / norm[:, np.newaxis]).T, targets.T,
                               np.zeros(r, dtype=np.intc), tolerance, work)
    return np.asarray(theta[:r].T / norm)


def orthonormal(columns: Array, tolerance: float) -> Array:
    """
    Return W, (k, r), such that columns @ W is an orthonormal basis of what they span.

    Of columns (m, k), scaled to unit norm first; directions whose singular value is below the
    tolerance, relative to the largest, are left out.
    """
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = np.inf
    _, s, right = svd(columns / size)
    kept = s > tolerance * np.max(s, initial=0.0)
    return np.asarray((right[kept] / s[kept, np.newaxis] / size).T)


def basis_of(columns: Array, before: Array | None = None, whole: Array | None = None) -> Array:
    """
    Return an orthonormal basis of what columns (m, k) add to one `before` them, (m, r).

    To 1e-8, in a third of the time of Householder's reflections: by Cholesky's decomposition with
    pivoting. Columns of which less is left than 1e-4, of the `whole` of them if they are what is
    left already, are left out: that is rounding, or none.
    """
    whole = columns if whole is None else whole
    size = np.sqrt(np.einsum('ij,ij->j', whole, whole))
    size[size == 0.0] = np.inf
    if before is not None:
        columns = columns - before @ (before.T @ columns)
    R, order, rank, _ = dpstrf(columns.T @ columns / size / size[:, np.newaxis],
                               tol=_DEPENDENT ** 2)
    kept = order[:rank] - 1
    back = scipy.linalg.solve_triangular(R[:rank, :rank], np.eye(rank))
    return np.asarray(columns[:, kept] @ (back / size[kept, np.newaxis]))


def triangle(columns: Array) -> Array:
    """
    Return the upper triangle R of columns = Q R, (m, n): (min(m, n), n).

    It is that of `numpy.linalg.qr` but for rounding and the signs of its rows, in half the time.
    Columns may be in any order of memory; the transpose of rows is quickest.
    """
    m, n = columns.shape
    return np.triu(dgeqrf(columns, lwork=_BLOCK * max(n, 1))[0][:n]) if m else np.zeros((0, n))


def svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Return the thin singular value decomposition, also where the fast algorithm gives up."""
    # Divide and conquer (LAPACK's gesdd) fails to converge on rare matrices that are perfectly
    # sound; the QR iteration (gesvd) is slower and does not.
    try:
        left, s, right = np.linalg.svd(matrix, full_matrices=False)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrix).all():
            raise
        left, s, right = scipy.linalg.svd(matrix, full_matrices=False, lapack_driver='gesvd')
    return left, s, right
