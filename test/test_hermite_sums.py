# SPDX-License-Identifier: Apache-2.0
import tracemalloc

from marks import slow
import numpy as np
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.bases import quadrature
from ctsid_core.bases.hermite import time_scale
from ctsid_core.bases.hermite_functions import (
    frequency_grid,
    frequency_table,
    hermite_functions,
    project,
)
from ctsid_core.signals.record import Signal

LONG = pytest.mark.skipif(np.finfo(np.longdouble).maxexp < 16000, reason='needs long exponents')


def directly(nmax: int, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return weights @ hermite_functions(nmax, x).T


def turning(nmax: int) -> float:
    return float(np.sqrt(2.0 * nmax + 1.0))


def truth(nmax: int, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum eq. 16 of [HD] in long floating-point numbers: their exponents do not underflow."""
    x, weights = x.astype(np.longdouble), weights.astype(np.longdouble)
    before, h = np.zeros_like(x), np.exp(-x * x / 2) / np.arccos(np.longdouble(-1.0)) ** 0.25
    sums = []
    for n in range(nmax + 1):
        sums.append((weights * h).sum(axis=1))
        k = np.longdouble(n)
        before, h = h, np.sqrt(2 / (k + 1)) * x * h - np.sqrt(k / (k + 1)) * before
    return np.array(sums, dtype=float).T


def stamps(kind: str, nmax: int, count: int) -> np.ndarray:
    rng, edge = np.random.default_rng(nmax), turning(nmax)
    uniform = np.linspace(-1.0, 1.0, count) * (edge + 5.0 * edge ** (-1.0 / 3.0))
    return {
        'uniform': uniform,
        'jittered': uniform + rng.uniform(-0.45, 0.45, count) * (uniform[1] - uniform[0]),
        'unsorted': rng.permutation(uniform),
        'bursts': np.concatenate([at + np.sort(rng.uniform(0.0, 1e-3, count // 4))
                                  for at in np.sort(rng.uniform(-edge, edge, 4))]),
        'turning points': rng.choice((-edge, edge), count) + rng.uniform(-1.0, 1.0, count),
        'far beyond': rng.uniform(-2.5, 2.5, count) * edge,
    }[kind]


@pytest.mark.parametrize('kind', ['uniform', 'jittered', 'unsorted', 'bursts', 'turning points',
                                  'far beyond'])
@pytest.mark.parametrize('nmax', [1, 60, 300, *slow(8, 101, 812, 1201, 1800)])
def test_they_are_those_of_the_functions_at_the_samples(kind, nmax):
    x = stamps(kind, nmax, 2000)
    weights = np.vstack((np.random.default_rng(0).standard_normal(len(x)), np.ones(len(x)),
                         np.cos(0.7 * turning(nmax) * x) * np.exp(-x * x / nmax)))
    found, wanted = project(nmax, x, weights), directly(nmax, x, weights)
    error = np.abs(found - wanted).max(axis=1) / np.abs(wanted).max(axis=1)
    assert error.max() < 5e-13


@LONG
@pytest.mark.parametrize('nmax', [100, 301, 812])
def test_sums_are_right_to_rounding(nmax):
    x = stamps('jittered', nmax, 1500)
    weights = np.random.default_rng(1).standard_normal((2, len(x)))
    wanted = truth(nmax, x, weights)
    assert np.abs(project(nmax, x, weights) - wanted).max() < 1e-13 * np.abs(wanted).max()


@LONG
def test_slopes_between_near_stamps_are_no_less_exact_than_directly():
    nmax, rng = 300, np.random.default_rng(2)
    x = np.sort(rng.uniform(-1.0, 1.0, 1000)) * turning(nmax)
    slope = rng.standard_normal((1, 1000)) * 1e6
    pairs, weights = np.concatenate((x, x + 1e-6)), np.hstack((slope, -slope))
    wanted = truth(nmax, pairs, weights)
    error = np.abs(project(nmax, pairs, weights) - wanted).max()
    assert error < np.abs(directly(nmax, pairs, weights) - wanted).max()
    assert error < 1e-10 * np.abs(wanted).max()


@pytest.mark.parametrize('nmax', [100, 812, 1800])
def test_single_values_are_those_of_the_functions(nmax):
    """With all weights but one zero the sums are the functions at one point."""
    at = turning(nmax) * np.array([-1.2, -1.0, -0.3, 0.0, 0.77, 1.05])
    x = np.concatenate((at, np.zeros(2000)))
    found = project(nmax, x, np.eye(len(at), len(x)))
    np.testing.assert_allclose(found, hermite_functions(nmax, at).T, rtol=0, atol=2e-13)


def test_samples_out_of_reach_count_for_nothing():
    x = np.concatenate((np.linspace(-5.0, 5.0, 1000), [-1e6, -80.0, -45.0, 45.0, 1e6, 1e18]))
    weights = np.ones((1, len(x)))
    without = project(300, x[:1000], weights[:, :1000])
    np.testing.assert_array_equal(project(300, x, weights), without)
    np.testing.assert_array_equal(project(300, np.full(1000, 1e3), np.ones((2, 1000))), 0.0)


def test_few_samples():
    rng = np.random.default_rng(3)
    for nmax, count in ((60, 500), (300, 30), (812, 1), (300, 0)):
        x, weights = rng.uniform(-9.0, 9.0, count), rng.standard_normal((2, count))
        np.testing.assert_allclose(project(nmax, x, weights), directly(nmax, x, weights),
                                   rtol=0, atol=1e-13 * (1.0 + np.abs(weights).sum()))


def test_channels_together_are_as_alone():
    rng = np.random.default_rng(4)
    x, weights = stamps('jittered', 400, 3000), rng.standard_normal((5, 3000))
    together = project(400, x, weights)
    alone = np.vstack([project(400, x, row[np.newaxis]) for row in weights])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-14 * np.abs(alone).max())
    assert project(400, x, weights[:0]).shape == (0, 401)


@pytest.mark.parametrize('nmax', [300, 1800])
def test_equal_bits_whatever_was_computed_before(nmax):
    x = stamps('jittered', nmax, 3000)
    weights = np.random.default_rng(5).standard_normal((3, 3000))
    first = project(nmax, x, weights)
    project(nmax + 1, x, weights)
    np.testing.assert_array_equal(project(nmax, x, weights), first)
    frequency_table.cache_clear()
    frequency_grid.cache_clear()
    np.testing.assert_array_equal(project(nmax, x, weights), first)


@pytest.mark.slow
def test_what_is_kept_is_bounded():
    x, weights = np.zeros(4000), np.ones((1, 4000))
    frequency_table.cache_clear()
    tracemalloc.start()
    for nmax in range(1500, 1512):
        project(nmax, x, weights)
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert frequency_table.cache_info().currsize == 8
    frequency_table.cache_clear()
    assert kept < 140e6


def test_arguments_are_left_alone():
    x, weights = stamps('far beyond', 300, 1000), np.ones((2, 1000))
    before = x.copy()
    project(300, x, weights)
    np.testing.assert_array_equal(x, before)
    np.testing.assert_array_equal(weights, 1.0)


@LONG
@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
@pytest.mark.parametrize('kind', ['uniform', 'jittered', 'close', 'gap', 'inside'])
@pytest.mark.parametrize('margin', [5.0, *slow(0.0, 20.0)])
def test_signals_of_any_hold_lose_nothing(hold, kind, margin, monkeypatch):
    rng, nmax = np.random.default_rng(6), 300
    t = np.linspace(-0.1, 10.1, 1500)
    if kind != 'uniform':
        t[1:-1] += rng.uniform(-0.45, 0.45, 1498) * (t[1] - t[0])
    if kind == 'close':
        t = np.sort(np.concatenate((t, t[::7] + 1e-7)))
    if kind == 'gap':
        t = t[(t < 3.0) | (t > 4.0)]
    if kind == 'inside':
        t = t[(t > 1.0) & (t < 9.5)]
    values = np.column_stack((np.sin(9.0 * t) + 5.0, rng.standard_normal(len(t))))
    settings = Settings(edges='exact' if margin else 'paper', edge_margin=margin or 5.0)
    alpha = time_scale(nmax, 5.0, settings)

    def coefficients() -> np.ndarray:
        return quadrature.coefficients([Signal(t, values, hold)], 0.0, 10.0, alpha, nmax,
                                       [0.013])[0]

    def errors(way) -> np.ndarray:
        monkeypatch.setattr(quadrature, 'project', way)
        return np.abs(coefficients() - wanted).max(axis=1) / np.abs(wanted).max(axis=1)

    monkeypatch.setattr(quadrature, 'project', truth)
    wanted = coefficients()
    # Slopes between near stamps are large weights that cancel: directly, more digits are lost.
    assert (errors(project) < np.maximum(1e-13, errors(directly))).all()


def test_identification_does_not_depend_on_what_is_kept():
    rng = np.random.default_rng(7)
    t = np.sort(rng.uniform(0.0, 10.0, 1500))
    u = np.sign(np.sin(3.0 * t) + np.sin(7.7 * t))
    y = np.zeros_like(t)
    for k, step in enumerate(np.diff(t)):                # dy/dt = -3 y + 3 u, u held
        y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-3.0 * step)
    y += 0.05 * rng.standard_normal(len(y))
    record = Record.from_arrays(t, u, t + 1e-4, y, input_hold='zoh')
    settings = Settings(order=1, nmax=250)
    first = identify(record, settings)
    frequency_table.cache_clear()
    frequency_grid.cache_clear()
    identify(record, settings.replace(nmax=251))
    again = identify(record, settings)
    assert first.model is not None
    assert again.model is not None
    for name in 'ABCDK':
        np.testing.assert_array_equal(getattr(again.model, name), getattr(first.model, name))
    assert first.model.poles.real[0] == pytest.approx(-3.0, rel=0.05)
