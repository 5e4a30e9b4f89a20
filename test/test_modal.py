# SPDX-License-Identifier: Apache-2.0
"""Responses of modes against simulations of matrices; their derivatives against differences."""

import numpy as np
import pytest

from ctsid_core.model.modal import steps_of
from ctsid_core.model.simulation import input_polynomials, respond
from ctsid_core.signals.record import Signal

POLES = np.array([-0.5 + 6.0j, -2.0, -2.0 - 1e-9, 0.3])


def inputs(hold: str) -> tuple[Signal, ...]:
    rng = np.random.default_rng(3)
    own, even = np.sort(rng.uniform(-1.0, 10.0, 300)), np.arange(-1.0, 10.5, 0.05)
    return (Signal(own, rng.standard_normal((300, 1)), hold),
            Signal(even, rng.standard_normal((len(even), 2)), 'zoh'))


TIMES = np.random.default_rng(4).uniform(0.0, 10.0, 60)      # in any order
DELAY = (0.05, 0.13, 0.0)


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
def test_responses_are_exact_at_own_stamps_with_dead_times(hold):
    responses, _ = steps_of(inputs(hold), DELAY, 0.0, TIMES).responses(POLES)
    order = np.argsort(TIMES)
    every = np.concatenate(([0.0], TIMES[order]))
    for k, p in enumerate(POLES):
        A = np.array([[p.real, -p.imag], [p.imag, p.real]])
        for j in range(3):
            B = np.zeros((2, 3))
            B[0, j] = 1.0
            x, _ = respond(A, B, np.zeros(2), inputs(hold), DELAY, every, np.zeros(2))
            np.testing.assert_allclose(responses[k, j, order], x[1:] @ [1.0, 1.0j],
                                       atol=1e-11 * np.abs(x).max())


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
def test_slopes_are_those_of_differences(hold):
    steps = steps_of(inputs(hold), DELAY, 0.0, TIMES)
    _, slopes = steps.responses(POLES)
    for step in (1e-5, 1e-5j):
        up, down = (steps.responses(POLES + side * step, slopes=False)[0]
                    for side in (1.0, -1.0))
        wanted = (up - down) / (2.0 * step)
        np.testing.assert_allclose(slopes, wanted, atol=1e-7 * np.abs(wanted).max())


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
def test_inputs_are_those_at_the_times(hold):
    """What acts on outputs at once: at the outputs' stamps, not at those of the inputs before."""
    found = steps_of(inputs(hold), DELAY, 0.0, TIMES)
    wanted = input_polynomials(inputs(hold), DELAY, TIMES)[0].T
    np.testing.assert_allclose(found.inputs, wanted, atol=1e-12)
    np.testing.assert_allclose(found.first, input_polynomials(
        inputs(hold), DELAY, np.zeros(1))[0, 0], atol=1e-12)


def test_rates_are_derivatives_and_of_a_held_input_spread_evenly_around_its_stamps():
    late, fine = (0.05, 0.0, 0.0), np.arange(1.0, 9.0, 1e-4)
    for hold in ('linear', 'smooth'):
        u = steps_of(inputs(hold), late, 0.0, fine)
        off = np.abs(np.gradient(u.inputs[0], fine) - u.rates[0]) > 0.05 * np.abs(u.rates[0]).max()
        assert np.mean(off) < 0.02                         # beside corners
    for place, (signal, delay) in enumerate(zip(inputs('zoh'), (0.05, 0.0), strict=True)):
        halfway = 0.5 * (signal.time[1:] + signal.time[:-1])
        within = (signal.time[1:-1] > 1.0) & (signal.time[1:-1] < 9.0)
        rates = steps_of(inputs('zoh'), late, 0.0,
                         signal.time[1:-1][within] + delay).rates[place]
        np.testing.assert_allclose(rates * np.diff(halfway)[within],
                                   np.diff(signal.values[:, 0])[:-1][within], atol=1e-12)
