# SPDX-License-Identifier: Apache-2.0
"""Least squares of least norm, where regressors may be dependent."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgelsy

from ctsid_core.linear.matrix_functions import svd
from ctsid_core.linear.types import Array

_BLOCK = 32           # columns that LAPACK factorises at a time


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
    found: Array = (right[kept] / s[kept, np.newaxis] / size).T
    return found
