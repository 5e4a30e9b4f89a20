# SPDX-License-Identifier: Apache-2.0
from marks import slow
import numpy as np
from plants import jittered, random_signal
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

from ctsid_core.bases.hermite_functions import hermite_functions
from ctsid_core.bases.quadrature import coefficients, integrate, smooth_values, spline_degree
from ctsid_core.signals.record import Signal

NMAX, START, END = 80, -0.3, 9.8
TURNING = np.sqrt(2.0 * NMAX + 1.0)
ALPHA = 0.5 * (END - START) / (TURNING + 5.0 * TURNING ** (-1.0 / 3.0))
BETWEEN = {
    'zoh': lambda t, x, at: x[np.maximum(np.searchsorted(t, at, side='right') - 1, 0)],
    'linear': lambda t, x, at: np.interp(at, t, x),
}


def by_panels(f, breaks, nmax=NMAX, alpha=ALPHA, start=START, end=END) -> np.ndarray:
    """Integrate f h_n between all breaks by 16 Gauss points per panel of less than 2 rad."""
    breaks = np.concatenate(([start], breaks[(breaks > start) & (breaks < end)], [end]))
    finest = 2.0 * alpha / np.sqrt(2.0 * nmax + 1.0)
    edges = np.concatenate([np.linspace(a, b, int((b - a) / finest) + 2)[:-1]
                            for a, b in zip(breaks[:-1], breaks[1:], strict=True)] + [[end]])
    point, weight = np.polynomial.legendre.leggauss(16)
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    at = (middle[:, np.newaxis] + half[:, np.newaxis] * point).ravel()
    x = (at - 0.5 * (start + end)) / alpha
    return hermite_functions(nmax, x) @ (f(at) * np.outer(half, weight).ravel()) / alpha


def stamps(rng, kind: str) -> np.ndarray:
    t = np.sort(rng.uniform(-1.0, 10.5, 70))
    if kind == 'close':
        return np.sort(np.concatenate((t, t[20:40] + 1e-7)))
    if kind == 'gap':
        return t[(t < 3.0) | (t > 7.0)]
    if kind == 'inside':
        return t[(t > 0.5) & (t < 9.1)]
    if kind == 'on the edges':
        return np.unique(np.concatenate((t, [START, END])))
    return np.array([4.0]) if kind == 'one' else t


def found(t, values, hold, *, delay=0.0, nmax=NMAX, alpha=ALPHA) -> np.ndarray:
    signal = Signal(t, values.reshape(len(t), -1), hold)
    return coefficients([signal], START, END, alpha, nmax, [delay])[0]


@pytest.mark.parametrize('kind', ['random', 'close', 'gap', 'inside', 'on the edges', 'one'])
@pytest.mark.parametrize('hold', ['zoh', 'linear'])
@pytest.mark.parametrize('delay', [0.0, 0.37])
def test_held_and_linear_signals_are_projected_exactly(hold, kind, delay):
    rng = np.random.default_rng(len(kind))
    t = stamps(rng, kind)
    values = 3.0 + rng.standard_normal((len(t), 2))
    got = found(t, values, hold, delay=delay)
    assert got.shape == (2, NMAX + 1)
    for row, x in zip(got, values.T, strict=True):
        wanted = by_panels(lambda at, x=x: BETWEEN[hold](t, x, at - delay), t + delay)
        np.testing.assert_allclose(row, wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize('hold', ['zoh', 'linear'])
@pytest.mark.parametrize('nmax', [1, 2, 700, *slow(1000)])
def test_exactness_at_any_order(hold, nmax):
    rng = np.random.default_rng(3)
    turning = np.sqrt(2.0 * nmax + 1.0)
    alpha = 0.5 * (END - START) / (turning + 5.0 * turning ** (-1.0 / 3.0))
    t = stamps(rng, 'random')
    x = rng.standard_normal(len(t))
    wanted = by_panels(lambda at: BETWEEN[hold](t, x, at), t, nmax, alpha)
    np.testing.assert_allclose(found(t, x, hold, nmax=nmax, alpha=alpha)[0], wanted, rtol=0,
                               atol=1e-10)


@pytest.mark.parametrize('hold', ['zoh', 'linear'])
def test_adaptive_quadrature_agrees(hold):
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(-1.0, 10.5, 12))
    x = rng.standard_normal(12)
    got = found(t, x, hold)[0]
    for n in (0, 1, 7, 30):
        def product(at, n=n):
            h = hermite_functions(n, np.array([(at - 0.5 * (START + END)) / ALPHA]))[n, 0]
            return BETWEEN[hold](t, x, np.array([at]))[0] * h / ALPHA

        inner = np.concatenate(([START], t[(t > START) & (t < END)], [END]))
        wanted = sum(quad(product, a, b, epsabs=1e-13, limit=200)[0]
                     for a, b in zip(inner[:-1], inner[1:], strict=True))
        assert got[n] == pytest.approx(wanted, abs=1e-10)


@pytest.mark.parametrize('paper', [False, True])
def test_basis_that_has_not_decayed_at_the_edges(paper):
    rng = np.random.default_rng(5)
    t, alpha = stamps(rng, 'random'), 0.5 * (END - START) / TURNING * (1.0 if paper else 1.5)
    x = rng.standard_normal(len(t))
    for hold in ('zoh', 'linear'):
        wanted = by_panels(lambda at, hold=hold: BETWEEN[hold](t, x, at), t, NMAX, alpha)
        np.testing.assert_allclose(found(t, x, hold, alpha=alpha)[0], wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize('uniform', [True, False])
@pytest.mark.parametrize('on_edges', [True, False])
def test_smooth_signals_against_the_truth_between_the_samples(uniform, on_edges):
    rng = np.random.default_rng(6)
    f = random_signal(rng, 2, band=2.0)
    t = np.arange(-0.9, 10.4, 0.01) if uniform else jittered(rng, 100.0, 11.4) - 0.9
    if on_edges:
        t = np.linspace(START, END, 1011) if uniform else \
            np.concatenate(([START], t[(t > START + 1e-3) & (t < END - 1e-3)], [END]))
    got = found(t, f.at(t), 'smooth')
    wanted = np.array([by_panels(lambda at, i=i: f.at(at)[:, i], np.empty(0)) for i in (0, 1)])
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-7 if uniform else 2e-5)


def test_uniform_samples_of_a_band_limited_signal_are_projected_to_rounding():
    # <h_n, exp(i w x)> = sqrt(2 pi) i^n h_n(w): the functions are their own Fourier transforms.
    t, w = np.linspace(START, END, 600), np.array([7.3, 11.9])
    x = np.cos(np.outer(t - 0.5 * (START + END), w) + 0.4)
    alpha = 0.9 * ALPHA                          # so that h_80 is below 1e-11 at the edges
    h = hermite_functions(NMAX, alpha * w)
    phase = np.exp(0.4j) * 1j ** np.arange(NMAX + 1)
    wanted = np.sqrt(2.0 * np.pi) * (phase[:, np.newaxis] * h).real.T
    np.testing.assert_allclose(found(t, x, 'smooth', alpha=alpha), wanted, rtol=0, atol=1e-10)


def test_uniform_samples_where_the_basis_has_not_decayed():
    """With the paper's alpha the ends count: half a weight each, as the trapezoid rule has it."""
    t, alpha = np.linspace(START, END, 1011), 0.5 * (END - START) / TURNING
    got = found(t, np.cos(t), 'smooth', alpha=alpha)[0]
    wanted = by_panels(np.cos, np.empty(0), alpha=alpha)
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-3)


def test_near_coincident_stamps_do_not_break_the_spline():
    rng = np.random.default_rng(7)
    f = random_signal(rng, 1, band=2.0)
    t = jittered(rng, 100.0, 11.4) - 0.9
    t = np.unique(np.concatenate((t, t[50:900:50] + 1e-6)))
    wanted = by_panels(lambda at: f.at(at)[:, 0], np.empty(0))
    np.testing.assert_allclose(found(t, f.at(t), 'smooth')[0], wanted, rtol=0, atol=1e-4)


def test_a_gap_is_bridged_by_a_straight_line_not_by_a_spline():
    t = np.concatenate((np.arange(-0.5, 4.0, 0.02), np.arange(5.0, 10.2, 0.02)))
    f = np.sin(3.0 * t)
    at = np.linspace(4.0 - 0.02, 5.0, 200)
    line = np.interp(at, t, f)
    inside = (at > t[224]) & (at < t[225])
    for degree in (3, 5):
        got = smooth_values(t, f[np.newaxis], at, degree)[0]
        np.testing.assert_allclose(got[inside], line[inside], atol=1e-14)
    # Beside the gap the splines are those of the two parts alone.
    at = np.array([3.91, 3.97, 5.03, 5.09])
    parts = CubicSpline(t[:225], f[:225]), CubicSpline(t[225:], f[225:])
    wanted = np.concatenate((parts[0](at[:2]), parts[1](at[2:])))
    np.testing.assert_allclose(smooth_values(t, f[np.newaxis], at)[0], wanted, atol=1e-13)


def test_the_projection_takes_the_line_across_a_gap():
    rng = np.random.default_rng(8)
    t = jittered(rng, 100.0, 11.4) - 0.9
    t = t[(t < 4.0) | (t > 5.0)]
    f = np.sin(3.0 * t)
    last = np.searchsorted(t, 4.5)

    def bridged(at):
        gap = (at > t[last - 1]) & (at < t[last])
        return np.where(gap, np.interp(at, t, f), np.sin(3.0 * at))

    wanted = by_panels(bridged, t[last - 1:last + 1])
    np.testing.assert_allclose(found(t, f, 'smooth')[0], wanted, rtol=0, atol=2e-5)


def test_smooth_values_beyond_the_ends_are_constant():
    t = np.linspace(0.0, 1.0, 30)
    got = smooth_values(t, np.vstack((t, 1 - t)), np.array([-3.0, 0.0, 1.0, 5.0]))
    np.testing.assert_allclose(got, [[0, 0, 1, 1], [1, 1, 0, 0]], atol=1e-15)


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
def test_few_samples(hold):
    for count in range(1, 9):
        t = np.linspace(0.0, 9.0, count) + 0.1 * np.arange(count) ** 2
        got = found(t, np.ones(count), hold)
        constant = by_panels(np.ones_like, np.empty(0))
        # Eight samples are splined, and the rule of Gauss is not exact in their long intervals.
        np.testing.assert_allclose(got[0], constant, rtol=0,
                                   atol=1e-3 if (hold, count) == ('smooth', 8) else 1e-10)


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
@pytest.mark.parametrize('uniform', [True, False])
def test_projection_is_linear(hold, uniform):
    rng = np.random.default_rng(9)
    t = np.linspace(-0.5, 10.0, 300) if uniform else jittered(rng, 30.0, 11.0) - 0.6
    x = random_signal(rng, 2, band=1.0).at(t)
    mixed = np.column_stack((x, 2.0 * x[:, 0] - 3.0 * x[:, 1]))
    a, b, c = found(t, mixed, hold)
    np.testing.assert_allclose(c, 2.0 * a - 3.0 * b, rtol=0, atol=1e-11)


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
def test_signals_with_shared_stamps_are_projected_as_if_alone(hold):
    rng = np.random.default_rng(10)
    t, other = jittered(rng, 40.0, 11.0) - 0.6, jittered(rng, 31.0, 11.0) - 0.6
    as_many = jittered(rng, 40.0, 11.0) - 0.6
    f = random_signal(rng, 3, band=2.0)
    signals = [Signal(t, f.at(t)[:, :1], hold), Signal(other, f.at(other)[:, 1:2], hold),
               Signal(t, f.at(t)[:, 1:], hold), Signal(t, f.at(t)[:, :1], hold),
               Signal(as_many, f.at(as_many), hold)]
    delays = [0.0, 0.0, 0.0, 0.2, 0.0]
    joined = coefficients(signals, START, END, ALPHA, NMAX, delays)
    for signal, delay, rows in zip(signals, delays, joined, strict=True):
        alone = coefficients([signal], START, END, ALPHA, NMAX, [delay])[0]
        assert rows.shape == (signal.width, NMAX + 1)
        np.testing.assert_allclose(rows, alone, rtol=0, atol=1e-13)


def test_a_dead_time_shifts_a_smooth_signal():
    rng = np.random.default_rng(11)
    f = random_signal(rng, 1, band=2.0)
    t = jittered(rng, 200.0, 11.4) - 0.9
    late = found(t, f.at(t), 'smooth', delay=0.25)[0]
    wanted = by_panels(lambda at: f.at(at - 0.25)[:, 0], np.empty(0))
    np.testing.assert_allclose(late, wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize(('noise', 'rate', 'degree'), [(3.0, 100.0, 1), (0.0, 25.0, 5)])
def test_the_degree_of_the_spline_follows_the_data(noise, rate, degree):
    rng = np.random.default_rng(12)
    t = jittered(rng, rate, 10.0)
    f = random_signal(rng, 2, band=2.0).at(t).T
    assert spline_degree(t, f + noise * rng.standard_normal(f.shape)) == degree


def test_the_degree_foretells_left_out_samples_best():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t = jittered(rng, 40.0, 10.0)
        f = random_signal(rng, 2, band=2.0).at(t).T
        f = f + 10.0 ** rng.uniform(-4.0, 0.0) * rng.standard_normal(f.shape)
        error = {k: np.mean((smooth_values(t[::2], f[:, ::2], t[1:-1:2], k)
                             - f[:, 1:-1:2]) ** 2 / f.var(axis=1, keepdims=True))
                 for k in (1, 3, 5)}
        assert spline_degree(t, f) == min(error, key=error.get)


def test_the_degree_is_three_where_there_are_too_few_samples_to_tell():
    t = np.linspace(0.0, 1.0, 31)
    assert spline_degree(t, np.random.default_rng(0).standard_normal((1, 31))) == 3


def test_degree_of_constant_channels_is_finite():
    t = jittered(np.random.default_rng(0), 40.0)
    assert spline_degree(t, np.zeros((2, len(t)))) in (1, 3, 5)


def test_integration_of_a_known_derivative():
    # g = <h_n, d h_k / dx>, by eq. 19 of [HD]; the coefficients of h_k are the unit vector.
    for k in (0, 1, 2, 9, 40):
        g = np.zeros((1, 42))
        if k:
            g[0, k - 1] = np.sqrt(k / 2.0)
        g[0, k + 1] = -np.sqrt((k + 1) / 2.0)
        c = integrate(g, np.array([1.0 if k == 0 else 0.0]))
        np.testing.assert_allclose(c[0], np.eye(42)[k], atol=1e-13)


def test_samples_are_left_alone():
    rng = np.random.default_rng(13)
    t = jittered(rng, 40.0, 11.0) - 0.6
    x = rng.standard_normal((len(t), 2))
    before = t.copy(), x.copy()
    for hold in ('zoh', 'linear', 'smooth'):
        coefficients([Signal(t, x, hold)], START, END, ALPHA, NMAX, [0.1])
    np.testing.assert_array_equal(t, before[0])
    np.testing.assert_array_equal(x, before[1])
