# SPDX-License-Identifier: Apache-2.0
"""Chunks of files: read ahead by threads, and their messages put in the order of log time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from operator import attrgetter
import os
from typing import BinaryIO, NamedTuple, TypeVar

import numpy as np

from ctsid_ros.decoding.block import Block, Located, Stamps
from ctsid_ros.recordings.recording import Wanted

C = TypeVar('C')
_THREADS = 2  # that decompress while columns are made
_AHEAD = 2  # batches that they may be ahead
_SPARE = 8  # part of a chunk's size that is taken beyond it: the next may be a little larger
YEAR = 3.2e16  # ns: none lasts so long
NO_CHECKSUMS = 'it has no checksums, so what is false within messages cannot be told'
BATCH = 8 << 20  # bytes of content that are decoded at once: NumPy's calls cost nothing then


@dataclass(frozen=True)
class Chunk:
    """
    A block of messages that is read at once.

    Parameters
    ----------
    offset, size : int
        Where its (compressed) content lies in the file.
    compression : str
    start_ns, end_ns : int
        First and last log time.
    counts : mapping, optional
        Number of messages by connection; None if not known without reading.
    full_size, crc : int
        Size and CRC-32 of the content, not compressed; 0 where not known.
    index_size : int
        Bytes of the records that follow it and say where its messages lie.
    cut : bool
        Whether the end of the file has cut off the rest of it.
    """

    offset: int
    size: int
    compression: str = ''
    start_ns: int = 0
    end_ns: int = 0
    counts: Mapping[int, int] | None = None
    full_size: int = 0
    crc: int = 0
    index_size: int = 0
    cut: bool = False

    def holds(self, connections: Collection[int]) -> bool:
        """Whether any of the connections has, or may have, messages here."""
        return self.counts is None or any(self.counts.get(c) for c in connections)

    def count(self, connections: Collection[int]) -> int:
        """Return how many messages of the connections are said to be here."""
        return sum((self.counts or {}).get(c, 0) for c in connections)


def within(chunk: Chunk, part: Located) -> Located:
    """Drop messages with log times that the chunk does not have: they are damaged."""
    inside = (part.log_ns >= chunk.start_ns) & (part.log_ns <= chunk.end_ns)
    return part if inside.all() else Located(
        part.slot, part.content, *(column[inside] for column in part[2:6]))


def plausible(log_ns: Stamps) -> Stamps:
    """Return the log times that can be of one recording; others come from damage."""
    if not len(log_ns):
        return log_ns
    middle = np.partition(log_ns, len(log_ns) // 2)[len(log_ns) // 2]  # one of them, not between
    return log_ns[np.abs(log_ns - float(middle)) < YEAR]


def span(chunks: Sequence[Chunk]) -> tuple[int, int]:
    """Return first and last log time [ns] of all chunks; zeros if there are none."""
    return (min((c.start_ns for c in chunks), default=0),
            max((c.end_ns for c in chunks), default=0))


class Held(NamedTuple):
    """
    Content of a chunk, in memory that holds others beside it.

    Parameters
    ----------
    memory : memoryview
    start, end : int
    """

    memory: memoryview
    start: int
    end: int

    @property
    def content(self) -> memoryview:
        """The content alone."""
        return self.memory[self.start:self.end]


NOTHING = Held(memoryview(b''), 0, 0)


class Room:
    """
    Memory that the chunks of a batch are read into, side by side; used again for others.

    To take fresh memory for each of them from the system costs as much as to decompress it.
    """

    def __init__(self) -> None:
        self._packed = memoryview(bytearray())
        self._memories: list[memoryview] = []  # one, unless chunks are larger than expected
        self._filled, self._end = 0, 0  # memories that are full, and how far the next is

    def empty(self) -> Room:
        """Give up all contents."""
        self._filled, self._end = 0, 0
        return self

    def packed(self, size: int) -> memoryview:
        """Return memory for what is compressed, until the next call."""
        if len(self._packed) < size:
            self._packed = _memory(size)
        return self._packed[:size]

    def content(self, size: int) -> Held:
        """Return memory for the content of one more chunk, behind those before it."""
        while (self._filled < len(self._memories)
               and self._end + size > len(self._memories[self._filled])):
            self._filled, self._end = self._filled + 1, 0
        if self._filled == len(self._memories):
            self._memories.append(_memory(size + BATCH))
        start, self._end = self._end, self._end + size
        return Held(self._memories[self._filled], start, self._end)

    def copy(self, content: bytes) -> Held:
        """Return the content of one more chunk that came in memory of its own."""
        held = self.content(len(content))
        held.content[:] = content
        return held


def _memory(size: int) -> memoryview:
    """Return memory of at least this size; the next content may be a little larger."""
    # Large arrays of NumPy are not written before they are used, and ask for large pages.
    return memoryview(np.empty(size + size // _SPARE, np.uint8))


def fill(memory: memoryview, file: BinaryIO, offset: int) -> memoryview:
    """
    Read as much as fits; several threads may share the file.

    Raises
    ------
    ValueError
        If the file ends before: memory that is used again must not pass for what is read.
    """
    size = os.preadv(file.fileno(), [memory], offset)
    if size < len(memory):
        raise ValueError(f'the file ends {len(memory) - size} bytes before it does')
    return memory


def blocks_in_order(
        chunks: Sequence[Chunk], wanted: Wanted, load: Callable[[Chunk, Room], C],
        locate: Callable[[Sequence[Chunk], Sequence[C]], list[Located]]) -> Iterator[Block]:
    """
    Yield the messages of all chunks by log time; those of equal time in the order of the file.

    Chunks may overlap in time; no more is held in memory than overlaps, and a few chunks.

    Parameters
    ----------
    chunks : sequence of Chunk
    wanted : Wanted
        Chunks without any of it are not read.
    load : callable
        Reads and decompresses the content of a chunk, in a thread.
    locate : callable
        Finds the wanted messages in the contents of some chunks.
    """
    batches = list(_batches(sorted((c for c in chunks if c.holds(wanted.slots)
                                    and wanted.overlaps(c.start_ns, c.end_ns)),
                                   key=attrgetter('start_ns'))))
    nothing = pending = wanted.block(())
    free: list[Room] = []
    for i, (room, contents) in enumerate(_ahead(load, batches, free)):
        pending = pending.merged(wanted.block(locate(batches[i], contents)))
        free.append(room.empty())
        ready = len(pending) if i + 1 == len(batches) else int(np.searchsorted(
            pending.log_ns, batches[i + 1][0].start_ns))
        block, pending = (pending, nothing) if ready == len(pending) else pending.split(ready)
        if ready:
            yield block


def _batches(chunks: Sequence[Chunk]) -> Iterator[list[Chunk]]:
    batch: list[Chunk] = []
    size = 0
    for chunk in chunks:
        batch.append(chunk)
        size += max(chunk.size, chunk.full_size)
        if size >= BATCH:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def _ahead(load: Callable[[Chunk, Room], C], batches: Sequence[Sequence[Chunk]],
           free: list[Room]) -> Iterator[tuple[Room, list[C]]]:
    """Load chunks in threads, some batches ahead; in order. Rooms come back by `free`."""
    waiting: deque[tuple[Room, Future[list[C]]]] = deque()

    def task(batch: Sequence[Chunk], room: Room) -> list[C]:
        return [load(chunk, room) for chunk in batch]

    # No context: a reader that is dropped would wait for its threads, and lose an interrupt.
    pool = ThreadPoolExecutor(_THREADS)
    for batch in batches:
        room = free.pop() if free else Room()
        waiting.append((room, pool.submit(task, batch, room)))
        if len(waiting) > _AHEAD:
            room, future = waiting.popleft()
            yield room, future.result()
    while waiting:
        room, future = waiting.popleft()
        yield room, future.result()
