# SPDX-License-Identifier: Apache-2.0
"""Robots whose axes are alike: one pole, or pair, as often as there are axes."""

from __future__ import annotations

from marks import slow
import numpy as np
import pytest

from ctsid_core import Grade, Record, Settings, identify
from ctsid_core.likelihood.modal_model import PoleSteps
from ctsid_core.likelihood.output_error import Free, climb_roughly, fit_at, jacobian
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.model.gains import gains
from ctsid_core.search.by_order import _of_more_ranks, parameters, tried
from ctsid_ros.studies.robots.experiment import stamps
from ctsid_ros.studies.robots.inputs import drive
from ctsid_ros.studies.robots.linear import Held, Linear
from ctsid_ros.studies.robots.linear_families import pair

LAG, SERVO, WHEEL = (-3.0,), pair(8.0, 0.6), (-4.0, -25.0)
LATE = 0.06           # [s]


def axes(roots: tuple[complex, ...], count: int = 3, coupled: float = 0.1) -> Linear:
    """So many axes of the same poles, every input moving all of them a little."""
    own = Linear.of_roots(1.0, roots, LATE)
    each = np.eye(count)
    mixed = each + coupled * np.random.default_rng(3).uniform(-1.0, 1.0, each.shape)
    return Linear(np.kron(each, own.A), np.kron(each, own.B) @ mixed, np.kron(each, own.C), LATE)


def flown(plant: Linear, kind: str, rng: np.random.Generator, noise: float) -> Record:
    """An experiment of 12 s, inputs at 50 Hz, outputs at 80 Hz."""
    time, times = stamps(rng, -0.5, 12.0, 50.0), stamps(rng, 0.0, 12.0, 80.0)
    moved = Held(time, drive(kind, rng, time, 12.0, 2.0, plant.nu))
    y = plant.move(moved, times)
    return Record.from_arrays(time, moved.values, times, y + noise * y.std(axis=0)
                              * rng.standard_normal(y.shape), input_hold='zoh')


@pytest.mark.parametrize(('roots', 'kind', 'seed'), [
    (LAG, 'step', 1), *slow(
        (LAG, 'prbs', 2), (LAG, 'doublets', 3), (SERVO, 'step', 2), (SERVO, 'doublets', 3),
        (SERVO, 'prbs', 4), (SERVO, 'multisine', 1), (WHEEL, 'prbs', 1), (WHEEL, 'pilot', 2))])
def test_every_axis_is_found_and_the_model_is_good(roots, kind, seed):
    rng, plant = np.random.default_rng(seed), axes(roots)
    found = identify(flown(plant, kind, rng, 0.03))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.n == len(plant.A)
    omega = np.array([1.0, 3.0, 8.0])
    truth = plant.response(omega)
    off = np.linalg.norm(found.model.frequency_response(omega) - truth, axis=(1, 2))
    assert np.all(off < 0.1 * np.linalg.norm(truth, axis=(1, 2)))


def test_an_order_starts_from_one_rank_more_of_a_pole_that_is_there():
    """What is one pole, a step apart from it leads elsewhere."""
    poles = np.array([-5.0, -3.0 + 4.0j, -3.0 + 4.0j])
    samples = samples_of([flown(axes(LAG), 'prbs', np.random.default_rng(5), 0.03)], [[None]])
    free = Free(False, True, (False,) * 3, 1.0, -1e-6, 100.0)
    found = {5: tried(samples, fit_at(samples, poles, np.zeros(3), free), free)}
    assert [pole for _, pole in _of_more_ranks(6, found, 3)] == [-5.0]
    assert [pole for _, pole in _of_more_ranks(7, found, 3)] == [-3.0 + 4.0j]
    assert not list(_of_more_ranks(7, found, 2))


def test_one_pole_of_several_ranks_tells_all_axes():
    plant = axes(SERVO)
    samples = samples_of([flown(plant, 'prbs', np.random.default_rng(5), 0.03)], [[None]])
    free = Free(False, True, (True,) * 3, 1.0, -1e-6, 100.0)
    start = fit_at(samples, np.repeat([5.0j - 3.0], 3), np.full(3, 0.02), free)
    found = climb_roughly(samples, start, free)
    assert len(set(found.model.poles.tolist())) == 1
    assert abs(found.model.poles[0] - SERVO[0]) < 0.02 * 8.0
    np.testing.assert_allclose(found.model.delay, LATE, atol=0.01)
    np.testing.assert_allclose(np.sqrt(found.power), 0.03, rtol=0.1)


@pytest.mark.parametrize('feedthrough', [False, True])
@pytest.mark.parametrize('ranks', [(1, 2), *slow(((2, 2),), ((2, 1),))])
def test_slopes_are_those_of_the_cost(feedthrough, ranks):
    """Of poles that are there twice and once: a step moves all of a pole."""
    plant = axes(SERVO, 2)
    samples = samples_of([flown(plant, 'multisine', np.random.default_rng(6), 0.1)], [[None]])
    free = Free(feedthrough, True, (True, True), 1.0, -1e-6, 100.0)
    poles, delay = np.repeat([-2.0, 6.0j - 4.0], ranks), np.array([0.031, 0.052])

    def best(moved, late):
        fit = fit_at(samples, moved, late, free)
        for _ in range(40):                      # b and c, one after the other
            fit = fit_at(samples, moved, late, free, fit)
        return fit
    steps, small, slopes = PoleSteps.of(poles, 1.0 / samples.length, 2), 1e-4, []
    rows, error, _ = jacobian(samples, best(poles, delay), free)
    gradient = rows.T @ error
    for k in range(3):
        ahead, behind = (best(steps.moved(s * np.eye(3)[k], free.limit, free.fastest)[0],
                              delay).cost for s in (small, -small))
        slopes.append((ahead - behind) / (2.0 * small))
    np.testing.assert_allclose(slopes, -2.0 * gradient[:3], rtol=1e-3)
    if not feedthrough:                 # D jumps where an input does
        for k in range(2):
            ahead, behind = (best(poles, delay + s * np.eye(2)[k]).cost for s in (small, -small))
            assert (ahead - behind) / (2.0 * small) == pytest.approx(
                -2.0 * gradient[3 + k], rel=0.02)


@pytest.mark.parametrize('ranks', [(1, 1), (2, 1), (1, 2), (3, 2)])
def test_a_model_has_as_many_numbers_as_directions_that_change_it(ranks):
    plant = axes(SERVO)
    samples = samples_of([flown(plant, 'prbs', np.random.default_rng(7), 0.1)], [[None]])
    free = Free(False, True, (True,) * 3, 1.0, -1e-6, 100.0)
    fit = fit_at(samples, np.repeat([-2.0, 7.0j - 4.0], ranks), np.full(3, 0.05), free)
    rows, _, _ = jacobian(samples, fit, free)
    s = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), compute_uv=False)
    assert np.sum(s > 1e-9 * s[0]) == parameters(samples, fit, free)


def test_twin_integrators_have_rates_and_deviations():
    """Poles that are alike, and nobody tells from 0: none is known exactly, each has a rate."""
    rng, h = np.random.default_rng(300), 0.01
    u = np.repeat(rng.choice([-1.0, 1.0], (300, 2)), 10, axis=0)
    y = 2.0 * h * np.vstack((np.zeros(2), np.cumsum(u, axis=0)[:-1]))
    record = Record.from_arrays(h * np.arange(3000), u, h * np.arange(3000),
                                y + 0.02 * rng.standard_normal(y.shape), input_hold='zoh')
    found = identify(record, Settings(feedthrough=False))
    assert found.good
    assert np.all(found.pole_std > 1e-5)
    rates = gains(found.model, found.covariance)
    assert rates.rate[0, 0]
    assert rates.rate[1, 1]
    np.testing.assert_allclose(rates.value, 2.0 * np.eye(2), atol=0.01)


def test_modes_keep_their_residues_where_poles_pass_each_other():
    poles = np.array([-2.0, -3.0, -4.0 + 1.0j])
    moved, modes = PoleSteps.of(poles, 0.1, 4).moved(np.array([0.0, 0.0, 0.0, -0.9]), -1e-6, 100.0)
    assert modes.tolist() == [1, 0, 2]
    np.testing.assert_allclose(moved[:2], [-3.0, -3.8])
