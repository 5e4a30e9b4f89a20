# SPDX-License-Identifier: Apache-2.0
"""What every file of a bag becomes, whatever its format; blocks in the order of log time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from ctsid_ros.decoding.block import Block, Decode, Located
from ctsid_ros.decoding.message_types import MessageType

Note = Callable[[str], None]
NEAR = 10**9  # from the end of a part to the start of the next, or of their overlap, at most [ns]


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
    message_type : MessageType, optional
        Where it is known without a definition.
    """

    id: int
    topic: str
    type: str
    encoding: str
    format: str
    definition: str
    count: int
    message_type: MessageType | None = None


class Wanted(NamedTuple):
    """
    Which messages are wanted of a file, and what is to become of them.

    Parameters
    ----------
    slots : mapping of int to int
        Number of the topic, by connection.
    topics : sequence of str
    decoders : sequence of Decode
    span_ns : (int, int), optional
        Log times outside of which nothing is wanted; a reader may give more.
    """

    slots: Mapping[int, int]
    topics: Sequence[str]
    decoders: Sequence[Decode]
    span_ns: tuple[int, int] | None = None

    def overlaps(self, start_ns: int, end_ns: int) -> bool:
        """Whether anything is wanted of a piece with these first and last log times."""
        return self.span_ns is None or (start_ns <= self.span_ns[1]
                                        and end_ns >= self.span_ns[0])

    def block(self, found: Sequence[Located]) -> Block:
        """Decode what a reader has found."""
        return Block.of(found, self.topics, self.decoders)


@dataclass(frozen=True)
class Recording:
    """
    One file of a bag.

    Parameters
    ----------
    connections : tuple of Connection
    start_ns, end_ns : int
        First and last log time; 0 if there is no message.
    blocks : callable
        (what is wanted, where to note damage) -> messages in the order of log time.
    notes : tuple of str
        What was damaged and recovered.
    alone : str, optional
        What its topics begin with if it is a table, whose topics any other name of it may stand
        for where it is the only file.
    own_clock : bool, optional
        Whether its times count from a start of its own, so that they do not tell which other
        files belong to it.
    """

    connections: tuple[Connection, ...]
    start_ns: int
    end_ns: int
    blocks: Callable[[Wanted, Note], Iterator[Block]]
    notes: tuple[str, ...] = ()
    alone: str = ''
    own_clock: bool = False

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(connection.count for connection in self.connections)


class Times(NamedTuple):
    """What of a file tells whether a logger has split it: columns, empty if it is no table."""

    columns: Collection[object]
    start_ns: int
    end_ns: int


def successors(files: Sequence[Times]) -> tuple[dict[int, int], tuple[int, ...]]:
    """
    Return which table continues which, and those of which time does not tell it, by their places.

    One may continue another if it has the same columns and begins when that has ended, and does if
    none lies between them. Where several could, as in runs that were split at the same time, none
    does.
    """
    later = [{j for j, other in enumerate(files) if one.columns and one.columns == other.columns
              and one.start_ns < other.start_ns and 0 <= other.start_ns - one.end_ns <= NEAR}
             for one in files]
    pairs = [(i, j) for i, places in enumerate(later) for j in places
             if not any(j in later[between] for between in places)]
    before, behind = Counter(i for i, _ in pairs), Counter(j for _, j in pairs)
    sure = {i: j for i, j in pairs if before[i] == behind[j] == 1}
    doubtful = {place for i, j in pairs if sure.get(i) != j for place in (i, j)}
    return sure, tuple(sorted(doubtful))


def continued(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Give tables that continue each other the name of the first: a logger has split them."""
    found = list(recordings)
    following, _ = successors([Times(_columns(one), one.start_ns, one.end_ns) for one in found])
    for i in sorted(following, key=lambda i: found[i].start_ns):
        name, own = found[i].alone, found[following[i]]
        found[following[i]] = replace(own, alone=name, connections=tuple(
            replace(c, topic=name + c.topic.removeprefix(own.alone)) for c in own.connections))
    return tuple(found)


def _columns(table: Recording) -> list[tuple[str, MessageType | None]]:
    return [(c.topic.removeprefix(table.alone), c.message_type) for c in table.connections
            if table.alone]


class _Stream(NamedTuple):
    """A stream of blocks, and its next one."""

    number: int
    block: Block
    rest: Iterator[Block]


def merge_in_time(streams: Sequence[tuple[int, Callable[[], Iterator[Block]]]]
                  ) -> Iterator[Block]:
    """
    Merge streams, each in the order of log time; none is opened before time reaches its start.

    Parameters
    ----------
    streams : sequence of (start_ns, function that opens the stream)
    """
    waiting = sorted(streams, key=itemgetter(0), reverse=True)
    numbers = count()
    active: list[_Stream] = []

    def advance(number: int, rest: Iterator[Block]) -> None:
        block = next((block for block in rest if len(block)), None)
        if block is not None:
            active.append(_Stream(number, block, rest))

    while waiting or active:
        while waiting and (not active or waiting[-1][0] <= min(
                int(stream.block.log_ns[-1]) for stream in active)):
            advance(next(numbers), waiting.pop()[1]())
        if not active:
            continue
        # Up to where the first of the blocks ends nothing can come any more.
        end_ns, number = min((int(s.block.log_ns[-1]), s.number) for s in active)
        merged: Block | None = None
        now, active = sorted(active), []
        for stream in now:
            # Where times are equal, those of a stream that was opened earlier come first.
            side = 'right' if stream.number <= number else 'left'
            ready, later = stream.block.split(int(np.searchsorted(
                stream.block.log_ns, end_ns, side)))  # type: ignore[call-overload]
            merged = ready if merged is None else merged.merged(ready)
            if len(later):
                active.append(stream._replace(block=later))
            else:
                advance(stream.number, stream.rest)
        assert merged is not None
        yield merged
