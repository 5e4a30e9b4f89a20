# SPDX-License-Identifier: Apache-2.0
"""Integrators whose input has a mean: a ramp, an offset and a free response that are alike."""

from dataclasses import replace

from marks import slow
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from ctsid_core import Grade, Record, Settings, identify
from ctsid_core.likelihood.output_error import Free, _slopes, climb, fit_at, steps_around
from ctsid_core.likelihood.samples import samples_of

LAG, RATE, STEP = 2.5, 4.0, 0.002


def travelled(seed, mean, several=1, duration=60.0):
    """A car's speed: throttle through a lag of 0.4 s, integrated; 1 % of noise."""
    rng = np.random.default_rng(seed)
    count = int(duration / STEP)
    t = np.arange(count) * STEP
    u = mean + 0.3 * rng.choice([-1.0, 1.0], (count // 250 + 1, several))[np.arange(count) // 250]
    kept, pushed, speed = np.exp(-LAG * STEP), np.zeros(several), np.zeros(several)
    y = np.empty((count, several))
    for k in range(count):
        y[k] = speed
        lag = (1.0 - kept) * (pushed - u[k])                    # over all of a step
        speed = speed + RATE * (u[k] * STEP + lag / LAG)
        pushed = u[k] + (pushed - u[k]) * kept
    y, u = y[::25] @ mixing(several), u[::25]
    return Record.from_arrays(t[::25], u, t[::25], y + 0.03 * rng.standard_normal(y.shape),
                              input_hold='zoh')


def mixing(several):
    return np.eye(several) + 0.3 * np.eye(several, k=1)


@pytest.mark.parametrize('start', [-1e-6, *slow(-1e-2, -1e-3, -1e-4)])
@pytest.mark.parametrize('several', [2, *slow(1)])
def test_a_climb_does_not_stall_beside_zero(several, start):
    samples = samples_of([travelled(5, 0.1, several)], [[None]])
    free = Free(False, True, (False,) * several, 0.1, 1.0, 100.0)
    poles = np.repeat([start, -2.0], several)
    found = climb(samples, fit_at(samples, poles, np.zeros(several), free), free)
    best = climb(samples, fit_at(samples, np.repeat([-1e-7, -LAG], several), np.zeros(several),
                                 free), free)
    assert found.cost < best.cost + 1.0


@pytest.mark.parametrize(('mean', 'seed'), [
    (0.1, 12), *slow((0.0, 11), (0.1, 13), (1.0, 14))])
@pytest.mark.parametrize('several', [1, *slow(2)])
def test_an_integrator_is_one_whatever_the_mean_of_its_input(several, mean, seed):
    estimate = identify(travelled(seed, mean, several), Settings(feedthrough=False))
    model = estimate.model
    assert model.n == 2 * several
    poles = np.sort(model.poles.real)[::-1]
    assert np.max(np.abs(poles[:several])) < 1e-3            # 6 % of the record's
    np.testing.assert_allclose(poles[several:], -LAG, rtol=0.05)
    response = model.frequency_response(np.array([0.1]))[0]
    np.testing.assert_allclose(response, RATE * LAG / (0.1j * (0.1j + LAG)) * mixing(several).T,
                               atol=0.02 * RATE / 0.1)


def test_what_would_leave_its_bounds_is_held_and_the_others_move():
    """A pole that would grow if it could: the other one, and the dead time, climb all the same."""
    samples = samples_of([travelled(5, 0.1)], [[None]])
    free = Free(False, True, (True,), 0.1, -1e-5, 100.0)
    start = fit_at(samples, np.array([-1e-5, -4.0]), np.zeros(1), free)
    slopes = _slopes(samples, start, free, steps_around(samples, start.model))
    assert (slopes.scale == np.inf).tolist() == [False, True, False]
    step = slopes.step(1e-9) / slopes.scale
    assert step[1] == 0.0
    assert step[0] != 0.0
    assert step[2] != 0.0
    found = climb(samples, start, free)
    assert np.max(found.model.poles.real) == -1e-5
    assert np.min(found.model.poles.real) == pytest.approx(-LAG, rel=0.05)


def swept(seed, noise):
    """A car's speed: throttle about 0.5, swept, through a lag of 0.7 s, integrated over 30 s."""
    rng, h, lag = np.random.default_rng(seed), 0.02, 0.7
    t = h * np.arange(1500)
    u = 0.5 + 0.3 * np.sin(2.0 * np.pi * h * np.cumsum(np.linspace(0.05, 1.5, len(t))))
    joined = expm(h * np.array([[-1.0 / lag, 0.0, 1.0 / lag], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    x, y = np.array([u[0], 0.0]), np.empty(len(t))
    for k in range(len(t)):
        y[k] = x[1]
        x = joined[:2, :2] @ x + joined[:2, 2] * u[k]
    y += noise * np.std(y) * rng.standard_normal(len(t))
    return Record.from_arrays(t, u, t, y, input_hold='zoh')


@pytest.mark.parametrize('seed', [13, *slow(1, 9, 33)])
def test_a_part_held_out_goes_on_with_the_ramp_of_the_mean_of_the_input(seed):
    """At 0, where predictions put the pole, no initial state and trim made one: -3 to -7 %."""
    estimate = identify(swept(seed, 0.01), Settings(feedthrough=False))
    assert estimate.verdict.grade is Grade.GOOD
    np.testing.assert_allclose(estimate.held_out_fit, 99.0, atol=0.2)


def test_an_integrator_in_the_wind_is_judged_by_how_it_simulates():
    """With its pole at 0 it simulated nothing, and was judged by its predictions, and WEAK."""
    rng, given = np.random.default_rng(918), swept(18, 0.005)
    y = given.outputs[0]
    wind = lfilter([1.0], [1.0, -0.98], rng.standard_normal(len(y.values)))
    wind *= 0.5 * np.std(np.diff(y.values[::50], axis=0)) / np.std(wind)
    found = identify(replace(given, outputs=(replace(y, values=y.values + wind[:, np.newaxis]),)),
                     Settings(feedthrough=False))
    assert not [c.value for c in found.choices if c.name == 'domain']      # but a simulation
    assert -1e-5 < np.max((found.model or found.rejected_model).poles.real) < 0.0


@pytest.mark.parametrize('seed', [2, *slow(8, 12, 18)])
def test_one_integrator_is_not_two(seed):
    """A search through dead times came upon a third state first, and a pair was not halved."""
    model = identify(swept(seed, 0.002), Settings(feedthrough=False)).model
    np.testing.assert_allclose(np.sort(model.poles.real), [-1.0 / 0.7, 0.0], rtol=0.15, atol=1e-3)
