# SPDX-License-Identifier: Apache-2.0
"""
Chosen scalars out of serialised messages, without building message objects.

One message at a time as they arrive on a robot, or many at a time as recordings hold them. Most
messages of a topic have the same layout; those that differ are read one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.decoding.block import Decoded, Index, Located, Stamps
from ctsid_ros.decoding.cdr_layout import DecodeError, Layout, Raw, Sizes, layout_of
from ctsid_ros.decoding.field_path import FieldPath, Leaf
from ctsid_ros.decoding.message_fields import bind, check_field
from ctsid_ros.decoding.message_types import MessageType

__all__ = ['DecodeError', 'Extracted', 'Extractor']

Extracted = tuple[int | None, tuple[float, ...]]
KEPT_LAYOUTS = 8  # for publishers that take turns on one topic


class Extractor:
    """
    Reads the header stamp and chosen scalars from raw messages of one type.

    Open ranges (`effort[:]`) are closed by the first message that is read.

    Parameters
    ----------
    message_type : MessageType
    fields : sequence of FieldPath

    Raises
    ------
    FieldError
        If a field does not exist or is not a number.
    """

    def __init__(self, message_type: MessageType, fields: Sequence[FieldPath]) -> None:
        for field in fields:
            check_field(message_type, field)
        self.message_type = message_type
        self.fields = tuple(fields)
        self._layouts: list[Layout] = []
        self._sizes: Sizes = {}
        self._leaves: tuple[Leaf, ...] = ()
        self._spans: list[tuple[int, int, FieldPath]] = []  # of each field in the leaves
        self._derived = any(field.euler for field in fields)

    def __call__(self, raw: Raw) -> Extracted:
        """
        Extract from one message.

        Returns
        -------
        stamp_ns : int or None
            `header.stamp` [ns] as it stands, even if zero; None for types without a header.
        scalars : tuple of float
            Those of all fields, in their order.

        Raises
        ------
        DecodeError
            If the message does not hold them.
        """
        for layout in self._layouts:
            try:
                values = layout.unpack(raw)
            except struct.error:
                continue
            if layout.words(values) == layout.expected:
                break
        else:
            layout = self._learn(raw)
            values = layout.unpack(raw)
        scalars = layout.scalars(values)
        if not layout.floats:
            scalars = tuple(map(float, scalars))
        if self._derived:
            scalars = self._combine(scalars)
        if layout.stamp is None:
            return None, scalars
        seconds, nanoseconds = layout.stamp
        return values[seconds] * 1_000_000_000 + values[nanoseconds], scalars

    def columns(self, parts: Sequence[Located]) -> Decoded:
        """
        Extract from many messages: the same as from one after another.

        Parameters
        ----------
        parts : sequence of Located

        Raises
        ------
        FieldError
            If a field is open: how many columns it has is not known.
        """
        count = sum(len(part.offsets) for part in parts)
        found = _Found(np.zeros(count, np.int64) if self.message_type.has_header else None,
                       np.empty((count, sum(field.width for field in self.fields))),
                       np.zeros(count, dtype=bool))
        left = np.arange(count)
        for layout in tuple(self._layouts):
            left = self._fill(layout, parts, left, found)
        for _ in range(KEPT_LAYOUTS):
            if not len(left):
                break
            try:
                layout = self._learn(_raw(parts, left[0]))
            except DecodeError:
                left = left[1:]
                continue
            left = self._fill(layout, parts, left, found)
        for row in left.tolist():
            try:
                stamp, found.values[row] = self(_raw(parts, row))
            except DecodeError:
                continue
            found.sound[row] = True
            if found.header_ns is not None:
                found.header_ns[row] = np.clip(stamp or 0, -2**63, 2**63 - 1)
        return Decoded(found.header_ns, found.values, found.sound)

    def _fill(self, layout: Layout, parts: Sequence[Located], left: Index, found: _Found
              ) -> Index:
        """Read those of the rows that have this layout; return the others."""
        if not len(left) or not layout.table.fits:
            return left
        rows, matches = layout.table.rows(chosen(parts, left))
        if not matches.any():
            return left
        if matches.all():
            own: Index | slice = left if len(left) < len(found.sound) else slice(None)
        else:
            own, rows = left[matches], rows[matches]
        found.sound[own] = True
        if found.header_ns is not None:
            found.header_ns[own] = layout.table.stamps(rows)
        in_place = not self._derived and isinstance(own, slice)
        numbers = found.values if in_place else np.empty((len(rows), len(self._leaves)))
        layout.table.fill(rows, numbers)
        if not in_place:
            # Functions of NumPy may round the last bit of an angle otherwise than those of math.
            found.values[own] = [self._combine(row) for row in numbers.tolist()] \
                if self._derived else numbers
        return left[~matches]

    def _learn(self, raw: Raw) -> Layout:
        if not self._leaves:
            self._bind(raw)
        layout = layout_of(self.message_type, self._leaves, raw, self._sizes)
        self._layouts = [layout, *self._layouts[:KEPT_LAYOUTS - 1]]
        return layout

    def _bind(self, raw: Raw) -> None:
        self.fields = tuple(bind(self.message_type, field, raw) if field.is_open else field
                            for field in self.fields)
        self._spans = []
        leaves: list[Leaf] = []
        for field in self.fields:
            self._spans.append((len(leaves), len(leaves) + len(field.leaves), field))
            leaves += field.leaves
        self._leaves = tuple(leaves)

    def _combine(self, numbers: Sequence[float]) -> tuple[float, ...]:
        scalars: list[float] = []
        for first, end, field in self._spans:
            scalars += field.combine(numbers[first:end])
        return tuple(scalars)


class _Found(NamedTuple):
    """What has been read of messages so far; it is written into."""

    header_ns: Stamps | None
    values: Array
    sound: NDArray[np.bool_]


def _raw(parts: Sequence[Located], row: int) -> memoryview:
    """Return one of the messages."""
    for part in parts:
        if row < len(part.offsets):
            start = int(part.offsets[row])
            return memoryview(part.content)[start:start + int(part.lengths[row])]
        row -= len(part.offsets)
    raise IndexError(row)


def chosen(parts: Sequence[Located], rows: Index) -> Sequence[Located]:
    """
    Return some of the messages.

    Parameters
    ----------
    parts : sequence of Located
    rows : ndarray of int
        Which of all, ascending.
    """
    if len(rows) == sum(len(part.offsets) for part in parts):
        return parts
    some, start = [], 0
    for part in parts:
        low, high = np.searchsorted(rows, (start, start + len(part.offsets)))
        own = rows[low:high] - start
        start += len(part.offsets)
        some.append(part._replace(offsets=part.offsets[own], lengths=part.lengths[own],
                                  log_ns=part.log_ns[own], publish_ns=part.publish_ns[own]))
    return some
