# SPDX-License-Identifier: Apache-2.0
"""
Messages of a sound SQLite file, without SQLite.

SQLite gives one row after another, in two to three times the time that the rest takes; here many
pages are read at once. Whatever is not as rosbag2 writes it (other columns, rows with a NULL or a
text, pages that do not belong to the table) is left to SQLite, and messages that go on in other
pages are asked of it.

Messages come in the order of time and `id`: the leaves are read in the order of their first
times, and a message waits until no leaf that is left can have an earlier one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
import sqlite3
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Block, Index, Located, Stamps
from ctsid_ros.recordings import sqlite_pages
from ctsid_ros.recordings.recording import Wanted
from ctsid_ros.recordings.sqlite_pages import (
    INTERIOR,
    INTERIOR_HEAD,
    LEAF,
    Bytes,
    Cells,
    big_endian,
    cells,
    messages,
    read_pages,
    varints,
)

_COLUMNS = [('id', 'INTEGER', 1), ('topic_id', 'INTEGER', 0), ('timestamp', 'INTEGER', 0),
            ('data', 'BLOB', 0)]  # name, type, part of the primary key
_DEEPEST = 20  # levels of a table that SQLite follows
_GREATEST = np.iinfo(np.int64).max  # `id` of all


class Form(NamedTuple):
    """Size of a page, how much at its end is not used [bytes], and how many pages there are."""

    size: int
    unused: int
    pages: int


class Leaves(NamedTuple):
    """
    The pages with the messages of a file.

    Parameters
    ----------
    path : Path
    form : Form
    numbers : ndarray of int, shape (L,)
        Of the pages, in the order of `id`.
    first_ns, last_ns : ndarray of int64, shape (L,)
        Range of the log times on each.
    counts : Counter
        Number of messages by topic.
    """

    path: Path
    form: Form
    numbers: Index
    first_ns: Stamps
    last_ns: Stamps
    counts: Counter[int]


class _NotPlainError(Exception):
    """Anything is not as rosbag2 has SQLite write it."""


def leaves_of(path: Path, database: sqlite3.Connection) -> Leaves | None:
    """Return the pages of all messages; None where SQLite has to be asked for them."""
    columns = [(name, kind.upper(), key) for _, name, kind, _, _, key, _ in database.execute(
        'PRAGMA table_xinfo(messages)')]
    root = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages' "
                            "AND type = 'table'").fetchone()
    if columns != _COLUMNS or not root or not root[0]:
        return None
    size, count = (database.execute(f'PRAGMA {name}').fetchone()[0]
                   for name in ('page_size', 'page_count'))
    try:
        with path.open('rb', buffering=0) as file:
            form = Form(size, file.read(21)[20], count)
            return _leaves(path, file, form, *_numbers(file, form, root[0]))
    except (_NotPlainError, EOFError):
        return None


def _numbers(file: BinaryIO, form: Form, root: int) -> tuple[Index, Index]:
    """Return the numbers of the leaves, in order, and the greatest `id` that each may have."""
    level, greatest = np.array([root]), np.array([_GREATEST])
    for _ in range(_DEEPEST):
        if read_pages(file, level[:1], form.size)[0] == LEAF:
            return level, greatest
        below = [_below(read_pages(file, some, form.size), own, form) for some, own in zip(
            _parts(level, form), _parts(greatest, form), strict=True)]
        level, greatest = (np.concatenate(column) for column in zip(*below, strict=True))
        if len(level) > form.pages or np.min(level) < 2 or np.max(level) > form.pages:
            raise _NotPlainError
    raise _NotPlainError


def _parts(numbers: Index, form: Form) -> list[Index]:
    step = max(1, sqlite_pages.BATCH // form.size)
    return [numbers[i:i + step] for i in range(0, len(numbers), step)]


def _below(content: Bytes, greatest: Index, form: Form) -> tuple[Index, Index]:
    """Return the numbers of the pages below some, and the greatest `id` of each."""
    pages = _checked(content, len(greatest), form, INTERIOR)
    page, at = cells(content, pages, form.size, INTERIOR_HEAD)
    keys, end = varints(content, np.maximum(at, 0) + 4)
    if (at < 0).any() or (end > page + form.size - form.unused).any():
        raise _NotPlainError
    # The last one of each page stands in its head.
    behind = np.searchsorted(page, pages, 'right')
    return (np.insert(big_endian(content, at, 4), behind, big_endian(content, pages + 8, 4)),
            np.insert(keys, behind, greatest))


def _checked(content: Bytes, count: int, form: Form, kind: int) -> Index:
    """Return where pages begin, if all are of this kind, and have as many cells as they can."""
    pages = np.arange(count) * form.size
    counts = big_endian(content, pages + 3, 2)
    if (content[pages] != kind).any() or (counts < 1).any() or (
            counts > (form.size - 8) // 6).any():
        raise _NotPlainError
    return pages


def _leaves(path: Path, file: BinaryIO, form: Form, numbers: Index, greatest: Index) -> Leaves:
    ranges, counts = [], Counter[int]()
    for some in _parts(numbers, form):
        content = read_pages(file, some, form.size)
        pages = _checked(content, len(some), form, LEAF)
        found = messages(content, pages, form.size, form.unused)
        if not found.sound.all() or (found.id[1:] <= found.id[:-1]).any():
            raise _NotPlainError
        ends = np.cumsum(big_endian(content, pages + 3, 2))
        starts = np.append(0, ends[:-1])
        ranges.append((found.id[starts], found.id[ends - 1],
                       np.minimum.reduceat(found.log_ns, starts),
                       np.maximum.reduceat(found.log_ns, starts)))
        topics, number = np.unique(found.topic, return_counts=True)
        counts.update(dict(zip(topics.tolist(), number.tolist(), strict=True)))
    least, most, first_ns, last_ns = (np.concatenate(r) for r in zip(*ranges, strict=True))
    # By these SQLite finds a single row.
    if (most > greatest).any() or (least[1:] <= greatest[:-1]).any():
        raise _NotPlainError
    return Leaves(path, form, numbers, first_ns, last_ns, counts)


def blocks(leaves: Leaves, database: sqlite3.Connection, batch: int, wanted: Wanted
           ) -> Iterator[Block]:
    """
    Yield the messages that are wanted, in the order of time and `id`, in pieces of `batch` bytes.

    Raises
    ------
    EOFError, sqlite3.DatabaseError
        If the file is another one than it was.
    """
    start_ns, end_ns = wanted.span_ns or (np.min(leaves.first_ns), np.max(leaves.last_ns))
    order = np.flatnonzero((leaves.first_ns <= end_ns) & (leaves.last_ns >= start_ns))
    order = order[np.argsort(leaves.first_ns[order], kind='stable')]
    parts = _parts(order, leaves.form)
    waiting, content = _none(), np.empty(0, np.uint8)
    with leaves.path.open('rb', buffering=0) as file:
        for some, following in zip_longest(parts, parts[1:]):
            waiting, held = _moved(waiting, content)
            content = read_pages(file, leaves.numbers[np.sort(some)],
                                 leaves.form.size, held)
            found = messages(content, len(held) + np.arange(len(some)) * leaves.form.size,
                             leaves.form.size, leaves.form.unused)
            found = _rows(found, found.sound & np.isin(found.topic, list(wanted.slots))
                          & (found.log_ns >= start_ns) & (found.log_ns <= end_ns))
            found = Cells._make(map(np.concatenate, zip(waiting, found, strict=True)))
            found = _rows(found, np.lexsort((found.id, found.log_ns)))
            ready = len(found.id) if following is None else int(np.searchsorted(
                found.log_ns, leaves.first_ns[following[0]]))
            waiting = _rows(found, slice(ready, None))
            for piece in _pieces(_rows(found, slice(ready)), batch):
                yield wanted.block(_located(piece, content, database, wanted))


def _rows(found: Cells, which: NDArray[Any] | slice) -> Cells:
    return Cells._make(column[which] for column in found)


def _none() -> Cells:
    return Cells(np.empty(0, np.bool_), *(np.empty(0, np.int64) for _ in Cells._fields[1:]))


def _moved(found: Cells, content: Bytes) -> tuple[Cells, bytes]:
    """Return messages that wait, and the bytes of them alone."""
    data = [content[at:at + here].tobytes() for at, here in zip(found.at, found.here, strict=True)]
    return found._replace(at=np.cumsum(found.here) - found.here), b''.join(data)


def _pieces(found: Cells, batch: int) -> Iterator[Cells]:
    """Divide messages, of which some may be large."""
    sizes = np.cumsum(found.length)
    start = 0
    while start < len(sizes):
        before = int(sizes[start - 1]) if start else 0
        end = max(start + 1, int(np.searchsorted(sizes, before + batch, 'right')))
        yield _rows(found, slice(start, end))
        start = end


def _located(found: Cells, content: Bytes, database: sqlite3.Connection, wanted: Wanted
             ) -> list[Located]:
    """Return where messages are: on their pages, or of those that go on in others a copy."""
    divided = found.here < found.length
    copies = [_data(database, number) for number in found.id[divided].tolist()]
    lengths = np.fromiter(map(len, copies), np.int64, len(copies))
    if (lengths != found.length[divided]).any():
        raise sqlite3.DatabaseError('a message is not as long as before')
    offsets = found.at.copy()
    offsets[divided] = np.cumsum(lengths) - lengths
    buffers, place = (memoryview(content), b''.join(copies)), np.arange(len(offsets))
    return [Located(slot, buffers[copied], offsets[own], found.length[own], found.log_ns[own],
                    found.log_ns[own], own)
            for topic, slot in wanted.slots.items() for copied in (False, True)
            if len(own := place[(found.topic == topic) & (divided == copied)])]


def _data(database: sqlite3.Connection, number: int) -> bytes:
    (data,) = database.execute('SELECT data FROM messages WHERE id = ?', (number,)).fetchone() or (
        b'',)
    return bytes(data)
