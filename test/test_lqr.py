# SPDX-License-Identifier: Apache-2.0
"""Gains against their laws and a rival; margins against what they promise."""

from __future__ import annotations

from dataclasses import replace
from time import thread_time

from marks import slow
import numpy as np
import pytest

from ctsid_core.errors import DataError
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Actuator
from ctsid_ros.examples import margins
from ctsid_ros.examples.lqr import Weights, compute_gains, design
from ctsid_ros.examples.margins import moved_matrices, moved_poles, worst_margin
from ctsid_ros.examples.quadrotor_roll import Plant

ROLL = Plant().true_model()
WEIGHTS = Weights(outputs=(1.0,), inputs=(0.1,))
SURE = 0.01 * abs(ROLL.poles)


def two_by_two(D: float = 0.0, delay: tuple[float, ...] = ()) -> tuple[StateSpace, Weights]:
    rng = np.random.default_rng(5)
    A = np.array([[0.3, 2, 0], [-2, 0.3, 0], [0, 0, -4]]) + 0.1 * rng.standard_normal((3, 3))
    model = StateSpace(
        A, rng.standard_normal((3, 2)), rng.standard_normal((2, 3)),
        D=D * rng.standard_normal((2, 2)), K=rng.standard_normal((3, 2)), delay=delay,
        noise=np.array([[0.02, 0.004], [0.004, 0.05]]))
    stable = compute_gains(replace(model, delay=()), Weights((1.0, 1.0), (1.0, 1.0))).observer
    return replace(model, K=stable), Weights((1.0, 3.0), (0.5, 2.0))


def disc_margin(model: StateSpace, gains, weights: Weights) -> float:
    return margins.disc_margin(model, gains.controller, np.array(weights.inputs),
                               np.array(weights.outputs))


def corners(model: StateSpace, pole_std: np.ndarray) -> list[StateSpace]:
    return [replace(model, A=A) for A in moved_matrices(model, moved_poles(model, pole_std))]


def closed_poles(model: StateSpace, gains) -> np.ndarray:
    own = gains.controller
    return np.linalg.eigvals(np.block([
        [model.A, model.B @ own.C],
        [own.B @ model.C, own.A + own.B @ model.D @ own.C]]))


def same_poles(left: np.ndarray, right: np.ndarray) -> None:
    for pole in right:
        assert np.min(abs(left - pole)) < 1e-6 * (1 + abs(pole))


def test_feedback_is_that_of_python_control():
    control = pytest.importorskip('control')
    model, weights = two_by_two(D=0.3)
    Q, R = np.diag([1.0, 1 / 9]), np.diag([4.0, 0.25])
    D, C = model.D, model.C
    wanted, _, poles = control.lqr(model.A, model.B, C.T @ Q @ C, R + D.T @ Q @ D, C.T @ Q @ D)
    gains = compute_gains(model, weights)
    np.testing.assert_allclose(gains.feedback, wanted, rtol=1e-8)
    same_poles(np.linalg.eigvals(model.A - model.B @ gains.feedback), poles)


@pytest.mark.parametrize('D', [0.0, 0.5])
def test_feedback_and_observer_keep_their_poles_together(D):
    """The separation principle; it fails if the observer forgets D."""
    model, weights = two_by_two(D)
    gains = compute_gains(model, weights)
    alone = np.concatenate([np.linalg.eigvals(model.A - model.B @ gains.feedback),
                            np.linalg.eigvals(model.A - gains.observer @ model.C)])
    same_poles(closed_poles(model, gains), alone)
    assert alone.real.max() < 0 < model.poles.real.max()


def test_observer_is_that_of_the_model_if_nothing_else_disturbs():
    np.testing.assert_allclose(
        compute_gains(ROLL, replace(WEIGHTS, disturbance=1e-9)).observer, ROLL.K,
        rtol=1e-5, atol=1e-9)
    assert np.linalg.norm(compute_gains(ROLL, WEIGHTS).observer) > 1.5 * np.linalg.norm(ROLL.K)


def test_controller_knows_the_trim():
    """Fed with what the plant puts out at rest under u = 0, its state comes to that of rest."""
    gains = compute_gains(ROLL, WEIGHTS)
    at_rest = -np.linalg.solve(ROLL.A, ROLL.x_trim)
    y = ROLL.C @ at_rest + ROLL.y_trim
    u = -gains.feedback @ at_rest
    drift = gains.controller.A @ at_rest + gains.controller.B @ y + gains.controller.x_trim
    np.testing.assert_allclose(drift, ROLL.B @ u, atol=1e-9)


@pytest.mark.parametrize('delay', [0.0, *slow(0.4)])
def test_disc_margin_is_the_smallest_destabilising_perturbation(delay):
    """f = (1 + m/2) / (1 - m/2) with complex m on the loop: the first |m| with 1 + f L = 0."""
    model, weights = replace(ROLL, delay=(delay,)), Weights((0.3,), (0.1,))
    gains = compute_gains(model, weights)
    omega = np.geomspace(1e-2, 1e4, 200_000)
    loop = -(gains.controller.frequency_response(omega) * model.frequency_response(omega))[:, 0, 0]
    wanted = np.min(abs(2 * (1 + loop) / (1 - loop)))
    assert disc_margin(model, gains, weights) == pytest.approx(wanted, rel=2e-3)


def test_disc_margin_of_several_axes_is_that_of_the_weaker_side():
    model, weights = two_by_two(0.2)
    gains = compute_gains(model, weights)
    omega = np.geomspace(1e-3, 1e3, 20_000)
    H = -gains.controller.frequency_response(omega)
    G = model.frequency_response(omega)
    sides = []
    for loop, size in ((H @ G, np.array(weights.inputs)), (G @ H, np.array(weights.outputs))):
        S = np.linalg.inv(np.eye(2) + loop / size[:, np.newaxis] * size)
        T = np.eye(2) - S
        sides.append(1 / np.linalg.svd((S - T) / 2, compute_uv=False).max())
    assert sides[0] != pytest.approx(sides[1], rel=0.01)
    assert disc_margin(model, gains, weights) == pytest.approx(min(sides), rel=1e-3)


def test_margin_bears_the_gains_it_promises():
    model, weights = two_by_two()
    gains = compute_gains(model, weights)
    m = disc_margin(model, gains, weights)
    assert 0.05 < m < 2
    for first in ((2 - m) / (2 + m), 1.0, (2 + m) / (2 - m)):
        for second in ((2 - m) / (2 + m), (2 + m) / (2 - m)):
            changed = replace(model, B=model.B * [1 + 0.999 * (first - 1),
                                                  1 + 0.999 * (second - 1)])
            assert closed_poles(changed, gains).real.max() < 0


def test_corners_move_the_poles_by_three_deviations():
    std = np.array([0.1, 0.5, 0.2, 0.2])
    found = corners(ROLL, std)
    assert len(found) == 3 * 3 * 5
    assert np.allclose(found[0].A, ROLL.A)
    assert sum(np.allclose(np.linalg.eigvals(m.A).imag.max(), ROLL.poles.imag.max(), rtol=1e-9)
               for m in found) == 27  # pairs that stay, or move along the real axis
    assert sum(np.min(abs(m.poles - ROLL.poles[3])) < 1e-6 for m in found) == 9
    for moved in found:
        gap = np.min(abs(ROLL.poles[:, np.newaxis] - moved.poles), axis=1)
        far = gap > 1e-6
        np.testing.assert_allclose(gap[far], 3 * std[far], rtol=1e-6)
        np.testing.assert_array_equal(moved.B, ROLL.B)
    reals = sorted({round(p.real, 3) for m in found for p in m.poles if abs(p.imag) < 1e-9})
    np.testing.assert_allclose(reals, [-21.5, -20, -18.5, -2.302, -2.002, -1.702], atol=2e-3)


def test_many_modes_are_tried_in_some_corners_only():
    many = StateSpace(np.diag(-np.arange(1.0, 13.0)), np.ones((12, 1)), np.ones((1, 12)))
    found = corners(many, 0.01 * np.ones(12))
    assert len(found) == 500
    assert np.allclose(found[0].A, many.A)
    assert np.allclose(found[7].A, corners(many, 0.01 * np.ones(12))[7].A)


@pytest.mark.parametrize('delay', [(), (0.01, 0.02)])
def test_the_worst_corner_is_that_of_all_margins_one_by_one(delay):
    model, weights = two_by_two(0.2, delay)
    gains = compute_gains(model, weights)
    poles = moved_poles(model, 0.002 * abs(model.poles))
    alone = [disc_margin(replace(model, A=A), gains, weights)
             for A in moved_matrices(model, poles)]
    assert len(alone) == 15
    corner, worst = worst_margin(model, poles, gains.controller, np.array(weights.inputs),
                                 np.array(weights.outputs))
    assert worst == pytest.approx(min(alone), rel=1e-6)
    assert alone[corner] == pytest.approx(min(alone), rel=1e-6)
    assert 0.0 < worst < 0.99 * alone[0]
    three = StateSpace(ROLL.A[:3, :3] - 30 * np.eye(3), np.eye(3), np.eye(3))
    own = compute_gains(three, Weights((1.0,) * 3, (1.0,) * 3))
    loop = -own.controller.frequency_response(np.geomspace(1e-2, 1e4, 20_000)) @ \
        three.frequency_response(np.geomspace(1e-2, 1e4, 20_000))
    half = np.linalg.inv(np.eye(3) + loop) - np.eye(3) / 2
    assert margins.disc_margin(three, own.controller, np.ones(3), np.ones(3)) == pytest.approx(
        1 / np.linalg.norm(half, 2, axis=(1, 2)).max(), rel=1e-3)


def test_poles_that_cannot_be_moved_one_by_one_are_refused():
    chain = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], noise=[[1e-4]])
    found = design(chain, np.array([0.01, 0.01]), Weights((1.0,), (1.0,)))
    assert found.gains is None
    assert 'so close together' in found.verdict


@pytest.mark.slow
def test_all_corners_of_six_poles_do_not_take_long():
    """In units of what four poles take, which have a ninth of the corners: 7 to 9 of them."""
    rng, seconds = np.random.default_rng(0), []
    for count in (4, 4, 6):
        many = StateSpace(np.diag(-2.0 ** np.arange(-1, count - 1)),
                          rng.standard_normal((count, 2)), rng.standard_normal((2, count)),
                          delay=(0.01, 0.02))
        start = thread_time()
        found = design(many, 0.03 * abs(many.poles), Weights((1.0, 1.0), (1.0, 1.0)), 0.05)
        seconds.append(thread_time() - start)
        assert found.gains is not None, found.verdict
    assert seconds[2] < 20.0 * min(seconds[:2])


def test_sure_model_is_accepted():
    found = design(ROLL, SURE, WEIGHTS)
    assert found.gains is not None
    assert found.verdict.startswith('Accepted: disc margin 1.7')
    assert 1.5 < found.worst_margin <= found.margin < 1.8
    true_after = Plant(0.1).true_model()  # a plant near by is borne too
    assert closed_poles(true_after, found.gains).real.max() < 0


def test_lightly_damped_mode_that_may_be_unstable_is_refused():
    found = design(ROLL, 0.03 * abs(ROLL.poles), WEIGHTS)
    assert found.gains is None
    assert 'with poles within 3 standard deviations, at' in found.verdict
    assert found.worst_margin == 0.0 < found.margin


@pytest.mark.parametrize(('model', 'words'), [
    (StateSpace([[1.0, 0], [0, -1]], [[0.0], [1]], [[1.0, 1]]), 'no stabilising gains'),
    (StateSpace([[1.0, 0], [0, -1]], [[1.0], [1]], [[0.0, 1]]), 'no stabilising gains'),
])
def test_unstable_state_out_of_reach_is_refused(model, words):
    found = design(model, np.zeros(2), WEIGHTS)
    assert found.gains is None
    assert words in found.verdict


def test_unknown_deviation_is_refused():
    found = design(ROLL, np.array([0.1, np.nan, 0.1, 0.1]), WEIGHTS)
    assert (found.gains, found.verdict) == (None, 'Refused: how sure the poles are is not known.')


def test_weak_loop_is_refused():
    model, weights = two_by_two()
    found = design(model, np.zeros(3), weights, least_margin=1.99)
    assert found.gains is None
    assert 'disc margin of' in found.verdict


def test_what_acts_of_a_command_is_said():
    found = design(replace(ROLL, actuators=(Actuator(timeout=0.5, limit=2.0),)), SURE, WEIGHTS)
    assert found.gains is not None
    assert 'counts as 0 from 0.5 s after a message on' in found.verdict
    assert 'acts by at most 2' in found.verdict
    assert 'counts as' not in design(ROLL, SURE, WEIGHTS).verdict


def test_dead_time_is_handled_said_and_refused_when_it_is_too_long():
    margins = []
    for delay in (0.0, 0.005, 0.02):
        found = design(replace(ROLL, delay=(delay,)), SURE, Weights((0.5,), (0.1,)))
        assert found.gains is not None
        assert ('dead time' in found.verdict) == (delay > 0)
        assert found.gains.feedback.shape == (1, 4 if delay == 0 else 7)
        margins.append(found.margin)
    assert margins == sorted(margins, reverse=True)
    unstable = StateSpace([[2.0]], [[1.0]], [[1.0]], K=[[5.0]], noise=[[1e-3]], delay=(0.6,))
    assert design(unstable, np.zeros(1), Weights((1.0,), (1.0,))).gains is None


def test_dead_times_of_two_inputs():
    model, weights = two_by_two(0.2, delay=(0.01, 0.02))
    found = design(model, 1e-3 * np.ones(3), weights, least_margin=0.01)
    assert found.gains is not None, found.verdict
    assert found.gains.observer.shape == (9, 2)


def test_integrator_is_a_plant_too():
    model = StateSpace([[0.0]], [[1.0]], [[1.0]], noise=[[1e-4]])
    found = design(model, np.array([0.01]), Weights((1.0,), (1.0,)))
    assert found.gains is not None, found.verdict


@pytest.mark.parametrize('weights', [
    Weights((1.0, 1.0), (1.0,)), Weights((1.0,), (1.0, 1.0))])
def test_weights_have_to_fit(weights):
    with pytest.raises(DataError, match='give one for each'):
        design(ROLL, SURE, weights)


def test_weights_have_to_be_positive():
    with pytest.raises(DataError, match='`inputs`'):
        Weights((1.0,), (0.0,))
    with pytest.raises(DataError, match='pole_std'):
        design(ROLL, np.ones(2), WEIGHTS)
