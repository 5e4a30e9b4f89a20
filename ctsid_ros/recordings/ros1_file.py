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
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
import io
from pathlib import Path
import struct
from typing import Any, BinaryIO

import lz4.frame
import numpy as np

from ctsid_ros.decoding.block import Block, Content, Located
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.chunks import (
    NO_CHECKSUMS,
    YEAR,
    Chunk,
    Room,
    blocks_in_order,
    fill,
    plausible,
    span,
    within,
)
from ctsid_ros.recordings.recording import Connection, Note, Recording, Wanted
from ctsid_ros.recordings.ros1_content import (
    CONNECTION,
    U32,
    Header,
    fields,
    locate,
    messages,
    time_ns,
)

MAGIC = b'#ROSBAG V'
_VERSION = b'#ROSBAG V2.0\n'
_BAG_HEADER, _CHUNK, _CHUNK_INFO = b'\3', b'\5', b'\6'
_U64 = struct.Struct('<Q')
_DECOMPRESS: dict[str, Callable[[memoryview], Content]] = {
    'none': lambda data: data, 'bz2': bz2.decompress, 'lz4': lz4.frame.decompress}
_CUT: dict[str, Callable[[], Any]] = {'bz2': bz2.BZ2Decompressor,
                                      'lz4': lz4.frame.LZ4FrameDecompressor}


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
        scan.known_compression()
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
                    if header[b'op'] == _CHUNK:  # its first records may be complete
                        self.record(header, position, data, size - data)
                        self.chunks[position] = replace(self.chunks[position], cut=True)
                    return
                self.record(header, position, data, data_size)
            except (struct.error, KeyError, ValueError, IndexError):
                return
            position = data + data_size
        self.complete = True

    def header(self, size: int) -> tuple[Header, int]:
        (length,) = U32.unpack(self.file.read(4))
        if self.file.tell() + length > size:
            raise ValueError('a header is longer than the file')
        header = fields(self.file.read(length))
        return header, U32.unpack(self.file.read(4))[0]

    def record(self, header: Header, position: int, data: int, size: int) -> None:
        kind = header[b'op']
        if kind == _CHUNK:
            compression = header[b'compression'].decode()
            self.chunks[position] = Chunk(data, size, compression,
                                          full_size=U32.unpack(header[b'size'])[0])
        elif kind == _BAG_HEADER:
            if header.get(b'encryptor'):
                raise BagError(f'{self.path}: the bag is encrypted; decrypt it with '
                               '`rosbag decrypt`')
            if _U64.unpack(header[b'index_pos'])[0]:
                self.stated_chunks = U32.unpack(header[b'chunk_count'])[0]
        elif kind == CONNECTION:
            self.connect(header, self.file.read(size))
        elif kind == _CHUNK_INFO:
            self.chunk_info(header, self.file.read(size))

    def connect(self, header: Header, data: bytes) -> None:
        (number,) = U32.unpack(header[b'conn'])
        declared = fields(data)
        self.connections[number] = Connection(
            number, _topic(header[b'topic']), declared[b'type'].decode(), 'ros1', 'ros1msg',
            declared[b'message_definition'].decode(errors='replace'), 0)

    def chunk_info(self, header: Header, data: bytes) -> None:
        (position,) = _U64.unpack(header[b'chunk_pos'])
        self.chunks[position] = replace(
            self.chunks[position], counts=dict(struct.iter_unpack('<II', data)),
            start_ns=time_ns(header[b'start_time']), end_ns=time_ns(header[b'end_time']))

    def known_compression(self) -> None:
        """Refuse a bag that is compressed in another way; of one chunk it is damage."""
        unknown = [chunk.compression for chunk in self.chunks.values()
                   if chunk.compression not in _DECOMPRESS]
        if unknown and len(unknown) == len(self.chunks):
            raise BagError(f'{self.path}: chunks are compressed with {unknown[0]!r}; ctsid reads '
                           'lz4, bz2 and none: convert the bag with `rosbag compress`')

    def contents(self) -> None:
        """Read those chunks of which the index tells nothing, or what cannot be."""
        starts = [chunk.start_ns for chunk in self.chunks.values() if chunk.counts is not None]
        known = set(plausible(np.array(starts, np.int64)).tolist())
        self.chunks = {position: chunk if chunk.counts is not None and chunk.start_ns in known
                       and 0 <= chunk.end_ns - chunk.start_ns < YEAR else self.read_anew(chunk)
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
            content = _content(self.file, chunk, Room())
            found = messages(content, self.connect)
            counts.update(found.connections.tolist())
            times = plausible(found.log_ns).tolist()
            if found.problem:
                self.notes.append(f'{self.path.name}: damaged chunk at byte {chunk.offset}: '
                                  f'{found.problem}')
        except ValueError as error:
            self.notes.append(f'{self.path.name}: damaged chunk at byte {chunk.offset}: {error}')
        return replace(chunk, counts=counts, start_ns=min(times, default=0),
                       end_ns=max(times, default=0))

    def recording(self) -> Recording:
        totals: Counter[int] = Counter()
        for chunk in self.chunks.values():
            totals.update(chunk.counts or {})
        connections = tuple(replace(connection, count=totals[number])
                            for number, connection in self.connections.items())
        if self.notes:
            self.notes.append(f'{self.path.name}: {NO_CHECKSUMS}')
        chunks = tuple(self.chunks.values())
        return Recording(connections, *span(chunks), partial(_read, self.path, chunks),
                         tuple(self.notes))


def _read(path: Path, chunks: tuple[Chunk, ...], wanted: Wanted, note: Note) -> Iterator[Block]:
    def load(chunk: Chunk, room: Room) -> Content | ValueError:
        try:
            return _content(file, chunk, room)
        except ValueError as error:
            return error

    def found(batch: Sequence[Chunk], contents: Sequence[Content | ValueError]) -> list[Located]:
        return [part for row in zip(batch, contents, strict=True) for part in found_in(*row)]

    def found_in(chunk: Chunk, content: Content | ValueError) -> list[Located]:
        located, problem = ([], str(content)) if isinstance(content, ValueError) else locate(
            content, wanted.slots)
        located = [within(chunk, part) for part in located]
        missing = chunk.count(wanted.slots) - sum(len(part.offsets) for part in located)
        if missing > 0:
            note(f'{path.name}: damaged chunk at byte {chunk.offset}: {missing} of its messages '
                 f'are lost{problem and f" ({problem})"}; {NO_CHECKSUMS}')
        return located

    with path.open('rb') as file:
        yield from blocks_in_order(chunks, wanted, load, found)


def _content(file: BinaryIO, chunk: Chunk, room: Room) -> Content:
    packed = room.content(chunk.size).content if chunk.compression == 'none' else \
        room.packed(chunk.size)
    fill(packed, file, chunk.offset)
    if chunk.compression not in _DECOMPRESS:
        raise ValueError(f'there is no compression {chunk.compression!r}')
    try:
        if chunk.cut and chunk.compression in _CUT:
            return bytes(_CUT[chunk.compression]().decompress(packed))
        return _DECOMPRESS[chunk.compression](packed)
    except (RuntimeError, OSError, EOFError, MemoryError) as error:
        raise ValueError(f'{chunk.compression}: {error}') from None


def _topic(name: bytes) -> str:
    # Some recorders double the slashes of a namespace.
    text = '/'.join(part for part in name.decode(errors='replace').split('/') if part)
    return f'/{text}' if name[:1] == b'/' else text
