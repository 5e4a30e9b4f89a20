# SPDX-License-Identifier: Apache-2.0
"""Step responses, and their deviations beside those of many models drawn at random."""

from __future__ import annotations

from dataclasses import replace

from flights import TRUTH
import numpy as np
import pytest
import scipy.signal

from ctsid_core.model.covariance import Covariance, Rival
from ctsid_core.model.gains import horizon, step_response
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Signal

TWO = StateSpace([[-1.0, 2.0], [-3.0, -0.5]], [[1.0, 0.5], [0.0, 2.0]], [[1.0, 0.0], [0.3, 1.0]],
                 [[0.0, 0.1], [0.2, 0.0]], delay=(0.2, 0.0))


def test_step_response_is_that_of_scipy():
    found = step_response(TRUTH, count=50)
    _, y = scipy.signal.step((TRUTH.A, TRUTH.B, TRUTH.C, TRUTH.D), T=found.times)
    np.testing.assert_allclose(found.values[:, 0, 0], y, atol=1e-9)
    assert found.times[-1] == pytest.approx(5.0 / 1.5)
    assert found.values[-1, 0, 0] == pytest.approx(TRUTH.dc_gain[0, 0], rel=0.02)
    assert np.isnan(found.std).all()


def test_deviation_is_what_small_changes_make():
    rng = np.random.default_rng(3)
    root = 1e-6 * rng.standard_normal((3, Covariance.entry_count(2, 2, 2)))
    known = Covariance(root, 2, 2, 2)
    found = step_response(TWO, known, length=4.0, count=41)

    def simulated(sign: float, row: int) -> np.ndarray:
        e = known.entries
        moved = replace(TWO, A=TWO.A + sign * e.A[row], B=TWO.B + sign * e.B[row],
                        C=TWO.C + sign * e.C[row], D=TWO.D + sign * e.D[row])
        late = [1e-9 + sign * d for d in e.delay[row]]
        return np.stack([replace(moved, delay=(0.0, 0.0)).simulate(
            [Signal(np.array([-9.0, 0.0]), np.eye(2)[j] * [[0.0], [1.0]], 'zoh')],
            np.concatenate(([0.0], np.maximum(found.times - late[j], 0.0))))[1:]
            for j in range(2)], axis=2)

    squares = sum((0.5 * (simulated(1.0, r) - simulated(-1.0, r))) ** 2 for r in range(3))
    np.testing.assert_allclose(found.std[1:], np.sqrt(squares)[1:], rtol=1e-3)


@pytest.mark.parametrize('late', [(0.0, 0.0), (0.2, 0.0), (0.5, 0.1), (2.5, 1.0)])
def test_rivals_vary_it_with_their_share(late):
    """Beside a step after the model's dead time: a rival of another one has moved before."""
    model = replace(TWO, delay=(1.7, 0.0))
    other = StateSpace(np.diag([-1.0, -3.0, -9.0]), np.ones((3, 2)), np.ones((2, 3)), delay=late,
                       x_trim=[1.0, 2.0, 3.0], y_trim=[5.0, 6.0])
    root = np.zeros((1, Covariance.entry_count(2, 2, 2)))
    found = step_response(model, Covariance(root, 2, 2, 2, (Rival(0.25, other),)),
                          length=4.0, count=41)
    for j in range(2):
        tau = np.maximum(found.times + model.delay[j] - late[j], 0.0)
        moved = np.sum((1.0 - np.exp(np.outer(tau, np.diag(other.A)))) / -np.diag(other.A), axis=1)
        np.testing.assert_allclose(found.std[:, :, j], 0.5 * np.abs(
            moved[:, np.newaxis] - found.values[:, :, j]), atol=1e-12)


def test_a_rival_that_leaves_the_range_of_numbers_does_not_count():
    grows = StateSpace([[400.0]], np.ones((1, 2)), np.ones((2, 1)))
    root = np.zeros((1, Covariance.entry_count(2, 2, 2)))
    found = step_response(TWO, Covariance(root, 2, 2, 2, (Rival(0.25, grows),)), length=4.0)
    assert not found.std.any()


@pytest.mark.parametrize(('A', 'seconds'), [
    ([[-2.0]], 2.5), ([[0.0]], 1.0), ([[3.0]], 1.0), ([[0.0, 1.0], [0.0, -4.0]], 1.25)])
def test_as_long_as_it_moves(A, seconds):
    model = StateSpace(A, np.ones((len(A), 1)), np.ones((1, len(A))))
    assert horizon(model) == pytest.approx(seconds)
    assert np.isfinite(step_response(model).values).all()


@pytest.mark.parametrize('pole', [-1e-8, 0.0, 1e-8])
def test_what_hardly_grows_is_shown_as_long_as_what_hardly_decays(pole):
    assert horizon(StateSpace([[pole, 1.0], [0.0, -3.0]], [[0.0], [1.0]],
                              [[1.0, 0.0]])) <= 1000.0
