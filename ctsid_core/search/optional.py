# SPDX-License-Identifier: Apache-2.0
"""D and dead times: numbers that a model may do without."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Fit, Free, climb_roughly, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import entry_changes
from ctsid_core.linear.types import Array
from ctsid_core.search.by_order import (
    LEAST,
    SEARCH,
    SubspacePoles,
    Tried,
    beats,
    choose,
    criterion,
    search_orders,
    tried,
)
from ctsid_core.search.problem import AT_ONCE, Problem

_AROUND = np.linspace(-1.0, 1.0, 21)        # sample intervals, of which the mean is taken
_SURE = 6.0           # standard deviations from which on a dead time is not asked
_MATTERS = 0.003      # of the motion: what a dead time that stays may gain at least


def with_direct(given: Problem, samples: Samples, found: dict[int, Tried], best: Tried,
                free: Free, subspace: SubspacePoles, counted: int) -> tuple[Tried, Free]:
    """
    Return the model with D, if that explains more than it costs.

    A state that the colour of the errors has added to the order `counted` D takes back only if a
    pole stands for D.
    """
    model, direct, order = best.fit.model, replace(free, feedthrough=True), given.settings.order
    known = given.seen(float(np.max(model.delay, initial=0.0)))
    if samples.effort.beyond(SEARCH) or np.min(known.counts.sum(axis=0)) <= best.parameters:
        return best, free
    # Worth a search if it is worth its price at the poles that are known, or if one of these is
    # beyond what samples can show, and may stand for D.
    stands = bool(np.max(np.abs(model.poles)) > AT_ONCE * free.fastest)
    fewest = 1 if stands or model.n <= counted else model.n
    if not stands and not any(beats(_fitted(samples, one.fit.model, direct), best)
                              for n, one in found.items() if fewest <= n <= model.n):
        return best, free
    known, orders = search_orders(
        known, direct, subspace, order=order, max_order=model.n,
        near=_behind_lags(found, free), known_delay=given.known_delay)
    orders = {n: one for n, one in orders.items() if n >= fewest}
    if not orders or order not in (0, *orders):
        return best, free
    with_D = orders[order or choose(orders)]
    if not beats(with_D, _fitted(known, model, free, best.fit)):
        return best, free
    return centred(samples, _fitted(samples, with_D.fit.model, direct, with_D.fit),
                    direct), direct


def centred(samples: Samples, one: Tried, free: Free) -> Tried:
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
        fast = model.poles[np.abs(model.poles) > AT_ONCE * free.fastest]
        lag = -np.sum((1.0 + (fast.imag > 0.0)) / fast).real
        delays.append(np.where(late, np.minimum(model.delay + lag, free.longest), model.delay))
    return delays


def _fitted(samples: Samples, model: ModalModel, free: Free, near: Fit | None = None) -> Tried:
    """Return the best model of other samples, or with D, at a model's poles and dead times."""
    return tried(samples, fit_at(samples, model.poles, model.delay, free, near), free)


def without_needless(samples: Samples, best: Tried, free: Free) -> tuple[Tried, Free]:
    """
    Return the model without dead times that explain too little, and what is free in it.

    They are asked all at once, then, if that is too many, one by one; those that are sure are not.
    Rms errors below `LEAST`, over the motion, are no evidence.
    """
    found = best.fit.model.delay
    asked = np.array(free.delays) & (found > 0.0)
    if asked.any() and np.any(best.power >= LEAST ** 2):
        asked &= found < _SURE * np.linalg.norm(entry_changes(samples, best.fit, free).delay,
                                                axis=0)
    late = np.flatnonzero(asked)
    free = _fixed(free, np.flatnonzero(free.delays & (found == 0.0)))
    count = samples.counts.sum()
    # What one costs at most, in samples that are not independent.
    price = float(np.log(count) * np.max(samples.counts.sum(axis=0) / best.independent))
    nothing = 2.0 * float(count) * float(np.log(LEAST))
    for places in [late, *(late[k:k + 1] for k in range(len(late)) if len(late) > 1)]:
        if samples.effort.over or not np.any(np.array(free.delays)[places]):
            continue
        fewer, delay = _fixed(free, places), best.fit.model.delay.copy()
        delay[places] = 0.0
        start = fit_at(samples, best.fit.model.poles, delay, fewer)
        other = tried(samples, climb_roughly(
            samples, start, fewer, max(best.fit.cost + len(places) * price, nothing)), fewer)
        if np.all(other.power < LEAST ** 2) or (
                criterion(other, best) <= 0.0 and other.rms - best.rms < _MATTERS):
            best, free = other, fewer
    return best, free


def _fixed(free: Free, places: NDArray[np.intp]) -> Free:
    """Return what is free, without the dead times of some inputs."""
    return replace(free, delays=tuple(f and k not in places for k, f in enumerate(free.delays)))
