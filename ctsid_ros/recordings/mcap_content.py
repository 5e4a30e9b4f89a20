# SPDX-License-Identifier: Apache-2.0
"""
Where messages lie in the content of an MCAP chunk.

The index behind a chunk says where; each of its entries is compared with the record that lies
there (kind, channel, length, log time). Where there is no index, or it does not agree, the records
are visited one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
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
        return _wanted(content, walk(content)[0], slots)
    entries = [(channel, table) for channel, table in _entries(index) if channel in slots]
    if not entries:
        return []
    table = np.concatenate([table for _, table in entries])
    counts = [len(table) for _, table in entries]
    places = table['offset']
    listed = Messages.at(content, places)
    agree = listed.whole & (listed.heads['log'] == table['log']) & \
        (listed.heads['channel'] == np.repeat([channel for channel, _ in entries], counts))
    if agree.all():
        ends = accumulate(counts)
        return [listed.located(content, slots[channel], slice(end - count, end))
                for (channel, _), count, end in zip(entries, counts, ends, strict=True) if count]
    records = walk(content)[0]
    if not checked:
        records = np.union1d(np.setdiff1d(records, places[~agree]), places[agree])
    return _wanted(content, records, slots)


def _wanted(content: Content, places: Index, slots: Mapping[int, int]) -> list[Located]:
    messages = Messages.at(content, places)
    channels = messages.heads['channel']
    parts = (messages.located(content, slot, channels == channel)
             for channel, slot in slots.items())
    return [part for part in parts if len(part.offsets)]


def walk(content: Content, define: Define | None = None) -> tuple[Index, int]:
    """
    Visit the records; return the places of complete messages, and where the last record ends.

    Parameters
    ----------
    content : bytes-like
    define : callable, optional
        Takes opcode and content of schemas and channels.
    """
    places: list[int] = []
    position, size, unpack = 0, len(content), RECORD.unpack_from
    while position + RECORD.size <= size:
        opcode, length = unpack(content, position)
        end = position + RECORD.size + length
        if opcode == _MESSAGE:
            if end <= size and length >= _LEAST:
                places.append(position)
        elif opcode == 0:  # data that never reached the disk; zeros may have begun before
            places = places[:-1]
            break
        elif define and opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and end <= size:
            define(opcode, bytes(content[position + RECORD.size:end]))
        position = end
    return np.array(places, dtype=np.intp), position


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
