# SPDX-License-Identifier: Apache-2.0
"""Coordinates of poles: no step changes how many states there are."""

import numpy as np
import pytest

from ctsid_core.likelihood.modal_model import PoleSteps, canonical


def states(poles) -> int:
    return len(poles) + int(np.sum(poles.imag > 0.0))


def test_a_pole_at_zero_is_far_from_others():
    """A plant found by predictions has one where it is put on the axis."""
    for poles in ([0.0, -1.0], [0.0, -1.0, -1.1], [0.0, -1e-9]):
        steps = PoleSteps.of(np.array(poles, dtype=complex), 0.0)
        assert (0, -1) in steps.factors


def test_a_pair_beside_a_real_pole_stays_a_pair():
    """Three real poles at the fastest that is allowed: two of them became a pair, and that one."""
    found = canonical(np.array([-175.76, -175.76 + 1e-9j, -3.0]))
    assert states(found) == 4
    assert np.sum(found.imag > 0.0) == 1


@pytest.mark.parametrize('seed', range(20))
def test_steps_to_bounds_keep_the_number_of_states(seed):
    rng = np.random.default_rng(seed)
    for _ in range(50):
        real, pairs = rng.integers(1, 5), rng.integers(0, 3)
        poles = np.concatenate((-np.exp(rng.uniform(2.0, 5.2, real)) + 0j, -np.exp(rng.uniform(
            2.0, 5.2, pairs)) * np.exp(1j * rng.choice([1e-6, 0.01, 1.0], pairs))))
        around = PoleSteps.of(np.where(poles.imag < 0.0, poles.conj(), poles), 0.1,
                              int(rng.integers(1, 3)))
        moved = around.moved(rng.normal(0.0, 2.0, states(around.poles)), -1e-6, 176.0)[0]
        assert states(moved) == states(around.poles)
        assert np.isfinite(around.size_of(moved))


def test_equal_poles_stay_as_often_as_a_residue_has_ranks():
    poles = np.array([-3.0, 2.0j - 1.0, -3.0, 2.0j - 1.0, -3.0])
    found = canonical(poles, 2)
    assert states(found) == 7
    assert np.sum(found == -3.0) == np.sum(found == 2.0j - 1.0) == 2
    assert len(np.unique(found)) == 3


def test_poles_of_all_ranks_that_meet_part_as_a_pair_and_others_pass():
    poles = np.array([-2.0, -2.0, -3.0, -3.0])
    around = PoleSteps.of(poles, 0.1, 2)
    assert around.derivatives().shape == (2, 4)
    moved = around.moved(np.array([0.0, 0.3]), -1e-6, 100.0)[0]
    assert states(moved) == 4
    assert len(np.unique(moved)) == 1
    assert moved[0].imag > 0.0
    passing = PoleSteps.of(poles, 0.1, 3).moved(np.array([0.2, -0.75]), -1e-6, 100.0)[0]
    np.testing.assert_allclose(passing, [-2.4, -2.4, -3.5, -3.5])


def test_a_pair_that_parts_keeps_its_rank():
    """Whatever rank the last pole has."""
    around = PoleSteps.of(np.array([-1.0, -9.0, -9.0, -2.0 + 0.1j]), 0.1, 2)
    moved, was = around.moved(np.array([0.0, -0.1, 0.0, 0.0]), -1e-6, 100.0)
    assert np.all(moved.imag == 0.0)
    assert states(moved) == 5
    assert was.tolist() == [0, 3, 3, 1, 2]
    twice = PoleSteps.of(np.array([-1.0, *[-2.0 + 0.1j] * 2, -3.0 + 4.0j]), 0.1, 2)
    assert states(twice.moved(np.array([0.0, -0.1, 0.0, 0.0, 0.0]), -1e-6, 100.0)[0]) == 7
