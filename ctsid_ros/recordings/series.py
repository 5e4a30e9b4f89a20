# SPDX-License-Identifier: Apache-2.0
"""
Recordings that are columns already: from the series of a file to messages like those of a bag.

A library has read the file into columns. Here their names become the fields of a message type
(`xyz[0]` an array, `esc[1].rpm` an array of messages), and their rows packed messages, so that
whatever reads bags reads them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Block, Located, Stamps
from ctsid_ros.decoding.field_grammar import Name, ParseError, Range, Step, parse_steps
from ctsid_ros.decoding.message_types import HEADER, TIMES, Fields, FieldType, MessageType
from ctsid_ros.recordings.chunks import YEAR
from ctsid_ros.recordings.recording import Connection, Note, Recording, Wanted

BOOT_NS = 10**15  # added to clocks that begin at zero or below: a stamp of zero counts as none
_ROWS = 1 << 16  # that are packed at once
_QUATERNION = ['x', 'y', 'z', 'w']
_STAMP = np.dtype([('sec', '<u4'), ('nanosec', '<u4')])


@dataclass(frozen=True)
class Series:
    """
    Columns with one time each row.

    Parameters
    ----------
    topic : str
    package, name : str
        Of the message type that is made of the columns.
    log_ns : ndarray of int64, shape (N,)
        Positive; in any order.
    columns : mapping of str to ndarray, shape (N,)
        Numbers, by field path; a name that is none is made one.
    header_ns : ndarray of int64, shape (N,), optional
        When what the rows hold was measured, if that is known beside the time of recording.
    units : mapping of str to str, optional
        Of columns that name theirs.
    """

    topic: str
    package: str
    name: str
    log_ns: Stamps
    columns: Mapping[str, NDArray[Any]]
    header_ns: Stamps | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.log_ns)

    @cached_property
    def _shape(self) -> tuple[MessageType, list[str]]:
        """The message type, and the columns in the order of its fields."""
        tree: _Tree = {}
        for column in self.columns:
            _insert(tree, _steps(column), column)
        types: dict[str, Fields] = {}
        order: list[str] = []
        top = f'{self.package}/msg/{self.name}'
        fields = _fields(tree, top, types, order, self)
        if self.header_ns is not None:
            fields = {'header': FieldType(HEADER), **fields}
            types |= {HEADER: {'stamp': FieldType(TIMES[0])},
                      TIMES[0]: {'sec': FieldType('uint32'), 'nanosec': FieldType('uint32')}}
        return MessageType(top, {top: fields, **types}, 'ros1'), order

    @property
    def message_type(self) -> MessageType:
        """The type that its rows are messages of."""
        return self._shape[0]

    @cached_property
    def in_order(self) -> NDArray[np.intp]:
        """The rows in the order of time."""
        return np.argsort(self.log_ns, kind='stable')

    def located(self, slot: int, first: int, end: int) -> Located:
        """Return some rows, in the order of time, as packed messages."""
        rows = self.in_order[first:end]
        _, order = self._shape
        kinds = [('header', _STAMP)] * (self.header_ns is not None) + [
            (f'{i}', _kind(self.columns[name])) for i, name in enumerate(order)]
        packed = np.empty(len(rows), kinds)
        for i, name in enumerate(order):
            packed[f'{i}'] = self.columns[name][rows]
        if self.header_ns is not None:
            packed['header']['sec'], packed['header']['nanosec'] = divmod(
                self.header_ns[rows], 10**9)
        log_ns, size = self.log_ns[rows], packed.dtype.itemsize
        return Located(slot, packed.tobytes(), np.arange(len(rows)) * size,
                       np.full(len(rows), size), log_ns, log_ns)


def recording(series: Sequence[Series], notes: Sequence[str], *, alone: str = '',
              own_clock: bool = False) -> Recording:
    """
    Return series as what a file of a bag is.

    Parameters
    ----------
    series : sequence of Series
        Of different topics.
    notes : sequence of str
    alone, own_clock
        See `Recording`.
    """
    filled = [one for one in series if len(one)]
    connections = tuple(
        Connection(number, one.topic, one.message_type.name, 'ros1', '', '', len(one),
                   one.message_type) for number, one in enumerate(filled))
    return Recording(
        connections, min((int(np.min(one.log_ns)) for one in filled), default=0),
        max((int(np.max(one.log_ns)) for one in filled), default=0), partial(_blocks, filled),
        tuple(notes), alone, own_clock)


def sound_times(times: NDArray[Any], unit_ns: int) -> tuple[Stamps, NDArray[np.bool_]]:
    """
    Return times in ns, and which of them can be of one recording; others come from damage.

    Parameters
    ----------
    times : ndarray of int, shape (N,)
    unit_ns : int
        What they count.
    """
    counts = times.astype(np.uint64)
    sound = (counts > 0) & (counts < 2**62 // unit_ns)
    log_ns = np.where(sound, counts, 0).astype(np.int64) * unit_ns
    if sound.any():
        sound &= np.abs(log_ns - np.median(log_ns[sound])) < YEAR
    return log_ns, sound


def left_out(path: Path, topic: str, sound: NDArray[np.bool_]) -> list[str]:
    """Return the note on messages whose times are not sound, if there are any."""
    count = len(sound) - int(np.count_nonzero(sound))
    what = 'message left out whose time is' if count == 1 else 'messages left out whose times are'
    return [f'{path.name}: topic {topic}: {count} {what} zero or impossible'] if count else []


def _blocks(series: Sequence[Series], wanted: Wanted, note: Note) -> Iterator[Block]:
    chosen = [(slot, series[number], series[number].log_ns[series[number].in_order])
              for number, slot in wanted.slots.items()]
    times = np.sort(np.concatenate([log_ns for _, _, log_ns in chosen]))
    cuts = [*times[_ROWS::_ROWS].tolist(), None]
    firsts = [0] * len(chosen)
    for cut in cuts:
        ends = [len(log_ns) if cut is None else int(np.searchsorted(log_ns, cut))
                for _, _, log_ns in chosen]
        yield wanted.block([one.located(slot, first, end) for (slot, one, _), first, end
                            in zip(chosen, firsts, ends, strict=True) if end > first])
        firsts = ends


_Tree = dict[str | int, Any]  # names and indices; at a leaf the column


def _steps(column: str) -> tuple[Step, ...]:
    """Return the steps of a column's name, or one that is made of it if it is no field path."""
    try:
        steps, euler = parse_steps(column)
        if not euler and not any(isinstance(step, Range | Name) for step in steps):
            return steps
    except ParseError:
        pass
    return (plain_name(column),)


def plain_name(text: str) -> str:
    """Return letters, digits and _ of a text, so that it can be a name."""
    name = re.sub(r'\W+', '_', text, flags=re.ASCII).strip('_') or 'column'
    return f'_{name}' if name[0].isdigit() else name


def _insert(tree: _Tree, steps: Sequence[Step], column: str) -> None:
    """Put a column at its place; where that is taken, under a name of its own."""
    node = tree
    for step in steps[:-1]:
        node = node.setdefault(step, {})  # type: ignore[arg-type]
        if not isinstance(node, dict):
            break
    if isinstance(node, dict) and steps[-1] not in node:
        node[steps[-1]] = column  # type: ignore[index]
        return
    name = plain_name(column)
    names = (name, *(f'{name}_{i}' for i in range(2, len(tree) + 3)))
    tree[next(free for free in names if free not in tree)] = column


def _fields(tree: _Tree, name: str, types: dict[str, Fields], order: list[str],
            series: Series) -> dict[str, FieldType]:
    """Describe the members of a message; the types below it are added to `types`."""
    fields: dict[str, FieldType] = {}
    for key, node in tree.items():
        if isinstance(node, dict) and not _regular(node, series.columns):
            # Indices that are missing, or elements that differ: each a field of its own.
            for column in _leaves(node):
                flat: _Tree = {}
                _insert(flat, (plain_name(column),), column)
                fields |= _fields(flat, name, types, order, series)
        else:
            fields[str(key)] = _field(node, f'{name}_{key}', types, order, series)
    return fields


def _field(node: Any, name: str, types: dict[str, Fields], order: list[str],
           series: Series) -> FieldType:
    if not isinstance(node, dict):
        order.append(node)
        return FieldType(_kind(series.columns[node]).name, unit=series.units.get(node, ''))
    if 0 in node:
        elements = [_field(node[i], name, types, order, series) for i in range(len(node))]
        return FieldType(elements[0].base, 'array', len(node), elements[0].unit)
    if [*node] == _QUATERNION:
        name = f'{name}_Quaternion'  # `euler(...)` of it is offered
    types[name] = _fields(node, name, types, order, series)
    return FieldType(name)


def _regular(node: _Tree, columns: Mapping[str, NDArray[Any]]) -> bool:
    """Whether indices count from 0, and all elements of an array are alike."""
    if not any(isinstance(key, int) for key in node):
        return True
    if sorted(map(str, node)) != sorted(map(str, range(len(node)))):
        return False
    return len({_signature(inner, columns) for inner in node.values()}) == 1 and not any(
        isinstance(inner, dict) and 0 in inner for inner in node.values())


def _signature(node: Any, columns: Mapping[str, NDArray[Any]]) -> str:
    if not isinstance(node, dict):
        return _kind(columns[node]).name
    return str([(key, _signature(inner, columns)) for key, inner in node.items()])


def _leaves(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        for inner in node.values():
            yield from _leaves(inner)
    else:
        yield node


def _kind(column: NDArray[Any]) -> np.dtype[Any]:
    """Return the packed type of a column: little endian, as wide as it is; half floats wider."""
    return np.dtype('<f4') if column.dtype == np.float16 else column.dtype.newbyteorder('<')
