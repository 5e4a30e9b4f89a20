# SPDX-License-Identifier: Apache-2.0
"""Chosen scalars out of serialised messages, without building message objects."""

from __future__ import annotations

from collections.abc import Sequence
import struct

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
