# SPDX-License-Identifier: Apache-2.0
"""The decisions: which order, which noise model, and the model at its likelihood's maximum."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_continuous_are

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.likelihood.prediction_errors import (
    innovation_cost,
    output_error_cost,
    simulate_lines,
)
from ctsid_core.likelihood.process_noise import with_process_noise
from ctsid_core.likelihood.refine import affordable, growth, refine_innovation
from ctsid_core.likelihood.simulation_of_poles import OutputErrorFit
from ctsid_core.likelihood.window_ends import ends_cost_of_simulation, line_distance
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import OrderTried
from ctsid_core.search.order import OrderTrial, Search, by_innovation, by_simulation
from ctsid_core.search.starts import Pair
from ctsid_core.settings import Settings

_CONTENDERS = 3       # orders whose innovation forms are refined before they are compared
_STEPS = 6            # of that refinement: enough to compare


@dataclass(frozen=True, eq=False)
class OrderChoice:
    """
    The order that was chosen, and why.

    Parameters
    ----------
    trial : OrderTrial
    tried : tuple of OrderTried
    noisy : Matrices or None
        The innovation form that decided, near its maximum.
    """

    trial: OrderTrial
    tried: tuple[OrderTried, ...]
    noisy: Matrices | None


def choose_order(search: Search, trials: list[OrderTrial]) -> OrderChoice:
    """
    Choose among the orders that were tried.

    Parameters
    ----------
    search : Search
    trials : list of OrderTrial
        Not empty.

    Notes
    -----
    Simulations come at their maximum already. The most promising innovation forms are taken to
    theirs, and taken if they are likelier than any simulation and accepted
    (`Pair.accepts_process_noise`).
    """
    chosen, least = min(trials, key=by_simulation), min(t.simulation for t in trials)
    criterion, noisy = {t.order: t.simulation for t in trials}, None
    for trial in sorted(trials, key=by_innovation)[:_CONTENDERS]:
        found = _innovation_form(search, trial, least)
        if found is None:
            continue
        value, model = found
        if value < least and trial.pair.accepts_process_noise(
                model, trial.simulation - value, trial.refined):
            chosen, least, noisy = trial, value, model
            criterion[trial.order] = value
    return OrderChoice(chosen, tuple(OrderTried(
        t.order, criterion[t.order] - least, 100.0 * (1.0 - float(np.sqrt(t.residual))))
        for t in trials), noisy)


def _innovation_form(search: Search, trial: OrderTrial,
                     least: float) -> tuple[float, Matrices] | None:
    """Return the criterion and the model of a trial with process noise; None if it has none."""
    if not (search.settings.refine and affordable(search.projection, trial.order)):
        return trial.innovation, trial.pair.predicting.matrices
    if trial.start is None:
        return None
    price = search.price(trial.order)
    model, cost = refine_innovation(search.projection, trial.start, search.settings.feedthrough,
                                    limit=trial.pair.limit, steps=_STEPS, rival=least - price)
    return cost + price, model


def model_criterion(search: Search, model: Matrices, process_noise: bool) -> float:
    """Return Schwarz's criterion of a model at its maximum, with or without process noise."""
    n, ny = len(model.A), len(model.C)
    if process_noise:
        return innovation_cost(search.projection, model) + search.price(n)
    still = replace(model, K=np.zeros_like(model.K))
    poles = np.linalg.eigvals(model.A).astype(complex)
    return (output_error_cost(search.projection, still) + search.price(n)
            - n * ny * search.charge + ends_cost_of_simulation(search.projection, poles))


def most_likely(projection: Projection, pair: Pair, settings: Settings,
                noisy: Matrices | None = None) -> tuple[Matrices, bool]:
    """
    Return the model at the maximum of the likelihood, and whether it has process noise.

    Parameters
    ----------
    projection : Projection
    pair : Pair
        The subspace models to start from.
    settings : Settings
        With `refine` false the subspace model itself is returned.
    noisy : Matrices, optional
        An innovation form near its maximum, if one is known.
    """
    if not (settings.refine and affordable(projection, len(pair.simulating.poles))):
        return pair.best.matrices, pair.process_noise
    feed, limit = settings.feedthrough, pair.limit
    model, cost, top = most_likely_simulation(projection, pair, settings)
    price = model.K.size * np.log(2.0 * len(projection.s) * len(projection.y))
    start = noisy or with_process_noise(projection, model, feed)
    if start is None:
        return replace(model, K=measurement_noise_gain(projection, model)), False
    noisy, noisy_cost = refine_innovation(projection, start, feed, limit=limit,
                                          rival=cost - price)
    other = refine_innovation(projection, pair.predicting.matrices, feed, limit=limit,
                              rival=min(noisy_cost, cost - price))
    noisy, noisy_cost = min((noisy, noisy_cost), other, key=lambda found: found[1])
    gain = cost - noisy_cost - price
    if pair.accepts_process_noise(noisy, gain, top):
        return noisy, True
    shifted = measurement_noise_gain(projection, model, 1.5 * line_distance(projection))
    damped = replace(model, K=shifted)
    held, held_cost = refine_innovation(projection, damped, feed, plant=False, steps=8,
                                        rival=cost - price)
    if held_cost + price < cost:
        return held, False
    return replace(model, K=measurement_noise_gain(projection, model)), False


def most_likely_simulation(projection: Projection, pair: Pair,
                           settings: Settings) -> tuple[Matrices, float, OutputErrorFit]:
    """
    Return the model at the maximum of the output-error likelihood, and what it costs.

    Parameters
    ----------
    projection : Projection
    pair : Pair
        The subspace models to start from.
    settings : Settings
        With `refine` false the subspace model itself is returned, with an infinite cost.

    Returns
    -------
    model : Matrices
    cost : float
        -2 log likelihood.
    free : OutputErrorFit
        The best simulation with free residues.
    """
    first = pair.simulating
    if not (settings.refine and affordable(projection, len(first.poles))):
        return pair.best.matrices, np.inf, first.simulated
    return (*pair.simulation, pair.refined)


def measurement_noise_gain(projection: Projection, m: Matrices, shift: float = 0.0) -> Array:
    """
    Return the stationary Kalman gain where there is no process noise.

    Zero for a stable plant. An unstable one needs a predictor: the gain that mirrors its
    unstable poles, the limit of small process noise. With a shift [rad/s], the same of the plant
    whose poles lie that much further to the right: all poles of the predictor decay faster.
    """
    if growth(m) < -shift:
        return np.zeros_like(m.K)
    A = m.A + shift * np.eye(len(m.A))
    error = as_real(projection.y - simulate_lines(projection, m))
    R = np.diag(np.mean(error ** 2, axis=1) + 1e-300)
    state = np.linalg.norm(m.A) * np.eye(len(m.A)) * 1e-9 * np.trace(R) / np.trace(m.C @ m.C.T)
    try:
        P = solve_continuous_are(A.T, m.C.T, state, R)
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros_like(m.K)
    gain: Array = np.linalg.solve(R, m.C @ P).T
    return gain
