# SPDX-License-Identifier: Apache-2.0
"""What a method other than HD-PBSID has to give: models of the moving channels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.joint import Joint
from ctsid_core.pbsid import Matrices
from ctsid_core.settings import Settings
from ctsid_core.signals import Array


@dataclass(frozen=True, eq=False)
class Made:
    """
    A continuous-time model of the moving channels, one of those that a method offers.

    Parameters
    ----------
    matrices : Matrices
        A, B, C, D and K (zero if the method has none), by `plain_matrices`: what belongs to the
        ends and the trim of the records is added by the caller.
    settings : Settings
        Those given, with the order and whatever the method chose filled in: with these the method
        makes this model, and no other.
    singular_values : ndarray
        Whose drop shows the order.
    condition : float
        Condition number of the regression.
    """

    matrices: Matrices
    settings: Settings
    singular_values: Array
    condition: float


# From the records, the settings and the orders that are wanted to all models that the method has
# to offer: of every order and every tuning that the settings leave open. Orders that the data are
# too short for are left out; the likeliest of the others is taken (`by_method.py`).
Method = Callable[[Joint, Settings, Sequence[int]], list[Made]]


def plain_matrices(A: Array, B: Array, C: Array, D: Array, K: Array | None = None) -> Matrices:
    """Return a model without anything that belongs to single records."""
    n, ny = len(A), len(C)
    return Matrices(A=A, B=B, C=C, D=D, K=np.zeros((n, ny)) if K is None else K,
                    tail=np.empty((n, 0)), x_trim=np.empty((n, 0)), y_trim=np.empty((ny, 0)))
