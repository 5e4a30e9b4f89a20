# SPDX-License-Identifier: Apache-2.0
"""Which input and output are guessed of a bag, and where it is worth identifying."""

from __future__ import annotations

from dataclasses import replace
import math
from pathlib import Path
import re
import shlex
from types import SimpleNamespace

from bag_fixtures import IMU, START, Sent, array, header, imu, joints, make, vector, write_mcap
from flights import S, at, flight, spoilt, stamp_of
from marks import slow
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import chirp, lfilter
from tangled_bags import KINDS, tangled, write_tangled
import yaml

from ctsid_core.model.storage import load_estimate
from ctsid_ros.cli import main
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.config.parameter_file import parse_config, read_config
from ctsid_ros.config.parameter_text import dump_brief
from ctsid_ros.errors import BagError
from ctsid_ros.recordings import portions
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.coherence import lag, mean_coherence
from ctsid_ros.recordings.excerpts import Clock, averaged, clock_for, held
from ctsid_ros.recordings.excited import excited
from ctsid_ros.recordings.guess import _AT_ONCE, _followed, better, guess, offered, scalars
from ctsid_ros.recordings.guess_candidates import no_signal
from ctsid_ros.recordings.guess_named import Named
from ctsid_ros.recordings.guess_pairs import (
    Comparison,
    begins_before,
    effective_frequencies,
    without_slow,
)
from ctsid_ros.recordings.guess_ranking import Pair, further_commands, rank
from ctsid_ros.recordings.survey import survey

ROOT = Path(__file__).resolve().parent.parent
TWIST, ODOMETRY = 'geometry_msgs/msg/Twist', 'nav_msgs/msg/Odometry'


def guessed(path, pick: int = 1, **named):
    with open_bag(path) as bag:
        return guess(bag, survey(bag), pick, Named(**{
            side: tuple(keys) for side, keys in named.items()}))


def ranked(path):
    with open_bag(path) as bag:
        return rank(bag, survey(bag))


def keys(found) -> list[tuple[tuple[str, str], tuple[str, str]]]:
    return [(p.input.key, p.output.key) for p in found.pairs]


def lagged(u: np.ndarray, pole: float, step: float) -> np.ndarray:
    """Return a held input behind a first-order low-pass."""
    y, share = np.zeros(len(u)), math.exp(-pole * step)
    for k in range(1, len(u)):
        y[k] = share * y[k - 1] + (1 - share) * u[k - 1]
    return y


def delayed(u: np.ndarray) -> np.ndarray:
    """Return a signal ten ticks later."""
    return np.concatenate([np.full(10, u[0]), u[:-10]])


def moves(rng, count: int, every: int = 25) -> np.ndarray:
    """Return random levels, each held for so many samples."""
    return np.repeat(rng.uniform(-1, 1, count // every + 1), every)[:count]


# --- measures


def clock(seconds: float, rate: float = 100.0) -> Clock:
    return clock_for([rate], [(0.0, seconds)])


def test_a_plant_explains_from_the_past_and_its_inverse_from_the_future():
    rng, ticks = np.random.default_rng(1), clock(40.0)
    u = moves(rng, len(ticks.time))
    y = lagged(u, 4.0, ticks.step) + 0.02 * rng.standard_normal(len(u))
    noise = rng.standard_normal(len(u))
    compare = Comparison(ticks, [y, u, noise, np.full(len(u), np.nan)])
    forth, _, nothing, unknown = compare.explained(u, range(4))
    (back,) = compare.explained(y, [1])
    assert forth.past > 0.95
    assert forth.future < 0.3
    assert back.past < back.future
    assert nothing.past < 0.05
    assert unknown.overlap == 0.0
    assert forth.overlap == pytest.approx(40.0)
    np.testing.assert_allclose(compare.screened(u)[[0, 2]], [forth.past, 0.0], atol=0.05)


def test_a_short_experiment_in_a_long_rest_is_found():
    """All of it may lie in one of the parts that are held out, if those are of equal length."""
    rng, ticks = np.random.default_rng(2), clock(200.0, 50.0)
    u = moves(rng, len(ticks.time)) * ((ticks.time > 100) & (ticks.time < 115))
    y = lagged(u, 4.0, ticks.step) + 0.01 * rng.standard_normal(len(u))
    assert Comparison(ticks, [y]).explained(u, [0])[0].past > 0.9


def test_slow_drift_and_what_is_lost_do_no_harm():
    rng, ticks = np.random.default_rng(3), clock(60.0)
    u = moves(rng, len(ticks.time))
    y = lagged(u, 4.0, ticks.step) + 0.1 * ticks.time
    y[2000:2300] = np.nan
    assert np.isnan(without_slow(y, ticks)).sum() == 300
    found = Comparison(ticks, [y]).explained(u, [0])[0]
    assert found.past > 0.9
    assert found.overlap == pytest.approx(57.0, abs=1.0)


def test_coherence_and_lag():
    rng, ticks = np.random.default_rng(4), clock(60.0)
    u = moves(rng, len(ticks.time), 5)
    late = np.roll(u, 20)
    assert mean_coherence(u, late, ticks) > 0.9
    assert mean_coherence(u, rng.standard_normal(len(u)), ticks) < 0.3
    assert lag(u, late, ticks) == pytest.approx(0.2)
    assert lag(u, -np.roll(u, -7), ticks) == pytest.approx(-0.07)


def test_frequencies_are_counted():
    ticks = clock(60.0)
    assert effective_frequencies(np.sin(3 * ticks.time), ticks) < 3
    assert effective_frequencies(moves(np.random.default_rng(5), len(ticks.time)), ticks) > 20


def test_which_of_two_signals_begins_to_move_first():
    rng, time = np.random.default_rng(6), np.arange(0.0, 20.0, 0.01)
    u = (time > 5.0).astype(float)
    y = lagged(delayed(u), 4.0, 0.01) + 0.02 * rng.standard_normal(len(u))
    assert begins_before(u, y)
    assert not begins_before(y, u)
    late = np.where(time < 2.0, np.nan, y)       # known later, and still at rest
    assert begins_before(u, late)
    for drift in (np.sin(0.3 * time), np.cos(0.3 * time), time,
                  1 - np.exp(-time / 2)):     # what moves all the time
        assert not begins_before(u, drift)
        assert not begins_before(drift, u)
    assert not begins_before(u, u)
    assert not begins_before(u, np.zeros(len(u)))
    assert not begins_before(u[450:480], y[450:480])     # too little rest


@pytest.mark.parametrize('columns', ['uy', 'yu'])
@pytest.mark.parametrize(('duration', 'at', 'pole', 'noise'), [
    (30.0, 3.0, 10.0, 0.05),     # an output like noise tells much about a single step
    (60.0, 6.0, 0.17, 0.002),
    (10.0, 1.0, 2.9, 0.02),
    (4.0, 1.0, 2.9, 0.02)])      # short: names alone decide, if they say anything
def test_a_step_comes_before_its_response(tmp_path, columns, duration, at, pole, noise):
    rng, time = np.random.default_rng(7), np.arange(0.0, duration, 0.01)
    u = (time >= at).astype(float)
    y = lagged(delayed(u), pole, 0.01) + noise * rng.standard_normal(len(u))
    table = [time, *({'u': u, 'y': y}[name] for name in columns)]
    path = tmp_path / 'run.csv'
    np.savetxt(path, np.transpose(table), delimiter=',', comments='',
               header=f'time,{",".join(columns)}')
    assert keys(guessed(path))[0] == (('run', 'u'), ('run', 'y'))


@pytest.mark.parametrize('seed', [3, *slow(1, 2)])
def test_two_measurements_of_one_motion_are_outputs_of_what_moves_it(tmp_path, capsys, seed):
    """An angle tells its rate all but exactly, but no names tell which column is which."""
    rng, step = np.random.default_rng(seed), expm(0.01 * np.array(
        [[0.0, 1.0, 0.0], [-20.0, -1.5, 40.0], [0.0, 0.0, 0.0]]))
    u, x = np.repeat(rng.standard_normal(120), 20), np.zeros((2401, 2))
    for k, value in enumerate(u):
        x[k + 1] = step[:2, :2] @ x[k] + step[:2, 2] * value
    x = x[:-1] + rng.standard_normal((2400, 2)) * [0.01, 0.03]
    table = np.column_stack((0.01 * np.arange(2400), x[:, 0], u, x[:, 1]))
    np.savetxt(tmp_path / 'run.csv', table, delimiter=',', comments='', header='time,a,b,c')
    found = guessed(tmp_path / 'run.csv')
    assert set(keys(found)[:2]) == {(('run', 'b'), ('run', 'a')), (('run', 'b'), ('run', 'c'))}
    assert main(['init', str(tmp_path / 'run.csv'), '-o', str(tmp_path / 'p.yaml')]) == 0
    told = capsys.readouterr().err
    line = next(line for line in told.splitlines() if 'one model of them all' in line)
    assert 'run b moves 2 outputs' in line
    words = shlex.split(line.partition('all: ')[2])
    assert main(['try', str(tmp_path / 'run.csv'), *words, '--out', str(tmp_path / 'res')]) == 0
    model = load_estimate(tmp_path / 'res' / 'model.json').model
    assert model.C.shape == (2, 2)
    assert np.sort(model.poles) == pytest.approx(np.sort(np.roots([1.0, 1.5, 20.0])), abs=0.02)


def driven(path, columns, **more):
    """Write what two of three held commands do to a speed: the first one most."""
    rng, t = np.random.default_rng(3), 0.02 * np.arange(1500)
    u = np.array([np.append(0.0, rng.uniform(-1.0, 1.0, 25))[
        np.searchsorted(np.sort(rng.uniform(0.0, 30.0, 25)), t)] for _ in range(3)])
    x = lfilter([1.0 - np.exp(-0.06)], [1.0, -np.exp(-0.06)], u[0] + 0.7 * u[1])
    y = x + 0.02 * x.std() * rng.standard_normal(len(t))
    seen = {name: make(u, y, rng) for name, make in more.items()}
    np.savetxt(path, np.column_stack((t, *u, y, *seen.values())), delimiter=',', comments='',
               header=','.join(('time', *columns, *seen)))
    return path


# By their names commands, and by what they do; a lag of the speed, a copy and a wish are none.
@pytest.mark.parametrize(('columns', 'more'), [
    *slow((('throttle_cmd', 'brake_cmd', 'steer_cmd', 'speed'), {})),
    *slow((('a', 'b', 'c', 'speed'), {})),
    (('throttle_cmd', 'brake_cmd', 'steer_cmd', 'speed'), {
        'motor_current': lambda u, y, rng: np.append(0.0, y[:-1]),
        'throttle_cmd_sent': lambda u, y, rng: np.append(0.0, u[0, :-1]),
        'target': lambda u, y, rng: u[1] + 0.5 * u[0]})])
def test_commands_that_move_an_output_as_well_are_told(tmp_path, capsys, columns, more):
    """A model of the throttle alone is GOOD by its predictions, with a gain of 1.6 for 1."""
    bag = driven(tmp_path / 'run.csv', columns, **more)
    named = ['--input', columns[0], '--output', 'speed']
    assert main(['try', str(bag), *named, '--out', str(tmp_path / 'one')]) == 0
    told = next(line for line in capsys.readouterr().err.splitlines() if ' too: ' in line)
    assert f'run {columns[1]} moves run speed, too' in told
    assert any(' too: ' in note for note in load_estimate(tmp_path / 'one' / 'model.json').notes)
    words = shlex.split(told.partition('all: ')[2])
    assert main(['try', str(bag), *words, '--out', str(tmp_path / 'all')]) == 0
    assert ' too: ' not in capsys.readouterr().err
    found = load_estimate(tmp_path / 'all' / 'model.json')
    assert found.good
    assert found.model.dc_gain[0] == pytest.approx([1.0, 0.7], abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize('named', [[], *slow(['--output', 'speed'])])
def test_all_commands_are_inputs_where_none_is_named(tmp_path, capsys, named):
    """Of two motors each explains half; a battery that sags with both would explain it all."""
    rng, count = np.random.default_rng(7), 3000
    motors = np.repeat(rng.uniform(0.0, 1.0, (count // 40, 2)), 40, axis=0)
    load = motors.sum(axis=1)
    speed = lfilter([1.0 - np.exp(-0.02)], [1.0, -np.exp(-0.02)], load)
    np.savetxt(tmp_path / 'run.csv', np.column_stack((
        0.02 * np.arange(count), motors, 12.0 - 0.3 * load + 0.01 * rng.standard_normal(count),
        speed + 0.01 * rng.standard_normal(count))),
        delimiter=',', comments='', header='time,port,starboard,battery,speed')
    assert main(['try', str(tmp_path / 'run.csv'), *named, '--out', str(tmp_path / 'out')]) == 0
    assert 'all are inputs' in capsys.readouterr().err
    found = load_estimate(tmp_path / 'out' / 'model.json')
    gains = dict(zip(found.model.input_names, found.model.dc_gain[0], strict=True))
    assert found.good
    assert gains == pytest.approx({'port': 1.0, 'starboard': 1.0}, abs=0.03)


def jumps(rng, count, channels):
    """Return levels that each last half a second, at 50 Hz."""
    return np.repeat(rng.uniform(-1.0, 1.0, (count // 25, channels)), 25, axis=0)


def table(path, rng, **columns):
    """Write a table at 50 Hz; noise of 2 % on what is not held."""
    rows = [x + 0.02 * np.std(x) * rng.standard_normal(len(x)) * bool(np.diff(x[:20]).any())
            for x in columns.values()]
    np.savetxt(path, np.column_stack((0.02 * np.arange(len(rows[0])), *rows)), delimiter=',',
               comments='', header=','.join(('time', *columns)))
    return path


def chosen(found):
    """Return the fields of inputs and outputs."""
    return [[c.field for c in side] for side in (found.config.inputs, found.config.outputs)]


@pytest.mark.parametrize('outputs', [(), *slow((('vx',),), (('vx', 'wz'),))])
def test_four_wheels_that_tell_a_quarter_each_are_found_together(tmp_path, outputs):
    """One was left, and WEAK; or moved the temperature, and REJECT."""
    rng = np.random.default_rng(4)
    w = jumps(rng, 3000, 4)
    bag = table(tmp_path / 'base.csv', rng, lamp=jumps(rng, 3000, 1)[:, 0], fl=w[:, 0],
                fr=w[:, 1], rl=w[:, 2], rr=w[:, 3], vbat=12.0 - 0.2 * w.sum(axis=1),
                vx=lagged(w.sum(axis=1), 4.0, 0.02),
                wz=lagged(w @ [-1.0, 1.0, -1.0, 1.0], 6.0, 0.02),
                temp=30.0 + np.cumsum(rng.standard_normal(3000)) * 0.01)
    found = guessed(bag, outputs=[('base', name) for name in outputs])
    assert chosen(found)[0] == ['fl', 'fr', 'rl', 'rr']
    assert set(chosen(found)[1]) <= {'vx', 'wz'}
    assert 'what steps' not in found.reasons[0]


def test_outputs_that_are_named_have_the_commands_of_all(tmp_path):
    rng = np.random.default_rng(5)
    u = jumps(rng, 3000, 3)
    bag = table(tmp_path / 'boat.csv', rng, a=u[:, 0], b=u[:, 1], c=u[:, 2],
                surge=lagged(u[:, 0] + 0.7 * u[:, 1], 2.0, 0.02),
                yaw=lagged(u[:, 0] - 0.8 * u[:, 2], 3.0, 0.02))
    found = guessed(bag, outputs=[('boat', 'surge'), ('boat', 'yaw')])
    assert chosen(found) == [['a', 'b', 'c'], ['surge', 'yaw']]
    assert sum('all are inputs' in reason for reason in found.reasons) == 2


def test_beside_a_set_point_commands_are_told_alone(tmp_path):
    rng = np.random.default_rng(5)
    u = jumps(rng, 3000, 2)
    bag = table(tmp_path / 'car.csv', rng, target=u[:, 0], b_cmd=u[:, 1],
                speed=lagged(u[:, 0] + 0.5 * u[:, 1], 2.0, 0.02))
    found = guessed(bag)
    assert chosen(found) == [['target'], ['speed']]
    assert any('one model of all: ' in reason for reason in found.reasons)


def test_an_output_without_noise_tells_no_command_before_it_acts(tmp_path):
    """What answers within a sample told how the other command changes: it was none of its own."""
    rng = np.random.default_rng(5)
    u = jumps(rng, 3000, 2)
    np.savetxt(tmp_path / 'car.csv', np.column_stack((
        0.02 * np.arange(3000), u, lfilter([0.06], [1.0, -0.94], u @ [1.0, 0.7]))),
        delimiter=',', comments='', header='time,a_cmd,b_cmd,speed')
    assert chosen(guessed(tmp_path / 'car.csv')) == [['a_cmd', 'b_cmd'], ['speed']]


def test_a_measured_torque_is_named_like_a_measurement(tmp_path):
    u = jumps(np.random.default_rng(5), 1500, 1)[:, 0]
    bag = table(tmp_path / 'arm.csv', np.random.default_rng(6), tau1=u, tau1_meas=lagged(
        u, 20.0, 0.02), rate=lagged(u, 2.0, 0.02))
    of = {c.key[1]: c for c in ranked(bag).found}
    assert of['tau1'].acts == of['tau1'].measures
    assert of['tau1_meas'].acts < of['tau1_meas'].measures


def test_what_is_named_an_output_is_no_further_input(tmp_path):
    rng = np.random.default_rng(5)
    u = jumps(rng, 3000, 2)
    bag = table(tmp_path / 'car.csv', rng, a_cmd=u[:, 0], b_cmd=u[:, 1],
                speed=lagged(u[:, 0] + 0.7 * u[:, 1], 2.0, 0.02))
    found = guessed(bag, outputs=[('car', 'speed'), ('car', 'b_cmd')])
    assert chosen(found) == [['a_cmd'], ['speed', 'b_cmd']]


@pytest.mark.parametrize('named', [None, 'velocity_cmd', 'torque_cmd'])
def test_what_a_controller_makes_of_an_input_is_no_further_one(tmp_path, named):
    """With both a right model was WEAK: the torque had a gain of 0.009 for 1."""
    rng, y, total = np.random.default_rng(5), 0.0, 0.0
    wish, gust = jumps(rng, 3000, 1)[:, 0], 3.0 * lagged(rng.standard_normal(3000), 2.0, 0.02)
    torque, speed = np.empty(3000), np.empty(3000)
    for k in range(3000):
        speed[k] = y + 0.01 * rng.standard_normal()
        total += 0.04 * (wish[k] - speed[k])
        torque[k] = 2.0 * (wish[k] - speed[k]) + total
        y = np.exp(-0.06) * y + (1.0 - np.exp(-0.06)) * (torque[k] + gust[k])
    np.savetxt(tmp_path / 'run.csv', np.column_stack((
        0.02 * np.arange(3000), wish, torque, speed)), delimiter=',', comments='',
        header='time,velocity_cmd,torque_cmd,speed')
    found = guessed(tmp_path / 'run.csv', outputs=[('run', 'speed')],
                    inputs=[('run', named)] if named else [])
    assert len(chosen(found)[0]) == 1
    assert not any(' too: ' in reason for reason in found.reasons)


def test_a_sum_of_commands_is_no_further_one(tmp_path):
    """The last of those that tell the same goes, and what one of them tells by half before."""
    rng = np.random.default_rng(6)
    u = jumps(rng, 3000, 2)
    bag = table(tmp_path / 'pan.csv', rng, col1=u[:, 0], col2=u[:, 1], col3=u.sum(axis=1),
                col4=np.append(0.0, u[:-1, 0]), y=lagged(2.0 * u[:, 0] - u[:, 1], 4.0, 0.02))
    found = guessed(bag, inputs=[('pan', 'col1')], outputs=[('pan', 'y')])
    assert "--input 'pan col1' --input 'pan col2' --output 'pan y'" in found.reasons[-1]


def test_a_temperature_is_what_is_warmed_though_it_is_of_a_motor(tmp_path):
    """By its name a command, it moved the heater."""
    rng, gust = np.random.default_rng(8), lagged(np.random.default_rng(9).standard_normal(3000),
                                                 0.5, 0.02)
    u = jumps(rng, 3000, 2)
    bag = table(tmp_path / 'oven.csv', rng, heater=u[:, 0], fan=u[:, 1],
                motor_temp=lagged(u @ [0.4, -0.3] + 0.5 * gust, 0.5, 0.02))
    assert chosen(guessed(bag)) == [['heater', 'fan'], ['motor_temp']]


@pytest.mark.parametrize(('names', 'inputs'), [
    ('supply_voltage,speed', ['supply_voltage']),
    ('supply_valve_cmd,level', ['supply_valve_cmd']),
    ('temperature_cmd,room', ['temperature_cmd']),
    ('heater,motor_temp', ['heater'])])
def test_what_supplies_or_warms_may_be_an_input(tmp_path, names, inputs):
    rng, (one, other) = np.random.default_rng(7), names.split(',')
    u = jumps(rng, 1500, 1)[:, 0]
    bag = table(tmp_path / 'run.csv', rng, **{one: u, other: lagged(u, 3.0, 0.02)})
    assert chosen(guessed(bag)) == [inputs, [other]]


# What repeats the output, what is measured, and what explains less than a hundredth more.
@pytest.mark.parametrize(('name', 'share', 'make'), [
    ('motor_cmd_done', 0.0, lambda v, y: np.append([0.0, 0.0], y[:-2])),
    ('state_feedback', 0.7, lambda v, y: v),
    ('brake_cmd', 0.07, lambda v, y: v)])
def test_what_is_no_further_command_is_not_told(tmp_path, name, share, make):
    rng, t = np.random.default_rng(3), 0.02 * np.arange(1500)
    u, v = (np.append(0.0, rng.uniform(-1.0, 1.0, 25))[
        np.searchsorted(np.sort(rng.uniform(0.0, 30.0, 25)), t)] for _ in range(2))
    gust = 0.5 * (share == 0.0) * lfilter([0.2], [1.0, -0.98], rng.standard_normal(len(t)))
    y = lfilter([1.0 - np.exp(-0.06)], [1.0, -np.exp(-0.06)], u + share * v + gust)
    np.savetxt(tmp_path / 'run.csv', np.column_stack((t, u, make(v, y), y)), delimiter=',',
               comments='', header=f'time,throttle_cmd,{name},speed')
    with open_bag(tmp_path / 'run.csv') as bag:
        ranking = rank(bag, survey(bag))
    of = {c.key[1]: c for c in ranking.found}
    further, without, share, _ = further_commands([of['throttle_cmd']], of['speed'], ranking)
    assert not further
    assert without == share


def test_a_command_that_explains_little_is_named_where_not_all_is_explained(tmp_path):
    """A brake, seldom used: without it the gain of the throttle was wrong, and no word of it."""
    rng, t = np.random.default_rng(0), 0.05 * np.arange(1800)
    u = np.repeat(rng.uniform(0.0, 1.0, 45), 40)
    v = 0.4 * np.repeat(rng.uniform(size=90) < 0.07, 20)
    gust = lfilter([0.02], [1.0, -0.98], 2.0 * rng.standard_normal(1800))
    y = lfilter([0.05], [1.0, -0.95], u - v + gust)
    np.savetxt(tmp_path / 'run.csv', np.column_stack((t, u, v, y)), delimiter=',', comments='',
               header='time,throttle,brake,speed')
    with open_bag(tmp_path / 'run.csv') as bag:
        told = [one for one in guess(bag, survey(bag)).reasons if 'little more' in one]
    assert told == ['run brake would explain little more of run speed, and not all that moves it '
                    "is explained; to take what is known to move it: --input 'run throttle' "
                    "--input 'run brake' --output 'run speed'"]


def test_a_controllers_own_output_is_not_offered_as_its_input():
    """The only command there was the output itself."""
    wish, u = (SimpleNamespace(key=('run', name), acts=1.0, measures=0.0, set_point=wanted)
               for name, wanted in (('target_speed', True), ('u', False)))
    told, = _followed(Pair(wish, u, None, None), (wish, u))
    assert told.endswith('the command that acts on it')


def test_a_column_may_be_called_like_its_file_or_a_field_of_pictures(tmp_path, capsys):
    bag = driven(tmp_path / 'fan.csv', ('fan', 'trim', 'step', 'height'))
    words = ['--input', 'fan', '--input', 'trim', '--output', 'height']
    assert main(['try', str(bag), *words, '--out', str(tmp_path / 'res')]) == 0
    assert re.search(r'input +fan .* zoh +0 ± \S+ \(found\)', capsys.readouterr().out)
    assert load_estimate(tmp_path / 'res' / 'model.json').model.nu == 2


def test_the_name_of_a_file_makes_no_column_a_command(tmp_path):
    """All columns would be commands, set points and sticks, the speed among them."""
    bag = driven(tmp_path / 'target_motor_joy.csv', ('u', 'v', 'w', 'speed'))
    found = ranked(bag).found
    acts = {c.key[1]: c.acts > c.measures for c in found}
    assert not any(c.wanted or c.set_point for c in found)
    assert acts == {'u': True, 'v': False, 'w': False, 'speed': False}


def test_comments_of_a_guess_hold_what_can_be_copied(tmp_path, capsys):
    t = np.arange(0.0, 8.0, 0.01)
    x = np.sin(8.0 * np.maximum(t - 1.0, 0.0))
    table = np.column_stack((t, t > 1.0, x))
    np.savetxt(tmp_path / 'run.csv', table, delimiter=',', comments='',
               header='time,set_point_of_the_elbow_joint,measured_position_of_the_elbow_joint')
    assert main(['init', str(tmp_path / 'run.csv')]) == 0
    comments = [line for line in capsys.readouterr().out.splitlines() if line.startswith('#')]
    assert any("--output 'run " in line for line in comments)
    assert all(line.count("'") % 2 == 0 for line in comments)
    assert not any('- %' in line for line in comments)


def test_switches_modes_clocks_and_constants_are_no_signals():
    t = np.arange(100.0)
    assert no_signal(t, 0 * t)
    assert no_signal(t, (t > 40).astype(float), counts=True)
    assert no_signal(t, np.floor(t / 40), counts=True)
    assert not no_signal(t, (t > 40).astype(float))             # a step, as people fly it
    assert no_signal(t, 5 + 0.1 * t)
    assert not no_signal(t, (np.sin(t) > 0).astype(float))      # a pseudo-random binary input
    assert not no_signal(t, 0.25 * (t > 40) + 0.1 * (t > 70))   # two steps
    assert not no_signal(t, np.sin(t / 10))


def test_signals_on_a_clock():
    ticks = clock_for([10.0], [(0.0, 1.0), (5.0, 6.0)])
    assert len(ticks.time) == 20
    assert ticks.parts == [slice(0, 10), slice(10, 20)]
    time = np.array([0.25, 0.55, 5.0])
    np.testing.assert_array_equal(held(time, time, ticks)[:7], [np.nan] * 3 + [0.25] * 3 + [0.55])
    known = averaged(np.arange(0.005, 1.0, 0.01), np.arange(100.0), ticks)
    np.testing.assert_allclose(known[1:9], 10.0 * np.arange(1, 9) - 0.5)
    assert np.isnan(known[10:]).all()
    gap = averaged(np.r_[0:0.3:0.01, 0.8:1.0:0.01], np.ones(50), clock(1.0))
    assert np.isnan(gap[35:75]).all()


# --- stretches


def test_excited_stretches():
    rng, ticks = np.random.default_rng(6), clock(200.0, 50.0)
    inside = [(20.0, 40.0), (45.0, 60.0), (120.0, 150.0)]
    on = np.any([(ticks.time > a) & (ticks.time < b) for a, b in inside], axis=0)
    u = np.where(on, moves(rng, len(ticks.time), 10), 0.01 * rng.standard_normal(len(ticks.time)))
    first, second = excited(u, ticks)
    assert (first.start, first.end) == pytest.approx((18.5, 63.5), abs=1.5)   # a pause of 5 s
    assert (second.start, second.end) == pytest.approx((118.5, 153.5), abs=1.5)
    assert first.power > 100
    assert first.energy + second.energy > 0.95
    assert excited(moves(rng, len(ticks.time)), ticks) == ()      # all the time
    assert excited(np.zeros(len(ticks.time)), ticks) == ()
    # A sweep begins slowly, a staircase holds, and neither is cut where it moves; what rests is.
    sweep = chirp(ticks.time, 0.02, 200.0, 4.0, method='logarithmic', phi=-90)
    assert excited(sweep, ticks) == ()
    sweep = np.where(ticks.time < 100, 1.0, chirp(ticks.time - 100, 0.02, 100.0, 4.0,
                                                  method='logarithmic'))
    assert [s.start for s in excited(sweep, ticks)] == pytest.approx([100.0], abs=5.0)
    steps = np.array([float(t // 3 % 3) if 30 < t < 45 or 100 < t < 115 else 7.0 * (t > 60)
                      for t in ticks.time])
    assert [s.start for s in excited(steps, ticks)] == pytest.approx([28.0, 98.0], abs=1.5)
    late = np.where(ticks.time > 100, moves(rng, len(ticks.time)), np.nan)
    assert [s.start for s in excited(late, ticks)] == pytest.approx([98.5], abs=1.5)


def test_how_long_a_recording_rests_does_not_hide_a_short_experiment():
    rng, ticks = np.random.default_rng(14), clock(1800.0, 20.0)
    u = np.where(np.abs(ticks.time - 920) < 20, moves(rng, len(ticks.time), 8), 0.0)
    u[np.abs(ticks.time - 101) < 1] = u[np.abs(ticks.time - 1600) < 2] = 0.5
    found = excited(u, ticks)
    assert [s.start for s in found] == pytest.approx([98.0, 898.0, 1596.0], abs=1.5)
    assert max(found, key=lambda s: s.energy).end == pytest.approx(943.0, abs=1.5)


@pytest.mark.parametrize('rest', [0.0, 600.0])
def test_the_unit_of_time_changes_nothing(tmp_path, rest):
    """A plant a hundred times slower that is sampled as much more slowly is the same plant."""
    rng, time = np.random.default_rng(15), np.arange(0.0, 200.0 + rest, 0.1)
    u = moves(rng, len(time), 20) * (time >= rest)
    y = lagged(u, 0.5, 0.1) + 0.01 * rng.standard_normal(len(u))
    found = []
    for factor in (1, 100):
        np.savetxt(tmp_path / 'run.csv', np.transpose([factor * time, u, y]), delimiter=',',
                   comments='', fmt='%.9g', header='t [s],a,b')
        one = guessed(tmp_path / 'run.csv')
        settings = one.config.settings
        seconds = [settings.window_length, settings.window_stride, one.pair.explained.overlap,
                   *(t for s in one.stretches for t in (s.start, s.end))]
        found.append([*(np.array(seconds) / factor), one.pair.explained.past,
                      one.pair.explained.future, one.pair.score])
        assert keys(one)[0] == (('run', 'a'), ('run', 'b'))
    assert found[1] == pytest.approx(found[0], rel=2e-3)        # a tick more or less
    assert len(one.stretches) == (rest > 0)


def test_steps_that_wait_for_a_slow_plant_are_one_experiment(tmp_path):
    """However often it is sampled: ten minutes from step to step, and samples every second."""
    rng, time = np.random.default_rng(16), np.arange(0.0, 21600.0, 1.0)
    u = moves(rng, len(time), 600) * (np.abs(time - 12000) < 6000)
    y = lagged(u, 1 / 900, 1.0) + 0.003 * rng.standard_normal(len(u))
    np.savetxt(tmp_path / 'run.csv', np.transpose([time, u, y]), delimiter=',', comments='',
               header='t [s],heater_cmd,temperature')
    found = guessed(tmp_path / 'run.csv')
    (stretch,) = found.stretches
    # As long at rest before it as a tenth of a move is left of the answer to it
    assert stretch.start == pytest.approx(6000.0 - 900.0 * np.log(10.0), abs=300.0)
    assert stretch.end == pytest.approx(18000.0 + 900.0 * np.log(10.0), abs=300.0)
    assert found.config.settings.window_length == 6000.0


def test_a_stretch_lasts_until_a_slow_plant_has_answered(tmp_path):
    """One step of an oven, and samples every second: 63 s of an hour told its response to 29 %."""
    rng, time = np.random.default_rng(21), np.arange(0.0, 7200.0)
    u = np.where((time >= 1500) & (time < 4500), 1.0, 0.0)
    y = 20.0 + 2.0 * lagged(u, 1 / 200, 1.0) + 0.01 * rng.standard_normal(len(u))
    np.savetxt(tmp_path / 'run.csv', np.transpose([time, u, y]), delimiter=',', comments='',
               header='t [s],heater_cmd,temperature')
    answer = 200.0 * np.log(10.0)
    for stretch, step in zip(guessed(tmp_path / 'run.csv').stretches, (1500, 4500), strict=True):
        assert stretch.start == pytest.approx(step - answer, abs=60.0)
        assert stretch.end == pytest.approx(step + answer, abs=60.0)


def test_each_named_output_has_an_input_that_it_follows(tmp_path):
    """Of an arm's speeds one torque was chosen, though the table showed that of each."""
    rng, time = np.random.default_rng(23), np.arange(0.0, 60.0, 0.02)
    table = {'tau1': moves(rng, len(time), 20), 'tau2': moves(rng, len(time), 30)}
    for k, pole in ((1, 2.0), (2, 4.0)):
        table[f'vel{k}'] = lagged(table[f'tau{k}'], pole, 0.02) \
            + 0.02 * rng.standard_normal(len(time))
    np.savetxt(tmp_path / 'run.csv', np.transpose([time, *table.values()]), delimiter=',',
               comments='', header=f't [s],{",".join(table)}')
    found = guessed(tmp_path / 'run.csv', outputs=[('run', 'vel1'), ('run', 'vel2')])
    assert sorted(c.name for c in found.config.inputs) == ['tau1', 'tau2']
    assert sum('% of the variance of' in reason for reason in found.reasons) == 2


@pytest.mark.parametrize('kind', ['noise', 'gusts', 'walk'])
def test_what_wanders_answers_to_nothing(kind):
    """Noise after an answer made an answer of all rest, and all of a recording was taken."""
    rng, ticks = np.random.default_rng(22), clock(600.0, 50.0)
    time = ticks.time
    u = np.sign(np.sin(2.0 * np.pi * time / 3.0)) * (time % 200.0 < 15.0)
    white = rng.standard_normal(len(time))
    y = lagged(u, 3.0, 0.02) + {
        'noise': 0.05 * white, 'gusts': lagged(2.0 * white, 1.0, 0.02),
        'walk': 0.0015 * np.cumsum(white)}[kind]
    alone, beside = (excited(u, ticks, outputs=outputs) for outputs in ((), (y,)))
    assert len(alone) == 3
    assert [(s.start, s.end) for s in beside] == [(s.start, s.end) for s in alone]


@pytest.mark.slow
def test_windows_are_long_beside_a_dead_time(tmp_path, monkeypatch):
    """Of 120 s windows of 12 s were written: four dead times, of which "nothing follows"."""
    rng, time = np.random.default_rng(3), np.arange(0.0, 120.0, 0.05)
    u = moves(rng, len(time), 10)
    y = lagged(np.concatenate((np.zeros(60), u[:-60])), 2.0, 0.05)
    np.savetxt(tmp_path / 'run.csv', np.transpose([
        time, u, y + 0.02 * rng.standard_normal(len(u))]), delimiter=',', comments='',
        header='t [s],a,b')
    assert 18.0 <= guessed(tmp_path / 'run.csv').config.settings.window_length <= 24.0
    # Where the recording does not tell how late an output is, its model does.
    monkeypatch.setattr('ctsid_ros.recordings.coherence.lag', lambda *_: math.nan)
    assert guessed(tmp_path / 'run.csv').config.settings.window_length == 12.0
    assert main(['try', str(tmp_path / 'run.csv'), '--out', str(tmp_path / 'out'),
                 '--quiet']) == 0
    settings = parse_config(yaml.safe_load((tmp_path / 'out/params.yaml').read_text())).settings
    assert settings.window_length == 18.0
    assert settings.window_stride == 1.8


# --- guesses


def twist(x: float, yaw: float):
    return make(TWIST, linear=vector(x), angular=vector(0, 0, yaw))


def drive(seconds: int = 30, *, pause: float = 0.0) -> list[Sent]:
    """Return a drive base: commands with and without header, odometry, an IMU of noise."""
    rng, count, sent = np.random.default_rng(7), 50 * seconds, []
    u = moves(rng, count) * (np.arange(count) >= 50 * pause), moves(rng, count, 40)
    x, yaw = lagged(u[0], 3.0, 0.02), lagged(u[1], 6.0, 0.02)
    for k in range(count):
        stamp, noise = START + k * S // 50, 0.01 * rng.standard_normal(3)
        inner = make('geometry_msgs/msg/TwistWithCovariance', twist=twist(
            x[k] + noise[0], yaw[k] + noise[1]), covariance=np.abs(rng.standard_normal(36)))
        sent.append(Sent('/odom', ODOMETRY, stamp, make(ODOMETRY, header=header(stamp),
                                                        twist=inner)))
        sent.append(Sent('/imu', IMU, stamp, imu(stamp, noise[2])))
        if k % 5 == 0:
            command = twist(u[0][k], u[1][k])
            sent.append(Sent('/cmd_vel', TWIST, stamp, command))
            sent.append(Sent('/twist_out', f'{TWIST}Stamped', stamp, make(
                f'{TWIST}Stamped', header=header(stamp), twist=command)))
        if k in (100, 900):
            sent.append(Sent('/joy', 'sensor_msgs/msg/Joy', stamp, make(
                'sensor_msgs/msg/Joy', buttons=np.array([k // 500, 1], np.int32))))
    return sent


@pytest.fixture(scope='module')
def base(tmp_path_factory):
    return write_mcap(tmp_path_factory.mktemp('drive') / 'base.mcap', drive(pause=12.0),
                      chunk_size=1 << 18)


def test_drive_base(base):
    found = guessed(base)
    turn = ('/twist_out', 'twist.angular.z'), ('/odom', 'twist.twist.angular.z')
    push = ('/twist_out', 'twist.linear.x'), ('/odom', 'twist.twist.linear.x')
    assert keys(found) == [turn, push]             # the copy without stamps is not offered
    assert [c.unit for c in found.config.channels] == ['rad/s', 'rad/s']
    assert [c.hold for c in found.config.channels] == ['zoh', 'smooth']
    assert not found.config.settings.feedthrough
    assert found.pair.explained.past > 0.9
    assert not any('covariance' in field or topic == '/joy' for topic, field, _ in found.others)
    second = guessed(base, 2)
    assert [(c.topic, c.field) for c in second.config.channels] == list(push)
    (stretch,) = second.stretches
    assert stretch.start == pytest.approx(11.0, abs=1.5)
    with pytest.raises(BagError, match='only 2 to pick'):
        guessed(base, 3)


def teleop(seed: int, *, timeout: float = 0.5, repeat: bool = True, cross: float = 0.0
           ) -> list[Sent]:
    """
    Return a base under keys: a command, perhaps repeated at 10 Hz, and often none for seconds.

    After a timeout the driver stops it. `cross`: how far each axis moves the other one.
    """
    rng, count, sent = np.random.default_rng(seed), 3000, []
    acts, begins = np.zeros((count, 2)), 50
    while begins < count - 200:
        press, pause = 25 * rng.integers(1, 5), rng.integers(40, 150) * (rng.random() < 0.7)
        wanted = rng.choice((-1.0, 1.0), 2) * rng.choice((0.5, 1.0), 2) * \
            np.array(((1, 0), (0, 1), (1, 1)))[rng.integers(3)]
        for k in range(begins, begins + press if repeat else begins + 1, 5):
            sent.append(Sent('/cmd_vel', TWIST, START + k * S // 50, twist(*wanted)))
            acts[k:] = 0.0
            acts[k:k + round(50 * timeout)] = wanted
        begins += press + pause
    acts = acts @ (np.eye(2) + cross * np.eye(2)[::-1])
    speeds = np.column_stack((lagged(acts[:, 0], 5.0, 0.02), lagged(acts[:, 1], 7.0, 0.02)))
    yaw = 0.02 * np.cumsum(speeds[:, 1])
    for k, (x, turn) in enumerate(speeds):
        stamp, noise = START + k * S // 50, 0.01 * rng.standard_normal(3)
        attitude = make('geometry_msgs/msg/Quaternion', z=np.sin(yaw[k] / 2),
                        w=np.cos(yaw[k] / 2))
        sent.append(Sent('/odom', ODOMETRY, stamp, make(
            ODOMETRY, header=header(stamp),
            pose=make('geometry_msgs/msg/PoseWithCovariance', covariance=np.zeros(36),
                      pose=make('geometry_msgs/msg/Pose', orientation=attitude)),
            twist=make('geometry_msgs/msg/TwistWithCovariance', covariance=np.zeros(36),
                       twist=twist(x + noise[0], turn + noise[1])))))
        gyro = vector(0.0, 0.0, turn + noise[2])
        sent.append(Sent('/imu', IMU, stamp, make(IMU, header=header(stamp),
                                                  angular_velocity=gyro)))
    return sorted(sent, key=lambda one: one.log_ns)


PUSH, TURN = ('/cmd_vel', 'linear.x'), ('/cmd_vel', 'angular.z')
SPEED, SPIN = ('/odom', 'twist.twist.linear.x'), ('/odom', 'twist.twist.angular.z')
GYRO = '/imu', 'angular_velocity.z'


@pytest.mark.parametrize(('seed', 'how'), [
    (2, {'timeout': 99.0, 'repeat': False}), *slow(
        (1, {}), *((seed, {}) for seed in (2, 3, 4)), (1, {'timeout': 99.0}))])
def test_keys_that_are_not_pressed_hide_no_plant(tmp_path, seed, how):
    """A driver stops the base, or holds; of two sensors of its turn neither is the input."""
    found = guessed(write_mcap(tmp_path / 'keys.mcap', teleop(seed, **how)))
    pairs = keys(found)
    assert {(PUSH, SPEED), (TURN, SPIN if (TURN, SPIN) in pairs else GYRO)} == set(pairs[:2])
    assert all(p.explained.past > max(0.95, p.explained.future) for p in found.pairs[:2])
    assert len(found.config.inputs) == 1


@pytest.mark.slow
def test_axes_that_move_each_other_have_both_commands(tmp_path):
    found = guessed(write_mcap(tmp_path / 'keys.mcap', teleop(1, cross=0.3)))
    assert {(c.topic, c.field) for c in found.config.inputs} == {PUSH, TURN}
    assert any("--input '/cmd_vel linear.x' --input '/cmd_vel angular.z' --output" in reason
               and reason.count('--output') > 1 for reason in found.reasons)


@pytest.mark.parametrize(('noise', 'moving'), [(0.0, True), (0.01, False), *slow((0.01, True))])
def test_a_measured_effort_is_no_motion(tmp_path, noise, moving):
    """It only repeats the command, a tick later; but where nothing else is recorded, it is all."""
    rng, count, sent = np.random.default_rng(17), 3000, []
    u = lagged(5.0 * rng.standard_normal(count), 30.0, 0.01)
    w = lagged(u, 1.5, 0.01) + 0.005 * rng.standard_normal(count)
    for k in range(1, count):
        stamp, effort = START + k * S // 100, u[k - 1] + noise * rng.standard_normal()
        sent.append(Sent('/effort_controller/commands', 'std_msgs/msg/Float64MultiArray', stamp,
                         array(u[k])))
        sent.append(Sent('/joint_states', 'sensor_msgs/msg/JointState', stamp + S // 1000, make(
            'sensor_msgs/msg/JointState', header=header(stamp), name=['j'], position=np.zeros(1),
            velocity=np.array([w[k] * moving]), effort=np.array([effort]))))
    found = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    field = 'velocity[j]' if moving else 'effort[j]'
    assert keys(found)[0] == (('/effort_controller/commands', 'data[0]'), ('/joint_states', field))
    assert 'explains' in found.reasons[0]


def test_the_file_is_short_and_reads_back(base):
    config = guessed(base).config
    text = dump_brief(config)
    assert parse_config(yaml.safe_load(text)) == config
    shown = [line for line in text.splitlines() if line and not line.lstrip().startswith('#')]
    assert len(shown) < 30
    bare = '\n'.join(line.replace('# ', '', 1) if line.lstrip().startswith('# ') and ': ' in line
                     or line.endswith(':') else line for line in text.splitlines()
                     if not line.lstrip().startswith(('# The rest', '# For', '# Most', '# One')))
    assert parse_config(yaml.safe_load(bare)) == config  # comments are defaults
    held = config.with_channels([replace(c, hold='smooth') for c in config.channels])
    assert parse_config(yaml.safe_load(dump_brief(held))) == held


def test_better_pairs_are_known(base):
    with open_bag(base) as bag:
        good = guess(bag, survey(bag)).config
        poor = good.with_channels([*good.inputs, replace(good.outputs[0], topic='/imu', type=IMU,
                                                         field='angular_velocity.x')])
        assert better(bag, good) == []
        assert [p.input.key for p in better(bag, poor)][0] == ('/twist_out', 'twist.angular.z')
        wrong = good.with_channels([replace(good.inputs[0], field='twist.linear.x'),
                                    *good.outputs])     # what moves this output is asked
        assert {p.output.key for p in better(bag, wrong)} == scalars(good.outputs)


def test_ranges_are_the_scalars_in_them():
    path = 'euler(pose.pose.orientation)'
    channels = [Channel('a', 'input', '/b', 'c/D', 'effort[0:2]'),
                Channel('r', 'output', '/o', ODOMETRY, path)]
    assert scalars(channels) == {('/b', 'effort[0]'), ('/b', 'effort[1]'), *(
        ('/o', f'{path}.{part}') for part in ('roll', 'pitch', 'yaw'))}


def test_joints_with_commands(tmp_path):
    """Positions that follow commands; the efforts among the measurements are not those."""
    kind, rng, sent = 'sensor_msgs/msg/JointState', np.random.default_rng(8), []
    u = np.array([moves(rng, 1500, 30), moves(rng, 1500, 45)])
    y = np.array([lagged(one, 5.0, 0.02) for one in u]) + 0.005 * rng.standard_normal(u.shape)
    for k in range(1500):
        stamp = START + k * S // 50
        sent += [Sent('/a', kind, stamp, joints(stamp, y[:, k])),
                 Sent('/b', kind, stamp, joints(stamp, u[:, k]))]
    guess = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    assert {(u[0], y[0], u[1][-2], y[1][-2]) for u, y in keys(guess)[:2]} == {
        ('/b', '/a', '0', '0'), ('/b', '/a', '1', '1')}      # whatever the names
    assert {c.unit for c in guess.config.channels} == {''}   # they may slide or turn


@pytest.mark.parametrize(('noise', 'hold'), [(1e-3, 'smooth'), (0.0, 'zoh')])
def test_one_topic_with_efforts(tmp_path, noise, hold):
    """An effort that was measured is never twice the same; one that is was commanded."""
    rng = np.random.default_rng(9)
    u = moves(rng, 1000)
    effort = u + noise * rng.standard_normal(len(u))
    y = lagged(u, 4.0, 0.02) + 0.01 * rng.standard_normal(len(u))
    kind = 'sensor_msgs/msg/JointState'
    sent = [Sent('/joint_states', kind, START + k * S // 50, make(
        kind, header=header(START + k * S // 50), name=['a'], position=np.zeros(1),
        velocity=y[k:k + 1], effort=effort[k:k + 1])) for k in range(1000)]
    found = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    assert keys(found)[0] == (('/joint_states', 'effort[a]'), ('/joint_states', 'velocity[a]'))
    assert [c.hold for c in found.config.channels] == [hold, 'smooth']


@pytest.mark.parametrize(('odom', 'cmd', 'stamps'), [
    *slow((lambda ns: ns // S * S, lambda ns: ns, ['auto', 'log'])),
    (lambda ns: START, lambda ns: ns, ['auto', 'log']),
    *slow((lambda ns: ns + 7200 * S, lambda ns: ns, ['log', 'log'])),   # local time
    (lambda ns: ns + 7200 * S, lambda ns: ns + 7200 * S, ['auto', 'auto'])])
def test_headers_that_cannot_be_used_together_are_not(tmp_path, odom, cmd, stamps):
    own = {'/odom': odom, '/twist_out': cmd}
    sent = [replace(s, message=replace(s.message, header=header(own[s.topic](s.log_ns))))
            for s in drive(20) if s.topic in own]
    found = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    assert [c.topic for c in found.config.channels] == ['/twist_out', '/odom']
    assert [c.stamp for c in found.config.channels] == stamps
    assert any('recording' in reason for reason in found.reasons) is ('log' in stamps)


def test_what_looks_like_noise_is_not_an_output(tmp_path):
    rng = np.random.default_rng(0)

    def noisy(_: int, one: Sent) -> Sent:
        changed = at(one, stamp_of(one))  # a message of its own: flights share theirs
        changed.message.angular_velocity.y = rng.standard_normal()
        return changed

    found = guessed(write_mcap(tmp_path / 'bag.mcap', spoilt('/imu', noisy, flight(10.0))))
    assert keys(found) == [(('/cmd', 'data[0]'), ('/imu', 'angular_velocity.x'))]
    assert ('/imu', 'angular_velocity.y') in [other[:2] for other in found.others]


def test_windows_fit_into_the_bag(base, tmp_path):
    for path, length in ((base, 10.0), (write_mcap(tmp_path / 'bag.mcap', drive(8)), 4.0)):
        assert guessed(path).config.settings.window_length == pytest.approx(length, rel=0.05)


def test_where_nothing_explains_anything_names_decide_and_that_is_said(tmp_path):
    rng = np.random.default_rng(10)
    sent = [Sent(topic, 'std_msgs/msg/Float64MultiArray', START + k * S // 50,
                 array(rng.standard_normal())) for k in range(500) for topic in ('/x', '/cmd')]
    found = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    assert keys(found)[0] == (('/cmd', 'data[0]'), ('/x', 'data[0]'))
    assert 'guessed by what steps, their names' in found.reasons[0]


@pytest.mark.parametrize('names', [('cmd', 'pos'), ('a', 'b'), ('b', 'a')])
def test_what_steps_is_the_input_where_nothing_explains_anything(tmp_path, names):
    time = np.arange(0.0, 30.0, 0.02)
    u = np.where(np.sin(0.4 * time ** 1.5) < 0.0, -1.0, 1.0)
    signals = dict(zip(names, (u, np.random.default_rng(3).standard_normal(len(u))), strict=True))
    path, order = tmp_path / 'run.csv', sorted(names)
    np.savetxt(path, np.transpose([time, *(signals[name] for name in order)]), delimiter=',',
               header=f't,{",".join(order)}', comments='')
    found = guessed(path)
    assert keys(found)[0] == (('run', names[0]), ('run', names[1]))
    assert 'guessed by what steps' in found.reasons[0]


@pytest.mark.parametrize('order', ['ab', 'ba'])
def test_a_step_without_rest_before_it_is_not_decided_by_the_order_of_columns(tmp_path, order):
    time = np.arange(0.0, 10.0, 0.02)
    u = np.where((time > 0.0) & (time < 4.0), 1.0, 0.0)
    signals = {'a': u, 'b': lagged(u, 2.0, 0.02)
               + 0.01 * np.random.default_rng(3).standard_normal(len(u))}
    path = tmp_path / 'run.csv'
    np.savetxt(path, np.transpose([time, *(signals[name] for name in order)]), delimiter=',',
               header=f't,{",".join(order)}', comments='')
    found = guessed(path)
    assert keys(found)[0] == (('run', 'a'), ('run', 'b'))
    assert 'guessed by what steps, their names' in found.reasons[0]
    assert "to turn it round: --input 'run b' --output 'run a'" in found.reasons[0]
    # Who names one of them has told the data's doubt.
    assert not guessed(path, inputs=[('run', 'a')]).doubts
    assert not guessed(path, outputs=[('run', 'b')]).doubts
    np.savetxt(path, np.transpose([time, 0 * u + 1.0, signals['b']]), delimiter=',',
               header='t,a,b', comments='')
    with pytest.raises(BagError, match='a step before the first sample is not seen'):
        guessed(path)


def test_too_little_moves(tmp_path):
    kind = 'std_msgs/msg/Float64MultiArray'
    sent = [Sent('/cmd', kind, START + k * S // 50, array(math.sin(k / 20), 1.0))
            for k in range(100)]
    with pytest.raises(BagError, match=r'only data\[0\] of /cmd does'):
        guessed(write_mcap(tmp_path / 'a.mcap', sent))
    with pytest.raises(BagError, match=r'too short: data\[0\] of /cmd \(7 messages\)'):
        guessed(write_mcap(tmp_path / 'b.mcap', sent[:7]))
    stopped = [replace(one, log_ns=START) for one in sent]
    with pytest.raises(BagError, match='at one instant'):
        guessed(write_mcap(tmp_path / 'c.mcap', stopped))
    with open_bag(tmp_path / 'c.mcap') as bag:
        assert not offered(bag, survey(bag))


def test_large_bags_are_read_in_portions(base, monkeypatch):
    with open_bag(base) as bag:
        assert portions.portions(bag) == [(0.0, pytest.approx(29.98))]
        whole = survey(bag)
        monkeypatch.setattr(portions, '_EXCERPT', 3.0)
        monkeypatch.setattr(portions, 'MOST_BYTES', bag.size // 2)
        parts = portions.portions(bag)
        assert sum(b - a for a, b in parts) == pytest.approx(29.98 / 2, rel=0.01)
        found = survey(bag)
        assert f'only {len(parts)} portions of 4 s' in found.notes[-1]
        for topic, other in zip(whole.topics, found.topics, strict=True):
            if topic.info.count > 100:
                assert other.rate == pytest.approx(topic.rate, rel=0.05)
                assert other.stamps[-1].gaps == topic.stamps[-1].gaps == 0
        ranking = rank(bag, found)
    assert len(ranking.clock.parts) == len(parts)
    assert {p.input.key for p in ranking.pairs[:2]} == {
        ('/twist_out', 'twist.angular.z'), ('/twist_out', 'twist.linear.x')}
    ends = np.concatenate([ranking.clock.time[p][[0, -1]] for p in ranking.clock.parts])
    assert (np.diff(ends) > 0).all()


@pytest.mark.parametrize('name', ['quadrotor_roll', 'quadrotor_roll_sqlite3',
                                  'quadrotor_roll.bag'])
def test_a_span_of_a_bag(name):
    with open_bag(ROOT / 'bags' / name) as bag:
        span = bag.start_ns + 5 * S, bag.start_ns + 6 * S
        times = np.concatenate([b.log_ns for b in bag.blocks({'/imu': []}, span)])
        inside = np.count_nonzero((times >= span[0]) & (times <= span[1]))
    assert inside == pytest.approx(200, abs=10)
    assert inside <= len(times) < 4000      # of 7949: the chunk that it lies in, of 13 s


# --- recordings as tangled as real ones


@pytest.mark.parametrize(('kind', 'seed', 'duration'), [('wheel', 101, 20.0), *slow(
    *((kind, seed, 60.0) for kind in KINDS for seed in (102, 103)))])
def test_tangled_recordings(tmp_path, kind, seed, duration):
    """The pair of the plant is the first, or at least one of the three that are shown."""
    path, truth = write_tangled(tmp_path / 'bag.mcap', seed, kind, duration)
    found = keys(ranked(path))[:3]
    assert any(truth.holds(u, y) for u, y in found), found
    assert truth.holds(*found[0], setpoint=True), found


def test_the_tangles_are_drawn_by_the_seed():
    one, same, other = (tangled(seed, 'wheel', 1.0) for seed in (1, 1, 2))
    assert [s.log_ns for s in one.sent] == [s.log_ns for s in same.sent]
    assert [s.log_ns for s in one.sent] != [s.log_ns for s in other.sent]


def test_a_real_aircraft(data_folder):
    found = guessed(data_folder / 'cubs2/cub_stabilize_2025_11_13.mcap')
    assert keys(found)[0] == (('/cub1/joy_serial_status', 'data[0]'),
                              ('/cub1/pose', 'euler(pose.orientation).roll'))


# --- the command


def test_try_does_all_in_one_go(base, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(['try', str(base), '--pick', '2', '--out', 'res', '--quiet']) == 0
    out = capsys.readouterr().out
    for words in ('most promising pair first', 'Stretches worth identifying', 'GOOD', 'pole',
                  'ctsid simulate res/model.json ANOTHER_BAG'):
        assert words in out
    assert (tmp_path / 'res/report.html').exists()
    config: Config = read_config('res/params.yaml')
    assert config.inputs[0].field == 'twist.linear.x'
    report = (tmp_path / 'res/report.md').read_text(encoding='utf-8')
    assert '--params res/params.yaml --interval 9.9:' in report
    assert 'next pair' not in out
    assert main(['try', str(base), '--out', 'first', '--quiet']) == 0
    assert f'next pair of signals: ctsid try {base} --pick 2' in capsys.readouterr().out


@pytest.mark.slow
def test_try_takes_the_time_that_it_is_told(tmp_path, capsys, monkeypatch):
    rng, time = np.random.default_rng(8), np.arange(0.0, 800.0, 2.0)
    u = moves(rng, len(time), 10)
    y = lagged(u, 0.1, 2.0) + 0.01 * rng.standard_normal(len(u))
    np.savetxt(tmp_path / 'run.csv', np.transpose([time, u, y]), delimiter=',', comments='',
               header='t,u,y')
    monkeypatch.chdir(tmp_path)
    for verb in (['try', '--out', 'wrong', '--force', '--quiet'], ['info'], ['init']):
        main([verb[0], 'run.csv', *verb[1:]])
        begin = ' '.join(''.join(capsys.readouterr()[::-1 if verb == ['init'] else 1]).split())
        guess = begin.index('taken as ms, for they step by 2: 0.798 s in all; if that is wrong, '
                            'say --time t:s')
        assert guess < begin.index('Time stamps' if verb == ['info'] else 'Inputs and outputs')
    assert main(['try', 'run.csv', '--time', 't:s', '--out', 'res', '--quiet']) == 0
    assert 'run.csv: 798.0 s' in capsys.readouterr().out       # else 0.8 s: steps of 2 are of ms
    assert '--time t:s' in (tmp_path / 'res/report.md').read_text(encoding='utf-8')


def test_try_takes_signals_and_a_rate(tmp_path, capsys, monkeypatch):
    rng = np.random.default_rng(10)
    u = moves(rng, 1000, 10)
    y = lagged(u, 2.0, 0.05) + 0.01 * rng.standard_normal(len(u))
    np.savetxt(tmp_path / 'run.dat', np.transpose([y, u, rng.standard_normal(len(u))]))
    monkeypatch.chdir(tmp_path)
    assert main(['try', 'run.dat', '--out', 'res', '--quiet']) == 1
    assert '--time 100Hz' in capsys.readouterr().err
    args = ['try', 'run.dat', '--time', '20Hz', '--out', 'res', '--force', '--quiet']
    assert main([*args, '--input', 'column_1', '--output', 'column_3']) == 3
    assert 'ctsid try run.dat --time 20Hz --input FIELD --output FIELD' in capsys.readouterr().out
    assert main([*args, '--input', 'column_2']) == 0
    assert 'GOOD' in capsys.readouterr().out
    report = (tmp_path / 'res/report.md').read_text(encoding='utf-8')
    assert 'ctsid identify run.dat --time 20Hz --params res/params.yaml' in report
    assert '-2.0' in report


def test_a_rejected_run_names_better_pairs(base, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    good = guessed(base).config
    poor = good.with_channels([*good.inputs, replace(good.outputs[0], topic='/imu', type=IMU,
                                                     field='angular_velocity.x')])
    (tmp_path / 'p.yaml').write_text(dump_brief(poor))
    assert main(['identify', str(base), '--params', 'p.yaml', '--out', 'res', '--quiet']) == 3
    out = ' '.join(capsys.readouterr().out.split())
    assert 'the data say more about other signals: /twist_out twist.angular.z -> /' in out
    assert '-o other.yaml --' in out


def test_units_are_those_of_message_types_not_of_names(tmp_path):
    rng, time = np.random.default_rng(9), np.arange(0.0, 40.0, 0.02)
    u = moves(rng, len(time), 25)
    y = lagged(u, 2.0, 0.02) + 0.01 * rng.standard_normal(len(u))
    np.savetxt(tmp_path / 'run.csv', np.transpose([time, u, y]), delimiter=',', comments='',
               header='t,torque,speed')
    found = guessed(tmp_path / 'run.csv').config.channels
    assert [(c.name, c.unit) for c in found] == [('torque', ''), ('speed', '')]
    np.savetxt(tmp_path / 'run.csv', np.transpose([time, u, y]), delimiter=',', comments='',
               header="t [s],voltage [V],x[0] (it's °/s)")
    found = guessed(tmp_path / 'run.csv').config
    assert [(c.field, c.unit) for c in found.channels] == [('voltage', 'V'), ('x[0]', "it's °/s")]
    (tmp_path / 'p.yaml').write_text(dump_brief(found), encoding='utf-8')
    assert [c.unit for c in read_config(str(tmp_path / 'p.yaml')).channels] == ['V', "it's °/s"]


@pytest.mark.slow
@pytest.mark.parametrize('turn', [360.0, 2.0 * math.pi])
def test_an_angle_that_wraps_is_unwrapped_and_that_is_said(tmp_path, capsys, monkeypatch, turn):
    rng, time = np.random.default_rng(11), np.arange(0.0, 60.0, 0.02)
    u = moves(rng, len(time), 25)
    yaw = lagged(u, 2.0, 0.02) * turn + 0.001 * turn * rng.standard_normal(len(u))
    np.savetxt(tmp_path / 'run.csv', np.transpose([time, u, yaw % turn]), delimiter=',',
               comments='', header='t,command,heading')
    monkeypatch.chdir(tmp_path)
    assert main(['try', 'run.csv', '--out', 'res', '--quiet']) == 0
    assert read_config('res/params.yaml').outputs[0].turn == turn
    told = ''.join(capsys.readouterr())
    assert f'it is unwrapped (`heading.turn: {turn!r}`; 0.0 would leave it as it is)' in told


@pytest.mark.parametrize(('name', 'at_once'), [
    ('linear_acceleration.x', True), ('accelerometer_m_s2[0]', True), ('AccX', True),
    ('accel', True), ('acc', True), ('angular_velocity.x', False), ('account', False)])
def test_accelerometers_answer_at_once_whoever_names_them(name, at_once):
    assert bool(_AT_ONCE.search(name)) is at_once


def test_two_large_steps_hide_no_experiment():
    """To take off and to land: the 480 s between them were the pace, and no stretch was left."""
    rng, ticks = np.random.default_rng(0), clock(600.0, 50.0)
    t = ticks.time
    u = 0.002 * moves(rng, len(t), 5) + 5.0 * ((t > 20.0) & (t < 500.0))
    u += 0.3 * np.sign(moves(rng, len(t), 50)) * ((t > 300.0) & (t < 360.0))
    assert any(s.start < 305.0 and s.end > 355.0 for s in excited(u, ticks))


def test_the_first_level_of_a_command_acts_before_it_moves(tmp_path):
    """A motor began to turn by it: "the output moves first", and only the inverse was offered."""
    rng, step = np.random.default_rng(0), 0.01
    u = moves(rng, 3000, 100)
    y = lagged(u, 6.7, step) + 0.01 * rng.standard_normal(len(u))
    np.savetxt(tmp_path / 'run.csv', np.transpose([step * np.arange(len(u)), u, y]), delimiter=',',
               comments='', header='t [s],duty,speed')
    config = guessed(tmp_path / 'run.csv').config
    assert [c.name for c in (*config.inputs, *config.outputs)] == ['duty', 'speed']


@pytest.mark.filterwarnings('error::RuntimeWarning')
def test_torn_values_are_no_signal(tmp_path):
    """Values so large that their squares are infinite: a column of them, and some in an output."""
    rng, t = np.random.default_rng(7), 0.01 * np.arange(1001)
    u = np.sign(np.sin(2.0 * t) + np.sin(5.1 * t))
    y = np.zeros(1001)
    for k in range(1000):
        y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-0.03)
    y += 0.05 * rng.standard_normal(1001)
    some = np.where(np.arange(1001) % 100 == 50, 1.7e308, y)
    table = tmp_path / 'flight.csv'
    np.savetxt(table, np.column_stack((t, u, some, 1e308 * y)), delimiter=',', comments='',
               header='t,u,y,torn')
    assert keys(ranked(table))[0] == (('flight', 'u'), ('flight', 'y'))
    assert all('torn' not in (p.input.key[1], p.output.key[1]) for p in ranked(table).pairs)
