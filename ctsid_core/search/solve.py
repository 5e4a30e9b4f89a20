# SPDX-License-Identifier: Apache-2.0
"""From records to the model that explains their samples best: HD-PBSID finds, samples decide."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples
from ctsid_core.model.estimate import Choice
from ctsid_core.search.by_order import SEARCHED, affordable, search_orders
from ctsid_core.search.by_prediction import PredictionFit
from ctsid_core.search.corrupt import without_outliers
from ctsid_core.search.direct import centred, doubt_of_direct, with_direct, without_needless
from ctsid_core.search.doubts import doubt_of_delays, doubt_of_hold, doubt_of_order, doubt_of_size
from ctsid_core.search.drifting import free_with_time, mean_of
from ctsid_core.search.plants import as_likely, disturbed, growth_of, likelier, predicted
from ctsid_core.search.solution import GROWS, Doubt, Solution, at_bound, left_out, table_of, used
from ctsid_core.search.task import Subspace, Task, samples_of_part
from ctsid_core.search.tried import (
    LEAST,
    SEARCH,
    UNEXPLAINED,
    Tried,
    advantage,
    advantage_in_colour,
    choose,
    climbed,
    explains,
    imitates,
    in_colour,
    price,
    roughly,
    shares_of,
    smaller_models,
)
from ctsid_core.settings import Settings
from ctsid_core.signals.loop import in_loop

_FAILS = 0.5          # error that is not noise, over the motion, with which no simulation tells a
                      # plant: in open loop it may grow
_CLEARLY = 0.1        # -2 log likelihood, of all horizons, for each sample


def solve(part: Joint, settings: Settings, effort: Effort) -> Solution | None:
    """Return the model of records, or None if they are too short for any."""
    task = Task(part, settings, effort, affordable(samples_of_part(part, effort)))
    found = _solved(task)
    return found and replace(found, doubt=doubt_of_delays(task, found) or found.doubt)


@dataclass(frozen=True, eq=False)
class _Searched:
    """What the search over orders found, and the model among that."""

    samples: Samples
    found: dict[int, Tried]
    best: Tried
    free: Free
    order: int              # the one chosen, before D was asked for, ...
    counted: int            # ... and by independent samples alone
    others: list[tuple[float, Tried]]       # by how much Akaike prefers them, and models
    notes: tuple[str, ...]


def _solved(task: Task) -> Solution | None:
    """Return the model that simulates the records, or the plant that predicts them."""
    # In open loop a plant is to simulate, unless it grows and no simulation tells it: predictions
    # are asked of what simulations leave. Without D they are asked first, and where a controller
    # is heard, the plant grows, or no simulation tells it, they are as good: simulations of what a
    # controller holds imitate what it makes of noise. Behind a stick, what an oscillation from
    # elsewhere does to an output predictions know, and inputs by chance. A drift they take up as
    # growth.
    samples, subspace, direct = task.seen(), Subspace(task), task.settings.feedthrough
    free = replace(task.free(samples), feedthrough=False)
    sought = None if direct else predicted(task, samples, free)
    growth = -np.inf if sought is None else growth_of(sought, samples)
    held = growth > GROWS or not direct and in_loop([p.record for p in task.part.parts])
    if sought is not None and held and (solved := _at_once(task, samples, free, sought)):
        return solved
    task, one = _by_orders(task, samples, free, subspace)
    if one is None:
        return None
    # Modes that last where its past tells of none are of the set point, or of disturbances.
    if sought is not None and held and growth < -GROWS and np.any(
            np.abs(one.best.fit.model.poles.real) * one.samples.length < GROWS) and (
            solved := as_likely(task, one.samples, free, sought)):
        return solved
    task, one = _without_outliers(task, _with_direct(task, one, subspace) if direct else one)
    hold = doubt_of_hold(task, one.samples.thinned(SEARCHED, scattered=True), one.found, one.best,
                         one.free)
    left = one.best.left
    order = doubt_of_order(task, one.samples, one.free) if left > UNEXPLAINED else None
    fails = _FAILS <= min(left, *(other.unexplained for other in one.found.values()))
    if direct and left > UNEXPLAINED and not task.effort.beyond(SEARCH):
        sought = predicted(task, one.samples, one.free)
        growth = -np.inf if sought is None else growth_of(sought, one.samples)
    held = held or fails and (growth > GROWS or not direct)
    drifts = growth > GROWS and one.best.drifting is not None and one.best.unexplained < _FAILS
    if sought is not None and held and not drifts and not (order and growth <= GROWS) and (
            solved := likelier(task, one.samples, one.best, one.free, sought)):
        return replace(solved, doubt=hold or solved.doubt)
    simulates = held or growth > GROWS or order or left <= UNEXPLAINED
    return _finished(task, one, subspace, hold or order, None if simulates else sought,
                     growth > GROWS)


def _at_once(task: Task, samples: Samples, free: Free, sought: PredictionFit) -> Solution | None:
    """Return the plant that predictions found where no simulation is searched for."""
    # A plant that grows predictions tell at once, and one that hardly decays, if they predict it
    # clearly better than a simulation near it would: of closed loops many states simulate the
    # record.
    growth = growth_of(sought, samples)
    if growth <= (GROWS if task.settings.order else -GROWS):
        return None
    return as_likely(task, samples, free, sought, 0.0 if growth > GROWS else _CLEARLY)


def _by_orders(task: Task, samples: Samples, free: Free,
               subspace: Subspace) -> tuple[Task, _Searched | None]:
    """Return the simulation without D of the order that is given, or of the best one."""
    # Before it the task, of as many samples as the budget sufficed for.
    settings = task.settings
    samples, found = search_orders(
        samples, free, subspace.poles, order=settings.order, max_order=settings.max_order,
        known_delay=np.array(task.own.delays(samples.nu)), finest=task.finest)
    task = replace(task, most=min(task.most, int(np.max(samples.counts.sum(axis=0)))))
    # As many numbers as there are samples explain any.
    found = {n: one for n, one in found.items() if one.parameters < samples.counts.sum()}
    if not found or settings.order not in (0, *found):
        return task, None
    samples, found = _where_known(task, samples, found, free)
    counted = settings.order or choose(found)
    order = settings.order or _neighbour(found, counted)
    others = [(advantage_in_colour(found[order], one), one)
              for n, one in found.items() if n != order and not imitates(one, found[order])]
    return task, _Searched(samples, found, found[order], free, order, counted, others,
                           left_out(task, found, order))


def _with_direct(task: Task, one: _Searched, subspace: Subspace) -> _Searched:
    """Return the model with D if that explains more; the one without may be right as well."""
    best, free = with_direct(task, one.samples, one.found, one.best, one.free, subspace,
                             one.counted)
    if best is one.best:
        return replace(one, free=free)
    more = advantage(best, one.best)
    return replace(one, best=best, free=free, others=[
        *((gain + more, other) for gain, other in one.others), (more, one.best)])


def _without_outliers(task: Task, one: _Searched) -> tuple[Task, _Searched]:
    """Return the task and the model without samples that stand out of its errors."""
    cleaner = without_outliers(task.part, one.samples, one.best.fit)
    if cleaner is task.part:
        return task, one
    task = replace(task, part=cleaner)
    samples = task.seen()
    return task, replace(one, samples=samples, best=climbed(samples, one.best, one.free))


def _finished(task: Task, one: _Searched, subspace: Subspace, doubt: Doubt | None,
              disturbs: PredictionFit | None = None, grows: bool = False) -> Solution:
    """Return a simulation at the maximum of the likelihood, without dead times it needs not."""
    # Or the plant that predictions found, if what `disturbs` it is why they do better.
    doubt = doubt or doubt_of_size(task, one.found)
    samples, found = one.samples, one.found
    reached = climbed(samples, one.best, one.free)
    best, free = without_needless(samples, reached, one.free, LEAST)
    if disturbs is not None and (solved := disturbed(task, samples, best, disturbs, free, found)):
        return solved
    late = float(np.max(best.fit.model.delay, initial=0.0))
    if late > 0.0:
        samples = task.seen(late)
    if late > 0.0 or best is not reached:
        best = climbed(samples, best, free)
    best, drifts = (best, None) if task.settings.order else mean_of(samples, best, free)
    both = best.drifting
    drifting = None if both is None else (both.samples, both.fit, free_with_time(free))
    best = centred(samples, best, free) if both is None else best
    smaller = smaller_models(samples, found, best, replace(free, feedthrough=False))
    n, poles = best.fit.model.n, best.fit.model.poles
    found[n] = best
    values, condition = subspace.shown(n)
    return Solution(
        used(task, n, best.fit.model.delay), task.part, samples, best.fit, free, best.independent,
        table_of(found, best, task.settings), _choices(task, one, best, free),
        (*one.notes, *at_bound(best.fit, free)),
        doubt=doubt or doubt_of_direct(poles, best.fit.model.delay, samples, free,
                                       task.settings.feedthrough, grows),
        smaller=smaller, drifting=drifting, drifts=drifts,
        rivals=shares_of([(gain, other.fit.model) for gain, other in one.others]),
        singular_values=values, condition=condition)


def _where_known(task: Task, samples: Samples, found: dict[int, Tried],
                 free: Free) -> tuple[Samples, dict[int, Tried]]:
    """Return the samples, and the models of each order, that the order is chosen by."""
    # Before a delayed input is known, what it was before acts, which further states imitate. Where
    # a smaller order is enough for the rest, the rest is what counts.
    chosen = task.settings.order or choose(found)
    late = float(np.max(found[chosen].fit.model.delay, initial=0.0))
    up_to = {n: one for n, one in found.items() if n <= chosen}
    if late > 0.0 and len(up_to) > 1 and not samples.effort.beyond(SEARCH):
        known = task.seen(late)
        if np.min(known.counts.sum(axis=0)) > found[chosen].parameters:
            thin, rest = known.thinned(SEARCHED), {}
            for n, one in up_to.items():
                rest[n] = replace(roughly(thin, *one.fit.model.nonlinear, free, one.fit),
                                  pointed=one.pointed, drifting=one.drifting, found=one.found)
            if choose(rest) < chosen:
                return known, {n: climbed(known, one, free) for n, one in rest.items()}
    return samples, found


def _neighbour(found: dict[int, Tried], chosen: int) -> int:
    """Return the chosen order, or the one beside it that is likelier in noise of any colour."""
    # What a disturbance or a curve of the plant leaves is hardly independent, however it is
    # counted, but its own past tells most of it; and a state too few, for which a dead time stands
    # in, shows in what is new before it shows in the fit. One more has to be likelier by what a
    # number costs.
    matters = found[chosen].power > LEAST ** 2
    if not matters.any():
        return chosen
    own = found[chosen]
    return min((n for n in (chosen, chosen - 1, chosen + 1) if n in found and (
        n <= chosen or not imitates(found[n], own) and (explains(own, found[n]) or bool(np.any(
            found[n].fit.model.delay < 0.5 * own.fit.model.delay))))),
               key=lambda n: in_colour(found[n], matters) + price(own.samples) * (n > chosen))


def _choices(task: Task, one: _Searched, best: Tried, free: Free) -> tuple[Choice, ...]:
    """Return what was chosen, and why."""
    settings, n = task.settings, best.fit.model.n
    beside = (one.order - one.counted) * (n == one.order)
    why = f', and one {"more" if beside > 0 else "less"}, because neighbouring errors are alike'
    found = [] if settings.order else [Choice(
        'order', n, ('the fewest states: more would explain no more than chance does'
                     + (why if beside else '')) if n < settings.max_order else
        'the most that are tried: more may explain more, set `max_order`')]
    found += [Choice('delay', round(float(best.fit.model.delay[k]), 6),
                     f'of input {name}: the most likely, with the poles')
              for k, name in enumerate(task.input_names) if free.delays[k]]
    return tuple(found)
