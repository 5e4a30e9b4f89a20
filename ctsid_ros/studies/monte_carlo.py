# SPDX-License-Identifier: Apache-2.0
"""What comes of a run of an experiment, and what the errors of many runs amount to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from ctsid_core.identify import identify
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Settings
from ctsid_ros.studies.experiments import Run


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    What came of one run.

    Parameters
    ----------
    error : ndarray, shape (n,)
        Of each true pole, in the order of the true model's; NaN if the order is wrong [rad/s].
    deviation : ndarray, shape (n,)
        What the estimate says of it.
    order : int
        Of the model; 0 if there is none.
    status : str
    model : StateSpace, optional
        A, B, C and D.
    """

    error: ComplexArray
    deviation: Array
    order: int
    status: str
    model: StateSpace | None = None


def outcome(run: Run, settings: Settings | None = None) -> Outcome:
    """Identify one run; a rejected model counts, and its status is noted."""
    estimate = identify(run.record, settings)
    return compared(estimate.model or estimate.rejected_model, run.model.poles,
                    np.asarray(estimate.pole_std), estimate.status.name)


def compared(model: StateSpace | None, truth: ComplexArray, deviation: Array | None = None,
             status: str = 'OK') -> Outcome:
    """Return the outcome of a run that gave a model, or none, where these poles are the true."""
    error, said = np.full(len(truth), np.nan + 0j), np.full(len(truth), np.nan)
    if model is None:
        return Outcome(error, said, 0, status)
    if model.n == len(truth):
        columns, rows = linear_sum_assignment(np.abs(truth[:, np.newaxis] - model.poles))
        error[columns] = model.poles[rows] - truth[columns]
        if deviation is not None:
            said[columns] = deviation[rows]
    plain = StateSpace(model.A, model.B, model.C, model.D)
    return Outcome(error, said, model.n, status, plain)


@dataclass(frozen=True, eq=False)
class Summary:
    """
    What errors amount to, pole by pole; only of the runs with the right order, NaN without any.

    Parameters
    ----------
    errors : ndarray, shape (runs, n)
    deviation : ndarray, shape (n,)
        Root mean square of what the estimates say.
    right, ok : float
        Part of the runs with the right order; with status OK.
    runs : int
        How many there are, with the right order or not.
    """

    errors: ComplexArray
    deviation: Array
    right: float
    ok: float
    runs: int

    @property
    def bias(self) -> Array:
        """|mean error| ([HD] eq. 60)."""
        return np.asarray(np.abs(self.mean))

    @property
    def mean(self) -> ComplexArray:
        """Mean error."""
        return np.asarray(self.errors.mean(axis=0) if len(self.errors)
                          else np.full(self.errors.shape[1], np.nan + 0j))

    @property
    def std(self) -> Array:
        """Standard deviation ([HD] eq. 61)."""
        square = np.sum(np.abs(self.errors - self.mean) ** 2, axis=0)
        return np.asarray(np.sqrt(square / (max(0, len(self.errors) - 1) or np.nan)))

    @property
    def rmse(self) -> Array:
        """Root mean square error."""
        return np.asarray(np.sqrt(np.sum(np.abs(self.errors) ** 2, axis=0)
                                  / (len(self.errors) or np.nan)))

    def beside(self, bound: Array, i: int) -> tuple[str, ...]:
        """Return cells of a pole: its error, a bound, how both compare, and how often it is."""
        return (*(f'{x:.3g}' for x in (self.rmse[i], bound[i])), *(
            f'{x / y:.2f}' for x, y in ((self.rmse[i], bound[i]),
                                        (self.deviation[i], self.rmse[i]))),
            f'{100 * self.right:.1f} %', f'{100 * self.ok:.1f} %', str(self.runs))


def summary(outcomes: Sequence[Outcome]) -> Summary:
    """Return what outcomes amount to."""
    errors, said = (np.array([getattr(o, name) for o in outcomes])
                    for name in ('error', 'deviation'))
    right = np.isfinite(errors).all(axis=1)
    deviation = np.sqrt(np.sum(said[right] ** 2, axis=0) / (np.sum(right) or np.nan))
    return Summary(errors[right], deviation, float(right.mean()),
                   float(np.mean([o.status == 'OK' for o in outcomes])), len(outcomes))


def of_poles(model: StateSpace) -> list[tuple[str, int]]:
    """Return the name of each pole, one of every pair, and its place among `model.poles`."""
    return [(f'{p.real:.4g}' + (f' ± {p.imag:.4g}i' if p.imag else ''), i)
            for i, p in enumerate(model.poles) if p.imag >= 0.0]
