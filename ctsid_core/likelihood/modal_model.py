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

    Outputs are over their size. What belongs to a real pole is real.
    """

    # (m,): real ones first, then one of each pair, that with positive imaginary part [rad/s]
    poles: ComplexArray
    b: ComplexArray   # (m, nu)
    c: ComplexArray   # (ny, m)
    x0: ComplexArray  # (records, m): modes at the start of each record
    D: Array          # (ny, nu)
    y0: Array         # (records, ny): trim
    delay: Array      # (nu,) [s]

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.poles) + int(np.count_nonzero(self.poles.imag > 0.0))
