# SPDX-License-Identifier: Apache-2.0
"""
Elements of arrays by name: which one `velocity[elbow]` is, in each message.

A message says so in an array of texts that is called `name`, `joint_names` or the like, beside
the array or in a message around it (JointState, DynamicJointState, JointTrajectory, LinkStates).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import re

from ctsid_ros.decoding.cdr_layout import COUNT, Raw, Sizes, layout_of
from ctsid_ros.decoding.field_path import (
    FieldPath,
    Leaf,
    Name,
    ParseError,
    Step,
    nearest,
    parse_field,
    path_text,
)
from ctsid_ros.decoding.message_types import FieldType, MessageType

_NAMES = re.compile(r'(\w+_)?names?')


def names_of(message_type: MessageType, steps: Sequence[Step]) -> tuple[Step, ...] | None:
    """Return the steps to the names of the elements of the array at `steps`; None without any."""
    found = None
    kind = message_type.name
    for depth, step in enumerate(steps):
        if isinstance(step, str):
            members = message_type.types.get(kind, {})
            own = next((name for name, field in members.items() if field.base == 'string'
                        and field.kind != 'single' and _NAMES.fullmatch(name)), None)
            found = (*steps[:depth], own) if own else found
            kind = members.get(step, FieldType('')).base
    return found


def by_name(message_type: MessageType, field: FieldPath, raw: Raw) -> FieldPath:
    """
    Return a scalar field by the names that a message has, if no two are alike; else as it is.

    Raises
    ------
    DecodeError
        If the message cannot be decoded.
    """
    names = Names(message_type, raw, {})
    pair = names.resolve(field.leaves[0])
    if pair is None or any(len({*own}) < len(own) for own in names.read.values()):
        return field
    named = FieldPath(pair[1][:len(field.steps)], field.euler)
    try:
        return parse_field(str(named))
    except ParseError:
        return field


def title(field: FieldPath) -> str:
    """Return what a field by name is of which element: elbow_velocity; '' if it is by index."""
    at = max((i for i, step in enumerate(field.steps) if isinstance(step, Name)), default=0)
    inner = [step for step in (*field.steps[at + 1:], *field.euler) if isinstance(step, str)]
    if not inner and len(field.elements) == 1:
        inner = [str(field.steps[at - 1])]
    return '_'.join((*field.elements, *inner)) if at else ''


def missing(field: FieldPath, names: Iterable[str], when: str = '') -> str:
    """Return the sentence on a field by name that no message has; they have these names."""
    return f'no message{when} has `{field}`' + (
        nearest(field.elements[-1], list(names)) or '; there are no names in them')


def join_called(one: Sequence[Leaf], other: Sequence[Leaf]) -> tuple[Leaf, ...]:
    """Return how some messages name an element and others do: two ways at most."""
    return tuple(dict.fromkeys((*one, *other)))[:2]


def mixed(field: FieldPath, called: Mapping[Leaf, Sequence[Leaf]]) -> str:
    """Return a sentence if a field by index is not always of one name; else ''."""
    for leaf in () if field.is_open else field.leaves:
        if len(names := called.get(leaf, ())) > 1:
            one, other = map(path_text, names)
            return (f'`{field}` is {one} in some messages and {other} in others; choose one of '
                    'them by its name instead')
    return ''


class Names:
    """
    The names in one message, read where they are wanted.

    Attributes
    ----------
    read : dict
        Names by the steps to their array.
    deciding : dict of Leaf
        What elements were chosen by: in messages where that is another, they may be others.
    """

    def __init__(self, message_type: MessageType, raw: Raw, sizes: Sizes) -> None:
        self._type, self._raw, self._sizes = message_type, raw, sizes
        self.read: dict[Leaf, tuple[str, ...]] = {}
        self.deciding: dict[Leaf, None] = {}

    def resolve(self, leaf: Leaf) -> tuple[Leaf, Leaf] | None:
        """
        Return a leaf by indices, and by names where there are some; None if it lacks its name.

        Raises
        ------
        DecodeError
            If the message cannot be decoded.
        """
        found: Leaf = ()
        called: Leaf = ()
        for depth, step in enumerate(leaf):
            name = step
            array = None if isinstance(step, str) else names_of(self._type, leaf[:depth])
            if array is not None:
                at: Leaf = (*found[:len(array) - 1], str(array[-1]))
                names = self._at(at)
                if isinstance(step, Name):
                    self._decide(at, [*range(len(names)), *([] if names else [COUNT])])
                    if step.name not in names:
                        return None
                    name, step = step, names.index(step.name)
                elif isinstance(step, int) and step < len(names) == self._count(found):
                    self._decide(at, (step,))
                    name = Name(names[step])
            found = (*found, step)
            called = (*called, name)
        return found, called

    def _decide(self, at: Leaf, which: Iterable[int | str]) -> None:
        self.deciding |= dict.fromkeys((*at, one) for one in which)

    def _at(self, at: Leaf) -> tuple[str, ...]:
        if at not in self.read:
            count = self._count(at)
            layout = layout_of(self._type, [(*at, i) for i in range(count)], self._raw,
                               self._sizes)
            texts = layout.scalars(layout.unpack(self._raw)) if count else ()
            self.read[at] = tuple(text.rstrip(b'\0').decode(errors='replace') for text in texts)
        return self.read[at]

    def _count(self, at: Leaf) -> int:
        found = FieldType(self._type.name)
        for step in at:
            found = self._type.types[found.base][step] if isinstance(step, str) else found
        if found.kind == 'array':
            return found.length
        layout = layout_of(self._type, [(*at, COUNT)], self._raw, self._sizes)
        return int(layout.scalars(layout.unpack(self._raw))[0])
