# SPDX-License-Identifier: Apache-2.0
"""
Where messages lie in the content of an MCAP chunk.

The index behind a chunk says where; each of its entries is compared with the record that lies
there (kind, channel, length, log time). Where there is no index, or it does not agree, the records
are visited one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
import struct
from typing import NamedTuple

from mcap.opcode import Opcode
import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Content, Index, Located
from ctsid_ros.decoding.table import take

RECORD = struct.Struct('<BQ')  # opcode, length of what follows
_INDEX = struct.Struct('<BQHI')  # opcode, length, channel, bytes of entries
_ENTRY = np.dtype([('log', '<i8'), ('offset', '<i8')])
_HEAD = np.dtype({'names': ['opcode', 'length', 'channel', 'log', 'publish'],
                  'formats': ['u1', '<i8', '<u2', '<i8', '<i8'], 'offsets': [0, 1, 9, 15, 23],
                  'itemsize': 31})  # of the record of a message, up to its data
_MESSAGE, _MESSAGE_INDEX = Opcode.MESSAGE.value, Opcode.MESSAGE_INDEX.value
_DEFINITIONS = (Opcode.SCHEMA.value, Opcode.CHANNEL.value)
_LEAST = _HEAD.itemsize - RECORD.size  # length of the record of an empty message
_CHANNEL = struct.Struct('<H')
Define = Callable[[int, bytes], None]


class Messages(NamedTuple):
    """
    Messages of any channels in one content.

    Parameters
    ----------
    offsets, lengths : ndarray of int, shape (N,)
        Of their data.
    heads : structured ndarray, shape (N,)
    whole : ndarray of bool, shape (N,)
        Which of them are records of messages that end within the content.
    """

    offsets: Index
    lengths: Index
    heads: NDArray[np.void]
    whole: NDArray[np.bool_]

    @classmethod
    def at(cls, content: Content, places: Index) -> Messages:
        """Look at the records at these places."""
        heads = take(content, places, _HEAD.itemsize).view(_HEAD)
        offsets, lengths = places + _HEAD.itemsize, heads['length'] - _LEAST
        whole = (heads['opcode'] == _MESSAGE) & (lengths >= 0) & (places >= 0) & \
            (lengths <= len(content) - offsets)
        return cls(offsets, lengths, heads, whole)

    def located(self, content: Content, slot: int, rows: slice | NDArray[np.bool_]) -> Located:
        """Return some of them as messages of one topic."""
        heads = self.heads[rows]
        return Located(slot, content, self.offsets[rows], self.lengths[rows], heads['log'],
                       heads['publish'])


def locate(content: Content, index: bytes, slots: Mapping[int, int], *, checked: bool
           ) -> list[Located]:
    """
    Find the messages of some channels.

    Parameters
    ----------
    content : bytes-like
    index : bytes
        The index records behind the chunk, as far as there are any.
    slots : mapping of int to int
        Numbers of the topics that are wanted, by channel.
    checked : bool
        Whether a checksum says that the content is sound; else only what agrees with the index
        is believed.
    """
    if not index:
        return _wanted(content, walk(content).messages, slots)
    entries = [(channel, table) for channel, table in _entries(index) if channel in slots]
    if not entries:
        return []
    counts = [len(table) for _, table in entries]
    listed, agree = _listed(content, entries)
    if agree.all():
        ends = accumulate(counts)
        return [listed.located(content, slots[channel], slice(end - count, end))
                for (channel, _), count, end in zip(entries, counts, ends, strict=True) if count]
    places = walk(content).messages if checked else _believed(content, list(_entries(index)))
    return _wanted(content, places, slots)


def _listed(content: Content, entries: Sequence[tuple[int, NDArray[np.void]]]
            ) -> tuple[Messages, NDArray[np.bool_]]:
    """Return the messages that an index lists, and which of them are what it says."""
    table = np.concatenate([table for _, table in entries])
    channels = np.repeat([channel for channel, _ in entries], [len(t) for _, t in entries])
    found = Messages.at(content, table['offset'])
    return found, (found.whole & (found.heads['log'] == table['log'])
                   & (found.heads['channel'] == channels))


def _believed(content: Content, entries: Sequence[tuple[int, NDArray[np.void]]]) -> Index:
    """Return messages that the index does not contradict, each followed by a proper record."""
    listed, agree = _listed(content, entries)
    walked = walk(content)
    starts = listed.offsets - _HEAD.itemsize
    places = np.union1d(np.setdiff1d(walked.messages, starts[~agree]), starts[agree])
    found = Messages.at(content, places)
    proper = np.concatenate((walked.records, starts[agree], [len(content)]))
    return places[found.whole & np.isin(found.offsets + found.lengths, proper)]


def _wanted(content: Content, places: Index, slots: Mapping[int, int]) -> list[Located]:
    messages = Messages.at(content, places)
    channels = messages.heads['channel']
    parts = (messages.located(content, slot, channels == channel)
             for channel, slot in slots.items())
    return [part for part in parts if len(part.offsets)]


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


def _entries(index: bytes) -> Iterator[tuple[int, NDArray[np.void]]]:
    """Yield channels and entries of index records."""
    position = 0
    while position + _INDEX.size <= len(index):
        opcode, length, channel, size = _INDEX.unpack_from(index, position)
        end = position + RECORD.size + length
        if opcode == _MESSAGE_INDEX and position + _INDEX.size + size <= len(index):
            yield channel, np.frombuffer(index, _ENTRY, size // _ENTRY.itemsize,
                                         position + _INDEX.size)
        position = end
