# SPDX-License-Identifier: Apache-2.0
"""The result of an identification: a model or none, and what is known about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array
from ctsid_core.model import covariance as known
from ctsid_core.model.covariance import Covariance, ResponseDeviation
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import UNJUDGED, Grade, Remedy, Verdict
from ctsid_core.settings import Settings


class Status(Enum):
    """Outcome of an identification; the value is the sentence shown to the user."""

    OK = 'A model was identified.'
    TOO_SHORT = ('The window holds too few samples or too short a time for a model; take a '
                 'longer window.')
    NO_EXCITATION = ('No input moves within the window; choose a part of the data in which they '
                     'move.')
    NO_RESPONSE = ('An output does not move within the window, or is stuck; check that its sensor '
                   'works.')
    UNEXPLAINED = ('No linear model explains all outputs by the inputs; check that these '
                   'are the right signals.')
    UNRELIABLE = ('No finite model could be computed from the data; check the signals, their '
                  'sizes and units, and that the window is long enough.')
    CHANGED = ('The plant, or the offset of a signal, changed within the window, and one model of '
               'both would be wrong; identify each side of the change by itself.')


REMEDIES = {Status.TOO_SHORT: Remedy.LONGER, Status.CHANGED: Remedy.SPLIT,
            Status.NO_EXCITATION: Remedy.PART}                                # else the signals


@dataclass(frozen=True)
class Choice:
    """One parameter that was set from the data: its value and the reason."""

    name: str
    value: object
    why: str
    deviation: float = float('nan')     # standard deviation of what acts of an input


@dataclass(frozen=True)
class RecordShare:
    """What belongs to one of several records alone."""

    number: int      # of the record among those given, from 1
    start_ns: int    # its interval, absolute [ns]
    end_ns: int
    x_trim: Array    # (n,): its trim, in the state coordinates of the model
    y_trim: Array    # (ny,)
    fit: Array       # (ny,): simulation fit (NRMSE) of each output on it [%]
    # By which its noise is smaller than that of all records (geometric mean)
    weight: float = 1.0


@dataclass(frozen=True)
class OrderTried:
    """One order that the search tried."""

    order: int
    criterion: float  # Schwarz's criterion, above that of the most likely order
    fit: float        # simulation fit of the worst output, on the window itself [%]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """
    The result of identifying one window of data.

    Parameters
    ----------
    status : Status
    model : StateSpace or None
        None unless the status is OK, so that nobody takes a bad one by accident.
    rejected_model : StateSpace or None
        One that was computed but not accepted: for people to look at, not for controllers.
    settings : Settings
        As used: automatic values filled in.
    pole_std : ndarray, shape (n,)
        Standard deviation of each pole [rad/s], in the order of `model.poles`: the square root
        of the expected squared distance of estimate and truth in the complex plane; NaN if not
        known.
    covariance : Covariance or None
        Of the entries of the model, or of the rejected one if there is no other; None if unknown.
    fit : ndarray, shape (ny,)
        Simulation fit (NRMSE) of each output on the window itself [%].
    held_out_fit : ndarray, shape (ny,)
        The same on a part of the window that was kept from a second model, over the motion of the
        whole window [%]; NaN if none was kept.
    singular_values : ndarray
        Of the state sequence; their drop shows the order.
    condition : float
        Condition number of the regression.
    choices : tuple of Choice
        What was chosen automatically, and why.
    orders : tuple of OrderTried
        The orders among which was chosen, lowest first; empty if the order was given.
    notes : tuple of str
        What else the user should know (pauses, constant channels, removed inputs).
    start_ns, end_ns : int
        The window, absolute [ns]; of several records the first start and the last end.
    statistics : dict of str to float
        Further numbers, by name with unit.
    records : tuple of RecordShare
        Of several records that were identified together, those that were used; else empty. The
        model's trim and noise are those of the record that ends last.
    verdict : Verdict
        REJECT if and only if `model` is None: without a model it is made so.

    Raises
    ------
    DataError
        If a model is given together with the verdict REJECT.
    """

    status: Status
    settings: Settings
    model: StateSpace | None = None
    rejected_model: StateSpace | None = None
    pole_std: Array = field(default_factory=lambda: np.empty(0))
    covariance: Covariance | None = None
    fit: Array = field(default_factory=lambda: np.empty(0))
    held_out_fit: Array = field(default_factory=lambda: np.empty(0))
    singular_values: Array = field(default_factory=lambda: np.empty(0))
    condition: float = float('nan')
    choices: tuple[Choice, ...] = ()
    orders: tuple[OrderTried, ...] = ()
    notes: tuple[str, ...] = ()
    start_ns: int = 0
    end_ns: int = 0
    statistics: dict[str, float] = field(default_factory=dict)
    records: tuple[RecordShare, ...] = ()
    verdict: Verdict = UNJUDGED

    def __post_init__(self) -> None:
        if self.model is None and self.verdict.grade is not Grade.REJECT:
            none = replace(self.verdict, grade=Grade.REJECT, reason=self.status.value,
                           remedy=REMEDIES.get(self.status, Remedy.SIGNALS))
            object.__setattr__(self, 'verdict', none)
        elif self.model is not None and self.verdict.grade is Grade.REJECT:
            raise DataError('`verdict` is REJECT but `model` is given; give it as '
                            '`rejected_model`')

    @property
    def good(self) -> bool:
        """Whether the model may be acted on: the verdict is GOOD."""
        return self.verdict.grade is Grade.GOOD

    @property
    def ok(self) -> bool:
        """Whether there is an accepted model, GOOD or WEAK."""
        return self.model is not None

    @property
    def by_predictions(self) -> bool:
        """Whether the model was found by its predictions: then its fits are of these."""
        return any(c.name == 'domain' and c.value == 'predictions' for c in self.choices)

    @property
    def pole_covariance(self) -> Array:
        """Covariance of (real part, imaginary part) of each pole, (n, 2, 2) [rad^2/s^2]."""
        return self._derived(known.pole_covariance, 'n', 2, 2)

    @property
    def natural_frequency_std(self) -> Array:
        """Standard deviation of each natural frequency, (n,) [rad/s]."""
        return self._derived(known.natural_frequency_deviation, 'n')

    @property
    def damping_std(self) -> Array:
        """Standard deviation of each damping ratio, (n,); 0 for real poles."""
        return self._derived(known.damping_deviation, 'n')

    @property
    def dc_gain_std(self) -> Array:
        """Standard deviation of the DC gain, (ny, nu); infinite where the gain is."""
        return self._derived(known.gain_deviation, 'ny', 'nu')

    @property
    def delay_std(self) -> Array:
        """Standard deviation of each dead time, (nu,) [s]; 0 where none was looked for."""
        return self._derived(known.delay_deviation, 'nu')

    def frequency_response_std(self, omega: ArrayLike) -> ResponseDeviation:
        """
        Return the standard deviations of magnitude (over the magnitude) and phase [rad].

        At frequencies omega (M,) [rad/s]: two arrays of shape (M, ny, nu); NaN where unknown.
        """
        return ResponseDeviation(*self._derived(
            lambda covariance, model: np.array(known.response_deviation(covariance, model, omega)),
            2, np.size(omega), 'ny', 'nu'))

    def _derived(self, what: Callable[[Covariance, StateSpace], Array],
                 *shape: str | int) -> Array:
        """Return what follows from the covariance; NaN if there is none, 0 states if no model."""
        model = self.model or self.rejected_model
        if model is not None and self.covariance is not None:
            return what(self.covariance, model)
        return np.full([size if isinstance(size, int) else getattr(model, size, 0)
                        for size in shape], np.nan)

    def trimmed(self, model: StateSpace, number: int) -> StateSpace:
        """
        Return `model`, or `rejected_model`, at the trim of one of several records.

        `number` counts the records that were given from 1; of one that was not used, the model's
        trim stays.
        """
        for record in self.records:
            if record.number == number:
                return replace(model, x_trim=record.x_trim, y_trim=record.y_trim)
        return model
