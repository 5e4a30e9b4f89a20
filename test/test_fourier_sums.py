# SPDX-License-Identifier: Apache-2.0
import tracemalloc

from marks import slow
import numpy as np
import pytest

from ctsid_core.bases.hermite_functions import fourier_grid, fourier_sums

REACH, TOP = 20.0, 15.0
GRID = fourier_grid(REACH, TOP)


def truth(x, weights, w) -> np.ndarray:
    """Sum term by term, in the longest floating-point numbers there are."""
    phase = np.outer(x.astype(np.longdouble), w.astype(np.longdouble))
    return weights @ np.cos(phase) - 1j * (weights @ np.sin(phase))


def stamps(kind: str, count: int = 3000) -> np.ndarray:
    rng = np.random.default_rng(len(kind))
    uniform = np.linspace(-REACH, REACH, count)
    return {
        'uniform': uniform,
        'jittered': uniform[1:-1] + rng.uniform(-0.45, 0.45, count - 2) * (2 * REACH / count),
        'unsorted': rng.uniform(-REACH, REACH, count),
        'bursts': np.concatenate([at + rng.uniform(0.0, 1e-4, count // 4)
                                  for at in rng.uniform(-REACH, REACH - 1e-4, 4)]),
        'on the grid': GRID.step * rng.integers(-GRID.size // 2, GRID.size // 2, count),
        'between': GRID.step * (rng.integers(-GRID.size // 2 + 1, GRID.size // 2, count) + 0.5),
        'at the ends': np.repeat((-REACH, REACH), count // 2),
    }[kind]


@pytest.mark.parametrize('kind', ['unsorted', 'on the grid', 'at the ends', *slow(
    'uniform', 'jittered', 'bursts', 'between')])
@pytest.mark.parametrize('channels', [3, *slow(1)])
def test_sums_are_those_of_the_terms(kind, channels):
    x = stamps(kind)
    weights = np.random.default_rng(0).standard_normal((channels, len(x)))
    wanted = truth(x, weights, GRID.w)
    found = fourier_sums(x, weights, GRID)
    assert found.shape == (channels, len(GRID.w))
    limit = 1e-13 * np.abs(weights).sum(axis=1)[:, np.newaxis]
    assert (np.abs(found - wanted) < limit).all()


@pytest.mark.parametrize('count', [0, 1, 8193, *slow(8191, 8192)])
def test_any_number_of_samples(count):
    x = np.random.default_rng(1).uniform(-REACH, REACH, count)
    found = fourier_sums(x, np.ones((1, count)), GRID)
    np.testing.assert_allclose(found, truth(x, np.ones((1, count)), GRID.w), rtol=0,
                               atol=1e-13 * max(count, 1))


@pytest.mark.parametrize(('reach', 'top'), [(0.1, 0.1), (3.0, 0.7), (40.0, 60.0)])
def test_grids_reach_as_far_as_asked(reach, top):
    grid = fourier_grid(reach, top)
    assert grid.w[0] == 0.0
    assert grid.w[-1] > top * (1.0 - 1e-14)
    assert grid.size * grid.step == pytest.approx(2.0 * reach, rel=1e-14)
    x = np.random.default_rng(2).uniform(-reach, reach, 50)
    found = fourier_sums(x, np.ones((1, 50)), grid)
    np.testing.assert_allclose(found, truth(x, np.ones((1, 50)), grid.w), rtol=0, atol=1e-11)


def test_stamps_side_by_side_keep_their_distance():
    """Slopes between near samples are large weights of either sign: what they leave is right."""
    x = stamps('unsorted', 300)
    after = x + 1e-8
    slope = np.random.default_rng(3).standard_normal((1, 300)) / (after - x)
    pairs, weights = np.concatenate((x, after)), np.hstack((slope, -slope))
    wanted = truth(pairs, weights, GRID.w)
    assert np.abs(fourier_sums(pairs, weights, GRID) - wanted).max() < 3e-9 * np.abs(wanted).max()


def test_the_memory_does_not_grow_with_the_samples():
    peaks = []
    for count in (20000, 200000):
        x, weights = np.linspace(-REACH, REACH, count), np.ones((2, count))
        fourier_sums(x, weights, GRID)
        tracemalloc.start()
        fourier_sums(x, weights, GRID)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] < 1e7


def test_arguments_are_left_alone():
    x, weights = stamps('unsorted'), np.ones((2, 3000))
    before = x.copy()
    fourier_sums(x, weights, GRID)
    np.testing.assert_array_equal(x, before)
    np.testing.assert_array_equal(weights, 1.0)
