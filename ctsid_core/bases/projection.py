# SPDX-License-Identifier: Apache-2.0
"""The seam between bases and subspace methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from ctsid_core.linear.types import Array, Lines


@dataclass(frozen=True)
class Projection:
    """
    A record in a basis in which the derivative is diagonal.

    All rows are spectral lines f_k, one complex number per line with frequency >= 0. Real and
    imaginary parts of all lines together are an orthonormal image of the basis coefficients (lines
    of positive frequency carry the factor sqrt(2) of their conjugates), so that sums of squares
    over them are those over the coefficients.
    """

    s: Lines      # (L,): the derivative, line by line [rad/s]: purely imaginary
    u: Lines      # (nu, L)
    y: Lines      # (ny, L)
    # (0 or parts, L): virtual inputs that stand for the truncated part of the state's derivative,
    # one for each part of a divided record, one record after the other
    tail: Lines
    ones: Lines   # (0 or records, L): the constant 1 over each record: trim of states and outputs
    # Time that a coordinate unit stands for [s]: white noise of intensity R has variance R / unit
    # in every real and imaginary part
    unit: float
    length: float  # of the record, or of one of its parts; of several records the longest [s]


def joined(records: Sequence[Projection]) -> Projection:
    """Return lines of several records, each with its own `ones`, side by side; of one, itself."""
    if len(records) == 1:
        return records[0]
    unit = max(p.unit for p in records)
    sized = [(float(np.sqrt(p.unit / unit)), p) for p in records]
    return Projection(
        s=np.concatenate([p.s for p in records]), u=np.hstack([size * p.u for size, p in sized]),
        y=np.hstack([size * p.y for size, p in sized]),
        tail=block_diag(*(size * p.tail for size, p in sized)),
        ones=block_diag(*(size * p.ones for size, p in sized)),
        unit=unit, length=max(p.length for p in records))


def as_real(lines: Lines) -> Array:
    """Return real and imaginary parts as columns: (m, L) complex to (m, 2 L) real."""
    return np.ascontiguousarray(lines).view(np.float64)
