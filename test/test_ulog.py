# SPDX-License-Identifier: Apache-2.0
"""PX4 ULog: topics, fields and times as in the file; damage is said."""

from __future__ import annotations

import struct
import sys

from bag_fixtures import notes, numbers, refused
from marks import slow
import numpy as np
import pytest
from recording_files import (
    ULogWriter,
    flight,
    samples_read,
    ulog_message,
    write_px4_log,
    write_ulog,
)

from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.guess_ranking import rank
from ctsid_ros.recordings.survey import survey

pytest.importorskip('pyulog')
T_U, U, T_Y, Y = flight(5.0)


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    return write_ulog(tmp_path_factory.mktemp('ulog') / 'log.ulg', T_U, U, T_Y, Y)


def columns(path, topic, *fields):
    """All rows of a topic, of all blocks."""
    with open_bag(path) as bag:
        found = [block.columns[0] for block in bag.blocks(
            {topic: [parse_field(field) for field in fields]})]
    first = found[0]
    for more in found[1:]:
        first = first.followed_by(more)
    return first


def test_topics_are_messages_and_their_instances(log):
    with open_bag(log) as bag:
        assert {name: (info.type, info.count) for name, info in bag.topics.items()} == {
            'vehicle_torque_setpoint': ('ulog/msg/VehicleTorqueSetpoint', len(U)),
            'vehicle_angular_velocity': ('ulog/msg/VehicleAngularVelocity', len(Y)),
            'vehicle_angular_velocity.1': ('ulog/msg/VehicleAngularVelocity', -(-len(Y) // 4)),
            'esc_status': ('ulog/msg/EscStatus', -(-len(Y) // 4))}
        assert bag.notes == ()


def test_values_and_times_are_those_of_the_file(log):
    rate = columns(log, 'vehicle_angular_velocity', 'xyz[0:2]')
    np.testing.assert_array_equal(rate.values, np.column_stack(
        [Y.astype(np.float32), np.full(len(Y), np.float32(0.1))]))
    microseconds = np.round(T_Y * 1e6).astype(np.int64)
    np.testing.assert_array_equal(rate.header_ns, microseconds * 1000)  # when it was sampled
    np.testing.assert_array_equal(rate.log_ns, (microseconds + 2000) * 1000)
    torque = columns(log, 'vehicle_torque_setpoint', 'xyz[0]')
    assert torque.header_ns is None  # it acts from its publishing on
    np.testing.assert_array_equal(torque.values[:, 0], U)


def test_nested_messages_and_arrays_are_fields_as_in_bags(log):
    with open_bag(log) as bag:
        assert [str(field) for field in bag.scalar_fields('esc_status')] == [
            'esc[0].timestamp', 'esc[0].rpm', 'esc[0].armed', 'esc[1].timestamp', 'esc[1].rpm',
            'esc[1].armed', 'count']
        assert str(bag.bind('esc_status', parse_field('esc[:].rpm'))) == 'esc[0:2].rpm'
        with pytest.raises(BagError, match='no field .spin.; nearest: .*rpm|there are: '):
            bag.bind('esc_status', parse_field('esc[0].spin'))
    rows = numbers(log, 'esc_status', 'esc[:].rpm', 'esc[1].armed', 'count')
    assert rows[5] == (1020.0, 1020.0, 1.0, 20.0)


def test_a_log_that_is_cut_off(tmp_path, log):
    content = log.read_bytes()
    cut = tmp_path / 'cut.ulg'
    cut.write_bytes(content[:-7])
    assert 'cut.ulg: truncated: ' in notes(cut)
    with open_bag(cut) as bag, open_bag(log) as whole:
        found, all_of_them = (sum(info.count for info in b.topics.values())
                              for b in (bag, whole))
    assert found == all_of_them - 1
    assert f'truncated: {found} messages recovered' in notes(cut)


@pytest.mark.parametrize('size', [7, 12, 17, 40, 75, 300, 420])
def test_a_log_without_a_message(tmp_path, log, size):
    (tmp_path / 'b.ulg').write_bytes(log.read_bytes()[:size])
    assert 'before its first message' in refused(tmp_path / 'b.ulg')


def test_a_damaged_place_loses_its_messages_only(tmp_path, log):
    content = bytearray(log.read_bytes())
    middle = len(content) // 2
    content[middle:middle + 200] = bytes(200)
    path = tmp_path / 'hole.ulg'
    path.write_bytes(content)
    said = notes(path)
    assert 'hole.ulg: damaged: ' in said
    with open_bag(path) as bag:
        count = bag.topics['vehicle_angular_velocity'].count
    assert len(Y) - 60 < count < len(Y)  # up to the next mark, half a second later


def test_damage_anywhere_does_not_crash(tmp_path, log):
    content = log.read_bytes()
    rng = np.random.default_rng(0)
    path, read = tmp_path / 'd.ulg', 0
    for _ in range(40):
        damaged = bytearray(content)
        start = int(rng.integers(0, 3000))
        damaged[start:start + 8] = rng.bytes(8)
        path.write_bytes(damaged)
        read += samples_read(path)
    assert read > 10 * len(Y)


def test_dropouts_are_counted_and_impossible_times_left_out(tmp_path):
    log = ULogWriter()
    log.format('gyro', 'uint64_t timestamp;float x;')
    number = log.subscribe('gyro')
    for time_us in (0, 1_000_000, 1_010_000, 2**63, 1_020_000):
        log.data(number, time_us, struct.pack('<f', time_us))
    log.dropout(1_005_000, 250)
    log.dropout(1_015_000, 150)
    path = tmp_path / 'drop.ulg'
    path.write_bytes(log.bytes())
    assert 'the logger dropped messages 2 times, for 0.4 s in all' in notes(path)
    assert 'topic gyro: 2 messages left out whose times are zero or impossible' in notes(path)
    assert [value for (value,) in numbers(path, 'gyro', 'x')] == [1.0e6, 1.01e6, 1.02e6]


def test_attitudes_have_angles(tmp_path):
    log = ULogWriter()
    log.format('vehicle_attitude', 'uint64_t timestamp;float[4] q;')
    number = log.subscribe('vehicle_attitude')
    angles = np.linspace(-1.0, 1.0, 9)
    for i, roll in enumerate(angles):
        log.data(number, 1_000_000 + 10_000 * i,
                 struct.pack('<4f', np.cos(roll / 2), np.sin(roll / 2), 0.0, 0.0))
    path = tmp_path / 'a.ulg'
    path.write_bytes(log.bytes())
    with open_bag(path) as bag:
        assert [str(field) for field in bag.scalar_fields('vehicle_attitude')] == [
            'q[0]', 'q[1]', 'q[2]', 'q[3]', 'euler(q_xyzw).roll', 'euler(q_xyzw).pitch',
            'euler(q_xyzw).yaw']
    np.testing.assert_allclose(numbers(path, 'vehicle_attitude', 'euler(q_xyzw).roll'),
                               angles[:, None], atol=1e-6)


def test_messages_without_time_are_no_topic(tmp_path):
    log = ULogWriter()
    log.format('odd', 'float x;')
    log.format('gyro', 'uint64_t timestamp;float x;')
    number, odd = log.subscribe('gyro'), log.subscribe('odd')
    log.data(number, 1_000_000, struct.pack('<f', 1.0))
    log.messages.append((1_000_001, ulog_message('D', struct.pack('<Hf', odd, 1.0))))
    (tmp_path / 'a.ulg').write_bytes(log.bytes())
    with open_bag(tmp_path / 'a.ulg') as bag:
        assert list(bag.topics) == ['gyro']


def test_without_its_library(log, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, 'pyulog', None)
    copy = tmp_path / 'copy.ulg'
    copy.write_bytes(log.read_bytes())
    assert refused(copy).endswith('is a PX4 ULog: to read it, ctsid needs the Python package '
                                  'pyulog, which is not installed here: pip install pyulog (it '
                                  'is the extra `px4` of ctsid)')


def test_messages_that_were_waiting_when_the_log_began(tmp_path):
    """They keep the times at which they were published: before the log, or in an earlier run."""
    log = ULogWriter(start_us=20_000_000)
    log.format('gyro', 'uint64_t timestamp;float x;')
    log.format('mission', 'uint64_t timestamp;float x;')
    gyro, mission, old = log.subscribe('gyro'), log.subscribe('mission'), log.subscribe('mission',
                                                                                        1)
    for i in range(50):
        log.data(gyro, 20_000_000 + 10_000 * i, struct.pack('<f', i))
    log.data(mission, 1_200_000_000, struct.pack('<f', 1.0))
    log.data(old, 3_000_000, struct.pack('<f', 2.0))
    path = tmp_path / 'a.ulg'
    path.write_bytes(log.bytes())
    with open_bag(path) as bag:
        assert (bag.start_ns, bag.end_ns) == (20_000_000_000, 20_490_000_000)
        assert bag.notes == ()
    assert numbers(path, 'mission', 'x') + numbers(path, 'mission.1', 'x') == [(1.0,), (2.0,)]
    assert columns(path, 'gyro', 'x').values[:, 0].tolist() == list(range(50))


def test_a_log_that_pyulog_has_written(tmp_path, log):
    from pyulog import ULog
    again = tmp_path / 'again.ulg'
    ULog(str(log)).write_ulog(str(again))
    for topic, field in (('vehicle_torque_setpoint', 'xyz[0]'), ('esc_status', 'esc[1].rpm'),
                         ('vehicle_angular_velocity', 'xyz[0]')):
        one, other = (columns(path, topic, field) for path in (log, again))
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_array_equal(one.log_ns, other.log_ns)
    with open_bag(again) as bag:
        assert bag.notes == ()


def first_pair(path):
    """The most promising pair."""
    with open_bag(path) as bag:
        pair = rank(bag, survey(bag)).pairs[0]
    return pair.input.key, pair.output.key


def turned(axis: int):
    return {(('vehicle_torque_setpoint', f'xyz[{axis}]'), (topic, f'{field}[{axis}]'))
            for topic, field in (('vehicle_angular_velocity', 'xyz'),
                                 ('sensor_combined', 'gyro_rad'))}


@pytest.mark.slow
@pytest.mark.parametrize('axis', [2, *slow(0, 1)])
def test_an_excited_axis_is_found_in_a_px4_log(tmp_path, axis):
    """Not what the takeoff moved as well, once, nor the setpoint of the loop around it."""
    assert first_pair(write_px4_log(tmp_path / 'log.ulg', axis, axis=axis)) in turned(axis)


@pytest.mark.slow
def test_a_real_px4_log_offers_a_torque_and_what_it_turns(data_folder):
    """A hover in PX4's simulation, without an experiment."""
    assert first_pair(data_folder / 'ulog/sample_px4_events.ulg') in turned(2)
