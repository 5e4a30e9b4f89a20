# SPDX-License-Identifier: Apache-2.0
"""The matrices of a model in the projected domain, with what its records need beside the plant."""

from __future__ import annotations

from dataclasses import dataclass

from ctsid_core.linear.types import Array


@dataclass(frozen=True)
class Matrices:
    """
    A model of a projection: A, B, C, D, K, and what belongs to each record.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    B : ndarray, shape (n, nu)
    C : ndarray, shape (ny, n)
    D : ndarray, shape (ny, nu)
    K : ndarray, shape (n, ny)
    tail : ndarray, shape (n, 0 or parts)
        Effect of the virtual inputs.
    x_trim, y_trim : ndarray, shapes (n, 0 or records), (ny, 0 or records)
        Effect of the constant over each record.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    tail: Array
    x_trim: Array
    y_trim: Array
