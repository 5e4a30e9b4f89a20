# SPDX-License-Identifier: Apache-2.0
"""A model in modal form, with what belongs to single records."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray


@dataclass(frozen=True, eq=False)
class ModalModel:
    """
    y_i = sum_l Re(c_il z_l) + D_i u + y0_i,   dz_l/dt = p_l z_l + b_l u(t - delay).

    Parameters
    ----------
    poles : ndarray, shape (m,)
        Real ones first, then one of each pair, that with positive imaginary part [rad/s].
    b : ndarray, shape (m, nu)
    c : ndarray, shape (ny, m)
    x0 : ndarray, shape (records, m)
        Modes at the start of each record.
    D : ndarray, shape (ny, nu)
    y0 : ndarray, shape (records, ny)
        Trim.
    delay : ndarray, shape (nu,)
        [s]

    Notes
    -----
    Outputs are over their size. What belongs to a real pole is real.
    """

    poles: ComplexArray
    b: ComplexArray
    c: ComplexArray
    x0: ComplexArray
    D: Array
    y0: Array
    delay: Array

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.poles) + int(np.count_nonzero(self.poles.imag > 0.0))
