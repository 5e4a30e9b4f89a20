# SPDX-License-Identifier: Apache-2.0
"""From records to the model that explains their samples best: HD-PBSID finds, samples decide."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Free, climb, climb_roughly, fit_at
from ctsid_core.likelihood.residuals import coloured_costs
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.by_order import (
    LEAST,
    SEARCH,
    SEARCHED,
    UNEXPLAINED,
    Tried,
    advantage,
    choose,
    explains,
    price,
    search_orders,
    tried,
)
from ctsid_core.search.corrupt import hide_outliers
from ctsid_core.search.optional import centred, with_direct, without_needless
from ctsid_core.search.predicted import (
    GROWS,
    disturbed,
    growth,
    lasts,
    likelier,
    near,
    predicted,
)
from ctsid_core.search.problem import Problem, at_bound, free_of
from ctsid_core.search.solution import Solution
from ctsid_core.settings import Settings
from ctsid_core.subspace.hd_pbsid import Subspaces, Tuning, realise

_FAILS = 0.5          # error that is not noise, over the motion, with which no simulation tells a
                      # plant in open loop, and it may grow
_FEWEST = 3           # states: fewer are found by a grid of poles
_NEGLIGIBLE = 0.01    # share of the Akaike weights

_PROJECTION, _PER_SAMPLE, _REGRESSION = 1e7, 2e4, 3e6       # work of HD-PBSID

Other = tuple[float, Tried]              # advantage over the choice, and the model


def solve(part: Joint, settings: Settings, effort: Effort) -> Solution | None:
    """Return the model of records, or None if they are too short for any."""
    given = Problem.of(part, settings, effort)
    own, samples = given.own, given.seen()
    free = replace(free_of(samples, own), feedthrough=False)
    one = None if own.feedthrough else predicted(given, samples, free)
    # A plant that grows predictions tell at once.
    grows = one is not None and growth(one, samples) > GROWS
    if one is not None and grows and (
            solved := likelier(given, samples, near(samples, free, one), free, one)):
        return solved
    subspace = _Subspace(part, own, effort)
    samples, found = search_orders(
        samples, free, subspace.poles, order=settings.order, max_order=settings.max_order,
        known_delay=given.known_delay)
    given = replace(given, most=min(given.most, int(np.max(samples.counts.sum(axis=0)))))
    if not found or settings.order not in (0, *found):
        return None
    samples, found = _where_known(given, samples, found, free)
    counted = settings.order or choose(found)
    order = settings.order or _neighbour(found, counted)
    others = [(advantage(found[order], one), one) for n, one in found.items() if n != order]
    notes = given.left_out(found, order)
    best = found[order]
    if own.feedthrough:
        with_D, free = with_direct(given, samples, found, best, free, subspace.poles, counted)
        others, best = _with(others, best, with_D), with_D
    if hidden := hide_outliers(part, given.corrupt, samples, best.fit):
        samples = given.seen()
        best = _climbed(samples, best, free)
    left = best.unexplained
    if one is not None:
        # So do modes that last where its past tells of none: of a set point, or of disturbances.
        imitates = growth(one, samples) < -GROWS and lasts(best, samples)
        rival = near(samples, free, one) if imitates else best
        if (imitates or left > UNEXPLAINED) and (
                solved := likelier(given, samples, rival, free, one)):
            return replace(solved, hidden=hidden)
    if own.feedthrough and left > UNEXPLAINED and not effort.beyond(SEARCH):
        one = predicted(given, samples, free)
        grows = one is not None and growth(one, samples) > GROWS
        # In open loop a plant is to simulate, unless it grows and no simulation tells it.
        if one is not None and grows and min(
                left, *(other.unexplained for other in found.values())) >= _FAILS and (
                solved := likelier(given, samples, best, free, one)):
            return replace(solved, hidden=hidden)
    climbed = _climbed(samples, best, free)
    best, free = without_needless(samples, climbed, free)
    if own.feedthrough and one is not None and not grows and not settings.order and (
            solved := disturbed(given, samples, best, free, one)):
        best = _climbed(solved.samples, best, free) if solved.samples is not samples else best
        return replace(solved, hidden=hidden, simulating=(solved.samples, best.fit, free),
                       smaller=_smaller(solved.samples, found, best, free))
    others = _with(others, climbed, best)
    late = float(np.max(best.fit.model.delay, initial=0.0))
    if late > 0.0:
        samples = given.seen(late)
    if late > 0.0 or best is not climbed:
        best = _climbed(samples, best, free)
    best = centred(samples, best, free)
    smaller = _smaller(samples, found, best, free)
    found[best.fit.model.n] = best
    values, condition = subspace.shown(best.fit.model.n)
    return Solution(given.used(best.fit.model.n, best.fit.model.delay), part, samples,
                    best.fit, free, best.independent, given.table(found, best),
                    given.choices(best, free, (order - counted) * (best.fit.model.n == order)),
                    (*notes, *at_bound(best, free)),
                    doubt=given.doubt(best, best.fit.model.poles, samples, free, grows),
                    hidden=hidden, smaller=smaller, rivals=_rivals(others), singular_values=values,
                    condition=condition)


def _where_known(given: Problem, samples: Samples, found: dict[int, Tried],
                 free: Free) -> tuple[Samples, dict[int, Tried]]:
    """
    Return the samples, and the models of each order, that the order is chosen by.

    Before a delayed input is known, what it was before acts, which further states imitate. Where
    a smaller order is enough for the rest, the rest is what counts.
    """
    chosen = given.settings.order or choose(found)
    late = float(np.max(found[chosen].fit.model.delay, initial=0.0))
    up_to = {n: one for n, one in found.items() if n <= chosen}
    if late > 0.0 and len(up_to) > 1 and not samples.effort.beyond(SEARCH):
        known = given.seen(late)
        if np.min(known.counts.sum(axis=0)) > found[chosen].parameters:
            thin = known.thinned(SEARCHED)
            rest = {n: _climbed(thin, one, free, roughly=True) for n, one in up_to.items()}
            if choose(rest) < chosen:
                return known, {n: _climbed(known, one, free) for n, one in rest.items()}
    return samples, found


def _neighbour(found: dict[int, Tried], chosen: int) -> int:
    """
    Return the chosen order, or the one beside it that is likelier in noise of any colour.

    What a disturbance or a curve of the plant leaves is hardly independent, however it is counted,
    but its own past tells most of it; and a state too few, for which a dead time stands in, shows
    in what is new before it shows in the fit.
    """
    own, matters = found[chosen], found[chosen].power > LEAST ** 2

    def in_colour(n: int) -> float:
        """Return Schwarz's criterion with errors of any colour, of the outputs that matter."""
        costs = coloured_costs(found[n].errors)
        return float(np.sum(costs[matters])) + price(own.samples) * found[n].parameters

    return min((n for n in (chosen, chosen - 1, chosen + 1) if n in found and (
        n <= chosen or explains(own, found[n]) or bool(np.any(
            found[n].fit.model.delay < 0.5 * own.fit.model.delay)))),
               key=in_colour) if matters.any() else chosen


def _with(others: list[Other], before: Tried, after: Tried) -> list[Other]:
    """Return the models that might be right beside the next choice, the last one among them."""
    if after is before:
        return others
    more = advantage(after, before)
    return [*((gain + more, one) for gain, one in others), (more, before)]


def _rivals(others: list[Other]) -> tuple[tuple[float, ModalModel], ...]:
    """Return the models that might be right, with their share of the Akaike weights."""
    gains = np.array([0.0, *(gain for gain, _ in others)])
    weights = np.exp(0.5 * (gains - gains.max()))
    shares = (weights / weights.sum()).tolist()[1:]
    return tuple((share, one.fit.model) for share, (_, one) in zip(shares, others, strict=True)
                 if share > _NEGLIGIBLE)


def _smaller(samples: Samples, found: dict[int, Tried], best: Tried,
             free: Free) -> tuple[tuple[ModalModel, Free], ...]:
    """Return the models of smaller orders, the dead times that are not free those of the best."""
    models, free = [], replace(free, feedthrough=False)
    for model in (one.fit.model for n, one in found.items() if n < best.fit.model.n):
        delay = np.where(free.delays, model.delay, best.fit.model.delay)
        if (delay != model.delay).any():
            with suppress(np.linalg.LinAlgError):
                model = climb_roughly(
                    samples, fit_at(samples, model.poles, delay, free), free).model
        models.append((model, free))
    return tuple(models)


def _climbed(samples: Samples, one: Tried, free: Free, roughly: bool = False) -> Tried:
    """Return a model at the maximum of the likelihood of other samples."""
    start = fit_at(samples, one.fit.model.poles, one.fit.model.delay, free, one.fit)
    return tried(samples, (climb_roughly if roughly else climb)(samples, start, free), free)


class _Subspace:
    """Poles of HD-PBSID's models, on lines projected when they are first asked for."""

    def __init__(self, part: Joint, own: Settings, effort: Effort) -> None:
        self._part, self._own, self._effort = part, own, effort
        self._made: dict[bool, Subspaces | None] = {}
        self._realised = lru_cache(maxsize=None)(self._realise)

    def shown(self, n: int) -> tuple[Array, float]:
        """Return singular values and condition of the middle one of the tunings for order n."""
        made = next((m for m in self._made.values() if m), None) or self._projected(
            np.array(self._own.delays(len(self._part.parts[0].u))))
        tunings = made.some_tunings(n) if made is not None else []
        if made is None or not tunings:
            return np.empty(0), float('nan')
        found = made.of(tunings[len(tunings) // 2])
        return found.singular_values, found.condition

    def poles(self, n: int, delay: Array) -> Iterator[ComplexArray]:
        """Yield the poles of models of order n, with given dead times, for every tuning."""
        if n >= _FEWEST and (subspaces := self._projected(delay)) is not None:
            for tuning in subspaces.some_tunings(n):
                yield from self._realised(n, tuning, subspaces)

    def _realise(self, n: int, tuning: Tuning, subspaces: Subspaces) -> list[ComplexArray]:
        self._effort.spend(_REGRESSION)
        subspace = subspaces.of(tuning)
        if n >= len(subspace.singular_values):
            return []
        A = realise(subspace, n).A
        if not np.isfinite(A).all():
            return []
        p = np.linalg.eigvals(A).astype(complex)
        p = np.where(p.real > 0.0, -p.conj(), p)
        return [p[p.imag >= 0.0]]

    def _projected(self, delay: Array) -> Subspaces | None:
        """
        Return the regressions, with dead times as they are given or as first found.

        Small models of several inputs have any dead times: those given are a start, too.
        """
        given = bool(np.array_equal(delay, self._own.delays(len(delay))))
        if given in self._made:
            return self._made[given]
        self._made[given], own = None, self._own.replace(delay=tuple(delay.tolist()))
        self._effort.spend(_PROJECTION + _PER_SAMPLE * sum(
            float(len(s.time)) for p in self._part.parts for s in p.record.outputs))
        with suppress(np.linalg.LinAlgError):
            self._made[given] = Subspaces(self._part.project(own, self._effort.check), own)
        return self._made[given]

