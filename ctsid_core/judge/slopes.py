# SPDX-License-Identifier: Apache-2.0
"""What a model could be instead, to first order, beside what it leaves of the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctsid_core.judge.curve import MOST, curves_of
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.likelihood.output_error import Fit, Free, fit_states, jacobian
from ctsid_core.likelihood.samples import Residuals, Samples
from ctsid_core.linear.least_squares import basis_of
from ctsid_core.linear.types import Array, Mask, Places

SEARCHED = 1200       # samples of a stream that are looked at

Own = tuple[ModalModel, Free]              # a model, and what is free in it


class Left(NamedTuple):
    """What columns leave of the errors, each output of each record over its rms before."""

    errors: Array           # (N,); none if there are too many columns
    power: Array
    numbers: int            # of columns that tell something
    cost: float             # -2 log likelihood, and one for each of them


@dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives of the simulation by what is free, outputs over the rms of their errors."""

    fit: Fit
    rows: Array             # (N, k)
    error: Array            # (N,)
    states: Mask            # (k,): columns of initial states and trims
    shares: Array           # (N,): when, as a part of the recording
    delays: Mask            # (k,): columns of dead times
    samples: Samples

    @property
    def edges(self) -> Places:
        """Where errors of an output of a record end, and those of the next one begin."""
        return np.cumsum(self.samples.counts.ravel().astype(int))[:-1]

    @property
    def rest(self) -> Array:
        """The columns that are of no state and no trim."""
        return self.rows[:, ~self.states]

    @property
    def drift(self) -> Array:
        """The same of numbers that move in a straight line within each recording."""
        return self.rest * (self.shares - 0.5)[:, np.newaxis]

    @cached_property
    def _without(self) -> tuple[Array, Array]:
        """A basis of the columns, and the errors without them."""
        self.samples.effort.spend(0.6 * self.rows.size * self.rows.shape[1])
        basis = basis_of(self.rows)
        return basis, self.error - basis @ (basis.T @ self.error)

    def beside(self, more: Array, blocks: Sequence[Array] = ()) -> Left:
        """
        Return what further columns leave, at most half as many as there are samples.

        Of each output a block, of all records, may have columns that are 0 everywhere else.
        """
        count, k = self.rows.shape
        if k + more.shape[1] + sum(one.shape[1] for one in blocks) > MOST * count:
            return Left(np.empty(0), np.full(self.samples.counts.size, np.inf), 0, np.inf)
        (basis, error), own, left = self._without, list[Array](), more
        for one in blocks:
            self.samples.effort.spend(0.6 * one.size * one.shape[1])
            tells = one.shape[1] <= MOST * len(one)         # more explain any of so few samples
            own.append(basis_of(one) if tells else one[:, :0])
        if blocks:
            self.samples.effort.spend(0.6 * self.rows.size * k)
            rows, error, left = (x.copy() for x in (self.rows, self.error, more))
            parts = np.split(np.arange(count), self.edges)
            for i, Q in enumerate(own):
                at = np.concatenate(parts[i::self.samples.ny])
                for x in (rows, error, left):
                    x[at] -= Q @ (Q.T @ x[at])
            basis = basis_of(rows, whole=self.rows)
            error = error - basis @ (basis.T @ error)
        self.samples.effort.spend(0.6 * count * more.shape[1] * (2 * k + more.shape[1]))
        further = basis_of(left, basis, more)
        numbers = sum(Q.shape[1] for Q in (*own, basis, further))
        errors = error - further @ (further.T @ error)
        power = np.maximum([float(e @ e) / max(len(e), 1)
                            for e in np.split(errors, self.edges)], 1e-300)
        cost = float(self.samples.counts.ravel() @ np.log(power)) + numbers
        return Left(errors, power, numbers, cost)

    def curved(self, common: Array | None = None) -> Left:
        """Return what curves leave, and common columns beside them."""
        return self.beside(self.rows[:, :0] if common is None else common,
                           curves_of(self.samples, self.fit))

    def in_records(self, errors: Array) -> Residuals:
        """Return errors of each output of each record, one after another, (N,), as residuals."""
        parts, ny = np.split(errors[:, np.newaxis], self.edges), self.samples.ny
        return tuple(tuple(parts[k:k + ny]) for k in range(0, len(parts), ny))

    def power(self, left: Left) -> Array:
        """Return the mean square of what is left of each output, over the motion, (ny,)."""
        return self.samples.mean(left.power.reshape(-1, self.samples.ny) * self.fit.power)

    def without(self, more: Array, common: Array | None = None) -> tuple[Array, Array]:
        """
        Return further columns, and the errors, without what the columns explain of them.

        The `common` ones explain, too.
        """
        basis, error = self._without
        more = more - basis @ (basis.T @ more)
        if common is None:
            return more, error
        further = basis_of(common, basis)
        return more - further @ (further.T @ more), error - further @ (further.T @ error)


def recordings(samples: Samples) -> list[int]:
    """Return a place of each recording among all records: of its last part between pauses."""
    return list({r.recording: k for k, r in enumerate(samples.records)
                 if r.end > r.start}.values())


def only(samples: Samples, place: int) -> Samples:
    """Return one recording, with all parts between its pauses: their states are fitted anew."""
    number = samples.records[place].recording
    return replace(samples, records=tuple(
        r for r in samples.records if r.recording == number and r.end > r.start))


def slopes_of(samples: Samples, own: Own) -> Slopes:
    """Return what may change the simulation of each sample of these records."""
    model, free = own
    columns = columns_of(samples, model.poles, model.delay, direct=free.feedthrough,
                         turned=False)
    fit = fit_states(samples, model, free, columns)
    rows, error, places = jacobian(samples, fit, free)
    shares = [(s.times - start) / (end - start) for r in samples.records
              for start, end in [r.span] for s in r.streams for _ in range(s.y.shape[1])]
    states, delays = (places.are(which, samples.ny, len(samples.records), free.trim)
                      for which in ('xt', 'd'))
    return Slopes(fit, rows, error, states, np.concatenate(shares), delays, samples)
