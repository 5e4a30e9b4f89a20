# SPDX-License-Identifier: Apache-2.0
"""
Messages in the pages of an SQLite file (https://www.sqlite.org/fileformat2.html).

The rows of a table lie in cells of pages that say so (leaves); what does not fit into a page goes
on in others. A row of the table of messages is known by its columns: a number that stands for its
own row, two integers and a blob. Cells of many pages are read at once, for SQLite hands out one
row after another, and copies it.

`sqlite_leaves.py` reads sound files by it, and `rows` damaged ones: SQLite finds the pages of a
table from one page that it can do without least, for the higher pages of a growing table are
written late, so those of a file that is cut off are often lost, and every message with them. Here
each page is looked at by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Index, Stamps

Bytes = NDArray[np.uint8]

LEAF, INTERIOR = 13, 5  # kinds of pages of a table: with rows, and with the numbers of other pages
LEAF_HEAD, INTERIOR_HEAD = 8, 12  # bytes before the list of cells
BATCH = 4 << 20  # bytes that are read and decoded at once: 1 and 12 MB take a tenth longer
_BEYOND = 80  # bytes that the numbers at the head of a cell have at most: read before it is known
_BLOB = 12  # least type of a blob; even ones are of (type - 12) / 2 bytes
_WIDTHS = np.array([0, 1, 2, 3, 4, 6, 8, 0, 0, 0])  # bytes of a number, by its type
_NUMBERS = (1, 2, 3, 4, 5, 6, 8, 9)  # types; 8 and 9 are 0 and 1 themselves
_COLUMNS = 4  # of the table of messages
_LARGEST = 10**9  # bytes of a row that SQLite reads


class Cells(NamedTuple):
    """
    Messages in pages, in the order of pages and cells.

    Parameters
    ----------
    sound : ndarray of bool, shape (N,)
        Whether it is a message; else the rest of its row means nothing.
    id, topic : ndarray of int64, shape (N,)
    log_ns : ndarray of int64, shape (N,)
    at, length : ndarray of int, shape (N,)
        Where its data begin in what was read, and how long they are.
    here : ndarray of int, shape (N,)
        How much of them is on its page. After less than all, the number of the page follows on
        which they go on.
    """

    sound: NDArray[np.bool_]
    id: NDArray[np.int64]
    topic: NDArray[np.int64]
    log_ns: Stamps
    at: Index
    length: Index
    here: Index


def read_pages(file: BinaryIO, numbers: Index, size: int, before: bytes = b'') -> Bytes:
    """
    Return pages by their numbers, in this order, and some bytes beyond; `before` goes before.

    Raises
    ------
    EOFError
        If the file ends before a page does.
    """
    content = np.zeros(len(before) + len(numbers) * size + _BEYOND, np.uint8)
    view = memoryview(content)
    view[:len(before)] = before
    runs = np.flatnonzero(np.diff(numbers, prepend=-1, append=-1) != 1)
    for first, last in zip(runs[:-1].tolist(), runs[1:].tolist(), strict=True):
        file.seek((int(numbers[first]) - 1) * size)
        start, end = (len(before) + i * size for i in (first, last))
        while start < end:
            count = file.readinto(view[start:end])  # type: ignore[attr-defined]
            if not count:
                raise EOFError('a page lies beyond the end of the file')
            start += count
    return content


def cells(content: Bytes, pages: Index, size: int, head: int) -> tuple[Index, Index]:
    """Return the page of each cell, and where the cell begins; -1 if that is not in the page."""
    counts = np.minimum(big_endian(content, pages + 3, 2), (size - 8) // 6)
    page = np.repeat(pages, counts)
    number = np.arange(len(page)) - np.repeat(np.cumsum(counts) - counts, counts)
    at = big_endian(content, page + head + 2 * number, 2)
    inside = (at >= head + 2 * np.repeat(counts, counts)) & (at < size)
    return page, np.where(inside, page + at, -1)


def messages(content: Bytes, pages: Index, size: int, unused: int) -> Cells:
    """
    Return the messages of leaves.

    Parameters
    ----------
    content : ndarray of uint8
        As `read_pages` gives it.
    pages : ndarray of int
        Where in it the leaves begin.
    size, unused : int
        Of a page, and how much at its end SQLite does not use [bytes].
    """
    page, at = cells(content, pages, size, LEAF_HEAD)
    sound, usable = at >= 0, size - unused
    payload, at = varints(content, np.maximum(at, 0))
    id_, begin = varints(content, at)
    head, at = varints(content, begin)
    types = []
    for _ in range(_COLUMNS):
        kind, at = varints(content, at)
        types.append(kind)
    own, topic, time, data = types
    length = data - _BLOB >> 1
    sound &= (at - begin == head) & (own == 0) & np.isin(topic, _NUMBERS) & np.isin(
        time, _NUMBERS) & (data >= _BLOB) & (data % 2 == 0)
    topic, time, at = (np.where(sound, value, 0) for value in (topic, time, at))
    numbers = _WIDTHS[topic] + _WIDTHS[time]
    local = _local(payload, usable)
    sound &= (head + numbers + length == payload) & (payload <= _LARGEST) & (
        head + numbers <= local) & (begin + local + 4 * (local < payload) <= page + usable)
    topic, time, at = (np.where(sound, value, 0) for value in (topic, time, at))
    return Cells(sound, id_, _integers(content, at, topic),
                 _integers(content, at + _WIDTHS[topic], time), at + numbers, length,
                 local - head - numbers)


def _local(payload: Index, usable: int) -> Index:
    """Return how many bytes of rows are on the page where they begin."""
    least = (usable - 12) * 32 // 255 - 23
    own = least + (payload - least) % (usable - 4)
    return np.where(payload <= usable - 35, payload, np.where(own <= usable - 35, own, least))


def varints(content: Bytes, at: Index) -> tuple[Index, Index]:
    """Return numbers of 1 to 9 bytes, and where they end."""
    byte = content[at]
    value, end = (byte & 0x7f).astype(np.int64), at + 1
    more = np.flatnonzero(byte > 0x7f)
    for number in range(1, 9):
        if not len(more):
            break
        byte = content[end[more]]
        value[more] = value[more] << 8 | byte if number == 8 else value[more] << 7 | byte & 0x7f
        end[more] += 1
        more = more[byte > 0x7f]
    return value, end


def big_endian(content: Bytes, at: Index, width: int) -> Index:
    """Return numbers of some bytes, without a sign unless they have eight."""
    value = content[at].astype(np.int64)
    for i in range(1, width):
        value = value << 8 | content[at + i]
    return value


def _integers(content: Bytes, at: Index, types: Index) -> Index:
    value = types - 8
    for kind in _NUMBERS[:6]:
        own = np.flatnonzero(types == kind)
        if len(own):
            width = int(_WIDTHS[kind])
            shift = 64 - 8 * width
            value[own] = big_endian(content, at[own], width) << shift >> shift
    return value


class Row(NamedTuple):
    """A row of the table of messages."""

    id: int
    topic: int
    timestamp: int
    data: bytes


def rows(file: BinaryIO, size: int, unused: int, end: int) -> Iterator[Row]:
    """
    Yield the messages of all pages of a damaged file, in their order.

    Parameters
    ----------
    file : binary file
    size, unused : int
        Of a page, and how much at its end SQLite does not use [bytes].
    end : int
        Size of what is there of the file: whole pages [bytes].
    """
    step = BATCH // size
    for first in range(2, end // size + 1, step):  # the first page has no messages
        content = read_pages(file, np.arange(first, min(first + step, end // size + 1)), size)
        pages = np.arange(0, len(content) - _BEYOND, size)
        found = messages(content, pages[content[pages] == LEAF], size, unused)
        for i in np.flatnonzero(found.sound).tolist():
            at, length, here = (int(column[i]) for column in found[4:])
            data = content[at:at + here].tobytes()
            if here < length:
                following = int(big_endian(content, np.array([at + here]), 4)[0])
                data += _rest(file, following, length - here, size, unused, end)
            if len(data) == length:  # else it goes on in a page that is lost
                yield Row(int(found.id[i]), int(found.topic[i]), int(found.log_ns[i]), data)


def _rest(file: BinaryIO, number: int, left: int, size: int, unused: int, end: int) -> bytes:
    """Return what did not fit into the page of a row; less if a page of it is lost."""
    parts = []
    # What is longer than the file might go round in a circle of pages.
    while 0 < left <= end and 0 < number <= end // size:
        file.seek((number - 1) * size)
        page = file.read(size)
        parts.append(page[4:min(size - unused, 4 + left)])
        number, left = int.from_bytes(page[:4], 'big'), left - len(parts[-1])
    return b''.join(parts)
