# SPDX-License-Identifier: Apache-2.0
"""The derivatives of prediction errors by dead times: columns beside those of `jacobian`."""

from __future__ import annotations

import numpy as np

from ctsid_core.bases.projection import Projection, as_real, real_times
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import Resolvent, resolvent
from ctsid_core.linear.types import Array


def delay_columns(projection: Projection, m: Matrices, whiten: Array,
                  closed: Resolvent | None = None) -> Array:
    """
    Return the derivatives of -E by the dead times of the inputs.

    Parameters
    ----------
    projection : Projection
        With `slopes`; without, there are no columns.
    m : Matrices
    whiten : ndarray, shape (ny, ny)
        Multiplies E.
    closed : Resolvent, optional
        Of A - K C, if it is at hand.

    Returns
    -------
    ndarray, shape (ny 2 L, nu)
        (C (s I - A bar)^-1 B bar + D) dU/dd, an input each; zero where a dead time is known.
    """
    if projection.slopes is None:
        return np.empty((2 * len(m.C) * len(projection.s), 0))
    closed = closed or resolvent(m.A - m.K @ m.C, projection.s)
    gain = real_times((m.B - m.K @ m.D).T, closed.outputs(m.C).reshape(len(m.A), -1))
    through = gain.reshape(len(m.B.T), len(m.C), -1) + m.D.T[:, :, np.newaxis]
    moved = (through * projection.slopes[:, np.newaxis]).reshape(len(m.B.T), len(m.C), -1)
    found: Array = np.stack([(whiten @ as_real(part)).ravel() for part in moved], axis=1)
    return found
