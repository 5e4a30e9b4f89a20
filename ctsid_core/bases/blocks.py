# SPDX-License-Identifier: Apache-2.0
"""
Products with a large table of which much is zero, for few vectors at a time.

A Hermite function is nothing beyond its reach, so that a fourth of a table of them is zero, on one
side of each row. Such products take the time to read the table from memory: it is therefore kept
in blocks of rows without their zeros, each of which is read once and serves all vectors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array

_NOTHING = 1e-18        # over the largest entry: far below rounding
_ROWS = 48              # of a block
_FEW = 4                # vectors that are taken one after the other


@dataclass(frozen=True, eq=False)
class Blocks:
    """A matrix in blocks of rows."""

    shape: tuple[int, int]                      # rows and columns
    blocks: tuple[tuple[int, int, Array], ...]  # of each: first row, first column, entries

    @classmethod
    def of(cls, matrix: Array) -> Blocks:
        """Return the blocks of a matrix (r, c)."""
        least = _NOTHING * float(np.abs(matrix).max(initial=0.0))
        found = []
        for row in range(0, len(matrix), _ROWS):
            part = matrix[row:row + _ROWS]
            there = np.flatnonzero((np.abs(part) > least).any(axis=0))
            if len(there):
                found.append((row, int(there[0]), np.ascontiguousarray(
                    part[:, there[0]:there[-1] + 1])))
        return cls((matrix.shape[0], matrix.shape[1]), tuple(found))

    def times(self, vectors: Array) -> Array:
        """Return the products of the matrix (r, c) with vectors (m, c): (m, r)."""
        found = np.zeros((len(vectors), self.shape[0]))
        vectors = np.ascontiguousarray(vectors)
        for row, column, entries in self.blocks:
            rows, columns = (slice(first, first + n) for first, n in
                             zip((row, column), entries.shape, strict=True))
            if len(vectors) > _FEW:
                np.matmul(vectors[:, columns], entries.T, out=found[:, rows])
                continue
            for vector, out in zip(vectors, found, strict=True):
                np.dot(entries, vector[columns], out=out[rows])
        return found
