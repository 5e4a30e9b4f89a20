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

from ctsid_ros.decoding.block import Decoded, Index, Located
from ctsid_ros.decoding.cdr_layout import DecodeError, Layout, Raw, Sizes, layout_of
from ctsid_ros.decoding.field_grammar import MAX_WIDTH
from ctsid_ros.decoding.field_path import FieldPath, Leaf
from ctsid_ros.decoding.message_fields import bind, check_field
from ctsid_ros.decoding.message_types import MessageType
from ctsid_ros.decoding.names import Names, join_called, names_of

__all__ = ['ABSENT', 'DecodeError', 'Extracted', 'Extractor']

Extracted = tuple[int | None, tuple[float, ...]]
KEPT_LAYOUTS = 8  # for publishers that take turns on one topic
ABSENT = float('nan')  # this very object: a scalar of an element that a message does not have


class Extractor:
    """
    Reads the header stamp and chosen scalars from raw messages of one type.

    Open ranges (`effort[:]`) are closed by the first message that is read. An element by name
    (`velocity[elbow]`) is where the names in a message say; without it the scalar is `ABSENT`.

    Parameters
    ----------
    message_type : MessageType
    fields : sequence of FieldPath

    Attributes
    ----------
    names : dict of str
        Names of elements in the messages that were read, if elements are chosen.
    called : dict
        What of an array is chosen by index, and how messages name it: see `mixed`.

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
        self._shapes: list[_Shape] = []
        self._sizes: Sizes = {}
        self._derived = any(field.euler for field in fields)
        self._named = [any(names_of(message_type, field.steps[:i]) for i, step
                           in enumerate(field.steps) if not isinstance(step, str))
                       for field in fields]
        self.names: dict[str, None] = {}
        self.called: dict[Leaf, tuple[Leaf, ...]] = {}

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
        for shape in self._shapes:
            layout = shape.layout
            try:
                values = layout.unpack(raw)
            except struct.error:
                continue
            if layout.words(values) == layout.expected:
                break
        else:
            shape = self._learn(raw)
            layout = shape.layout
            values = layout.unpack(raw)
        scalars = layout.scalars(values)
        if not layout.floats:
            scalars = tuple(map(float, scalars))
        if self._derived or not shape.whole:
            scalars = shape.combine(scalars)
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
        shape_of_all = count, sum(field.width for field in self.fields)
        found = Decoded(np.zeros(count, np.int64) if self.message_type.has_header else None,
                        np.empty(shape_of_all), np.zeros(count, dtype=bool),
                        np.zeros(shape_of_all, dtype=bool)
                        if any(field.elements for field in self.fields) else None)
        left = np.arange(count)
        for shape in tuple(self._shapes):
            left = self._fill(shape, parts, left, found)
        for _ in range(KEPT_LAYOUTS):
            if not len(left):
                break
            try:
                shape = self._learn(_raw(parts, left[0]))
            except DecodeError:
                left = left[1:]
                continue
            left = self._fill(shape, parts, left, found)
        for row in left.tolist():
            try:
                stamp, scalars = self(_raw(parts, row))
            except DecodeError:
                continue
            found.values[row], found.sound[row] = scalars, True
            if found.absent is not None:
                found.absent[row] = [scalar is ABSENT for scalar in scalars]
            if found.header_ns is not None:
                found.header_ns[row] = np.clip(stamp or 0, -2**63, 2**63 - 1)
        return found

    def forget(self) -> None:
        """Let `called` tell only of messages that are read from now on."""
        if self.called:
            self.called, self._shapes = {}, []

    def _fill(self, shape: _Shape, parts: Sequence[Located], left: Index, found: Decoded
              ) -> Index:
        """Read those of the rows that have this shape; return the others."""
        table = shape.layout.table
        if not len(left) or not table.fits:
            return left
        rows, matches = table.rows(chosen(parts, left))
        if not matches.any():
            return left
        if matches.all():
            own: Index | slice = left if len(left) < len(found.sound) else slice(None)
        else:
            own, rows = left[matches], rows[matches]
        found.sound[own] = True
        if found.header_ns is not None:
            found.header_ns[own] = table.stamps(rows)
        if found.absent is not None:
            found.absent[own] = shape.absent
        in_place = shape.whole and not self._derived and isinstance(own, slice)
        numbers = found.values if in_place else np.full((len(rows), len(table.scalars)), np.nan)
        table.fill(rows, numbers)
        if self._derived:
            # Functions of NumPy may round the last bit of an angle otherwise than those of math.
            found.values[own] = [shape.combine(row) for row in numbers.tolist()]
        elif not in_place:
            values = np.full((len(rows), len(shape.absent)), np.nan)
            values[:, ~shape.absent] = numbers
            found.values[own] = values
        return left[~matches]

    def _learn(self, raw: Raw) -> _Shape:
        self.fields = tuple(bind(self.message_type, field, raw) if field.is_open else field
                            for field in self.fields)
        names = Names(self.message_type, raw, self._sizes)
        leaves: list[Leaf] = []
        spans: list[tuple[int, int, FieldPath]] = []
        called: list[tuple[Leaf, Leaf]] = []
        for field, named in zip(self.fields, self._named, strict=True):
            own: Sequence[Leaf] = field.leaves
            if named:
                found = [pair for leaf in own if (pair := names.resolve(leaf))]
                complete = len(found) == len(own)
                if complete:
                    called += [(leaf, pair[1]) for leaf, pair in zip(own, found, strict=True)]
                own = [leaf for leaf, _ in found if complete]
            spans.append((len(leaves), len(leaves) + len(own), field))
            leaves += own
        absent = [first == end for first, end, field in spans for _ in range(field.width)]
        shape = _Shape(layout_of(self.message_type, leaves, raw, self._sizes, names.deciding),
                       tuple(spans), np.array(absent, bool), not any(absent))
        self._shapes = [shape, *self._shapes[:KEPT_LAYOUTS - 1]]
        if len(self.names) < MAX_WIDTH:  # some may never repeat
            self.names |= dict.fromkeys(name for own in names.read.values() for name in own)
        for leaf, by_name in called:
            self.called[leaf] = join_called(self.called.get(leaf, ()), [by_name])
        return shape


class _Shape(NamedTuple):
    """Messages of one layout."""

    layout: Layout
    spans: tuple[tuple[int, int, FieldPath], ...]  # of each field in the leaves; empty if absent
    absent: NDArray[np.bool_]  # of the scalars
    whole: bool  # whether none of them is absent

    def combine(self, numbers: Sequence[float]) -> tuple[float, ...]:
        """Turn the numbers at the leaves into the scalars of the fields."""
        scalars: list[float] = []
        for first, end, field in self.spans:
            scalars += field.combine(numbers[first:end]) if first < end else \
                [ABSENT] * field.width
        return tuple(scalars)


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
