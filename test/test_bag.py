# SPDX-License-Identifier: Apache-2.0
"""Bags in every container, sound, odd and damaged: what was recorded is what is read."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
import json
import math
import os
from pathlib import Path
import shutil
import sqlite3
import tempfile

from bag_fixtures import (
    IMU,
    START,
    STORE,
    Sent,
    array,
    bare,
    flight,
    flight_ros1,
    imu,
    joints,
    make,
    notes,
    numbers,
    rows,
    write_mcap,
    write_ros1,
    write_rosbag2,
    written,
)
from marks import slow
from mcap.writer import IndexType
import numpy as np
import pytest
import yaml
import zstandard

from ctsid_ros.cli import main
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.playback import read_record


def without_metadata(folder: Path) -> Path:
    (folder / 'metadata.yaml').unlink()
    return folder


def edit_metadata(folder: Path, change) -> Path:
    file = folder / 'metadata.yaml'
    content = yaml.safe_load(file.read_text())
    change(content['rosbag2_bagfile_information'])
    file.write_text(yaml.safe_dump(content))
    return folder


def renamed(path: Path) -> Path:
    return path.rename(path.with_name('some.data'))


NO_SUMMARY = {'index_types': IndexType.NONE, 'use_statistics': False, 'repeat_channels': False,
              'repeat_schemas': False, 'use_summary_offsets': False}
CONTAINERS = {
    'folder, mcap': lambda p, s: write_rosbag2(p / 'b', s),
    'folder, mcap, chunks packed': lambda p, s: write_rosbag2(p / 'b', s, compression='storage'),
    'folder, mcap, file packed': lambda p, s: write_rosbag2(p / 'b', s, compression='file'),
    'folder, mcap, messages packed': lambda p, s: write_rosbag2(p / 'b', s, 'mcap', 'message'),
    'folder, sqlite3': lambda p, s: write_rosbag2(p / 'b', s, 'sqlite3'),
    'folder, sqlite3, file packed': lambda p, s: write_rosbag2(p / 'b', s, 'sqlite3', 'file'),
    'folder, sqlite3, messages packed': lambda p, s: write_rosbag2(
        p / 'b', s, 'sqlite3', 'message'),
    'folder, mcap, no metadata': lambda p, s: without_metadata(write_rosbag2(p / 'b', s)),
    'folder, sqlite3, no metadata': lambda p, s: without_metadata(
        write_rosbag2(p / 'b', s, 'sqlite3')),
    'folder, messages packed, no metadata': lambda p, s: without_metadata(
        write_rosbag2(p / 'b', s, 'mcap', 'message')),
    'bare .mcap': lambda p, s: bare(write_rosbag2(p / 'b', s), '.mcap'),
    'bare .db3': lambda p, s: bare(write_rosbag2(p / 'b', s, 'sqlite3'), '.db3'),
    'bare .mcap.zstd': lambda p, s: bare(write_rosbag2(p / 'b', s, 'mcap', 'file'), '.mcap.zstd'),
    'mcap, lz4': lambda p, s: write_mcap(p / 'b.mcap', s, 'lz4'),
    'mcap, zstd': lambda p, s: write_mcap(p / 'b.mcap', s, 'zstd'),
    'mcap, not packed': lambda p, s: write_mcap(p / 'b.mcap', s, 'none'),
    'mcap, no chunks': lambda p, s: write_mcap(p / 'b.mcap', s, use_chunking=False),
    'mcap, no chunks, no summary': lambda p, s: write_mcap(
        p / 'b.mcap', s, use_chunking=False, **NO_SUMMARY),
    'mcap, no message index': lambda p, s: write_mcap(
        p / 'b.mcap', s, index_types=IndexType.CHUNK),
    'mcap, no index, no summary': lambda p, s: write_mcap(p / 'b.mcap', s, **NO_SUMMARY),
    'mcap, message index only': lambda p, s: write_mcap(
        p / 'b.mcap', s, **{**NO_SUMMARY, 'index_types': IndexType.MESSAGE}),
    'mcap, no CRC': lambda p, s: write_mcap(p / 'b.mcap', s, enable_crcs=False),
    'mcap under another name': lambda p, s: renamed(write_mcap(p / 'b.mcap', s)),
    'name with odd letters': lambda p, s: bare(
        write_rosbag2(p / 'b', s, 'sqlite3'), '.db3').rename(p / 'a #1 ?mode=rw&x%20y.db3'),
}


@pytest.mark.parametrize('container', CONTAINERS)
def test_every_container_gives_what_was_written(tmp_path, container):
    sent = flight()
    path = CONTAINERS[container](tmp_path, sent)
    with open_bag(path) as bag:
        assert bag.notes == ()
        assert {t.name: (t.type, t.count, t.has_header) for t in bag.topics.values()} == {
            '/imu': (IMU, 40, True), '/cmd': ('std_msgs/msg/Float64MultiArray', 10, False)}
        assert (bag.start_ns, bag.end_ns) == (START + 1_000_000, START + 196_000_000)
        got = [(m.topic, m.log_ns, bytes(m.raw)) for m in bag.messages()]
        assert got == written(sent)
        assert [m.topic for m in bag.messages(['/cmd'])] == ['/cmd'] * 10
        assert sum(1 for _ in bag.messages('/cmd')) == 10
        assert {m.publish_ns - m.log_ns for m in bag.messages()} == {0}
        assert bag.notes == ()


@pytest.mark.parametrize('container', [*list(CONTAINERS)[::4], *slow(*(
    name for k, name in enumerate(CONTAINERS) if k % 4))])
def test_every_container_keeps_the_order_of_log_times(tmp_path, container):
    sent = flight(300)
    rng = np.random.default_rng(4)
    order = np.argsort(np.arange(len(sent)) + rng.uniform(0, 60, len(sent)))  # chunks overlap
    path = CONTAINERS[container](tmp_path, [sent[i] for i in order])
    got = rows(path)
    assert [log_ns for _, log_ns, _ in got] == sorted(s.log_ns for s in sent)
    assert Counter(got) == Counter(written(sent))


@pytest.mark.parametrize('compression', ['none', 'lz4', 'bz2'])
def test_ros1(tmp_path, compression):
    path = write_ros1(tmp_path / 'b.bag', flight_ros1(), compression)
    with open_bag(path) as bag:
        assert bag.notes == ()
        topic = bag.topics['/imu']
        assert (topic.type, topic.count, topic.has_header) == (IMU, 40, True)
        assert (bag.start_ns, bag.end_ns) == (START + 1_000_000, START + 196_000_000)
        extract = bag.extractor('/imu', [parse_field('angular_velocity.x')])
        got = [(m.log_ns, *extract(m.raw)) for m in bag.messages()]
    assert got == [(s.log_ns, s.log_ns - 1_000_000, (0.01 * k,))
                   for k, s in enumerate(flight_ros1())]


def test_publish_times_are_kept(tmp_path):
    sent = [Sent('/cmd', 'std_msgs/msg/Float64MultiArray', 1000 + k, array(k), 900 + k)
            for k in range(5)]
    with open_bag(write_mcap(tmp_path / 'b.mcap', sent)) as bag:
        assert [(m.log_ns, m.publish_ns) for m in bag.messages()] == [
            (1000 + k, 900 + k) for k in range(5)]


# ---- several files

def split(sent: list[Sent], count: int) -> list[list[Sent]]:
    size = math.ceil(len(sent) / count)
    return [sent[i:i + size] for i in range(0, len(sent), size)]


@pytest.mark.parametrize('named', ['folder', 'files', 'files backwards'])
def test_split_bags_are_merged_by_time(tmp_path, named):
    sent = flight(100)
    files = [write_mcap(tmp_path / f'b_{k}.mcap', part) for k, part in enumerate(split(sent, 4))]
    path = {'folder': tmp_path, 'files': files, 'files backwards': files[::-1]}[named]
    assert rows(path) == written(sent)
    with open_bag(path) as bag:
        assert bag.topics['/imu'].count == 100


def test_files_that_overlap_in_time_are_merged(tmp_path):
    sent = flight(100)
    imu_file = write_mcap(tmp_path / 'imu.mcap', [s for s in sent if s.topic == '/imu'])
    folder = write_rosbag2(tmp_path / 'cmd', [s for s in sent if s.topic == '/cmd'], 'sqlite3')
    got = rows([imu_file, folder])
    assert [log_ns for _, log_ns, _ in got] == sorted(s.log_ns for s in sent)
    assert Counter(got) == Counter(written(sent))


def test_a_file_named_twice_is_read_once(tmp_path):
    folder = write_rosbag2(tmp_path / 'b', flight())
    assert len(rows([folder, next(folder.glob('*.mcap'))])) == 50


def test_unpacked_beside_packed_is_read_once(tmp_path):
    folder = write_rosbag2(tmp_path / 'b', flight(), compression='file')
    (packed,) = folder.glob('*.zstd')
    packed.with_suffix('').write_bytes(zstandard.ZstdDecompressor().decompressobj().decompress(
        packed.read_bytes()))
    assert rows(folder) == written(flight())
    assert notes(folder) == ''


def test_files_that_metadata_forgets_are_read_and_noted(tmp_path):
    first, second = split(flight(), 2)
    folder = write_rosbag2(tmp_path / 'b', first)
    write_mcap(folder / 'more.mcap', second)
    assert rows(folder) == written(flight())
    assert 'does not list them: more.mcap' in notes(folder)
    assert 'states' not in notes(folder)


def test_files_that_are_gone_are_noted(tmp_path):
    folder = edit_metadata(write_rosbag2(tmp_path / 'b', flight()),
                           lambda m: m['relative_file_paths'].append('b_1.mcap'))
    assert rows(folder) == written(flight())
    assert 'not there: b_1.mcap' in notes(folder)


def test_an_unusable_file_of_a_folder_is_noted(tmp_path):
    write_mcap(tmp_path / 'b_0.mcap', flight())
    (tmp_path / 'b_1.mcap').touch()  # the recorder had just begun it
    assert rows(tmp_path) == written(flight())
    assert 'b_1.mcap is empty' in notes(tmp_path)


def spoil_qos(metadata):
    for topic in metadata['topics_with_message_count']:
        topic['topic_metadata']['offered_qos_profiles'] = [{
            'history': 'keep_all', 'depth': 7, 'reliability': 'best_effort',
            'durability': 'volatile', 'deadline': {'sec': 0, 'nsec': 0},
            'lifespan': {'sec': 0, 'nsec': 0}, 'liveliness': 'automatic',
            'liveliness_lease_duration': {'sec': 0, 'nsec': 0},
            'avoid_ros_namespace_conventions': False}]


def spoil_hash(metadata):
    topic = metadata['topics_with_message_count'][0]['topic_metadata']
    topic['type_description_hash'] = 'RIHS01_0'


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('change', [
    spoil_qos, spoil_hash, lambda m: m.update(version=10), lambda m: m.update(duration=None)])
def test_metadata_loses_nothing(tmp_path, storage, change):
    folder = edit_metadata(write_rosbag2(tmp_path / 'b', flight(), storage), change)
    assert rows(folder) == written(flight())
    assert notes(folder) == ''


@pytest.mark.parametrize('text', ['', 'a: [', 'rosbag2_bagfile_information: 3', '\0', 'x: y'])
def test_broken_metadata_is_noted(tmp_path, text):
    folder = write_rosbag2(tmp_path / 'b', flight())
    (folder / 'metadata.yaml').write_text(text)
    assert rows(folder) == written(flight())
    assert 'metadata.yaml is not usable' in notes(folder)


@pytest.mark.parametrize('stated', [0, 7, 51])
def test_wrong_counts_of_metadata_are_noted(tmp_path, stated):
    folder = edit_metadata(write_rosbag2(tmp_path / 'b', flight()),
                           lambda m: m.update(message_count=stated))
    assert len(rows(folder)) == 50
    assert f'states {stated} messages, 50 are there' in notes(folder)


# ---- definitions

def test_custom_types_are_known_from_the_bag(tmp_path):
    sent = [Sent('/s', 'my_msgs/msg/Sample', k, make('my_msgs/msg/Sample', value=k + 0.5,
                                                     note='n' * k)) for k in range(5)]
    for path in (write_mcap(tmp_path / 'b.mcap', sent),
                 write_rosbag2(tmp_path / 'b', sent, 'sqlite3')):
        assert numbers(path, '/s', 'value', 'triple[1]') == [(k + 0.5, 0.0) for k in range(5)]


def test_the_definition_in_the_bag_wins(tmp_path):
    raw = b'\0\1\0\0' + np.array([1.0, 2.0]).tobytes()
    path = write_mcap(tmp_path / 'b.mcap', [Sent('/imu', IMU, 5, raw)],
                      schema=('ros2msg', b'float64 gyro\nfloat64 angular_velocity\n'))
    assert numbers(path, '/imu', 'angular_velocity', 'gyro') == [(2.0, 1.0)]
    with open_bag(path) as bag:
        assert not bag.topics['/imu'].has_header


IDL = """// generated
#include "std_msgs/msg/Header.idl"
module px_msgs { module msg {
  typedef float float__4[4];
  module Status_Constants { const uint8 ARMED = 2; };
  struct Status {
    std_msgs::msg::Header header;
    @verbatim (language="comment", text="attitude")
    float__4 q;
    sequence<double> gains;
    boolean armed;
  };
}; };
"""
HEADER_IDL = """module std_msgs { module msg { struct Header {
  builtin_interfaces::msg::Time stamp; string frame_id; }; }; };"""


@pytest.mark.parametrize('several', [False, True])
def test_definitions_in_idl(tmp_path, several):
    bar = '=' * 80 + '\n'
    text = (f'{bar}IDL: px_msgs/msg/Status\n{IDL}{bar}IDL: std_msgs/msg/Header\n{HEADER_IDL}'
            if several else IDL)
    raw = (b'\0\1\0\0' + np.array([3, 7, 2], np.uint32).tobytes() + b'f\0\0\0'
           + np.array([1, 2, 3, 4], np.float32).tobytes() + np.uint32(1).tobytes()
           + bytes(4) + np.array([0.25]).tobytes() + b'\1')
    path = write_mcap(tmp_path / 'b.mcap', [Sent('/p', 'px_msgs/msg/Status', 5, raw)],
                      schema=('ros2idl', text.encode()))
    with open_bag(path) as bag:
        assert bag.topics['/p'].type == 'px_msgs/msg/Status'
        extract = bag.extractor('/p', [parse_field(t) for t in ('q[3]', 'gains[0]', 'armed')])
        got = [extract(m.raw) for m in bag.messages()]
    assert got == [(3_000_000_007, (4.0, 0.25, 1.0))]


def test_without_definition_jazzy_stands_in(tmp_path):
    path = write_mcap(tmp_path / 'b.mcap', flight(), schema=('', b''))
    assert numbers(path, '/imu', 'angular_velocity.x') == [(0.01 * k,) for k in range(40)]


@pytest.mark.parametrize(('schema', 'said'), [
    (('', b''), 'neither in the bag nor known'),
    (('ros2msg', b'float64 x\n???\n'), 'cannot be parsed'),
    (('ros2idl', b'struct {'), 'cannot be parsed'),
    (('ros2msg', b'my_msgs/Sample again\n'), 'contains itself'),
    (('protobuf', b'\1\2'), "written in 'protobuf'")])
def test_unknown_types_are_noted(tmp_path, schema, said):
    sent = [Sent('/s', 'my_msgs/msg/Sample', 5, make('my_msgs/msg/Sample'))]
    path = write_mcap(tmp_path / 'b.mcap', sent, schema=schema)
    with open_bag(path) as bag:
        assert said in bag.topics['/s'].problem
        assert '/s (my_msgs/msg/Sample) cannot be decoded' in bag.notes[0]
        assert len(list(bag.messages(['/s']))) == 1
        with pytest.raises(BagError, match=said):
            bag.extractor('/s', [])
        with pytest.raises(BagError, match=said):
            bag.scalar_fields('/s')


def test_other_encodings_are_noted(tmp_path):
    raw = json.dumps({'x': 1}).encode()
    path = write_mcap(tmp_path / 'b.mcap', [Sent('/j', 'std_msgs/msg/Empty', 5, raw)],
                      schema=('jsonschema', b'{}'), encoding='json')
    with open_bag(path) as bag, pytest.raises(BagError, match="encoded as 'json'"):
        bag.extractor('/j', [])


def test_files_with_other_definitions_of_a_topic_are_noted(tmp_path):
    sent = flight(40)
    write_mcap(tmp_path / 'a.mcap', [s for s in sent if s.topic == '/imu'])
    raw = b'\0\1\0\0' + np.array([1.0]).tobytes()
    write_mcap(tmp_path / 'b.mcap', [Sent('/imu', IMU, START, raw)],
               schema=('ros2msg', b'float64 gyro\n'))
    assert len(numbers(tmp_path, '/imu', 'angular_velocity.x')) == 40
    assert 'topic /imu: 1 messages of another definition' in notes(tmp_path)


def test_comments_do_not_make_another_definition(tmp_path):
    sent = [s for s in flight(40) if s.topic == '/imu']
    text = STORE.generate_msgdef(IMU, ros_version=2)[0]
    write_mcap(tmp_path / 'a.mcap', sent[:20])
    write_mcap(tmp_path / 'b.mcap', sent[20:], schema=('ros2msg', b'# new\n' + text.encode()))
    assert len(numbers(tmp_path, '/imu', 'angular_velocity.x')) == 40
    assert notes(tmp_path) == ''


# ---- SQLite

def old_schema(file: Path) -> None:
    """Make a bag of Foxy: no definitions, no schema version, no hash."""
    database = sqlite3.connect(file)
    database.executescript("""
        DROP TABLE message_definitions; DROP TABLE schema; DROP TABLE metadata;
        ALTER TABLE topics DROP COLUMN type_description_hash;
        ALTER TABLE topics DROP COLUMN offered_qos_profiles;
        DROP INDEX timestamp_idx""")
    database.close()


def test_old_sqlite_schema(tmp_path):
    path = bare(write_rosbag2(tmp_path / 'b', flight(), 'sqlite3'), '.db3')
    old_schema(path)
    assert rows(path) == written(flight())
    assert numbers(path, '/imu', 'angular_velocity.x') == [(0.01 * k,) for k in range(40)]


def test_definitions_may_be_missing_from_a_new_sqlite_schema(tmp_path):
    path = bare(write_rosbag2(tmp_path / 'b', flight(), 'sqlite3'), '.db3')
    database = sqlite3.connect(path)
    database.execute('DROP TABLE message_definitions')
    database.close()
    assert rows(path) == written(flight())


def test_write_ahead_log_of_a_crashed_recorder_is_read(tmp_path):
    source = bare(write_rosbag2(tmp_path / 'b', flight(20), 'sqlite3'), '.db3')
    database = sqlite3.connect(source)
    database.execute('PRAGMA journal_mode=WAL')
    for one in flight(40)[25:]:
        database.execute('INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)', (
            {'/imu': 1, '/cmd': 2}[one.topic], one.log_ns,
            bytes(STORE.serialize_cdr(one.message, one.type))))
    database.commit()
    crashed = tmp_path / 'crashed'
    crashed.mkdir()
    for suffix in ('', '-wal'):
        shutil.copy(f'{source}{suffix}', crashed / f'b.db3{suffix}')
    database.close()
    assert (crashed / 'b.db3-wal').stat().st_size
    assert rows(crashed) == written(flight(40))


def test_reading_leaves_no_trace_beside_the_bag(tmp_path):
    path = bare(write_rosbag2(tmp_path / 'b', flight(), 'sqlite3'), '.db3')
    database = sqlite3.connect(path)
    database.execute('PRAGMA journal_mode=WAL')  # stays written in the file
    database.close()
    before = sorted(os.listdir(tmp_path)), path.read_bytes()
    assert len(rows(path)) == 50
    assert (sorted(os.listdir(tmp_path)), path.read_bytes()) == before


# ---- the rest of Bag

def test_bind_and_scalar_fields(tmp_path):
    sent = [Sent('/j', 'sensor_msgs/msg/JointState', k, joints(k, range(k))) for k in range(3)]
    sent.append(Sent('/e', 'sensor_msgs/msg/JointState', 9, joints(9, [])))
    with open_bag(write_mcap(tmp_path / 'b.mcap', sent)) as bag:
        assert str(bag.bind('/j', parse_field('effort[:]'))) == 'effort[0:1]'
        assert str(bag.bind('/j', parse_field('effort[7]'))) == 'effort[7]'
        with pytest.raises(BagError, match='length of `effort.:.` is not known.*0 elements'):
            bag.bind('/e', parse_field('effort[:]'))
        assert bag.scalar_fields('/j') == []  # its first message is empty
    with open_bag(write_mcap(tmp_path / 'c.mcap', flight())) as bag:
        assert [str(field) for field in bag.scalar_fields('/cmd')] == [
            'layout.data_offset', *(f'data[{i}]' for i in range(3))]
        assert len(bag.scalar_fields('/imu', most=3)) == 9


def test_a_bag_without_messages(tmp_path):
    for path in (write_mcap(tmp_path / 'b.mcap', []), write_rosbag2(tmp_path / 'b', []),
                 write_rosbag2(tmp_path / 'c', [], 'sqlite3')):
        with open_bag(path) as bag:
            assert list(bag.messages()) == []
            assert (bag.start_ns, bag.end_ns) == (0, 0)
            assert bag.notes == ('there is no message in the bag',)


def test_temporary_files_are_removed(tmp_path, monkeypatch):
    scratch = tmp_path / 'scratch'
    scratch.mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(scratch))
    path = write_rosbag2(tmp_path / 'b', flight(), compression='file')
    with open_bag(path) as bag:
        assert list(scratch.iterdir())
        assert len(list(bag.messages())) == 50
    assert not list(scratch.iterdir())
    (path / 'b.mcap.zstd').write_bytes(zstandard.compress(b'nothing'))
    with pytest.raises(BagError):
        open_bag(path)
    assert not list(scratch.iterdir())


def test_a_file_that_vanishes_is_a_bag_error(tmp_path):
    path = write_mcap(tmp_path / 'b.mcap', flight())
    with open_bag(path) as bag:
        path.unlink()
        with pytest.raises(BagError, match='reading stopped'):
            list(bag.messages())


def test_many_files_do_not_stay_open(tmp_path):
    sent = flight(600)
    for k, part in enumerate(split(sent, 300)):
        write_mcap(tmp_path / f'b_{k:03}.mcap', part)
    before = len(os.listdir('/proc/self/fd'))
    with open_bag(tmp_path) as bag:
        most = max(len(os.listdir('/proc/self/fd')) for _ in bag.messages())
    assert most <= before + 5


def test_real_flight(data_folder):
    path = data_folder / 'cubs2' / 'cub_stabilize_2025_11_13.mcap'
    if not path.exists():
        pytest.skip(f'{path} is not here')
    with open_bag(path) as bag:
        pose, stick = bag.topics['/cub1/pose'], bag.topics['/cub1/joy_serial_status']
        assert (pose.type, pose.has_header) == ('geometry_msgs/msg/PoseStamped', True)
        assert (stick.type, stick.has_header) == ('std_msgs/msg/UInt16MultiArray', False)
        assert bag.notes == ()
        assert (bag.end_ns - bag.start_ns) * 1e-9 == pytest.approx(198, abs=1)
    roll = np.degrees(numbers(path, '/cub1/pose', 'euler(pose.orientation).roll'))
    assert len(roll) == pose.count
    assert np.mean(roll) == pytest.approx(15.5, abs=0.1)
    assert np.std(roll) == pytest.approx(12.1, abs=0.1)
    pwm = np.array(numbers(path, '/cub1/joy_serial_status', 'data[:]'))
    assert pwm.shape == (stick.count, 5)
    assert np.ptp(pwm[:, 4]) == 0
    assert pwm[:, :4].min() >= 900
    assert pwm[:, :4].max() <= 2100


def test_what_the_fixtures_write_comes_back(tmp_path):
    sent = [Sent('/imu', IMU, 7, imu(5, 0.5))]
    with open_bag(write_mcap(tmp_path / 'b.mcap', sent)) as bag:
        extract = bag.extractor('/imu', [parse_field('angular_velocity.x')])
        assert [extract(m.raw) for m in bag.messages()] == [(5, (0.5,))]


def test_why_messages_cannot_be_decoded_is_said(tmp_path, capsys):
    sent = [replace(s, message=bytes((0, 9)) + bytes(STORE.serialize_cdr(s.message, s.type))[2:])
            for s in flight(60)]
    path = write_mcap(tmp_path / 'a.mcap', sent)
    assert main(['info', str(path)]) == 0
    assert ' '.join(capsys.readouterr().out.split()).count('DELIMITED_CDR2 of XCDR2') == 2
    config = Config((Channel('u', 'input', '/cmd', '', 'data[0]'),
                     Channel('y', 'output', '/imu', '', 'angular_velocity.x')))
    with open_bag(path) as bag, pytest.raises(BagError, match='`y`: messages that .* 00 09'):
        read_record(bag, config)
