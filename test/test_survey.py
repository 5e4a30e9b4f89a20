# SPDX-License-Identifier: Apache-2.0
"""What is measured of a bag, and what is guessed from it."""

from __future__ import annotations

from dataclasses import replace
import math

from bag_fixtures import (
    IMU,
    START,
    Sent,
    array,
    header,
    imu,
    joints,
    make,
    vector,
    write_mcap,
)
from bag_fixtures import flight as flight_bag
from flights import S, at, flight, spoilt, stamp_of
import numpy as np
import pytest
import yaml

from ctsid_ros.config.parameter_file import parse_config
from ctsid_ros.config.parameter_text import dump_config
from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.guess import guess
from ctsid_ros.recordings.survey import RUN, survey
from ctsid_ros.recordings.survey_stats import field_stats, stamp_stats

FIELD = parse_field('x')
TWIST, ODOMETRY = 'geometry_msgs/msg/Twist', 'nav_msgs/msg/Odometry'


def surveyed(path, **more):
    with open_bag(path) as bag:
        return survey(bag, **more)


def guessed(path):
    return guess(surveyed(path))


def fields(found, role: str) -> list[tuple[str, str]]:
    return [(c.topic, c.field) for c in found.config.channels if c.role == role]


# --- measurements


def test_stamps_are_measured():
    steps = np.full(999, 10_000_000)
    steps[100], steps[200], steps[300] = 50_000_000, -5_000_000, 0
    found = stamp_stats('log', START + np.concatenate([[0], np.cumsum(steps)]))
    assert found.usable
    assert (found.period, found.gaps, found.longest) == pytest.approx((0.01, 1, 0.05))
    assert (found.backward, found.repeated) == (1, 1)
    assert found.jitter == pytest.approx(0, abs=1e-12)
    jittered = START + np.arange(5000) * 10_000_000 + np.random.default_rng(0).integers(
        0, 2_000_000, 5000)
    assert stamp_stats('log', jittered).jitter == pytest.approx(0.002 / math.sqrt(6), rel=0.05)


@pytest.mark.parametrize(('stamps', 'usable', 'why'), [
    ([0, 0, 0, 0], False, 'all are zero'), ([0, 0, 0, START], False, '3 of 4 are zero'),
    ([0, START, START + 1, START + 2], True, '1 of 4 are zero'), ([START] * 4, False, 'increase'),
    ([START], True, ''), ([], False, '')])
def test_stamps_that_cannot_be_used(stamps, usable, why):
    found = stamp_stats('header', np.array(stamps, dtype=np.int64))
    assert found.usable is usable
    assert why in found.why


def test_movement_is_told_from_noise_constants_and_counters():
    t, rng = np.arange(1000.0), np.random.default_rng(0)
    sine, noise = np.sin(t / 20), rng.standard_normal(1000)
    kinds = {'sine': sine, 'noisy': sine + 0.1 * noise, 'noise': noise, 'constant': 0 * t + 3.3,
             'counter': t, 'rounding': 1e6 + 1e-5 * noise}
    found = {name: field_stats(FIELD, values, RUN) for name, values in kinds.items()}
    assert {n for n, f in found.items() if f.moves} == {'sine', 'noisy', 'noise', 'counter'}
    assert {n for n, f in found.items() if f.white} == {'noise'}
    assert {n for n, f in found.items() if f.monotone} == {'counter'}
    assert found['sine'].std == pytest.approx(math.sqrt(0.5), rel=0.02)
    spoilt_values = np.where(t % 10 == 0, np.nan, sine)
    assert field_stats(FIELD, spoilt_values, RUN).finite == pytest.approx(0.9)
    assert not field_stats(FIELD, np.full(9, np.nan), RUN).moves


def test_noise_is_judged_within_runs_only():
    """Between two runs a signal may have gone anywhere."""
    values = np.repeat(np.tile([1.0, -1.0], 500), 2)
    assert field_stats(FIELD, values, 10_000).white
    assert not field_stats(FIELD, values, 2).white


def test_angles_are_unwrapped():
    angle = np.mod(np.arange(1000) * 0.01 + math.pi, 2 * math.pi) - math.pi
    found = field_stats(parse_field('euler(q).yaw'), angle, RUN)
    assert found.high - found.low == pytest.approx(9.99)


def test_long_topics_are_decoded_in_part_and_all_over(tmp_path):
    sent = [Sent('/imu', IMU, START + k * 1_000_000, imu(START + k * 1_000_000, k / 100))
            for k in range(8000)]
    (topic,) = surveyed(write_mcap(tmp_path / 'bag.mcap', sent)).topics
    assert topic.rate == pytest.approx(1000.0)
    (moving,) = topic.moving
    assert moving.low == 0.0
    assert moving.high > 70.0  # hundredths of the number of the message


def test_the_number_of_messages_is_bounded(tmp_path):
    found = surveyed(write_mcap(tmp_path / 'bag.mcap', flight(10.0)), most=300)
    assert found.covered < 3
    assert 'only the first 300 messages were looked at' in found.notes


def test_undecodable_messages_are_counted(tmp_path):
    sent = spoilt('/imu', lambda k, s: replace(s, message=b'\0\1\0\0') if k % 10 == 5 else s,
                  flight(4.0))
    topics = {t.info.name: t for t in surveyed(write_mcap(tmp_path / 'bag.mcap', sent)).topics}
    assert topics['/imu'].undecodable == 40
    assert [f.field for f in topics['/imu'].moving] == ['angular_velocity.x']


# --- guesses


def twist(x: float, yaw: float):
    return make(TWIST, linear=vector(x), angular=vector(0, 0, yaw))


def odometry(stamp_ns: int, x: float, yaw: float):
    inner = make('geometry_msgs/msg/TwistWithCovariance', twist=twist(x, yaw))
    return make(ODOMETRY, header=header(stamp_ns), twist=inner)


def drive(seconds: int = 20) -> list[Sent]:
    sent = []
    for k in range(50 * seconds):
        stamp, x, yaw = START + k * S // 50, math.sin(k / 20), math.cos(k / 30)
        sent.append(Sent('/odom', ODOMETRY, stamp, odometry(stamp, x, yaw)))
        sent.append(Sent('/imu', IMU, stamp, imu(stamp, 0.01 * x)))
        if k % 5 == 0:
            sent.append(Sent('/cmd_vel', TWIST, stamp, twist(x, yaw)))
    return sent


def test_drive_base(tmp_path):
    found = guessed(write_mcap(tmp_path / 'bag.mcap', drive()))
    assert set(fields(found, 'input')) == {('/cmd_vel', 'linear.x'), ('/cmd_vel', 'angular.z')}
    assert set(fields(found, 'output')) == {('/odom', 'twist.twist.linear.x'),
                                            ('/odom', 'twist.twist.angular.z')}
    units = {c.field: c.unit for c in found.config.channels}
    assert units['linear.x'] == 'm/s'
    assert units['twist.twist.angular.z'] == 'rad/s'
    assert ('/imu', 'angular_velocity.x') in [other[:2] for other in found.others]
    assert not found.config.settings.feedthrough
    assert parse_config(yaml.safe_load(dump_config(found.config))) == found.config


def test_arm_with_commands(tmp_path):
    kind = 'sensor_msgs/msg/JointState'
    sent = []
    for k in range(500):
        stamp = START + k * S // 50
        sent.append(Sent('/joint_states', kind, stamp,
                         joints(stamp, [math.sin(k / 20), math.cos(k / 20)])))
        sent.append(Sent('/joint_commands', kind, stamp,
                         joints(stamp, [math.sin(k / 20 + 0.1), math.cos(k / 20 + 0.1)])))
    found = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    assert {topic for topic, _ in fields(found, 'input')} == {'/joint_commands'}
    assert {topic for topic, _ in fields(found, 'output')} == {'/joint_states'}


def test_one_topic_with_efforts(tmp_path):
    sent = [Sent('/joint_states', 'sensor_msgs/msg/JointState', START + k * S // 50,
                 joints(START + k * S // 50, [math.sin(k / 20)])) for k in range(500)]
    found = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    assert fields(found, 'input') == [('/joint_states', 'effort[0]')]
    assert fields(found, 'output')[0][0] == '/joint_states'
    assert {c.hold for c in found.config.channels} == {'smooth'}  # measured, not held


def test_what_looks_like_noise_is_not_an_output(tmp_path):
    rng = np.random.default_rng(0)

    def noisy(_: int, one: Sent) -> Sent:
        changed = at(one, stamp_of(one))  # a message of its own: flights share theirs
        changed.message.angular_velocity.y = rng.standard_normal()
        return changed

    found = guessed(write_mcap(tmp_path / 'bag.mcap', spoilt('/imu', noisy, flight(10.0))))
    assert fields(found, 'output') == [('/imu', 'angular_velocity.x')]
    assert ('/imu', 'angular_velocity.y') in [other[:2] for other in found.others]


def test_two_topics_of_which_none_is_named_like_a_command(tmp_path):
    sent = [Sent(topic, 'std_msgs/msg/Float64MultiArray', START + k * S // 50,
                 array(math.sin(k / 20 + i))) for k in range(500) for i, topic in
            enumerate(('/a', '/b'))]
    found = guessed(write_mcap(tmp_path / 'bag.mcap', sent))
    assert {t for t, _ in fields(found, 'input') + fields(found, 'output')} == {'/a', '/b'}


def test_windows_fit_into_the_bag(tmp_path):
    for seconds, length in ((8, 4.0), (20, 10.0)):
        found = guessed(write_mcap(tmp_path / f'{seconds}.mcap', drive(seconds)))
        assert found.config.settings.window_length == pytest.approx(length, rel=0.05)


def test_too_little_moves(tmp_path):
    sent = [Sent('/cmd', 'std_msgs/msg/Float64MultiArray', START + k * S // 50,
                 array(math.sin(k / 20), 1.0)) for k in range(100)]
    with pytest.raises(BagError, match=r'only data\[0\] of /cmd does'):
        guessed(write_mcap(tmp_path / 'bag.mcap', sent))


@pytest.mark.parametrize('text', ['float64 x\nwstring name\nfloat64 y\n', 'float64 x\n'],
                         ids=['wstring', 'XCDR2'])
def test_a_topic_that_cannot_be_decoded_leaves_the_others(tmp_path, text):
    """As `ctsid info` and `ctsid init` look at it."""
    body = np.array([1.5]).tobytes() + b'\2\0\0\0x\0y\0' + np.array([2.5]).tobytes()
    kind = b'\0\7\0\0' if 'wstring' not in text else b'\0\1\0\0'
    write_mcap(tmp_path / 'a.mcap', flight_bag(200))
    write_mcap(tmp_path / 'b.mcap', [Sent('/odd', IMU, START + k * 10**7, kind + body)
                                     for k in range(50)], schema=('ros2msg', text.encode()))
    found = {t.info.name: t for t in surveyed(tmp_path).topics}
    assert found['/odd'].undecodable == 50
    assert found['/odd'].fields == ()
    assert found['/imu'].moving
    assert '/odd' not in {c.topic for c in guessed(tmp_path).config.channels}
