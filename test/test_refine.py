# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
from plants import PLANTS, flown, match, plant, random_plant, running
import pytest
from scipy.optimize import least_squares

from ctsid_core import Settings
from ctsid_core.bases.hermite import project_record
from ctsid_core.bases.projection import as_real
from ctsid_core.likelihood import information as deviation_of
from ctsid_core.likelihood.information import pole_deviation
from ctsid_core.likelihood.prediction_errors import (
    innovation_cost,
    jacobian,
    line_fit,
    output_error_cost,
    prediction_errors,
    simulate_lines,
)
from ctsid_core.likelihood.refine import (
    realise_poles,
    refine_innovation,
    refine_output_error,
)
from ctsid_core.likelihood.simulation_of_poles import OutputError
from ctsid_core.search.order import Search
from ctsid_core.search.selection import most_likely
from ctsid_core.subspace.pbsid_equations import Tuning, realise, regress, stack_levels

NOISY = Settings(feedthrough=False)


def window(p, snr=20, seed=0, *, nmax=150, settings=None):
    rng = np.random.default_rng(seed)
    record = running(rng, p, snr, rate=200.0, band=5.0)
    return project_record(record, settings or Settings(), nmax)


def subspace_model(lines, n, *, feedthrough=True, beta=8.0, past=4):
    levels = stack_levels(lines, beta, 4.0 * beta, past + 1)
    return realise(regress(levels, Tuning(beta, 4.0 * beta, past, past),
                           feedthrough=feedthrough, rank_tolerance=1e-10), n)


def poles(m) -> np.ndarray:
    return np.linalg.eigvals(m.A)


def in_other_states(m, T):
    inverse = np.linalg.inv(T)
    return replace(m, A=T @ m.A @ inverse, C=m.C @ inverse,
                   **{name: T @ getattr(m, name) for name in ('B', 'K', 'tail', 'x_trim')})


@pytest.mark.parametrize('snr', [40, 20, 6])
@pytest.mark.parametrize('name', ['hd51', 'hd52', 'flexible'])
def test_refinement_never_makes_a_model_less_likely(name, snr):
    p = PLANTS[name]
    lines, n = window(p, snr, nmax=300 if name == 'flexible' else 150), len(p.A)
    start = subspace_model(lines, n, beta=20.0)
    costs = [output_error_cost(lines, replace(start, K=0.0 * start.K))]
    for steps in (1, 2, 5, 10):
        model, cost = refine_output_error(lines, start, True, steps=steps)
        assert cost == pytest.approx(output_error_cost(lines, model), rel=1e-12)
        assert not model.K.any()
        costs.append(cost)
    assert (np.diff(costs) <= 0.0).all()
    assert costs[-1] < costs[0] - 1.0


@pytest.mark.parametrize('scale', [0.02, 0.2, 1.0])
def test_bad_starts_do_not_end_worse_than_they_began(scale):
    lines = window(PLANTS['hd52'])
    start = subspace_model(lines, 3)
    rng = np.random.default_rng(1)
    for _ in range(2):
        bad = replace(start, **{k: getattr(start, k) * (1.0 + scale * rng.standard_normal(
            getattr(start, k).shape)) for k in ('A', 'B', 'C', 'D', 'tail')})
        cost = output_error_cost(lines, replace(bad, K=0.0 * bad.K))
        assert refine_output_error(lines, bad, True)[1] <= cost
        assert refine_innovation(lines, bad, True)[1] <= innovation_cost(lines, bad)


def test_the_optimum_is_stationary():
    """No direction is left along which the whitened errors would fall."""
    lines = window(PLANTS['hd52'])
    model, cost = refine_output_error(lines, subspace_model(lines, 3), True, steps=40)
    error = as_real(prediction_errors(lines, model))
    size = np.sqrt(np.mean(error ** 2, axis=1))
    columns = jacobian(lines, model, True, with_noise=False) / size[:, np.newaxis, np.newaxis]
    columns = columns.reshape(-1, columns.shape[2])
    norm = np.linalg.norm(columns, axis=0)
    slope = (error / size[:, np.newaxis]).ravel() @ columns[:, norm > 0.0] / norm[norm > 0.0]
    assert np.abs(slope).max() < 0.2                 # in standard deviations of each entry
    rng = np.random.default_rng(0)
    for name in ('A', 'B', 'C', 'D'):
        moved = getattr(model, name) * (1.0 + 0.01 * rng.standard_normal(
            getattr(model, name).shape))
        assert output_error_cost(lines, replace(model, **{name: moved})) > cost - 2e-2


@pytest.mark.parametrize('snr', [20, 50])
def test_the_poles_do_not_depend_on_the_realisation(snr):
    lines = window(PLANTS['hd52'], snr)
    start = subspace_model(lines, 3)
    rng = np.random.default_rng(2)
    plain, cost = refine_output_error(lines, start, True)
    for _ in range(3):
        T = rng.standard_normal((3, 3)) * 10.0 ** rng.uniform(-1.0, 1.0, (3, 1))
        other, same = refine_output_error(lines, in_other_states(start, T), True)
        assert same == pytest.approx(cost, abs=2e-2)
        deviation = pole_deviation(lines, plain, True).min()
        np.testing.assert_allclose(match(poles(other), poles(plain)), poles(plain),
                                   rtol=0, atol=0.05 * deviation)


def test_the_innovation_form_does_not_depend_on_the_realisation():
    lines = project_record(flown(np.random.default_rng(0), q=0.2), NOISY, 250)
    start = subspace_model(lines, 2, feedthrough=False)
    plain, cost = refine_innovation(lines, start, False)
    other, same = refine_innovation(lines, in_other_states(
        start, np.array([[3.0, 1.0], [-0.2, 0.5]])), False)
    assert same == pytest.approx(cost, abs=5e-2)
    np.testing.assert_allclose(match(poles(other), poles(plain)), poles(plain), atol=5e-3)


def test_one_output_leads_to_the_optimum_over_the_poles():
    """With one output every residue is of rank one: both likelihoods have the same maximum."""
    for seed in range(3):
        p = random_plant(np.random.default_rng(seed), 3, 1, 1)
        lines = window(p, 25, seed)
        over_poles = OutputError(lines, True).fit(p.poles.astype(complex), 40)
        model, cost = refine_output_error(lines, realise_poles(lines, over_poles.poles, True),
                                          True, steps=30)
        assert cost == pytest.approx(over_poles.cost, abs=2e-2)
        np.testing.assert_allclose(match(poles(model), over_poles.poles), over_poles.poles,
                                   rtol=5e-3)


@pytest.mark.parametrize('feedthrough', [True, False])
def test_true_poles_realise_the_plant(feedthrough):
    for seed, shape in enumerate([(1, 1, 1), (3, 2, 3), (4, 1, 2), (5, 3, 1)]):
        p = random_plant(np.random.default_rng(seed), *shape, feedthrough=feedthrough)
        lines = window(p, None, seed, settings=Settings(edge_margin=10.0))
        m = realise_poles(lines, p.poles.astype(complex), feedthrough)
        np.testing.assert_allclose(match(poles(m), p.poles), p.poles, rtol=1e-12)
        error = np.abs(simulate_lines(lines, m) - lines.y).max()
        assert error < 1e-6 * np.abs(lines.y).max()
        for w in (0.5, 3.0, 20.0):
            wanted, got = (M.C @ np.linalg.solve(1j * w * np.eye(len(M.A)) - M.A, M.B) + M.D
                           for M in (p, m))
            np.testing.assert_allclose(got, wanted, atol=1e-5 * np.abs(wanted).max())


def test_units_of_the_channels_do_not_matter():
    lines = window(PLANTS['hd52'], 20)
    big = np.array([[1e6], [1e-6], [1.0], [1e3]])
    scaled = replace(lines, u=1e-6 * lines.u, y=big * lines.y)
    a, cost = refine_output_error(lines, subspace_model(lines, 3), True)
    b, _ = refine_output_error(scaled, subspace_model(scaled, 3), True)
    np.testing.assert_allclose(match(poles(b), poles(a)), poles(a), rtol=1e-3)
    np.testing.assert_allclose(pole_deviation(scaled, b, True), pole_deviation(lines, a, True),
                               rtol=1e-2)


def test_without_feedthrough_d_stays_zero():
    lines = window(PLANTS['hd51'])
    start = subspace_model(lines, 2, feedthrough=False)
    for model, _ in (refine_output_error(lines, start, False),
                     refine_innovation(lines, start, False)):
        assert not model.D.any()
        assert model.y_trim.any()


def test_no_pole_crosses_the_limit():
    lines = window(PLANTS['hd51'])
    start = realise_poles(lines, np.array([-3.5, -6.0], dtype=complex), True)
    for refine in (refine_output_error, refine_innovation):
        model, _ = refine(lines, start, True, limit=-3.0)
        assert poles(model).real.max() <= -3.0
    free, _ = refine_output_error(lines, start, True)
    np.testing.assert_allclose(match(poles(free), [-2, -4]), [-2, -4], atol=0.5)


def test_process_noise_needs_the_innovation_form():
    """At the same data: output error is off by its wrong noise model, the innovation form not."""
    errors = {'output error': [], 'innovation': []}
    for seed in range(6):
        lines = project_record(flown(np.random.default_rng(seed), q=0.2), NOISY, 250)
        start = subspace_model(lines, 2, feedthrough=False)
        for name, refine in (('output error', refine_output_error),
                             ('innovation', refine_innovation)):
            errors[name].append(match(poles(refine(lines, start, False)[0]), [2, -3]) - [2, -3])
    spread = {name: np.sqrt(np.mean(np.abs(e) ** 2)) for name, e in errors.items()}
    assert spread['innovation'] < 0.15
    assert spread['innovation'] < 0.85 * spread['output error']


def test_an_inadmissible_start_is_returned_as_it_is():
    lines = window(PLANTS['hd51'])
    start = subspace_model(lines, 2)
    unstable = replace(start, A=start.A + 20.0 * np.eye(2), K=0.0 * start.K)
    model, cost = refine_innovation(lines, unstable, True)
    assert cost == np.inf
    assert model is unstable


def test_the_gain_can_be_refined_with_the_plant_held():
    lines = project_record(flown(np.random.default_rng(3), q=0.2), NOISY, 250)
    start = subspace_model(lines, 2, feedthrough=False)
    model, cost = refine_innovation(lines, start, False, plant=False)
    assert cost < innovation_cost(lines, start)
    for name in ('A', 'B', 'C', 'D', 'x_trim', 'y_trim'):
        np.testing.assert_array_equal(getattr(model, name), getattr(start, name), err_msg=name)
    assert (model.K != start.K).all()


@pytest.mark.parametrize('name', ['hd51', 'hd52', 'flexible'])
def test_the_most_likely_model_of_clean_plants(name):
    p = PLANTS[name]
    lines = window(p, 40, nmax=300 if name == 'flexible' else 150)
    pair = Search(lines, Settings()).pair(len(p.A))
    model, process_noise = most_likely(lines, pair, Settings())
    assert not process_noise
    found = match(poles(model), p.poles)
    deviation = pole_deviation(lines, model, True)
    aligned = [deviation[np.argmin(np.abs(poles(model) - f))] for f in found]
    assert (np.abs(found - p.poles) < 4.0 * np.array(aligned)).all()
    assert line_fit(lines, model).min() > 90.0


def test_without_refinement_the_subspace_model_is_returned():
    lines = window(PLANTS['hd51'])
    settings = Settings(refine=False)
    pair = Search(lines, settings).pair(2)
    assert most_likely(lines, pair, settings) == (pair.best.matrices, pair.process_noise)


@pytest.mark.parametrize('q', [0.0, 0.2])
def test_an_unstable_plant_gets_a_stable_predictor(q):
    lines = project_record(flown(np.random.default_rng(4), q), NOISY, 250)
    model, process_noise = most_likely(lines, Search(lines, NOISY).pair(2), NOISY)
    assert process_noise == (q > 0.0)
    np.testing.assert_allclose(match(poles(model), [2, -3]), [2, -3], atol=0.3)
    assert np.linalg.eigvals(model.A - model.K @ model.C).real.max() < 0.0


def fisher(lines, start, *, feedthrough=True) -> np.ndarray:
    """
    Standard deviation of |pole error|, from differences of partial fractions (one output).

    Nothing is shared with the tested code: parameters are the poles and all linear weights.
    """
    z, pairs = np.vstack((lines.u, lines.tail)), start[start.imag > 0.0]
    real = start[start.imag == 0.0].real
    direct = np.vstack((lines.ones, lines.u)) if feedthrough else lines.ones

    def rows(v):
        blocks = [z / (lines.s - r) for r in v[2 * len(pairs):]]
        for re, im in v[:2 * len(pairs)].reshape(-1, 2):
            one, other = (1.0 / (lines.s - complex(re, sign * im)) for sign in (1, -1))
            blocks += [z * (one + other), z * (1j * (one - other))]
        return as_real(np.vstack((*blocks, direct)))

    y = as_real(lines.y)[0]

    def residual(v):
        X = rows(v)
        return y - X.T @ np.linalg.lstsq(X.T, y, rcond=None)[0]

    v0 = np.concatenate((np.column_stack((pairs.real, pairs.imag)).ravel(), real))
    v = least_squares(residual, v0, xtol=1e-14, ftol=1e-14).x
    X = rows(v)
    weights = np.linalg.lstsq(X.T, y, rcond=None)[0]
    slopes = [(rows(v + d).T - rows(v - d).T) @ weights / 2e-5
              for d in 1e-5 * np.eye(len(v))]
    J = np.column_stack((*slopes, X.T))
    free = len(y) - J.shape[1]
    covariance = np.linalg.inv(J.T @ J) * np.sum(residual(v) ** 2) / free
    variance = np.diag(covariance)[:len(v)]
    of_pairs = variance[:2 * len(pairs)].reshape(-1, 2).sum(axis=1)
    return np.sqrt(np.concatenate((of_pairs, variance[2 * len(pairs):])))


@pytest.mark.parametrize('n', [1, 2, 3, 4])
def test_the_deviation_of_the_poles_is_that_of_the_fisher_information(n, monkeypatch):
    """Residuals' power smoothed over all lines: as if it were known that they are white."""
    monkeypatch.setattr(deviation_of, '_WIDTHS', ())
    p = random_plant(np.random.default_rng(n), n, 1, 1)
    lines = window(p, 20, n)
    model, _ = refine_output_error(lines, subspace_model(lines, n, past=n + 1), True, steps=40)
    found = poles(model)
    deviation = pole_deviation(lines, model, True)
    assert deviation.shape == (n,)
    upper = np.concatenate((found[found.imag > 0.0], found[found.imag == 0.0]))
    mine = [deviation[np.argmin(np.abs(found - f))] for f in upper]
    # What is counted as a parameter differs by the trim of the states (3 % at most here), and
    # what the fit has taken out of the residuals is put back line by line.
    np.testing.assert_allclose(mine, fisher(lines, upper.astype(complex)), rtol=0.06)
    for f, d in zip(found, deviation, strict=True):
        assert d == pytest.approx(deviation[np.argmin(np.abs(found - f.conjugate()))], rel=1e-6)


def test_the_deviation_does_not_depend_on_the_realisation_and_scales_with_the_noise():
    p = PLANTS['hd52']
    found = {}
    for snr in (20, 40):
        lines = window(p, snr)
        model, _ = refine_output_error(lines, subspace_model(lines, 3), True)
        found[snr] = pole_deviation(lines, model, True)
        T = np.random.default_rng(5).standard_normal((3, 3))
        other = in_other_states(model, T)
        aligned = match(poles(other), poles(model))
        order = [np.argmin(np.abs(poles(other) - a)) for a in aligned]
        np.testing.assert_allclose(pole_deviation(lines, other, True)[order], found[snr],
                                   rtol=1e-4)
    np.testing.assert_allclose(found[20], 10.0 * found[40], rtol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(('name', 'snr'), [('hd51', 20), ('hd52', 20), ('hd52', 50),
                                           ('flexible', 20)])
def test_the_deviation_is_that_of_the_scatter(name, snr):
    """100 runs on the same input: scatter over claim, and how often two claims hold the truth."""
    p, n = PLANTS[name], len(PLANTS[name].A)
    errors, claims = [], []
    clean = running(np.random.default_rng(0), p, rate=200.0, band=12.0 if n == 6 else 5.0)
    signal = clean.outputs[0]
    for seed in range(100):
        rng = np.random.default_rng(seed)
        size = np.sqrt(np.mean(signal.values ** 2, axis=0) * 10 ** (-snr / 10))
        y = signal.values + size * rng.standard_normal(signal.values.shape)
        lines = project_record(replace(clean, outputs=(replace(signal, values=y),)), Settings(),
                               400 if n == 6 else 200)
        model, _ = most_likely(lines, Search(lines, Settings()).pair(n), Settings())
        found = match(poles(model), p.poles)
        deviation = pole_deviation(lines, model, True)
        errors.append(np.abs(found - p.poles))
        claims.append([deviation[np.argmin(np.abs(poles(model) - f))] for f in found])
    errors, claims = np.array(errors), np.array(claims)
    ratio = np.sqrt(np.mean(errors ** 2, axis=0)) / np.sqrt(np.mean(claims ** 2, axis=0))
    print(name, snr, 'scatter over claim', ratio.round(3))
    assert (0.8 < ratio).all()
    assert (ratio < 1.2).all()
    # A real pole's error is normal; of a pair's |error|^2 at least 95 % lies within 4 variances.
    held = np.mean(errors < 1.96 * claims, axis=0)
    print(name, snr, 'within 1.96 claims', held)
    assert (held >= 0.89).all()


@pytest.mark.slow
def test_the_deviation_is_that_of_the_scatter_with_process_noise():
    errors, claims = [], []
    for seed in range(100):
        lines = project_record(flown(np.random.default_rng(seed), q=0.2), NOISY, 250)
        model, noisy = most_likely(lines, Search(lines, NOISY).pair(2), NOISY)
        assert noisy
        found, deviation = match(poles(model), [2, -3]), pole_deviation(lines, model, False)
        errors.append(np.abs(found - [2, -3]))
        claims.append([deviation[np.argmin(np.abs(poles(model) - f))] for f in found])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(claims), axis=0))
    held = np.mean(np.array(errors) < 1.96 * np.array(claims), axis=0)
    print('process noise: scatter over claim', ratio.round(3), 'within 1.96 claims', held)
    assert (0.75 < ratio).all()
    assert (ratio < 1.3).all()


def test_a_model_that_leaves_nothing_has_a_finite_deviation():
    p = plant([[-2, 0], [0, -5]], [[1], [1]], [[1, 2]])
    lines = window(p, None)
    model, _ = refine_output_error(lines, subspace_model(lines, 2), True)
    deviation = pole_deviation(lines, model, True)
    assert np.isfinite(deviation).all()
    assert deviation.max() < 1e-3
