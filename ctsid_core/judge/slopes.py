# SPDX-License-Identifier: Apache-2.0
"""
What a model could be instead, to first order, beside what it leaves of the samples.

Also what jumps at some instants: the gain of an input, or a load at it. Who says that a plant
changes has a rival. Somebody leans on a robot for a second, a gust hits a drone, a wheel climbs a
bump: one plant, and a load that nobody measures comes and goes. It counts if it explains as much
with as many numbers.

References
----------
Pati, Rezaiifar and Krishnaprasad 1993, Asilomar Conference (orthogonal matching pursuit).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
INSTANTS = 48         # parts of a record, between which anything may jump
_MOST_JUMPS = 20      # at most
NOTHING = 1e-4        # of a column: less is left of it by rounding

_Jump = tuple[int, int, int]               # its channel, from which instant, to which


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
        """Return further columns, and errors, without what columns and `common` ones explain."""
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
    columns = columns_of(samples, *model.nonlinear, direct=free.feedthrough, turned=False)
    fit = fit_states(samples, model, free, columns)
    rows, error, places = jacobian(samples, fit, free)
    shares = [(s.times - start) / (end - start) for r in samples.records
              for start, end in [r.span] for s in r.streams for _ in range(s.y.shape[1])]
    return Slopes(fit, rows, error, places.are('xt'), np.concatenate(shares), places.are('d'),
                  samples)


def under_loads(slopes: Slopes, jumps: int, common: Array) -> Left:
    """Return what loads leave that jump so often, beside common columns."""
    # One jump after another, or two by two, whichever explains more: the first jump of a short
    # push explains nothing by itself.
    steps, lefts = moved_by(slopes, None), list[Left]()
    for pairs in (False, True):
        *_, found = [], *(one for one, _ in jumps_of(slopes, steps, jumps, pairs, common))
        lefts.append(slopes.beside(np.column_stack((common, *(
            steps[start, :, j] - steps[end, :, j] for j, start, end in found)))))
    return min(lefts, key=lambda left: left.cost)


def jumps_of(slopes: Slopes, steps: Array, most: int = _MOST_JUMPS, pairs: bool = False,
             common: Array | None = None) -> Iterator[tuple[list[_Jump], Array]]:
    """
    Yield the jumps that explain most beside those before, and the errors that are left.

    `steps` (instants, N, channels) are what jumps at each instant move. Pairs begin at any of
    them, and count twice; what is no pair, or the last of an odd number, begins with the record.
    """
    slopes.samples.effort.spend(2.0 * steps.size * (slopes.rows.shape[1] + INSTANTS))
    least = (NOTHING * np.max(np.linalg.norm(steps, axis=1))) ** 2
    rows, error = slopes.without(steps.transpose(1, 2, 0).reshape(steps.shape[1], -1), common)
    columns = rows.reshape(len(rows), -1, INSTANTS).transpose(1, 0, 2)
    products = columns.swapaxes(1, 2) @ columns
    found, count = list[_Jump](), 0
    while count < most:
        slopes.samples.effort.spend(3.0 * columns.size)
        jump = _most_telling(products, error @ columns, least,
                             INSTANTS if pairs and count + 1 < most else 1)
        if jump is None:
            return
        j, start, end = jump
        best = columns[j, :, start] - columns[j, :, end]
        best = best / np.linalg.norm(best)
        error = error - best * (best @ error)
        less = best @ columns
        columns = columns - best[:, np.newaxis] * less[:, np.newaxis]
        products = products - less[:, :, np.newaxis] * less[:, np.newaxis]
        found.append(jump)
        count += 1 + (start > 0)
        yield found.copy(), error


def _most_telling(products: Array, told: Array, least: float, starts: int) -> _Jump | None:
    """Return the jump that explains most, from one of the first instants; None if none does."""
    own = np.diagonal(products, axis1=1, axis2=2)
    size = own[:, :starts, np.newaxis] + own[:, np.newaxis] - 2.0 * products[:, :starts]
    tells = np.where(size > least, (told[:, :starts, np.newaxis] - told[:, np.newaxis]) ** 2
                     / np.maximum(size, 1e-300), 0.0)
    j, start, end = map(int, np.unravel_index(int(np.argmax(tells)), tells.shape))
    return (j, start, end) if tells[j, start, end] > 0.0 else None


def moved_by(slopes: Slopes, means: Sequence[Array] | None) -> Array:
    """
    Return what inputs move from each instant on, (instants, N, nu), outputs over errors.

    By themselves: what they move at all, less what is left of that by then, which decays, and
    what their `means` move, of as many inputs as have some. Without these what a constant load at
    each of them moves.
    """
    samples, model = slopes.samples, slopes.fit.model
    nu = samples.nu if means is None else len(means[0])
    found = np.zeros((INSTANTS, len(slopes.error), nu))
    at = 0
    for r, (record, triangles) in enumerate(zip(samples.records, slopes.fit.columns.triangles,
                                                strict=True)):
        mean = np.ones(nu) if means is None else means[r]
        start, end = record.span
        for s, t in zip(record.streams, triangles, strict=True):
            (count, channels), size = s.y.shape, np.sqrt(slopes.fit.power[r, s.channels])
            residues = (model.c[s.channels] / size[:, np.newaxis]).T \
                * model.b.T[:nu, :, np.newaxis]                         # (nu, m, channels)
            direct = (model.D[s.channels, :nu] / size[:, np.newaxis]).T[:, np.newaxis]
            inputs = (t.z[:, :, :nu], t.u[:, :nu]) if means is not None else (
                np.zeros((count, len(model.poles), nu)), np.zeros((count, nu)))
            for k in range(INSTANTS):
                first = int(np.searchsorted(s.times, start + k / INSTANTS * (end - start)))
                if first == count:
                    break
                z, u = (one[first:] for one in inputs)
                since = s.times[first:, np.newaxis] - s.times[first:first + 1]
                rising = np.where(model.poles == 0.0, since, np.expm1(since * model.poles)
                                  / np.where(model.poles == 0.0, 1.0, model.poles))
                z = z - z[:1] * np.exp(since * model.poles)[:, :, np.newaxis] \
                    + np.multiply.outer(rising, mean)
                moved = (z.transpose(2, 0, 1) @ residues).real \
                    + (u + mean).T[:, :, np.newaxis] * direct           # (nu, N, channels)
                places = at + first + count * np.arange(channels)[:, np.newaxis] \
                    + np.arange(count - first)
                found[k, places] = moved.transpose(2, 1, 0)
            at += count * channels
    return found
