# SPDX-License-Identifier: Apache-2.0
"""
rosbag2 files in SQLite (.db3), of any schema version, sound or cut off.

A file left behind by a crash may have its last messages in a write-ahead log beside it, which is
then read as well. The messages of a sound file are read by `sqlite_leaves.py`, those of another
by SQLite. A cut-off file is malformed for SQLite; its messages are taken out of the pages
that are there, by `sqlite_pages.py`, and its topics by SQLite, the file filled up with zeros to
the size that its header states.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
import io
from itertools import chain, islice
from pathlib import Path
import shutil
import sqlite3
import tempfile
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from ctsid_ros.decoding.block import Block, Located
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.chunks import NO_CHECKSUMS, YEAR
from ctsid_ros.recordings.recording import Connection, Note, Recording, Wanted
from ctsid_ros.recordings.sqlite_leaves import Leaves, blocks, leaves_of
from ctsid_ros.recordings.sqlite_pages import BATCH, rows

MAGIC = b'SQLite format 3\0'
TABLES = {
    'topics': ('id', 'name', 'type', 'serialization_format'),
    'messages': ('id', 'topic_id', 'timestamp', 'data'),
    'message_definitions': ('topic_type', 'encoding', 'encoded_message_definition'),
}
_ROWS = 64  # fetched at once, before it is known how large they are
# A damaged schema may even come with an error message that is not UTF-8.
DAMAGE = (sqlite3.DatabaseError, UnicodeDecodeError)
# Asked of each message when it is read as well: its time then comes out of the index, where it may
# be another one than in the table.
SOUND = "typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"  # columns can hold anything


def scan_sqlite(path: Path, resources: ExitStack) -> Recording:
    """
    Read what an SQLite file contains.

    Raises
    ------
    BagError
        If it is not one of rosbag2, or nothing of it can be read.
    """
    database = _connect(path, resources)
    try:
        return _recording(path, database, ())
    except DAMAGE as error:
        salvaged, count = _salvage(path, resources, error)
        note = f'{path.name}: truncated: {count} messages recovered ({error})'
        return _recording(path, salvaged, (note,))


def _connect(path: Path, resources: ExitStack) -> sqlite3.Connection:
    """Open a file for reading; without touching its folder unless a write-ahead log is there."""
    mode = 'mode=ro' if _log_ahead(path) else 'immutable=1'
    database = sqlite3.connect(f'{path.resolve().as_uri()}?{mode}', uri=True,
                               check_same_thread=False)
    database.text_factory = _text
    resources.callback(database.close)
    return database


def _log_ahead(path: Path) -> bool:
    """Whether a write-ahead log is beside a file, with what is newer than the file."""
    log = path.with_name(path.name + '-wal')
    return log.exists() and log.stat().st_size > 0


def _text(stored: bytes) -> str:
    return stored.decode(errors='replace')


def _recording(path: Path, database: sqlite3.Connection, notes: tuple[str, ...]) -> Recording:
    present = {name for name, in database.execute('SELECT name FROM sqlite_master')}
    if not {'topics', 'messages'} <= present:
        raise BagError(f'{path} is an SQLite database, but not a bag: its tables are '
                       f'{", ".join(sorted(present)) or "none"}')
    definitions = _definitions(database) if 'message_definitions' in present else {}
    topics = [row for row in database.execute(f'SELECT {", ".join(TABLES["topics"])} FROM topics')
              if all(isinstance(text, str) for text in row[1:])]
    known = [number for number, *_ in topics]
    content = _plain(path, database, known) or _asked(path, database, known)
    connections = tuple(
        Connection(number, topic, kind, encoding, *definitions.get(kind, ('', '')),
                   content.counts.get(number, 0))
        for number, topic, kind, encoding in topics)
    return Recording(connections, content.start_ns, content.end_ns, content.blocks,
                     (*notes, *content.notes))


class _Content(NamedTuple):
    """Number of messages by topic, first and last time, and what else a `Recording` has."""

    counts: Mapping[int, int]
    start_ns: int
    end_ns: int
    blocks: Callable[[Wanted, Note], Iterator[Block]]
    notes: tuple[str, ...] = ()


def _plain(path: Path, database: sqlite3.Connection, known: Sequence[int]) -> _Content | None:
    """Return what pages say that are as rosbag2 has SQLite write them; None if others are."""
    leaves = None if _log_ahead(path) else leaves_of(path, database)
    if leaves is None or not leaves.counts.keys() <= set(known):
        return None
    start_ns, end_ns = int(np.min(leaves.first_ns)), int(np.max(leaves.last_ns))
    if end_ns - start_ns > YEAR:
        return None
    return _Content(leaves.counts, start_ns, end_ns, partial(_plain_blocks, leaves, database))


def _plain_blocks(leaves: Leaves, database: sqlite3.Connection, wanted: Wanted, note: Note
                  ) -> Iterator[Block]:
    given = 0
    try:
        for block in blocks(leaves, database, BATCH, wanted):
            yield block
            given += len(block)
    except (*DAMAGE, EOFError) as error:
        note(f'{leaves.path.name}: damaged: {given} messages read, the rest is lost ({error})')


def _asked(path: Path, database: sqlite3.Connection, known: Sequence[int]) -> _Content:
    """Return what SQLite says of messages."""
    sound = _sound(database)
    # One pass, for SQLite would sort them: the topics of all messages as one text.
    topics, total = database.execute(
        f'SELECT group_concat(CASE WHEN {sound} THEN topic_id END), COUNT(*) FROM messages'
        ).fetchone()
    counts = Counter((topics or '').split(',') if topics else [])
    # Messages are read in the order of an index, which may lack some of those in the table.
    (listed,) = database.execute(
        f'SELECT COUNT(*) FROM messages WHERE {_in_time(sound)}').fetchone()
    if listed < counts.total():
        raise sqlite3.DatabaseError('its index of times is damaged')
    left_out = total - counts.total()
    notes = (f'{path.name}: {left_out} messages are damaged and were left out; {NO_CHECKSUMS}',
             ) if left_out else ()
    by_topic = {number: counts[str(number)] for number in known}
    among = ', '.join(str(number) for number, count in by_topic.items() if count)
    first, last = (database.execute(
        f'SELECT timestamp FROM messages WHERE topic_id IN ({among}) AND {sound} '
        f'ORDER BY timestamp {order} LIMIT 1').fetchone() or (0,) for order in ('ASC', 'DESC'))
    return _Content(by_topic, first[0], last[0], partial(_blocks, path, database, sound), notes)


def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    columns = ', '.join(TABLES['message_definitions'])
    return {kind: (str(encoding), str(text)) for kind, encoding, text in database.execute(
        f'SELECT {columns} FROM message_definitions')}


def _sound(database: sqlite3.Connection) -> str:
    """Return the condition of SQL that a message is not damaged."""
    (middle,) = database.execute(
        'SELECT timestamp FROM messages ORDER BY timestamp LIMIT 1 '
        'OFFSET (SELECT COUNT(*) FROM messages) / 2').fetchone() or (0,)
    if not isinstance(middle, int):
        return SOUND
    return f'{SOUND} AND timestamp BETWEEN {middle - int(YEAR)} AND {middle + int(YEAR)}'


def _in_time(sound: str) -> str:
    """Return the part of the condition that is on the time, and needs nothing but the index."""
    return sound.replace(" AND typeof(data) = 'blob'", '')


def _blocks(path: Path, database: sqlite3.Connection, sound: str, wanted: Wanted, note: Note
            ) -> Iterator[Block]:
    marks = ', '.join('?' * len(wanted.slots))
    within = 'AND timestamp BETWEEN {} AND {}'.format(*wanted.span_ns) if wanted.span_ns else ''
    query = (f'SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({marks}) '
             f'AND {sound} {within} ORDER BY timestamp, id')
    given, count = 0, _ROWS
    try:
        cursor = database.execute(query, tuple(wanted.slots))
        # One list of all values: rows that are kept as tuples cost a quarter more.
        while values := list(chain.from_iterable(islice(cursor, count))):
            found, size = _located(values, wanted.slots)
            given += len(values) // 3
            count = max(_ROWS, min(BATCH * len(values) // 3 // max(size, 1), 4 * count))
            yield wanted.block(found)
    except DAMAGE as error:
        note(f'{path.name}: damaged: {given} messages read, the rest is lost ({error})')


def _located(values: Sequence[Any], slots: Mapping[int, int]) -> tuple[list[Located], int]:
    """Lay messages (time, topic, data, and so on) side by side; return them, and their size."""
    data: Sequence[bytes] = values[2::3]
    log_ns, number = (np.fromiter(values[i::3], np.int64, len(data)) for i in (0, 1))
    lengths = np.fromiter(map(len, data), np.intp, len(data))
    content, offsets = b''.join(data), np.cumsum(lengths) - lengths
    found = []
    for topic, slot in slots.items():
        own = np.flatnonzero(number == topic)
        if len(own):
            found.append(Located(slot, content, offsets[own], lengths[own], log_ns[own],
                                 log_ns[own]))
    return found, len(content)


def _salvage(path: Path, resources: ExitStack, error: Exception
             ) -> tuple[sqlite3.Connection, int]:
    """Copy into a new database what can be read of a malformed one."""
    folder = Path(resources.enter_context(tempfile.TemporaryDirectory(prefix='ctsid-')))
    copy = folder / 'damaged.db3'
    page, unused, end = _fill_up(path, copy)
    damaged = _connect(copy, resources)
    new = sqlite3.connect(folder / 'salvaged.db3', check_same_thread=False)
    resources.callback(new.close)
    new.executescript('PRAGMA synchronous = OFF; PRAGMA journal_mode = OFF')  # quick, temporary
    for table, columns in TABLES.items():
        key = ' INTEGER PRIMARY KEY' if columns[0] == 'id' else ''
        new.execute(f'CREATE TABLE {table} ({columns[0]}{key}, {", ".join(columns[1:])})')
        if table != 'messages':
            _copy_rows(damaged, new, table, columns)
    with copy.open('rb') as file:
        new.executemany('INSERT OR IGNORE INTO messages VALUES (?, ?, ?, ?)',
                        rows(file, page, unused, end))
    new.execute('CREATE INDEX by_time ON messages (timestamp)')
    new.commit()
    (count,) = new.execute('SELECT COUNT(*) FROM messages').fetchone()
    if not count:
        raise BagError(f'{path}: the database is damaged ({error}) and no message can be '
                       'recovered; try `sqlite3 FILE .recover`')
    return new, count


def _fill_up(path: Path, copy: Path) -> tuple[int, int, int]:
    """
    Copy a file without its last, half-written page, filled with zeros to its stated size.

    Return the size of a page, how much at its end SQLite does not use, and what was there.
    """
    shutil.copyfile(path, copy)
    with copy.open('r+b') as file:
        header = file.read(100).ljust(100, b'\0')
        page = int.from_bytes(header[16:18], 'big')
        page = 65536 if page == 1 else max(page, 512)
        size, end = file.seek(0, io.SEEK_END), _end_of_data(file)
        # Zeros that fill pages never reached the disk; fewer may be the end of a message.
        whole = (end if size - end >= page else size) // page * page
        file.truncate(whole)
        file.truncate(max(whole, page * int.from_bytes(header[28:32], 'big')))
    return page, header[20], whole


def _end_of_data(file: BinaryIO) -> int:
    """Return the size of a file without the zeros at its end."""
    end = file.seek(0, io.SEEK_END)
    while end > 0:
        start = max(0, end - (1 << 20))
        file.seek(start)
        block = file.read(end - start).rstrip(b'\0')
        if block:
            return start + len(block)
        end = start
    return 0


def _copy_rows(damaged: sqlite3.Connection, new: sqlite3.Connection, table: str,
               columns: tuple[str, ...]) -> None:
    marks = ', '.join('?' * len(columns))
    try:
        for row in damaged.execute(f'SELECT {", ".join(columns)} FROM {table} ORDER BY rowid'):
            new.execute(f'INSERT INTO {table} VALUES ({marks})', row)
    except DAMAGE:
        return  # no such table, or no further row
