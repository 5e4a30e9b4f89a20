# SPDX-License-Identifier: Apache-2.0
"""Chunks of MCAP files: decompressed, compared with their checksums, their messages found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import os
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard

from ctsid_ros.decoding.block import Block, Located
from ctsid_ros.recordings.chunks import (
    NO_CHECKSUMS,
    NOTHING,
    Chunk,
    Held,
    Room,
    blocks_in_order,
    fill,
)
from ctsid_ros.recordings.mcap_content import Source, locate
from ctsid_ros.recordings.recording import Note, Wanted

try:  # the same sums as zlib's, with the instructions that processors have for them
    from isal import isal_zlib as sums
except ImportError:
    import zlib as sums  # type: ignore[no-redef]

__all__ = ['COMPRESSIONS', 'DamagedError', 'content_of', 'read', 'sums', 'where']
COMPRESSIONS = ('', 'lz4', 'zstd')


class DamagedError(ValueError):
    """A chunk that cannot be read."""


class _Loaded(NamedTuple):
    """Content and index of a chunk; or why it cannot be read."""

    held: Held
    entries: bytes = b''
    problem: str = ''


def read(path: Path, chunks: tuple[Chunk, ...], wanted: Wanted, note: Note) -> Iterator[Block]:
    """Yield the messages of the chunks of a file, and note what is damaged."""
    def load(chunk: Chunk, room: Room) -> _Loaded:
        try:
            return _Loaded(content_of(file, chunk, room), os.pread(
                file.fileno(), chunk.index_size, chunk.offset + chunk.size))
        except DamagedError as error:
            return _Loaded(NOTHING, problem=where(chunk, error))

    def found(batch: Sequence[Chunk], loaded: Sequence[_Loaded]) -> list[Located]:
        located, counts = locate([
            Source(one.held, one.entries, None if chunk.crc else (chunk.start_ns, chunk.end_ns))
            for chunk, one in zip(batch, loaded, strict=True)], wanted.slots)
        for chunk, one, count in zip(batch, loaded, counts, strict=True):
            missing = chunk.count(wanted.slots) - count
            if one.problem:
                note(f'{path.name}: {one.problem}')
            elif missing > 0:
                note(f'{path.name}: chunk at byte {chunk.offset} is damaged inside: {missing} of '
                     'its messages are lost' + ('' if chunk.crc else f'; {NO_CHECKSUMS}'))
        return located

    with path.open('rb') as file:
        yield from blocks_in_order(chunks, wanted, load, found)


def content_of(file: BinaryIO, chunk: Chunk, room: Room) -> Held:
    """
    Return the content of a chunk; of one that the end of the file has cut off, what is there.

    Raises
    ------
    DamagedError
        If it cannot be decompressed, or is not what its checksum says.
    """
    try:
        held = _decompressed(file, chunk, room)
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError) as error:
        raise DamagedError(f'{chunk.compression}: {error}') from None
    if chunk.crc and sums.crc32(held.content) != chunk.crc:
        raise DamagedError('its CRC does not match')
    return held


def _decompressed(file: BinaryIO, chunk: Chunk, room: Room) -> Held:
    if not chunk.compression:
        held = room.content(chunk.size)
        fill(held.content, file, chunk.offset)
        return held
    packed = fill(room.packed(chunk.size), file, chunk.offset)
    if chunk.compression not in COMPRESSIONS:
        raise ValueError('there is no such compression')
    if chunk.cut:
        unpacker = lz4.frame.LZ4FrameDecompressor() if chunk.compression == 'lz4' else \
            zstandard.ZstdDecompressor().decompressobj()
        return room.copy(unpacker.decompress(packed))
    if chunk.compression == 'lz4':
        return room.copy(lz4.frame.decompress(packed))
    if zstandard.frame_content_size(packed) not in (-1, chunk.full_size):
        raise ValueError('its size is not the one that is stated')
    held = room.content(chunk.full_size)
    with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
        size = reader.readinto(held.content)
    return held._replace(end=held.start + size)


def where(chunk: Chunk, error: Exception) -> str:
    """Say which chunk is lost, and why."""
    count = sum((chunk.counts or {}).values())
    lost = f' ({count} messages lost)' if count else ''
    return f'damaged chunk at byte {chunk.offset} skipped{lost}: {error}'
