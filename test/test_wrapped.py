# SPDX-License-Identifier: Apache-2.0
"""Angles that wrap, told from what only looks like one."""

from marks import slow
import numpy as np
from plants import held_response, plant
import pytest

from ctsid_core import Grade, Record, Settings, identify
from ctsid_core.model.verdict import Remedy
from ctsid_core.signals.wrapped import Wrapped, wrapped_channels, wraps

T = np.arange(0.0, 40.0, 0.02)


def heading(seed):
    """Return stamps and values of a steering command, and the heading that it integrates."""
    rng = np.random.default_rng(seed)
    t_u = np.arange(-2.0, 40.0, 0.05)
    u = np.repeat(rng.uniform(-1.0, 1.4, len(t_u) // 20), 20)[:, np.newaxis]
    yaw = held_response(plant([[-4.0, 0.0], [1.0, 0.0]], [[4.0], [0.0]], [[0.0, 1.0]]), t_u, u, T)
    return t_u, u, yaw[:, 0] + 0.003 * rng.standard_normal(len(T))


@pytest.mark.parametrize('turn', [360.0, 2.0 * np.pi])
@pytest.mark.parametrize('low', [0.0, -0.5])
@pytest.mark.parametrize('kind', [np.float64, np.float32])
def test_an_angle_that_wraps_is_told_with_its_jumps(turn, low, kind):
    yaw = heading(1)[2] * turn / (2.0 * np.pi)
    values = ((yaw - low * turn) % turn + low * turn).astype(kind).astype(float)
    jumps = np.count_nonzero(np.diff(np.floor((yaw - low * turn) / turn)))
    assert jumps > 1
    assert wraps(values) == (turn, jumps)
    assert wraps(np.unwrap(values, period=turn)) == (0.0, 0)


def noise(size):
    return size * np.random.default_rng(4).standard_normal(len(T))


@pytest.mark.parametrize('values', [
    180.0 * np.sign(np.sin(T + 0.1)),                           # a square wave
    180.0 * np.sign(np.sin(T + 0.1)) + noise(1.0),              # ... that is measured
    360.0 * (np.sin(T) > 0.0),                                  # a set point that jumps by a turn
    np.select([T < 10.0, T < 20.0], [0.0, 350.0], 20.0),        # ... or does not
    np.clip(noise(100.0), -180.0, 180.0),                       # what moves as much as it jumps
    np.clip(noise(1.5), -np.pi, np.pi),
    40.0 * np.sin(T) + 300.0 * (np.arange(len(T)) == 900),      # a spike
    (100.0 * T) % 500.0,                                        # another sawtooth
    500.0 + (100.0 * T) % 360.0,                                # ends that no angle has
    np.repeat([-3.0, 0.0, -1.2, 3.0, -2.8, 1.0, 2.9, -2.9], 250),     # levels
    np.sin(T), 0.0 * T, np.empty(0)], ids=str)
def test_nothing_else_is_called_an_angle(values):
    assert wraps(values) == (0.0, 0)


def test_channels_are_named():
    y = np.column_stack([np.sin(T), (3.0 * T + 0.5 * np.sin(T)) % (2.0 * np.pi)])
    record = Record.from_arrays(T, np.sign(np.sin(T)), T, y, output_names=('a', 'joint[1]'))
    assert wrapped_channels(record) == (Wrapped('joint[1]', 2.0 * np.pi, 19),)


@pytest.mark.parametrize('feedthrough', [True, *slow(False)])
@pytest.mark.parametrize('seed', [1, *slow(2)])
def test_a_verdict_says_first_that_an_angle_wraps(seed, feedthrough):
    t_u, u, yaw = heading(seed)

    def judged(y):
        return identify(Record.from_arrays(t_u, u, T, y, input_hold='zoh',
                                           output_names=('yaw[0]',)),
                        Settings(feedthrough=feedthrough))
    wrapped = judged(np.degrees(yaw) % 360.0).verdict
    assert wrapped.grade is not Grade.GOOD
    assert wrapped.remedy is Remedy.SETTING
    assert wrapped.reason.startswith('The signal yaw[0] jumps ')
    assert wrapped.reason.endswith(' If it is so, set `yaw.turn: 360.0`.')
    assert judged(np.degrees(yaw)).good


@pytest.mark.parametrize('seed', [1, *slow(3, 4)])
def test_an_angle_that_wraps_once_is_not_good(seed):
    """Eight states and more made the jump; two are right."""
    t_u, u, yaw = heading(seed)
    yaw = 0.6 * np.degrees(yaw - yaw.min()) * 360.0 / np.degrees(np.ptp(yaw))

    def once(low):
        return (yaw + low) % 360.0
    low = next(low for low in np.arange(0.0, 360.0, 5.0) if wraps(once(low)) == (360.0, 1))
    found, right = (identify(Record.from_arrays(t_u, u, T, y, input_hold='zoh'))
                    for y in (once(low), yaw))
    assert not found.good
    assert found.verdict.remedy is Remedy.SETTING
    assert 'jumps once by a full turn' in found.verdict.reason
    assert 'numpy.unwrap' in found.verdict.reason
    assert right.good
