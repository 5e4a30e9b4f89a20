# SPDX-License-Identifier: Apache-2.0
"""
Messages out of the pages of a damaged SQLite file (https://www.sqlite.org/fileformat2.html).

SQLite finds the pages of a table from one page that it can do without least: the higher pages of
a growing table are written late, so those of a file that is cut off are often lost, and every
message with them. Here each page is looked at by itself. A page that holds rows says so, and a
row of the table of messages is known by its columns: a number that stands for its own row, two
integers and a blob.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

_LEAF = 13  # kind of a page that holds rows of a table
_HEAD, _FIRST = 8, 100  # bytes of the head of such a page; of the file, on its first page
_BLOB = 12  # least type of a blob; even ones are of (type - 12) / 2 bytes
_WIDTHS = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}  # bytes of integers by type
_COLUMNS = 4  # of the table of messages


class Row(NamedTuple):
    """A row of the table of messages."""

    id: int
    topic: int
    timestamp: int
    data: bytes


def rows(file: BinaryIO, page: int, unused: int, end: int) -> Iterator[Row]:
    """
    Yield the messages of all pages, in their order.

    Parameters
    ----------
    file : binary file
    page : int
        Size of a page [bytes].
    unused : int
        Bytes at the end of each page that SQLite does not use.
    end : int
        Size of what is there of the file: whole pages [bytes].
    """
    for number in range(1, end // page + 1):
        file.seek((number - 1) * page)
        content = file.read(page)
        start = _FIRST if number == 1 else 0
        if content[start] == _LEAF:
            for at in _cells(content, start):
                try:
                    row = _row(file, content, at, page - unused, end)
                except (IndexError, ValueError):
                    continue  # it is damaged, or of another table
                if row:
                    yield row


def _cells(content: bytes, start: int) -> list[int]:
    """Return where the cells of a page begin."""
    count = int.from_bytes(content[start + 3:start + 5], 'big')
    first = start + _HEAD
    places = [int.from_bytes(content[at:at + 2], 'big')
              for at in range(first, min(first + 2 * count, len(content) - 1), 2)]
    return [at for at in places if first + 2 * count <= at < len(content)]


def _row(file: BinaryIO, content: bytes, at: int, usable: int, end: int) -> Row | None:
    """Return the message in a cell; None if it is one of another table."""
    size, at = _varint(content, at)
    id_, at = _varint(content, at)
    head, first = _varint(content, at)
    types = []
    while first < at + head:
        kind, first = _varint(content, first)
        types.append(kind)
    if len(types) != _COLUMNS or types[0] or not {*types[1:3]} <= _WIDTHS.keys() \
            or types[3] < _BLOB or types[3] % 2:
        return None
    widths = [_WIDTHS[kind] for kind in types[:3]] + [(types[3] - _BLOB) // 2]
    if head + sum(widths) != size:
        raise ValueError('a row is not as long as its columns')
    record = _payload(file, content, at, size, usable, end)
    values = []
    for kind, width in zip(types, widths, strict=True):
        values.append(record[head:head + width] if kind >= _BLOB else kind - 8 if kind > 7 else
                      int.from_bytes(record[head:head + width], 'big', signed=True))
        head += width
    _, topic, timestamp, data = values
    return Row(id_, topic, timestamp, data)  # type: ignore[arg-type]


def _payload(file: BinaryIO, content: bytes, at: int, size: int, usable: int, end: int) -> bytes:
    """Return the columns of a cell, with what did not fit into its page."""
    own = size
    if size > usable - 35:
        least = (usable - 12) * 32 // 255 - 23
        own = least + (size - least) % (usable - 4)
        own = own if own <= usable - 35 else least
    parts, left = [content[at:at + own]], size - own
    following = content[at + own:at + own + 4] if left else b''
    if left > end:
        raise ValueError('a row is longer than the file')  # its pages might go round in a circle
    while left > 0:
        number = int.from_bytes(following, 'big')
        if not 0 < number <= end // len(content):
            raise ValueError('a row goes on in a page that is lost')
        file.seek((number - 1) * len(content))
        more = file.read(len(content))
        parts.append(more[4:min(usable, 4 + left)])
        following, left = more[:4], left - (usable - 4)
    return b''.join(parts)


def _varint(content: bytes, at: int) -> tuple[int, int]:
    """Return a number of 1 to 9 bytes, and where it ends."""
    value = 0
    for end in range(at, at + 8):
        value = value << 7 | content[end] & 0x7f
        if content[end] < 0x80:
            return value, end + 1
    value = value << 8 | content[at + 8]
    return value - (value >> 63 << 64), at + 9
