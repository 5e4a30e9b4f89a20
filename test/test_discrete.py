# SPDX-License-Identifier: Apache-2.0
"""The model at the ticks of a clock is the continuous one, to rounding."""

import numpy as np
import pytest
from ticks import response, simulated

from ctsid_core import Signal, StateSpace
from ctsid_core.errors import DataError
from ctsid_core.model.discrete import discretise

RATE = 64.0


def model_of(delay=(0.0, 0.0), n=3, seed=0) -> StateSpace:
    rng = np.random.default_rng(seed)
    nu = len(delay)
    A = rng.standard_normal((n, n)) * 3 - 4 * np.eye(n)
    return StateSpace(A, rng.standard_normal((n, nu)), rng.standard_normal((2, n)),
                      D=rng.standard_normal((2, nu)), x_trim=rng.standard_normal(n),
                      y_trim=rng.standard_normal(2), delay=delay)


def test_jordan_blocks_are_discretised_too():
    model = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], delay=(0.75,))
    found = discretise(model, 1.0)
    np.testing.assert_allclose(found.now, [[0.25 ** 2 / 2], [0.25]], rtol=1e-14)
    np.testing.assert_allclose(found.now + found.before, [[0.5], [1.0]], rtol=1e-14)


@pytest.mark.parametrize('delay', [(0.0, 0.0), (1 / 64, 5 / 64), (0.3 / 64, 0.0),
                                   (7.25 / 64, 2.9 / 64)])
@pytest.mark.parametrize('n', [0, 3])
def test_it_simulates_what_the_continuous_model_does(delay, n):
    model = model_of(delay, n)
    ticks = np.arange(300) / RATE
    u = np.random.default_rng(1).standard_normal((300, 2))
    found = discretise(model, RATE)
    wanted = model.simulate([Signal(ticks, u, hold='zoh')], ticks)
    np.testing.assert_allclose(simulated(found, u), wanted, rtol=0,
                               atol=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize('delay', [(0.0, 0.0), (1 / 64, 5 / 64), (0.3 / 64, 2.9 / 64)])
def test_past_inputs_as_states_change_nothing(delay):
    found = discretise(model_of(delay), RATE)
    A, B, C, D = found.expanded()
    omega = np.geomspace(0.1, np.pi * RATE, 50)
    wanted = response(found, omega)
    got = [C @ np.linalg.solve(np.exp(1j * w / RATE) * np.eye(len(A)) - A, B) + D for w in omega]
    np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


def test_a_dead_time_that_is_nearly_whole_is_whole():
    found = discretise(model_of((3 * (1 / 64 + 1e-15), 0.0)), RATE)
    assert found.lag == (3, 0)
    assert found.fraction == (0.0, 0.0)
    assert not found.before.any()


@pytest.mark.parametrize('rate', [0.0, -1.0, np.inf, np.nan, 1e9])
def test_a_rate_that_cannot_be_is_refused(rate):
    with pytest.raises(DataError, match='rate'):
        discretise(model_of((0.01, 0.01)), rate)


def test_too_many_past_inputs_for_matrices_are_refused():
    with pytest.raises(DataError, match='lower rate'):
        discretise(model_of((0.5, 0.5)), 1e4).expanded()
