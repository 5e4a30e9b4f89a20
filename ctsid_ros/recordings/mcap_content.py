# SPDX-License-Identifier: Apache-2.0
"""
Where messages lie in the content of an MCAP chunk.

The index behind a chunk says where; each of its entries is compared with the record that lies
there (kind, channel, length, log time). Where there is no index, or it does not agree, the records
are visited one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
import struct
from typing import NamedTuple

from mcap.opcode import Opcode
import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Content, Index, Located
from ctsid_ros.decoding.table import take
from ctsid_ros.recordings.chunks import Held

RECORD = struct.Struct('<BQ')  # opcode, length of what follows
_INDEX = struct.Struct('<BQHI')  # opcode, length, channel, bytes of entries
_ENTRY = np.dtype([('log', '<i8'), ('offset', '<i8')])
_HEAD = np.dtype({'names': ['opcode', 'length', 'channel', 'sequence', 'log', 'publish'],
                  'formats': ['u1', '<i8', '<u2', '<u4', '<i8', '<i8'],
                  'offsets': [0, 1, 9, 11, 15, 23],
                  'itemsize': 31})  # of the record of a message, up to its data
_MESSAGE, _MESSAGE_INDEX = Opcode.MESSAGE.value, Opcode.MESSAGE_INDEX.value
_DEFINITIONS = (Opcode.SCHEMA.value, Opcode.CHANNEL.value)
_LEAST = _HEAD.itemsize - RECORD.size  # length of the record of an empty message
_EVER = (-2**63, 2**63 - 1)
Define = Callable[[int, bytes], None]


class Source(NamedTuple):
    """
    What messages are looked for in.

    Parameters
    ----------
    held : Held
    entries : bytes
        The index records behind the chunk, as far as there are any.
    span_ns : (int, int) or None
        First and last log time that its messages can have, where no checksum says that the content
        is sound: then only what agrees with the index is believed, too.
    """

    held: Held
    entries: bytes
    span_ns: tuple[int, int] | None


class Messages(NamedTuple):
    """
    Messages of any channels.

    Parameters
    ----------
    offsets, lengths : ndarray of int, shape (N,)
        Of their data, in the memory.
    heads : structured ndarray, shape (N,)
    whole : ndarray of bool, shape (N,)
        Which of them are records of messages that end within their content.
    """

    offsets: Index
    lengths: Index
    heads: NDArray[np.void]
    whole: NDArray[np.bool_]

    @classmethod
    def at(cls, memory: Content, start: int | Index, end: int | Index, places: Index) -> Messages:
        """Look at the records at these places of contents that begin and end there."""
        near = np.clip(places, 0, end - start)  # an index that is damaged may list any number
        heads = take(memory, start + near, _HEAD.itemsize).view(_HEAD)
        offsets, lengths = start + near + _HEAD.itemsize, heads['length'] - _LEAST
        return cls(offsets, lengths, heads, (heads['opcode'] == _MESSAGE) & (places == near)
                   & (lengths >= 0) & (lengths <= end - offsets))

    def located(self, memory: Content, slot: int, rows: slice | Index | NDArray[np.bool_]
                ) -> Located:
        """Return some of them as messages of one topic."""
        heads = self.heads[rows]
        return Located(slot, memory, self.offsets[rows], self.lengths[rows],
                       np.ascontiguousarray(heads['log']), np.ascontiguousarray(heads['publish']),
                       sequences=heads['sequence'].astype(np.int64))


Found = tuple[list[Located], list[int]]  # and how many messages there are in each source


def locate(sources: Sequence[Source], slots: Mapping[int, int]) -> Found:
    """
    Find the messages of some channels.

    Parameters
    ----------
    sources : sequence of Source
    slots : mapping of int to int
        Numbers of the topics that are wanted, by channel.

    Returns
    -------
    list of Located
    list of int
        How many messages were found in each source.
    """
    located: list[Located] = []
    counts: list[int] = []
    for _, side_by_side in groupby(sources, key=lambda s: (id(s.held.memory), bool(s.entries))):
        for parts, own in _found(list(side_by_side), slots):
            located += parts
            counts += own
    return [part for part in located if len(part.offsets)], counts


def _found(sources: Sequence[Source], slots: Mapping[int, int]) -> Iterator[Found]:
    """Find messages in contents of one memory: in all at once, if their indexes are right."""
    found = _by_index(sources, slots) if sources[0].entries else None
    if found:
        yield found
    elif len(sources) == 1:
        yield _visited(sources[0], slots)
    else:
        for source in sources:
            yield from _found([source], slots)


def _by_index(sources: Sequence[Source], slots: Mapping[int, int]) -> Found | None:
    """Return what the indexes of all sources list; None if not all of it is there."""
    pieces: dict[int, list[tuple[int, bytes]]] = {channel: [] for channel in slots}
    for number, source in enumerate(sources):
        for channel, entries in _entries(source.entries):
            if channel in pieces:
                pieces[channel].append((number, entries))
    listed = [(number, channel, len(entries) // _ENTRY.itemsize)
              for channel, own in pieces.items() for number, entries in own]
    if not listed:
        return [], [0] * len(sources)
    table = np.frombuffer(b''.join([e for own in pieces.values() for _, e in own]), _ENTRY)
    numbers, channels, sizes = np.array(listed).T
    bounds = np.array([(s.held.start, s.held.end, *(s.span_ns or _EVER)) for s in sources])
    starts, ends, first_ns, last_ns = np.repeat(bounds[numbers], sizes, axis=0).T
    memory = sources[0].held.memory
    messages = Messages.at(memory, starts, ends, table['offset'])
    log_ns = table['log']
    if not (messages.whole & (messages.heads['log'] == log_ns)
            & (messages.heads['channel'] == np.repeat(channels, sizes))).all():
        return None
    inside = (first_ns <= log_ns) & (log_ns <= last_ns)  # others are damaged
    located = []
    end = 0
    for channel, own in pieces.items():
        start, end = end, end + sum(len(e) for _, e in own) // _ENTRY.itemsize
        rows = slice(start, end) if inside.all() else start + np.flatnonzero(inside[start:end])
        located.append(messages.located(memory, slots[channel], rows))
    counts = np.bincount(np.repeat(numbers, sizes)[inside], minlength=len(sources))
    return located, counts.tolist()


def _visited(source: Source, slots: Mapping[int, int]) -> Found:
    """Return what visiting the records has met, as far as it is believed."""
    memory, start, end = source.held
    content = source.held.content
    places = _believed(content, source.entries) if source.entries and source.span_ns else \
        walk(content).messages
    found = Messages.at(memory, start, end, places)
    log_ns, (first_ns, last_ns) = found.heads['log'], source.span_ns or _EVER
    inside = (first_ns <= log_ns) & (log_ns <= last_ns)
    located = [found.located(memory, slot, inside & (found.heads['channel'] == channel))
               for channel, slot in slots.items()]
    return located, [sum(len(part.offsets) for part in located)]


def _believed(content: Content, index: bytes) -> Index:
    """Return messages that the index does not contradict, each followed by a proper record."""
    pairs = [(channel, np.frombuffer(entries, _ENTRY)) for channel, entries in _entries(index)]
    entries = np.concatenate([np.empty(0, _ENTRY), *(own for _, own in pairs)])
    channels = np.repeat([channel for channel, _ in pairs], [len(own) for _, own in pairs])
    listed = Messages.at(content, 0, len(content), entries['offset'])
    agree = (listed.whole & (listed.heads['log'] == entries['log'])
             & (listed.heads['channel'] == channels))
    walked = walk(content)
    starts = entries['offset']
    places = np.union1d(np.setdiff1d(walked.messages, starts[~agree]), starts[agree])
    found = Messages.at(content, 0, len(content), places)
    proper = np.concatenate((walked.records, starts[agree], [len(content)]))
    return places[found.whole & np.isin(found.offsets + found.lengths, proper)]


class Walked(NamedTuple):
    """
    What a visit of the records has met.

    Parameters
    ----------
    messages : ndarray of int
        Places of complete messages.
    records : ndarray of int
        Places of complete records of any kind.
    end : int
        Where the last record ends; beyond the content if it is cut off.
    """

    messages: Index
    records: Index
    end: int


def walk(content: Content, define: Define | None = None) -> Walked:
    """
    Visit the records.

    Parameters
    ----------
    content : bytes-like
    define : callable, optional
        Takes opcode and content of schemas and channels.
    """
    messages: list[int] = []
    records: list[int] = []
    position, size, unpack = 0, len(content), RECORD.unpack_from
    while position + RECORD.size <= size:
        opcode, length = unpack(content, position)
        end = position + RECORD.size + length
        if opcode == 0:  # data that never reached the disk; zeros may have begun before
            del messages[-1:]
            break
        if end <= size:
            records.append(position)
            if opcode == _MESSAGE:
                if length >= _LEAST:
                    messages.append(position)
            elif define and opcode in _DEFINITIONS:
                define(opcode, bytes(content[position + RECORD.size:end]))
        position = end
    return Walked(np.array(messages, np.intp), np.array(records, np.intp), position)


def _entries(index: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield channels and entries of index records."""
    position = 0
    while position + _INDEX.size <= len(index):
        opcode, length, channel, size = _INDEX.unpack_from(index, position)
        first = position + _INDEX.size
        if opcode == _MESSAGE_INDEX and first + size <= len(index):
            yield channel, index[first:first + size // _ENTRY.itemsize * _ENTRY.itemsize]
        position += RECORD.size + length
