# SPDX-License-Identifier: Apache-2.0
"""ArduPilot's binary logs: instances, scales and times as in the file; damage is said."""

from __future__ import annotations

import struct
import sys

from bag_fixtures import notes, numbers, refused
import numpy as np
import pytest
from recording_files import dataflash, dataflash_format, flight, samples_read, write_ardupilot

from ctsid_ros.recordings.bag import open_bag

pytest.importorskip('pymavlink')
T_U, U, T_Y, Y = flight(5.0)


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    return write_ardupilot(tmp_path_factory.mktemp('ardupilot') / 'log.bin', T_U, U, T_Y, Y)


def test_topics_are_messages_and_their_instances(log):
    with open_bag(log) as bag:
        assert {name: (info.type, info.count) for name, info in bag.topics.items()} == {
            'RCOU': ('ardupilot/msg/RCOU', len(U)), 'IMU': ('ardupilot/msg/IMU', len(Y)),
            'IMU.1': ('ardupilot/msg/IMU', len(Y))}
        assert [str(field) for field in bag.scalar_fields('IMU')] == ['GyrX', 'GyrY']
        assert bag.notes == ()


def test_values_are_scaled_and_times_are_those_of_the_file(log):
    np.testing.assert_allclose(numbers(log, 'RCOU', 'C1'), U[:, None], rtol=1e-12)
    np.testing.assert_array_equal(numbers(log, 'IMU.1', 'GyrX'),
                                  (Y + 1).astype(np.float32)[:, None])
    with open_bag(log) as bag:
        stamps = [message.log_ns for message in bag.messages(['IMU'])]
    np.testing.assert_array_equal(stamps, np.round(T_Y * 1e6).astype(np.int64) * 1000)


def test_pymavlink_reads_the_same(log):
    from pymavlink.DFReader import DFReader_binary

    with DFReader_binary(str(log)) as reader:
        expected = []
        while (message := reader.recv_match(type='RCOU')) is not None:
            expected.append((message.C1,))
    assert numbers(log, 'RCOU', 'C1') == expected


def test_a_log_that_is_cut_off(tmp_path, log):
    cut = tmp_path / 'cut.bin'
    cut.write_bytes(log.read_bytes()[:-3])
    assert 'truncated: ' in notes(cut)
    assert 'the log ends within its last message' in notes(cut)
    with open_bag(cut) as bag:
        assert sum(info.count for info in bag.topics.values()) == len(U) + 2 * len(Y) - 1


@pytest.mark.parametrize('size', [3, 50, 89, 400])
def test_a_log_without_a_message(tmp_path, log, size):
    (tmp_path / 'b.bin').write_bytes(log.read_bytes()[:size])
    assert 'nothing can be recovered' in refused(tmp_path / 'b.bin')


def test_a_damaged_place_loses_its_messages_only(tmp_path, log):
    content = bytearray(log.read_bytes())
    middle = len(content) // 2
    content[middle:middle + 200] = bytes(200)
    path = tmp_path / 'hole.bin'
    path.write_bytes(content)
    assert 'hole.bin: damaged: ' in notes(path)
    with open_bag(path) as bag:
        assert len(Y) - 10 < bag.topics['IMU'].count < len(Y)


def test_damage_anywhere_does_not_crash(tmp_path, log):
    content = log.read_bytes()
    rng = np.random.default_rng(0)
    path, read = tmp_path / 'd.bin', 0
    for _ in range(12):
        damaged = bytearray(content)
        start = int(rng.integers(3, 3000))
        damaged[start:start + 8] = rng.bytes(8)
        path.write_bytes(damaged)
        read += samples_read(path)
    assert read > 3 * len(Y)


def test_times_that_cannot_be_are_left_out(tmp_path):
    parts = [dataflash_format(0x80, 'FMT', 'BBnNZ', 'Type,Length,Name,Format,Columns', 86),
             dataflash_format(2, 'GYR', 'Qf', 'TimeUS,X', 12)]
    parts += [dataflash(2, struct.pack('<Qf', time, 1.0))
              for time in (0, 1_000_000, 1_010_000, 2**63, 1_020_000)]
    path = tmp_path / 'a.bin'
    path.write_bytes(b''.join(parts))
    assert 'topic GYR: 2 messages left out whose times are zero or impossible' in notes(path)
    with open_bag(path) as bag:
        assert bag.topics['GYR'].count == 3


def test_without_its_library(tmp_path, log, monkeypatch):
    monkeypatch.setitem(sys.modules, 'pymavlink.DFReader', None)
    copy = tmp_path / 'copy.bin'
    copy.write_bytes(log.read_bytes())
    assert 'pip install pymavlink (it is the extra `ardupilot` of ctsid)' in refused(copy)
