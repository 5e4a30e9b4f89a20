# SPDX-License-Identifier: Apache-2.0
"""Arrays by what they hold, and the matrices of a model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Lines = NDArray[np.complex128]  # spectral lines, one column per frequency
Mask = NDArray[np.bool_]
Places = NDArray[np.intp]


@dataclass(frozen=True)
class Matrices:
    """A model of the moving channels, with what belongs to one record."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    start: Array   # (n,): state at the start of the record
    x_trim: Array  # (n,)
    y_trim: Array  # (ny,)


def plain_matrices(A: Array, B: Array, C: Array, D: Array, K: Array | None = None) -> Matrices:
    """Return a model at rest, without trim and, unless given, without K."""
    n, ny = len(A), len(C)
    return Matrices(A, B, C, D, np.zeros((n, ny)) if K is None else K, np.zeros(n), np.zeros(n),
                    np.zeros(ny))
