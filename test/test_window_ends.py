# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.likelihood.window_ends import ends_cost, ends_cost_of_simulation, ends_slopes
from ctsid_core.linear.resolvent import resolvent

A = np.array([[0.0, 1.0, 0.0], [-30.0, -2.5, 1.0], [0.0, 0.0, -3.0]])
C = np.array([[1.0, 0.0, 0.5]])
GAINS = np.array([[0.0, 0.0, 0.0], [2.0, 5.0, 1.0], [6.0, -8.0, 0.5], [1.5, 40.0, -2.0]])


def lines(count=6000, apart=0.2) -> Projection:
    """Lines far beyond all poles, with a tail of equal size on each."""
    s = 1j * apart * (np.arange(count) + 0.5)
    one = np.ones((1, count), dtype=complex)
    return Projection(s=s, u=one, y=one, tail=one, ones=one[:0], unit=1.0, start=0.0, end=10.0)


def poles(matrix) -> np.ndarray:
    return np.linalg.eigvals(matrix).astype(complex)


def known(p, closed) -> float:
    """Log det of what the errors tell of the tail, line by line."""
    X = as_real(np.stack([C @ np.linalg.solve(s * np.eye(3) - closed, np.eye(3))
                          for s in p.s])[:, 0].T * p.tail)
    return float(np.linalg.slogdet(X @ X.T)[1])


@pytest.mark.parametrize('gain', GAINS[1:])
def test_the_cost_is_log_det_of_the_information_on_the_tail(gain):
    p, closed = lines(), A - gain[:, np.newaxis] @ C
    wanted = known(p, closed) - known(p, A)
    got = ends_cost(p, poles(closed), poles(A)) - ends_cost(p, poles(A), poles(A))
    assert got == pytest.approx(wanted, abs=0.02)
    assert abs(wanted) > 0.5


def test_a_pole_on_a_line_makes_nothing_likelier():
    """What -2 log|det H| gains as a predictor's pole comes near a line is paid back."""
    p = lines(400)
    at = p.s[40]
    costs = []
    for damping in (1e-2, 1e-3, 1e-4):
        predictor = np.array([at - damping, np.conj(at) - damping])
        H = np.log(np.abs(p.s[:, np.newaxis] - predictor)).sum(axis=1)
        costs.append(2.0 * p.weights @ H + ends_cost(p, predictor, predictor - 3.0))
    assert np.ptp(costs) < 0.1


def test_without_gain_nothing_is_added_where_the_window_resolves_the_poles():
    p = lines()
    for scale in (5.0, 20.0):
        assert abs(ends_cost(p, poles(scale * A), poles(scale * A))) < 0.05 / scale
    fast = poles(5.0 * A)
    assert ends_cost_of_simulation(p, fast) == pytest.approx(ends_cost(p, fast, fast))
    slow = np.array([-1e-3 + 5j, -1e-3 - 5j])
    assert ends_cost_of_simulation(p, slow) > 3.0                # a spike on one line is not free
    assert ends_cost_of_simulation(p, -slow.conj()) == pytest.approx(
        ends_cost_of_simulation(p, slow))


@pytest.mark.parametrize('shift', [0.0, 2.0])                   # a stable and an unstable plant
def test_slopes_against_central_differences(shift):
    p, plant = lines(200, 0.6), A + shift * np.eye(3)
    closed = plant - np.array([[6.0], [10.0], [2.0]]) @ C
    slopes = ends_slopes(p, resolvent(closed, p.s), resolvent(plant, p.s))
    for which, slope in enumerate(slopes):
        for place in np.ndindex(3, 3):
            step = np.zeros((3, 3))
            step[place] = 1e-5
            moved = [[closed + sign * step, plant] if which == 0 else [closed, plant + sign * step]
                     for sign in (1.0, -1.0)]
            ahead, behind = (ends_cost(p, *map(poles, pair)) for pair in moved)
            assert slope.T[place] == pytest.approx((ahead - behind) / 2e-5, abs=1e-5)


def test_parts_have_ends_of_their_own_and_without_a_tail_there_are_none():
    p = lines(300)
    once = ends_cost(p, poles(A - GAINS[1][:, np.newaxis] @ C), poles(A))
    for parts in (0, 3):
        more = replace(p, tail=np.ones((parts, 300), dtype=complex))
        assert ends_cost(more, poles(A - GAINS[1][:, np.newaxis] @ C),
                         poles(A)) == pytest.approx(parts * once)
