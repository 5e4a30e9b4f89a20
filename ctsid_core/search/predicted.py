# SPDX-License-Identifier: Apache-2.0
"""Whether the plant that predictions found is taken, and what it is judged by."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ctsid_core.likelihood.noise_gain import with_noise
from ctsid_core.likelihood.output_error import Free, climb_roughly, fit_at, fit_states
from ctsid_core.likelihood.pole_steps import bounded
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import matrices_of, modal_of
from ctsid_core.linear.types import Array, Matrices
from ctsid_core.model.estimate import Choice
from ctsid_core.search.by_order import SEARCHED, UNEXPLAINED, Tried, price, tried
from ctsid_core.search.by_prediction import (
    AHEAD,
    Compared,
    PredictionFit,
    held_interval,
    in_record,
    information,
    plant_of,
    prediction_errors,
    solve_by_prediction,
)
from ctsid_core.search.problem import Problem, at_bound
from ctsid_core.search.solution import DISTURBED, Solution

GROWS = 1.0           # times e within the record: less does not tell a plant that grows
_GROWN = 2.0          # times e, as far as a plant that grows has to predict


class _Plant(NamedTuple):
    """A plant that predictions found, and how it simulates."""

    matrices: Matrices
    simulated: Tried
    free: Free


def predicted(given: Problem, samples: Samples, free: Free) -> PredictionFit | None:
    """Return the model that predicts best."""
    return solve_by_prediction(
        samples, replace(free, delays=given.own.unknown_delays(samples.nu)),
        order=given.settings.order, max_order=given.settings.max_order,
        known_delay=given.known_delay, last=_compared(given, given.part.last))


def growth(found: PredictionFit, samples: Samples) -> float:
    """Return how many times e a plant that predictions found grows within a record."""
    return float(np.max(np.linalg.eigvals(found.matrices.A).real)) * samples.length


def near(samples: Samples, free: Free, found: PredictionFit) -> Tried | None:
    """
    Return the best simulation near a plant that predictions found.

    Of closed loops many states simulate the record: others are no rivals of a plant that grows.
    """
    poles = bounded(np.linalg.eigvals(found.matrices.A).astype(complex), free.limit, np.inf)
    thin = samples.thinned(SEARCHED)
    with suppress(np.linalg.LinAlgError):
        start = fit_at(thin, poles, found.found.fit.model.delay[:samples.nu], free)
        top = climb_roughly(thin, start, free)
        return tried(samples, fit_at(samples, top.model.poles, top.model.delay, free, top), free)
    return None


def lasts(one: Tried, samples: Samples) -> bool:
    """Return whether a model has modes that last as long as a record."""
    return bool(np.any(np.abs(one.fit.model.poles.real) * samples.length < GROWS))


def likelier(given: Problem, samples: Samples, rival: Tried | None, free: Free,
             found: PredictionFit) -> Solution | None:
    """
    Return the plant that predictions found where they are likelier than a simulation's.

    If it simulates, that is what it is judged by, else by predictions.
    """
    if rival is None or not _predicts_better(given, samples, rival, found):
        return None
    # Simulated as it is, for the best simulation may err by what the controller makes of gusts.
    plant = None if growth(found, samples) > GROWS else _plant_of(given, samples, found, free)
    if plant is not None and plant.simulated.unexplained < DISTURBED:
        return _as_it_simulates(given, samples, found, plant)
    return Solution(
        given.used(len(found.matrices.A), found.found.fit.model.delay[:samples.nu]), given.part,
        found.samples, found.found.fit, found.free, found.found.independent,
        given.table(found.orders, found.found),
        (Choice('domain', 'predictions', "predictions from the outputs' own past are likelier "
                'than those of the best model that simulates'),),
        given.left_out(found.orders, len(found.matrices.A)),
        doubt=given.doubt(None, np.linalg.eigvals(found.matrices.A), samples, free),
        plant=found.matrices, errors_ahead=found.errors, simulating=None if plant is None else (
            samples, plant.simulated.fit, plant.free))


def disturbed(given: Problem, samples: Samples, best: Tried, free: Free,
              found: PredictionFit) -> Solution | None:
    """
    Return the plant that predictions found in open loop, as it simulates, if they are likelier.

    What disturbs a plant for longer than it remembers is like an input that is not known. Output
    error then trusts most the frequencies that are disturbed most; predictions trust those that
    are known best.
    """
    plant = _plant_of(given, samples, found, free)
    if plant is None or not _predicts_better(given, samples, best, found):
        return None
    return _as_it_simulates(given, samples, found, plant, best.fit.model.delay)


def _plant_of(given: Problem, samples: Samples, found: PredictionFit,
              free: Free) -> _Plant | None:
    """Return the plant that predictions found, none of its modes growing, or None."""
    fit, nu = found.found.fit, samples.nu
    free = replace(free, feedthrough=False, delays=found.free.delays[:nu])
    m = plant_of(fit, found.samples, given.part.last, False)
    plant = None if m is None else modal_of(m, samples, fit.model.delay[:nu])
    with suppress(np.linalg.LinAlgError):
        if m is not None and plant is not None:
            return _Plant(m, tried(samples, fit_states(samples, plant, free), free), free)
    return None


def _as_it_simulates(given: Problem, samples: Samples, found: PredictionFit, plant: _Plant,
                     delay: Array | float = 0.0) -> Solution:
    """Return a plant that predictions found, to be judged by its simulation."""
    one, fit = plant.simulated, plant.simulated.fit
    late = float(np.max(np.maximum(fit.model.delay, delay), initial=0.0))
    if late > 0.0:
        samples = given.seen(late)
        one = tried(samples, fit_states(samples, fit.model, plant.free), plant.free)
    domain = 'disturbed' if one.unexplained > UNEXPLAINED else 'simulation'
    return Solution(
        given.used(fit.model.n, fit.model.delay), given.part, samples, one.fit, plant.free,
        one.independent, (),                    # orders were compared by predictions
        (Choice('domain', domain, "predictions from the outputs' own past found the plant, and "
                'are likelier than those of the one that simulates best; judged as others'),),
        (*given.left_out(found.orders, fit.model.n), *at_bound(one, plant.free)),
        plant=plant.matrices, doubt=given.doubt(one, fit.model.poles, samples, plant.free),
        predictor=(found.samples, found.found.fit, found.free))


def _compared(given: Problem, place: int) -> Compared:
    return Compared(place, given.part.parts[place].record, tuple(given.corrupt[place]))


def _predicts_better(given: Problem, samples: Samples, best: Tried,
                     found: PredictionFit) -> bool:
    """
    Return whether the plant that predictions found predicts better than a simulation's.

    Where a simulation explains all but noise, a plant that grows must not predict worse where it
    has grown: less far ahead, a gain that drifts looks like growth. One that does not grow must
    not predict worse several samples ahead: one sample ahead, high frequencies may outweigh it.
    Not beside oscillations that last, which know a set point, or what disturbs, as far ahead.
    """
    fit, last = found.found.fit, given.part.last
    noisy, _ = with_noise(samples, best.fit, best.errors, last)
    numbers = best.parameters + int(np.count_nonzero(noisy.K))
    grown, gain, far = growth(found, samples), 0.0, 0.0
    doubted = grown > GROWS and best.unexplained < UNEXPLAINED
    poles = best.fit.model.poles
    asked = grown <= GROWS and not np.any(
        (poles.imag > 0.0) & (np.abs(poles.real) * samples.length < GROWS))
    for place, counts in enumerate(samples.counts):
        record, compared = samples.records[place], _compared(given, place)
        # Nor do outputs count that no simulation knows the inputs of.
        cut = replace(compared, record=replace(compared.record, start=record.start))
        rival = replace(matrices_of(best.fit.model, samples.size, place), K=noisy.K)
        plant = found.matrices if place == last else in_record(
            found.matrices, fit, found.samples, place)
        simulated = partial(prediction_errors, rival, best.fit.model.delay, cut, simulates=True)
        own = partial(prediction_errors, plant, fit.model.delay[:samples.nu], cut)
        errors = found.errors if place == last and record.start == compared.record.start \
            else own()
        rivals = simulated()
        gain += information(rivals, counts) - information(errors, counts)
        if asked and AHEAD < min(len(errors), len(rivals)):
            far += float(counts @ np.log(np.maximum(errors[AHEAD], 1e-12)
                                         / np.maximum(rivals[AHEAD], 1e-12)))
        if doubted:
            length = record.end - record.start
            ahead = min(_GROWN / grown * samples.length, 0.4 * length)
            horizons = (max(int(ahead / held_interval(found.samples)), 1),)
            ours, theirs = (np.maximum(f(horizons=horizons), 1e-12) for f in (own, simulated))
            # Errors so far ahead are alike for as long.
            far += 2.0 * length / ahead * float(np.sum(np.log(ours / theirs)))
    # Fewer numbers are no reason to give up a simulation.
    return gain >= price(samples) * max(found.found.parameters - numbers, 0) \
        and far <= 0.0
