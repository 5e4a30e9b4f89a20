# SPDX-License-Identifier: Apache-2.0
"""
Whether outputs follow inputs at once (D), instead of or beside dead times and fast poles.

And which dead times a model may do without: those that explain too little for a number.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Free, climb_roughly, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import entry_changes
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.by_order import search_orders
from ctsid_core.search.solution import DIRECT, GROWS, NO_DIRECT, Doubt
from ctsid_core.search.task import Subspace, Task
from ctsid_core.search.tried import SEARCH, Tried, beats, choose, climbed, criterion, fitted, tried

_AT_ONCE = 0.4        # of the fastest pole that is looked for: a pole beyond it may stand for D
_MARGIN = 1.2         # times a dead time, for which outputs are left out while D is looked for
_AROUND = np.linspace(-1.0, 1.0, 21)        # sample intervals, of which the mean is taken
_SURE = 6.0           # standard deviations from which on a dead time is not asked by itself
_MATTERS = 0.003      # of the motion: what a dead time that stays may gain at least


def with_direct(task: Task, samples: Samples, found: dict[int, Tried], best: Tried, free: Free,
                subspace: Subspace, counted: int) -> tuple[Tried, Free]:
    """Return the model with D, if that explains more than it costs."""
    model, direct = best.fit.model, replace(free, feedthrough=True)
    known = task.seen(_MARGIN * float(np.max(model.delay, initial=0.0)))
    if samples.effort.beyond(SEARCH) or np.min(known.counts.sum(axis=0)) <= best.parameters:
        return best, free
    # Worth a search if it is worth its price at the poles that are known, with their dead times or
    # at once, or if one of these is beyond what samples can show, and may stand for D.
    stands = bool(np.max(np.abs(model.poles)) > _AT_ONCE * free.fastest)
    # A state that the colour of the errors has added, D takes back only if it stands for D.
    fewest = 1 if stands or model.n <= counted else model.n
    if not stands and not any(beats(fitted(samples, own, direct), best)
                              for n, one in found.items() if fewest <= n <= model.n
                              for own in _late_or_not(one.fit.model, free)):
        return best, free
    known, orders = search_orders(
        known, direct, subspace.poles, order=task.settings.order, max_order=model.n,
        near=_behind_lags(found, free),
        known_delay=np.array(task.own.delays(samples.nu)))
    orders = {n: one for n, one in orders.items() if n >= fewest}
    # A search from the beginning is not to end worse than the poles that it was worth it for.
    kept = min((climbed(known, fitted(known, own, direct, best.fit), direct)
                for own in _late_or_not(model, free)), key=lambda one: one.fit.cost)
    orders[model.n] = min(orders.get(model.n, kept), kept, key=lambda one: one.fit.cost)
    with_D = orders[task.settings.order or choose(orders)]
    if not beats(with_D, fitted(known, model, free, best.fit)):
        return best, free
    return centred(samples, fitted(samples, with_D.fit.model, direct, with_D.fit), direct), direct


def centred(samples: Samples, one: Tried, free: Free) -> Tried:
    """Return a model with D at the mean of the dead times that the samples allow."""
    # In the dead time of D the likelihood is flat but where a jump of the input passes a sample:
    # any point of what is flat is a maximum, and on other data the middle errs least.
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


def doubt_of_direct(poles: Array | ComplexArray, delay: Array, samples: Samples, free: Free,
                    feedthrough: bool, grows: bool = False) -> Doubt | None:
    """
    Return what a model looks like if the setting of D is not right, and that setting.

    With D: three states (a pair is two) decay by less than e within a record, or grow, or
    predictions find a mode that grows. Without D: a mode decays nearly as fast as any sought, and
    some `delay` is 0.
    """
    poles = poles[poles.imag >= 0.0]
    near = poles.real * samples.length >= -GROWS
    steady = int(np.sum(near) + np.sum(near & (poles.imag > 0.0)))
    if feedthrough and (grows or steady > 2):
        what = 'predictions find a mode that grows' \
            if grows else 'modes hardly move within the record'
        return (f'{what}, as when a controller keeps an unstable plant in place', NO_DIRECT)
    # One that goes on is no D.
    if not feedthrough and np.min(delay) <= 0.0 and np.max(
            -poles.real, initial=0.0) > _AT_ONCE * free.fastest:
        return ('a mode decays nearly as fast as any that is looked for, as when outputs follow '
                'inputs at once, and no controller acts', DIRECT)
    return None


def without_needless(samples: Samples, best: Tried, free: Free, least: float,
                     each: bool = True) -> tuple[Tried, Free]:
    """
    Return the model without dead times that explain too little, and what is free in it.

    They are asked all at once. If `each` may go, then, if that is too many, one by one, and those
    that are sure are not asked. Rms errors below `least`, over the motion, are no evidence. Noise
    that is stronger the faster it is, as of differences of counts, tells more of dead times than
    its power does: in noise of any colour they may not be likelier either.
    """
    found = best.fit.model.delay
    asked = np.array(free.delays) & (found > 0.0)
    if each and asked.any() and np.any(best.power >= least ** 2):
        deviation = np.linalg.norm(entry_changes(samples, best.fit, free).delay, axis=0)
        asked &= found < _SURE * deviation
    late = np.flatnonzero(asked)
    free = free.without(np.flatnonzero(free.delays & (found == 0.0)).tolist())
    count = samples.counts.sum()
    # What one costs at most, in samples that are not independent; below `least` nothing counts.
    price = float(np.log(count) * np.max(samples.counts.sum(axis=0) / best.independent))
    nothing = 2.0 * float(count) * float(np.log(least)) if least else -np.inf
    for places in [late, *(late[k:k + 1] for k in range(len(late)) if each and len(late) > 1)]:
        if samples.effort.over or not np.any(np.array(free.delays)[places]):
            continue
        fewer, delay = free.without(places.tolist()), best.fit.model.delay.copy()
        delay[places] = 0.0
        start = fit_at(samples, best.fit.model.poles, delay, fewer)
        other = tried(samples, climb_roughly(
            samples, start, fewer, max(best.fit.cost + len(places) * price, nothing)), fewer)
        if np.all(other.power < least ** 2) or (
                criterion(other, best) <= 0.0 and other.rms - best.rms < _MATTERS
                and float(np.sum((other.coloured - best.coloured)[other.power >= least ** 2]))
                <= len(places) * float(np.log(count))):
            best, free = other, fewer
    return best, free
