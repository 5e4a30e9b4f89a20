# SPDX-License-Identifier: Apache-2.0
"""
ROS 1 bags, format 2.0 (http://wiki.ros.org/Bags/Format/2.0), indexed or not.

The records are visited in sequence, stepping over the content of chunks. Where the index at the
end says what the chunks hold they are not opened; a bag without it (a crash of the recorder, a
`.bag.active` file, a cut-off copy) is read as far as it goes.
"""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import replace
import io
from pathlib import Path
import struct
from typing import BinaryIO

import lz4.frame

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.recording import (
    Chunk,
    Connection,
    Note,
    Recording,
    Row,
    rows_in_order,
    span,
)

MAGIC = b'#ROSBAG V'
_VERSION = b'#ROSBAG V2.0\n'
_MESSAGE, _BAG_HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = b'\2', b'\3', b'\5', b'\6', b'\7'
_U32 = struct.Struct('<I')
_U64 = struct.Struct('<Q')
_TIME = struct.Struct('<II')
_DECOMPRESS: dict[str, Callable[[bytes], bytes]] = {
    'none': lambda data: data, 'bz2': bz2.decompress,
    'lz4': lambda data: bytes(lz4.frame.decompress(data))}

Header = dict[bytes, bytes]


def scan_ros1(path: Path, resources: ExitStack) -> Recording:
    """
    Read what a ROS 1 bag contains.

    Raises
    ------
    BagError
        If its version is not 2.0, it is encrypted, or nothing of it can be read.
    """
    with path.open('rb') as file:
        version = file.read(len(_VERSION))
        if version != _VERSION:
            raise BagError(f'{path}: a ROS 1 bag of version {version[9:12].decode("latin1")!r}; '
                           'ctsid reads 2.0: convert it with `rosbag fix`')
        scan = _Scan(path, file)
        scan.records()
        scan.contents()
        return scan.recording()


class _Scan:
    """The pass over a file at its opening; a builder of its `Recording`."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.chunks: dict[int, Chunk] = {}  # by position of the record
        self.connections: dict[int, Connection] = {}
        self.stated_chunks: int | None = None  # None: never closed
        self.complete = False
        self.notes: list[str] = []

    def records(self) -> None:
        """Visit all records of the file, as far as they are complete."""
        size = self.file.seek(0, io.SEEK_END)
        position = len(_VERSION)
        while position < size:
            try:
                self.file.seek(position)
                header, data_size = self.header(size)
                data = self.file.tell()
                if data + data_size > size:
                    return
                self.record(header, position, data, data_size)
            except (struct.error, KeyError, ValueError, IndexError):
                return
            position = data + data_size
        self.complete = True

    def header(self, size: int) -> tuple[Header, int]:
        (length,) = _U32.unpack(self.file.read(4))
        if self.file.tell() + length > size:
            raise ValueError('a header is longer than the file')
        header = _fields(self.file.read(length))
        return header, _U32.unpack(self.file.read(4))[0]

    def record(self, header: Header, position: int, data: int, size: int) -> None:
        kind = header[b'op']
        if kind == _CHUNK:
            compression = header[b'compression'].decode()
            if compression not in _DECOMPRESS:
                raise BagError(f'{self.path}: chunks are compressed with {compression!r}; ctsid '
                               'reads lz4, bz2 and none: convert the bag with `rosbag compress`')
            self.chunks[position] = Chunk(data, size, compression)
        elif kind == _BAG_HEADER:
            if header.get(b'encryptor'):
                raise BagError(f'{self.path}: the bag is encrypted; decrypt it with '
                               '`rosbag decrypt`')
            if _U64.unpack(header[b'index_pos'])[0]:
                self.stated_chunks = _U32.unpack(header[b'chunk_count'])[0]
        elif kind == _CONNECTION:
            self.connect(header, self.file.read(size))
        elif kind == _CHUNK_INFO:
            self.chunk_info(header, self.file.read(size))

    def connect(self, header: Header, data: bytes) -> None:
        (number,) = _U32.unpack(header[b'conn'])
        fields = _fields(data)
        self.connections[number] = Connection(
            number, _topic(header[b'topic']), fields[b'type'].decode(), 'ros1', 'ros1msg',
            fields[b'message_definition'].decode(errors='replace'), 0)

    def chunk_info(self, header: Header, data: bytes) -> None:
        (position,) = _U64.unpack(header[b'chunk_pos'])
        self.chunks[position] = replace(
            self.chunks[position], counts=dict(struct.iter_unpack('<II', data)),
            start_ns=_time(header[b'start_time']), end_ns=_time(header[b'end_time']))

    def contents(self) -> None:
        """Read those chunks of which the index tells nothing."""
        self.chunks = {position: chunk if chunk.counts is not None else self.read_anew(chunk)
                       for position, chunk in self.chunks.items()}
        self.chunks = {position: chunk for position, chunk in self.chunks.items() if chunk.counts}
        found = sum(sum((chunk.counts or {}).values()) for chunk in self.chunks.values())
        if self.stated_chunks is None or not self.complete:
            if not found:
                raise BagError(f'{self.path}: the bag is cut off before its first complete chunk; '
                               'nothing can be recovered')
            self.notes.append(f'{self.path.name}: truncated: {found} messages recovered (the bag '
                              'was not closed, or has no index)')

    def read_anew(self, chunk: Chunk) -> Chunk:
        """Find counts, times and connections in the content of a chunk."""
        counts: Counter[int] = Counter()
        times: list[int] = []
        try:
            for header, data in _records(_content(self.file, chunk)):
                if header[b'op'] == _MESSAGE:
                    counts[_U32.unpack(header[b'conn'])[0]] += 1
                    times.append(_time(header[b'time']))
                elif header[b'op'] == _CONNECTION:
                    self.connect(header, bytes(data))
        except (struct.error, KeyError, ValueError) as error:
            self.notes.append(f'{self.path.name}: damaged chunk at byte {chunk.offset}: {error}')
        return replace(chunk, counts=counts, start_ns=min(times, default=0),
                       end_ns=max(times, default=0))

    def recording(self) -> Recording:
        totals: Counter[int] = Counter()
        for chunk in self.chunks.values():
            totals.update(chunk.counts or {})
        connections = tuple(replace(connection, count=totals[number])
                            for number, connection in self.connections.items())
        path, chunks = self.path, tuple(self.chunks.values())

        def rows(wanted: Collection[int], note: Note) -> Iterator[Row]:
            return _read(path, chunks, frozenset(wanted), note)

        return Recording(connections, *span(chunks), rows, tuple(self.notes))


def _read(path: Path, chunks: tuple[Chunk, ...], wanted: frozenset[int], note: Note
          ) -> Iterator[Row]:
    with path.open('rb') as file:
        def rows(chunk: Chunk) -> list[Row]:
            found: list[Row] = []
            try:
                for header, data in _records(_content(file, chunk)):
                    if header[b'op'] == _MESSAGE:
                        (number,) = _U32.unpack(header[b'conn'])
                        if number in wanted:
                            log_ns = _time(header[b'time'])
                            found.append((log_ns, log_ns, number, data))
            except (struct.error, KeyError, ValueError) as error:
                note(f'{path.name}: damaged chunk at byte {chunk.offset}: {error}')
            return found

        yield from rows_in_order([c for c in chunks if c.holds(wanted)], rows)


def _records(content: bytes) -> Iterator[tuple[Header, memoryview]]:
    view = memoryview(content)
    position = 0
    while position < len(content):
        (length,) = _U32.unpack_from(content, position)
        start = position + 4 + length
        header = _fields(content[position + 4:start])
        (size,) = _U32.unpack_from(content, start)
        position = start + 4 + size
        if position > len(content):
            raise ValueError('a record is longer than its chunk')
        yield header, view[start + 4:position]


def _fields(data: bytes) -> Header:
    fields: Header = {}
    position = 0
    while position < len(data):
        (length,) = _U32.unpack_from(data, position)
        position += 4 + length
        name, _, value = data[position - length:position].partition(b'=')
        fields[name] = value
    return fields


def _content(file: BinaryIO, chunk: Chunk) -> bytes:
    file.seek(chunk.offset)
    try:
        return _DECOMPRESS[chunk.compression](file.read(chunk.size))
    except (RuntimeError, OSError, EOFError, MemoryError) as error:
        raise ValueError(f'{chunk.compression}: {error}') from None


def _time(value: bytes) -> int:
    seconds, nanoseconds = _TIME.unpack(value)
    return int(seconds) * 10**9 + int(nanoseconds)


def _topic(name: bytes) -> str:
    # Some recorders double the slashes of a namespace.
    text = '/'.join(part for part in name.decode(errors='replace').split('/') if part)
    return f'/{text}' if name[:1] == b'/' else text
