# SPDX-License-Identifier: Apache-2.0
"""The gain K after the plant: predictions against those of the Kalman filter that knows all."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from ctsid_core.likelihood.noise_gain import (
    _filtering,
    continuous_gain,
    noise_gain,
    predicted_states,
    states_with_gaps,
    uniform,
)
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.linear.matrix_functions import led_through
from ctsid_core.signals.record import Record, Signal

STEP = 0.02


def disturbed(poles, seed, noise=0.02):
    """What disturbances of a plant of one output leave after its simulation, and its filter."""
    rng, n = np.random.default_rng(seed), len(poles)
    A = np.diag(-np.array(poles)) + np.eye(n, k=1)
    C, F = np.eye(1, n), expm(A * STEP)
    Q = 1e-4 * np.diag(np.arange(n) + 1.0)
    x, v = np.zeros(n), np.empty((3000, 1))
    for k in range(3000):
        v[k] = C @ x + noise * rng.standard_normal()
        x = F @ x + np.sqrt(np.diag(Q)) * rng.standard_normal(n)
    P = solve_discrete_are(F.T, C.T, Q, [[noise ** 2]])
    return A, C, v, float((C @ P @ C.T)[0, 0] + noise ** 2), \
        F @ P @ C.T / (C @ P @ C.T + noise ** 2)


@pytest.mark.parametrize('poles', [(0.5,), (1e-7,), (1e-7, 2.0), (1e-7, 1e-6, 3.0)])
@pytest.mark.parametrize('seed', range(3))
def test_innovations_are_as_small_as_those_of_the_kalman_filter(poles, seed):
    """Of plants that integrate, too: from no gain at all nothing leads to theirs."""
    A, C, v, power, best = disturbed(poles, seed)
    K, R = noise_gain(A, C, [v], STEP)
    print(f'\ngain {K.ravel()}, of the filter {best.ravel() / STEP}, power {R[0, 0] / power:.3f}')
    assert R[0, 0] == pytest.approx(power, rel=0.08)       # of 3000 samples: 2.6 %
    assert np.linalg.eigvals(A - K @ C).real.max() < 0.0


def test_white_errors_have_no_gain():
    v = np.random.default_rng(0).standard_normal((3000, 1))
    for pole in (0.5, 1e-7):
        K, _ = noise_gain(np.array([[-pole]]), np.eye(1), [v], STEP)
        assert not K.any()


def test_the_gain_in_continuous_time_is_that_of_the_samples():
    A, C, _, _, _ = disturbed((1.0, 4.0), 0)
    update = np.array([[0.2], [0.1]])
    K = continuous_gain(A, C, update, STEP)
    times = (np.arange(500) + 0.5) * STEP / 500
    mean = STEP * np.mean([expm((A - K @ C) * t) for t in times], axis=0)
    np.testing.assert_allclose(mean @ K, update, rtol=1e-5)


def test_filters_are_those_of_the_riccati_equation_whatever_the_units():
    """A state in large units does not hide a slow one in small ones."""
    F, R = np.diag([0.5, 0.999]), np.eye(1)
    for C in ([[1.0, 1.0]], [[1e-6, 1.0]], [[1.0, 1e-6]]):
        C = np.array(C)
        moved = np.diag(1.0 / np.linalg.norm(C, axis=0) ** 2)
        shares = np.array([1e-5, 1e-2, 1.0])[:, np.newaxis, np.newaxis]
        for P, share in zip(_filtering(F, C, shares * moved, R), shares, strict=True):
            np.testing.assert_allclose(P, solve_discrete_are(F.T, C.T, share * moved, R),
                                       rtol=1e-5)


def test_messages_that_come_in_bursts_are_not_filled_up():
    """60 in 0.3 ms each second were read at 12 million instants: 9 GB of memory."""
    t = (np.arange(60.0)[:, np.newaxis] + 5e-6 * np.arange(60.0)).ravel()
    y = np.random.default_rng(0).standard_normal(len(t))
    samples = samples_of([Record.from_arrays(t, y, t, y)], [[None]])
    step, (errors,) = uniform(samples, (((y[:, np.newaxis],),)))
    assert len(errors) <= 10 * len(t) + 1
    assert step * len(errors) == pytest.approx(t[-1], rel=1e-3)


@pytest.mark.parametrize('late', [False, True])
def test_a_sample_that_is_read_twice_tells_nothing_of_the_next(late):
    """Lost in bursts, or stamped on receipt: white errors had a gain, and predictions were bad."""
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(3000)
    t = np.sort(t + rng.uniform(0.0, 0.02, len(t))) if late else \
        t[np.repeat(rng.random(300) > 0.3, 10)]
    y = rng.standard_normal(len(t))
    _, (errors,) = uniform(samples_of([Record.from_arrays(t, y, t, y)], [[None]]),
                           ((y[:, np.newaxis],),))
    assert abs(np.corrcoef(errors[1:, 0], errors[:-1, 0])[0, 1]) < 0.05


def test_a_sample_half_a_step_from_two_instants_is_read_once():
    """Outputs at 10 Hz, one half an interval before the other, a third of its samples lost."""
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(3000)
    kept = rng.random(3000) > 0.3
    kept[[0, -1]] = True
    y = rng.standard_normal((np.count_nonzero(kept), 1))
    record = Record((Signal(t, t[:, np.newaxis], 'zoh'),), (
        Signal(t[kept], y), Signal(t + 0.05, t[:, np.newaxis])), 0.0, t[-1] + 0.05)
    _, (errors,) = uniform(samples_of([record], [[None] * 2]), ((y, np.zeros((3000, 1))),))
    seen = errors[errors[:, 0] != 0.0, 0]
    assert len(seen) >= np.count_nonzero(kept) - 2
    assert len(np.unique(seen)) == len(seen)


@pytest.mark.parametrize('count', [0, 40])
def test_a_filter_goes_on_where_samples_are_missing(count):
    rng = np.random.default_rng(5)
    F = np.diag([0.9, 0.8, 1.02]) + 0.05 * rng.standard_normal((3, 3))
    C, v = rng.standard_normal((2, 3)), rng.standard_normal((317, 2))
    P = solve_discrete_are(F.T, C.T, np.eye(3), np.eye(2))
    L = F @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(2))
    everywhere = states_with_gaps(F, L, C, v, np.ones(317, dtype=bool), count)
    np.testing.assert_allclose(everywhere, predicted_states(F, L, C, v, count), atol=1e-12)
    known = rng.uniform(size=317) > 0.4
    known[100:160] = False
    states = states_with_gaps(F, L, C, v, known, count)
    x = states[0]
    for k in range(317):
        np.testing.assert_allclose(states[k], x, rtol=1e-9, atol=1e-9)
        x = F @ x + L @ (v[k] - C @ x) * known[k]

    def errors(start):
        x, found = start, []
        for k in range(count):
            found.append((v[k] - C @ x) * known[k])
            x = F @ x + L @ (v[k] - C @ x) * known[k]
        return np.concatenate(found) if found else np.zeros(1)

    least = np.sum(errors(states[0]) ** 2)                     # the first one is best for these
    assert all(np.sum(errors(states[0] + 1e-3 * d) ** 2) >= least
               for d in (*np.eye(3), *-np.eye(3)))


def test_blocks_lead_through_as_one_step_after_another():
    rng = np.random.default_rng(6)
    for count in (1, 2, 3, 10, 101):
        moves = 0.6 * rng.standard_normal((count, 3, 3))
        pushes = rng.standard_normal((count, 3, 2))
        found = led_through(moves, pushes, np.ones((3, 2)))
        x = np.ones((3, 2))
        for k in range(count):
            np.testing.assert_allclose(found[k], x, rtol=1e-8, atol=1e-8)
            x = moves[k] @ x + pushes[k]
