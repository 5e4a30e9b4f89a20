# SPDX-License-Identifier: Apache-2.0
"""Estimates from samples in bursts: as good as can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from plants import PLANTS, asynchronous
import pytest

from ctsid_core import Record, Settings, Signal, Status, identify
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.model.simulation import respond

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


def test_noise_free_samples_give_the_plant_to_rounding():
    found = identify(bursty(0, snr=240.0), Settings(order=4))
    np.testing.assert_allclose(paired(found.model.poles), TRUTH, rtol=1e-6)


@pytest.mark.slow
def test_bursty_outputs_are_estimated_as_well_as_can_be():
    scores = []
    for seed in range(60):
        estimate = identify(bursty(seed), Settings(order=4))
        assert estimate.ok, (seed, estimate.status)
        poles = estimate.model.poles
        deviation = np.array([estimate.pole_std[np.argmin(np.abs(poles - p))] for p in TRUTH])
        scores.append(np.abs(paired(poles) - TRUTH) / deviation)
    # Standard deviations are the Cramer-Rao bound at the found model.
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    print(rms)
    assert (rms < 1.25).all(), rms
    assert (rms > 0.75).all(), rms


def test_bursty_outputs_with_nothing_set():
    estimate = identify(bursty(1))
    assert estimate.ok
    assert estimate.model.n == 4
    assert (np.abs(paired(estimate.model.poles) - TRUTH)[2:] < 0.15).all()


def test_lightly_damped_modes_are_found_from_nothing():
    """Three pairs; that of 9 Hz is seldom found in interpolated samples."""
    p = PLANTS['flexible']
    record = asynchronous(np.random.default_rng(0), p, 100.0, 60.0, snr=20.0)
    found = identify(record, Settings(max_order=7, delay=0.0))
    poles = found.model.poles
    assert len(poles) == 6
    off = np.abs(p.poles[:, np.newaxis] - poles)
    np.testing.assert_array_less(off.min(axis=1), 4.0 * found.pole_std[off.argmin(axis=1)])


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



def test_thinned_samples_mistake_no_frequency_for_another():
    """Of every k-th sample a sine is as well one of another frequency."""
    t = np.arange(0.0, 60.0, 0.004)
    given = Record.from_arrays(t, np.sign(np.sin(t)), t, np.sin(30.0 * t))
    whole = samples_of([given], [[None]])
    thin = whole.thinned(1000, scattered=True)
    times, y = (np.squeeze(x) for x in (thin.records[0].streams[0].times,
                                        thin.records[0].streams[0].y))
    assert len(times) == 1000
    assert np.all(np.diff(times) > 0.0)
    again = whole.thinned(1000, scattered=True).records[0].streams[0]
    np.testing.assert_array_equal(times, again.times)
    alias = 2.0 * np.pi / (15 * 0.004) - 30.0
    for omega, least, most in ((30.0, 0.999, 1.0), (alias, 0.0, 0.05)):
        columns = np.stack((np.cos(omega * times), np.sin(omega * times)), axis=1)
        left = y - columns @ np.linalg.lstsq(columns, y, None)[0]
        assert least <= 1.0 - left @ left / (y @ y) <= most
