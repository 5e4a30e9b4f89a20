# SPDX-License-Identifier: Apache-2.0
"""Coordinates of poles: no step changes how many states there are."""

import numpy as np
import pytest

from ctsid_core.likelihood.pole_steps import PoleSteps, canonical


def states(poles) -> int:
    return len(poles) + int(np.sum(poles.imag > 0.0))


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
                              bool(rng.integers(2)))
        moved = around.moved(rng.normal(0.0, 2.0, states(around.poles)), -1e-6, 176.0)
        assert states(moved) == states(around.poles)
        assert np.isfinite(around.size_of(moved))
