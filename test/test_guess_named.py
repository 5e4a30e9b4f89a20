# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs that are named, and what is guessed beside them; logs of PX4 as it flies."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
import json
import re
import shlex
import struct

from bag_fixtures import START, Sent, array, imu, make, vector, write_mcap
from marks import slow
import numpy as np
import pytest
from recording_files import ULogWriter
from scipy.linalg import expm

from ctsid_core.model.storage import load_estimate
from ctsid_ros.cli import main
from ctsid_ros.config.parameter_file import read_config
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.excited import Stretch, together
from ctsid_ros.recordings.guess import guess
from ctsid_ros.recordings.guess_candidates import is_wanted
from ctsid_ros.recordings.guess_named import named
from ctsid_ros.recordings.guess_pairs import Explained
from ctsid_ros.recordings.guess_ranking import _score, rank
from ctsid_ros.recordings.survey import survey

S = 10**9
TWIST = 'geometry_msgs/msg/Twist'


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    """Two inputs drive two rates each; a switch, and a copy of the rates of a second sensor."""
    rng = np.random.default_rng(5)
    step, count = 0.01, 2000
    u = np.repeat(rng.uniform(-1, 1, (count // 25, 2)), 25, axis=0)
    x = np.zeros((count, 2))
    for k in range(1, count):
        x[k] = x[k - 1] + step * (-4 * x[k - 1] + 4 * u[k - 1] @ [[1.0, 0.2], [0.0, 1.0]])
    x += 0.01 * rng.standard_normal(x.shape)
    sent = []
    for k in range(count):
        now = START + round(k * step * 1e9)
        sample = imu(now, x[k, 0])
        sample.angular_velocity.y = x[k, 1]
        sent += [Sent(topic, 'sensor_msgs/msg/Imu', now, sample) for topic in ('/imu', '/imu2')]
        if k % 5 == 0:
            sent.append(Sent('/cmd', TWIST, now, make(TWIST, linear=vector(u[k, 0], 0.0, 0.0),
                                                      angular=vector(0.0, 0.0, u[k, 1]))))
            sent.append(Sent('/arm', 'std_msgs/msg/Float64MultiArray', now, array(
                *np.sin([0.013 * k, 0.017 * k, 0.019 * k]))))
            sent.append(Sent('/switch', 'std_msgs/msg/Bool', now, make(
                'std_msgs/msg/Bool', data=k > 1000)))
    return str(write_mcap(tmp_path_factory.mktemp('named') / 'robot.mcap', sent))


@lru_cache
def surveyed(path):
    """What is in a bag, looked at once."""
    with open_bag(path) as bag:
        return survey(bag)


def keys(path, inputs=(), outputs=(), pick=1):
    with open_bag(path) as bag:
        found = surveyed(path)
        config = guess(bag, found, pick, named(found, inputs, outputs)).config
    return [[f'{c.topic} {c.field}' for c in own] for own in (config.inputs, config.outputs)]


@pytest.mark.parametrize(('text', 'fields'), [
    ('linear.x', ['/cmd linear.x']),
    ('/cmd *.?', ['/cmd linear.x', '/cmd angular.z']),
    ('/arm data[0:2]', ['/arm data[0]', '/arm data[1]']),
    ('/arm/data[1]', ['/arm data[1]']),
    ('/cmd {angular.z, linear.x}', ['/cmd angular.z', '/cmd linear.x']),
    ('/switch', ['/switch data']), *slow(
        ('/cmd linear.x', ['/cmd linear.x']), ('/cmd/angular.z', ['/cmd angular.z']),
        ('/cmd', ['/cmd linear.x', '/cmd angular.z']))])
def test_words_stand_for_fields(robot, text, fields):
    """As `ctsid info` prints them; brackets are indices, no patterns of characters."""
    assert keys(robot, [text], ['/imu angular_velocity.x'])[0] == fields


@pytest.mark.parametrize(('inputs', 'outputs', 'reason'), [
    (['/cmd linear.y'], [], "nothing that is called '/cmd linear.y' moves"),
    (['/cmd linear.q'], [], 'nearest: /cmd linear.x'),
    (['/comd'], [], 'nearest: /cmd'),
    ([], ['angular_velocity.x'], "name the topic as well: '/imu angular_velocity.x'"),
    (['linear.x'], ['/cmd linear.x'], 'cannot be an input and an output'),
    ([], ['params.yaml'], '-o FILE')])
def test_words_that_stand_for_nothing(robot, inputs, outputs, reason):
    with pytest.raises(BagError, match=re.escape(reason)):
        keys(robot, inputs, outputs)


def test_what_a_table_has_are_its_columns(tmp_path):
    path = tmp_path / 'gust.csv'
    t = np.arange(0.0, 10.0, 0.02)
    np.savetxt(path, np.transpose([t, np.sin(t), np.cos(t)]), delimiter=',', header='t,cmd,pos',
               comments='')
    with pytest.raises(BagError, match="is called 'cmdd'; nearest: cmd; also: pos; "):
        keys(path, ['cmdd'])
    with pytest.raises(BagError, match="is called 'x'; there are: cmd, pos; "):
        keys(path, ['x'])


def test_what_is_not_named_is_chosen_from_the_data(robot):
    assert keys(robot, outputs=['/imu angular_velocity.x'])[0] == ['/cmd linear.x']
    assert keys(robot, ['/cmd angular.z'])[1][0].endswith('angular_velocity.y')
    both = keys(robot, outputs=['/imu angular_velocity.{x,y}'])
    assert both[1] == ['/imu angular_velocity.x', '/imu angular_velocity.y']
    assert both[0] == ['/cmd linear.x', '/cmd angular.z']
    # Whichever command is picked, one model of all.
    assert keys(robot, outputs=['/imu angular_velocity.{x,y}'], pick=2)[0] == both[0]


@pytest.mark.slow
def test_from_names_to_a_model_of_two_inputs_and_outputs(robot, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['init', robot, '-o', 'p.yaml', '--input', 'linear.x', '--input', 'angular.z',
                 '--output', '/imu angular_velocity.*']) == 0
    said = capsys.readouterr()
    assert 'with 2 inputs and 2 outputs' in said.out
    assert said.out.count(' *  /cmd') == 4
    config = read_config('p.yaml')
    assert [(c.field, c.hold) for c in config.channels] == [
        ('linear.x', 'zoh'), ('angular.z', 'zoh'), ('angular_velocity.x', 'smooth'),
        ('angular_velocity.y', 'smooth')]
    assert len({c.name for c in config.channels}) == 4
    assert main(['identify', robot, '--params', 'p.yaml', '--out', 'res', '--quiet',
                 '--duration', '8']) == 0


def test_stretches_of_several_inputs_are_those_of_any():
    first = [Stretch(0.0, 10.0, 20.0, 0.5), Stretch(50.0, 60.0, 20.0, 0.5)]
    second = [Stretch(8.0, 20.0, 30.0, 1.0)]
    assert together([first, second]) == (Stretch(0.0, 20.0, 30.0, 1.0), first[1])
    assert together([first, []]) == ()
    assert together([first]) == tuple(first)


def test_what_few_samples_explain_counts_less(robot):
    """Adjusted R^2: as many steps as samples explain anything."""
    with open_bag(robot) as bag:
        pair = rank(bag, survey(bag)).pairs[0]
    scores = [_score(pair.input, replace(pair.output, rate=samples / 20.0),
                     Explained(0.5, 0.1, 20.0), 10.0) for samples in (29, 35, 60, 200, 2000)]
    assert scores[0] == 0.0
    assert scores == sorted(scores)
    assert scores[1] == 0.0     # 22 steps explain half of 35 samples of noise
    assert scores[3] == pytest.approx(scores[4], rel=0.12)


@pytest.mark.parametrize(('topic', 'wish'), [
    ('vehicle_rates_setpoint', True), ('/cmd_vel/desired', True), ('/target_pose', True),
    ('goal', True), ('x_des', True), ('/attitude_sp', True), ('description', False),
    ('vehicle_torque_setpoint', False), ('/desired_wrench', False), ('/cmd', False)])
def test_a_wanted_force_is_a_command(topic, wish):
    assert is_wanted(topic) is wish


def write_px4(path, seconds: float = 40.0, seed: int = 3):
    """A quadrotor's rate loop as PX4 logs it: setpoints, torque, motors, gyro, attitude."""
    rng = np.random.default_rng(seed)
    log = ULogWriter()
    forms = {'vehicle_rates_setpoint': 'float roll;float pitch;float yaw',
             'vehicle_torque_setpoint': 'float[3] xyz', 'actuator_motors': 'float[4] control',
             'esc_status': 'float[4] rpm;float[4] current',
             'vehicle_angular_velocity': 'float[3] xyz', 'vehicle_attitude': 'float[4] q',
             'vehicle_attitude_setpoint': 'float roll_body;float pitch_body',
             'battery_status': 'float voltage_v;float current_a',
             'cpuload': 'float load;float ram_usage', 'manual_control_setpoint': 'float roll'}
    numbers = {}
    for name, fields in forms.items():
        log.format(name, f'uint64_t timestamp;{fields};')
        numbers[name] = log.subscribe(name)

    def write(name, now, *values):
        log.data(numbers[name], round(now * 1e6), struct.pack(f'<{len(values)}f', *values))

    step, count = 0.004, int(seconds / 0.004)
    wanted = np.repeat(rng.uniform(-1, 1, (count // 100 + 1, 3)), 100, axis=0)
    rate, angle, motors = np.zeros(3), np.zeros(3), np.zeros(4)
    mixer = np.array([[-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]]) / 4
    effect = np.linalg.pinv(mixer)
    for k in range(count):
        now = 10.0 + k * step
        setpoint = wanted[k] - 0.8 * angle
        torque = 0.15 * (setpoint - rate) + 0.02 * rng.standard_normal(3)
        command = 0.5 + mixer @ torque
        motors += step * 25 * (command - motors)
        acting = 4 * effect.dot(motors - 0.5) / 4
        rate = rate + step * (30 * acting - 1.5 * rate) + 0.004 * rng.standard_normal(3)
        angle = angle + step * rate
        gyro = rate + 0.01 * rng.standard_normal(3)
        if k % 2 == 0:
            write('vehicle_angular_velocity', now, *gyro)
            write('vehicle_torque_setpoint', now + 0.0003, *torque)
            write('vehicle_rates_setpoint', now, *setpoint)
            write('actuator_motors', now + 0.0005, *command)
        if k % 5 == 0:
            w, (x, y, z) = 1 - angle @ angle / 8, angle / 2
            write('vehicle_attitude', now, w, x, y, z)
            write('vehicle_attitude_setpoint', now, *(wanted[k, :2]))
            write('manual_control_setpoint', now, wanted[k, 0])
        if k % 25 == 0:
            write('esc_status', now, *(9000 * np.sqrt(np.maximum(motors, 0))), *(10 * motors))
        if k % 50 == 0:
            power = float(motors.sum())
            write('battery_status', now, 16.4 - 0.2 * power, 10 * power)
            write('cpuload', now, rng.uniform(), 0.4)
    path.write_bytes(log.bytes())
    return path


@pytest.mark.parametrize('seed', [3, *slow(4)])
def test_a_log_of_px4_is_guessed_from_torque_to_rate(tmp_path, seed):
    """Not from a single motor, nor to what the motors say of themselves."""
    pytest.importorskip('pyulog')
    path = write_px4(tmp_path / 'log.ulg', seed=seed)
    (u,), (y,) = keys(path)
    axis = u[-2]
    assert (u, y) == (f'vehicle_torque_setpoint xyz[{axis}]',
                      f'vehicle_angular_velocity xyz[{axis}]')


@pytest.mark.slow
@pytest.mark.parametrize('names', [('u', 'y'), ('command', 'angle')])
def test_a_table_of_a_loop_has_the_command_that_is_held(tmp_path, monkeypatch, capsys, names):
    """An unstable plant under a sampled controller, whose set point jumps."""
    rng, step = np.random.default_rng(2), expm(0.01 * np.array(
        [[0.0, 1.0, 0.0], [6.0, -1.0, 1.0], [0.0, 0.0, 0.0]]))
    x, last, rows = np.zeros(2), 0.0, []
    for k in range(2000):
        y = x[0] + 1e-3 * rng.standard_normal()
        goal = 0.3 * (k // 500 % 2) + 0.1 * np.sin(0.04 * k)
        u = 20.0 * (goal - y) - 6.0 * (y - last) / 0.01
        last, x = y, step[:2, :2] @ x + step[:2, 2] * u
        rows.append(f'{0.01 * k:.2f},{u:.9g},{y:.9g}')
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'loop.csv').write_text('\n'.join([f't,{names[0]},{names[1]}', *rows]) + '\n')
    assert main(['try', 'loop.csv', '--out', 'res']) == 0
    u = next(c for c in read_config('res/params.yaml').channels if c.role == 'input')
    assert (u.field, u.hold) == (names[0], 'zoh')
    found = load_estimate('res/model.json')
    assert found.good
    assert np.sort(found.model.poles.real) == pytest.approx([-3.0, 2.0], abs=0.1)
    capsys.readouterr()
    assert main(['simulate', 'res/model.json', 'loop.csv', '--params', 'res/params.yaml',
                 '--json']) == 0
    told = json.loads(capsys.readouterr().out)
    assert any('cannot be simulated for so long' in note for note in told['notes'])


@pytest.mark.parametrize('names', ['ref,cmd,theta,omega', 'r,a,b,c'])
def test_of_a_loop_it_is_said_what_the_model_is_of(tmp_path, capsys, names):
    rng, step = np.random.default_rng(1), expm(0.01 * np.array(
        [[0.0, 1.0, 0.0, 0.0], [9.0, -0.5, 5.0, 0.0], [0.0, 0.0, -30.0, 30.0], [0.0] * 4]))
    x, rows = np.zeros(3), []
    goals = np.repeat(rng.uniform(-0.3, 0.3, 100), 40)
    moves = np.repeat(rng.choice([-0.6, 0.6], 40), 100)         # an experiment
    for k, (goal, more) in enumerate(zip(goals, moves, strict=True)):
        y = x[:2] + rng.standard_normal(2) * [1e-3, 5e-3]
        u = 8.0 * (goal - y[0]) - 1.6 * y[1] + more
        rows.append(f'{0.01 * k:.2f},{goal:.9g},{u:.9g},{y[0]:.9g},{y[1]:.9g}')
        x = step[:3, :3] @ x + step[:3, 3] * u
    (tmp_path / 'loop.csv').write_text('\n'.join([f't,{names}', *rows]) + '\n')
    assert main(['init', str(tmp_path / 'loop.csv'), '-o', str(tmp_path / 'p.yaml')]) == 0
    told = capsys.readouterr().err
    reference, command, *_ = (f'loop {name}' for name in names.split(','))
    chosen = {c.role: f'loop {c.field}' for c in read_config(tmp_path / 'p.yaml').channels}
    assert chosen['input'] == reference
    # A command that a controller makes is no output of the plant.
    assert f'--output {shlex.quote(command)}' not in told
    if 'ref' in names:
        assert f'{reference} is named like a set point: the model is of the closed loop' in told
        assert shlex.join(('--input', command, '--output', chosen['output'])) in told
    else:
        assert 'closed loop' not in told
