# SPDX-License-Identifier: Apache-2.0
"""The result of an identification: a model or none, and what is known about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ctsid_core.settings import Settings
from ctsid_core.statespace import StateSpace

Array = NDArray[np.float64]


class Status(Enum):
    """Outcome of an identification; the value is the sentence shown to the user."""

    OK = 'A model was identified.'
    TOO_SHORT = ('The window holds too few samples or too short a time for a model; take a '
                 'longer window.')
    NO_EXCITATION = ('No input moves within the window; excite the inputs, or choose a window in '
                     'which they move.')
    NO_RESPONSE = ('No output moves within the window; check that the right topics and fields '
                   'are used.')
    GAPS = ('Too much of the window lies in gaps of the data; find out why messages are '
            'missing, or choose another window.')
    UNEXPLAINED = ('No linear model explains the outputs by the inputs; check the choice of '
                   'inputs and outputs, the dead time and the order, or the plant is not linear '
                   'over this window.')
    UNRELIABLE = ('The data do not determine a single pole well enough for a trustworthy model; '
                  'excite more frequencies, take a longer window, or lower the order.')
    CHANGED = ('The plant, or the offset of a signal, changed within the window, and one model of '
               'both would be wrong; take a window before or after the change, or wait until the '
               'change has left the window.')


@dataclass(frozen=True)
class Choice:
    """One parameter that was set from the data: its value and the reason."""

    name: str
    value: object
    why: str


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """
    What one window of data told.

    Parameters
    ----------
    status : Status
        `Status.OK`, or what to do next.
    model : StateSpace or None
        The model; None unless the status is OK, so that nobody takes a bad one by accident.
    rejected_model : StateSpace or None
        A model that was computed but not accepted: for people to look at, not for controllers.
    settings : Settings
        As used: automatic values filled in.
    pole_std : ndarray, shape (n,)
        Standard deviation of each pole [rad/s], in the order of `model.poles`: the square root
        of the expected squared distance |estimate - truth| in the complex plane; NaN if unknown.
    fit : ndarray, shape (ny,)
        Simulation fit (NRMSE) of each output on the window itself [%]. Of an unstable plant with
        process noise: by how much its inputs make one-step predictions better (`predicted_fit`).
    held_out_fit : ndarray, shape (ny,)
        How much of each output the inputs explain on a part of the window that was kept from a
        second model (`unseen_fit`) [%]; NaN if none was kept.
    singular_values : ndarray
        Of the state sequence; their drop shows the order.
    condition : float
        Condition number of the regression.
    choices : tuple of Choice
        What was chosen automatically, and why.
    notes : tuple of str
        What else the user should know (gaps, constant channels, removed inputs).
    start_ns, end_ns : int
        The window, absolute [ns].
    statistics : dict of str to float
        Further numbers, by name with unit.
    """

    status: Status
    settings: Settings
    model: StateSpace | None = None
    rejected_model: StateSpace | None = None
    pole_std: Array = field(default_factory=lambda: np.empty(0))
    fit: Array = field(default_factory=lambda: np.empty(0))
    held_out_fit: Array = field(default_factory=lambda: np.empty(0))
    singular_values: Array = field(default_factory=lambda: np.empty(0))
    condition: float = float('nan')
    choices: tuple[Choice, ...] = ()
    notes: tuple[str, ...] = ()
    start_ns: int = 0
    end_ns: int = 0
    statistics: dict[str, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether there is an accepted model."""
        return self.model is not None
