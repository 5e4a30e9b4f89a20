# SPDX-License-Identifier: Apache-2.0
"""
Where messages lie in the content of an MCAP chunk.

The index behind a chunk says where; each of its entries is compared with the record that lies
there (kind, channel, length, log time). Where there is no index, or it does not agree, the records
are visited one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
import struct
from typing import NamedTuple

from mcap.opcode import Opcode
import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Content, Index, Located
from ctsid_ros.decoding.table import take

RECORD = struct.Struct('<BQ')  # opcode, length of what follows
_INDEX = struct.Struct('<BQHI')  # opcode, length, channel, bytes of entries
_ENTRY = 2  # numbers of 8 bytes: log time and offset
_HEAD = np.dtype({'names': ['opcode', 'length', 'channel', 'log', 'publish'],
                  'formats': ['u1', '<i8', '<u2', '<i8', '<i8'], 'offsets': [0, 1, 9, 15, 23],
                  'itemsize': 31})  # of the record of a message, up to its data
_MESSAGE, _MESSAGE_INDEX = Opcode.MESSAGE.value, Opcode.MESSAGE_INDEX.value
_DEFINITIONS = (Opcode.SCHEMA.value, Opcode.CHANNEL.value)
_LEAST = _HEAD.itemsize - RECORD.size  # length of the record of an empty message
_NONE = np.empty((0, _ENTRY), '<i8')
Table = NDArray[np.int64]  # entries of the index of one channel, shape (N, 2)
Define = Callable[[int, bytes], None]


class Source(NamedTuple):
    """
    What messages are looked for in.

    Parameters
    ----------
    content : bytes-like
    entries : bytes
        The index records behind the chunk, as far as there are any.
    checked : bool
        Whether a checksum says that the content is sound; else only what agrees with the index
        is believed.
    """

    content: Content
    entries: bytes
    checked: bool


class Messages(NamedTuple):
    """
    Messages of any channels.

    Parameters
    ----------
    offsets, lengths : ndarray of int, shape (N,)
        Of their data.
    heads : structured ndarray, shape (N,)
    whole : ndarray of bool, shape (N,)
        Which of them are records of messages that end within their content.
    """

    offsets: Index
    lengths: Index
    heads: NDArray[np.void]
    whole: NDArray[np.bool_]

    @classmethod
    def at(cls, contents: Sequence[Content], places: Sequence[Index]) -> Messages:
        """Look at the records at these places of each content."""
        place = np.concatenate(places)
        # An index that is damaged may list any number.
        near = [np.maximum(own, 0) for own in places]
        heads = np.concatenate([take(content, own, _HEAD.itemsize) for content, own in
                                zip(contents, near, strict=True)]).view(_HEAD)
        offsets, lengths = place + _HEAD.itemsize, heads['length'] - _LEAST
        ends = np.repeat([len(content) for content in contents], [len(own) for own in places])
        return cls(offsets, lengths, heads, (heads['opcode'] == _MESSAGE) & (place >= 0)
                   & (lengths >= 0) & (lengths <= ends - offsets))

    def located(self, content: Content, slot: int, rows: slice | NDArray[np.bool_]) -> Located:
        """Return some of them as messages of one topic."""
        heads = self.heads[rows]
        return Located(slot, content, self.offsets[rows], self.lengths[rows], heads['log'],
                       heads['publish'])


def locate(sources: Sequence[Source], slots: Mapping[int, int]) -> list[list[Located]]:
    """
    Find the messages of some channels.

    Parameters
    ----------
    sources : sequence of Source
    slots : mapping of int to int
        Numbers of the topics that are wanted, by channel.

    Returns
    -------
    list of list of Located
        Of each source.
    """
    entries = [[(channel, table) for channel, table in _entries(source.entries)
                if channel in slots] for source in sources]
    listed, agree = _listed([source.content for source in sources], entries)
    located = []
    end = 0
    for source, own in zip(sources, entries, strict=True):
        ends = list(accumulate((len(table) for _, table in own), initial=end))
        start, end = end, ends[-1]
        if source.entries and agree[start:end].all():
            located.append([listed.located(source.content, slots[channel], slice(first, last))
                            for (channel, _), (first, last) in zip(own, pairwise(ends),
                                                                   strict=True)])
            continue
        places = _believed(source) if source.entries and not source.checked else \
            walk(source.content).messages
        found = Messages.at([source.content], [places])
        located.append([found.located(source.content, slot, found.heads['channel'] == channel)
                        for channel, slot in slots.items()])
    return [[part for part in parts if len(part.offsets)] for parts in located]


def _listed(contents: Sequence[Content], entries: Sequence[Sequence[tuple[int, Table]]]
            ) -> tuple[Messages, NDArray[np.bool_]]:
    """Return the messages that indexes list, and which of them are what these say."""
    tables = [np.concatenate([_NONE, *(table for _, table in own)]) for own in entries]
    pairs = [(channel, len(table)) for own in entries for channel, table in own]
    channels = np.repeat([channel for channel, _ in pairs], [count for _, count in pairs])
    found = Messages.at(contents, [table[:, 1] for table in tables])
    return found, (found.whole & (found.heads['log'] == np.concatenate(tables)[:, 0])
                   & (found.heads['channel'] == channels))


def _believed(source: Source) -> Index:
    """Return messages that the index does not contradict, each followed by a proper record."""
    content = source.content
    listed, agree = _listed([content], [list(_entries(source.entries))])
    walked = walk(content)
    starts = listed.offsets - _HEAD.itemsize
    places = np.union1d(np.setdiff1d(walked.messages, starts[~agree]), starts[agree])
    found = Messages.at([content], [places])
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


def _entries(index: bytes) -> Iterator[tuple[int, Table]]:
    """Yield channels and entries of index records."""
    position = 0
    while position + _INDEX.size <= len(index):
        opcode, length, channel, size = _INDEX.unpack_from(index, position)
        end = position + RECORD.size + length
        if opcode == _MESSAGE_INDEX and position + _INDEX.size + size <= len(index):
            yield channel, np.frombuffer(index, '<i8', size // 16 * _ENTRY,
                                         position + _INDEX.size).reshape(-1, _ENTRY)
        position = end
