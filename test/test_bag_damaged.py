# SPDX-License-Identifier: Apache-2.0
"""Damaged bags: what is complete is read, nothing false is, and it is said."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from io import BytesIO
import sqlite3
import struct
import subprocess
import sys

from bag_fixtures import (
    STORE,
    Sent,
    bare,
    flight,
    flight_ros1,
    make,
    notes,
    rows,
    write_mcap,
    write_ros1,
    write_rosbag2,
    written,
)
from marks import slow
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
import numpy as np
import pytest

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag


def whole_records(data: bytes) -> list[int]:
    """Return the log times of all complete messages, those of a chunk cut off as well."""
    times, position = [], 0
    while position + 9 <= len(data):
        opcode, end = data[position], position + 9 + int.from_bytes(
            data[position + 1:position + 9], 'little')
        if opcode == 6 and position + 49 <= len(data):
            name = int.from_bytes(data[position + 37:position + 41], 'little')
            times += whole_records(data[position + 49 + name:end])
        elif opcode == 5 and end <= len(data):
            times.append(int.from_bytes(data[position + 15:position + 23], 'little'))
        position = end
    return times


def rival(data: bytes) -> list[int]:
    """Return the log times that the mcap library's stream reader gives before it fails."""
    times: list[int] = []
    try:
        for record in StreamReader(BytesIO(data)).records:
            if isinstance(record, Message):
                times.append(record.log_time)
    except (McapError, struct.error, ValueError):
        pass  # it fails in many ways at the end of a file
    return times


@pytest.mark.parametrize('compression', ['zstd', *slow('none', 'lz4')])
@pytest.mark.parametrize('chunks', [True, False], ids=['chunks', 'no chunks'])
def test_cut_off_mcap_gives_what_is_complete(tmp_path, compression, chunks):
    sent = flight(60)
    data = write_mcap(tmp_path / 'whole.mcap', sent, compression,
                      use_chunking=chunks).read_bytes()
    path = tmp_path / 'cut.mcap'
    recovered = []
    for size in [*range(200, len(data), 397), len(data) - 8, len(data) - 20, len(data) - 40]:
        path.write_bytes(data[:size])
        there = sorted(rival(data[:size]))
        if compression == 'none' or not chunks:
            assert len(there) <= len(more := sorted(whole_records(data[8:size])))
            there = more
        try:
            bag = open_bag(path)
        except BagError as error:
            assert 'cut off or damaged' in str(error)
            assert not there
            continue
        with bag:
            if compression != 'none' and chunks:  # some of the last chunk's messages, in order
                got = [m.log_ns for m in bag.messages()]
                assert got[:len(there)] == there
                assert set(got) <= {s.log_ns for s in sent}
                there = got
            if size < len(data) - 8:
                assert f'truncated: {len(there)} messages recovered' in bag.notes[0]
            assert sum(t.count for t in bag.topics.values()) == len(there)
            assert [m.log_ns for m in bag.messages()] == there
            assert bag.end_ns == there[-1]
        recovered.append(len(there))
    assert recovered[-1] == len(sent)
    assert len(set(recovered)) > 5


@pytest.mark.parametrize('compression', ['none', 'lz4', 'zstd'])
def test_the_whole_records_of_a_chunk_that_is_cut_off_are_recovered(tmp_path, compression):
    sent = flight(2000)
    path = write_mcap(tmp_path / 'b.mcap', sent, compression, chunk_size=1 << 22)
    data = path.read_bytes()
    start, end = chunk_at(data, 0)
    path.write_bytes(data[:start + 3 * (end - start) // 4])
    got, real = rows(path), written(sent)
    assert got == real[:len(got)]
    assert len(got) > 0.4 * len(sent)
    assert f'truncated: {len(got)} messages recovered' in notes(path)


@pytest.mark.parametrize('options', [
    {}, *slow({'compression': 'lz4'}), {'enable_crcs': False}, *slow({'use_chunking': False})],
    ids=['CRC', 'lz4', 'no CRC', 'no chunks'])
def test_mcap_that_ends_in_zeros_gives_nothing_false(tmp_path, options):
    """The disk was full or the power failed: the file has its size, but not its data."""
    sent = flight(60)
    options = {'compression': 'none', **options}
    data = write_mcap(tmp_path / 'whole.mcap', sent, **options).read_bytes()
    path = tmp_path / 'cut.mcap'
    real = written(sent)
    recovered = 0
    for size in range(200, len(data) - 2500, len(data) // 30):
        path.write_bytes(data[:size] + bytes(len(data) - size))
        try:
            got = rows(path)
        except BagError:
            got = []
        assert got == real[:len(got)]
        assert len(got) >= len(rival(data[:size])) - 1
        assert not got or 'truncated' in notes(path)
        recovered = max(recovered, len(got))
    assert recovered > 45


def test_zeros_from_within_the_head_of_a_chunk(tmp_path):
    path = write_mcap(tmp_path / 'b.mcap', flight(60), 'lz4')
    data = path.read_bytes()
    start, _ = chunk_at(data, 3)
    name = start - 8 - len('lz4')
    path.write_bytes(data[:name] + bytes(len(data) - name))
    assert sorted(rival(data[:name])) == [log_ns for _, log_ns, _ in rows(path)] != []


def chunk_at(data: bytes, number: int) -> tuple[int, int]:
    """Return start and end of the content of a chunk."""
    position = 8
    while True:
        opcode, length = data[position], int.from_bytes(data[position + 1:position + 9], 'little')
        if opcode == 6:
            number -= 1
            if number < 0:
                name = int.from_bytes(data[position + 37:position + 41], 'little')
                return position + 49 + name, position + 9 + length
        position += 9 + length


@pytest.mark.parametrize('compression', ['none', 'lz4', 'zstd'])
def test_damaged_chunk_is_skipped_and_noted(tmp_path, compression):
    sent = flight(60)
    path = write_mcap(tmp_path / 'b.mcap', sent, compression)
    whole = rows(path)
    data = bytearray(path.read_bytes())
    start, end = chunk_at(data, 2)
    data[(start + end) // 2] ^= 0xff
    path.write_bytes(data)
    with open_bag(path) as bag:
        got = [(m.topic, m.log_ns, bytes(m.raw)) for m in bag.messages()]
        lost = len(whole) - len(got)
        assert 0 < lost < 20
        assert f'damaged chunk at byte {start} skipped ({lost} messages lost)' in bag.notes[0]
        assert list(bag.messages()) != []
        assert len(bag.notes) == 1
    first = next(i for i, row in enumerate(got) if row != whole[i])
    assert got == whole[:first] + whole[first + lost:]


def test_damage_without_crc_ends_the_chunk(tmp_path):
    path = write_mcap(tmp_path / 'b.mcap', flight(60), 'none', enable_crcs=False)
    data = bytearray(path.read_bytes())
    start, end = chunk_at(data, 1)
    data[start + 1:start + 9] = b'\xff' * 8  # length of its first record
    path.write_bytes(data)
    assert 40 < len(rows(path)) < 75
    assert f'chunk at byte {start} is damaged inside' in notes(path)


def test_chunks_of_other_topics_are_not_touched(tmp_path):
    sent = flight(20)
    picture = make('sensor_msgs/msg/Image', data=np.zeros(4000, np.uint8))
    sent[10:10] = [Sent('/camera', 'sensor_msgs/msg/Image', sent[10].log_ns, picture)
                   for _ in range(5)]
    path = write_mcap(tmp_path / 'b.mcap', sent, 'none')
    data = path.read_bytes()
    at = data.index(bytes(3000))
    path.write_bytes(data[:at] + b'\1' + data[at + 1:])  # spoils the CRC of its chunk
    with open_bag(path) as bag:
        assert len(list(bag.messages(['/cmd']))) == 5
        touched = bool(bag.notes)
        list(bag.messages(['/camera']))
        assert bag.notes
    assert not touched


@pytest.mark.parametrize('crc', [True, False], ids=['CRC', 'no CRC'])
def test_false_statistics_are_noted(tmp_path, crc):
    path = write_mcap(tmp_path / 'b.mcap', flight(), 'none', enable_crcs=crc)
    data = path.read_bytes()
    at = data.rindex((50).to_bytes(8, 'little'))
    path.write_bytes(data[:at] + bytes(8) + data[at + 8:])
    assert rows(path) == written(flight())
    assert ('its summary is damaged' if crc else
            'statistics state 0 messages, 50 are there') in notes(path)
    assert ('no checksums' in notes(path)) != crc


@pytest.mark.parametrize('crc', [True, False], ids=['CRC', 'no CRC'])
def test_copies_of_definitions_inside_chunks_win(tmp_path, crc):
    """A channel renamed by damage in the summary keeps its name."""
    path = write_mcap(tmp_path / 'b.mcap', flight(), 'zstd', enable_crcs=crc)
    data = path.read_bytes()
    at = data.rindex(b'/imu')
    path.write_bytes(data[:at] + b'/abc' + data[at + 4:])
    assert rows(path) == written(flight())
    assert ('its summary is damaged' in notes(path)) == crc


@pytest.mark.parametrize('spoilt', [True, *slow(False)])
def test_checksums_are_compared_with_and_without_isal(tmp_path, spoilt):
    path = write_mcap(tmp_path / 'b.mcap', flight(), 'none')
    if spoilt:
        data = bytearray(path.read_bytes())
        data[chunk_at(data, 1)[0] + 100] ^= 1
        path.write_bytes(data)
    found = [subprocess.run([sys.executable, '-c', f"""
import sys
if {hidden}:
    sys.modules['isal'] = None
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.mcap_chunks import sums
with open_bag({str(path)!r}) as bag:
    print(sum(1 for _ in bag.messages()), 'CRC does not match' in ''.join(bag.notes))
assert sums.__name__ == 'zlib' or not {hidden}
"""], check=True, capture_output=True, text=True).stdout.split() for hidden in (True, False)]
    assert found[0] == found[1]
    assert found[0][1] == str(spoilt)
    assert (int(found[0][0]) < 50) == spoilt


@pytest.mark.parametrize('start', [2**63, 2**64 - 1, 2**40])
def test_a_summary_that_would_begin_beyond_the_file_is_damaged(tmp_path, start):
    path = write_mcap(tmp_path / 'b.mcap', flight())
    data = path.read_bytes()
    footer = len(data) - 8 - 20  # start of the summary, of its offsets, and a checksum
    path.write_bytes(data[:footer] + start.to_bytes(8, 'little') + data[footer + 8:])
    assert rows(path) == written(flight())
    assert 'its summary is damaged' in notes(path)


@pytest.mark.parametrize('compression', ['zstd', 'lz4', 'none'])
@pytest.mark.parametrize('size', [0, 2**30, 2**62])
def test_chunks_whose_size_is_damaged_cost_no_others(tmp_path, compression, size):
    """Contents lie side by side in memory: one that claims any size takes none of the others."""
    path = write_mcap(tmp_path / 'b.mcap', flight(200), compression)
    data = bytearray(path.read_bytes())
    record = chunk_at(data, 2)[0] - 49 - len(compression.replace('none', ''))
    assert data[record] == 6
    data[record + 25:record + 33] = size.to_bytes(8, 'little')
    path.write_bytes(data)
    got, sent = rows(path), written(flight(200))
    assert all(row in sent for row in got)
    assert len(got) > 0.75 * len(sent)
    assert len(got) == len(sent) or 'damaged' in notes(path)


@pytest.mark.parametrize('crc', [True, False], ids=['CRC', 'no CRC'])
@pytest.mark.parametrize('place', [9, 17], ids=['start', 'end'])
def test_times_of_chunks_are_not_believed_blindly(tmp_path, place, crc):
    """A bag of a few seconds is not of 36 years, nor are its messages out of order."""
    sent = flight(200)
    path = write_mcap(tmp_path / 'b.mcap', sent, 'none', enable_crcs=crc)
    data = bytearray(path.read_bytes())
    start, _ = chunk_at(data, 2)
    head = start - 49
    assert data[head] == 6
    data[head + place + 7] ^= 0x10
    path.write_bytes(data)
    assert rows(path) == written(sent)
    with open_bag(path) as bag:
        assert (bag.end_ns - bag.start_ns) * 1e-9 == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(('chunks', 'byte'), [(True, 7), (False, 7), (False, 5)],
                         ids=['chunks', 'no chunks', 'by hours'])
def test_absurd_log_times_without_checksums_are_lost_and_said(tmp_path, chunks, byte):
    sent = flight(200)
    path = write_mcap(tmp_path / 'b.mcap', sent, 'none', enable_crcs=byte < 7,
                      use_chunking=chunks)
    data = path.read_bytes()
    at = data.index(2 * sent[77].log_ns.to_bytes(8, 'little'))
    path.write_bytes(data[:at + byte] + b'\x2f' + data[at + byte + 1:])
    got = rows(path)
    lost = [row for row in written(sent) if row not in got]
    assert 1 <= len(lost) <= 2
    assert 'no checksums' in notes(path)
    with open_bag(path) as bag:
        assert (bag.end_ns - bag.start_ns) * 1e-9 == pytest.approx(1.0, abs=0.01)


def test_messages_that_are_not_where_the_index_says_are_counted(tmp_path):
    """Bytes that are shifted within a chunk without checksum: the index tells."""
    sent = flight(400)
    path = write_mcap(tmp_path / 'b.mcap', sent, 'none', enable_crcs=False, chunk_size=20_000)
    data = bytearray(path.read_bytes())
    start, end = chunk_at(data, 1)
    middle = (start + end) // 2
    data[middle:end] = data[middle + 4:end] + bytes(4)
    path.write_bytes(data)
    real, got = written(sent), rows(path)
    assert all(row in real for row in got)
    lost = len(real) - len(got)
    assert 10 < lost < 60
    assert f'damaged inside: {lost} of its messages are lost' in notes(path)


def test_a_chunk_that_ends_early_is_noted(tmp_path):
    """1600 messages promised, fewer given: without a checksum, counts tell."""
    path = write_mcap(tmp_path / 'b.mcap', flight(400), 'none', enable_crcs=False,
                      chunk_size=20_000)
    data = bytearray(path.read_bytes())
    start, end = chunk_at(data, 1)
    middle = data.index(b'\5', (start + end) // 2)
    data[middle:end] = bytes(end - middle)
    path.write_bytes(data)
    lost = 500 - len(rows(path))
    assert lost > 10
    assert f'{lost} of its messages are lost; it has no checksums' in notes(path)


def test_a_message_index_that_lacks_a_channel_loses_nothing(tmp_path):
    path = write_mcap(tmp_path / 'b.mcap', flight())
    data = bytearray(path.read_bytes())
    _, at = chunk_at(data, 1)
    assert data[at] == 7  # the first message index after that chunk
    data[at] = 0x7f  # a record of unknown kind is stepped over
    path.write_bytes(data)
    assert rows(path) == written(flight())
    with open_bag(path) as bag:
        assert sum(topic.count for topic in bag.topics.values()) == 50
        assert len(list(bag.messages(['/cmd']))) == 10
        assert len(list(bag.messages(['/imu']))) == 40


def test_unknown_compression_is_an_error(tmp_path):
    path = write_mcap(tmp_path / 'b.mcap', flight(), 'zstd')
    path.write_bytes(path.read_bytes().replace(b'\4\0\0\0zstd', b'\4\0\0\0brtl'))
    with pytest.raises(BagError, match="'brtl'.*mcap compress"):
        open_bag(path)


FUZZED = {
    'mcap': lambda p: write_mcap(p / 'b.mcap', flight(60), 'lz4'),
    'mcap, no CRC': lambda p: write_mcap(p / 'b.mcap', flight(60), 'none', enable_crcs=False),
    'sqlite3': lambda p: bare(write_rosbag2(p / 'b', flight(60), 'sqlite3'), '.db3'),
    'ros1': lambda p: write_ros1(p / 'b.bag', flight_ros1(60), 'lz4'),
}


@pytest.mark.parametrize('kind', [
    'sqlite3', *slow(*(kind for kind in FUZZED if kind != 'sqlite3'))])
def test_random_damage_never_gives_anything_but_messages_or_bag_errors(tmp_path, kind):
    data = FUZZED[kind](tmp_path).read_bytes()
    rng = np.random.default_rng(6)
    path = tmp_path / 'spoilt'
    counts = []
    for _ in range(80):
        spoilt = bytearray(data)
        for at in rng.integers(0, len(data), size=3):
            spoilt[at] = rng.integers(256)
        cut = rng.integers(len(data))
        del spoilt[cut:cut + int(rng.integers(20))]
        path.write_bytes(spoilt)
        try:
            counts.append(len(rows(path)))
        except BagError:
            counts.append(0)
    assert max(counts) > 40
    assert len(set(counts)) > 2


@pytest.mark.parametrize('tail', [b'', bytes(200_000)], ids=['cut', 'zeros'])
def test_cut_off_sqlite_gives_what_is_there(tmp_path, tail):
    sent = flight(1000)
    path = bare(write_rosbag2(tmp_path / 'b', sent, 'sqlite3'), '.db3')
    data = path.read_bytes()
    share = []
    for part in (0.9, 0.5, 0.2):
        path.write_bytes(data[:int(part * len(data))] + tail)
        with open_bag(path) as bag:
            got = [(m.topic, m.log_ns, bytes(m.raw)) for m in bag.messages()]
            assert f'truncated: {len(got)} messages recovered' in bag.notes[0]
            assert sum(t.count for t in bag.topics.values()) == len(got)
        assert got == written(sent)[:len(got)]
        share.append(len(got) / len(sent))
    np.testing.assert_allclose(share, [0.9, 0.5, 0.2], atol=0.1)


def test_absurd_times_in_sqlite_are_left_out_and_said(tmp_path):
    path = bare(write_rosbag2(tmp_path / 'b', flight(100), 'sqlite3'), '.db3')
    database = sqlite3.connect(path)
    database.execute('UPDATE messages SET timestamp = timestamp + (1 << 60) WHERE id IN (7, 20)')
    database.execute("UPDATE messages SET data = 'text' WHERE id = 30")
    database.commit()
    database.close()
    assert len(rows(path)) == 125 - 3
    assert '3 messages are damaged and were left out; it has no checksums' in notes(path)
    with open_bag(path) as bag:
        assert (bag.end_ns - bag.start_ns) * 1e-9 == pytest.approx(0.495)


def test_sqlite_cut_off_beyond_use(tmp_path):
    path = bare(write_rosbag2(tmp_path / 'b', flight(100), 'sqlite3'), '.db3')
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(BagError, match='no message can be recovered'):
        open_bag(path)


def test_other_databases_are_not_bags(tmp_path):
    path = tmp_path / 'other.db3'
    database = sqlite3.connect(path)
    database.execute('CREATE TABLE customers (name)')
    database.close()
    with pytest.raises(BagError, match='not a bag: its tables are customers'):
        open_bag(path)


def test_cut_off_ros1_bag_gives_what_is_there(tmp_path):
    path = write_ros1(tmp_path / 'b.bag', flight_ros1(60), 'lz4')
    data = path.read_bytes()
    counts = []
    for part in (0.85, 0.65, 0.5):
        path.write_bytes(data[:int(part * len(data))])
        with open_bag(path) as bag:
            got = list(bag.messages())
            assert f'truncated: {len(got)} messages recovered' in bag.notes[0]
        assert [m.log_ns for m in got] == [s.log_ns for s in flight_ros1(60)][:len(got)]
        counts.append(len(got))
    assert 60 >= counts[0] > counts[1] > counts[2] > 0


def test_ros1_bag_without_index(tmp_path):
    """A `.bag.active` file: the recorder never came back to write index_pos."""
    path = write_ros1(tmp_path / 'b.bag', flight_ros1(60))
    data = path.read_bytes()
    at = data.index(b'index_pos=') + 10
    index = int.from_bytes(data[at:at + 8], 'little')
    path.write_bytes(data[:at] + bytes(8) + data[at + 8:index])
    path = path.rename(tmp_path / 'b.bag.active')
    assert [log_ns for _, log_ns, _ in rows(path)] == [s.log_ns for s in flight_ros1(60)]
    assert rows(path) == rows(tmp_path)
    assert 'truncated: 60 messages recovered' in notes(path)


@pytest.mark.parametrize(('old', 'new', 'said'), [
    (b'#ROSBAG V2.0', b'#ROSBAG V1.2', "version '1.2'"),
    (b'compression=none', b'compression=rar0', 'rar0'),
    (b'chunk_count=', b'encryptor=xx', 'encrypted')])
def test_unreadable_ros1_bags(tmp_path, old, new, said):
    path = write_ros1(tmp_path / 'b.bag', flight_ros1())
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(BagError, match=said):
        open_bag(path)


def test_ros1_bag_cut_off_beyond_use(tmp_path):
    path = write_ros1(tmp_path / 'b.bag', flight_ros1())
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(BagError, match='cut off before its first complete chunk'):
        open_bag(path)


def test_damaged_ros1_chunk_is_noted(tmp_path):
    path = write_ros1(tmp_path / 'b.bag', flight_ros1(60), 'bz2')
    data = bytearray(path.read_bytes())
    at = data.index(b'BZh', data.index(b'BZh') + 1) + 40
    data[at:at + 20] = bytes(20)
    path.write_bytes(data)
    assert 0 < len(rows(path)) < 60
    assert 'damaged chunk' in notes(path)


def ros1_chunk_at(data: bytes, number: int) -> tuple[int, int]:
    """Return where the header of a chunk begins, and its content."""
    at = -1
    for _ in range(number + 1):
        at = data.index(b'op=\x05', at + 1)
    while True:
        at -= 1
        length = int.from_bytes(data[at:at + 4], 'little')
        if 20 < length < 200 and b'compression=' in data[at + 4:at + 4 + length]:
            return at, at + 8 + length


@pytest.mark.parametrize('compression', ['none', *slow('lz4')])
def test_the_whole_records_of_a_ros1_chunk_that_is_cut_off(tmp_path, compression):
    sent = flight_ros1(3000)
    path = write_ros1(tmp_path / 'b.bag', sent, compression, threshold=1 << 20)
    data = path.read_bytes()
    path.write_bytes(data[:2 * len(data) // 3])
    got = [log_ns for _, log_ns, _ in rows(path)]
    assert got == [s.log_ns for s in sent][:len(got)]
    assert len(got) > 0.3 * len(sent)
    assert f'truncated: {len(got)} messages recovered' in notes(path)
    assert 'no checksums' in notes(path)


def test_counts_of_a_ros1_chunk_are_compared(tmp_path):
    sent = flight_ros1(60)
    path = write_ros1(tmp_path / 'b.bag', sent)
    data = bytearray(path.read_bytes())
    _, content = ros1_chunk_at(data, 2)
    at = data.index(b'op=\x02', content)
    data[at + 3] = 9  # no kind of record
    path.write_bytes(data)
    assert len(rows(path)) == 59
    assert '1 of its messages are lost; it has no checksums' in notes(path)


def test_times_in_a_ros1_index_are_not_believed_blindly(tmp_path):
    sent = flight_ros1(60)
    path = write_ros1(tmp_path / 'b.bag', sent)
    data = bytearray(path.read_bytes())
    at = data.rindex(b'end_time=') + len('end_time=')
    data[at + 3] ^= 0x40
    at = data.rindex(b'start_time=', 0, at - 300) + len('start_time=')
    data[at + 3] ^= 0x40
    path.write_bytes(data)
    with open_bag(path) as bag:
        assert (bag.end_ns - bag.start_ns) * 1e-9 == pytest.approx(0.295, abs=0.01)
        assert [m.log_ns for m in bag.messages()] == [s.log_ns for s in sent]


def test_an_index_that_has_become_a_message_hides_none(tmp_path):
    """One lost and one invented: the counts agree, the index of the chunk in the summary tells."""
    sent = flight(60)
    path = write_mcap(tmp_path / 'b.mcap', sent)
    data = bytearray(path.read_bytes())
    _, at = chunk_at(data, 0)
    single = 9 + 22  # the record of an index of one message is as long as that of an empty one
    while data[at] == 7 and int.from_bytes(data[at + 1:at + 9], 'little') + 9 != single:
        at += 9 + int.from_bytes(data[at + 1:at + 9], 'little')
    assert data[at] == 7
    data[at] = 5
    path.write_bytes(data)
    assert set(written(sent)) <= set(rows(path))
    assert 'statistics state 75 messages, 76 are there' in notes(path)


def test_two_messages_of_different_centuries(tmp_path):
    """Between their times there is none of either."""
    sent = [replace(one, log_ns=one.log_ns + k * 10**18) for k, one in enumerate(flight(9)[::9])]
    path = write_mcap(tmp_path / 'b.mcap', sent, 'none', use_chunking=False)
    data = path.read_bytes()
    path.write_bytes(data[:-60])
    assert len(rows(path)) >= 1


def test_pages_of_a_row_that_go_round_in_a_circle(tmp_path):
    """Its length is false as well, so that it would never end."""
    sent = [Sent('/camera', 'sensor_msgs/msg/Image', one.log_ns, make(
        'sensor_msgs/msg/Image', data=np.full(9000, i, np.uint8)))
        for i, one in enumerate(flight(9))]
    path = bare(write_rosbag2(tmp_path / 'b', sent, 'sqlite3'), '.db3')
    data = bytearray(path.read_bytes())
    size = len(STORE.serialize_cdr(sent[0].message, sent[0].type))
    at = data.index(bytes(STORE.serialize_cdr(sent[3].message, sent[3].type))[:60])
    kind = 12 + 2 * size
    short = bytes((0x80 | kind >> 14, 0x80 | kind >> 7 & 0x7f, kind & 0x7f))
    head = data.rindex(short, 0, at)
    data[head:head + 3] = b'\xff\xff\x7e'         # a blob of a million bytes
    path.write_bytes(data[:-4096])
    got = rows(path)
    assert set(got) <= set(written(sent))
    assert 0 < len(got) < len(sent)


@pytest.mark.parametrize('kind', ['INTEGER', 'INT'])
def test_a_time_in_the_index_of_a_database_that_is_none(tmp_path, kind):
    """In the table it is sound: it is read there, or by SQLite in the order of the index."""
    sent = flight(60)
    path = bare(write_rosbag2(tmp_path / 'b', sent, 'sqlite3'), '.db3')
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.executescript("PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = "
                               f"replace(sql, 'topic_id INTEGER', 'topic_id {kind}')")
    data = bytearray(path.read_bytes())
    found = [at for at in range(4096, len(data), 4096) if data[at] == 10]    # pages of an index
    at = data.index(sent[30].log_ns.to_bytes(8, 'big'), found[0])
    assert data[at - 2] == 6
    data[at - 2] = 28                                                       # a blob of 8 bytes
    path.write_bytes(data)
    assert rows(path) == written(sent)
    said = '75 messages recovered (its index of times is damaged)' in notes(path)
    assert said == (kind == 'INT')
