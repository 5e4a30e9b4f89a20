# SPDX-License-Identifier: Apache-2.0
"""Chunks of MCAP files: decompressed, compared with their checksums, their messages found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import os
from pathlib import Path
from typing import BinaryIO, NamedTuple
import zlib

import lz4.frame
import zstandard

from ctsid_ros.decoding.block import Block, Content, Located
from ctsid_ros.recordings.chunks import NO_CHECKSUMS, Chunk, Room, blocks_in_order, fill, within
from ctsid_ros.recordings.mcap_content import Source, locate
from ctsid_ros.recordings.recording import Note, Wanted

COMPRESSIONS = ('', 'lz4', 'zstd')


class DamagedError(ValueError):
    """A chunk that cannot be read."""


class _Loaded(NamedTuple):
    """Content and index of a chunk; or why it cannot be read."""

    content: Content
    entries: bytes = b''
    problem: str = ''


def read(path: Path, chunks: tuple[Chunk, ...], wanted: Wanted, note: Note) -> Iterator[Block]:
    """Yield the messages of the chunks of a file, and note what is damaged."""
    def load(chunk: Chunk, room: Room) -> _Loaded:
        try:
            return _Loaded(content_of(file, chunk, room), os.pread(
                file.fileno(), chunk.index_size, chunk.offset + chunk.size))
        except DamagedError as error:
            return _Loaded(b'', problem=where(chunk, error))

    def found(batch: Sequence[Chunk], loaded: Sequence[_Loaded]) -> list[Located]:
        located = locate([Source(one.content, one.entries, checked=chunk.crc != 0)
                          for chunk, one in zip(batch, loaded, strict=True)], wanted.slots)
        return [part for row in zip(batch, loaded, located, strict=True) for part in checked(*row)]

    def checked(chunk: Chunk, loaded: _Loaded, located: list[Located]) -> list[Located]:
        if not chunk.crc:
            located = [within(chunk, part) for part in located]
        missing = chunk.count(wanted.slots) - sum(len(part.offsets) for part in located)
        if loaded.problem:
            note(f'{path.name}: {loaded.problem}')
        elif missing > 0:
            note(f'{path.name}: chunk at byte {chunk.offset} is damaged inside: {missing} of its '
                 'messages are lost' + ('' if chunk.crc else f'; {NO_CHECKSUMS}'))
        return located

    with path.open('rb') as file:
        yield from blocks_in_order(chunks, wanted, load, found)


def content_of(file: BinaryIO, chunk: Chunk, room: Room) -> Content:
    """
    Return the content of a chunk; of one that the end of the file has cut off, what is there.

    Raises
    ------
    DamagedError
        If it cannot be decompressed, or is not what its checksum says.
    """
    try:
        data = _decompressed(file, chunk, room)
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError) as error:
        raise DamagedError(f'{chunk.compression}: {error}') from None
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise DamagedError('its CRC does not match')
    return data


def _decompressed(file: BinaryIO, chunk: Chunk, room: Room) -> Content:
    packed = room.packed(chunk.size) if chunk.compression else room.content(chunk.size)
    fill(packed, file, chunk.offset)
    if not chunk.compression:
        return packed
    if chunk.compression not in COMPRESSIONS:
        raise ValueError('there is no such compression')
    if chunk.cut:
        unpacker = lz4.frame.LZ4FrameDecompressor() if chunk.compression == 'lz4' else \
            zstandard.ZstdDecompressor().decompressobj()
        return bytes(unpacker.decompress(packed))
    if chunk.compression == 'lz4':
        return bytes(lz4.frame.decompress(packed))
    if zstandard.frame_content_size(packed) not in (-1, chunk.full_size):
        raise ValueError('its size is not the one that is stated')
    content = room.content(chunk.full_size)
    with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
        size = reader.readinto(content)
    return content[:size]


def where(chunk: Chunk, error: Exception) -> str:
    """Say which chunk is lost, and why."""
    count = sum((chunk.counts or {}).values())
    lost = f' ({count} messages lost)' if count else ''
    return f'damaged chunk at byte {chunk.offset} skipped{lost}: {error}'
