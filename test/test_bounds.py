# SPDX-License-Identifier: Apache-2.0
"""The bounds against laws, differences, and each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from plants import PLANTS, random_signal
import pytest
from scipy.linalg import expm

from ctsid_core.model.simulation import respond
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Signal
from ctsid_ros.studies.bounds import (
    innovation_bound,
    innovations,
    output_error_bound,
    pole_slopes,
    stationary_gain,
)

T = np.linspace(0.0, 10.0, 501)


def statespace(name: str) -> StateSpace:
    p = PLANTS[name]
    return StateSpace(p.A, p.B, p.C, p.D)


def excitation(channels: int = 1, hold: str = 'linear', seed: int = 0) -> Signal:
    return Signal(T, random_signal(np.random.default_rng(seed), channels, band=3.0).at(T), hold)


def simulated(model: StateSpace, x0, inputs, times) -> np.ndarray:
    x, u = respond(model.A, model.B, model.x_trim, inputs, model.delay, times, x0)
    return x @ model.C.T + u @ model.D.T + model.y_trim


def test_decay_of_one_state_is_the_analytic_case():
    """y = x0 exp(p t) with x0 unknown: information by hand."""
    p, x0, sigma = -0.7, 2.0, 0.1
    model = StateSpace([[p]], [[1.0]], [[1.0]])
    nothing = Signal(T, np.zeros((len(T), 1)), 'zoh')
    bound = output_error_bound(model, np.array([x0]), [nothing], T, np.array([sigma]),
                               feedthrough=False, trim=False)
    slopes = np.stack((x0 * T * np.exp(p * T), np.exp(p * T)))
    by_hand = sigma * np.sqrt(np.linalg.inv(slopes @ slopes.T)[0, 0])
    np.testing.assert_allclose(bound, [by_hand], rtol=1e-9)


def test_long_record_of_noise_through_one_lag():
    """
    White u held over h, through a known-gain-free lag: information per sample in closed form.

    y' = p y + b u. For held white u of variance 1 and h |p| << 1 the spectra are continuous:
    with H = b / (s - p) the derivatives by p and b are b / (s - p)^2 and 1 / (s - p), whose
    mean squares, and product, are h b^2 / (4 |p|^3), h / (2 |p|) and h b / (4 p^2).
    """
    p, b, sigma, h, N = -2.0, 3.0, 0.5, 0.005, 100_000
    t = h * np.arange(N)
    u = np.random.default_rng(0).standard_normal((N, 1))
    model = StateSpace([[p]], [[b]], [[1.0]])
    bound = output_error_bound(model, np.zeros(1), [Signal(t, u, 'zoh')], t, np.array([sigma]),
                               feedthrough=False, trim=False)
    per_sample = h * np.array([[b * b / (4 * 8.0), b / (4 * 4.0)], [b / (4 * 4.0), 1 / (2 * 2.0)]])
    law = sigma * np.sqrt(np.linalg.inv(N * per_sample)[0, 0])
    np.testing.assert_allclose(bound, [law], rtol=0.03)


@pytest.mark.parametrize('hold', ['zoh', 'smooth'])
@pytest.mark.parametrize('name', ['hd52', 'flexible'])
def test_the_bound_is_that_of_derivatives_by_differences(name, hold):
    """By all entries of A, B, C, D, the first state and the trim of the outputs."""
    model, rng = statespace(name), np.random.default_rng(1)
    inputs, x0 = [excitation(model.nu, hold)], rng.standard_normal(model.n)
    times = np.sort(rng.uniform(0.0, 10.0, 80))
    noise = rng.uniform(0.5, 2.0, model.ny)
    parts = [model.A, model.B, model.C, model.D, x0, np.zeros(model.ny)]
    flat = np.concatenate([part.ravel() for part in parts])

    def outputs(flat):
        A, B, C, D, x, level = (part.reshape(old.shape) for part, old in zip(
            np.split(flat, np.cumsum([part.size for part in parts])[:-1]), parts, strict=True))
        return simulated(StateSpace(A, B, C, D, y_trim=level), x, inputs, times)

    rows = []
    for one in np.eye(len(flat)):
        slope = (outputs(flat + 1e-5 * one) - outputs(flat - 1e-5 * one)) / 2e-5
        rows.append((slope / noise).ravel())
    rows = np.array(rows).T
    size = np.linalg.norm(rows, axis=0)
    left, s, right = np.linalg.svd(rows / size, full_matrices=False)
    kept = s > 1e-7 * s[0]
    change = np.zeros((2 * model.n, len(flat)))
    change[:, :model.A.size] = pole_slopes(model)
    spread = (right[kept] / s[kept, np.newaxis] / size) @ change.T
    spread = np.sum(spread ** 2, axis=0)
    by_hand = np.sqrt(spread[:model.n] + spread[model.n:])
    bound = output_error_bound(model, x0, inputs, times, noise)
    np.testing.assert_allclose(bound, by_hand, rtol=1e-4)


def test_scaling_with_noise_and_length():
    """In proportion to the noise; four times the time of the same excitation halves it."""
    model = statespace('hd52')
    one = [excitation()]
    noise = np.array([1.0, 2.0, 0.5, 1.0])
    bound = output_error_bound(model, np.zeros(3), one, T, noise)
    np.testing.assert_allclose(output_error_bound(model, np.zeros(3), one, T, 7.0 * noise),
                               7.0 * bound, rtol=1e-6)
    short, long = (np.arange(0.0, end, 0.02) for end in (40.0, 160.0))
    u = random_signal(np.random.default_rng(3), 1, band=3.0)
    a, b = (output_error_bound(model, np.zeros(3), [Signal(t, u.at(t), 'linear')], t, noise)
            for t in (short, long))
    np.testing.assert_allclose(b / a, 0.5, rtol=0.1)


@pytest.mark.slow
def test_without_process_noise_both_bounds_are_one():
    model, u = statespace('hd52'), excitation()
    noise, x0 = np.array([0.3, 2.0, 0.5, 1.0]), np.array([1.0, -2.0, 0.5])
    y = simulated(model, x0, [u], T)
    plain = output_error_bound(model, x0, [u], T, noise)
    arguments = np.zeros((3, 4)), np.diag(noise ** 2)
    known = innovation_bound(model, *arguments, [(u.values, y, x0)], T[1], 'linear',
                             feedthrough=True, gain_known=True)
    np.testing.assert_allclose(known, plain, rtol=1e-6)
    rng = np.random.default_rng(6)
    runs = [(u.values, y + noise * rng.standard_normal(y.shape), x0) for _ in range(10)]
    found = innovation_bound(model, *arguments, runs, T[1], 'linear', feedthrough=True)
    assert (found > plain * 0.999).all()
    np.testing.assert_allclose(found, plain, rtol=0.1)


def test_derivatives_of_innovations_are_those_of_differences():
    model = replace(statespace('unstable'), y_trim=np.array([0.3]))
    rng = np.random.default_rng(4)
    u, y = rng.standard_normal((60, 1)), rng.standard_normal((60, 1))
    x0, L = rng.standard_normal(2), np.array([[0.4], [1.0]])

    def errors(flat):
        A, B, C, x, gain, level, D = np.split(flat, np.cumsum([4, 2, 2, 2, 2, 1]))
        changed = StateSpace(A.reshape(2, 2), B.reshape(2, 1), C.reshape(1, 2), D.reshape(1, 1),
                             y_trim=level)
        return innovations(changed, gain.reshape(2, 1), u, y, 0.02, 'linear', x,
                           feedthrough=True)

    flat = np.concatenate((model.A.ravel(), model.B.ravel(), model.C.ravel(), x0, L.ravel(),
                           model.y_trim, model.D.ravel()))
    slopes = errors(flat)[1]
    for i in range(len(flat)):
        up, down = flat.copy(), flat.copy()
        up[i] += 1e-5
        down[i] -= 1e-5
        slope = (errors(up)[0] - errors(down)[0]) / 2e-5
        np.testing.assert_allclose(slopes[:, :, i], slope, rtol=1e-5,
                                   atol=1e-6 * np.abs(slope).max() + 1e-12)


@pytest.mark.slow
def test_kalman_gain_gives_white_errors_of_its_covariance():
    """By simulation: the errors of the filter are white, and as large as it says."""
    rng = np.random.default_rng(5)
    model = StateSpace([[0.0, 1.0], [-9.0, -1.2]], [[0.0], [9.0]], [[1.0, 0.0]])
    step, count, noise = 0.02, 20_000, np.array([0.05])
    intensity = np.diag([0.0, 0.5])
    L, S = stationary_gain(model, intensity, noise, step)
    fine = 10
    F = expm(model.A * step / fine)
    x, y = np.zeros(2), np.empty((count, 1))
    kicks = np.sqrt(step / fine * 0.5) * rng.standard_normal((count, fine))
    powers = [np.linalg.matrix_power(F, k) for k in range(fine + 1)]
    pushed = kicks @ np.stack([powers[fine - 1 - k][:, 1] for k in range(fine)])
    for k in range(count):
        y[k] = x[0] + noise * rng.standard_normal(1)
        x = powers[fine] @ x + pushed[k]
    u = np.zeros((count, 1))
    e, _ = innovations(model, L, u, y, step, 'zoh', np.zeros(2), feedthrough=False)
    e = e[100:, 0]
    np.testing.assert_allclose(np.mean(e ** 2), S[0, 0], rtol=0.04)
    lags = [np.mean(e[i:] * e[:-i]) / np.mean(e ** 2) for i in (1, 2, 3, 5, 10)]
    assert np.abs(lags).max() < 4.0 / np.sqrt(len(e))
