# SPDX-License-Identifier: Apache-2.0
"""What every file of a bag becomes, whatever its format; messages in the order of log time."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
import heapq
from itertools import count
from operator import itemgetter
from typing import TypeVar

Payload = bytes | memoryview
Row = tuple[int, int, int, Payload]  # log time [ns], publish time [ns], connection, message
Note = Callable[[str], None]
T = TypeVar('T', bound=Sequence[object])


@dataclass(frozen=True)
class Connection:
    """
    One publisher's or recorder's entry for a topic in a file.

    Parameters
    ----------
    id : int
    topic : str
    type : str
        Name of the message type as the file has it.
    encoding : str
        Of the messages: 'cdr', 'ros1', or what ctsid cannot decode.
    format : str
        Of the definition: 'ros2msg', 'ros2idl', 'ros1msg', '' or another.
    definition : str
    count : int
        Number of messages.
    """

    id: int
    topic: str
    type: str
    encoding: str
    format: str
    definition: str
    count: int


@dataclass(frozen=True)
class Recording:
    """
    One file of a bag.

    Parameters
    ----------
    connections : tuple of Connection
    start_ns, end_ns : int
        First and last log time; 0 if there is no message.
    rows : callable
        (connection ids, where to note damage) -> messages in the order of log time.
    notes : tuple of str
        What was damaged and recovered.
    """

    connections: tuple[Connection, ...]
    start_ns: int
    end_ns: int
    rows: Callable[[Collection[int], Note], Iterator[Row]]
    notes: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(connection.count for connection in self.connections)


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
    """

    offset: int
    size: int
    compression: str = ''
    start_ns: int = 0
    end_ns: int = 0
    counts: Mapping[int, int] | None = None
    full_size: int = 0
    crc: int = 0

    def holds(self, connections: Collection[int]) -> bool:
        """Whether any of the connections has, or may have, messages here."""
        return self.counts is None or any(self.counts.get(c) for c in connections)


def span(chunks: Sequence[Chunk]) -> tuple[int, int]:
    """Return first and last log time [ns] of all chunks; zeros if there are none."""
    return (min((c.start_ns for c in chunks), default=0),
            max((c.end_ns for c in chunks), default=0))


def rows_in_order(chunks: Sequence[Chunk], read: Callable[[Chunk], list[Row]]) -> Iterator[Row]:
    """
    Yield the rows of all chunks by log time; rows of equal time in the order of the file.

    Chunks may overlap in time; no more is held in memory than overlaps. Rows within a chunk need
    not be in order: their sort is cheap when they are.
    """
    ordered = sorted(chunks, key=lambda chunk: chunk.start_ns)
    pending: list[Row] = []
    for i, chunk in enumerate(ordered):
        pending += read(chunk)
        pending.sort(key=itemgetter(0))
        if i + 1 < len(ordered):
            ready = bisect_left(pending, ordered[i + 1].start_ns, key=itemgetter(0))
            yield from pending[:ready]
            del pending[:ready]
    yield from pending


def merge_in_time(streams: Sequence[tuple[int, Callable[[], Iterator[T]]]],
                  log_time: Callable[[T], int]) -> Iterator[T]:
    """
    Merge streams, each in the order of log time; none is opened before time reaches its start.

    Parameters
    ----------
    streams : sequence of (start_ns, function that opens the stream)
    log_time : callable
        Log time of an item [ns].
    """
    waiting = sorted(streams, key=itemgetter(0), reverse=True)
    serial = count()
    active: list[tuple[int, int, T, Iterator[T]]] = []
    while waiting or active:
        while waiting and (not active or waiting[-1][0] <= active[0][0]):
            stream = waiting.pop()[1]()
            for item in stream:
                heapq.heappush(active, (log_time(item), next(serial), item, stream))
                break
        if not active:
            continue
        _, number, item, stream = active[0]
        yield item
        following = next(stream, None)
        if following is None:
            heapq.heappop(active)
        else:
            heapq.heapreplace(active, (log_time(following), number, following, stream))
