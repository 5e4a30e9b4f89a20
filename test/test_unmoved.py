# SPDX-License-Identifier: Apache-2.0
"""Modes that last and that no input moves belong to what disturbs the plant: a note tells them."""

from marks import slow
import numpy as np
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_ros.studies.robots.inputs import drive
from ctsid_ros.studies.robots.linear import Held, Linear


def told(poles, hum, kind='pilot', swing=0.0):
    """Return an estimate of a plant whose output has a hum of 9.7 Hz, and what it notes on it."""
    rng = np.random.default_rng(5)
    held, times = np.arange(-1.0, 30.0, 0.02), np.arange(0.003, 30.0, 0.02)
    u = drive(kind, rng, held, 30.0, 2.0)
    u[held < 0.0] = 0.0
    y = Linear.of_roots(1.0, poles, 0.02).move(Held(held, u), times)[:, 0]
    y = y + swing * y.std() * np.exp(poles[0].real * times) * np.cos(poles[0].imag * times)
    y = y + y.std() * (hum * np.sin(2.0 * np.pi * 9.7 * times + 1.0)
                       + 0.01 * rng.standard_normal(len(y)))
    found = identify(Record.from_arrays(held, u, times, y, input_hold='zoh'),
                     Settings(feedthrough=False))
    return found, [note for note in found.notes if note.startswith('inputs move the oscillation')]


@pytest.mark.parametrize('kind', ['prbs', *slow('pilot')])
def test_a_hum_is_told_from_the_plant(kind):
    found, notes = told((-4.0 + 6.0j, -4.0 - 6.0j), 0.2, kind)
    assert found.good
    assert found.model.n == 4
    assert len(notes) == 1
    assert 'the oscillation at 9.7 Hz by less than what the model misses' in notes[0]
    assert not any('feedthrough: true' in note for note in found.notes)


@pytest.mark.parametrize(('poles', 'swing'), [
    ((-0.005 + 6.0j, -0.005 - 6.0j), 20.0), ((0.0, -5.0), 0.0), *slow(
        ((-0.005 + 6.0j, -0.005 - 6.0j), 0.0), ((0.0, -5.0), 20.0))])
def test_what_lasts_and_is_moved_is_of_the_plant(poles, swing):
    """However much it swings at first."""
    found, notes = told(poles, 0.0, swing=swing)
    assert found.good
    assert not notes
