# SPDX-License-Identifier: Apache-2.0
"""
Pauses of all channels: nobody knows what moved there.

A network that drops out, a recorder that is paused: truths are plants whose inputs went on.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache
import re

from marks import slow
import numpy as np
from plants import held_response, noisy, plant
import pytest
from scipy.signal import lfilter

from ctsid_core import Grade, Record, Settings, Signal, Status, identify
from ctsid_core.likelihood.residuals import motion_within
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.model.verdict import Remedy
from ctsid_core.sequence.tracking import Tracker
from ctsid_core.settings import Actuator
from ctsid_core.signals.actuators import acting
from ctsid_core.signals.gaps import between_pauses, silent_at_end
from ctsid_ros.studies.robots.families import experiment
from ctsid_ros.verbs.simulate import timeouts_suggested

PLANT = plant([[0.0, 1.0], [-25.0, -5.0]], [[0.0], [25.0]], [[1.0, 0.0]])
POLE = -2.5 + 4.330127j


def moved(seed: int, duration: float = 12.0, gain=lambda t: 1.0, delay: float = 0.0):
    """Return stamps and samples of a held random command at 50 Hz, and of its answer at 100."""
    rng = np.random.default_rng(seed)
    t_u, t_y = np.arange(-1.0, duration, 0.02), np.arange(0.0, duration, 0.01)
    u = np.repeat(rng.choice((-1.0, 1.0), len(t_u)), 12)[:len(t_u), np.newaxis]
    u = u * np.array([gain(t) for t in t_u])[:, np.newaxis]
    return t_u, u, t_y, noisy(rng, held_response(PLANT, t_u + delay, u, t_y), 30.0)


def recorded(t_u, u, t_y, y, *pauses: tuple[float, float]) -> Record:
    """Return the record of what was not within pauses."""
    def known(t):
        return ~np.any([(a < t) & (t < b) for a, b in pauses], axis=0) if pauses else t > -9.0
    return Record.from_arrays(t_u[known(t_u)], u[known(t_u)], t_y[known(t_y)], y[known(t_y)],
                              input_hold='zoh')


def off(found) -> float:
    """Return how far the pole of an estimate is from the truth, over its size."""
    model = found.model or found.rejected_model
    return float(np.min(np.abs(model.poles - POLE))) / 5.0


@pytest.mark.parametrize('seed', [1, *slow(2, 3, 4)])
@pytest.mark.parametrize('pauses', [
    ((4.0, 6.0),), ((3.0, 3.6), (8.0, 8.4)), *slow((((0.5, 8.0),),))])
def test_what_moved_in_a_pause_is_no_error_of_the_model(pauses, seed):
    given = moved(seed)
    record = recorded(*given, *pauses)
    # Offsets begin anew: fits are over the motion within the parts.
    motion = np.std(np.concatenate([y - np.mean(y) for part in between_pauses(record)
                                    for y in [part.outputs[0].values]]))
    noise = 10.0 ** -1.5 * np.std(given[3]) / motion
    found = identify(record)
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.n == 2
    assert off(found) < 0.03
    assert found.fit[0] > 100.0 * (1.0 - noise) - 0.5
    assert not found.records
    when = 'from 4.0 to 6.0 s after the start' if pauses == ((4.0, 6.0),) else \
        'in 2 pauses, the longest from 3.0 to 3.6 s' if len(pauses) == 2 else 'from 0.5 to 8.0 s'
    assert [when in note for note in found.notes if 'nothing to be used' in note] == [True]


def test_a_pause_is_where_every_channel_misses_samples():
    t_u, u, t_y, y = moved(5)
    given = recorded(t_u, u, t_y, y, (4.0, 6.0))
    first, second = between_pauses(given)
    assert (first.start, first.end) == (0.0, pytest.approx(4.0, abs=0.021))
    assert second.start == pytest.approx(6.0, abs=0.021)
    assert second.end == given.end
    assert first.part_of is second.part_of is given
    assert first.inputs[0].time[0] == -1.0           # inputs act later: what came before is kept
    # One channel that goes on, or that is sent when it changes only, is no witness of a pause.
    lost = (t_y < 4.0) | (t_y > 6.0)
    few = ((t_u < 4.0) | (t_u > 6.0)) & (np.arange(len(t_u)) % 50 == 0)
    for times, values in ((t_u, u), (t_u[few], u[few])):
        own = Record.from_arrays(times, values, t_y[lost], y[lost], input_hold='zoh')
        assert between_pauses(own) == (own,)
    whole = recorded(t_u, u, t_y, y)
    assert between_pauses(whole) == (whole,)
    short = recorded(t_u, u, t_y, y, (4.01, 4.07))
    assert between_pauses(short) == (short,)


def test_a_part_with_one_sample_of_an_output_is_left_out():
    """There is no interval from it to a next one: a division by zero."""
    t_u, u, t_y, y = moved(0, 18.0)
    late = t_y + 0.003
    one = (late < 6.0) | (late > 12.0)
    one[np.searchsorted(late, 9.0)] = True
    outputs = (Signal(t_y, y), Signal(late[one], y[one]))
    record = Record((Signal(t_u, u, 'zoh'),), outputs, 0.0, 18.0)
    for pause in ((6.0, 7.0), (11.0, 12.0)):
        record = replace(record, **{name: tuple(replace(
            s, time=s.time[rows], values=s.values[rows]) for s in getattr(record, name)
            for rows in [(s.time < pause[0]) | (s.time > pause[1])]) for name in (
                'inputs', 'outputs')})
    assert [part.end < 7.0 or part.start > 11.0 for part in between_pauses(record)] == [True] * 2
    assert identify(record, Settings(order=2)).model is not None


def test_a_measured_input_that_is_missing_is_a_pause():
    """Straight lines through 0.6 s, in which it moved: a pole 14 % away, with 21 states."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 12.0, 0.01)
    u = lfilter([0.1], [1.0, -0.9], rng.standard_normal((len(t), 1)), axis=0)
    y = noisy(rng, held_response(PLANT, t, u, t), 40.0)
    known = (t < 5.0) | (t > 5.6)
    found = identify(Record.from_arrays(t[known] + 0.005, u[known], t, y, input_hold='smooth'))
    assert found.verdict.grade is Grade.GOOD
    assert found.model.n == 2
    assert off(found) < 0.02


@pytest.mark.parametrize('seed', [5, *slow(6, 7, 8)])
def test_a_held_input_that_went_on_while_it_was_silent_pauses(seed):
    """A recorder lost a command that went on, and the robot moved: outputs had no cause."""
    t_u, u, t_y, y = moved(seed)
    lost = (t_u > 5.0) & (t_u < 7.0)
    given = Record.from_arrays(t_u[~lost], u[~lost], t_y, y, input_hold='zoh')
    first, second = between_pauses(given, lost=True)
    # What was sent last, at 4.98 s, is known for as long as a usual interval.
    assert (first.end, second.start) == pytest.approx((5.0, 7.0))
    found = identify(given)
    assert found.good
    assert off(found) < 0.02
    assert any('nothing to be used from 5.0 to 7.0 s' in note for note in found.notes)


@pytest.mark.parametrize('seed', [5, *slow(6, 7, 8)])
@pytest.mark.parametrize('again', [1, 5])
def test_a_held_input_that_stays_while_it_is_silent_does_not_pause(again, seed):
    """Sent when it changes, as goals are, or a few times, as while a key is held."""
    t_u, u, t_y, y = moved(seed)
    changes = np.flatnonzero(np.append(True, np.diff(u[:, 0]) != 0.0))
    sent = np.unique(np.minimum(changes[:, np.newaxis] + np.arange(again), len(t_u) - 1))
    given = Record.from_arrays(t_u[sent], u[sent], t_y, y, input_hold='zoh')
    found = identify(given)
    assert found.good
    assert off(found) < 0.01
    assert not any('pause' in note or 'nothing to be used' in note for note in found.notes)


@cache
def commanded(seed: int, *timeouts: float | None, duration: float = 60.0) -> Record:
    """
    Return a base driven by keys that are held for a while, sent at 20 Hz; of as many inputs.

    Each of them is 0 from a timeout after its last message on, or (None) holds.
    """
    rng, t = np.random.default_rng(seed), np.arange(0.0, duration, 0.005)
    inputs, acts = [], np.zeros((len(t), len(timeouts)))
    for j, timeout in enumerate(timeouts):
        sent, command, begins = [], [], rng.uniform(0.1, 0.6)
        while begins < duration - 5.0:
            stamps = begins + 0.05 * np.arange(rng.integers(5, 30))
            value = rng.choice((-1.0, 1.0)) * rng.choice((0.5, 1.0))
            following = stamps[-1] + rng.uniform(0.85, 3.0)
            stops = stamps[-1] + (timeout or duration)
            acts[(t >= begins) & (t < stops), j] = value
            acts[t >= following, j] = 0.0
            sent, command, begins = [*sent, stamps], [*command, value + 0.0 * stamps], following
        if timeout is None:
            acts[t >= sent[-1][0], j] = command[-1][0]
        inputs.append(Signal(np.concatenate(sent), np.concatenate(command)[:, np.newaxis], 'zoh',
                             ('vw'[j],)))
    t_y = np.arange(0.0, duration - 2.0, 0.02)
    truth = PLANT if len(inputs) == 1 else TWO
    y = noisy(rng, held_response(truth, t, acts, t_y), 30.0)
    return Record.from_signals(inputs, (Signal(t_y, y),))


@cache
def _that_stops() -> Tracker:
    tracker = Tracker()
    tracker.take(commanded(5, 0.5, duration=30.0))
    return tracker


def that_stops() -> Tracker:
    """Return a tracker of its own that has taken a window of a base with a timeout."""
    return deepcopy(_that_stops())


TWO = plant([[-4.0, 0.0], [0.0, -7.0]], [[4.0, 0.0], [0.0, 5.6]], [[1.0, 0.0], [0.0, 1.0]])


@pytest.mark.parametrize('seed', [5, *slow(6, 7, 8)])
@pytest.mark.parametrize('timeout', [0.5, *slow(0.25, 0.2, 0.6, 0.8, 1.0)])
def test_a_timeout_that_stops_the_robot_is_found(timeout, seed):
    """Models of what was held were GOOD by their predictions, with gains halved."""
    found = identify(commanded(seed, timeout))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.timeout == pytest.approx((timeout,), rel=0.02)
    assert found.settings.timeout == found.model.timeout[0]
    assert off(found) < 4.0 * np.max(found.pole_std) / 5.0
    assert found.model.dc_gain[0, 0] == pytest.approx(1.0, abs=4.0 * found.dc_gain_std[0, 0])
    assert any(c.name == 'timeout' for c in found.choices)
    assert any(n.startswith('input v counts as 0 from') for n in found.notes)
    other = commanded(seed + 100, timeout)
    assert simulation(found.model, other).fit[0] > 95.0
    assert simulation(replace(found.model, actuators=(Actuator(0.0),)), other).fit[0] < 70.0
    settled, simulated = other.outputs[0].time > 5.0, found.model.simulate(
        other.inputs, other.outputs[0].time)
    assert np.std((simulated - other.outputs[0].values)[settled]) < 0.05 * np.std(simulated)
    again = identify(commanded(seed, timeout), found.settings)
    assert again.model.timeout == found.model.timeout
    assert again.good


@pytest.mark.parametrize('seed', [5, *slow(6, 7)])
def test_a_base_that_holds_has_no_timeout(seed):
    given = commanded(seed, None)
    found = identify(given)
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.timeout == (0.0,)
    assert off(found) < 0.01
    told = identify(given, Settings(timeout=0.0))
    assert told.model == found.model
    assert not any('timeout' in words for words in (*found.notes, *map(str, found.choices)))


@pytest.mark.parametrize(('timeouts', 'seed'), [
    *slow(*((timeouts, seed) for timeouts in ((0.5, None), (None, 0.5)) for seed in (1, 4, 5)),
          *(((0.5, t), seed) for t in (0.5, 1.0) for seed in (1, 4, 5)))])
def test_commands_of_two_topics_have_timeouts_of_their_own(timeouts, seed):
    found = identify(commanded(seed, *timeouts))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.timeout == pytest.approx([t or 0.0 for t in timeouts], rel=0.02)
    assert np.diag(found.model.dc_gain) == pytest.approx([1.0, 0.8], rel=0.02)


def test_channels_of_one_message_share_a_timeout():
    one, other = (commanded(seed, 0.5, duration=25.0) for seed in (3, 4))
    found = identify([one, other])
    assert found.model.timeout == pytest.approx((0.5,), rel=0.02)
    assert found.good


def test_a_channel_that_is_constant_while_it_is_sent_moves_by_its_timeout():
    one = commanded(5, 0.5, duration=30.0)
    values = np.hstack((one.inputs[0].values, np.full((len(one.inputs[0].time), 1), 0.3)))
    found = identify(replace(one, inputs=(replace(one.inputs[0], values=values,
                                                  names=('v', 'w')),)))
    assert found.model.timeout == pytest.approx((0.5, 0.5), rel=0.05)
    assert found.model.dc_gain[0, 0] == pytest.approx(1.0, abs=0.05)


def test_keys_of_one_speed_move_by_their_timeout_alone():
    one = commanded(5, 0.5)
    sent = replace(one.inputs[0], values=np.ones_like(one.inputs[0].values))
    found = identify(replace(one, inputs=(sent,)))
    assert found.verdict.reason.endswith('a timeout stops the robot while v is silent, set '
                                         '`v.timeout`.')
    assert found.verdict.remedy is Remedy.SETTING
    still = replace(sent, values=np.zeros_like(sent.values))
    assert 'timeout' not in identify(replace(one, inputs=(still,))).verdict.reason


def test_a_timeout_is_kept_where_commands_are_lost_too():
    one = commanded(5, 0.5)
    t, values = one.inputs[0].time, one.inputs[0].values
    kept = ~np.any([(a < t) & (t < a + 3.0) for a in (10.0, 25.0, 45.0)], axis=0)
    found = identify(replace(one, inputs=(replace(one.inputs[0], time=t[kept],
                                                  values=values[kept]),)))
    assert found.model.timeout == pytest.approx((0.5,), rel=0.05)
    assert found.model.dc_gain[0, 0] == pytest.approx(1.0, abs=0.03)
    assert found.fit[0] > 80.0                          # 70 % where it is not divided there
    assert any('nothing to be used' in note for note in found.notes)
    assert any(c.name == 'timeout' for c in found.choices)
    assert any('counts as 0' in note for note in found.notes)


def test_a_window_knows_of_silence_that_begins_before_it():
    given = commanded(6, 0.5)
    begins = given.inputs[0].time[np.argmax(np.diff(given.inputs[0].time) > 2.0)] + 0.3
    found = identify(given.between(begins, begins + 20.0), Settings(timeout=0.5))
    assert found.fit[0] > 95.0
    assert off(found) < 0.02


@pytest.mark.parametrize('seed', [21, *slow(25, 35, 39, 44)])
def test_a_timeout_is_found_where_what_was_held_only_predicts(seed):
    """Someone drives faster and faster: the model of what was held is of a plant that grows."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 14.0, 0.005)
    sent, command, begins, acts = [], [], 0.3, np.zeros((len(t), 1))
    while begins < 13.5:
        stamps = begins + 0.05 * np.arange(rng.integers(20, 60))
        value = rng.choice((-1.0, 1.0)) * rng.choice((0.5, 1.0)) * 30.0 ** (begins / 14.0)
        following = stamps[-1] + rng.uniform(1.0, 1.5)
        acts[(t >= begins) & (t < stamps[-1] + 0.5)] = value
        sent, command, begins = [*sent, stamps], [*command, value + 0.0 * stamps], following
    t_y, base = np.arange(0.0, 13.0, 0.02), plant([[-4.0]], [[4.0]], [[1.0]])
    given = Record.from_arrays(
        np.concatenate(sent), np.concatenate(command)[:, np.newaxis], t_y,
        noisy(rng, held_response(base, t, acts, t_y), 30.0), input_hold='zoh')
    held = identify(given, Settings(feedthrough=False, timeout=0.0))
    assert held.by_predictions
    assert np.max((held.model or held.rejected_model).poles.real) > 0.1
    found = identify(given, Settings(feedthrough=False))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.timeout == pytest.approx((0.5,), rel=0.02)
    assert found.model.poles == pytest.approx([-4.0], rel=0.03)
    assert found.model.dc_gain[0, 0] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(('acts', 'told'), [(0.5, True), (None, False)])
def test_a_model_that_holds_is_told_of_a_timeout_in_another_recording(acts, told):
    given = commanded(5, acts)
    holds = StateSpace(PLANT.A, PLANT.B, PLANT.C, input_names=('v',), output_names=('y',))
    said = timeouts_suggested(holds, given, simulation(holds, given))
    assert any('`v.timeout: 0.5`' in words for words in said) == bool(said) == told
    stops = replace(holds, actuators=(Actuator(0.5),))
    assert not timeouts_suggested(stops, given, simulation(stops, given))


def windows(given: Record, length: float = 10.0) -> list[Record]:
    return [given.between(a, a + length) for a in np.arange(0.0, given.end - length, 5.0)]


@pytest.mark.parametrize(('seed', 'last'), slow((5, 3), (11, 3)))
def test_a_window_with_few_silences_takes_the_timeout_of_those_before(seed, last):
    """Of 180 windows with a budget of 0.8 s 24 were not GOOD, each alone."""
    settings = Settings(budget=4.0)
    taken, joined, few = Tracker(settings), Tracker(settings), 0
    for window in windows(commanded(seed, 0.5))[:last]:
        alone = identify(window, settings)
        few += not alone.good
        found = taken.take(window).estimate
        assert found.good, found.verdict.reason
        assert found.model.timeout == pytest.approx((0.5,), rel=0.1)
        assert found.model.dc_gain[0, 0] == pytest.approx(1.0, abs=0.05)
        assert (found.model.timeout == alone.model.timeout if alone.good and any(
            alone.model.timeout) else any('as in windows before' in n for n in found.notes))
        assert found.settings.budget == settings.budget
        other = joined.join(window, alone).estimate
        assert (other.model, other.settings) == (found.model, found.settings)
    assert few


def test_a_window_without_silence_keeps_the_timeout_of_those_before():
    tracker, given = that_stops(), commanded(5, 0.5, duration=30.0)
    own = moved(5)
    without = replace(recorded(*own), epoch_ns=given.epoch_ns + round(1e11))
    alone = identify(without)
    assert alone.model.timeout == (0.0,)
    found = tracker.take(without).estimate
    assert found.model.timeout == pytest.approx((0.5,), rel=0.02)
    assert found.fit == alone.fit


def test_a_timeout_that_is_no_more_is_forgotten():
    tracker, holds = that_stops(), commanded(6, None, duration=30.0)
    for k in (1, 2):
        later = replace(holds, epoch_ns=holds.epoch_ns + round(k * 1e11))
        assert tracker.take(later).estimate.model.timeout == (0.0,)


@pytest.mark.parametrize(('timeout', 'told'), [
    (0.52, False), (0.4, True), *slow((0.0, True), (1.0, True), (0.25, True))])
def test_another_timeout_than_is_given_is_told(timeout, told):
    found = identify(commanded(5, 0.5, duration=30.0), Settings(timeout=timeout))
    assert found.model is None or found.model.timeout == (timeout,)
    assert ('`v.timeout: 0.5`' in found.verdict.reason) == told
    assert not (told and found.good)


def test_what_acts_is_zero_after_a_timeout():
    given = Signal(np.array([0.0, 0.1, 1.0, 2.0]), np.array([[2.0], [3.0], [0.0], [4.0]]), 'zoh')
    found, = acting((given,), (Actuator(0.5),))
    assert found.time.tolist() == [0.0, 0.1, 0.6, 1.0, 2.0, 2.5]
    assert found.values.ravel().tolist() == [2.0, 3.0, 0.0, 0.0, 4.0, 0.0]
    assert acting((found,), (Actuator(0.5),)) == (found,)
    for signal, timeout in ((given, 0.0), (replace(given, hold='linear'), 0.5)):
        assert acting((signal,), (Actuator(timeout),)) == (signal,)


@pytest.mark.parametrize('seed', [1, *slow(2, 3, 4)])
def test_commands_that_are_lost_are_no_timeout(seed):
    """Twelve times for 2 s: they were WEAK as if a timeout stopped them."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 60.0, 0.05)
    u = np.repeat(rng.choice((-1.0, 1.0), len(t)) * rng.choice((0.5, 1.0), len(t)), 14)
    u, t_y = u[:len(t), np.newaxis], np.arange(0.0, 58.0, 0.04)
    y = noisy(rng, held_response(PLANT, t, u, t_y), 30.0)
    lost = np.any([(a < t) & (t < a + 2.0) for a in np.linspace(3.0, 55.0, 12)], axis=0)
    found = identify(Record.from_arrays(t[~lost], u[~lost], t_y, y, input_hold='zoh'))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.timeout == (0.0,)
    assert off(found) < 0.01


def test_samples_that_come_in_bursts_are_no_parts():
    t = np.concatenate([k + np.arange(8) * 0.01 for k in np.arange(0.0, 6.0, 0.8)])
    bursts = Record.from_arrays(t, np.sin(t), t, np.cos(t))
    assert between_pauses(bursts) == (bursts,)


@pytest.mark.parametrize(('period', 'seeds'), [(0.25, 1), *slow((0.25, 3), (0.1, 3), (0.2, 3))])
def test_clumps_of_arrival_are_no_parts(period, seeds):
    """All that arrives at a time is of some milliseconds: none is an experiment."""
    for seed in range(seeds):
        t_u, u, t_y, y = moved(seed)
        late = recorded(clumped(t_u, period), u, clumped(t_y, period), y)
        assert between_pauses(late) == (late,)
        assert identify(late, Settings(feedthrough=False)).verdict.reason


def test_short_experiments_of_a_long_recording_are_parts():
    t_u, u, t_y, y = moved(1)
    every = 1800.0 * np.arange(12)[:, np.newaxis]
    record = recorded((t_u + 1.0 + every).ravel(), np.tile(u, (12, 1)),
                      (t_y + 1.0 + every).ravel(), np.tile(y, (12, 1)))
    assert len(between_pauses(record)) == 12


def clumped(time, period):
    clumps = np.ceil(time / period) * period
    return np.maximum.accumulate(clumps) + 1e-5 * np.arange(len(time))


def test_where_most_samples_are_in_short_parts_all_are_used():
    t = np.concatenate([k + np.arange(15 if k else 30) * 0.01 for k in np.arange(0.0, 12.0)])
    bursts = Record.from_arrays(t, np.sin(t), t, np.cos(t))
    assert between_pauses(bursts) == (bursts,)


def test_an_output_may_be_seldom_in_a_part():
    """Nine and ten samples of it: all parts are used."""
    t_u, u, t_y, y = moved(18)
    given = recorded(t_u, u, t_y, y, (4.0, 7.0))
    slow_one = np.arange(0.0, 12.0, 0.5)
    slow_one = slow_one[(slow_one <= 4.0) | (slow_one >= 7.0)]
    seldom = Signal(slow_one, np.interp(slow_one, t_y, y[:, 0])[:, np.newaxis], 'smooth', ('q',))
    both = replace(given, outputs=(*given.outputs, seldom))
    found = identify(both)
    assert len(between_pauses(both)) == 2
    assert not any('left out' in note for note in found.notes)
    assert found.status is Status.OK


def test_motion_is_within_a_tenth_of_the_recording():
    t = np.arange(0.0, 20.0, 0.01)
    known = (t < 9.9) | (t > 10.3)
    whole = Record.from_arrays(t, np.sin(0.5 * t), t, np.sin(0.5 * t))
    parts = between_pauses(Record.from_arrays(
        t[known], np.sin(0.5 * t[known]), t[known], np.sin(0.5 * t[known])))
    assert len(parts) == 2
    of_all, of_parts = (motion_within(samples, [tuple(
        np.zeros_like(s.y) for s in r.streams) for r in samples.records]) for samples in (
            samples_of([whole], [[None]]), samples_of(parts, [[None]] * 2)))
    assert of_parts == pytest.approx(of_all, rel=0.05)


@pytest.mark.slow
def test_a_short_part_does_not_keep_a_model_from_its_test():
    """What is held out of it leaves too few samples, but of all parts there are many."""
    rng = np.random.default_rng(32)
    at = rng.uniform(0.5, 18.0, 4)
    t_u, t_y = np.arange(-1.0, 20.0, 0.02), np.arange(0.0, 20.0, 0.01)
    u = np.repeat(rng.choice((-1.0, 1.0), len(t_u)), 12)[:len(t_u), np.newaxis]
    y = noisy(rng, held_response(PLANT, t_u + 0.3, u, t_y), 35.0)
    found = identify(recorded(t_u, u, t_y, y, *((a, a + 0.6) for a in at)))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert np.isfinite(found.held_out_fit).all()


def test_notes_on_parts_of_one_record_have_no_number():
    t_u, u, t_y, y = moved(19)
    y[200] += 5.0
    found = identify(recorded(t_u, u, t_y, y, (4.0, 6.0)))
    assert any('corrupt' in note for note in found.notes)
    assert not any(note.startswith('record ') for note in found.notes)


def test_parts_too_short_are_left_out():
    given = recorded(*moved(6), (3.0, 3.5), (3.6, 6.0))
    assert [round(part.start) for part in between_pauses(given)] == [0, 6]


def test_a_window_that_begins_in_a_pause_knows_no_command_before_it():
    """The last command before it was held for the pause, and the model was of another plant."""
    given = recorded(*moved(7, 30.0), (8.0, 12.0))
    window = given.between(10.5, 20.5, lead=3.0)
    found = identify(window)
    after = identify(recorded(*moved(7, 30.0)).between(12.02, 20.5))
    assert found.verdict.grade is Grade.GOOD
    assert off(found) < 0.03
    assert np.max(np.abs(found.model.poles - after.model.poles)) < 0.2
    assert any('from 0.0 to 1.5 s after the start' in note for note in found.notes)


@pytest.mark.slow
def test_a_drift_goes_on_through_a_pause():
    given = moved(8, 14.0, gain=lambda t: 0.7 + 0.6 * t / 14.0)
    command = np.sign(given[1])
    found = identify(recorded(given[0], command, *given[2:], (6.0, 7.5)))
    told = re.search(r'the gain of u1 by \+(\d+) % from start to end', found.verdict.reason)
    assert float(told[1]) == pytest.approx(60.0, abs=5.0)
    assert found.model.n == 2
    assert off(found) < 0.03


@pytest.mark.slow
def test_a_change_in_a_pause_is_told_with_its_time():
    given = moved(9, gain=lambda t: 1.0 if t < 5.5 else 1.6)
    command = np.sign(given[1])
    found = identify(recorded(given[0], command, *given[2:], (5.0, 6.0)))
    assert found.status is Status.CHANGED
    assert 'The plant changed about' in found.verdict.reason
    assert 4.9 < found.statistics['change_share'] * 12.0 < 6.1


@pytest.mark.parametrize(('seed', 'pauses'), [
    (9, ((3.0, 3.3), (8.0, 8.3))), *slow((2, ((2.0, 2.2), (6.3, 6.5), (9.0, 9.2))))])
def test_a_change_between_pauses_is_told_with_its_time(seed, pauses):
    """Beside parts all of another plant; their own states imitated it, and it was GOOD."""
    given = moved(seed, gain=lambda t: 1.0 if t < 6.0 else 1.6)
    found = identify(recorded(given[0], np.sign(given[1]), *given[2:], *pauses))
    assert found.status is Status.CHANGED
    assert found.statistics['change_share'] * 12.0 == pytest.approx(6.0, abs=0.5)


def test_what_is_known_through_a_pause_of_another_channel_is_kept():
    """A command that was sent before it, and outputs of any rate, do not end a part."""
    t_u, u, t_y, y = moved(15)
    known = (t_u < 6.0) | (t_u > 6.4)
    measured = Signal(t_u[known], u[known], 'linear')
    other = Signal(np.array([0.0, 1.0, 2.0, 3.0]), np.array([[0.0], [1.0], [0.0], [1.0]]), 'zoh')
    seldom = Signal(np.arange(0.0, 4.0), np.zeros((4, 1)), 'smooth')
    given = Record((measured, other), (Signal(t_y, y), seldom), 0.0, 11.9)
    first, second = between_pauses(given)
    assert (first.start, second.end) == (0.0, 11.9)
    assert (first.end, second.start) == (pytest.approx(6.0, abs=0.021),
                                         pytest.approx(6.4, abs=0.021))
    assert second.inputs[1].values[-1] == 1.0
    assert second.inputs[0].time[0] >= 6.4


@pytest.mark.parametrize('end', [10.0, 10.02])
def test_the_last_sample_of_a_measured_input_is_no_pause(end):
    t_u, u, t_y, y = moved(16)
    seen = t_u < 10.0
    given = Record((Signal(t_u[seen], u[seen], 'smooth'),), (Signal(t_y, y),), 0.0, end)
    assert between_pauses(given) == (given,)


def test_short_pauses_of_a_slow_plant_are_bridged():
    """States and offsets anew after each would cost more than what it moves in them."""
    rng, t = np.random.default_rng(3), np.arange(0.0, 100.0, 0.01)
    u = np.cumsum(rng.standard_normal((len(t), 1)), axis=0) / 100.0
    y = noisy(rng, held_response(plant([[-0.1]], [[0.1]], [[1.0]]), t, u, t), 34.0)
    gaps = rng.uniform(1.0, 99.0, 40)
    known = ~np.any([(a < t) & (t < a + 0.08) for a in gaps], axis=0)
    found = identify(Record.from_arrays(t[known], u[known], t[known], y[known], input_hold='zoh'))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert found.model.poles.real == pytest.approx([-0.1], rel=0.01)


def test_the_offset_of_a_part_without_samples_is_not_told():
    given = moved(17, delay=1.5)
    record = recorded(*given, (11.0, 11.5))
    model = replace(identify(recorded(*given)).model, delay=(1.5,))
    model = replace(model, y_trim=model.y_trim - 7.0)
    assert simulation(model, record, trim='refit').offset == pytest.approx(7.0, abs=0.1)


def test_records_with_pauses_are_counted_as_they_were_given():
    t_u, u, t_y, y = moved(10)
    early = (t_y < 4.0)[:, np.newaxis]
    noise = 0.1 * np.random.default_rng(0).standard_normal(y.shape)
    one, other = recorded(t_u, u, t_y, y, (4.0, 6.0)), recorded(*moved(11))
    loud = identify([recorded(t_u, u, t_y, y + early * noise, (4.0, 6.0)), other])
    assert loud.records[0].fit[0] < 92.0             # of both parts, not of the last one
    found = identify([one, other])
    assert found.verdict.grade is Grade.GOOD
    assert [share.number for share in found.records] == [1, 2]
    assert [(s.end_ns - s.start_ns) * 1e-9 for s in found.records] == pytest.approx([12, 12], 0.01)
    assert np.min([share.fit for share in found.records]) > 96.0
    assert any(n.startswith('there is nothing to be used from 4.0 to 6.0 s after the start of '
                            'record 1') for n in found.notes)


@pytest.mark.parametrize('delay', [0.0, 0.3])
def test_a_simulation_begins_anew_after_a_pause(delay):
    given = moved(12, delay=delay)
    model = replace(identify(recorded(*given)).model, delay=(delay,))
    for trim in ('model', 'refit'):
        found = simulation(model, recorded(*given, (4.0, 6.0)), trim=trim)
        assert found.fit[0] > 96.0
        assert np.all(np.diff(found.times) > 0.0)
        assert found.y_hat.shape == found.y.shape == (len(found.times), 1)
        # Not before a delayed input is known again.
        assert not np.any((4.0 < found.times) & (found.times < 6.0 + delay - 1e-9))


def test_a_model_is_tested_on_new_data_beyond_a_pause():
    given, tracker = recorded(*moved(13, 30.0), (11.0, 12.5)), Tracker()
    tracker.take(given.between(0.0, 10.0))
    later = tracker.take(given.between(5.0, 15.0))
    assert later.fresh_fit[0] > 95.0
    assert later.estimate.verdict.grade is Grade.GOOD


@pytest.mark.slow
def test_a_channel_with_a_single_sample_in_a_part_is_no_reason_to_fail():
    t_u, u, t_y, y = moved(14)
    other = Signal(np.array([0.0, 0.5, 5.0, 11.9]), np.ones((4, 1)) * [[0], [1], [0], [1]], 'zoh')
    given = recorded(t_u, u, t_y, y, (4.0, 6.0))
    both = Record.from_signals((*given.inputs, other), given.outputs)
    assert between_pauses(both) == (both,)
    identify(both)


@pytest.mark.slow
def test_a_part_whose_inputs_are_known_at_its_end_only_is_no_reason_to_fail():
    """A base drives again as its recording ends, after odometry was lost for a while."""
    given = commanded(5, 0.5, 0.5, duration=30.0)

    def without(signals, first, last):
        return tuple(replace(s, time=s.time[known], values=s.values[known])
                     for s in signals for known in [(s.time < first) | (s.time > last)])
    record = Record.from_signals(without(given.inputs, 5.6, 9.9), without(given.outputs, 6.0, 9.0))
    found = identify(record.between(0.0, 10.5))
    assert np.sort(found.model.poles.real) == pytest.approx([-7.0, -4.0], rel=0.1)


@pytest.mark.parametrize('family', ['flexible-joint', *slow(
    'random-2x2', 'pendulum', 'backlash', 'slow-pole', 'sensor-lowpass')])
def test_robots_that_pause(family):
    """Of 66 usable experiments 31 were GOOD with a pause of 15 % in the middle, now 60."""
    given = experiment(family, 58, 1)
    r, (a, b) = given.record, (0.4 * given.record.duration, 0.55 * given.record.duration)

    def cut(signals):
        return tuple(replace(s, time=s.time[keep], values=s.values[keep]) for s in signals
                     for keep in [(s.time < r.start + a) | (s.time > r.start + b)])
    found = identify(replace(r, inputs=cut(r.inputs), outputs=cut(r.outputs)), given.settings)
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason


@pytest.mark.parametrize(('stamps', 'silent'), [
    (np.arange(0.0, 10.0, 0.01), 0.0), (np.arange(0.0, 8.95, 0.01), 1.06),
    (np.arange(0.2, 8.5, 1.0), 0.0), (np.arange(0.2, 7.5, 1.0), 2.8),      # a slow sensor
    (np.concatenate([s + np.arange(0.0, 1.0, 0.02) for s in (0.0, 2.5, 5.0)]), 4.02),   # in duty
    (np.concatenate([s + np.arange(0.0, 1.0, 0.02) for s in (0.0, 2.5, 5.0, 7.5)]), 0.0)])
def test_silence_at_the_end_is_longer_than_any_before_it(stamps, silent):
    """Of outputs, and of inputs that are not held."""
    here, there = Signal(stamps, stamps[:, np.newaxis]), Signal(
        np.array([0.0, 9.9]), np.array([[1.0], [2.0]]), 'zoh')
    for record, name in ((Record((there,), (here,), 0.0, 10.0), 'y1'),
                         (Record((replace(here, hold='linear'),), (there,), 0.0, 10.0), 'u1'),
                         (Record((replace(here, hold='zoh'),), (there,), 0.0, 10.0), '')):
        found = silent_at_end(record)
        assert [one for one, _ in found] == ([name] if silent and name else [])
        assert not found or found[0][1] == pytest.approx(silent, abs=1e-9)


def test_a_part_without_samples_of_an_input_is_none():
    """Of 2 s without commands outputs know the middle; the test of the last model died of it."""
    t_u, u, t_y, y = moved(1, duration=14.0)
    heard = ~((t_u > 6.0) & (t_u < 8.0))
    seen = ~(((t_y > 6.0) & (t_y < 6.6)) | ((t_y > 7.4) & (t_y < 8.0)))
    record = Record.from_arrays(t_u[heard], u[heard], t_y[seen], y[seen], input_hold='zoh')
    assert all(len(s.time) for part in between_pauses(record) for s in part.inputs)
    tracker = Tracker(Settings(order=2))
    found = [tracker.take(record.between(start, start + 10.0)) for start in (0.0, 2.0, 4.0)]
    assert found[0].estimate.good
    assert min(t.fresh_fit[0] for t in found[1:]) > 95.0
