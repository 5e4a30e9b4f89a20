# SPDX-License-Identifier: Apache-2.0
"""Outputs that jump by themselves: their sensor's offset does, or something strikes the robot."""

from __future__ import annotations

from dataclasses import replace
import re

from marks import slow
import numpy as np
from plants import held_response, plant
import pytest
from scipy.signal import lfilter

from ctsid_core.identify import identify
from ctsid_core.judge import offsets
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.model.verdict import Remedy
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal

LAG = plant([[-2.0]], [[2.0]], [[1.0]])
NAMED = re.compile(
    r'[Oo]utput angle jumps by (\S+) rad about (\S+) s after the start of the window')


def flight(seed=0, *, jump=0.0, at=7.3, gusts=0.0, direct=0.0, step=False):
    """A lag of 0.5 s, moved every half second or once, with an output that jumps at some time."""
    rng = np.random.default_rng(seed)
    t, t_u = np.arange(0.0, 15.0, 0.0123), np.arange(-1.0, 15.0, 0.02)
    u = np.repeat(rng.uniform(-1.0, 1.0, len(t_u) // 25 + 1), 25)[:len(t_u), np.newaxis]
    u = np.where(t_u >= at, 1.0, 0.0)[:, np.newaxis] if step else u
    moving = plant(LAG.A, LAG.B, LAG.C, [[direct]])
    y = held_response(moving, t_u, u, t)[:, 0]
    wander = lfilter([1.0], [1.0, -0.98], rng.standard_normal(len(t_u)))[:, np.newaxis]
    moved = held_response(LAG, t_u, wander, t)[:, 0]        # of 1 s, at the input
    y += (0.02 * rng.standard_normal(len(t)) + gusts * moved / moved.std()) * y.std()
    y += jump * (t >= at)
    return Record((Signal(t_u, u, 'zoh', names=('stick',)),), (
        Signal(t, y[:, np.newaxis], names=('angle',), units=('rad',)),), 0.0, 14.9)


@pytest.mark.parametrize(('jump', 'gusts'), [(0.2, 0.2), *slow(
    (-0.2, 0.2), (0.3, 0.4), (0.12, 0.0), (2.0, 0.1))])
@pytest.mark.parametrize('seed', [0, *slow(1, 2, 3)])
def test_an_offset_that_jumps_is_named_with_its_time(jump, gusts, seed):
    """Else a model of it is GOOD, or the plant has changed, or is not linear, or drifts."""
    record = flight(seed, jump=jump, gusts=gusts)
    found = identify(record, Settings(feedthrough=False))
    verdict, notes = found.verdict, '; '.join(found.notes)
    said = NAMED.search(notes if found.good else verdict.reason)
    assert said, verdict.reason
    # It is what is wrong, if anything is: of a model that passes all tests it is a note.
    assert found.good or verdict.remedy is Remedy.PART and verdict.reason.endswith(
        'something struck the robot; take a part of the data without that.')
    assert found.good == ('jumps by' in notes)
    # A few samples beside it may have been taken for corrupt ones.
    assert float(said[1]) == pytest.approx(jump, rel=0.3)
    assert 7.25 < float(said[2]) < 7.45
    for part in (replace(record, end=7.2), record.between(7.5, 14.9)):
        assert 'jumps by' not in words(identify(part, Settings(feedthrough=False)))


def words(found):
    return '; '.join((found.verdict.reason, *found.notes))


@pytest.mark.parametrize('gusts', [0.0, *slow(0.2, 0.4)])
@pytest.mark.parametrize('seed', [0, *slow(1, 2, 3, 4, 5)])
def test_outputs_that_jump_nowhere_are_not_named(gusts, seed):
    said = words(identify(flight(seed, gusts=gusts), Settings(feedthrough=False)))
    assert 'jumps by' not in said


@pytest.mark.parametrize('seed', [0, *slow(1, 2)])
@pytest.mark.parametrize('step', [True, *slow(False)])
def test_an_output_that_jumps_with_its_input_does_not_jump_by_itself(step, seed):
    """What follows at once, though D is not allowed: a single step, and many."""
    record = flight(seed, direct=0.5, step=step)
    said = words(identify(record, Settings(feedthrough=False, order=1, delay=0.0)))
    assert 'jumps by' not in said + words(identify(record))


@pytest.mark.parametrize('seed', [0, *slow(2, 3)])
def test_what_moves_an_output_on_is_no_jump(seed):
    """Gusts while samples were lost, a blow that is felt through a lag, what was before all."""
    record = flight(seed, gusts=0.4)
    y, = record.outputs
    lost = replace(record, outputs=(y.of((y.time < 5.0) | (y.time > 7.2)),))
    record = flight(seed, gusts=0.1)
    y, since = record.outputs[0], np.maximum(record.outputs[0].time - 7.3, 0.0)
    blow = 0.3 * -np.expm1(-since / 0.03) * np.exp(-since / 0.5)
    struck = replace(record, outputs=(replace(y, values=y.values + blow[:, np.newaxis]),))
    for one in (lost, struck, flight(seed, jump=0.3, at=0.1, gusts=0.1)):
        assert 'jumps by' not in words(identify(one, Settings(feedthrough=False)))


def test_a_jump_is_as_far_as_means_of_samples_before_and_after_it_are_apart():
    times, rng = np.arange(0.0, 10.0, 0.05), np.random.default_rng(0)
    errors = 0.01 * rng.standard_normal(200) + 0.7 * (times >= 4.0)
    record, = samples_of([flight().between(0.0, 10.0)], [[None]]).records
    at, size = offsets._standing_out(record, times, errors)
    assert (at, size) == (80, pytest.approx(errors[80:85].mean() - errors[75:80].mean()))
    assert offsets._standing_out(record, times, errors - 0.5 * (times >= 7.0))[1] == 0.0


def test_of_several_records_the_one_that_jumps_is_named():
    records = [flight(0), flight(1, jump=0.2)]
    found = identify(records, Settings(feedthrough=False))
    assert re.search(r'about 7\.[34] s after the start of record 2', words(found))
