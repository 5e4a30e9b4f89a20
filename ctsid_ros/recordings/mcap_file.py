# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, sound or damaged (https://mcap.dev/spec).

One way of reading for all of them: the records of the file are visited in sequence, stepping
over the content of chunks. The summary at the end is but further records, so files without it,
without index, or cut off anywhere need no special case: whatever is complete is read. Counts
come from the message indexes that follow the chunks; where those are missing, disagree with the
statistics, or the file was not closed, the chunks themselves are read. A summary is believed as
far as its checksum, or a copy elsewhere in the file, says the same.
"""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
import io
from pathlib import Path
import struct
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics
import numpy as np

from ctsid_ros.decoding.block import Content
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.chunks import NO_CHECKSUMS, Chunk, Room, plausible, span
from ctsid_ros.recordings.mcap_chunks import COMPRESSIONS, content_of, read, sums, where
from ctsid_ros.recordings.mcap_content import RECORD, Messages, walk
from ctsid_ros.recordings.recording import Connection, Recording

MAGIC = b'\x89MCAP0\r\n'
_CHUNK = struct.Struct('<qqQII')  # start, end, full size, CRC, length of the compression's name
_INDEX = struct.Struct('<HI')  # channel, bytes that follow: 16 per message
_MESSAGE = struct.Struct('<HIqq')  # channel, sequence, log time, publish time
_INDEXES = 1 << 13  # bytes: 4 and 16 KB take longer
_LOOSE_SIZE = 1 << 20  # messages outside of chunks are read in blocks of about this size


def scan_mcap(path: Path, resources: ExitStack) -> Recording:
    """
    Read what an MCAP file contains.

    Raises
    ------
    BagError
        If nothing of it can be read.
    """
    # A few bytes are read of each record; the indexes behind a chunk lie together.
    with path.open('rb', buffering=_INDEXES) as file:
        scan = _Scan(path, file)
        scan.records()
        scan.known_compression()
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
        self.known: set[int] = set()  # channels whose definitions can be believed
        self.stated: dict[int, ChunkIndex] = {}  # chunks by position, in the summary
        self.starts: dict[int, int] = {}  # positions of chunks by that of their content
        self.in_summary = self.closed = False
        self.whole: tuple[int, int] | None = None  # first and last log time, by a checked summary
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
            if opcode == 0:
                break
            try:
                if end > size:
                    if opcode == Opcode.CHUNK:
                        self.chunk(position + RECORD.size, end, size)
                    break
                if opcode == Opcode.MESSAGE.value:
                    channel, _, log_ns, _ = _MESSAGE.unpack_from(head, RECORD.size)
                    self.loose_message(position, end, channel, log_ns)
                elif opcode == Opcode.MESSAGE_INDEX.value:
                    self.message_index(head, end)
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
            self.chunk(start, end, end)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.define(opcode, self.file.read(end - start))
        elif opcode == Opcode.STATISTICS:
            self.statistics = Statistics.read(self.stream(end - start))
        elif opcode == Opcode.CHUNK_INDEX:
            index = ChunkIndex.read(self.stream(end - start))
            self.stated[index.chunk_start_offset] = index
        elif opcode == Opcode.DATA_END:
            self.in_summary = True
        elif opcode == Opcode.FOOTER:
            self.closed = True
            self.footer(Footer.read(self.stream(end - start)), start, end)

    def stream(self, size: int) -> ReadDataStream:
        return ReadDataStream(io.BytesIO(self.file.read(size)))

    def footer(self, footer: Footer, start: int, end: int) -> None:
        """Compare the summary with its checksum."""
        if not footer.summary_crc:
            return
        first = footer.summary_start or start - RECORD.size
        self.file.seek(min(first, end))  # it may say any number
        summary = self.file.read(max(end - 4 - first, 0))
        if sums.crc32(summary) == footer.summary_crc:
            self.known = set(self.channels)
            if self.statistics:
                self.whole = (self.statistics.message_start_time,
                              self.statistics.message_end_time)
            return
        self.notes.append(f'{self.path.name}: its summary is damaged: the file was read anew')
        self.statistics = None
        self.stated.clear()
        self.index_ends.clear()
        self.chunks = [replace(chunk, counts=None) for chunk in self.chunks]

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
                channel for _, _, channel, _ in self.loose), plausible(
                    np.array([row[3] for row in self.loose], np.int64))
            self.chunks.append(Chunk(first, end - first, '', int(np.min(times)),
                                     int(np.max(times)), counts))
            self.loose.clear()

    def chunk(self, start: int, end: int, limit: int) -> None:
        """Note a chunk that ends at `end`, or where the file ends."""
        self.file.seek(start)
        start_ns, end_ns, full_size, crc, length = _CHUNK.unpack(self.file.read(_CHUNK.size))
        compression = self.file.read(min(length, 32)).decode()
        if len(compression) < length or not compression.isprintable():
            raise ValueError('that is no name of a compression')
        (size,) = struct.unpack('<Q', self.file.read(8))
        offset = start + _CHUNK.size + length + 8
        if offset + size > end:
            raise ValueError('the content of a chunk is longer than its record')
        self.index = Counter()
        self.starts[offset] = start - RECORD.size
        cut = offset + size > limit
        self.chunks.append(Chunk(
            offset, max(min(size, limit - offset), 0), compression, start_ns, end_ns, self.index,
            full_size, 0 if cut else crc, cut=cut))

    def message_index(self, head: bytes, end: int) -> None:
        self.end_loose()
        channel, size = _INDEX.unpack_from(head, RECORD.size)
        self.index[channel] += size // 16
        self.index_ends[len(self.chunks) - 1] = end

    def define(self, opcode: int, data: bytes) -> None:
        """Take a schema or channel; copies in the summary do not count where there is another."""
        stream = ReadDataStream(io.BytesIO(data))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            if not self.in_summary or schema.id not in self.schemas:
                self.schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            if not self.in_summary:
                self.known.add(channel.id)
            if not self.in_summary or channel.id not in self.channels:
                self.channels[channel.id] = channel

    def known_compression(self) -> None:
        """Refuse a file that is compressed in another way; of one chunk it is damage."""
        unknown = [c.compression for c in self.chunks if c.compression not in COMPRESSIONS]
        if unknown and len(unknown) == len(self.chunks):
            raise BagError(f'{self.path}: chunks are compressed with {unknown[0]!r}; ctsid reads '
                           'lz4, zstd and none: convert the bag with `mcap compress`')

    def contents(self) -> None:
        """Read those chunks of which the records of the file tell too little, or may lie."""
        for number, end in self.index_ends.items():
            chunk = self.chunks[number]
            self.chunks[number] = replace(chunk, index_size=end - chunk.offset - chunk.size)
        self.in_summary = False
        stated = self.statistics.message_count if self.statistics else None
        listed = sum(sum(chunk.counts.values()) for chunk in self.chunks if chunk.counts)
        lies = not self.closed or (stated is not None and stated != listed)
        self.chunks = [self.read_anew(chunk) if lies or not self.believed(chunk) else chunk
                       for chunk in self.chunks]
        self.chunks = [self.limited(chunk) for chunk in self.chunks if chunk.counts]
        found = sum(sum(chunk.counts.values()) for chunk in self.chunks if chunk.counts)
        if not self.closed:
            self.truncated(found)
        elif stated is not None and stated != found:
            self.notes.append(f'{self.path.name}: its statistics state {stated} messages, {found} '
                              'are there')

    def limited(self, chunk: Chunk) -> Chunk:
        """Leave out times that a checked summary excludes, where messages have no checksum."""
        if chunk.crc or not self.whole:
            return chunk
        return replace(chunk, start_ns=max(chunk.start_ns, self.whole[0]),
                       end_ns=min(chunk.end_ns, self.whole[1]))

    def believed(self, chunk: Chunk) -> bool:
        """Whether channels and times of a chunk are known, and those that it must have."""
        if not chunk.counts or not chunk.counts.keys() <= self.known:
            return False
        start = self.starts.get(chunk.offset)
        if start is None:  # messages outside of chunks have told their own times
            return True
        span_ns, stated = (chunk.start_ns, chunk.end_ns), self.stated.get(start)
        stated_ns = (stated.message_start_time, stated.message_end_time) if stated else None
        whole = (self.statistics.message_start_time, self.statistics.message_end_time) \
            if self.statistics else stated_ns or (0, 0)
        indexed = stated.message_index_offsets.keys() if stated else set()
        return (stated_ns in (None, span_ns) and (not indexed or indexed == chunk.counts.keys())
                and whole[0] <= span_ns[0] <= span_ns[1] <= whole[1])

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
            content = content_of(self.file, chunk, Room()).content
            places = walk(content, self.define).messages
        except (McapError, ValueError, struct.error) as error:
            self.notes.append(f'{self.path.name}: {where(chunk, error)}')
        heads = Messages.at(content, 0, len(content), places).heads
        numbers, counts = np.unique(heads['channel'], return_counts=True)
        times = heads['log'] if chunk.crc else plausible(heads['log'])
        return replace(chunk, counts=dict(zip(numbers.tolist(), counts.tolist(), strict=True)),
                       start_ns=int(np.min(times)) if len(times) else 0,
                       end_ns=int(np.max(times)) if len(times) else 0, index_size=0)

    def recording(self) -> Recording:
        totals: Counter[int] = Counter()
        for chunk in self.chunks:
            totals.update(chunk.counts or {})
        orphans = sum(totals[c] for c in totals.keys() - self.channels.keys())
        if orphans:
            self.notes.append(f'{self.path.name}: {orphans} messages of unknown topics skipped')
        if self.notes and not all(chunk.crc or chunk.cut for chunk in self.chunks):
            self.notes.append(f'{self.path.name}: {NO_CHECKSUMS}')
        connections = tuple(self.connection(channel, totals[channel.id])
                            for channel in self.channels.values())
        return Recording(connections, *span(self.chunks),
                         partial(read, self.path, tuple(self.chunks)), tuple(self.notes))

    def connection(self, channel: Channel, count: int) -> Connection:
        schema = self.schemas.get(channel.schema_id)
        return Connection(
            channel.id, channel.topic, schema.name if schema else '', channel.message_encoding,
            schema.encoding if schema else '',
            schema.data.decode(errors='replace') if schema else '', count)
