# SPDX-License-Identifier: Apache-2.0
"""
The QR factorisation of a tall matrix, from blocks of rows that fit into the cache.

Householder's factorisation of all columns at once reads the whole matrix twice for each of them:
a long record is fetched from memory a hundred times. Rows are therefore taken some at a time,
and each block is annihilated by the triangle of those before it (LAPACK's dtpqrt). That is as
stable as the factorisation of the whole (Demmel, Grigori, Hoemmen and Langou 2012, SIAM J. Sci.
Comput. 34).

Columns that are zero before some row or after another, as what belongs to one part of a divided
record is, do not take part there.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.linalg.lapack import dgeqrf, dtpqrt

from ctsid_core.linear.types import Array, Places

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
    first, last = _extents(columns)
    found = []
    for start, end in pairwise(_edges(first, last, m, n)):
        alive = np.flatnonzero((first < end) & (last > start))
        part = np.zeros((len(alive), n))
        part[:, alive] = _reduced(columns[start:end], alive)
        found.append(part)
    if len(found) == 1 and len(found[0]) == n:
        return found[0]
    return triangle(np.concatenate([*found, np.zeros((n, n))]))


def _reduced(columns: Array, alive: Places) -> Array:
    """Return the triangle of some of the columns."""
    n = len(alive)
    whole = n == columns.shape[1]
    R = np.zeros((n, n), order='F')
    for start in range(0, len(columns) if n else 0, _ROWS):
        block = columns[start:start + _ROWS]
        R = dtpqrt(0, min(_PANEL, n), R, np.array(block if whole else block[:, alive], order='F'),
                   overwrite_a=1, overwrite_b=1)[0]
    return np.triu(R)


def _extents(columns: Array) -> tuple[Places, Places]:
    """Return the first row in which each column is not zero, and the one after the last."""
    m, n = columns.shape
    first, last = np.zeros(n, dtype=np.intp), np.full(n, m, dtype=np.intp)
    short = np.flatnonzero((columns[0] == 0.0) | (columns[-1] == 0.0))
    for column in short.tolist():            # one at a time: all at once are a copy of the whole
        there = columns[:, column] != 0.0
        some = bool(there.any())
        first[column] = np.argmax(there) if some else m
        last[column] = m - np.argmax(there[::-1]) if some else 0
    return first, last


def _edges(first: Places, last: Places, m: int, n: int) -> list[int]:
    """Return the rows at which columns begin or end, those too near to the one before left out."""
    edges = [0]
    for place in np.unique(np.concatenate((first, last))).tolist():
        if place - edges[-1] >= 2 * n and m - place >= 2 * n:
            edges.append(place)
    return [*edges, m]
