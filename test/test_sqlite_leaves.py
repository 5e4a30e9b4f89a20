# SPDX-License-Identifier: Apache-2.0
"""Messages that are read out of the pages of an SQLite file are those that SQLite gives."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
import sqlite3

from marks import slow
import numpy as np
import pytest

from ctsid_ros.recordings import sqlite_pages
from ctsid_ros.recordings.packed import raw
from ctsid_ros.recordings.recording import Wanted
from ctsid_ros.recordings.sqlite_leaves import blocks, leaves_of

hypothesis = pytest.importorskip('hypothesis')
st = hypothesis.strategies

TABLE = ('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
         'timestamp INTEGER NOT NULL, data BLOB NOT NULL)')
LOOSE = TABLE.replace(' NOT NULL', '')
INDEX = 'CREATE INDEX timestamp_idx ON messages (timestamp ASC)'
MOST = 2**63 - 1
PAGES = [512, 1024, 4096, 65536]


def written(path: Path, rows, page: int = 4096, table: str = TABLE, *, index: bool = True,
            vacuum: str = 'NONE', deleted=(), again: bool = False) -> Path:
    """A database with messages, of which some were deleted later."""
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute(f'PRAGMA page_size = {page}')
        database.execute(f'PRAGMA auto_vacuum = {vacuum}')
        database.executescript('PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF')
        database.execute(table)
        if index:
            database.execute(INDEX)
        database.execute('BEGIN')
        database.executemany('INSERT OR REPLACE INTO messages VALUES (?, ?, ?, ?)', rows)
        database.executemany('DELETE FROM messages WHERE id = ?', [(i,) for i in deleted])
        database.execute('COMMIT')
        if again:
            database.execute('VACUUM')
    return path


def opened(path: Path):
    return closing(sqlite3.connect(f'{path.as_uri()}?immutable=1', uri=True))


def by_sqlite(database, topics, span=None) -> list[tuple[int, int, bytes]]:
    low, high = span or (-MOST - 1, MOST)
    return [row for row in database.execute(
        'SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY timestamp, id')
        if row[0] in topics and low <= row[1] <= high]


def by_pages(leaves, database, topics, batch=1 << 20, span=None) -> list[tuple[int, int, bytes]]:
    names = [str(topic) for topic in topics]
    wanted = Wanted({topic: i for i, topic in enumerate(topics)}, names, [raw] * len(names), span)
    got = []
    for block in blocks(leaves, database, batch, wanted):
        rows = [iter(zip(c.log_ns.tolist(), c.values, strict=True)) for c in block.columns]
        got += [(int(names[number]), *next(rows[number])) for number in block.which]
    return got


TIMES = st.one_of(st.integers(10**18, 10**18 + 20), st.integers(-MOST - 1, MOST),
                  st.sampled_from([0, 1, -1, 127, -128, 2**15, -2**23, 2**31, 2**47, -2**47]))
TOPICS = st.sampled_from([0, 1, 2, 3, -1, 200, -70000, 2**40, MOST, -MOST - 1])
IDS = st.one_of(st.integers(-5, 300), st.integers(-MOST - 1, MOST))
SIZES = st.one_of(st.integers(0, 600), st.integers(0, 9000))


@st.composite
def databases(draw):
    rows = [(number, draw(TOPICS), draw(TIMES), bytes([i % 251]) * draw(SIZES))
            for i, number in enumerate(draw(st.lists(IDS, min_size=1, max_size=60, unique=True)))]
    deleted = [row[0] for row in rows[1:] if draw(st.integers(0, 4)) == 0]
    return rows, deleted


@hypothesis.settings(max_examples=75, deadline=None,
                     suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(made=databases(), page=st.sampled_from(PAGES), index=st.booleans(),
                  vacuum=st.sampled_from(['NONE', 'FULL', 'INCREMENTAL']), again=st.booleans(),
                  batch=st.sampled_from([1, 3000, 1 << 20]), read=st.sampled_from([1, 4 << 20]),
                  span=st.none() | st.tuples(TIMES, TIMES).map(sorted))
def test_messages_are_those_of_sqlite(tmp_path, made, page, index, vacuum, again, batch, read,
                                      span):
    rows, deleted = made
    path = written(tmp_path / 'a.db3', rows, page, index=index, vacuum=vacuum, deleted=deleted,
                   again=again)
    topics = sorted({row[1] for row in rows})[::2]
    with opened(path) as database, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sqlite_pages, 'BATCH', read)
        leaves = leaves_of(path, database)
        assert leaves is not None
        assert by_pages(leaves, database, topics, batch, span) == by_sqlite(database, topics, span)
        there = by_sqlite(database, {row[1] for row in rows})
        assert leaves.counts.total() == len(there)
        assert all(leaves.counts[t] == sum(row[0] == t for row in there) for t in topics)
        assert np.min(leaves.first_ns) == there[0][1]
        assert np.max(leaves.last_ns) == there[-1][1]


@pytest.mark.parametrize('order', ['rising', 'topic after topic', 'any', 'late ones'])
@pytest.mark.parametrize('page', [512, *slow(*PAGES[1:])])
def test_many_messages_in_any_order_of_time(tmp_path, page, order, monkeypatch):
    rng = np.random.default_rng(page)
    count = 6000 if page > 512 else 3000
    times = np.arange(count) * 1000
    if order == 'topic after topic':
        times = np.concatenate([times[k::4] for k in range(4)])
    elif order == 'any':
        times = rng.permutation(times)
    elif order == 'late ones':
        times = np.where(rng.uniform(size=count) < 0.02, times[::-1], times)
    rows = [(i + 1, 4 * i // count, t, rng.bytes(60 + i % 100)) for i, t in
            enumerate((times // 3000).tolist())]
    path = written(tmp_path / 'a.db3', rows, page)
    monkeypatch.setattr(sqlite_pages, 'BATCH', 1 << 17)
    with opened(path) as database:
        leaves = leaves_of(path, database)
        assert by_pages(leaves, database, [0, 1, 3], 1 << 14) == by_sqlite(database, {0, 1, 3})


ROW = (5, 1, 10**18, b'data')
OTHERS = {
    'null': (TABLE, (5, None, 10**18, b'data')),
    'text': (TABLE, (5, 1, 10**18, 'data')),
    'real': (TABLE, (5, 1, 0.5, b'data')),
    'topic as text': (TABLE, (5, 'one', 10**18, b'data')),
    'without rowid': (TABLE + ' WITHOUT ROWID', ROW),
    'key of its own': (TABLE.replace('INTEGER PRIMARY KEY', 'INTEGER PRIMARY KEY DESC'), ROW),
    'real column': (TABLE.replace('timestamp INTEGER', 'timestamp REAL'), ROW),
    'a column more': (TABLE.replace(')', ', more)'), (*ROW, 1)),
    'other order': (TABLE.replace('topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL',
                                  'timestamp INTEGER NOT NULL, topic_id INTEGER NOT NULL'), ROW),
}


@pytest.mark.parametrize('kind', OTHERS)
def test_what_rosbag2_does_not_write_is_left_to_sqlite(tmp_path, kind):
    table, row = OTHERS[kind]
    path = tmp_path / 'a.db3'
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute(table.replace(' NOT NULL', ''))
        database.execute(f'INSERT INTO messages VALUES ({", ".join("?" * len(row))})', row)
    with opened(path) as database:
        assert leaves_of(path, database) is None


def test_an_empty_table_is_left_to_sqlite(tmp_path):
    with opened(written(tmp_path / 'a.db3', [])) as database:
        assert leaves_of(tmp_path / 'a.db3', database) is None


def damaged(path: Path, count: int, rng) -> None:
    """Spoil bytes, most of them where pages say what they are and in the heads of cells."""
    data = bytearray(path.read_bytes())
    page = int.from_bytes(data[16:18], 'big')
    page = 65536 if page == 1 else page
    for _ in range(count):
        start = page * int(rng.integers(len(data) // page))
        at = start + int(rng.choice([rng.integers(12), rng.integers(100), rng.integers(page)]))
        flipped = data[at] ^ 1 << int(rng.integers(8))
        data[at] = rng.choice([0, 1, 13, 5, 255, rng.integers(256), flipped])
    if rng.integers(4) == 0:
        del data[int(rng.integers(len(data))):]
    path.write_bytes(data)


def sqlite_or_error(database):
    try:
        return by_sqlite(database, {0, 1, 2, 3})
    except (sqlite3.DatabaseError, UnicodeDecodeError):
        return None


@pytest.mark.parametrize('rounds', [100, *slow(400)])
@pytest.mark.parametrize('page', [512, *slow(1024, 4096, 65536)])
def test_damaged_files_give_what_sqlite_gives_or_are_left_to_it(tmp_path, page, rounds):
    rng = np.random.default_rng(page)
    rows = [(i + 1, i % 4, 10**18 + 1000 * i, rng.bytes(30 + 7 * i % 900)) for i in range(400)]
    source = written(tmp_path / 'a.db3', rows, page)
    path, compared, left = tmp_path / 'b.db3', 0, 0
    for _ in range(rounds):
        path.write_bytes(source.read_bytes())
        damaged(path, int(rng.integers(1, 3)), rng)
        with opened(path) as database:
            try:
                leaves = leaves_of(path, database)
            except (sqlite3.DatabaseError, UnicodeDecodeError):
                continue              # SQLite cannot open it either
            wanted = None if leaves is None else sqlite_or_error(database)
            if leaves is None:
                left += 1
                continue
            try:
                assert by_pages(leaves, database, [0, 1, 2, 3], 5000) == wanted
                compared += 1
            except sqlite3.DatabaseError:
                assert wanted is None
    assert compared > rounds / 4
    assert left > rounds / 20
