# SPDX-License-Identifier: Apache-2.0
"""
Messages as columns: what recordings hand out, and what `Ingest` takes.

A reader says where the messages of a topic lie in the bytes that it has read (`Located`), a
decoder turns them into columns (`Decoded`), and `Block.of` puts the columns of all topics into
the order of recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]
Index = NDArray[np.intp]
Content = bytes | memoryview


class Located(NamedTuple):
    """
    Messages of one topic within one buffer.

    Parameters
    ----------
    slot : int
        Number of the topic among those that are read.
    content : bytes-like
    offsets, lengths : ndarray of int, shape (N,)
        All lie within the content: the reader has checked that.
    log_ns, publish_ns : ndarray of int64, shape (N,)
    places : ndarray of int, shape (N,), optional
        Order among messages of equal log time, where it is not that of buffers and offsets; all
        that a block is made of have it, or none.
    sequences : ndarray of int64, shape (N,), optional
        Numbers that the publishers gave the messages, where the recording keeps them; 0 where it
        does not.
    """

    slot: int
    content: Content
    offsets: Index
    lengths: Index
    log_ns: Stamps
    publish_ns: Stamps
    places: Index | None = None
    sequences: Stamps | None = None


class Decoded(NamedTuple):
    """
    What a decoder has read of messages, a row each.

    Parameters
    ----------
    header_ns : ndarray of int64, shape (N,), or None
        Header stamps as they stand, even if zero; None for types without a header.
    values : ndarray, shape (N, k)
        The scalars; or whatever else a decoder makes of a message, shape (N,).
    sound : ndarray of bool, shape (N,)
        Which of the messages could be decoded; stamps and values of others mean nothing.
    absent : ndarray of bool, shape (N, k), optional
        Which scalars a message has no sample of, for it lacks their name; None if there is none.
    """

    header_ns: Stamps | None
    values: NDArray[Any]
    sound: NDArray[np.bool_]
    absent: NDArray[np.bool_] | None = None


Decode = Callable[[Sequence[Located]], Decoded]


@dataclass(frozen=True)
class Columns:
    """
    Messages of one topic, a row each, in the order of recording.

    Parameters
    ----------
    topic : str
    log_ns, publish_ns : ndarray of int64, shape (N,)
    header_ns, values, sound, absent
        As a decoder gives them, see `Decoded`.
    sequences : ndarray of int64, shape (N,), or None
        As a reader gives them, see `Located`.
    """

    topic: str
    log_ns: Stamps
    publish_ns: Stamps
    header_ns: Stamps | None
    values: NDArray[Any]
    sound: NDArray[np.bool_]
    absent: NDArray[np.bool_] | None = None
    sequences: Stamps | None = None

    def __len__(self) -> int:
        return len(self.log_ns)

    def __getitem__(self, rows: slice | Index) -> Columns:
        return replace(self, log_ns=self.log_ns[rows], publish_ns=self.publish_ns[rows],
                       header_ns=None if self.header_ns is None else self.header_ns[rows],
                       values=self.values[rows], sound=self.sound[rows],
                       sequences=None if self.sequences is None else self.sequences[rows],
                       absent=None if self.absent is None else self.absent[rows])

    def followed_by(self, other: Columns) -> Columns:
        """Return the rows of both."""
        if not len(self) or not len(other):
            return self if len(self) else other
        return Columns(self.topic, np.concatenate((self.log_ns, other.log_ns)),
                       np.concatenate((self.publish_ns, other.publish_ns)),
                       _all_of((self.header_ns, other.header_ns)),
                       np.concatenate((self.values, other.values)),
                       np.concatenate((self.sound, other.sound)),
                       _all_of((self.absent, other.absent)),
                       _all_of((self.sequences, other.sequences)))


@dataclass(frozen=True)
class Block:
    """
    Messages of several topics that follow each other in a recording.

    Parameters
    ----------
    which : ndarray of int, shape (M,)
        Which of the columns each message belongs to, in the order of log time: it is the next
        row there.
    columns : tuple of Columns
    """

    which: Index
    columns: tuple[Columns, ...]

    @classmethod
    def of(cls, found: Sequence[Located], topics: Sequence[str], decoders: Sequence[Decode]
           ) -> Block:
        """
        Decode what a reader has found; by log time, and where that is equal by place.

        Parameters
        ----------
        found : sequence of Located
            In the order of the file; of one buffer there may be several, one after another.
        topics : sequence of str
            By slot.
        decoders : sequence of Decode
            By slot.
        """
        columns = []
        for slot, (topic, decode) in enumerate(zip(topics, decoders, strict=True)):
            own = [part for part in found if part.slot == slot]
            columns.append(Columns(topic, joined([part.log_ns for part in own]),
                                   joined([part.publish_ns for part in own]), *decode(own),
                                   _all_of([part.sequences for part in own])))
        buffers: dict[int, int] = {}
        places: list[list[Index]] = [[] for _ in topics]
        for part in found:
            base = buffers.setdefault(id(part.content), len(buffers)) << 40
            places[part.slot].append(
                part.offsets + base if part.places is None else part.places)
        return cls._sorted(columns, [joined(own) for own in places])

    @classmethod
    def _sorted(cls, columns: Sequence[Columns], places: Sequence[Stamps]) -> Block:
        """Put rows in the order of log time, those of equal time in the order of place."""
        which = np.repeat(np.arange(len(columns)), [len(c) for c in columns])
        order = np.argsort(np.concatenate(places), kind='stable')
        log = np.concatenate([c.log_ns for c in columns])[order]
        if (log[1:] < log[:-1]).any():
            order = order[np.argsort(log, kind='stable')]
        which = which[order]
        ordered, start = [], 0
        for number, rows in enumerate(columns):
            own = order[which == number] - start
            start += len(rows)
            ordered.append(rows if (own[1:] > own[:-1]).all() else rows[own])
        return cls(which, tuple(ordered))

    @cached_property
    def log_ns(self) -> Stamps:
        """Log times of all messages [ns]."""
        times = np.empty(len(self.which), np.int64)
        for number, rows in enumerate(self.columns):
            times[self.which == number] = rows.log_ns
        return times

    def __len__(self) -> int:
        return len(self.which)

    def split(self, at: int) -> tuple[Block, Block]:
        """Return the first `at` messages and the others."""
        counts = np.bincount(self.which[:at], minlength=len(self.columns)).tolist()
        pairs = [(rows[:count], rows[count:])
                 for rows, count in zip(self.columns, counts, strict=True)]
        return (Block(self.which[:at], tuple(first for first, _ in pairs)),
                Block(self.which[at:], tuple(rest for _, rest in pairs)))

    def merged(self, other: Block) -> Block:
        """Return the messages of both by log time; where that is equal, these before the other."""
        if not len(self) or not len(other):
            return self if len(self) else other
        columns, places = [], []
        for number, (first, second) in enumerate(zip(self.columns, other.columns, strict=True)):
            columns.append(first.followed_by(second))
            places += [np.flatnonzero(self.which == number),
                       np.flatnonzero(other.which == number) + len(self)]
        pairs = [np.concatenate(places[i:i + 2]) for i in range(0, len(places), 2)]
        return self._sorted(columns, pairs)


def _all_of(parts: Sequence[NDArray[Any] | None]) -> NDArray[Any] | None:
    """Return the rows of all parts; None if one has none."""
    known = [part for part in parts if part is not None]
    return joined(known) if len(known) == len(parts) else None


def joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return the rows of all parts; copied only where there are several."""
    if len(parts) == 1:
        return parts[0]
    return np.concatenate(parts) if parts else np.empty(0, np.int64)
