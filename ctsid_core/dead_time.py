# SPDX-License-Identifier: Apache-2.0
"""
Is there a dead time, and roughly which?

A model without dead time imitates it: with zeros in the right half plane and some states too many.
So order and dead time are looked for together. From the best poles of the order n0 that was chosen
without dead time, and of the orders below, poles and dead times climb jointly to the maximum of
the output-error likelihood (`OutputError.joint_step`), the delayed inputs projected exactly at
every step; all candidates explain the same outputs. Where Schwarz's criterion shows nothing there,
there is no dead time, and the search ends. Else lower orders are tried, too, from several starts,
for the profile over dead time has side maxima.

A dead time is believed if the criterion falls by a margin, and if it is not so short that the
interpolation between samples could feign it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.base import Array, Projection
from ctsid_core.bases.hermite import project_inputs
from ctsid_core.order import Search
from ctsid_core.pole_fit import OutputError, OutputErrorFit
from ctsid_core.settings import Settings
from ctsid_core.signals import Record, Signal
from ctsid_core.window_ends import ends_cost_of_simulation

LONGEST = 0.1         # of the window: the longest dead time that is looked for
MARGIN = 6.0          # -2 log likelihood by which the criterion has to fall, beyond its charge
_FEIGNED = 0.1        # of a sample interval: shorter ones are not believed
_ORDERS = 2           # below the chosen one that are looked at first
_GLANCE = 6           # steps of a first look
_STEPS = 25           # of a climb
_HALVINGS = 5
_LEAST_GAIN = 0.02    # -2 log likelihood: smaller gains are not worth another step
_STARTS = 12          # at most, apart by what a climb reaches across
_SINGLE = 4           # inputs up to which each is tried alone
_UNCLEAR = 0.5        # part of an output's power unexplained from which all starts are tried
_SURE = 2.5           # standard deviations: a dead time of several that is nearer to 0 is 0

_Poles = NDArray[np.complex128]
_Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class LateFit:
    """
    Poles and dead times, and what they are worth.

    Parameters
    ----------
    criterion : float
        Schwarz's.
    poles : ndarray, shape (n,)
        [rad/s]
    delays : ndarray, shape (nu,)
        [s]
    late : ndarray, shape (nu,)
        Which of them were looked for.
    cost : float
        -2 log likelihood.
    gain : float
        By how much the criterion is less than without dead time.
    """

    criterion: float
    poles: _Poles
    delays: Array
    late: _Mask
    cost: float
    gain: float = 0.0


class DeadTimeSearch:
    """
    The search for the dead times of one record.

    Parameters
    ----------
    record : Record
        Of the moving channels.
    search : Search
        Of the same without dead time; known ones are in its settings.
    nmax : int
        Of its projection.
    late : ndarray, shape (nu,)
        The inputs whose dead time is not known.
    """

    def __init__(self, record: Record, search: Search, nmax: int, late: _Mask) -> None:
        self._record, self._search, self._nmax, self._late = record, search, nmax, late
        self._known = np.array(search.settings.delays(record.nu))
        self._longest = LONGEST * record.duration
        self._starts = np.empty(0)

    def best(self, n0: int, alone: bool, poles: _Poles) -> LateFit | None:
        """
        Return the best poles and dead times, or None if there is no dead time.

        Parameters
        ----------
        n0 : int
            Order that was chosen without dead time.
        alone : bool
            Whether no other order is wanted.
        poles : ndarray, shape (n0,)
            Of the model without dead time [rad/s].
        """
        still = self._still(n0, alone, poles)
        reference = min(fit.criterion for fit in still.values())
        first = min(still.values(), key=lambda fit: fit.criterion)
        unclear = self._search.output_error.fit(first.poles).residual > _UNCLEAR
        looked = [self._climbed(fit, self._late, _GLANCE, reference)
                  for n, fit in still.items() if n0 - _ORDERS <= n <= n0]
        if not unclear and min(fit.criterion for fit in looked) > reference:
            return None
        found = self._thorough(still, looked)
        found = self._pruned(found)
        if found is None or found.criterion > reference - MARGIN:
            return None
        return replace(found, gain=reference - found.criterion)

    def _still(self, n0: int, alone: bool, poles: _Poles) -> dict[int, LateFit]:
        """Return the best fits without dead time by order."""
        fits = {}
        for n in [n0] if alone else range(1, n0 + 1):
            trial = None if alone else self._search.trial(n)
            found = trial.refined if trial else self._search.output_error.fit(poles, _GLANCE)
            fits[n] = self._rated(found, self._known, np.zeros_like(self._late))
        return fits

    def _rated(self, fit: OutputErrorFit, delays: Array, late: _Mask) -> LateFit:
        count = fit.parameters + int(late.sum())
        value = fit.cost + count * self._search.charge + ends_cost_of_simulation(
            self._search.projection, fit.poles)
        return LateFit(value, fit.poles, delays, late, fit.cost)

    def _at(self, delays: Array) -> OutputError:
        if np.array_equal(delays, self._known):
            return self._search.output_error
        return OutputError(self.projection(delays), self._search.settings.feedthrough)

    def projection(self, delays: Array) -> Projection:
        """Return the projection with other dead times, of the same outputs."""
        return replace(self._search.projection, u=project_inputs(
            self._record, self._search.settings, self._nmax, delays.tolist()))

    def _climbed(self, start: LateFit, late: _Mask, steps: int = _STEPS,
                 rival: float = np.inf) -> LateFit:
        """Return the joint maximum reached from a start; given up if it will not beat a rival."""
        here, at = replace(start, late=late), self._at(start.delays)
        here = self._rated(at.fit(start.poles), start.delays, late)
        for k in range(steps):
            step = at.joint_step(here.poles, late)
            found = self._stepped(here, late, step.poles, step.delays)
            if found is None:
                break
            gain, (here, at) = here.cost - found[0].cost, found
            if gain < _LEAST_GAIN or here.criterion - 3.0 * (steps - k) * gain > rival:
                break
        return here

    def _stepped(self, here: LateFit, late: _Mask, move: Callable[[float], _Poles],
                 delays: Array) -> tuple[LateFit, OutputError] | None:
        """Return the first better point on the way back from a step."""
        for halving in range(_HALVINGS):
            part = 0.5 ** halving
            there = np.where(late, np.clip(here.delays + part * delays, 0.0, self._longest),
                             here.delays)
            poles = move(part)
            if np.max(poles.real) > max(np.max(here.poles.real), 1.0 / self._record.duration):
                continue
            at = self._at(there)
            fit = at.fit(poles)
            if fit.cost < here.cost:
                return self._rated(fit, there, late), at
        return None

    def _thorough(self, still: dict[int, LateFit], looked: list[LateFit]) -> LateFit:
        """Return the best fit of all orders and starts, the lowest order of nearly equal ones."""
        best = min(looked, key=lambda fit: fit.criterion)
        spare = 0
        for n in sorted(still, reverse=True):
            starts = [fit for fit in looked if len(fit.poles) == n]
            starts += self._from_grid(still[n], best.delays)
            found = min((self._climbed(start, start.late) for start in starts),
                        key=lambda fit: fit.criterion)
            spare = 0 if found.criterion < best.criterion else spare + 1
            best = min(best, found, key=lambda fit: fit.criterion)
            if spare > _ORDERS:
                break
        return best

    def _from_grid(self, still: LateFit, delays: Array) -> list[LateFit]:
        """Return the two likeliest of several starts with these poles, after two steps each."""
        apart = self._reach(still.poles)
        count = min(int(self._longest / apart), _STARTS)
        tried = [(delays, self._late), *(
            (np.where(late, k * apart, self._known), late)
            for late in self._masks() for k in range(count + 1))]
        fits = [self._rated(self._at(d).fit(still.poles, 2), d, late) for d, late in tried]
        return sorted(fits, key=lambda fit: fit.criterion)[:2]

    def _masks(self) -> list[_Mask]:
        """Return the sets of inputs to be delayed alike: all, and each alone if there are few."""
        places = np.flatnonzero(self._late)
        alone = [np.arange(len(self._late)) == j for j in places]
        return [self._late, *(alone if 1 < len(places) <= _SINGLE else [])]

    def _reach(self, poles: _Poles) -> float:
        """Return the distance of dead times across which a climb finds its way [s]."""
        p = self._search.projection
        power = np.sum(np.abs(p.u) ** 2, axis=0) * np.min(
            np.abs(p.s - poles[:, np.newaxis]) ** -2.0, axis=0)
        return float(1.0 / np.sqrt(np.sum(np.abs(p.s) ** 2 * power) / np.sum(power)))

    def _pruned(self, fit: LateFit) -> LateFit | None:
        """Return the fit without dead times that are not significant, or too short to be told."""
        least = np.array([_FEIGNED * max(own, *(s.period for s in self._record.outputs))
                          for own in intervals(self._record)])
        while True:
            short = fit.late & (fit.delays < least)
            if not short.any() and fit.late.sum() > 1:
                short = fit.late & (fit.delays < _SURE * self._deviation(fit))
            if not short.any():
                return fit if fit.late.any() else None
            j = int(np.argmin(np.where(short, fit.delays, np.inf)))
            late = fit.late & (np.arange(len(fit.late)) != j)
            delays = np.where(np.arange(len(late)) == j, self._known, fit.delays)
            if not late.any():
                return None
            fit = self._climbed(replace(fit, delays=delays, late=late), late)

    def _deviation(self, fit: LateFit) -> Array:
        """Return how far each dead time may be off, by what the likelihood loses without it."""
        at, lost = self._at(fit.delays), np.full(len(fit.late), np.inf)
        for j in np.flatnonzero(fit.late):
            moved = np.where(np.arange(len(fit.late)) == j, self._known, fit.delays)
            other = np.array(fit.late)
            other[j] = False
            lost[j] = max(self._climbed(replace(fit, delays=moved), other).cost
                          - at.fit(fit.poles).cost, 1e-9)
        return fit.delays / np.sqrt(lost)


def intervals(record: Record) -> list[float]:
    """Return the sample interval of each input as far as it matters between samples [s]."""
    return [_interval(signal) for signal in record.inputs for _ in range(signal.width)]


def _interval(signal: Signal) -> float:
    """A held signal is known between its samples."""
    return 0.0 if signal.hold == 'zoh' else signal.period
