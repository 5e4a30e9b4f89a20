# SPDX-License-Identifier: Apache-2.0
"""
The search for dead times: is there one, and roughly which.

A model without dead time imitates it: with zeros in the right half plane and some states too many.
So order and dead time are looked for together. From the best poles of the order n0 that was chosen
without dead time, and of the orders below, poles and dead times climb jointly to the maximum of
the output-error likelihood (`OutputError.joint_step`), the delayed inputs projected exactly at
every step; all candidates explain the same outputs. Where Schwarz's criterion shows nothing there,
there is no dead time, and the search ends. Else lower orders are tried, too, from several starts,
for the profile over dead time has side maxima.

A dead time is believed if the criterion falls by a margin, and if it is not so short that the
interpolation between samples could feign it. Where the data are described equally well by another
state and by dead time, as by a fast pole in noise, the criterion counts parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.hermite import input_slopes, project_inputs
from ctsid_core.bases.projection import Projection
from ctsid_core.bases.records import Joint, Layout
from ctsid_core.likelihood.simulation_of_poles import OutputError, OutputErrorFit
from ctsid_core.likelihood.window_ends import ends_cost_of_simulation
from ctsid_core.linear.types import Array
from ctsid_core.search.order import Search
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal

LONGEST = 0.1         # of the window: the longest dead time that is looked for
MARGIN = 6.0          # -2 log likelihood by which the criterion has to fall, beyond its charge
_COSTLY = 2.0         # times the margin, if it saves no other parameters
_FEIGNED = 0.1        # of a sample interval: shorter ones are not believed
_ORDERS = 2           # below the chosen one that are looked at first
_GLANCE = 6           # steps of a first look
_STEPS = 20           # of a climb
_HALVINGS = 5
_LEAST_GAIN = 0.02    # -2 log likelihood: smaller gains are not worth another step
_STARTS = 12          # at most, apart by what a climb reaches across
_SINGLE = 4           # inputs up to which each is tried alone
_UNCLEAR = 0.5        # part of an output's power unexplained from which all starts are tried

_Poles = NDArray[np.complex128]
_Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DeadTimeFit:
    """
    Poles and dead times, and their likelihood.

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
    direct : bool
        Whether D is free.
    cost : float
        -2 log likelihood.
    parameters : int
        Free ones, dead times included.
    gain : float
        By how much the criterion is less than without dead time.
    """

    criterion: float
    poles: _Poles
    delays: Array
    late: _Mask
    direct: bool
    cost: float
    parameters: int
    gain: float = 0.0

    def why(self, order: int) -> str:
        """Return why it is accepted, beside a model of another order without dead time."""
        return (f"with {len(self.poles)} states and dead time, Schwarz's criterion is "
                f'{self.gain:.0f} less than with {order} states and no dead time'
                + ('' if self.direct else '; D is not needed then'))


class DeadTimeSearch:
    """
    The search for dead times.

    Parameters
    ----------
    part : Joint
        The records.
    layout : Layout
        Of their projection.
    search : Search
        Of the same without dead time; known ones are in its settings.
    late : ndarray, shape (nu,)
        The inputs whose dead time is not known.

    Notes
    -----
    Where D = 0 a small change of dead time is one of B and D: -s G = -C B - C A (s I - A)^-1 B. So
    D is free only where the data show that it is needed beside dead time.
    """

    def __init__(self, part: Joint, layout: Layout, search: Search, late: _Mask) -> None:
        self._part, self._layout, self._search, self._late = part, layout, search, late
        self._known = np.array(search.settings.delays(len(late)))
        self._longest = LONGEST * part.length
        self._plain = search.output_error if not search.settings.feedthrough else \
            OutputError(search.projection, feedthrough=False)

    def best(self, n0: int, alone: bool, poles: _Poles) -> DeadTimeFit | None:
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
        lowest = n0 if alone else max(n0 - _ORDERS, 1)
        without = {n: self._still(n, alone, poles, False) for n in range(lowest, n0 + 1)}
        with_direct = {n: self._still(n, alone, poles, True) for n in without} \
            if self._search.settings.feedthrough else without
        first = min((*with_direct.values(), *without.values()), key=_criterion)
        unclear = self._at(first).fit(first.poles).residual > _UNCLEAR
        looked = [self._climbed(fit, self._late, _GLANCE, first.criterion)
                  for fits in (without, with_direct)[:1 + first.direct] for fit in fits.values()]
        more = self._search.trial(n0 + 1) if alone else None
        if more is not None:
            higher = self._rated(more.refined, self._known, np.zeros_like(self._late),
                                 self._search.settings.feedthrough)
            if higher.criterion < first.criterion - MARGIN:     # the order is not enough
                looked += self._from_above(without[n0], n0)
        if not unclear and min(fit.criterion for fit in looked) > first.criterion:
            return None
        lower = {} if alone else {n: self._still(n, alone, poles, False)
                                  for n in range(1, lowest)}
        found = self._pruned(self._thorough(lower | without, with_direct, looked))
        if found is None:
            return None
        # What is missing in a model looks like dead time, too; what is saved speaks for it.
        margin = MARGIN if alone or found.parameters < first.parameters else _COSTLY * MARGIN
        gain = first.criterion - found.criterion
        return replace(found, gain=gain) if gain > margin else None

    def _from_above(self, still: DeadTimeFit, n0: int) -> list[DeadTimeFit]:
        """Return climbs of a given order from the poles of higher ones."""
        trials = [self._search.trial(n) for n in range(n0 + 1, n0 + 1 + _ORDERS)]
        return [self._climbed(replace(still, poles=_slowest(trial.refined.poles, n0)), self._late)
                for trial in trials if trial is not None]

    def _still(self, n: int, alone: bool, poles: _Poles, direct: bool) -> DeadTimeFit:
        """Return the best fit of an order without dead time."""
        trial = None if alone else self._search.trial(n)
        start = trial.refined if trial else self._search.output_error.fit(poles, _GLANCE)
        if not direct and self._search.settings.feedthrough:
            start = self._plain.fit(start.poles, _GLANCE)
        return self._rated(start, self._known, np.zeros_like(self._late), direct)

    def _rated(self, fit: OutputErrorFit, delays: Array, late: _Mask, direct: bool) -> DeadTimeFit:
        count = fit.parameters + int(late.sum())
        value = fit.cost + count * self._search.charge + ends_cost_of_simulation(
            self._search.projection, fit.poles)
        return DeadTimeFit(value, fit.poles, delays, late, direct, fit.cost, count)

    def _at(self, fit: DeadTimeFit) -> OutputError:
        """Return the likelihood with the dead times of a fit, as a function of the poles."""
        if np.array_equal(fit.delays, self._known):
            return self._search.output_error if fit.direct else self._plain
        return OutputError(self.projection(fit.delays), fit.direct)

    def projection(self, delays: Array) -> Projection:
        """Return the projection with other dead times, of the same outputs."""
        return delayed(self._part, self._layout, self._search.settings, self._search.projection,
                       delays)

    def _climbed(self, start: DeadTimeFit, late: _Mask, steps: int = _STEPS,
                 rival: float = np.inf) -> DeadTimeFit:
        """Return the joint maximum reached from a start; given up if it will not beat a rival."""
        at = self._at(start)
        here = self._rated(at.fit(start.poles), start.delays, late, start.direct)
        for k in range(steps):
            step = at.joint_step(here.poles, late)
            found = self._stepped(here, step.poles, step.delays)
            if found is None:
                break
            gain, (here, at) = here.cost - found[0].cost, found
            if gain < _LEAST_GAIN or here.criterion - 3.0 * (steps - k) * gain > rival:
                break
        return here

    def _stepped(self, here: DeadTimeFit, move: Callable[[float], _Poles],
                 delays: Array) -> tuple[DeadTimeFit, OutputError] | None:
        """Return the first better point on the way back from a step."""
        limit = max(np.max(here.poles.real), 1.0 / self._part.length)
        for halving in range(_HALVINGS):
            part = 0.5 ** halving
            there = np.where(here.late, np.clip(here.delays + part * delays, 0.0, self._longest),
                             here.delays)
            poles = move(part)
            if np.max(poles.real) > limit:
                continue
            at = self._at(replace(here, delays=there))
            fit = at.fit(poles)
            if fit.cost < here.cost:
                return self._rated(fit, there, here.late, here.direct), at
        return None

    def _thorough(self, without: dict[int, DeadTimeFit], with_direct: dict[int, DeadTimeFit],
                  looked: list[DeadTimeFit]) -> DeadTimeFit:
        """Return the best fit of all orders and starts."""
        best = last = min(looked, key=_criterion)
        for n in sorted(without, reverse=True):
            starts = [fit for fit in looked if len(fit.poles) == n]
            starts += [replace(fits[n], delays=best.delays, late=best.late)
                       for fits in (without, with_direct)[:1 + best.direct] if n in fits]
            if len(last.poles) > n:
                starts.append(replace(last, poles=_slowest(last.poles, n)))
            last = found = min((self._climbed(start, self._late, rival=best.criterion)
                                for start in starts), key=_criterion)
            best = min(best, found, key=_criterion)
            if len(best.poles) - n >= _ORDERS:
                break
        for start in self._from_grid(without[len(best.poles)]):
            best = min(best, self._climbed(start, start.late, rival=best.criterion),
                       key=_criterion)
        return best if best.direct else self._with_direct(best)

    def _with_direct(self, fit: DeadTimeFit) -> DeadTimeFit:
        """Return a fit with D free if that is clearly better, of the same order or one less."""
        if not self._search.settings.feedthrough:
            return fit
        n = len(fit.poles)
        found = min((self._climbed(replace(fit, direct=True, poles=_slowest(fit.poles, m)),
                                   fit.late, rival=fit.criterion)
                     for m in range(max(n - 1, 1), n + 1)), key=_criterion)
        return found if found.criterion < fit.criterion - MARGIN else fit

    def _from_grid(self, still: DeadTimeFit) -> list[DeadTimeFit]:
        """Return the two most likely of several starts with these poles, after two steps each."""
        apart = self._reach(still.poles)
        count = min(int(self._longest / apart), _STARTS)
        fits = []
        for late in self._masks():
            for k in range(1, count + 1):
                start = replace(still, late=late, delays=np.where(late, k * apart, self._known))
                fits.append(self._rated(self._at(start).fit(still.poles, 2), start.delays, late,
                                        start.direct))
        return sorted(fits, key=_criterion)[:2]

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

    def _pruned(self, fit: DeadTimeFit) -> DeadTimeFit | None:
        """Return the fit without dead times that are too short, or that nothing asks for."""
        least = np.max([[_FEIGNED * max(own, *(s.period for s in p.record.outputs))
                         for own in intervals(p.record)] for p in self._part.parts], axis=0)
        while fit.late.any():
            short = np.flatnonzero(fit.late & (fit.delays < least))
            if len(short):
                fit = self._without(fit, int(short[np.argmin(fit.delays[short])]))
                continue
            fewer = min((self._without(fit, int(j)) for j in np.flatnonzero(fit.late)),
                        key=_criterion)
            if fewer.criterion - MARGIN > fit.criterion:
                return fit
            fit = fewer
        return None

    def _without(self, fit: DeadTimeFit, j: int) -> DeadTimeFit:
        """Return the fit in which one input has no dead time to be found."""
        others = fit.late & (np.arange(len(fit.late)) != j)
        delays = np.array(fit.delays)
        delays[j] = self._known[j]
        return self._climbed(replace(fit, delays=delays), others)


def _slowest(poles: _Poles, n: int) -> _Poles:
    """Return the n slowest poles; of a pair that is too many by one, a real pole of its size."""
    kept = list(poles[np.argsort(np.abs(poles), kind='stable')])
    while len(kept) > n:
        fastest = kept[-1]
        if fastest.imag == 0.0:
            kept.pop()
        elif len(kept) == n + 1:
            kept[-2:] = [complex(-abs(fastest))]
        else:
            del kept[-2:]
    return np.array(kept, dtype=complex)


def _criterion(fit: DeadTimeFit) -> float:
    return fit.criterion


def delayed(part: Joint, layout: Layout, settings: Settings, base: Projection, delays: Array,
            late: _Mask | None = None) -> Projection:
    """
    Return the projection of the same outputs with other dead times.

    Parameters
    ----------
    part : Joint
    layout : Layout
    settings : Settings
        That they were projected with.
    base : Projection
        With other dead times.
    delays : ndarray, shape (nu,)
        [s]
    late : ndarray, shape (nu,), optional
        The inputs whose `slopes` are wanted.
    """
    members = []
    for p, own, (nmax, parts), weight in zip(part.parts, base.records, layout.sizes,
                                             layout.weights, strict=True):
        scale = weight * np.sqrt(own.unit / base.unit) if part.several else 1.0
        with_parts = settings.replace(parts=parts)
        slopes = None if late is None else scale * input_slopes(
            p.record, with_parts, nmax, delays.tolist(), late)
        members.append(replace(own, slopes=slopes, u=scale * project_inputs(
            p.record, with_parts, nmax, delays.tolist())))
    if not part.several:
        return members[0]
    slopes = None if late is None else np.hstack([m.slopes for m in members
                                                  if m.slopes is not None])
    return replace(base, u=np.hstack([m.u for m in members]), slopes=slopes,
                   members=tuple(members))


def intervals(record: Record) -> list[float]:
    """Return the sample interval of each input as far as it matters between samples [s]."""
    return [_interval(signal) for signal in record.inputs for _ in range(signal.width)]


def _interval(signal: Signal) -> float:
    """Return its sample interval; a held signal is known between its samples."""
    return 0.0 if signal.hold == 'zoh' else signal.period
