# SPDX-License-Identifier: Apache-2.0
"""The matrices of a model in the projected domain, with what its records need beside the plant."""

from __future__ import annotations

from dataclasses import dataclass

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
