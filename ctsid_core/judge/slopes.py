# SPDX-License-Identifier: Apache-2.0
"""
What a model could be instead, to first order, beside what it leaves of the samples.

A car that gains speed, a battery that sags, a motor that warms up: a model of the mean is as good
as one can be, and may be what is wanted, but its user should know what constant numbers miss, and
such that move in a straight line do not. Dead times alone drift where the clocks of input and
output run apart. Looked at beside curves, which a plant that is not linear follows better.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctsid_core.judge.curve import MOST, beside, curves_of
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.likelihood.output_error import Fit, Free, fit_states, jacobian
from ctsid_core.likelihood.residuals import independent
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, Mask

SEARCHED = 1200       # samples of a stream that are looked at
NOTED = 1.0           # per cent of the motion that one model has to miss, to be worth a word

Own = tuple[ModalModel, Free]              # a model, and what is free in it


class Left(NamedTuple):
    """What columns leave of the errors, each output of each record over its rms before."""

    errors: list[Array]
    power: Array
    numbers: int            # of columns that tell something
    cost: float             # -2 log likelihood, and one for each of them


class Slopes(NamedTuple):
    """Derivatives of the simulation by what is free, outputs over the rms of their errors."""

    fit: Fit
    rows: Array             # (N, k)
    error: Array            # (N,)
    states: Mask            # (k,): columns of initial states and trims
    shares: Array           # (N,): when, as a part of the record
    delays: Mask            # (k,): columns of dead times
    records: Array          # (N,): of which record
    counts: Array           # samples of each output of each record
    samples: Samples

    @property
    def rest(self) -> Array:
        """The columns that are of no state and no trim."""
        return self.rows[:, ~self.states]

    @property
    def drift(self) -> Array:
        """The same of numbers that move in a straight line within each record."""
        return self.rest * (self.shares - 0.5)[:, np.newaxis]

    def beside(self, more: Array) -> Left:
        """Return what further columns leave, at most half as many as there are samples."""
        columns = np.hstack((self.rows, more))
        if columns.shape[1] > MOST * len(self.error):
            return Left([], np.full(len(self.counts), np.inf), 0, np.inf)
        self.samples.effort.spend(1.5 * len(self.error) * columns.shape[1] ** 2)
        left, told = beside(columns, self.error)
        errors = np.split(left, np.cumsum(self.counts)[:-1])
        power = np.maximum([float(np.mean(e ** 2)) for e in errors], 1e-300)
        return Left(errors, power, told, float(self.counts @ np.log(power)) + told)


def only(samples: Samples, place: int) -> Samples:
    """Return one record: its states are fitted anew."""
    return replace(samples, records=samples.records[place:place + 1])


def slopes_of(samples: Samples, own: Own) -> Slopes:
    """Return what may change the simulation of each sample of these records."""
    model, free = own
    columns = columns_of(samples, model.poles, model.delay, direct=free.feedthrough,
                         turned=False)
    fit = fit_states(samples, model, free, columns)
    rows, error, places = jacobian(samples, fit, free)
    times = [[(s.times - r.start) / (r.end - r.start)
              for s in r.streams for _ in range(s.y.shape[1])] for r in samples.records]
    number = np.arange(rows.shape[1]) - places.poles
    return Slopes(
        fit, rows, error, places.of_states(samples.ny, len(times), free.trim),
        np.concatenate([t for one in times for t in one]),
        (number >= 0) & (number < places.delays),
        np.repeat(np.arange(len(times)), [sum(map(len, one)) for one in times]),
        np.array([len(t) for one in times for t in one]), samples)


class Drift(NamedTuple):
    """What a model misses of the motion because the plant drifts."""

    record: int = -1        # its place; -1 if none does
    cost: float = 0.0       # rms over the motion, of the output where it is most [%]
    late: bool = False      # whether dead times alone explain most of it


def drift_of(samples: Samples, fit: Fit, free: Free, least: float = NOTED) -> Drift:
    """Return the drift of the record where it costs most, if more than the `least` [%]."""
    if not np.max(fit.power) > (0.01 * least) ** 2:
        return Drift()
    return max((_of_record(only(samples, k).thinned(SEARCHED), (fit.model, free), k, least)
                for k, record in enumerate(samples.records) if record.end > record.start),
               key=lambda drift: drift.cost, default=Drift())


def _of_record(samples: Samples, own: Own, place: int, least: float) -> Drift:
    if samples.effort.over or not samples.counts.all():
        return Drift()
    slopes = slopes_of(samples, own)
    constant, drifting = slopes.beside(slopes.rows[:, :0]), slopes.beside(slopes.drift)
    if not drifting.cost < constant.cost:
        return Drift()
    numbers = drifting.numbers - constant.numbers
    n_eff = independent((tuple(e[:, np.newaxis] for e in drifting.errors),))
    gain = float(n_eff @ np.log(constant.power / drifting.power))
    by_chance = drifting.power * numbers / samples.ny / np.maximum(
        n_eff - drifting.numbers / samples.ny, 1.0)
    missed = np.maximum(constant.power - drifting.power - by_chance, 0.0) * slopes.fit.power[0]
    if gain <= numbers * float(np.log(max(float(np.max(n_eff)), 2.0))) \
            or np.max(missed) <= (0.01 * least) ** 2 or samples.effort.over:
        return Drift()
    if drifting.cost >= slopes.beside(curves_of(samples, slopes.fit)).cost:
        return Drift()
    late = slopes.beside(slopes.drift[:, slopes.delays[~slopes.states]])
    most = int(np.argmax(missed))
    return Drift(place, 100.0 * float(np.sqrt(missed[most])), bool(
        (2.0 * late.power < constant.power + drifting.power)[most]))
