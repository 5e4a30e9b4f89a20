# SPDX-License-Identifier: Apache-2.0
"""Stamps of inputs that come after they act: outputs answer before, as no plant does."""

from __future__ import annotations

from dataclasses import replace

from marks import slow
import numpy as np
from plants import held_response, noisy, plant
import pytest

from ctsid_core import Grade, Record, Settings, Signal, StateSpace, identify
from ctsid_core.judge.conclusion import _asked_for_leads
from ctsid_core.judge.lead import lead_by_search, lead_of_outputs
from ctsid_core.likelihood.output_error import Free, fit_at
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.model.verdict import Excitation
from ctsid_ros.studies.robots.families import experiment
from ctsid_ros.studies.robots.inputs import KINDS, drive

SECOND = plant([[0, 1], [-20, -3]], [[0], [20]], [[1, 0]])
LAG = plant([[-5]], [[5]], [[1]])
DIRECT = plant([[0, 1], [-20, -3]], [[0], [20]], [[1, 0]], [[0.1]])
ZERO = plant([[0, 1], [-20, -3]], [[2], [14]], [[1, 0]])
BACKWARDS = plant([[0, 1], [-20, -3]], [[-2], [26]], [[1, 0]])     # at first


def levels(rng, t):
    """Return random switches every 0.3 s."""
    return rng.choice([-1.0, 1.0], 1 + int(t[-1] / 0.3))[(t / 0.3).astype(int)]


def pilot(rng, t):
    """Return noise after two lags of 0.25 s."""
    u, a = np.zeros((2, len(t) + 1)), np.exp(-np.median(np.diff(t)) / 0.25)
    for k, w in enumerate(rng.standard_normal(len(t))):
        u[0, k + 1] = a * u[0, k] + w
        u[1, k + 1] = a * u[1, k] + (1.0 - a) * u[0, k + 1]
    return u[1, 1:] / u[1].std()


def stamped(p, late: float, moves=levels, seed: int = 1, hold='zoh') -> Record:
    """Return 20 s of a plant with an input at 50 Hz, from rest, stamped late."""
    rng = np.random.default_rng(seed)
    t, t_y = np.arange(1000) / 50.0, np.sort(np.arange(2000) / 100.0 + rng.uniform(0, 4e-3, 2000))
    u = moves(rng, t)[:, np.newaxis]
    y = held_response(p, np.append(-1e3, t), np.vstack((0.0 * u[:1], u)), t_y)
    return Record.from_signals([Signal(t + late, u, hold)], [Signal(t_y, noisy(rng, y, 30.0))])


@pytest.mark.parametrize(('p', 'late', 'moves', 'feedthrough'), [
    *slow((SECOND, 0.06, levels, False)), (SECOND, 0.06, levels, True),
    *slow((LAG, 0.06, levels, True), (SECOND, 0.15, levels, False), (SECOND, 0.15, pilot, False),
          (LAG, 0.06, pilot, False))])
def test_an_input_stamped_late_is_told(p, late, moves, feedthrough):
    """They were GOOD with a lead of phase, or "minus one over a controller"."""
    found = identify(stamped(p, late, moves), Settings(feedthrough=feedthrough))
    assert found.verdict.grade is Grade.WEAK
    assert 'before input u1' in found.verdict.reason
    told = float(found.verdict.reason.split('about ')[1].split()[0])
    assert abs(told - late) < 0.02
    assert 'correct the stamps' in found.verdict.reason


@pytest.mark.parametrize(('p', 'moves'), [
    (SECOND, levels), (DIRECT, levels), (ZERO, pilot), (BACKWARDS, levels),
    *slow((SECOND, pilot), (LAG, levels), (DIRECT, pilot), (ZERO, levels), (BACKWARDS, pilot))])
@pytest.mark.parametrize('feedthrough', [True, *slow(False)])
def test_plants_that_answer_at_once_are_not_called_so(p, moves, feedthrough):
    found = identify(stamped(p, 0.0, moves), Settings(feedthrough=feedthrough))
    assert 'before' not in found.verdict.reason
    assert found.verdict.grade is Grade.GOOD or not feedthrough


@pytest.mark.parametrize(('hold', 'late'), [('linear', 0.0), ('zoh', 0.015)])
def test_a_hold_that_is_wrong_by_half_a_sample_is_not_called_so(hold, late):
    found = identify(stamped(SECOND, late, pilot, hold=hold))
    assert 'before' not in found.verdict.reason


def test_stamps_that_are_moved_back_are_right():
    record = stamped(SECOND, 0.06)
    back = tuple(replace(s, time=s.time - 0.06) for s in record.inputs)
    assert identify(Record.from_signals(back, record.outputs)).good


def test_a_dead_time_that_is_given_is_not_asked():
    found = identify(stamped(SECOND, 0.06), Settings(delay=0.0))
    assert 'before' not in found.verdict.reason


def two_inputs(dead_time: float) -> Record:
    """Return a record of an input that acts later, and one that is stamped 0.08 s late."""
    one, two = stamped(SECOND, -dead_time, seed=2), stamped(LAG, 0.08, seed=3)
    t, values = one.outputs[0].time, one.outputs[0].values
    other = np.interp(t, two.outputs[0].time, two.outputs[0].values[:, 0])[:, np.newaxis]
    return Record.from_signals(
        [replace(s, names=(name,)) for s, name in ((one.inputs[0], 'a'), (two.inputs[0], 'b'))],
        [Signal(t, values + other)])


@pytest.mark.parametrize('dead_time', [3.0, *slow(0.0)])
def test_the_one_of_two_inputs_that_is_late_is_named(dead_time):
    """Whatever dead time the other one has."""
    assert 'before input b' in identify(two_inputs(dead_time)).verdict.reason


def test_the_dead_time_of_another_input_is_found_anew_beside_a_lead():
    """It stood in for the lead; that it gets shorter is none of its own."""
    samples = samples_of([two_inputs(0.02)], [[None]])
    free = Free(False, True, (True, True), 2.0, -1e-6, 150.0)
    fit = fit_at(samples, np.array([complex(-1.5, 4.2), -5.0]), np.array([0.1, 0.0]), free)
    found = lead_of_outputs(samples, fit, free, (True, True))
    assert found[0] == 0.0
    assert found[1] == pytest.approx(0.08, abs=0.01)


@pytest.mark.parametrize(('late', 'kind'), [
    (0.3, 'prbs'), (0.3, 'pilot'), *slow(
        *((late, kind) for late in (0.1, 0.3) for kind in KINDS if (late, kind) not in (
            (0.3, 'prbs'), (0.3, 'pilot'), (0.1, 'sweep'))))])
def test_a_lead_with_which_no_model_without_one_is_near_is_told(late, kind):
    """
    Predictions found poles that grow, or "does not follow the inputs", or a controller.

    Of a sweep a zero stands in for 0.1 s, and the model simulates as well.
    """
    rng = np.random.default_rng(0)
    t_u, t = np.arange(-1.0, 12.0, 0.02), np.arange(0.0, 10.0, 0.008) + rng.uniform(0, 1e-3, 1250)
    u = drive(kind, rng, t_u, 12.0, 2.0, 1)
    motor = StateSpace([[-4.0, 0.0], [25.0, -25.0]], [[4.0], [0.0]], [[0.0, 1.0]])
    y = motor.simulate((Signal(t_u, u, 'zoh'),), t)[:, 0]
    record = Record.from_arrays(t_u[50:], u[50:], t - late,
                                y + 0.02 * y.std() * rng.standard_normal(1250), input_hold='zoh')
    found = identify(record, Settings(feedthrough=False))
    assert not found.good
    assert 'answer about' in found.verdict.reason
    told = float(found.verdict.reason.split('answer about ')[1].split()[0])
    # To an interval of the input; a lag of 0.04 s, of the faster pole, may be taken for less lead
    assert late - 0.06 < told < late + 0.03


def test_outputs_that_come_only_at_the_end_break_no_search_for_leads():
    """A sensor that has returned: with all stamps of inputs earlier no sample is left."""
    record = stamped(SECOND, 0.0)
    y, = record.outputs
    late = y.time > 18.2
    found = identify(replace(record, outputs=(replace(y, time=y.time[late],
                                                      values=y.values[late]),)))
    assert not found.good
    free = Free(False, True, (True,), 1.0, -1e-6, 100.0)
    none = lead_by_search(samples_of([replace(record, outputs=(replace(
        y, time=y.time[late], values=y.values[late]),))], [[None]]), free, np.zeros(1))
    assert none.tolist() == [0.0]


def test_chance_finds_no_lead_in_noise():
    """Three states and any lead explain 1 % of this white noise, by more than their price."""
    given = experiment('no-white', 106, 0)
    found = identify(given.record, given.settings)
    assert 'answer about' not in found.verdict.reason
    assert 'does not follow the inputs' in found.verdict.reason


@pytest.mark.parametrize('seed', [8, *slow(16, 23, *range(24, 40))])
def test_sines_tell_no_lead(seed):
    """Of two integrators and a trim, moved by two sines: a lead is a lag of less than a period."""
    rng = np.random.default_rng(seed)
    speed, first = rng.uniform(0.3, 1.5), 2.0 * np.pi * rng.uniform(0.2, 0.5)
    p = plant([[-8.0, 0.0, 0.0], [speed, 0.0, 0.0], [0.0, 1.0, 0.0]], [[8.0], [0.0], [0.0]],
              [[0.0, 0.4, 1.0]])
    t_u, t = np.arange(-1.0, 12.0, 0.02), np.arange(0.0, 11.9, 0.01)
    u = (t_u >= 0.0) * (np.sin(first * t_u) + rng.uniform(0.4, 0.9) * np.sin(
        first * rng.uniform(2.2, 4.1) * t_u + rng.uniform(0.0, 6.0)))
    y = noisy(rng, held_response(p, t_u, u[:, np.newaxis], t), rng.uniform(15.0, 35.0))
    found = identify(Record.from_arrays(t_u, u, t, y, input_hold='zoh'))
    assert found.verdict.grade is not Grade.GOOD
    assert 'before input' not in found.verdict.reason


@pytest.mark.parametrize('seed', [14, *slow(15)])
def test_a_stick_tells_the_lead_of_a_lag(seed):
    """Its motion is at about two frequencies, and one suffices for the model: it was GOOD."""
    rng = np.random.default_rng(seed)
    t_u, t = np.arange(-2.0, 12.0, 0.02), np.arange(0.0, 12.0, 0.01)
    u = np.sin(np.outer(t_u, 2.0 * np.pi * rng.uniform(0.05, 0.4, 6))
               + rng.uniform(0.0, 6.0, 6)) @ rng.standard_normal(6)
    y = noisy(rng, held_response(LAG, t_u, u[:, np.newaxis], t), 30)
    found = identify(Record.from_arrays(t_u + 0.1, u, t, y, input_hold='zoh'))
    assert found.verdict.excitation[0].frequencies < 2.6
    assert found.verdict.reason.startswith('Outputs answer about 0.11 s before input u1 moves')


def test_inputs_that_move_together_are_asked_for_no_lead():
    """Of a sum of two others it was said that it is stamped 3.4 s late."""
    seen = tuple(Excitation('u', frequencies=9.0, own=own) for own in (0.0, 0.05, 0.5))
    assert _asked_for_leads((True, True, True), seen, 2) == (False, False, True)
