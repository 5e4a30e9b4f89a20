# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, sound or damaged (https://mcap.dev/spec).

One way of reading for all of them: the records of the file are visited in sequence, stepping
over the content of chunks. The summary at the end is but further records, so files without it,
without index, or cut off anywhere need no special case: whatever is complete is read. Counts
come from the message indexes that follow the chunks; where those are missing, disagree with the
statistics, or the file was not closed, the chunks themselves are read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
import io
import os
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics
import numpy as np
import zstandard

from ctsid_ros.decoding.block import Block, Content, Located
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.mcap_content import RECORD, Messages, locate, walk
from ctsid_ros.recordings.recording import (
    Chunk,
    Connection,
    Note,
    Recording,
    Room,
    Wanted,
    blocks_in_order,
    span,
)

MAGIC = b'\x89MCAP0\r\n'
_CHUNK = struct.Struct('<qqQII')  # start, end, full size, CRC, length of the compression's name
_INDEX = struct.Struct('<HI')  # channel, bytes that follow: 16 per message
_MESSAGE = struct.Struct('<HIqq')  # channel, sequence, log time, publish time
_LOOSE_SIZE = 1 << 20  # messages outside of chunks are read in blocks of about this size
_COMPRESSIONS = ('', 'lz4', 'zstd')


class _DamagedError(ValueError):
    """A chunk that cannot be read."""


def scan_mcap(path: Path, resources: ExitStack) -> Recording:
    """
    Read what an MCAP file contains.

    Raises
    ------
    BagError
        If nothing of it can be read.
    """
    with path.open('rb') as file:
        scan = _Scan(path, file)
        scan.records()
        scan.contents()
        return scan.recording()


class _Scan:
    """The pass over a file at its opening; a builder of its `Recording`."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.chunks: list[Chunk] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.statistics: Statistics | None = None
        self.closed = False
        self.loose: list[tuple[int, int, int, int]] = []  # start, end, channel, log time
        self.index: Counter[int] = Counter()  # what indexes say of the last chunk
        self.index_ends: dict[int, int] = {}  # where the indexes of each chunk end
        self.notes: list[str] = []

    def records(self) -> None:
        """Visit all records of the file, as far as they are complete."""
        size = self.file.seek(0, io.SEEK_END)
        position = len(MAGIC)
        while not self.closed and position + RECORD.size <= size:
            self.file.seek(position)
            head = self.file.read(RECORD.size + _MESSAGE.size)
            opcode, length = RECORD.unpack_from(head)
            end = position + RECORD.size + length
            if opcode == 0:
                self.zeros_at(position)
            if opcode == 0 or end > size:
                break
            try:
                if opcode == Opcode.MESSAGE.value:
                    channel, _, log_ns, _ = _MESSAGE.unpack_from(head, RECORD.size)
                    self.loose_message(position, end, channel, log_ns)
                else:
                    self.record(opcode, position + RECORD.size, end)
            except (McapError, ValueError, struct.error):
                break
            position = end
        self.end_loose()

    def loose_message(self, position: int, end: int, channel: int, log_ns: int) -> None:
        if self.loose and end - self.loose[0][0] > _LOOSE_SIZE:
            self.end_loose()
        self.loose.append((position, end, channel, log_ns))

    def record(self, opcode: int, start: int, end: int) -> None:
        self.file.seek(start)
        self.end_loose()
        if opcode == Opcode.CHUNK:
            self.chunk(start, end)
        elif opcode == Opcode.MESSAGE_INDEX:
            self.message_index(end)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            self.define(opcode, self.file.read(end - start))
        elif opcode == Opcode.FOOTER:
            self.closed = True

    def zeros_at(self, position: int) -> None:
        """Drop the message before the zeros at the end of a file: they may begin within it."""
        if self.loose:
            self.loose.pop()
        elif self.chunks and self.chunks[-1].offset + self.chunks[-1].size == position:
            last = self.chunks[-1]
            if not last.compression and not last.crc:
                self.chunks[-1] = replace(last, size=last.size - 1)  # one message less complete

    def end_loose(self) -> None:
        """Make a chunk of the messages outside of chunks that were visited last."""
        if self.loose:
            first, end, counts, times = self.loose[0][0], self.loose[-1][1], Counter(
                channel for _, _, channel, _ in self.loose), [row[3] for row in self.loose]
            self.chunks.append(Chunk(first, end - first, '', min(times), max(times), counts))
            self.loose.clear()

    def chunk(self, start: int, end: int) -> None:
        start_ns, end_ns, full_size, crc, length = _CHUNK.unpack(self.file.read(_CHUNK.size))
        compression = self.file.read(min(length, 32)).decode()
        if length > 32 or not compression.isprintable():
            raise ValueError('that is no name of a compression')
        if compression not in _COMPRESSIONS:
            raise BagError(f'{self.path}: chunks are compressed with {compression!r}; ctsid reads '
                           'lz4, zstd and none: convert the bag with `mcap compress`')
        (size,) = struct.unpack('<Q', self.file.read(8))
        offset = start + _CHUNK.size + length + 8
        if offset + size > end:
            raise ValueError('the content of a chunk is longer than its record')
        self.index = Counter()
        self.chunks.append(Chunk(offset, size, compression, start_ns, end_ns, self.index,
                                 full_size, crc))

    def message_index(self, end: int) -> None:
        channel, size = _INDEX.unpack(self.file.read(_INDEX.size))
        self.index[channel] += size // 16
        self.index_ends[len(self.chunks) - 1] = end

    def define(self, opcode: int, data: bytes) -> None:
        stream = ReadDataStream(io.BytesIO(data))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self.channels[channel.id] = channel
        else:
            self.statistics = Statistics.read(stream)

    def contents(self) -> None:
        """Read those chunks of which the records of the file tell too little, or may lie."""
        for number, end in self.index_ends.items():
            chunk = self.chunks[number]
            self.chunks[number] = replace(chunk, index_size=end - chunk.offset - chunk.size)
        stated = self.statistics.message_count if self.statistics else None
        listed = sum(sum(chunk.counts.values()) for chunk in self.chunks if chunk.counts)
        if not self.closed or (stated is not None and stated != listed):
            self.chunks = [self.read_anew(chunk) for chunk in self.chunks]
        else:
            self.chunks = [chunk if chunk.counts and chunk.counts.keys() <= self.channels.keys()
                           else self.read_anew(chunk) for chunk in self.chunks]
        self.chunks = [chunk for chunk in self.chunks if chunk.counts]
        found = sum(sum(chunk.counts.values()) for chunk in self.chunks if chunk.counts)
        if not self.closed:
            self.truncated(found)
        elif stated is not None and stated != found:
            self.notes.append(f'{self.path.name}: its statistics state {stated} messages, {found} '
                              'are there')

    def truncated(self, found: int) -> None:
        if not found:
            raise BagError(f'{self.path}: the file is cut off or damaged before its first '
                           'complete block of messages; nothing can be recovered')
        self.notes.append(f'{self.path.name}: truncated: {found} messages recovered (the recorder '
                          'did not close the file)')

    def read_anew(self, chunk: Chunk) -> Chunk:
        """Find counts, times and definitions in the content of a chunk; trust no index of it."""
        content: Content = b''
        places = np.empty(0, np.intp)
        try:
            content = _content(self.file, chunk, Room())
            places, _ = walk(content, self.define)
        except (McapError, ValueError, struct.error) as error:
            self.notes.append(f'{self.path.name}: {_where(chunk, error)}')
        heads = Messages.at(content, places).heads
        numbers, counts = np.unique(heads['channel'], return_counts=True)
        return replace(chunk, counts=dict(zip(numbers.tolist(), counts.tolist(), strict=True)),
                       start_ns=int(heads['log'].min(initial=2**63 - 1)) if len(heads) else 0,
                       end_ns=int(heads['log'].max(initial=-2**63)) if len(heads) else 0,
                       index_size=0)

    def recording(self) -> Recording:
        totals: Counter[int] = Counter()
        for chunk in self.chunks:
            totals.update(chunk.counts or {})
        orphans = sum(totals[c] for c in totals.keys() - self.channels.keys())
        if orphans:
            self.notes.append(f'{self.path.name}: {orphans} messages of unknown topics skipped')
        connections = tuple(self.connection(channel, totals[channel.id])
                            for channel in self.channels.values())
        return Recording(connections, *span(self.chunks),
                         partial(_read, self.path, tuple(self.chunks)), tuple(self.notes))

    def connection(self, channel: Channel, count: int) -> Connection:
        schema = self.schemas.get(channel.schema_id)
        return Connection(
            channel.id, channel.topic, schema.name if schema else '', channel.message_encoding,
            schema.encoding if schema else '',
            schema.data.decode(errors='replace') if schema else '', count)


class _Loaded(NamedTuple):
    """Content and index of a chunk; or why it cannot be read."""

    content: Content
    entries: bytes = b''
    problem: str = ''


def _read(path: Path, chunks: tuple[Chunk, ...], wanted: Wanted, note: Note) -> Iterator[Block]:
    def load(chunk: Chunk, room: Room) -> _Loaded:
        try:
            return _Loaded(_content(file, chunk, room), os.pread(
                file.fileno(), chunk.index_size, chunk.offset + chunk.size))
        except _DamagedError as error:
            return _Loaded(b'', problem=_where(chunk, error))

    def found(chunk: Chunk, loaded: _Loaded) -> list[Located]:
        if loaded.problem:
            note(f'{path.name}: {loaded.problem}')
            return []
        located = locate(loaded.content, loaded.entries, wanted.slots, checked=chunk.crc != 0)
        missing = chunk.count(wanted.slots) - sum(len(part.offsets) for part in located)
        if missing > 0:
            note(f'{path.name}: chunk at byte {chunk.offset} is damaged inside: {missing} of its '
                 f'messages are lost' + ('' if chunk.crc else '; the file has no checksums, so '
                                         'others may be false'))
        return located

    with path.open('rb') as file:
        yield from blocks_in_order(chunks, wanted, load, found)


def _content(file: BinaryIO, chunk: Chunk, room: Room) -> memoryview:
    try:
        data = _decompressed(file, chunk, room)
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError) as error:
        raise _DamagedError(f'{chunk.compression}: {error}') from None
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise _DamagedError('its CRC does not match')
    return data


def _decompressed(file: BinaryIO, chunk: Chunk, room: Room) -> memoryview:
    packed = room.packed(chunk.size) if chunk.compression else room.content(chunk.size)
    os.preadv(file.fileno(), [packed], chunk.offset)  # several threads share the file
    if not chunk.compression:
        return packed
    if chunk.compression == 'lz4':
        return memoryview(lz4.frame.decompress(packed))
    if zstandard.frame_content_size(packed) not in (-1, chunk.full_size):
        raise ValueError('its size is not the one that is stated')
    content = room.content(chunk.full_size)
    with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
        size = reader.readinto(content)
    return content[:size]


def _where(chunk: Chunk, error: Exception) -> str:
    count = sum((chunk.counts or {}).values())
    lost = f' ({count} messages lost)' if count else ''
    return f'damaged chunk at byte {chunk.offset} skipped{lost}: {error}'
