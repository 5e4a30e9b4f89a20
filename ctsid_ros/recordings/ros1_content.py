# SPDX-License-Identifier: Apache-2.0
"""
Where messages lie in the content of a chunk of a ROS 1 bag.

A record is a header of named fields, and data. The headers of messages have the same fields in
the same order, so they are read all at once; those that differ are read one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Content, Index, Located, Stamps
from ctsid_ros.decoding.table import take

MESSAGE, CONNECTION = b'\2', b'\7'
U32 = struct.Struct('<I')
_TIME = struct.Struct('<II')
Header = dict[bytes, bytes]
Connect = Callable[[Header, bytes], None]


class Messages(NamedTuple):
    """
    Messages in one content, in the order of their places.

    Parameters
    ----------
    offsets, lengths : ndarray of int, shape (N,)
        Of their data.
    connections : ndarray of int, shape (N,)
    log_ns : ndarray of int64, shape (N,)
    problem : str
        Why there may be others that cannot be read; empty if there are none.
    """

    offsets: Index
    lengths: Index
    connections: Index
    log_ns: Stamps
    problem: str


def fields(data: bytes) -> Header:
    """Return the fields of a header."""
    return {name: data[start:end] for name, (start, end) in _places(data).items()}


def _places(data: bytes) -> dict[bytes, tuple[int, int]]:
    """Return where the values of the fields of a header lie."""
    found: dict[bytes, tuple[int, int]] = {}
    end = 0
    while end < len(data):
        start = end + 4
        end = start + U32.unpack_from(data, end)[0]
        name, _, value = data[start:end].partition(b'=')
        found[name] = (start + len(name) + 1, start + len(name) + 1 + len(value))
    return found


def time_ns(value: bytes) -> int:
    """Return a time [ns]."""
    seconds, nanoseconds = _TIME.unpack(value)
    return int(seconds) * 10**9 + int(nanoseconds)


def messages(content: Content, connect: Connect | None = None) -> Messages:
    """
    Find the messages of all connections.

    Parameters
    ----------
    content : bytes-like
    connect : callable, optional
        Takes header and data of each connection that is declared.
    """
    records, problem = _walk(content)
    start, head, size = records.T
    number, log_ns = np.full(len(records), -1), np.zeros(len(records), np.int64)
    left = np.arange(len(records))
    while len(left):
        first = left[0]
        text = bytes(content[start[first] + 4:start[first] + 4 + head[first]])
        try:
            places = _places(text)
            kind = text[slice(*places[b'op'])]
            if kind == MESSAGE:
                rows = left[head[left] == head[first]]
                own, connections, times = _alike(content, start[rows] + 4, text, places)
                number[rows[own]], log_ns[rows[own]] = connections[own], times[own]
                left = np.setdiff1d(left, rows[own], assume_unique=True)
                continue
            if kind == CONNECTION and connect:
                data = int(start[first] + 8 + head[first])
                connect(fields(text), bytes(content[data:data + int(size[first])]))
        except (struct.error, KeyError, ValueError) as error:
            problem = f'a record has no proper header ({error})'
        left = left[1:]
    found = np.flatnonzero(number >= 0)
    return Messages((start + 8 + head)[found], size[found], number[found], log_ns[found], problem)


def _alike(content: Content, starts: Index, text: bytes, places: Mapping[bytes, tuple[int, int]]
           ) -> tuple[NDArray[np.bool_], Index, Stamps]:
    """Return which headers are like one but for connection and time, and what these are."""
    heads = take(content, starts, len(text)).view(np.uint8).reshape(len(starts), -1)
    fixed = np.ones(len(text), bool)
    values = []
    for name, width in ((b'conn', 4), (b'time', 8)):
        first, last = places[name]
        if last - first != width:
            raise ValueError(f'{name.decode()} of {last - first} bytes')
        fixed[first:last] = False
        values.append(np.ascontiguousarray(heads[:, first:last]).view('<u4').astype(np.int64))
    alike = (heads[:, fixed] == np.frombuffer(text, np.uint8)[fixed]).all(axis=1)
    (connection, time) = values
    return alike, connection[:, 0], time[:, 0] * 10**9 + time[:, 1]


def _walk(content: Content) -> tuple[Index, str]:
    """Return where complete records begin, and the lengths of headers and data; what is wrong."""
    found: list[tuple[int, int, int]] = []
    position, size, unpack, problem = 0, len(content), U32.unpack_from, ''
    while position < size:
        try:
            (head,) = unpack(content, position)
            (data,) = unpack(content, position + 4 + head)
        except struct.error as error:
            problem = str(error)
            break
        end = position + 8 + head + data
        if end > size:
            problem = 'a record is longer than its chunk'
            break
        found.append((position, head, data))
        position = end
    return np.array(found, np.intp).reshape(-1, 3), problem


def locate(content: Content, slots: Mapping[int, int]) -> tuple[list[Located], str]:
    """Find the messages of some connections; say what is wrong."""
    all_ = messages(content)
    found = []
    for connection, slot in slots.items():
        own = np.flatnonzero(all_.connections == connection)
        if len(own):
            found.append(Located(slot, content, all_.offsets[own], all_.lengths[own],
                                 all_.log_ns[own], all_.log_ns[own]))
    return found, all_.problem
