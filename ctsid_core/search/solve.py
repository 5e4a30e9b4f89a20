# SPDX-License-Identifier: Apache-2.0
"""From records to the model that explains their samples best: HD-PBSID finds, samples decide."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.noise_gain import with_noise
from ctsid_core.likelihood.output_error import Fit, Free, climb_roughly, fit_at, fit_states
from ctsid_core.likelihood.pole_steps import bounded
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import matrices_of, modal_of, two_deviations
from ctsid_core.linear.types import Array, ComplexArray, Mask, Matrices
from ctsid_core.model.estimate import Choice, OrderTried
from ctsid_core.search.by_order import MORE, SEARCHED, affordable, search_orders
from ctsid_core.search.by_prediction import (
    Compared,
    PredictionFit,
    in_record,
    information,
    is_stable,
    plant_of,
    prediction_errors,
    solve_by_prediction,
)
from ctsid_core.search.corrupt import corrupt_rows, samples_of_part, without_outliers
from ctsid_core.search.drifting import free_with_time, mean_of
from ctsid_core.search.held import other_hold
from ctsid_core.search.needless import without_needless
from ctsid_core.search.own_past import AHEAD, held_interval
from ctsid_core.search.solution import (
    ANY_DELAY,
    ANY_ORDER,
    DISTURBED,
    GROWS,
    NO_DIRECT,
    OTHER_HOLD,
    Doubt,
    Solution,
    at_fastest,
    own_delays,
)
from ctsid_core.search.tried import (
    AKAIKE,
    LEAST,
    POINT,
    SEARCH,
    UNEXPLAINED,
    Tried,
    advantage,
    beats,
    choose,
    climbed,
    explains,
    imitates,
    price,
    roughly,
    tried,
)
from ctsid_core.settings import Settings, longest_sought, slowest_sought
from ctsid_core.signals.record import channel_slices
from ctsid_core.subspace.hd_pbsid import Subspaces, Tuning, realise

_FASTEST = 0.95       # of the outputs' Nyquist frequency: the fastest pole
_FAILS = 0.5          # error that is not noise, over the motion, with which no simulation tells a
                      # plant in open loop, and it may grow
_GROWN = 2.0          # times e, as far as a plant that grows has to predict
_AT_ONCE = 0.4        # of the fastest pole that is looked for: a pole beyond it may stand for D
_MARGIN = 1.2         # times a dead time, for which outputs are left out while D is looked for
_AROUND = np.linspace(-1.0, 1.0, 21)        # sample intervals, of which the mean is taken
_FEWEST = 3           # states: fewer are found by a grid of poles
_CLEARLY = 0.1        # -2 log likelihood, of all horizons, for each sample
_NEGLIGIBLE = 0.01    # share of the Akaike weights

_PROJECTION, _PER_SAMPLE, _REGRESSION = 1e7, 2e4, 3e6       # work of HD-PBSID

Seen = Callable[..., Samples]           # the samples, outputs left out for so long after the start


def solve(part: Joint, settings: Settings, effort: Effort) -> Solution | None:
    """Return the model of records, or None if they are too short for any."""
    found = _solve(part, settings, effort)
    return found and replace(found, doubt=_other_delays(found, settings, effort) or found.doubt)


def _solve(part: Joint, settings: Settings, effort: Effort) -> Solution | None:
    own = own_delays(part, settings)
    most = affordable(samples_of_part(part, effort))

    def seen(ahead: float = 0.0) -> Samples:
        return samples_of_part(part, effort, ahead).thinned(most)

    samples = seen()
    free = replace(free_of(samples, own), feedthrough=False)
    given = np.array(own.delays(samples.nu))
    predicted = None if own.feedthrough else _predicted(part, settings, samples, free)
    # A plant that grows predictions tell at once, and one that hardly decays, if they predict it
    # clearly better than a simulation near it would: of closed loops many states simulate the
    # record.
    growth = -np.inf if predicted is None else _growth(predicted, samples)
    if predicted is not None and growth > (GROWS if settings.order else -GROWS) and (
            solved := _as_likely(part, settings, seen, samples, free, predicted,
                                 0.0 if growth > GROWS else _CLEARLY)):
        return solved
    subspace = _Subspace(part, own, effort)
    samples, found = search_orders(samples, free, subspace.poles, order=settings.order,
                                   max_order=settings.max_order, known_delay=given)
    most = min(most, int(np.max(samples.counts.sum(axis=0))))
    # As many numbers as there are samples explain any.
    found = {n: one for n, one in found.items() if one.parameters < samples.counts.sum()}
    if not found or settings.order not in (0, *found):
        return None
    samples, found = _where_known(seen, samples, found, free, settings)
    counted = settings.order or choose(found)
    order = settings.order or _neighbour(found, counted)
    others = [(_advantage(found[order], one), one)      # over the choice, and the model
              for n, one in found.items() if n != order and not imitates(one, found[order])]
    notes = _left_out(found, order, settings, effort)
    best, fewer = found[order], choose(found) if settings.order else order
    needless = None if fewer == order else (
        f'{fewer} state{"s explain" if fewer > 1 else " explains"} as much as the {order} that '
        'are given', ANY_ORDER)
    # So do modes that last where its past tells of none: of the set point, or of disturbances.
    if predicted is not None and _growth(predicted, samples) < -GROWS and np.any(
            np.abs(best.fit.model.poles.real) * samples.length < GROWS) and (
            solved := _as_likely(part, settings, seen, samples, free, predicted)):
        return solved
    if own.feedthrough:
        with_D, free = _direct(part, seen, samples, found, best, free, subspace, settings, counted)
        if with_D is not best:              # the last choice may be right as well
            more = advantage(with_D, best)
            others = [*((gain + more, one) for gain, one in others), (more, best)]
        best = with_D
    cleaner = without_outliers(part, samples, best.fit)
    if cleaner is not part:
        part = cleaner
        samples = seen()
        best = climbed(samples, best, free)
    otherwise = _otherwise(part, samples.thinned(SEARCHED, scattered=True), found, best, free)
    disturbed, grows, left = None, False, best.left
    wanted = _wanted(part, settings, samples, free) if left > UNEXPLAINED else None
    if wanted and predicted is not None and _growth(predicted, samples) <= GROWS:
        predicted = None
    if own.feedthrough and not effort.beyond(SEARCH) and left > UNEXPLAINED:
        predicted = _predicted(part, settings, samples, free)
        grows = predicted is not None and _growth(predicted, samples) > GROWS
        # In open loop a plant is to simulate, unless it grows and no simulation tells it.
        if not grows or min(left, *(one.unexplained for one in found.values())) < _FAILS:
            predicted, disturbed = None, None if grows or wanted else predicted
    # A drift predictions take up, too, as growth; simulations of what a controller holds seem to
    # drift, but fail.
    drifts = best.drifting is not None and best.unexplained < _FAILS
    if predicted is not None and not drifts and (solved := _likelier(
            part, settings, seen, samples, best, free, predicted)):
        return replace(solved, doubt=otherwise or solved.doubt)
    reached = climbed(samples, best, free)
    best, free = without_needless(samples, reached, free, LEAST)
    if disturbed is not None and (solved := _disturbed(
            part, settings, seen, samples, best, disturbed, free, found)):
        return solved
    late = float(np.max(best.fit.model.delay, initial=0.0))
    if late > 0.0:
        samples = seen(late)
    if late > 0.0 or best is not reached:
        best = climbed(samples, best, free)
    best = mean_of(samples, best, free) if not settings.order else best
    both = best.drifting
    drifting = None if both is None else (both.samples, both.fit, free_with_time(free))
    best = _centred(samples, best, free) if both is None else best
    smaller = _smaller(samples, found, best, replace(free, feedthrough=False))
    found[best.fit.model.n] = best
    values, condition = subspace.shown(best.fit.model.n)
    return Solution(_used(part, settings, best.fit.model.n, best.fit.model.delay), part, samples,
                    best.fit, free, best.independent, _table(settings, found, best),
                    _choices(part, settings, best, free,
                             (order - counted) * (best.fit.model.n == order)),
                    (*notes, *_at_bound(best, free)),
                    doubt=otherwise or wanted or needless
                    or _doubt(best.fit.model.poles, samples, free, own, grows),
                    smaller=smaller, drifting=drifting,
                    rivals=_rivals([(gain, one.fit.model) for gain, one in others]),
                    singular_values=values, condition=condition)


def _disturbed(part: Joint, settings: Settings, seen: Seen, samples: Samples, best: Tried,
               found: PredictionFit, free: Free, orders: dict[int, Tried]) -> Solution | None:
    """
    Return the plant that predictions found, as it simulates, if these are likelier.

    What disturbs a plant for longer than it remembers is like an input that is not known. Output
    error then trusts most the frequencies that are disturbed most; predictions trust those that
    are known best.
    """
    plant = _plant_of(part, samples, found, free)
    if plant is None or not _predicts_better(part, samples, best, found):
        return None
    # If this is the plant, all numbers of the best simulation explain no more than their price.
    n_eff = np.maximum(plant.simulated.independent, 2.0)
    power = [np.maximum(one.power, LEAST ** 2) for one in (plant.simulated, best)]
    if n_eff @ np.log(power[0] / power[1]) > best.parameters * np.log(np.min(n_eff)):
        return None
    solved = _as_it_simulates(part, settings, seen, samples, found, plant, best.fit.model.delay)
    best = climbed(solved.samples, best, free) if solved.samples is not samples else best
    return replace(
        solved, simulating=(solved.samples, best.fit, free),
        smaller=_smaller(solved.samples, orders, best, replace(free, feedthrough=False)))


class _Plant(NamedTuple):
    """A plant that predictions found, and how it simulates."""

    matrices: Matrices
    simulated: Tried
    free: Free


def _plant_of(part: Joint, samples: Samples, found: PredictionFit, free: Free) -> _Plant | None:
    """Return the plant that predictions found, none of its modes growing, or None."""
    fit, nu = found.found.fit, samples.nu
    free = replace(free, feedthrough=False, delays=found.free.delays[:nu])
    m = plant_of(fit, found.samples, part.last, free.limit)
    plant = None if m is None else modal_of(m, samples, fit.model.delay[:nu])
    with suppress(np.linalg.LinAlgError):
        if m is not None and plant is not None:
            one, gains = tried(samples, fit_states(samples, plant, free), free), m.K.size
            share = found.found.parameters / (one.parameters + gains)       # 1, if it has climbed
            return _Plant(m, replace(one, parameters=round(share * one.parameters)), free)
    return None


def _where_known(seen: Seen, samples: Samples, found: dict[int, Tried], free: Free,
                 settings: Settings) -> tuple[Samples, dict[int, Tried]]:
    """
    Return the samples, and the models of each order, that the order is chosen by.

    Before a delayed input is known, what it was before acts, which further states imitate. Where
    a smaller order is enough for the rest, the rest is what counts.
    """
    chosen = settings.order or choose(found)
    late = float(np.max(found[chosen].fit.model.delay, initial=0.0))
    up_to = {n: one for n, one in found.items() if n <= chosen}
    if late > 0.0 and len(up_to) > 1 and not samples.effort.beyond(SEARCH):
        known = seen(late)
        if np.min(known.counts.sum(axis=0)) > found[chosen].parameters:
            thin, rest = known.thinned(SEARCHED), {}
            for n, one in up_to.items():
                model = one.fit.model
                rest[n] = replace(roughly(thin, model.poles, model.delay, free, one.fit),
                                  pointed=one.pointed, drifting=one.drifting, found=one.found)
            if choose(rest) < chosen:
                return known, {n: climbed(known, one, free) for n, one in rest.items()}
    return samples, found


def _as_it_simulates(part: Joint, settings: Settings, seen: Seen, samples: Samples,
                     found: PredictionFit, plant: _Plant,
                     delay: Array | float = 0.0) -> Solution:
    """Return a plant that predictions found, to be judged by its simulation."""
    one, fit = plant.simulated, plant.simulated.fit
    late = float(np.max(np.maximum(fit.model.delay, delay), initial=0.0))
    if late > 0.0:
        samples = seen(late)
        one = tried(samples, fit_states(samples, fit.model, plant.free), plant.free)
    domain = 'disturbed' if one.unexplained > UNEXPLAINED else 'simulation'
    return Solution(
        _used(part, settings, fit.model.n, fit.model.delay), part, samples, one.fit, plant.free,
        one.independent, (),                    # orders were compared by predictions
        (Choice('domain', domain, 'inputs and past outputs together predict these data better '
                'than the inputs alone simulate them: the model was found so, and is judged by '
                'how it simulates'),),
        (*_left_out(found.orders, fit.model.n, settings, samples.effort),
         *_at_bound(one, plant.free)), plant=plant.matrices, rivals=_other_plants(
            part, settings, samples, found, plant.free.limit),
        doubt=_doubt(fit.model.poles, samples, plant.free, settings),
        predictor=(found.samples, found.found.fit, found.free))


def _neighbour(found: dict[int, Tried], chosen: int) -> int:
    """
    Return the chosen order, or the one beside it that is likelier in noise of any colour.

    What a disturbance or a curve of the plant leaves is hardly independent, however it is counted,
    but its own past tells most of it; and a state too few, for which a dead time stands in, shows
    in what is new before it shows in the fit. One more has to be likelier by what a number costs.
    """
    matters = found[chosen].power > LEAST ** 2
    if not matters.any():
        return chosen
    own = found[chosen]
    return min((n for n in (chosen, chosen - 1, chosen + 1) if n in found and (
        n <= chosen or not imitates(found[n], own) and (explains(own, found[n]) or bool(np.any(
            found[n].fit.model.delay < 0.5 * own.fit.model.delay))))),
               key=lambda n: _in_colour(found[n], matters) + price(own.samples) * (n > chosen))


def _in_colour(one: Tried, matters: Mask, each: float = 0.0) -> float:
    """
    Return Schwarz's criterion with errors of any colour, of the outputs that matter.

    Unless `each` says what a parameter costs.
    """
    return float(one.coloured[matters].sum()) + (each or price(one.samples)) * one.parameters


def _advantage(one: Tried, other: Tried) -> float:
    """
    Return by how much Akaike's criterion prefers the other one.

    The less of what independent samples and errors of any colour say: few samples are independent
    of what missing states leave, and a model without them would seem as right as one that leaves
    nothing but noise.
    """
    matters = np.maximum(one.power, other.power) > LEAST ** 2
    return min(advantage(one, other),
               _in_colour(one, matters, AKAIKE) - _in_colour(other, matters, AKAIKE))


def _rivals(others: list[tuple[float, ModalModel]]) -> tuple[tuple[float, ModalModel], ...]:
    """Return the models that might be right, with their share of the Akaike weights."""
    gains = np.array([0.0, *(gain for gain, _ in others)])
    weights = np.exp(0.5 * (gains - gains.max()))
    shares = (weights / weights.sum()).tolist()[1:]
    return tuple((share, one) for share, (_, one) in zip(shares, others, strict=True)
                 if share > _NEGLIGIBLE)


def _other_plants(part: Joint, settings: Settings, samples: Samples, found: PredictionFit,
                  limit: float) -> tuple[tuple[float, ModalModel], ...]:
    """
    Return other plants that might be right, of predictors, with their share.

    Those of the predictors that it was compared with in the end, and its own with each dead time
    two deviations off to either side, which their shares make one deviation.
    """
    def plant(fit: Fit) -> ModalModel | None:
        m = plant_of(fit, found.samples, part.last, limit)
        return None if m is None else modal_of(m, samples, fit.model.delay[:samples.nu])

    fit, others = found.found.fit, [(one, plant(one.found.fit)) for one in found.others]
    # None is likelier than the choice, which looks further ahead than one sample.
    rivals = list(_rivals([(min(_advantage(found.found, one.found), 0.0), other)
                           for one, other in others if other is not None]))
    sought = own_delays(part, settings).unknown_delays(samples.nu)
    for j in np.flatnonzero(sought).tolist():
        if samples.effort.beyond(SEARCH):
            break
        changes = two_deviations(found.samples, fit, found.free, j, samples.interval)
        for change in changes:
            delay = fit.model.delay.copy()
            delay[j] = max(delay[j] + change, 0.0)
            with suppress(np.linalg.LinAlgError):
                beside = plant(fit_at(found.samples, fit.model.poles, delay, found.free, fit,
                                      slopes=False))
                rivals += [(0.25 / len(changes), beside)] if beside is not None else []
    return tuple(rivals)


def _smaller(samples: Samples, found: dict[int, Tried], best: Tried,
             free: Free) -> tuple[tuple[ModalModel, Free], ...]:
    """Return the models of smaller orders, the dead times that are not free those of the best."""
    models = []
    for model in (one.fit.model for n, one in found.items() if n < best.fit.model.n):
        delay = np.where(free.delays, model.delay, best.fit.model.delay)
        if (delay != model.delay).any():
            with suppress(np.linalg.LinAlgError):
                model = climb_roughly(
                    samples, fit_at(samples, model.poles, delay, free), free).model
        models.append((model, free))
    return tuple(models)


def _at_bound(best: Tried, free: Free) -> tuple[str, ...]:
    """Return that a pole is about as fast as any that is looked for, in words."""
    return () if not at_fastest(best.fit, free) else (
        f'the pole of {np.max(np.abs(best.fit.model.poles)):.3g} rad/s is about the fastest that '
        f'is looked for ({_FASTEST:g} of the Nyquist frequency of the outputs) and stands for '
        'anything faster: it is a bound',)


def _doubt(poles: Array | ComplexArray, samples: Samples, free: Free, own: Settings,
           grows: bool = False) -> Doubt | None:
    """
    Return what a model looks like if the setting of D is not right, and that setting.

    With D: three states (a pair is two) decay by less than e within a record, or grow, or
    predictions find a mode that grows. Without D: a mode decays nearly as fast as any sought.
    """
    poles = poles[poles.imag >= 0.0]
    near = poles.real * samples.length >= -GROWS
    steady = int(np.sum(near) + np.sum(near & (poles.imag > 0.0)))
    if own.feedthrough and (grows or steady > 2):
        what = 'predictions find a mode that grows' \
            if grows else 'modes hardly move within the record'
        return (f'{what}, as when a controller keeps an unstable plant in place',
                NO_DIRECT)
    # One that goes on is no D.
    if not own.feedthrough and np.max(-poles.real, initial=0.0) > _AT_ONCE * free.fastest:
        return ('a mode decays nearly as fast as any that is looked for, as when outputs follow '
                'inputs at once, and no controller acts', 'feedthrough: true')
    return None


def _left_out(found: Container[int], order: int, settings: Settings,
              effort: Effort) -> tuple[str, ...]:
    """Return what the budget has left out, in words."""
    near = range(max(order - MORE, 1), min(order + MORE, settings.max_order) + 1)
    if settings.order or not effort.beyond(SEARCH) or all(n in found for n in near):
        return ()
    return (f'the budget of {settings.budget:.3g} s ended the search at order {order}; raise '
            '`budget`, or set `order`',)


def _direct(part: Joint, seen: Seen, samples: Samples, found: dict[int, Tried], best: Tried,
            free: Free, subspace: _Subspace, settings: Settings,
            counted: int) -> tuple[Tried, Free]:
    """Return the model with D, if that explains more than it costs."""
    model, direct = best.fit.model, replace(free, feedthrough=True)
    known = seen(_MARGIN * float(np.max(model.delay, initial=0.0)))
    if samples.effort.beyond(SEARCH) or np.min(known.counts.sum(axis=0)) <= best.parameters:
        return best, free
    # Worth a search if it is worth its price at the poles that are known, with their dead times or
    # at once, or if one of these is beyond what samples can show, and may stand for D.
    stands = bool(np.max(np.abs(model.poles)) > _AT_ONCE * free.fastest)
    # A state that the colour of the errors has added, D takes back only if it stands for D.
    fewest = 1 if stands or model.n <= counted else model.n
    if not stands and not any(beats(_fitted(samples, own, direct), best)
                              for n, one in found.items() if fewest <= n <= model.n
                              for own in _late_or_not(one.fit.model, free)):
        return best, free
    known, orders = search_orders(
        known, direct, subspace.poles, order=settings.order, max_order=model.n,
        near=_behind_lags(found, free),
        known_delay=np.array(own_delays(part, settings).delays(samples.nu)))
    orders = {n: one for n, one in orders.items() if n >= fewest}
    # A search from the beginning is not to end worse than the poles that it was worth it for.
    kept = min((climbed(known, _fitted(known, own, direct, best.fit), direct)
                for own in _late_or_not(model, free)), key=lambda one: one.fit.cost)
    orders[model.n] = min(orders.get(model.n, kept), kept, key=lambda one: one.fit.cost)
    with_D = orders[settings.order or choose(orders)]
    if not beats(with_D, _fitted(known, model, free, best.fit)):
        return best, free
    return _centred(samples, _fitted(samples, with_D.fit.model, direct, with_D.fit),
                    direct), direct


def _centred(samples: Samples, one: Tried, free: Free) -> Tried:
    """
    Return a model with D at the mean of the dead times that the samples allow.

    In the dead time of D the likelihood is flat but where a jump of the input passes a sample: any
    point of what is flat is a maximum, and on other data the middle errs least.
    """
    fit = one.fit
    late = np.array(free.delays) & (fit.model.delay > 0.0)
    for j in np.flatnonzero(late & fit.model.D.any(axis=0)).tolist():
        poles, delays = fit.model.poles, np.tile(fit.model.delay, (len(_AROUND), 1))
        delays[:, j] = np.clip(delays[:, j] + samples.interval * _AROUND, 0.0, free.longest)
        with suppress(np.linalg.LinAlgError):
            costs = [fit_at(samples, poles, d, free, fit, slopes=False).cost for d in delays]
            mean = np.average(delays, axis=0, weights=np.exp(0.5 * (min(costs) - np.array(costs))))
            middle = fit_at(samples, poles, mean, free, fit)
            fit = middle if middle.cost < fit.cost + 1.0 else fit
    return one if fit is one.fit else tried(samples, fit, free)


def _behind_lags(found: dict[int, Tried], free: Free) -> list[Array]:
    """Return the dead times of models that have none of the poles beyond what samples show."""
    late, delays = np.array(free.delays), []
    for model in (one.fit.model for one in found.values()):
        fast = model.poles[np.abs(model.poles) > _AT_ONCE * free.fastest]
        lag = -np.sum((1.0 + (fast.imag > 0.0)) / fast).real
        delays.append(np.where(late, np.minimum(model.delay + lag, free.longest), model.delay))
    return delays


def _late_or_not(model: ModalModel, free: Free) -> list[ModalModel]:
    """Return a model, and the same without the dead times that were found, if there are any."""
    late = np.array(free.delays) & (model.delay > 0.0)
    return [model, replace(model, delay=np.where(late, 0.0, model.delay))][:1 + bool(late.any())]


def _fitted(samples: Samples, model: ModalModel, free: Free, near: Fit | None = None) -> Tried:
    """Return the best model of other samples, or with D, at a model's poles and dead times."""
    return tried(samples, fit_at(samples, model.poles, model.delay, free, near), free)


def _used(part: Joint, settings: Settings, order: int, delay: Array) -> Settings:
    """Return the settings with what was found; dead times as one number if given so and alike."""
    delays = np.array(settings.delays(part.parts[0].whole.nu))
    delays[list(part.parts[0].u)] = delay
    alike = not isinstance(settings.delay, tuple) and bool(np.all(delays == delays[0]))
    return settings.replace(order=order,
                            delay=float(delays[0]) if alike else tuple(delays.tolist()))


def _table(settings: Settings, found: dict[int, Tried], chosen: Tried) -> tuple[OrderTried, ...]:
    """Return the orders among which was chosen; none if it was given."""
    return () if settings.order else tuple(
        order_row(one, chosen, n) for n, one in sorted(found.items()))


def _choices(part: Joint, settings: Settings, best: Tried, free: Free,
             beside: int) -> tuple[Choice, ...]:
    """Return what was chosen, and why."""
    why = f', and one {"more" if beside > 0 else "less"}, because neighbouring errors are alike'
    found = [] if settings.order else [Choice(
        'order', best.fit.model.n, ('the fewest states: more would explain no more than chance '
                                    'does' + (why if beside else ''))
        if best.fit.model.n < settings.max_order else
        'the most that are tried: more may explain more, set `max_order`')]
    found += [Choice('delay', round(float(best.fit.model.delay[k]), 6),
                     f'of input {name}: the most likely, with the poles')
              for k, name in enumerate(_names(part)) if free.delays[k]]
    return tuple(found)


def _predicted(part: Joint, settings: Settings, samples: Samples,
               free: Free) -> PredictionFit | None:
    """Return the model that predicts best."""
    own = own_delays(part, settings)
    return solve_by_prediction(
        samples, replace(free, delays=own.unknown_delays(samples.nu)), order=settings.order,
        max_order=settings.max_order, known_delay=np.array(own.delays(samples.nu)),
        last=_compared(part, part.last))


def _otherwise(part: Joint, samples: Samples, found: dict[int, Tried], best: Tried,
               free: Free) -> Doubt | None:
    """Return that an input is not held as it is said to be, and what to set, if so."""
    other = other_hold(samples, found, best, free)
    if other is None:
        return None
    place, hold = other
    inputs = samples.records[0].inputs
    name = _names(part)[channel_slices(inputs)[place].start].partition('[')[0]
    moves = 'is held between its samples' if hold == 'zoh' else 'moves between its samples'
    return (f'input {name} seems as if it {moves}: that explains more, with no more states, than '
            f'`hold: {inputs[place].hold}` does', f'{name}{OTHER_HOLD}{hold}')


def _wanted(part: Joint, settings: Settings, samples: Samples, free: Free) -> Doubt | None:
    """
    Return that an order is given which is too small, as predictions say, and the setting.

    What missing states leave is no noise, and predictions would take it for that.
    """
    sought = 0 < settings.order < settings.max_order and not samples.effort.leaves_out(
        'whether more states predict better', SEARCH)
    found = _predicted(part, settings.replace(order=0), samples, free) if sought else None
    return None if found is None or len(found.matrices.A) <= settings.order else (
        f'more states than the {settings.order} that are given predict better, as when the order '
        'is too small', ANY_ORDER)


def _other_delays(found: Solution, settings: Settings, effort: Effort) -> Doubt | None:
    """Return that dead times are given with which less is explained than with others, if so."""
    own, simulated = own_delays(found.part, settings), found.simulated
    unknown = np.array(own.unknown_delays(len(found.delay)))
    if unknown.all() or simulated is None:
        return None
    left = [tried(*one).unexplained for one in (simulated, found.drifting) if one]
    if min(left) <= UNEXPLAINED or effort.leaves_out('whether other dead times explain more'):
        return None
    samples, (_, fit, given) = simulated[0].thinned(SEARCHED), simulated
    free = replace(given, delays=(True,) * samples.nu)
    order, most = settings.order, fit.model.n
    if found.doubt is not None and found.doubt[1] == ANY_ORDER:
        order, most = 0, settings.max_order     # or dead times stand for states that are missing
    samples, orders = search_orders(
        samples, free, _Subspace(found.part, own, effort).poles, order=order, max_order=most,
        known_delay=np.zeros(samples.nu))
    other = orders.get(order or choose(orders)) if orders else None
    if other is None:
        return None
    model = other.fit.model
    near = climbed(samples, _fitted(samples, replace(model, delay=np.where(
        unknown, model.delay, own.delays(samples.nu))), given, other.fit), given)
    if not (beats(other, near) and beats(other, _fitted(samples, fit.model, given, fit))):
        return None
    return ('dead times of ' + ', '.join(f'{d:.3g}' for d in model.delay)
            + ' s explain more than those that are given', ANY_DELAY)


def _compared(part: Joint, place: int) -> Compared:
    own = part.parts[place]
    return Compared(place, own.record, corrupt_rows(own))


def _as_likely(part: Joint, settings: Settings, seen: Seen, samples: Samples, free: Free,
               found: PredictionFit, clearly: float = 0.0) -> Solution | None:
    """Return the plant that predictions found, if likelier than the best simulation near it."""
    poles = bounded(np.linalg.eigvals(found.matrices.A).astype(complex), free.limit, np.inf)
    thin, near = samples.thinned(SEARCHED), None
    with suppress(np.linalg.LinAlgError):
        start = fit_at(thin, poles, found.found.fit.model.delay[:samples.nu], free)
        top = climb_roughly(thin, start, free)
        near = tried(samples, fit_at(samples, top.model.poles, top.model.delay, free, top), free)
    return None if near is None or clearly and near.unexplained < UNEXPLAINED else _likelier(
        part, settings, seen, samples, near, free, found, clearly)


def _likelier(part: Joint, settings: Settings, seen: Seen, samples: Samples, best: Tried,
              free: Free, found: PredictionFit, clearly: float = 0.0) -> Solution | None:
    """
    Return the plant that predictions found where they are likelier than a simulation's.

    By at least `clearly` for each sample.

    If it simulates, that is what it is judged by, else by predictions.
    """
    if not _predicts_better(part, samples, best, found, clearly):
        return None
    # Simulated as it is, for the best simulation may err by what the controller makes of gusts.
    plant = None if _growth(found, samples) > GROWS else _plant_of(part, samples, found, free)
    if plant is not None and plant.simulated.unexplained < DISTURBED:
        return _as_it_simulates(part, settings, seen, samples, found, plant)
    return Solution(
        _used(part, settings, len(found.matrices.A), found.found.fit.model.delay[:samples.nu]),
        part, found.samples, found.found.fit, found.free, found.found.independent,
        _table(settings, found.orders, found.found),
        (Choice('domain', 'predictions', 'inputs and past outputs together predict these data '
                'better than the best simulation from the inputs alone'),),
        _left_out(found.orders, len(found.matrices.A), settings, samples.effort),
        doubt=_doubt(np.linalg.eigvals(found.matrices.A), samples, free, settings),
        plant=found.matrices, errors_ahead=found.errors,
        rivals=_other_plants(part, settings, samples, found,
                             0.0 if is_stable(found.matrices) else np.inf),
        simulating=None if plant is None else (samples, plant.simulated.fit, plant.free))


def _predicts_better(part: Joint, samples: Samples, best: Tried,
                     found: PredictionFit, clearly: float = 0.0) -> bool:
    """
    Return whether the plant that predictions found predicts better than a simulation's.

    Where a simulation explains all but noise, a plant that grows must not predict worse where it
    has grown: less far ahead, a gain that drifts looks like growth. One that does not grow must
    not predict worse several samples ahead: one sample ahead, high frequencies may outweigh it.
    Not beside oscillations that last, which know a set point, or what disturbs, as far ahead.
    """
    fit = found.found.fit
    noisy, _ = with_noise(samples, best.fit, best.errors, part.last)
    numbers = best.parameters + int(np.count_nonzero(noisy.K))
    growth, gain, far = _growth(found, samples), 0.0, 0.0
    doubted = growth > GROWS and best.unexplained < UNEXPLAINED
    poles = best.fit.model.poles
    asked = growth <= GROWS and not np.any(
        (poles.imag > 0.0) & (np.abs(poles.real) * samples.length < GROWS))
    for place, counts in enumerate(samples.counts):
        record, last = samples.records[place], _compared(part, place)
        # Nor do outputs count that no simulation knows the inputs of.
        cut = replace(last, record=replace(last.record, start=record.start))
        rival = replace(matrices_of(best.fit.model, samples.size, place), K=noisy.K)
        plant = found.matrices if place == part.last else in_record(
            found.matrices, fit, found.samples, place)
        simulated = partial(prediction_errors, rival, best.fit.model.delay, cut, simulates=True)
        predicted = partial(prediction_errors, plant, fit.model.delay[:samples.nu], cut)
        errors = found.errors if place == part.last and record.start == last.record.start \
            else predicted()
        rivals = simulated()
        gain += information(rivals, counts) - information(errors, counts)
        if asked and AHEAD < min(len(errors), len(rivals)):
            far += float(counts @ np.log(np.maximum(errors[AHEAD], LEAST)
                                         / np.maximum(rivals[AHEAD], LEAST)))
        if doubted:
            length = record.end - record.start
            ahead = min(_GROWN / growth * samples.length, 0.4 * length)
            horizons = (max(int(ahead / held_interval(found.samples)), 1),)
            own, other = (np.maximum(f(horizons=horizons), LEAST) for f in (predicted, simulated))
            # Errors so far ahead are alike for as long.
            far += 2.0 * length / ahead * float(np.sum(np.log(own / other)))
    # Fewer numbers are no reason to give up a simulation.
    more = price(samples) * max(found.found.parameters - numbers, 0)
    return gain >= max(more, clearly * float(np.sum(samples.counts))) and far <= 0.0


def _growth(found: PredictionFit, samples: Samples) -> float:
    """Return how many times e a plant that predictions found grows within a record."""
    return float(np.max(np.linalg.eigvals(found.matrices.A).real)) * samples.length


def _names(part: Joint) -> list[str]:
    names = part.parts[0].whole.input_names
    return [names[j] for j in part.parts[0].u]


def free_of(samples: Samples, own: Settings) -> Free:
    """Return what is free, and within which bounds."""
    return Free(own.feedthrough, own.trim, own.unknown_delays(samples.nu),
                longest_sought(samples.length), -slowest_sought(samples.length),
                _FASTEST * np.pi / samples.finest)


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

        Small models of several inputs have any dead times: those given are a start, too, and where
        a budget is short the first that are asked for are all.
        """
        given = bool(np.array_equal(delay, self._own.delays(len(delay))))
        if given in self._made or self._made and self._effort.beyond(POINT):
            return self._made.get(given)
        self._made[given], own = None, self._own.replace(delay=tuple(delay.tolist()))
        self._effort.spend(_PROJECTION + _PER_SAMPLE * sum(
            float(len(s.time)) for p in self._part.parts for s in p.record.outputs))
        with suppress(np.linalg.LinAlgError):
            self._made[given] = Subspaces(self._part.project(own, self._effort.check), own)
        return self._made[given]


def order_row(one: Tried, chosen: Tried, n: int) -> OrderTried:
    """Return a row of the table of orders: all by the independent samples of the chosen one."""
    n_eff = max(float(np.min(chosen.independent)), 2.0)
    power = one.power / np.maximum(chosen.power, 1e-300)
    price = (one.parameters - chosen.parameters) * float(np.log(n_eff))
    return OrderTried(n, n_eff * float(np.sum(np.log(np.maximum(power, 1e-300)))) + price,
                      100.0 * (1.0 - float(np.sqrt(np.max(one.power)))))
