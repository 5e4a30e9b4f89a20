# SPDX-License-Identifier: Apache-2.0
"""What inputs do between their samples: the outputs tell, if it matters."""

from __future__ import annotations

from marks import slow
import numpy as np
from plants import held_response, plant
import pytest

from ctsid_core import Grade, Record, Settings, identify
from ctsid_core.model.validation import simulation

PLANT = plant([[0.0, 1.0], [-36.0, -6.0]], [[0.0], [36.0]], [[1.0, 0.0]])


def moved(seed: int, kind: str, every: int, hold: str, noise: float = 0.02) -> Record:
    """Return a record whose log has one of so many samples of a command at 500 Hz."""
    rng, t, t_y = np.random.default_rng(seed), np.arange(0.0, 15.0, 0.002), np.arange(0, 15, 0.01)
    if kind == 'sines':
        f = np.geomspace(0.1, 1.5, 12) * rng.uniform(0.95, 1.05, 12)
        u = np.sin(2 * np.pi * np.outer(t, f) + rng.uniform(0.0, 6.0, 12)).sum(axis=1)
    else:
        u = np.repeat(rng.standard_normal(len(t) // every), every)
    u = u[:, np.newaxis]
    y = held_response(PLANT, t, u, t_y)
    return Record.from_arrays(t[::every], u[::every], t_y,
                              y + noise * y.std() * rng.standard_normal(y.shape), input_hold=hold)


@pytest.mark.parametrize('feedthrough', [True, *slow(False)])
@pytest.mark.parametrize(('every', 'seed'), [
    (50, 1), *slow((100, 1), (50, 2), (100, 2), (100, 3))])
def test_a_smooth_command_of_few_samples_is_no_staircase(every, seed, feedthrough):
    """It was GOOD, and simulated another experiment to 61 to 90 %."""
    settings = Settings(feedthrough=feedthrough)
    found = identify(moved(seed, 'sines', every, 'zoh'), settings)
    assert found.verdict.grade is Grade.WEAK
    assert 'set `u1.hold: ' in found.verdict.reason
    again = identify(moved(seed, 'sines', every, 'smooth'), settings)
    assert again.good
    other = moved(seed + 10, 'sines', 1, 'zoh', noise=0.0)
    assert simulation(again.model, other).fit[0] > 95.0
    assert simulation(found.model, other).fit[0] < simulation(again.model, other).fit[0] - 5.0


@pytest.mark.parametrize(('every', 'seed'), [(50, 1), *slow((100, 1), (50, 2), (100, 2), (50, 3))])
def test_steps_are_steps(every, seed):
    assert identify(moved(seed, 'steps', every, 'zoh'), Settings(feedthrough=False)).good
    for hold in ('linear', 'smooth'):
        found = identify(moved(seed, 'steps', every, hold), Settings(feedthrough=False))
        assert not found.good
        print(found.verdict.reason)
        assert 'u1.hold: zoh' in found.verdict.reason


@pytest.mark.parametrize('hold', ['zoh', *slow('linear', 'smooth')])
def test_where_samples_are_many_nothing_is_asked(hold):
    assert identify(moved(1, 'sines', 5, hold), Settings(feedthrough=False)).good
