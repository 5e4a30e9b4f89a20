# SPDX-License-Identifier: Apache-2.0
"""
Plants that predictions found, beside simulations: where they are taken, and how they are judged.

A plant that grows is judged by its predictions; one that simulates, by that.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.likelihood.modal_model import ModalModel, bounded
from ctsid_core.likelihood.noise_gain import with_noise
from ctsid_core.likelihood.output_error import Fit, Free, climb_roughly, fit_at, fit_states
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import matrices_of, modal_of, two_deviations
from ctsid_core.linear.types import Array, Matrices
from ctsid_core.model.estimate import Choice
from ctsid_core.search.by_order import SEARCHED
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
from ctsid_core.search.direct import doubt_of_direct
from ctsid_core.search.own_past import AHEAD, held_interval
from ctsid_core.search.solution import (
    DISTURBED,
    GROWS,
    Solution,
    at_bound,
    left_out,
    table_of,
    used,
)
from ctsid_core.search.task import Task, corrupt_rows
from ctsid_core.search.tried import (
    LEAST,
    SEARCH,
    UNEXPLAINED,
    Tried,
    advantage_in_colour,
    climbed,
    price,
    shares_of,
    smaller_models,
    tried,
)

_GROWN = 2.0          # times e, as far as a plant that grows has to predict


def predicted(task: Task, samples: Samples, free: Free) -> PredictionFit | None:
    """Return the model that predicts best."""
    own = task.own
    return solve_by_prediction(
        samples, replace(free, delays=own.unknown_delays(samples.nu)), order=own.order,
        max_order=own.max_order, known_delay=np.array(own.delays(samples.nu)),
        last=_compared(task.part, task.part.last))


def growth_of(found: PredictionFit, samples: Samples) -> float:
    """Return how many times e a plant that predictions found grows within a record."""
    return float(np.max(np.linalg.eigvals(found.matrices.A).real)) * samples.length


def as_likely(task: Task, samples: Samples, free: Free, found: PredictionFit,
              clearly: float = 0.0) -> Solution | None:
    """Return the plant that predictions found, if likelier than the best simulation near it."""
    poles = bounded(np.linalg.eigvals(found.matrices.A).astype(complex), free.limit, np.inf)
    thin, near = samples.thinned(SEARCHED), None
    with suppress(np.linalg.LinAlgError):
        start = fit_at(thin, poles, found.found.fit.model.delay[:samples.nu], free)
        top = climb_roughly(thin, start, free)
        near = tried(samples, fit_at(samples, *top.model.nonlinear, free, top), free)
    return None if near is None or clearly and near.unexplained < UNEXPLAINED else likelier(
        task, samples, near, free, found, clearly)


def likelier(task: Task, samples: Samples, best: Tried, free: Free, found: PredictionFit,
             clearly: float = 0.0) -> Solution | None:
    """
    Return the plant that predictions found where they are likelier than a simulation's.

    By at least `clearly` for each sample. If it simulates, that is what it is judged by, else by
    predictions.
    """
    if not _predicts_better(task, samples, best, found, clearly):
        return None
    # Simulated as it is, for the best simulation may err by what the controller makes of gusts.
    plant = None if growth_of(found, samples) > GROWS else _plant_of(task, samples, found, free)
    if plant is not None and plant.simulated.unexplained < DISTURBED:
        return _as_it_simulates(task, samples, found, plant)
    return Solution(
        used(task, len(found.matrices.A), found.found.fit.model.delay[:samples.nu]), task.part,
        found.samples, found.found.fit, found.free, found.found.independent,
        table_of(found.orders, found.found, task.settings),
        (Choice('domain', 'predictions', 'inputs and past outputs together predict these data '
                'better than the best simulation from the inputs alone'),),
        left_out(task, found.orders, len(found.matrices.A)),
        doubt=doubt_of_direct(np.linalg.eigvals(found.matrices.A),
                              found.found.fit.model.delay[:samples.nu], samples, free,
                              task.settings.feedthrough),
        plant=found.matrices, errors_ahead=found.errors,
        rivals=_other_plants(task, samples, found,
                             0.0 if is_stable(found.matrices) else np.inf),
        simulating=None if plant is None else (samples, plant.simulated.fit, plant.free))


def _predicts_better(task: Task, samples: Samples, best: Tried, found: PredictionFit,
                     clearly: float = 0.0) -> bool:
    """Return whether the plant that predictions found predicts better than a simulation's."""
    # Where a simulation explains all but noise, a plant that grows must not predict worse where it
    # has grown: less far ahead, a gain that drifts looks like growth. One that does not grow must
    # not predict worse several samples ahead: one sample ahead, high frequencies may outweigh it.
    # Not beside oscillations that last, which know a set point, or what disturbs, as far ahead.
    fit, part = found.found.fit, task.part
    noisy, _ = with_noise(samples, best.fit, best.errors, part.last)
    numbers = best.parameters + int(np.count_nonzero(noisy.K))
    growth, gain, far = growth_of(found, samples), 0.0, 0.0
    doubted = growth > GROWS and best.unexplained < UNEXPLAINED
    poles = best.fit.model.poles
    asked = growth <= GROWS and not np.any(
        (poles.imag > 0.0) & (np.abs(poles.real) * samples.length < GROWS))
    for place, counts in enumerate(samples.counts):
        if np.min(counts) < 2:      # nothing is ahead of a single sample
            continue
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


def disturbed(task: Task, samples: Samples, best: Tried, found: PredictionFit, free: Free,
              orders: dict[int, Tried]) -> Solution | None:
    """Return the plant that predictions found, as it simulates, if these are likelier."""
    # What disturbs a plant for longer than it remembers is like an input that is not known. Output
    # error then trusts most the frequencies that are disturbed most; predictions trust those that
    # are known best.
    plant = _plant_of(task, samples, found, free)
    if plant is None or not _predicts_better(task, samples, best, found):
        return None
    # If this is the plant, all numbers of the best simulation explain no more than their price.
    n_eff = np.maximum(plant.simulated.independent, 2.0)
    power = [np.maximum(one.power, LEAST ** 2) for one in (plant.simulated, best)]
    if n_eff @ np.log(power[0] / power[1]) > best.parameters * np.log(np.min(n_eff)):
        return None
    solved = _as_it_simulates(task, samples, found, plant, best.fit.model.delay)
    best = climbed(solved.samples, best, free) if solved.samples is not samples else best
    return replace(
        solved, simulating=(solved.samples, best.fit, free),
        smaller=smaller_models(solved.samples, orders, best, replace(free, feedthrough=False)))


class _Plant(NamedTuple):
    """A plant that predictions found, and how it simulates."""

    matrices: Matrices
    simulated: Tried
    free: Free


def _plant_of(task: Task, samples: Samples, found: PredictionFit, free: Free) -> _Plant | None:
    """Return the plant that predictions found, none of its modes growing, or None."""
    fit, nu = found.found.fit, samples.nu
    free = replace(free, feedthrough=False, delays=found.free.delays[:nu])
    m = plant_of(fit, found.samples, task.part.last, free.limit)
    plant = None if m is None else modal_of(m, samples, fit.model.delay[:nu])
    with suppress(np.linalg.LinAlgError):
        if m is not None and plant is not None:
            one, gains = tried(samples, fit_states(samples, plant, free), free), m.K.size
            share = found.found.parameters / (one.parameters + gains)       # 1, if it has climbed
            return _Plant(m, replace(one, parameters=round(share * one.parameters)), free)
    return None


def _as_it_simulates(task: Task, samples: Samples, found: PredictionFit, plant: _Plant,
                     delay: Array | float = 0.0) -> Solution:
    """Return a plant that predictions found, to be judged by its simulation."""
    one, fit = plant.simulated, plant.simulated.fit
    late = float(np.max(np.maximum(fit.model.delay, delay), initial=0.0))
    if late > 0.0:
        samples = task.seen(late)
        one = tried(samples, fit_states(samples, fit.model, plant.free), plant.free)
    domain = 'disturbed' if one.unexplained > UNEXPLAINED else 'simulation'
    return Solution(
        used(task, fit.model.n, fit.model.delay), task.part, samples, one.fit, plant.free,
        one.independent, (),                    # orders were compared by predictions
        (Choice('domain', domain, 'inputs and past outputs together predict these data better '
                'than the inputs alone simulate them: the model was found so, and is judged by '
                'how it simulates'),),
        (*left_out(task, found.orders, fit.model.n), *at_bound(one.fit, plant.free)),
        plant=plant.matrices,
        rivals=_other_plants(task, samples, found, plant.free.limit),
        doubt=doubt_of_direct(*fit.model.nonlinear, samples, plant.free,
                              task.settings.feedthrough),
        predictor=(found.samples, found.found.fit, found.free))


def _other_plants(task: Task, samples: Samples, found: PredictionFit,
                  limit: float) -> tuple[tuple[float, ModalModel], ...]:
    """Return other plants that might be right, of predictors, with their share."""
    # Those of the predictors that it was compared with in the end, and its own with each dead time
    # two deviations off to either side, which their shares make one deviation.
    def plant(fit: Fit) -> ModalModel | None:
        m = plant_of(fit, found.samples, task.part.last, limit)
        return None if m is None else modal_of(m, samples, fit.model.delay[:samples.nu])

    fit, others = found.found.fit, [(one, plant(one.found.fit)) for one in found.others]
    # None is likelier than the choice, which looks further ahead than one sample.
    rivals = list(shares_of([(min(advantage_in_colour(found.found, one.found), 0.0), other)
                           for one, other in others if other is not None]))
    sought = task.own.unknown_delays(samples.nu)
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


def _compared(part: Joint, place: int) -> Compared:
    own = part.parts[place]
    return Compared(place, own.record, corrupt_rows(own))
