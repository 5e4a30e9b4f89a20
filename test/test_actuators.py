# SPDX-License-Identifier: Apache-2.0
"""What lies before the plant: what acts of a command, by definition, and found from the data."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
import re

from marks import slow
import numpy as np
from plants import LINEAR, held_response, noisy, plant
import pytest

from ctsid_core.identify import identify
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.model.verdict import Grade, Remedy
from ctsid_core.sequence.tracking import Tracker
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.actuators import acting, as_acting, in_words, settled
from ctsid_core.signals.gaps import between_pauses
from ctsid_core.signals.loop import in_loop
from ctsid_core.signals.record import Record, Signal

PLANT = plant([[0.0, 1.0], [-16.0, -4.8]], [[0.0], [16.0]], [[1.0, 0.0]])
FINE = 0.001        # [s]
EACH = {'dead_zone': 0.3, 'limit': 0.7, 'backlash': 0.4, 'rate_limit': 1.5}


def brute(t, u, kind: str, value: float, t_u) -> np.ndarray:
    """Return what acts on a fine grid by the definitions, step by step; at rest before."""
    sent = np.where(t >= t_u[0], u[np.maximum(np.searchsorted(t_u, t, side='right') - 1, 0)], 0.0)
    if kind == 'dead_zone':
        return np.where(np.abs(sent) > value, sent - np.sign(sent) * value, 0.0)
    if kind == 'limit':
        return np.minimum(np.maximum(sent, -value), value)
    place, found = 0.0, np.empty(len(t))
    for k, wanted in enumerate(sent):
        if kind == 'rate_limit':
            place += max(min(wanted - place, value * FINE), -value * FINE)
        elif abs(wanted - place) > 0.5 * value:
            place = wanted - 0.5 * value * np.sign(wanted - place)
        found[k] = place
    return found


@cache
def driven(seed: int, kind: str = '', value: float = 0.0, *, size: float = 1.0,
           duration: float = 30.0, noise: float | None = 30.0) -> Record:
    """Return a robot under levels of many sizes, what acts of them behind one actuator."""
    rng = np.random.default_rng(seed)
    t_u = np.cumsum(np.append(0.5, rng.uniform(0.3, 1.2, int(duration / 0.6))))
    t_u = t_u[t_u < duration]
    u = size * rng.uniform(-1.2, 1.2, len(t_u))
    t, t_y = np.arange(0.0, duration, FINE), np.arange(0.0, duration, 0.02)
    acts = brute(t, u, kind, value, t_u)
    y = held_response(PLANT, t, acts[:, np.newaxis], t_y)
    # A message each 50 ms, as drivers want it
    sent = np.arange(0.0, duration, 0.05)
    stamps = np.union1d(sent, t_u)
    held = np.where(stamps >= t_u[0], u[np.maximum(
        np.searchsorted(t_u, stamps, side='right') - 1, 0)], 0.0)
    return Record.from_arrays(stamps, held[:, np.newaxis], t_y, noisy(rng, y, noise),
                              input_hold='zoh')


@pytest.mark.parametrize('kind', EACH)
def test_what_acts_is_what_the_definition_says(kind):
    given = driven(3).inputs[0]
    acts, = acting((given,), (Actuator(**{kind: EACH[kind]}),))
    t = np.arange(0.0, 29.0, FINE)
    wanted = brute(t, given.values[:, 0], kind, EACH[kind], given.time)
    found = np.interp(t, acts.time, acts.values[:, 0]) if acts.hold == 'linear' else \
        acts.values[np.searchsorted(acts.time, t, side='right') - 1, 0]
    assert np.max(np.abs(found - wanted)) < 1.5 * FINE * EACH['rate_limit'] * (
        kind == 'rate_limit') + 1e-12
    assert acting((given,), (Actuator(),)) == (given,)
    measured = replace(given, hold='smooth')
    assert acting((measured,), (Actuator(**{kind: EACH[kind]}),)) == (measured,)


@pytest.mark.parametrize('seed', [1, *slow(2, 3, 4, 5, 6)])
@pytest.mark.parametrize('kind', ['dead_zone', 'rate_limit', *slow('limit', 'backlash')])
def test_what_lies_before_a_plant_is_found_and_the_plant_behind_it_is_right(kind, seed):
    found = identify(driven(seed, kind, EACH[kind]))
    assert found.good, found.verdict.reason
    own, = found.model.actuators
    assert getattr(own, kind) == pytest.approx(EACH[kind], rel=0.05)
    assert sum(map(bool, own)) == 1
    assert found.model.n == 2
    assert np.sort_complex(found.model.poles) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(PLANT.A)), rel=0.05)
    assert found.model.dc_gain[0, 0] == pytest.approx(1.0, abs=0.03)
    assert any(c.name == kind for c in found.choices)
    told, = in_words(found.model.input_names, (own,))
    assert any(re.sub(r' ± [-\de.]+', '', note) == told for note in found.notes)
    # Motions of other sizes, which linear models of this record do not tell
    other = driven(seed + 50, kind, EACH[kind], size=2.0, noise=None)
    linear = identify(driven(seed, kind, EACH[kind]), LINEAR)
    line = linear.model or linear.rejected_model
    assert not any(line.actuators[0])
    fits = [simulation(m, other, trim='refit').fit[0] for m in (found.model, line)]
    assert fits[0] > 96.0
    assert fits[1] < 90.0
    # The numbers may be given, too.
    again = identify(driven(seed, kind, EACH[kind]), found.settings)
    assert again.model.actuators == found.model.actuators
    assert not any(c.name == kind for c in again.choices)


@pytest.mark.parametrize('seed', [1, *slow(2, 3, 4, 5, 6)])
@pytest.mark.parametrize('noise', [30.0, *slow(15.0)])
def test_a_plant_that_is_linear_has_nothing_before_it(seed, noise):
    found = identify(driven(seed, noise=noise))
    assert found.good
    assert not any(found.model.actuators[0])


def test_where_ramps_and_gears_begin_is_not_known():
    """A robot at rest is sent a command before the record: the ramp is under way at its start."""
    stamps = np.array([0.0, 4.0, 8.0])
    held = Signal(stamps, np.array([[1.0], [-1.0], [0.5]]), 'zoh', ('u',))
    y = Signal(np.arange(0.0, 20.0, 0.02), np.zeros((1000, 1)), 'smooth', ('y',))
    record = Record((held,), (y,), 0.0, 19.9)
    acts = settled(record, (Actuator(rate_limit=0.5),))
    assert acts.start == pytest.approx(4.0)     # from -1 to 1 at 0.5 a second
    assert as_acting(record, (Actuator(rate_limit=0.5),)).start == 0.0
    assert as_acting(acts, (Actuator(rate_limit=0.5),)).commands == (held,)
    assert settled(record, (Actuator(rate_limit=0.1),)).start == 0.0    # never known: as if sent
    assert settled(record, (Actuator(limit=0.5),)).start == 0.0
    # Nothing is beyond a limit: from -0.2 to 0.2 at 0.1 a second
    assert settled(record, (Actuator(limit=0.2, rate_limit=0.1),)).start == pytest.approx(4.0)


@pytest.mark.parametrize(('family', 'number', 'kind', 'least'), [
    ('saturation-60', 2, 'limit', 95.0), *slow(
        ('saturation-30', 6, 'limit', 97.0), ('backlash', 0, 'backlash', 97.0),
        ('rate-limit', 3, 'rate_limit', 98.0), ('dead-zone', 0, 'dead_zone', 97.0))])
def test_commands_that_never_rest_are_no_loop_if_they_hear_nothing(family, number, kind, least):
    """Sticks and sweeps seemed a controller's: WEAK, or GOOD, and 48 to 89 % of another flight."""
    robots = pytest.importorskip('ctsid_ros.studies.robots.families')
    from ctsid_ros.studies.robots.trials import simulated
    given = robots.experiment(family, 301, number)
    found = identify(given.record, Settings(feedthrough=False))
    assert found.good
    assert getattr(found.model.actuators[0], kind) > 0.0
    assert np.mean(simulated(found.model, given.test)) > least


@pytest.mark.parametrize(('family', 'loop'), [
    ('cart-pole', True), *slow(('rates-1x1', True), ('rates-4x3', True)), ('roll', False),
    ('turbulence-strong', False), ('second-input', False), ('saturation-60', False)])
def test_who_hears_the_outputs_is_in_a_loop(family, loop):
    """One of 7 may seem the other one: of sums of sines, e.g., next to nothing is new."""
    robots = pytest.importorskip('ctsid_ros.studies.robots.families')
    seen = [in_loop([robots.experiment(family, 11, number).record]) for number in range(7)]
    assert sum(one is not loop for one in seen) <= 1


def test_a_limit_that_all_commands_exceed_is_not_told_from_a_gain():
    rng = np.random.default_rng(5)
    t_u = np.arange(0.5, 30.0, 1.5)
    u = rng.choice((-1.0, 0.0, 1.0), len(t_u)) * rng.uniform(0.8, 1.5, len(t_u))
    t, t_y = np.arange(0.0, 30.0, FINE), np.arange(0.0, 30.0, 0.02)
    y = held_response(PLANT, t, brute(t, u, 'limit', 0.5, t_u)[:, np.newaxis], t_y)
    found = identify(Record.from_arrays(t_u, u[:, np.newaxis], t_y, noisy(rng, y, 30.0),
                                        input_hold='zoh'))
    assert not found.good


def keyed(seed: int, stops: float, noise: float | None = 26.0) -> Record:
    """Return a base, at rest at first, under keys, with a timeout and an acceleration of 0.5."""
    rng = np.random.default_rng(seed)
    stamps, sent, begins = list[np.ndarray](), list[np.ndarray](), 1.0
    t, t_y = np.arange(0.0, 60.0, FINE), np.arange(0.0, 60.0, 0.02)
    acts = np.zeros(len(t))
    while begins < 57.0:
        of = begins + 0.05 * np.arange(rng.integers(16, 60))
        value = rng.choice((-0.3, 0.3, 0.5))
        following = of[-1] + rng.choice((0.05, rng.uniform(0.8, 2.5)))
        acts[(t >= begins) & (t < min(of[-1] + stops, following))] = value
        stamps, sent, begins = [*stamps, of], [*sent, 0.0 * of + value], following
    place = 0.0
    for k, wanted in enumerate(acts):
        acts[k] = place = place + max(min(wanted - place, 0.5 * FINE), -0.5 * FINE)
    y = held_response(plant([[-4.0]], [[4.0]], [[1.0]]), t, acts[:, np.newaxis], t_y)
    return Record.from_arrays(
        np.concatenate(stamps), np.concatenate(sent)[:, np.newaxis], t_y, noisy(rng, y, noise),
        input_hold='zoh')


@pytest.mark.parametrize('seed', [2, *slow(1, 3)])
def test_ramps_are_judged_by_what_was_sent(seed):
    found = identify(keyed(seed, 60.0))
    assert found.good, found.verdict.reason
    assert found.model.actuators[0].timeout == 0.0
    assert found.model.actuators[0].rate_limit == pytest.approx(0.5, rel=0.03)
    assert found.verdict.excitation[0].frequencies > 10.0


def test_a_comparison_begins_where_ramps_are_known():
    given = keyed(2, 60.0, None)
    truth = StateSpace([[-4.0]], [[4.0]], [[1.0]], actuators=(Actuator(rate_limit=0.5),))
    assert simulation(truth, given).fit[0] > 99.5


def test_sizes_beyond_what_may_be_set_are_not_looked_for():
    given = driven(1, 'limit', 0.7)
    held = given.inputs[0]
    found = identify(replace(given, inputs=(replace(held, values=1e13 * held.values),)))
    assert not any((found.model or found.rejected_model).actuators[0])


@pytest.mark.slow
def test_a_base_stops_and_ramps():
    """Keys, a timeout of 0.5 s and an acceleration of 0.5: each for itself was taken for more."""
    found = identify(keyed(1, 0.5))
    assert found.good, found.verdict.reason
    assert found.model.actuators[0].timeout == pytest.approx(0.5, rel=0.04)
    assert found.model.actuators[0].rate_limit == pytest.approx(0.5, rel=0.04)
    assert found.model.poles == pytest.approx([-4.0], rel=0.05)


@pytest.mark.slow
def test_channels_of_one_message_have_their_own():
    one, other = driven(1, 'limit', 0.7), driven(2)
    stamps = np.union1d(one.inputs[0].time, other.inputs[0].time)
    u = np.column_stack([r.inputs[0].values[np.searchsorted(
        r.inputs[0].time, stamps, side='right') - 1, 0] for r in (one, other)])
    y = one.outputs[0].values + other.outputs[0].values
    found = identify(Record.from_arrays(stamps, u, one.outputs[0].time, y, input_hold='zoh'))
    assert found.good, found.verdict.reason
    assert found.model.actuators[0].limit == pytest.approx(0.7, rel=0.05)
    assert not any(found.model.actuators[1])


@pytest.mark.parametrize(('family', 'seed', 'number'), [
    ('no-gain-jump', 300, 2), ('quadratic-drag', 135, 6), *slow(
        ('gain-drift', 140, 2), ('no-pole-jump', 300, 6), ('no-clipped', 4, 0),
        ('no-gain-jump', 4, 6), ('quadratic-drag', 303, 6), ('gain-drift', 300, 1))])
def test_a_plant_that_changes_or_bends_is_no_actuator(family, seed, number):
    """Two models, or curves, tell of jumps and drag as well; a clipped sensor leaves too much."""
    robots = pytest.importorskip('ctsid_ros.studies.robots.families')
    given = robots.experiment(family, seed, number)
    found = identify(given.record)
    assert not any((found.model or found.rejected_model).actuators[0])


@pytest.mark.parametrize(('kind', 'seeds', 'duration'), [
    ('limit', range(20, 21), 60.0), *slow(
        ('limit', range(20, 22), 60.0), ('limit', range(20, 23), 120.0),
        *((kind, range(20, 32), 30.0) for kind in EACH))])
def test_what_acts_is_as_sure_as_it_is_said_to_be(kind, seeds, duration):
    """As all samples tell, of which the search looks at a thousand."""
    errors = []
    for seed in seeds:
        found = identify(driven(seed, kind, EACH[kind], duration=duration, noise=20.0))
        told, = (c for c in found.choices if c.name == kind)
        assert 0.001 < told.deviation / EACH[kind] < 0.02
        assert any(f' ± {told.deviation:.1g}' in note for note in found.notes)
        errors.append((told.value - EACH[kind]) / told.deviation)
    print(np.round(errors, 1))
    assert np.sqrt(np.mean(np.square(errors))) < 1.8


@pytest.mark.parametrize('place', [0, *slow(1)])
def test_an_input_that_rests_has_no_say_in_what_acts_of_another(place):
    given = driven(20, 'limit', 0.7)
    sent, measured = given.inputs[0], given.outputs[0]
    u = np.insert(sent.values, place, 0.3, axis=1)
    found = identify(Record.from_arrays(sent.time, u, measured.time, measured.values,
                                        input_hold='zoh'))
    assert found.model.actuators[1 - place].limit == pytest.approx(0.7, rel=0.01)


@pytest.mark.slow
def test_a_part_without_a_sample_of_an_output_is_no_reason_to_fail():
    """Of what is delayed by half a second nothing is left of a short part."""
    given = driven(20, 'limit', 0.7)
    def known(s, late, every):
        time = s.time[::every] + late
        kept = ((time < 8.0) | (time > 10.0)) & ((time < 10.6) | (time > 13.0))
        return replace(s, time=time[kept], values=s.values[::every][kept])
    y, = given.outputs
    found = identify(Record.from_signals(
        [known(s, 0.0, 1) for s in given.inputs],
        [replace(known(y, 0.5, every), names=(name,)) for name, every in (('a', 1), ('b', 20))]))
    assert found.model.actuators[0].limit == pytest.approx(0.7, rel=0.02)


@pytest.mark.parametrize(('duration', 'budget', 'lasts'), [
    (100.0, 0.8, False), (100.0, 2.4, True), *slow((600.0, 3.0, False), (600.0, 6.0, True))])
def test_a_budget_that_ends_before_what_acts_is_found_is_told(duration, budget, lasts):
    found = identify(driven(21, 'backlash', 0.4, duration=duration), Settings(budget=budget))
    assert any(found.model.actuators[0]) == lasts == found.good
    assert found.good or 'whether actuators stop' in found.verdict.reason


@pytest.mark.parametrize(('family', 'number', 'kind', 'value'), [
    ('backlash', 4, 'backlash', 0.198), *slow(
        ('saturation-30', 0, 'limit', 0.78), ('backlash', 5, 'backlash', 0.29))])
def test_kinds_are_compared_at_the_number_that_is_likeliest(family, number, kind, value):
    """A rate limit, a dead zone, or a limit beside it was likelier at one of the numbers tried."""
    robots = pytest.importorskip('ctsid_ros.studies.robots.families')
    trials = pytest.importorskip('ctsid_ros.studies.robots.trials')
    given = robots.experiment(family, 302, number)
    found = identify(given.record)
    assert found.good, found.verdict.reason
    told = found.model.actuators[0]._asdict()
    assert [name for name, one in told.items() if one] == [kind]
    assert told[kind] == pytest.approx(value, rel=0.03)
    assert trials.simulated(found.model, given.test)[0] > 98.0


@pytest.mark.slow
def test_a_limit_that_may_be_any_smaller_one_is_not_known():
    """Where it is 0.66 one level is below it; that none is, too, is two deviations less likely."""
    robots = pytest.importorskip('ctsid_ros.studies.robots.families')
    found = identify(robots.experiment('saturation-60', 139, 4).record)
    assert not found.good
    assert found.choices[-1].deviation > 0.1


@pytest.mark.parametrize(('levels', 'limit'), [
    ((1.0, 1.2, 1.6), 0.7), *slow(((0.8, 1.0, 1.5), 0.5))])
def test_a_limit_behind_a_dead_zone_may_be_below_every_command(levels, limit):
    rng, duration = np.random.default_rng(1), 40.0
    t_u = np.cumsum(np.append(0.5, rng.uniform(0.3, 1.2, 66)))
    t_u = t_u[t_u < duration]
    u = rng.choice(levels, len(t_u)) * rng.choice((-1.0, 1.0), len(t_u))
    t, t_y = np.arange(0.0, duration, FINE), np.arange(0.0, duration, 0.02)
    sent = np.append(0.0, u)[np.searchsorted(t_u, t, side='right')]
    acts = np.sign(sent) * np.clip(np.abs(sent) - 0.4, 0.0, limit)
    y = noisy(rng, held_response(PLANT, t, acts[:, np.newaxis], t_y), 30.0)
    stamps = np.union1d(np.arange(0.0, duration, 0.05), t_u)
    held = np.append(0.0, u)[np.searchsorted(t_u, stamps, side='right')]
    found = identify(Record.from_arrays(stamps, held, t_y, y, input_hold='zoh'),
                     Settings(dead_zone=0.4))
    assert found.good, found.verdict.reason
    assert found.model.actuators[0].limit == pytest.approx(limit, rel=0.03)


@pytest.mark.parametrize(('family', 'seed', 'number', 'limit'), [
    ('saturation-60', 303, 3, 0.898), *slow(('gain-drift', 15, 1, 0.956))])
def test_what_a_drift_explains_as_well_is_a_doubt(family, seed, number, limit):
    """
    Doublets of two sizes, the larger ones later: a limit, or a gain that falls.

    A limit of all of them is as likely as any smaller one: the smallest command is named.
    """
    robots = pytest.importorskip('ctsid_ros.studies.robots.families')
    record = robots.experiment(family, seed, number).record
    found = identify(record)
    assert found.verdict.grade is Grade.WEAK
    assert found.verdict.remedy is Remedy.SETTING
    told = re.fullmatch(
        r'It may be that input u1 acts by at most (.*), or that the plant changes or drifts: '
        r'both explain as much; set `u1\.limit: (.*)`\.', found.verdict.reason)
    assert [float(one) for one in told.groups()] == pytest.approx([limit] * 2, rel=0.03)
    assert not any(found.model.actuators[0])
    assert 'drifts' not in identify(record, Settings(limit=limit)).verdict.reason


@pytest.mark.parametrize(('kind', 'part'), [
    ('backlash', 0.7), *slow(
        ('dead_zone', 0.7), ('limit', 0.7), ('rate_limit', 0.7), *((kind, 1.5) for kind in EACH))])
def test_what_is_given_wrongly_is_a_doubt(kind, part):
    record, wrong = driven(1, kind, EACH[kind]), Settings(**{kind: part * EACH[kind]})
    found = identify(record, wrong)
    assert found.verdict.grade is Grade.WEAK
    assert found.verdict.remedy is Remedy.SETTING
    assert found.verdict.reason.endswith(
        f', but another number explains more; set `u1.{kind}: auto`.')
    assert getattr(found.model.actuators[0], kind) == part * EACH[kind]


def test_what_is_given_and_is_not_there_is_a_doubt():
    found = identify(driven(1), Settings(limit=0.7))
    assert found.verdict.reason.endswith('set `u1.limit: auto`.')


@pytest.mark.slow
def test_a_number_that_nobody_gave_is_no_doubt():
    """It moved from one round to the next, and was said to be given."""
    robots = pytest.importorskip('ctsid_ros.studies.robots.families')
    found = identify(robots.experiment('backlash', 12, 4).record)
    assert found.good, found.verdict.reason


@pytest.mark.slow
def test_a_number_that_is_given_and_does_no_harm_is_no_doubt():
    """Beside one that is found it moved where the likelihood is flat."""
    found = identify(driven(1, 'dead_zone', 0.3), Settings(limit=1.05))
    assert found.good, found.verdict.reason
    assert found.model.actuators[0].limit == 1.05


@pytest.mark.parametrize('kind', ['rate_limit', *slow('limit', 'dead_zone', 'backlash')])
def test_what_is_given_rightly_is_none(kind):
    found = identify(driven(1, kind, EACH[kind]), Settings(**{kind: 1.03 * EACH[kind]}))
    assert found.good, found.verdict.reason


def test_windows_that_do_not_reach_a_limit_keep_that_of_those_before():
    tracker = Tracker()
    first = tracker.take(driven(1, 'limit', 0.7)).estimate
    small = driven(3, 'limit', 0.7, size=0.4)
    later = replace(small, epoch_ns=round(1e11))
    assert not any(identify(later).model.actuators[0])
    found = tracker.take(later).estimate
    assert found.good
    assert found.model.actuators == first.model.actuators
    assert any('as in windows before' in note for note in found.notes)
    assert found.model.dc_gain[0, 0] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize('rate', [1.0, 2.5, 4.0, 10.0])
def test_ramps_that_end_with_a_message_have_no_stamp_beside_it(rate):
    stamps = 0.05 * np.arange(400)
    held = Signal(stamps, np.random.default_rng(2).choice((-1.0, 1.0), (400, 1)), 'zoh', ('u',))
    acts, = acting((held,), (Actuator(rate_limit=rate),))
    assert np.min(np.diff(acts.time)) > 1e-6
    assert np.max(np.abs(np.diff(acts.values[:, 0]) / np.diff(acts.time))) < 1.0001 * rate


def test_two_of_them_before_one_input():
    rng, t, t_y = np.random.default_rng(1), np.arange(0.0, 40.0, FINE), np.arange(0.0, 40.0, 0.02)
    t_u = np.cumsum(rng.uniform(0.3, 1.5, 60))
    t_u = t_u[t_u < 40.0]
    u = rng.uniform(-1.3, 1.3, len(t_u))
    acts = brute(t, brute(t, u, 'limit', 0.6, t_u), 'rate_limit', 2.0, t)
    y = held_response(PLANT, t, acts[:, np.newaxis], t_y)
    found = identify(Record.from_arrays(t_u, u[:, np.newaxis], t_y, noisy(rng, y, 34.0),
                                        input_hold='zoh'))
    assert found.good, found.verdict.reason
    assert found.model.actuators[0].limit == pytest.approx(0.6, rel=0.03)
    assert found.model.actuators[0].rate_limit == pytest.approx(2.0, rel=0.03)
    assert found.model.n == 2


def test_sparse_commands_that_are_ramped_do_not_pause():
    given = driven(4)
    changes = np.flatnonzero(np.append(True, np.diff(given.inputs[0].values[:, 0]) != 0.0))
    sparse = replace(given, inputs=(replace(
        given.inputs[0], time=given.inputs[0].time[changes],
        values=given.inputs[0].values[changes]),))
    record = as_acting(sparse, (Actuator(rate_limit=5.0),))
    assert between_pauses(record) == (record,)
    # In a pause of all channels what was sent last is not known, however it acts.
    signals = [replace(s, time=s.time[rows], values=s.values[rows])
               for s in (*given.inputs, *given.outputs)
               for rows in [(s.time < 10.0) | (s.time > 14.0)]]
    pauses = replace(given, inputs=(signals[0],), outputs=(signals[1],))
    for one in (pauses, as_acting(pauses, (Actuator(rate_limit=5.0),))):
        assert [part.inputs[0].time[0] > 13.9 for part in between_pauses(one)] == [False, True]
