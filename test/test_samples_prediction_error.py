# SPDX-License-Identifier: Apache-2.0
"""Predictions of raw samples: against another recursion, differences, and the truth."""

from __future__ import annotations

from dataclasses import replace

from marks import slow
import numpy as np
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.likelihood.samples_prediction_error import (
    Predictor,
    continuous_gain,
    prediction_cost,
    predictor,
    refine_in_time,
    settled,
    slopes,
    uniform_samples,
)
from ctsid_core.linear.matrix_functions import modes
from ctsid_core.model.mode_sensitivity import mode_responses, output_sensitivities, rest_state
from ctsid_core.model.simulation import respond
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Signal
from ctsid_ros.studies.bounds import innovations, stationary_gain
from ctsid_ros.studies.experiments import flown

STEP = 0.002


def begun(run) -> Predictor:
    """Return the true predictor, started at the true state."""
    model = run.model
    gain = stationary_gain(model, model.B @ model.B.T, run.noise, STEP)[0]
    own = modes(model.A)
    at = mode_responses(own.values, [run.u], model.delay, run.y.time)
    force = own.left @ np.column_stack((model.B, model.x_trim))
    first = (own.right @ (at.responses[0] * force).sum(axis=1)).real
    return Predictor(model, gain, run.x0 - first)


@pytest.fixture(scope='module')
def run():
    return flown(0, 1.0, duration=3.0)


def test_errors_are_those_of_the_kalman_filter_sample_by_sample(run):
    p = begun(run)
    e, _ = slopes(uniform_samples(run.record), p)
    other, _ = innovations(run.model, p.L, run.u.values, run.y.values, STEP, 'zoh', run.x0,
                           feedthrough=False)
    np.testing.assert_allclose(e, other, atol=1e-12)


def test_derivatives_are_those_of_differences(run):
    samples, p = uniform_samples(run.record), begun(run)
    columns = slopes(samples, p)[1]
    n, own = 2, modes(p.model.A)

    def errors(i, size):
        parts = [np.zeros(n), np.zeros((n, 2)), np.zeros((1, n)), np.zeros((1, 2)),
                 np.zeros((n, 1)), np.zeros(n)]
        flat = np.zeros(columns.shape[2])
        flat[i] = size
        poles, B, C, D, L, start = (x.reshape(old.shape) for x, old in zip(
            np.split(flat, np.cumsum([x.size for x in parts])[:-1]), parts, strict=True))
        m = p.model
        A = ((own.right * (own.values + poles)) @ own.left).real
        moved = StateSpace(A, m.B + B[:, :1], m.C + C, m.D + D[:, :1], x_trim=m.x_trim + B[:, 1],
                           y_trim=m.y_trim + D[:, 1])
        return slopes(samples, Predictor(moved, p.L + L, p.start + start))[0]

    for i in range(columns.shape[2]):
        slope = (errors(i, -1e-5) - errors(i, 1e-5)) / 2e-5
        np.testing.assert_allclose(columns[:, :, i], slope, atol=1e-5 * np.abs(slope).max())


def test_growing_modes_are_followed_backwards():
    """The bounded response and its slopes, where e^(A t) has lost all digits."""
    t = np.linspace(0.0, 40.0, 801)
    rng = np.random.default_rng(1)
    u = Signal(t, rng.standard_normal((len(t), 1)), 'linear')
    model = StateSpace(np.diag([2.0, -3.0]), [[1.0], [1.0]], [[1.0, 0.5]])
    y, columns, _ = output_sensitivities(model, np.zeros(2), [u], t)
    x, _ = respond(model.A, model.B, model.x_trim, [u], model.delay, t, None)
    np.testing.assert_allclose(y, x @ model.C.T, atol=1e-12)
    order = np.argsort(-modes(model.A).values.real)
    for i, pole in enumerate(order):
        moves = [model.A + size * np.diag([i == 0, i == 1]) for size in (1e-5, -1e-5)]
        up, down = (respond(A, model.B, model.x_trim, [u], model.delay, t, None)[0] @ model.C.T
                    for A in moves)
        np.testing.assert_allclose(columns[:, :, pole], (up - down) / 2e-5, atol=1e-7)
    # Rounding of the first state grows with e^(2 t): only a short window tells what it was.
    short = t[:101]
    x = respond(model.A, model.B, model.x_trim, [u], model.delay, short, None)[0]
    np.testing.assert_allclose(rest_state(model, x[0], [u], short), 0.0, atol=1e-10)


def test_gain_from_continuous_to_sampled_and_back(run):
    p = begun(run)
    K = continuous_gain(p.model, p.L, STEP)
    np.testing.assert_allclose(predictor(replace(p.model, K=K), STEP).L, p.L, rtol=1e-9)


def test_refinement_climbs_to_one_maximum(run):
    """From the truth and from a poor start the same poles; better than the truth by chi-square."""
    samples, p = uniform_samples(run.record), begun(run)
    best, cost = refine_in_time(samples, p, feedthrough=False, trim=True, steps=30)
    gain = prediction_cost(samples, p) - cost
    assert 0.0 < gain < 40.0
    moved = replace(p.model, A=p.model.A + [[0.0, 0.0], [1.5, -1.0]], B=1.2 * p.model.B)
    start, before = settled(samples, Predictor(moved, 0.8 * p.L, np.zeros(2)))
    other, same = refine_in_time(samples, start, feedthrough=False, trim=True, steps=30)
    assert before > same
    np.testing.assert_allclose(same, cost, atol=0.1)
    np.testing.assert_allclose(np.sort(other.model.poles.real), np.sort(best.model.poles.real),
                               atol=0.02)


def test_uneven_or_separate_stamps_are_left_alone():
    t = np.arange(0.0, 2.0, 0.01)
    u, y = np.sin(t), np.column_stack((t, t ** 2))
    assert uniform_samples(Record.from_arrays(t, u, t, y)) is not None
    uneven = t + np.where(np.arange(len(t)) % 2, 0.002, 0.0)
    assert uniform_samples(Record.from_arrays(t, u, uneven, y)) is None


@pytest.mark.parametrize(('q', 'bound', 'seeds'), [
    (0.2, (0.068, 0.082), 1), *slow((0.2, (0.068, 0.082), 40), (1.0, (0.32, 0.38), 40))])
def test_unstable_plant_with_process_noise(q, bound, seeds):
    """Nothing set but that there is no feedthrough; see docs/accuracy.md for the bound."""
    errors = []
    for seed in range(seeds):
        estimate = identify(flown(seed, q).record, Settings(feedthrough=False))
        assert estimate.ok, (seed, estimate.notes)
        assert estimate.model.n == 2, seed
        errors.append(np.sort(estimate.model.poles.real)[::-1] - [2.0, -3.0])
    e, bound = np.array(errors), np.array(bound)
    # Chance: the mean square of n normal errors is chi-square with n degrees of freedom.
    assert (np.sqrt(np.mean(e ** 2, axis=0)) < bound * (1.0 + 2.0 / np.sqrt(seeds))).all()
    if seeds > 10:
        assert (np.abs(e.mean(axis=0)) < e.std(axis=0)).all()
