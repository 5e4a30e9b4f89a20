# SPDX-License-Identifier: Apache-2.0
"""What inputs do between their samples: the outputs tell, if it matters."""

from __future__ import annotations

from marks import slow
import numpy as np
from plants import held_response, plant
import pytest
from scipy.linalg import expm

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


@pytest.mark.parametrize(('every', 'seed', 'holds'), [(50, 1, ('linear',)), *slow(*(
    (every, seed, ('linear', 'smooth'))
    for every, seed in ((50, 1), (100, 1), (50, 2), (100, 2), (50, 3))))])
def test_steps_are_steps(every, seed, holds):
    assert identify(moved(seed, 'steps', every, 'zoh'), Settings(feedthrough=False)).good
    for hold in holds:
        found = identify(moved(seed, 'steps', every, hold), Settings(feedthrough=False))
        assert not found.good
        print(found.verdict.reason)
        assert 'u1.hold: zoh' in found.verdict.reason


@pytest.mark.parametrize('hold', ['zoh', *slow('linear', 'smooth')])
def test_where_samples_are_many_nothing_is_asked(hold):
    assert identify(moved(1, 'sines', 5, hold), Settings(feedthrough=False)).good


def in_loop(seed: int, gain: float = 4.0) -> Record:
    """Return lags of 25 and 3 rad/s under a PI controller at 100 Hz, commands as they are sent."""
    rng, h, count = np.random.default_rng(seed), 0.01, 1000
    wanted = np.repeat(rng.choice([-1.0, 0.0, 1.0], count // 50), 50)
    joined = expm(h * np.array([[-25.0, 0.0, 25.0], [3.0, -3.0, 0.0], [0.0, 0.0, 0.0]]))
    u, y, x, total = np.empty(count), np.empty(count), np.zeros(2), 0.0
    for k in range(count):
        y[k] = x[1] + 0.06 * rng.standard_normal()
        total += 0.05 * gain * (wanted[k] - y[k])
        u[k] = gain * (wanted[k] - y[k]) + total
        x = joined[:2, :2] @ x + joined[:2, 2] * u[k]
    t = h * np.arange(count)
    return Record.from_arrays(t, u, t, y, input_hold='zoh')


@pytest.mark.parametrize(('seed', 'gain'), [(3, 4.0), *slow((33, 4.0), (36, 4.0), (19, 6.0))])
def test_lines_to_the_next_command_of_a_loop_know_the_noise(seed, gain):
    """Six of 80 were WEAK, for a controller makes the next command of the noise till then."""
    found = identify(in_loop(seed, gain), Settings(feedthrough=False))
    assert found.verdict.grade is Grade.GOOD
    np.testing.assert_allclose(np.sort(found.model.poles), [-25.0, -3.0], rtol=0.12)
