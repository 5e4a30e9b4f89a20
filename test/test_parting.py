# SPDX-License-Identifier: Apache-2.0
"""Modes of one pole part where the samples say so, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from test_axes import SERVO, axes, flown

from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.likelihood.output_error import (
    Fit,
    Free,
    _powers,
    climb_roughly,
    fit_at,
    jacobian,
    steps_around,
)
from ctsid_core.likelihood.parting import _diagonal, _moves, parted
from ctsid_core.likelihood.samples import samples_of
from ctsid_ros.studies.robots.linear import Linear

FREE = Free(False, True, (True, True), 1.0, -1e-6, 100.0)
DELAY = np.array([0.031, 0.052])
PRICE = 2.0


def samples(plant):
    return samples_of([flown(plant, 'multisine', np.random.default_rng(6), 0.1)], [[None]])


@pytest.mark.parametrize('poles', [[-4.0, -4.0, -9.0], [6.0j - 4.0] * 2, [-4.0, -4.0, 3.0j - 2.0]])
def test_slopes_by_blocks_are_those_of_the_cost(poles):
    """The rest held, along any matrix in the blocks: real poles become a pair, pairs part."""
    data, rng = samples(axes(SERVO, 2)), np.random.default_rng(1)
    start = fit_at(data, np.array(poles, dtype=complex), DELAY, FREE)
    around = steps_around(data, start.model)
    moves, _ = _moves(around)

    def at(change):
        model = _diagonal(start.model, around.ranks, change)
        columns = columns_of(data, model.poles, model.delay, direct=False)
        power = _powers(data, model, columns)
        return Fit(model, columns, power, float(np.sum(data.counts * np.log(power))))
    rows, error, _ = jacobian(data, at(0.0 * moves[0]), FREE, moves=moves)
    for step in 1e-4 * rng.standard_normal((6, len(moves))):
        change = np.tensordot(step, moves, 1)
        slope = 0.5 * (at(change).cost - at(-change).cost)
        assert slope == pytest.approx(-2.0 * step @ rows[:, :len(moves)].T @ error, rel=1e-2,
                                      abs=1e-4 * np.linalg.norm(rows[:, :len(moves)].T @ error))


def test_poles_of_equal_axes_stay_one():
    data = samples(axes(SERVO, 2))
    fit = climb_roughly(data, fit_at(data, np.repeat([5.0j - 3.0], 2), DELAY, FREE), FREE)
    assert parted(data, fit, FREE, PRICE) is None


def test_two_real_poles_part_as_a_pair():
    """Two states that turn into each other: no two real poles that pass each other are near."""
    plant = Linear(np.array([[-4.0, 6.0], [-6.0, -4.0]]), np.eye(2), np.eye(2), DELAY[0])
    data = samples(plant)
    tied = climb_roughly(data, fit_at(data, np.array([-5.0 + 0j] * 2), DELAY, FREE), FREE)
    apart = parted(data, tied, FREE, PRICE)
    found = climb_roughly(data, apart, FREE)
    assert tied.model.poles[0].imag == 0.0
    assert found.cost < apart.cost < tied.cost
    np.testing.assert_allclose(found.model.poles, [6.0j - 4.0], rtol=0.02)
