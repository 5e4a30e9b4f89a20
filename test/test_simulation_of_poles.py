# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
from plants import PLANTS, match, plant, random_plant, running
import pytest
from scipy.optimize import least_squares, minimize

from ctsid_core import Record, Settings
from ctsid_core.bases.hermite import project_record
from ctsid_core.bases.projection import as_real
from ctsid_core.likelihood.simulation_of_poles import OutputError

MIXED = np.array([-1.0 + 2.0j, -1.0 - 2.0j, -4.0, -9.0, -0.5])


def projection(p, snr, seed=0, nmax=150, settings=None):
    rng = np.random.default_rng(seed)
    record = running(rng, p, snr, rate=200.0, band=5.0)
    return project_record(record, settings or Settings(), nmax)


def explained(lines, poles, feedthrough) -> tuple[np.ndarray, int]:
    """Return residuals of plain least squares on partial fractions, and the free parameters."""
    z = np.vstack((lines.u, lines.tail, lines.ones))
    rows = []
    for p in poles[poles.imag >= 0.0]:
        if p.imag == 0.0:
            rows.append(z / (lines.s - p))
        else:
            one, other = 1.0 / (lines.s - p), 1.0 / (lines.s - p.conjugate())
            rows += [z * (one + other), z * (1j * (one - other))]
    rows.append(lines.ones)
    if feedthrough:
        rows.append(lines.u)
    X, y = as_real(np.vstack(rows)), as_real(lines.y)
    size = np.linalg.norm(X, axis=1)
    weights = np.linalg.lstsq((X.T / size), y.T, rcond=1e-13)[0]
    # The trim of the states acts like that of the outputs: it adds no parameter.
    used = len(poles) * (len(z) - len(lines.ones)) + len(lines.ones) + feedthrough * len(lines.u)
    return y - (weights.T / size) @ X, len(y) * used + len(poles)


def likelihood(lines, residual) -> float:
    count = 2 * len(lines.s) - np.count_nonzero(lines.s == 0.0)   # real numbers of all lines
    return count * np.log(np.sum(residual ** 2, axis=1) / count).sum()


@pytest.mark.parametrize('poles', [MIXED, MIXED[:2], MIXED[2:3], MIXED[2:4], MIXED[:3]])
@pytest.mark.parametrize('feedthrough', [True, False])
@pytest.mark.parametrize('settings', [Settings(), Settings(trim=False, edges='paper')])
def test_the_cost_is_that_of_plain_least_squares(poles, feedthrough, settings):
    lines = projection(PLANTS['hd52'], 20, settings=settings)
    found = OutputError(lines, feedthrough).fit(poles)
    residual, count = explained(lines, poles, feedthrough)
    assert found.cost == pytest.approx(likelihood(lines, residual), rel=1e-10)
    assert found.parameters == count
    np.testing.assert_allclose(match(found.poles, poles), poles, rtol=1e-12)


def test_what_is_explained_is_counted_about_the_trim():
    """A large offset explains nothing: else the search for the order ends at once."""
    lines = projection(PLANTS['hd51'], 20)
    moved = replace(lines, y=lines.y + 1e3 * lines.ones)
    for given in (lines, moved):
        residual, _ = explained(given, MIXED[2:4], True)
        y, ones = as_real(given.y), as_real(given.ones)
        moving = y - y @ np.linalg.pinv(ones) @ ones
        share = np.sum(residual ** 2, axis=1) / np.sum(moving ** 2, axis=1)
        found = OutputError(given, True).fit(MIXED[2:4])
        assert found.residual == pytest.approx(share.max(), rel=1e-6)


def from_vector(v) -> np.ndarray:
    roots = [np.roots([1.0, a, b]) for a, b in v.reshape(-1, 2)]
    return np.concatenate(roots).astype(complex)


@pytest.mark.parametrize('snr', [40, 10])
@pytest.mark.parametrize('poles', [[-1 + 3j, -1 - 3j], [-2.0, -6.0],
                                   [-0.5 + 3j, -0.5 - 3j, -1 + 9j, -1 - 9j]])
def test_gauss_newton_reaches_the_optimum_of_least_squares(poles, snr):
    """One output: then the likelihood is a sum of squares, and scipy can start from the truth."""
    poles, n = np.array(poles, dtype=complex), len(poles)
    A = np.zeros((n, n))
    for i in range(0, n, 2):
        A[i:i + 2, i:i + 2] = [[0.0, 1.0], [-(poles[i] * poles[i + 1]).real,
                                            (poles[i] + poles[i + 1]).real]]
    B, C = np.zeros((n, 1)), np.zeros((1, n))
    B[1::2], C[:, 0::2] = np.abs(poles[0::2, np.newaxis]) ** 2, 1.0
    lines = projection(plant(A, B, C), snr)
    truth = np.array([(-(p + q).real, (p * q).real) for p, q in
                      zip(poles[0::2], poles[1::2], strict=True)]).ravel()
    wanted = least_squares(lambda v: explained(lines, from_vector(v), True)[0].ravel(), truth,
                           x_scale=np.abs(truth), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    best = explained(lines, from_vector(wanted.x), True)[0]
    start = poles * 1.15
    found = OutputError(lines, True).fit(start, 30)
    assert likelihood(lines, best) - 1e-6 < found.cost < likelihood(lines, best) + 2e-3
    np.testing.assert_allclose(match(found.poles, from_vector(wanted.x)), from_vector(wanted.x),
                               rtol=2e-3)
    assert found.cost < OutputError(lines, True).fit(start).cost


def test_the_optimum_over_several_outputs():
    rng = np.random.default_rng(1)
    p = random_plant(rng, 3, 2, 3)
    lines = projection(p, 15, seed=2)
    oe = OutputError(lines, False)

    def cost(v):
        poles = np.append(np.roots([1.0, v[0], v[1]]), -v[2]).astype(complex)
        return likelihood(lines, explained(lines, poles, False)[0])

    pair = p.poles[p.poles.imag > 0.0][0]
    truth = np.array([-2.0 * pair.real, abs(pair) ** 2, -p.poles[p.poles.imag == 0.0][0].real])
    best = minimize(cost, truth, method='Nelder-Mead',
                    options={'xatol': 1e-9, 'fatol': 1e-9, 'maxiter': 800})
    found = oe.fit(p.poles.astype(complex) * 0.9, 30)
    assert best.fun - 1e-6 < found.cost < best.fun + 2e-3


@pytest.mark.parametrize('far', [0.3, 0.7, 1.5, 3.0])
def test_far_starts_end_at_the_same_optimum(far):
    p = PLANTS['hd52']
    oe = OutputError(projection(p, 20), True)
    near, away = oe.fit(p.poles, 30), oe.fit(p.poles * far, 60)
    np.testing.assert_allclose(match(away.poles, near.poles), near.poles, rtol=1e-2)


def test_the_cost_never_rises():
    rng = np.random.default_rng(3)
    oe = OutputError(projection(PLANTS['hd52'], 10), True)
    for _ in range(20):
        real = -10.0 ** rng.uniform(-1.0, 1.5, 2)
        pair = 10.0 ** rng.uniform(-1.0, 1.5) * np.exp(1j * rng.uniform(1.6, 3.0))
        poles = np.array([*real, pair, pair.conjugate()])
        costs = [oe.fit(poles, steps).cost for steps in (0, 1, 2, 5)]
        assert (np.diff(costs) <= 1e-9).all()


def test_poles_stay_in_conjugate_pairs_and_may_become_real():
    oe = OutputError(projection(plant([[-2, 0], [0, -5]], [[1], [1]], [[1, 2]]), 40), False)
    found = oe.fit(np.array([-3 + 2j, -3 - 2j]), 30)
    np.testing.assert_allclose(np.sort(found.poles.real), [-5, -2], atol=0.2)
    np.testing.assert_array_equal(found.poles.imag, 0.0)


@pytest.mark.parametrize('pole', [0.0, -1e-9, 1e-7, -1e-3])
def test_a_drifting_integrator_is_explained(pole):
    """A constant through a pole as slow as this is a ramp: a regressor of its own."""
    t = np.linspace(0.0, 10.0, 2001)
    u = np.sin(3.0 * t + 0.2 * t ** 2)
    record = Record.from_arrays(t, u, t, 5.0 - 0.7 * t, input_hold='smooth')
    lines = project_record(record, Settings(edge_margin=10.0), 150)
    assert OutputError(lines, False).fit(np.array([pole], dtype=complex)).residual < 1e-6


def test_no_pole_crosses_the_limit():
    p = PLANTS['hd51']
    oe = OutputError(projection(p, 20), True)
    for limit in (-5.0, -3.0, 0.1):
        found = oe.fit(np.array([-6.0, -9.0], dtype=complex), 30, limit)
        assert found.poles.real.max() <= limit
    free = oe.fit(np.array([-6.0, -9.0], dtype=complex), 30)
    np.testing.assert_allclose(match(free.poles, p.poles), p.poles, atol=0.5)


def test_noise_free_data_have_a_finite_cost():
    p = PLANTS['hd51']
    lines = projection(p, None, settings=Settings(edge_margin=10.0))
    found = OutputError(lines, True).fit(p.poles.astype(complex), 5)
    assert np.isfinite(found.cost)
    assert found.residual < 1e-12
    silent = replace(lines, y=np.vstack((lines.y[:1], 0.0 * lines.y[:1])))
    assert np.isfinite(OutputError(silent, True).fit(p.poles.astype(complex), 5).cost)


def test_units_change_the_cost_by_a_constant_only():
    lines = projection(PLANTS['hd51'], 20)
    big = replace(lines, u=1e6 * lines.u, y=lines.y * np.array([[1e-6], [1e6]]))
    a, b = (OutputError(x, True).fit(np.array([-1.0, -6.0], dtype=complex), 20)
            for x in (lines, big))
    np.testing.assert_allclose(match(a.poles, b.poles), b.poles, rtol=1e-5)
    assert b.cost == pytest.approx(a.cost, abs=1e-3)         # 1e-6 and 1e6 cancel


@pytest.mark.parametrize('poles', [[-2.0, -2.0], [-2.0, -2.0, -2.0], [0.0, -1.0], [3.0, -1.0],
                                   [-1e-9, -1e6], [-1 + 1e-9j, -1 - 1e-9j]])
def test_odd_poles_are_no_trouble(poles):
    oe = OutputError(projection(PLANTS['hd51'], 20), True)
    for steps in (0, 20):
        found = oe.fit(np.array(poles, dtype=complex), steps)
        assert np.isfinite(found.cost)
        assert np.isfinite(found.poles).all()
        assert len(found.poles) == len(poles)
