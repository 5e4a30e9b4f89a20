# SPDX-License-Identifier: Apache-2.0
"""The subspace method of generalized orthonormal bases against the truth."""

from __future__ import annotations

import csv
from xml.etree import ElementTree

from marks import slow
import numpy as np
import pytest

from ctsid_core.bases.takenaka_malmquist import chain
from ctsid_core.errors import SettingsError
from ctsid_core.identify import identify
from ctsid_core.likelihood.output_error import Free, fit_at
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.likelihood.state_space import matrices_of
from ctsid_core.model.simulation import input_polynomials
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_core.subspace.gobf import (
    dynamics,
    filter_records,
    integrated,
    interpolation_errors,
    observe,
)
from ctsid_ros.studies import takenaka_malmquist as study
from ctsid_ros.studies.experiments import flexible, from_rest, quadrotor, running
from ctsid_ros.studies.filtered_inputs import realised
from ctsid_ros.studies.local_polynomials import derivatives, local_polynomials
from ctsid_ros.studies.robots import families as robots

SEQUENCES = {
    'spread': np.linspace(1.0, 15.0, 8), 'laguerre': np.full(8, 6.0),
    'pairs': np.array([2 + 6j, 2 - 6j, 3.0, 4 + 2j, 4 - 2j, 5 + 9j, 5 - 9j, 9.0])}
PLANT = StateSpace([[-1.0, 2.0, 0.0], [-2.0, -1.0, 0.5], [0.0, 0.0, -4.0]],
                   [[1.0, 0.0], [0.5, 1.0], [2.0, -1.0]],
                   [[1.0, 0.0, 1.0], [0.0, 1.0, -0.5]], [[0.0, 0.3], [0.2, 0.0]],
                   x_trim=[0.4, -0.2, 0.1], y_trim=[2.0, -1.0])
OMEGA = np.geomspace(0.1, 30.0, 40)


def record(hold: str, *, jitter: float = 0.4, seed: int = 1, plant: StateSpace = PLANT) -> Record:
    """Return a noise-free record that does not start at rest, each signal at stamps of its own."""
    rng = np.random.default_rng(seed)
    t_u = 0.02 * (np.arange(401) + jitter * rng.uniform(-0.5, 0.5, 401))
    t_y = 0.01 * (np.arange(801) + jitter * rng.uniform(-0.5, 0.5, 801))
    u = np.cumsum(rng.standard_normal((401, plant.nu)), axis=0) * 0.2
    u -= np.linspace(0, 1, 401)[:, np.newaxis] * u[-1]
    signal = Signal(t_u, u, hold)
    start = min(t_u[0], t_y[0])
    y = plant.simulate((signal,), np.concatenate(([start], t_y)), rng.standard_normal(plant.n))
    return Record.from_arrays(t_u, u, t_y, y[1:], input_hold=hold)


def worst(found: StateSpace, truth: StateSpace) -> float:
    G = truth.frequency_response(OMEGA)
    return float(np.max(np.abs(found.frequency_response(OMEGA) - G)) / np.max(np.abs(G)))


def simulating(own: Record, poles: np.ndarray) -> StateSpace:
    """Return the model of given poles that simulates best."""
    samples = samples_of([own], [[None]])
    fit = fit_at(samples, poles.astype(complex), np.zeros(2),
                 Free(True, True, (False, False), 0.0, np.inf, np.inf))
    m = matrices_of(fit.model, samples.size)
    return StateSpace(m.A, m.B, m.C, m.D)


def observability(sigma, plant: StateSpace) -> np.ndarray:
    """[TM] eq. 10, with the conjugates."""
    n, blocks, before = plant.n, [], np.eye(plant.n)
    for pole in sigma:
        inverse = np.linalg.inv(plant.A + pole * np.eye(n))
        blocks.append(np.sqrt(2.0 * pole.real) * plant.C @ inverse @ before)
        before = before @ (plant.A - np.conj(pole) * np.eye(n)) @ inverse
    return np.array(blocks)                                    # (N, ny, n)


@pytest.mark.parametrize('name', SEQUENCES)
def test_dynamics_of_exact_observability(name):
    """Eq. 11 to 14 as corrected, whatever the states are."""
    basis = chain(SEQUENCES[name])
    seen = observability(basis.poles, PLANT)
    real = np.tensordot(basis.turn.conj().T, seen, axes=1)
    assert np.abs(real.imag).max() < 1e-12
    theta = real.real.reshape(-1, PLANT.n)
    T = np.random.default_rng(0).standard_normal((3, 3))
    for change in (np.eye(3), T):
        A, C = dynamics(basis, theta @ change)
        np.testing.assert_allclose(change @ A, PLANT.A @ change, atol=1e-9)
        np.testing.assert_allclose(C, PLANT.C @ change, atol=1e-9)


def test_regressors_of_the_paper_are_dependent():
    """N (N + 1) / 2 functions psi_(j,i+1) M_i of eq. 6 span N dimensions: those of the chain."""
    sigma, s = np.linspace(4.0, 60.0, 6), 1j * np.geomspace(0.1, 300.0, 200)
    rows = []
    for i in range(6):
        f = np.sqrt(2 * sigma[i]) / (s + sigma[i])
        for j in range(i, 6):
            f = f if j == i else f * (s - sigma[j]) / (s + sigma[j])
            rows.append(f)
    values = np.linalg.svd(np.hstack((np.real(rows), np.imag(rows))), compute_uv=False)
    assert len(rows) == 21
    assert values[5] > 1e-4 * values[0]
    assert values[6] < 1e-12 * values[0]


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
@pytest.mark.parametrize('name', SEQUENCES)
def test_noise_free_irregular_and_of_several_signals(name, hold):
    own = record(hold)
    filtered = filter_records([own], chain(SEQUENCES[name]), (0.0, 0.0), trim=True)
    seen = observe(filtered, 1e-10)
    found = realised(filtered, 3, feedthrough=True, rank_tolerance=1e-10)
    # Of smooth signals a spline of the output is not the output, if only by little.
    poles = np.linalg.eigvals(found.A)
    far = np.abs(poles[:, np.newaxis] - PLANT.poles).min(axis=0) / np.abs(PLANT.poles)
    assert far.max() < (1e-3 if hold == 'smooth' else 3e-6)
    assert seen.singular_values[3] / seen.singular_values[2] < (
        1e-2 if hold == 'smooth' else 1e-4)
    assert worst(simulating(own, poles), PLANT) < (1e-3 if hold == 'smooth' else 1e-5)


@pytest.mark.parametrize('hold', ['zoh', 'linear'])
def test_inputs_by_equation_15(hold):
    filtered = filter_records([record(hold)], chain(SEQUENCES['pairs']), (0.0, 0.0), trim=True)
    found = realised(filtered, 3, feedthrough=True, rank_tolerance=1e-10)
    assert worst(StateSpace(found.A, found.B, found.C, found.D), PLANT) < 1e-3


def test_kinks_matter():
    own = record('zoh')
    errors = []
    for kinks in (0, 1, 2):
        filtered = filter_records([own], chain(SEQUENCES['spread']), (0.0, 0.0), trim=True,
                                  kinks=kinks)
        A, _ = dynamics(filtered.chain, observe(filtered, 1e-10).left[:, :3])
        poles = np.linalg.eigvals(A)
        errors.append(np.abs(np.sort_complex(poles) - np.sort_complex(PLANT.poles)).max())
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 0.1 * errors[1]


def test_what_is_missed_is_what_interpolation_misses():
    """Of an output that is the integral of a held input, known by a dense sampling."""
    rng = np.random.default_rng(2)
    t = np.linspace(0.0, 1.0, 21)
    u = Signal(t, rng.standard_normal((21, 1)), 'zoh')
    knots = np.unique(np.concatenate((t, np.linspace(0.0, 1.0, 201))))
    parts = input_polynomials((u,), (0.0,), knots)
    y = integrated(parts, knots)[0]
    stamps = knots[::7]
    sampled = Signal(stamps, y[::7], 'smooth')
    missed = interpolation_errors(parts, knots, (sampled,), input_polynomials, 1, 1)
    curve = input_polynomials((sampled,), (0.0,), knots)
    inside = knots < stamps[-1]
    np.testing.assert_allclose(missed[0, inside, 0], (y - curve[0])[inside, 0], atol=1e-12)
    assert np.abs(missed).max() > 1e-4


def test_local_polynomials_are_exact_for_polynomials():
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(0.0, 2.0, 30))
    own = np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0])
    knots = np.sort(np.concatenate((t, rng.uniform(t[0], t[-1], 50))))[:-1]
    found = derivatives(t, own(t), 3, knots)
    for j in range(4):
        np.testing.assert_allclose(found[j], own.deriv(j)(knots) if j else own(knots), rtol=1e-6,
                                   atol=1e-7)


def test_local_polynomials_of_the_paper_on_irregular_stamps():
    own = record('smooth')
    filtered = filter_records([own], chain(SEQUENCES['spread']), (0.0, 0.0), trim=True,
                              pieces=local_polynomials(3))
    found = realised(filtered, 3, feedthrough=True, rank_tolerance=1e-10)
    np.testing.assert_allclose(StateSpace(found.A, found.B, found.C).poles, PLANT.poles, rtol=0.03)


def test_simulations_give_the_inputs_and_outputs_of_the_truth():
    own = record('zoh')
    assert worst(simulating(own, PLANT.poles), PLANT) < 1e-7


def test_identify_noise_free():
    found = identify(record('zoh'), Settings(method='gobf', order=3, delay=0.0))
    model = found.model or found.rejected_model
    np.testing.assert_allclose(model.poles, PLANT.poles, rtol=1e-3)
    assert worst(model, PLANT) < 1e-3


@pytest.mark.parametrize(('plant', 'order'), [(flexible(0.05), 6), *slow((quadrotor(), 3))])
def test_identify_finds_order_and_poles_of_noisy_data(plant, order):
    own = running(0, 20.0, plant).record
    found = identify(own, Settings(method='gobf'))
    assert found.good
    assert found.model.n == order
    error = np.abs(found.model.poles - plant.poles)
    assert (error < 4.0 * found.pole_std).all()
    again = identify(own, found.settings)
    np.testing.assert_array_equal(again.model.A, found.model.A)


@pytest.mark.slow
def test_fits_noisy_outputs_as_well_as_the_likeliest_model():
    """Residues of rank one are not the best B and C: without the turns 0.3 % of a fit is lost."""
    own = from_rest(1, 20.0).record
    found, likeliest = (identify(own, Settings(method=name, order=3))
                        for name in ('gobf', 'hd-pbsid'))
    assert (found.fit > likeliest.fit - 0.1).all()


def test_identify_with_given_pairs_and_two_records():
    settings = Settings(method='gobf', order=3, delay=0.0,
                        tm_real=tuple(SEQUENCES['pairs'].real.tolist()),
                        tm_imag=tuple(SEQUENCES['pairs'].imag.tolist()))
    found = identify([record('zoh'), record('zoh', seed=5)], settings)
    model = found.model or found.rejected_model
    np.testing.assert_allclose(model.poles, PLANT.poles, rtol=1e-3)


def test_wrong_settings():
    own = record('zoh')
    with pytest.raises(SettingsError, match='one for each pole'):
        identify(own, Settings(method='gobf', tm_real=(1.0, 2.0), tm_imag=(1.0,)))
    with pytest.raises(SettingsError, match='conjugate'):
        identify(own, Settings(method='gobf', tm_real=(1.0, 2.0), tm_imag=(1.0, 0.0)))


def median_errors(folder, seeds):
    """Run the study and return the median errors of its table by estimate and way."""
    assert study.main(['--seeds', str(seeds), '--jobs', '1', '--out', str(folder)]) == 0
    with (folder / 'tm.csv').open(encoding='utf-8') as stream:
        return {(row['estimate'], row['between samples']): float(row['median error'])
                for row in csv.DictReader(stream)}


@pytest.mark.slow
def test_example_of_the_paper(tmp_path):
    own = median_errors(tmp_path, 1)
    assert own[study.SPREAD, 'kinks'] < 1e-5
    assert own['gobf', 'order given'] < 1e-3
    with (tmp_path / 'runs.csv').open(encoding='utf-8') as stream:
        assert len(list(csv.reader(stream))) == 1 + len(study.tasks())
    for name in ('tm_figure_1', 'tm_figure_2', 'tm_figure_3_kinks', 'tm_figure_4_published'):
        ElementTree.parse(tmp_path / f'{name}.svg')


@pytest.mark.slow
def test_example_of_the_paper_over_20_seeds(tmp_path):
    own = median_errors(tmp_path, 20)
    assert all(own[study.SPREAD, 'kinks'] < own[name, 'kinks']
               for name in study.SEQUENCES if name != study.SPREAD)


def test_a_part_held_out_is_tested_if_any_tuning_has_a_model_of_the_rest():
    """Chains with the poles of the whole have models that explode there."""
    found = identify(robots.experiment('receipt-stamps', 21, 0).record, Settings(method='gobf'))
    assert np.isfinite(found.verdict.held_out_error).all()
