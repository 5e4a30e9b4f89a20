# SPDX-License-Identifier: Apache-2.0
"""The matrices of a model in the projected domain, with what its records need beside the plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array


@dataclass(frozen=True)
class Matrices:
    """A model of a projection: A, B, C, D, K, and what belongs to each record."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    tail: Array    # (n, 0 or parts): effect of the virtual inputs
    x_trim: Array  # (n, 0 or records): effect of the constant over each record
    y_trim: Array  # (ny, 0 or records)


def plain_matrices(A: Array, B: Array, C: Array, D: Array, K: Array | None = None) -> Matrices:
    """Return a model without anything that belongs to single records; without K it is zero."""
    n, ny = len(A), len(C)
    return Matrices(A=A, B=B, C=C, D=D, K=np.zeros((n, ny)) if K is None else K,
                    tail=np.empty((n, 0)), x_trim=np.empty((n, 0)), y_trim=np.empty((ny, 0)))
