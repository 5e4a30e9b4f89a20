# SPDX-License-Identifier: Apache-2.0
"""Estimates from the raw samples: exact responses, efficiency, and when they are made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from plants import PLANTS, asynchronous, running
import pytest
from scipy.integrate import solve_ivp

from ctsid_core import Record, Settings, Signal, Status, identify
from ctsid_core.likelihood.samples_output_error import poles_in_time, refine_in_time
from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.matrices import Matrices
from ctsid_core.model.mode_responses import derivatives, outputs, responses, stamps_of
from ctsid_core.model.simulation import respond
from ctsid_core.search.samples_model import in_bursts
from ctsid_core.search.samples_modes import search_in_time

TRUTH = np.array([-2.0, -4.0, -0.3 + 6.3j, -0.3 - 6.3j])
A = np.zeros((4, 4))
A[:2, :2], A[2:, 2:] = [[-2.0, 1.0], [0.0, -4.0]], [[-0.3, 6.3], [-6.3, -0.3]]
B = np.array([[0.5], [1.0], [1.0], [0.5]])
C = np.array([[1.0, 4.0, 0.3, 0.1], [2.0, 1.0, -0.2, 0.3]])


def in_pieces(rng, length: float = 10.0) -> np.ndarray:
    """Return stamps in bursts of 3 to 8 at 60 Hz, 20 Hz on average, with two gaps of 1 s."""
    stamps, t = [], rng.uniform(0.0, 0.1)
    while t < length:
        count = rng.integers(3, 9)
        stamps += list(t + (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / 60.0)
        t += count / 20.0 * rng.uniform(0.7, 1.3)
    t = np.array(stamps)
    for gap in (rng.uniform(1.5, 3.5), rng.uniform(5.5, 7.5)):
        t = t[(t < gap) | (t > gap + 1.0)]
    return np.sort(t[(t > 0.0) & (t < length)])


def bursty(seed: int, snr: float = 20.0) -> Record:
    """Input held at 100 Hz with jitter from 3 s before the window on, outputs in bursts."""
    rng = np.random.default_rng(seed)
    t_u = (np.arange(1300) + rng.uniform(-0.2, 0.2, 1300)) / 100.0 - 3.0
    u = np.convolve(rng.standard_normal(1312), np.hanning(13), 'valid')
    u /= u.std()
    t_y = in_pieces(rng)
    held = Signal(t_u, u[:, np.newaxis], 'zoh')
    x = respond(A, B, np.zeros(4), (held,), (0.0,), np.append(t_u[0], t_y), np.zeros(4))[0][1:]
    y = x @ C.T
    y = y + y.std(axis=0) * 10.0 ** (-snr / 20.0) * rng.standard_normal(y.shape)
    kept = t_u > -0.05
    return Record.from_arrays(t_u[kept], u[kept], t_y, y, input_hold='zoh')


def paired(poles) -> np.ndarray:
    """Return the found poles in the order of the true ones."""
    return np.array([poles[np.argmin(np.abs(poles - p))] for p in TRUTH])


def own_stamps(hold: str) -> Record:
    rng = np.random.default_rng(3)
    t_1, t_2 = np.sort(rng.uniform(-1.0, 10.0, 300)), np.arange(-1.0, 10.5, 0.05)
    inputs = (Signal(t_1, rng.standard_normal((300, 1)), hold),
              Signal(t_2, rng.standard_normal((len(t_2), 1)), 'zoh'))
    stamps = np.sort(rng.uniform(0.0, 10.0, 40)), np.sort(rng.uniform(0.0, 10.0, 50))
    return Record(inputs, tuple(Signal(t, np.zeros((len(t), 1))) for t in stamps), 0.0, 10.0)


def some_model(A_here) -> Matrices:
    rng = np.random.default_rng(4)
    return Matrices(A=A_here, B=rng.standard_normal((4, 2)), C=C, D=rng.standard_normal((2, 2)),
                    K=np.zeros((4, 2)), tail=rng.standard_normal((4, 1)),
                    x_trim=rng.standard_normal((4, 1)), y_trim=rng.standard_normal((2, 1)))


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
@pytest.mark.parametrize('poles', ['distinct', 'double'])
def test_responses_and_their_derivatives_are_exact(hold, poles):
    """At own stamps of both outputs, with dead times, and where two modes share a pole."""
    turn = np.random.default_rng(5).standard_normal((4, 4))
    m = some_model(turn @ A @ np.linalg.inv(turn) if poles == 'distinct'
                   else np.diag([-1.0, -1.0, -2.0, -2.0]))
    record, delay = own_stamps(hold), (0.05, 0.13)
    stamps = stamps_of(record, delay, True)

    def simulated(q: Matrices) -> np.ndarray:
        x, u = respond(q.A, q.B, q.x_trim[:, 0], record.inputs, delay, stamps.times, q.tail[:, 0])
        y = (x @ q.C.T + u @ q.D.T + q.y_trim[:, 0]).T
        return np.concatenate([y[channels][0][rows] for channels, rows in stamps.streams])

    found = responses(stamps, m)
    y = outputs(stamps, m, found)
    own = np.concatenate([y[channels][0][rows] for channels, rows in stamps.streams])
    np.testing.assert_allclose(own, simulated(m), rtol=0, atol=1e-9 * np.abs(own).max())
    slopes = derivatives(stamps, m, found, np.ones(2), True)
    entries = FreeEntries.of(m, True)
    for k, row in enumerate(slopes):
        step = 1e-6 * (np.arange(len(slopes)) == k)
        wanted = (simulated(entries.moved(m, step)) - simulated(entries.moved(m, -step))) / 2e-6
        np.testing.assert_allclose(row, wanted, rtol=0, atol=1e-6 * (1 + np.abs(row).max()))


def test_a_simulation_agrees_with_a_solver_of_others():
    """An independent code, restarted where the held input jumps."""
    rng = np.random.default_rng(6)
    t_u, t_y = np.sort(rng.uniform(-0.2, 5.0, 40)), np.sort(rng.uniform(0.0, 5.0, 30))
    u, x = rng.standard_normal(40), rng.standard_normal(4)
    record = Record((Signal(t_u, u[:, np.newaxis], 'zoh'),),
                    (Signal(t_y, np.zeros((30, 2))),), 0.0, 5.0)
    m = replace(some_model(A), B=B, D=np.zeros((2, 1)), tail=x[:, np.newaxis])
    stamps = stamps_of(record, (0.0,), True)
    knots, wanted = np.union1d(t_y, t_u[(t_u > t_y[0]) & (t_u < t_y[-1])]), []
    for begin, end in zip(knots, np.append(knots[1:], knots[-1] + 1.0), strict=True):
        if begin in t_y:
            wanted.append(C @ x + m.y_trim[:, 0])
        value = u[np.searchsorted(t_u, begin, side='right') - 1]
        x = solve_ivp(lambda _, z: A @ z + B[:, 0] * value + m.x_trim[:, 0],  # noqa: B023
                      (begin, end), x, rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(outputs(stamps, m, responses(stamps, m)).T, wanted, atol=1e-8)


def test_noise_free_samples_give_the_plant_to_rounding():
    record = bursty(0, snr=240.0)
    start = some_model(A * 1.1)
    start = replace(start, B=B, D=np.zeros((2, 1)))
    found = refine_in_time(record, start, (0.0,), feedthrough=True, steps=40)
    np.testing.assert_allclose(paired(poles_in_time(found)[0]), TRUTH, rtol=1e-6)


def check_bursty(seeds: int, low: float, high: float) -> None:
    scores = []
    for seed in range(seeds):
        estimate = identify(bursty(seed), Settings(order=4))
        assert estimate.ok, (seed, estimate.status)
        assert [c.value for c in estimate.choices if c.name == 'domain'] == ['time']
        poles = estimate.model.poles
        deviation = np.array([estimate.pole_std[np.argmin(np.abs(poles - p))] for p in TRUTH])
        scores.append(np.abs(paired(poles) - TRUTH) / deviation)
    # Standard deviations are the Cramer-Rao bound at the found model.
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    print(rms)
    assert (rms < high).all(), rms
    assert (rms > low).all(), rms


@pytest.mark.slow
def test_bursty_outputs_are_estimated_as_well_as_can_be():
    """A mean of 6 squares of unit normal variables lies below 3.4 in all but 0.25 %."""
    check_bursty(6, 0.25, 1.85)


@pytest.mark.slow
def test_bursty_outputs_are_estimated_as_well_as_can_be_at_length():
    check_bursty(60, 0.75, 1.25)


def test_bursty_outputs_with_nothing_set():
    estimate = identify(bursty(1))
    assert estimate.ok
    assert estimate.model.n == 4
    assert (np.abs(paired(estimate.model.poles) - TRUTH)[2:] < 0.15).all()
    assert 'bursts' in ' '.join(c.why for c in estimate.choices)
    again = identify(bursty(1))
    np.testing.assert_array_equal(estimate.model.A, again.model.A)


def test_lightly_damped_modes_are_found_from_nothing():
    """Three pairs from a grid; that of 9 Hz is seldom found in interpolated samples."""
    p = PLANTS['flexible']
    record = asynchronous(np.random.default_rng(0), p, 100.0, 60.0, snr=20.0)
    found = search_in_time(record, (0.0, 0.0), Settings(max_order=7))
    poles, deviation = poles_in_time(found.fit)
    assert len(poles) == 6, found.table
    off = np.abs(p.poles[:, np.newaxis] - poles)
    np.testing.assert_array_less(off.min(axis=1), 4.0 * deviation[off.argmin(axis=1)])


def test_bursts_of_noise_are_not_explained():
    rng = np.random.default_rng(8)
    record = bursty(0)
    y = record.outputs[0]
    noise = replace(record, outputs=(replace(y, values=rng.standard_normal(y.values.shape)),))
    estimate = identify(noise)
    assert estimate.status is not Status.OK
    assert estimate.model is None


def test_corrupt_samples_in_bursts_are_left_out():
    record = bursty(1)
    y = record.outputs[0]
    values = y.values.copy()
    values[[40, 90], 0] += 10.0 * values[:, 0].std()
    dirty = identify(replace(record, outputs=(replace(y, values=values),)), Settings(order=4))
    clean = identify(record, Settings(order=4))
    off = np.abs(paired(dirty.model.poles) - paired(clean.model.poles))
    assert (off < paired_std(clean)).all()


def paired_std(estimate) -> np.ndarray:
    return np.array([estimate.pole_std[np.argmin(np.abs(estimate.model.poles - p))]
                     for p in TRUTH])


def test_dense_outputs_are_not_estimated_in_time():
    for estimate in (identify(running(np.random.default_rng(0), PLANTS['hd51'], 20.0)),
                     identify(running(np.random.default_rng(0), PLANTS['hd52'], 20.0))):
        assert not [c for c in estimate.choices if c.name == 'domain']
    assert not in_bursts(running(np.random.default_rng(0), PLANTS['hd51'], 20.0))
