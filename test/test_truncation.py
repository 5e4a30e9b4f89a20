# SPDX-License-Identifier: Apache-2.0
"""Recordings of every format cut off anywhere: each complete message is read, and it is said."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
import sqlite3
import struct

from bag_fixtures import bare, flight, numbers, rows, write_rosbag2, written
from marks import slow
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mutations import FORMATS
import numpy as np
import pytest
from recording_files import write_csv

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag

LIBRARIES = {'ULog': 'pyulog', 'ArduPilot': 'pymavlink', 'Parquet': 'pyarrow'}
CUTS = [25, *slow(200)]


def cuts(data: bytes, count: int) -> Iterator[int]:
    rng = np.random.default_rng(3)
    yield from sorted(rng.integers(1, len(data), count).tolist())


def in_mcap(data: bytes) -> int:
    """Return how many messages the reader of the mcap library gives before it fails."""
    count = 0
    try:
        for record in StreamReader(BytesIO(data)).records:
            count += isinstance(record, Message)
    except (McapError, struct.error, ValueError):
        pass
    return count


def in_ros1(data: bytes) -> int:
    """Return how many messages lie in complete records, by a visit of all of them."""
    count, position = 0, 13
    while position + 8 <= len(data):
        head = int.from_bytes(data[position:position + 4], 'little')
        fields = data[position + 4:position + 4 + head]
        size = int.from_bytes(data[position + 4 + head:position + 8 + head], 'little')
        end = position + 8 + head + size
        if b'op=\5' in fields and b'compression=none' in fields:
            count += in_ros1(bytes(13) + data[position + 8 + head:end])
        count += b'op=\2' in fields and end <= len(data)
        position = end
    return count


def ulog_ends(data: bytes) -> dict[int, bool]:
    """Return where messages end, and whether they hold data."""
    ends, position = {}, 16
    while position < len(data):
        size, kind = struct.unpack_from('<HB', data, position)
        position += 3 + size
        ends[position] = kind == ord('D')
    return ends


def ardupilot_ends(data: bytes) -> dict[int, bool]:
    """Return where messages end, by the sizes of formats, and whether they hold numbers."""
    ends, position, sizes = {}, 0, {0x80: 89}
    while position < len(data):
        kind = data[position + 2]
        if kind == 0x80:
            sizes[data[position + 3]] = data[position + 4]
        position += sizes[kind]
        ends[position] = kind in (2, 3)
    return ends


# Neither has a record that says that it ends here.
ENDS = {'ULog': ulog_ends, 'ArduPilot': ardupilot_ends}
COUNTED = {'mcap, zstd': in_mcap, 'mcap, lz4': in_mcap, 'mcap, no chunks': in_mcap,
           'ROS 1, none': in_ros1}


@pytest.mark.parametrize('count', CUTS)
@pytest.mark.parametrize('kind', [*COUNTED, *ENDS])
def test_every_complete_message_of_a_file_that_is_cut_off(tmp_path, kind, count):
    if kind in LIBRARIES:
        pytest.importorskip(LIBRARIES[kind])
    path = FORMATS[kind](tmp_path)
    data, sound = path.read_bytes(), rows(path)
    ends = ENDS[kind](data) if kind in ENDS else {}
    recovered = []
    for size in cuts(data, count):
        path.write_bytes(data[:size])
        there = sum(own for end, own in ends.items() if end <= size) if ends else \
            COUNTED[kind](data[:size])
        try:
            with open_bag(path) as bag:
                got = [(m.topic, m.log_ns, bytes(m.raw)) for m in bag.messages()]
                said = '\n'.join(bag.notes)
        except BagError as error:
            assert str(path) in str(error)
            assert there == 0, size
            continue
        assert len(got) >= there, size
        assert set(got) <= set(sound)
        assert len(set(got)) == len(got)
        assert size in ends or f'truncated: {len(got)} messages recovered' in said, size
        recovered.append(len(got))
    assert max(recovered) > 0.8 * len(sound)


@pytest.mark.slow
@pytest.mark.parametrize('count', CUTS)
@pytest.mark.parametrize('page', [512, *slow(4096)])
def test_every_complete_message_of_a_database_that_is_cut_off(tmp_path, page, count):
    """Also where the pages that lead to them were written later, and are lost."""
    sent = flight(500)
    path = bare(write_rosbag2(tmp_path / 'a', sent, 'sqlite3'), '.db3')
    database = sqlite3.connect(path, isolation_level=None)
    database.execute(f'PRAGMA page_size = {page}')
    database.execute(f"VACUUM INTO '{tmp_path / 'b.db3'}'")
    database.close()
    path = tmp_path / 'b.db3'
    data, sound = path.read_bytes(), written(sent)
    assert rows(path) == sound
    recovered = []
    for size in cuts(data, count):
        path.write_bytes(data[:size])
        whole = data[:size // page * page]
        there = [row for row in sound if row[2] in whole]
        try:
            with open_bag(path) as bag:
                got = [(m.topic, m.log_ns, bytes(m.raw)) for m in bag.messages()]
                assert f'truncated: {len(got)} messages recovered' in bag.notes[0]
        except BagError as error:
            assert 'no message can be recovered' in str(error)
            assert not there, size
            continue
        found = set(got)
        assert set(there) <= found, size
        assert got == [row for row in sound if row in found]
        recovered.append(len(got) / len(sound))
    assert len(set(recovered)) > min(count, len(data) // page) / 2     # each page has several
    assert max(recovered) > 0.8


@pytest.mark.parametrize('count', CUTS)
@pytest.mark.parametrize('form', ['{:.6f}', '{!r}'], ids=['digits', 'as short as can be'])
def test_rows_of_a_table_that_is_cut_off(tmp_path, form, count):
    """A number without its last digits, or its exponent, is another one."""
    rng = np.random.default_rng(1)
    values = [float(v) for v in 10.0 ** rng.integers(-7, 3, 100) * rng.standard_normal(100)]
    path = write_csv(tmp_path / 'a.csv', {
        't': [f'{0.1 * i:.1f}' for i in range(100)], 'u': values,
        'y': [form.format(v) for v in values]})
    data, sound = path.read_bytes(), numbers(path, 'a', 'y')
    for size in cuts(data, count):
        path.write_bytes(data[:size])
        lines = data[:size].count(b'\n')
        if lines < 4:
            continue
        with open_bag(path) as bag:
            found, said = bag.topics['a'].count, '\n'.join(bag.notes)
        assert found >= lines - 1
        np.testing.assert_allclose(numbers(path, 'a', 'y'), sound[:found], rtol=1e-5)
        assert found == lines or data[size - 1:size] == b'\n' or 'left out' in said, size


@pytest.mark.parametrize('count', CUTS)
def test_a_parquet_file_that_is_cut_off_is_refused_with_the_reason(tmp_path, count):
    pytest.importorskip('pyarrow')
    path = FORMATS['Parquet'](tmp_path)
    data = path.read_bytes()
    for size in cuts(data, count):
        path.write_bytes(data[:size])
        with pytest.raises(BagError, match='cut off|not a bag|empty'):
            open_bag(path)
