# SPDX-License-Identifier: Apache-2.0
"""
The QR factorisation of a tall matrix, from blocks of rows that fit into the cache.

Householder's factorisation of all columns at once reads the whole matrix twice for each of them:
a long record is fetched from memory a hundred times. Rows are therefore taken some at a time,
and each block is annihilated by the triangle of those before it (LAPACK's dtpqrt). That is as
stable as the factorisation of the whole (Demmel, Grigori, Hoemmen and Langou 2012, SIAM J. Sci.
Comput. 34).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgeqrf, dtpqrt

from ctsid_core.linear.types import Array

_SMALL = 2 ** 16        # entries: half a megabyte stays in the cache anyhow
_ROWS = 1024            # taken at a time
_PANEL = 8              # columns that LAPACK factorises at a time there
_BLOCK = 32             # and of a small matrix


def triangle(columns: Array) -> Array:
    """
    Return the upper triangle R of columns = Q R, (m, n): (min(m, n), n).

    It is that of `numpy.linalg.qr` but for rounding and the signs of its rows. Columns may be in
    any order of memory; the transpose of rows is quickest.
    """
    m, n = columns.shape
    if not m:
        return np.zeros((0, n))
    if m * n < _SMALL or m < 4 * n:
        small = dgeqrf(columns, lwork=_BLOCK * max(n, 1))[0][:n]
        return np.triu(small)
    R = np.zeros((n, n), order='F')
    for start in range(0, m, _ROWS):
        block = np.array(columns[start:start + _ROWS], order='F')
        R = dtpqrt(0, min(_PANEL, n), R, block, overwrite_a=1, overwrite_b=1)[0]
    return np.triu(R)
