# SPDX-License-Identifier: Apache-2.0
"""
Where the fields of a serialised message lie.

The position of a field depends only on the length words before it: the lengths of strings and
sequences. So one message is walked with the type's definition up to the last wanted field; from
then on a single `struct.Struct` with pad bytes reads the length words AND the fields of each
message. Equal length words mean an equal layout, by induction from the first one.

Two encodings: CDR (plain XCDR1, either byte order: the OMG's DDSI-RTPS 10.5 with the alignment of
CORBA 3.4 part 2, 9.3) and ROS 1 (little endian, packed).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from operator import itemgetter
import struct
from typing import Any

from ctsid_ros.decoding.field_path import Leaf
from ctsid_ros.decoding.message_types import FieldType, MessageType
from ctsid_ros.decoding.table import Table

Raw = bytes | bytearray | memoryview
Sizes = dict[tuple[str, int], int | None]

CODES = {'bool': '?', 'byte': 'B', 'char': 'B', 'int8': 'b', 'uint8': 'B', 'int16': 'h',
         'uint16': 'H', 'int32': 'i', 'uint32': 'I', 'int64': 'q', 'uint64': 'Q',
         'float32': 'f', 'float64': 'd'}
SIZES = {base: struct.calcsize('<' + code) for base, code in CODES.items()}
STAMP: tuple[Leaf, Leaf] = (('header', 'stamp', 'sec'), ('header', 'stamp', 'nanosec'))
COUNT = '#'  # pseudo-field of a sequence: its length word


# No middleware of ROS 2 writes these. Where their headers are depends on which types may be
# extended, and the definitions in bags do not say that.
_XCDR2 = {bytes((0, kind + end)): name for kind, name in (
    (6, 'PLAIN_CDR2'), (8, 'DELIMITED_CDR2'), (10, 'PL_CDR2')) for end in (0, 1)}


class DecodeError(ValueError):
    """A message that is too short for its type, or whose arrays lack a wanted element."""


@dataclass(frozen=True)
class Layout:
    """Where the length words and the wanted fields of messages of one shape lie."""

    unpack: Callable[[Raw], tuple[Any, ...]]
    words: Callable[[tuple[Any, ...]], Any]
    expected: Any
    scalars: Callable[[tuple[Any, ...]], tuple[Any, ...]]
    stamp: tuple[int, int] | None
    floats: bool
    table: Table


_Wanted = dict[Any, Any]  # tree of steps; an int at a leaf is its slot


def layout_of(message_type: MessageType, leaves: Sequence[Leaf], raw: Raw, sizes: Sizes,
              same: Collection[Leaf] = ()) -> Layout:
    """
    Walk one message up to the last wanted leaf and return its layout.

    Messages have it only if the leaves `same` hold what they hold in this one.
    """
    stamp = STAMP if message_type.has_header else ()
    wanted: _Wanted = {}
    slots = {leaf: slot for slot, leaf in enumerate(dict.fromkeys((*stamp, *leaves, *same)))}
    for leaf, slot in slots.items():
        node = wanted
        for step in leaf[:-1]:
            node = node.setdefault(step, {})
        node[leaf[-1]] = slot
    walker = _Walker(message_type, raw, len(slots), sizes)
    if slots:
        walker.message(walker.start, message_type.name, wanted)
    item_of = [walker.slots[slots[leaf]] for leaf in (*stamp, *leaves)]
    floats = all(walker.items[i][1] in 'fd' for i in item_of[len(stamp):])
    unpack = struct.Struct(walker.format()).unpack_from
    expected = [*walker.words, *(walker.slots[slots[leaf]] for leaf in same)]
    words = _picker(expected)
    scalars, pair = item_of[len(stamp):], (item_of[0], item_of[1]) if stamp else None
    values = unpack(raw)
    table = Table(walker.order, tuple(walker.items), {i: values[i] for i in expected},
                  tuple(scalars), pair)
    return Layout(unpack, words, words(values), _picker(scalars), pair, floats, table)


def _picker(indices: Sequence[int]) -> Callable[[tuple[Any, ...]], tuple[Any, ...]]:
    """Return the quickest function that picks these items of a tuple, as a tuple."""
    first = indices[0] if indices else 0
    if list(indices) == list(range(first, first + len(indices))):
        return itemgetter(slice(first, first + len(indices)))
    return itemgetter(*indices)


class _Walker:
    """
    One pass over one message: notes position and code of each length word and wanted field.

    Parameters
    ----------
    message_type : MessageType
    raw : bytes-like
    missing : int
        Number of wanted fields; the pass ends when all are found.
    sizes : dict
        Sizes of types without strings and sequences, by (type, position modulo 8): a memory that
        passes share.
    """

    def __init__(self, message_type: MessageType, raw: Raw, missing: int, sizes: Sizes) -> None:
        self.types, self.raw, self.missing, self.sizes = message_type.types, raw, missing, sizes
        self.packed = message_type.encoding == 'ros1'
        self.items: list[tuple[int, str]] = []
        self.words: list[int] = []
        self.slots: dict[int, int] = {}
        self.order, self.start = '<', 0
        if not self.packed:
            self.encapsulation()

    def encapsulation(self) -> None:
        kind = bytes(self.raw[:2])
        if kind in _XCDR2:
            raise DecodeError(f'messages that begin with {kind.hex(" ")} ({_XCDR2[kind]} of '
                              'XCDR2) are not read: no middleware of ROS 2 writes them')
        if len(self.raw) < 4 or kind not in (b'\0\0', b'\0\1'):
            raise DecodeError(f'{len(self.raw)} bytes that begin with {kind.hex(" ") or "nothing"}'
                              ' are not a CDR message: 00 00 or 00 01 and two more come first')
        self.order, self.start = '<' if kind[1] else '>', 4
        self.words.append(0)
        self.items.append((0, '2s'))

    def format(self) -> str:
        text, position = self.order, 0
        for start, code in self.items:
            text += f'{start - position}x{code}'
            position = start + struct.calcsize('<' + code)
        return text

    def align(self, position: int, size: int) -> int:
        # Alignment counts from the end of the encapsulation, at byte 4: modulo 8 that matters.
        return position if self.packed else position + (self.start - position) % size

    def need(self, end: int) -> None:
        if end > len(self.raw):
            raise DecodeError(f'the message ends after {len(self.raw)} bytes; its type needs at '
                              f'least {end}')

    def word(self, position: int) -> tuple[int, int]:
        """Note the length word at the next multiple of 4; return it and the position after."""
        position = self.align(position, 4)
        self.need(position + 4)
        self.words.append(len(self.items))
        self.items.append((position, 'I'))
        return struct.unpack_from(self.order + 'I', self.raw, position)[0], position + 4

    def want(self, position: int, base: str, slot: int) -> None:
        # ROS 1 has a signed byte, ROS 2 an octet.
        self.note(position, 'b' if self.packed and base == 'byte' else CODES[base], slot)

    def note(self, position: int, code: str, slot: int) -> None:
        self.need(position + struct.calcsize('<' + code))
        self.slots[slot] = len(self.items)
        self.items.append((position, code))
        self.missing -= 1

    def message(self, position: int, name: str, wanted: _Wanted) -> int:
        if name not in self.types:
            raise DecodeError(f'the definition of {name} is missing or not supported')
        for field, declared in self.types[name].items():
            position = self.field(position, declared, wanted.get(field, {}))
            if not self.missing:
                break
        return position

    def field(self, position: int, declared: FieldType, wanted: Any) -> int:
        if declared.kind == 'single':
            return self.element(position, declared.base, wanted)
        count = declared.length
        if declared.kind == 'sequence':
            count, position = self.word(position)
            self.need(position + count)  # each element takes a byte or more
            if COUNT in wanted:
                self.slots[wanted[COUNT]] = self.words[-1]
                self.missing -= 1
        beyond = [i for i in wanted if i != COUNT and i >= count]
        if beyond:
            raise DecodeError(f'element {min(beyond)} is wanted of an array that has {count} '
                              'elements in this message')
        if declared.base in SIZES:
            return self.numbers(position, declared.base, count, wanted)
        for i in range(count):
            position = self.element(position, declared.base, wanted.get(i, {}))
            if not self.missing:
                break
        return position

    def numbers(self, position: int, base: str, count: int, wanted: _Wanted) -> int:
        if not count:
            return position
        position = self.align(position, SIZES[base])
        for i in sorted(i for i in wanted if isinstance(i, int)):
            self.want(position + i * SIZES[base], base, wanted[i])
        return position + count * SIZES[base]

    def element(self, position: int, base: str, wanted: Any) -> int:
        if base in SIZES:
            position = self.align(position, SIZES[base])
            if wanted != {}:
                self.want(position, base, wanted)
            return position + SIZES[base]
        if base == 'string':
            length, position = self.word(position)
            if wanted != {}:
                self.note(position, f'{length}s', wanted)
            return position + length
        if base.rpartition('/')[2] == 'wstring':
            raise DecodeError('a text of wide characters (wstring) comes first, which versions of '
                              'ROS 2 write with 2 or 4 bytes for each; only fields before it can '
                              'be read')
        if not wanted:
            size = self.fixed_size(base, (position - self.start) % 8)
            if size is not None:
                return position + size
        return self.message(position, base, wanted)

    def fixed_size(self, name: str, phase: int) -> int | None:
        """Return the size of a type at a position modulo 8; None if its messages differ."""
        if (name, phase) not in self.sizes:
            self.sizes[name, phase] = self.measure(name, phase)
        return self.sizes[name, phase]

    def measure(self, name: str, phase: int) -> int | None:
        position = self.start + phase
        for declared in self.types.get(name, {'': FieldType('string')}).values():
            for _ in range(1 if declared.kind == 'single' else declared.length):
                if declared.base in SIZES:
                    position = self.align(position, SIZES[declared.base]) + SIZES[declared.base]
                    continue
                size = (None if declared.base == 'string'
                        else self.fixed_size(declared.base, (position - self.start) % 8))
                if size is None:
                    return None
                position += size
            if declared.kind == 'sequence':
                return None
        if not self.types[name] and not self.packed:
            position += 1  # CDR gives a type without fields one byte
        return position - self.start - phase
