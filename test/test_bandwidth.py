# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
from plants import PLANTS, Multisine, jittered, running
import pytest

from ctsid_core import Record, Signal
from ctsid_core.bases.records import choose_nmax, signal_band


def band_limited(rng, top: float, channels: int = 1) -> Multisine:
    """Noise of equal power up to `top` Hz and none above."""
    f = rng.uniform(0.05, top, 60)
    f[0] = top
    turn = np.exp(2j * np.pi * rng.uniform(size=(channels, 60)))
    return Multisine(2 * np.pi * f, turn / np.sqrt(30.0))


def signal(rng, top, *, rate=100.0, duration=10.0, noise=0.0, channels=1, hold='smooth') -> Signal:
    t = jittered(rng, rate, duration)
    x = band_limited(rng, top, channels).at(t)
    return Signal(t, x + noise * rng.standard_normal(x.shape), hold)


def record(y, u=None) -> Record:
    return Record.from_signals([u or replace(y, hold='zoh')], [y])


@pytest.mark.parametrize('top', [1.0, 3.0, 10.0])
@pytest.mark.parametrize('noise', [0.0, 0.01, 0.1])
def test_the_band_of_a_band_limited_signal_is_found(top, noise):
    rng = np.random.default_rng(0)
    s = signal(rng, top, noise=noise, rate=200.0)
    found = signal_band(s, 0.0, 10.0) / (2 * np.pi)
    assert 0.8 * top < found < top + 2.5          # the periodogram's window smears by about 2 Hz


def test_the_widest_channel_counts():
    rng = np.random.default_rng(1)
    narrow, wide = signal(rng, 1.0), signal(rng, 8.0)
    t = narrow.time
    both = Signal(t, np.column_stack((narrow.values, band_limited(rng, 8.0).at(t))))
    assert signal_band(both, 0.0, 10.0) > 3.0 * signal_band(narrow, 0.0, 10.0)
    assert choose_nmax(record(wide))[0] > choose_nmax(record(narrow))[0]


@pytest.mark.parametrize('seed', range(5))
def test_white_noise_has_next_to_no_band(seed):
    rng = np.random.default_rng(seed)
    t = jittered(rng, 200.0)
    s = Signal(t, rng.standard_normal((len(t), 2)))
    assert signal_band(s, 0.0, 10.0) < 0.05 * np.pi * 200.0


@pytest.mark.parametrize(('size', 'offset'), [(1e6, 0.0), (1e-6, 0.0), (1.0, 1e4)])
def test_units_and_trim_do_not_matter(size, offset):
    s = signal(np.random.default_rng(2), 4.0, noise=0.02)
    moved = replace(s, values=size * s.values + offset)
    assert signal_band(moved, 0.0, 10.0) == pytest.approx(signal_band(s, 0.0, 10.0), rel=0.02)


def test_few_samples_are_taken_at_their_nyquist_frequency():
    t = np.linspace(0.0, 1.5, 16)[:15]
    assert signal_band(Signal(t, np.zeros((15, 1))), 0.0, 9.0) == pytest.approx(np.pi / 0.1)


@pytest.mark.parametrize('seed', range(3))
def test_nmax_is_twice_the_time_bandwidth_product(seed):
    rng = np.random.default_rng(seed)
    s = signal(rng, 10.0, rate=200.0, duration=20.0, noise=0.01)
    nmax, parts = choose_nmax(record(s))
    assert parts == 1
    product = 0.5 * 10.0 * 2 * np.pi * 10.0
    assert 0.8 * 2.0 * product < nmax < 1.5 * 2.0 * product


def test_a_window_twice_as_long_needs_twice_the_functions():
    rng = np.random.default_rng(3)
    s = signal(rng, 8.0, duration=20.0, noise=0.01)
    long, short = (choose_nmax(record(s).between(0.0, end))[0] for end in (20.0, 10.0))
    assert long / short == pytest.approx(2.0, rel=0.2)


def test_the_slowest_sampling_limits_nmax():
    rng = np.random.default_rng(4)
    y = signal(rng, 15.0, rate=200.0)
    fast = choose_nmax(record(y))[0]
    slow_input = signal(rng, 2.0, rate=12.0, hold='linear')
    limited = choose_nmax(record(y, slow_input))[0]
    assert limited < 1.1 * 0.8 * 0.5 * 5.0 * np.pi * 12.0
    assert limited < 0.3 * fast
    # Held inputs are known between their samples: they limit nothing.
    assert choose_nmax(record(y, replace(slow_input, hold='zoh')))[0] == pytest.approx(
        fast, rel=0.1)


def test_nmax_stays_within_bounds():
    rng = np.random.default_rng(5)
    slow = choose_nmax(record(signal(rng, 0.2, rate=50.0)))[0]
    assert 80 <= slow <= 220                        # one or two hundred, however slow the plant
    assert choose_nmax(record(signal(rng, 0.2, rate=5.0, duration=1.0)))[0] == 8


def test_long_records_are_divided():
    """One basis of all functions would cost the square: parts with one model cost the sum."""
    rng = np.random.default_rng(8)
    found = {}
    for duration in (10.0, 40.0, 120.0):
        s = signal(rng, 15.0, rate=200.0, duration=duration, noise=0.01)
        nmax, parts = choose_nmax(record(s))
        product = 0.25 * duration * 2 * np.pi * 15.0
        assert nmax <= 1500
        assert 0.8 * 2.0 * product < nmax * parts < 1.5 * 2.0 * product
        found[duration] = parts
    assert found[10.0] < found[40.0] < found[120.0]
    endless = signal(rng, 40.0, rate=200.0, duration=500.0)
    nmax, parts = choose_nmax(record(endless))
    assert nmax * parts <= 15000


def test_windows_alike_share_their_basis():
    rng = np.random.default_rng(6)
    whole = running(rng, PLANTS['hd52'], 20, rate=200.0, duration=30.0)
    found = {choose_nmax(whole.between(k, k + 10.0))[0] for k in range(0, 20, 2)}
    assert len(found) <= 4
    assert max(found) < 1.25 * min(found)


def test_jitter_does_not_hide_the_band():
    rng = np.random.default_rng(7)
    f = band_limited(rng, 4.0)
    even, uneven = np.arange(2001) / 200.0, jittered(rng, 200.0)
    a, b = (signal_band(Signal(t, f.at(t) + 0.01 * rng.standard_normal((len(t), 1))), 0.0, 10.0)
            for t in (even, uneven))
    assert a == pytest.approx(b, rel=0.1)
