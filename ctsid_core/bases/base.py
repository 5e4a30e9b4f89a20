# SPDX-License-Identifier: Apache-2.0
"""The seam between bases and subspace methods."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Lines = NDArray[np.complex128]


@dataclass(frozen=True)
class Projection:
    """
    A record in a basis in which the derivative is diagonal.

    All rows are spectral lines f_k, one complex number per line with frequency >= 0. Real and
    imaginary parts of all lines together are an orthonormal image of the basis coefficients
    (lines of positive frequency carry the factor sqrt(2) of their conjugates), so that sums of
    squares over them are those over the coefficients.

    Parameters
    ----------
    s : ndarray, shape (L,)
        The derivative, line by line [rad/s]: purely imaginary.
    u : ndarray, shape (nu, L)
    y : ndarray, shape (ny, L)
    tail : ndarray, shape (0 or parts, L)
        The virtual inputs that stand for the truncated part of the state's derivative, one for
        each part of a divided record.
    ones : ndarray, shape (0 or 1, L)
        The constant 1: trim of states and outputs.
    unit : float
        Time that a coordinate unit stands for [s]: white noise of intensity R has variance
        R / unit in every real and imaginary part.
    start, end : float
        The interval of the record [s].
    slopes : ndarray, shape (nu, L), or None
        Derivatives of u by the dead times that were estimated [1/s], zero for those that are
        known; None if all are.
    """

    s: Lines
    u: Lines
    y: Lines
    tail: Lines
    ones: Lines
    unit: float
    start: float
    end: float
    slopes: Lines | None = None

    @cached_property
    def signals(self) -> Lines:
        """Rows of u, tail, ones and y, one below the other."""
        return np.vstack((self.u, self.tail, self.ones, self.y))

    @cached_property
    def weights(self) -> Array:
        """How many real numbers each line stands for, (L,): 2, but 1 at frequency zero."""
        return np.where(self.s == 0.0, 1.0, 2.0)

    @cached_property
    def count(self) -> float:
        """How many real numbers the lines stand for in all."""
        return float(self.weights.sum())


def as_real(lines: Lines) -> Array:
    """Return real and imaginary parts as columns: (m, L) complex to (m, 2 L) real."""
    real: Array = np.ascontiguousarray(lines).view(np.float64)
    return real


def real_times(matrix: Array, lines: Lines) -> Lines:
    """Return the product of a real matrix (k, m) and lines (m, L), without complex arithmetic."""
    product: Lines = (matrix @ as_real(lines)).view(np.complex128)
    return product
