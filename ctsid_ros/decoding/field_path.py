# SPDX-License-Identifier: Apache-2.0
"""
Field paths: which scalars of a message are signals; their syntax is in `field_grammar.py`.

`euler(path)` turns a quaternion x, y, z, w into the angles of `angles.py`; those of one message
know nothing of the one before: they are unwrapped in each window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import difflib
from itertools import product
import re
from typing import Any

from ctsid_ros.decoding.angles import EULER_PARTS, QUATERNION, roll_pitch_yaw
from ctsid_ros.decoding.field_grammar import Name, ParseError, Range, Step, parse_steps, path_text

__all__ = ['FieldError', 'FieldPath', 'Leaf', 'Name', 'ParseError', 'Range', 'Step',
           'nearest', 'parse_field', 'path_text', 'plain', 'roll_pitch_yaw']

Leaf = tuple[str | int | Name, ...]


class FieldError(ValueError):
    """A field path that leads nowhere, or not to numbers, in this message or type."""


@dataclass(frozen=True)
class FieldPath:
    """
    A parsed field path.

    Parameters
    ----------
    steps : tuple of str, int, Range or Name
        Names of fields, indices, ranges and names of elements, from the message inwards.
    euler : tuple of str
        The angles wanted of the quaternions at `steps`; empty for plain numbers.
    """

    steps: tuple[Step, ...]
    euler: tuple[str, ...] = ()

    def __str__(self) -> str:
        path = path_text(self.steps)
        part = f'.{self.euler[0]}' if len(self.euler) == 1 else ''
        return f'euler({path}){part}' if self.euler else path

    @property
    def is_open(self) -> bool:
        """Whether its number of scalars is known only from a message (`effort[:]`)."""
        return any(isinstance(step, Range) and step.end is None for step in self.steps)

    @property
    def elements(self) -> tuple[str, ...]:
        """The elements that it chooses by name (`velocity[elbow]`)."""
        return tuple(step.name for step in self.steps if isinstance(step, Name))

    @property
    def width(self) -> int:
        """
        Number of scalars.

        Raises
        ------
        FieldError
            If the path is open.
        """
        return len(self.angles)

    @property
    def angles(self) -> tuple[bool, ...]:
        """
        Which of the scalars are angles that have to be unwrapped.

        Raises
        ------
        FieldError
            If the path is open.
        """
        count = len(self._concrete())
        return (True,) * (count * len(self.euler)) if self.euler else (False,) * count

    @property
    def leaves(self) -> tuple[Leaf, ...]:
        """
        The numbers of the message that are read, in order: four for each quaternion.

        Raises
        ------
        FieldError
            If the path is open.
        """
        if not self.euler:
            return self._concrete()
        return tuple((*leaf, part) for leaf in self._concrete() for part in QUATERNION)

    def _concrete(self) -> tuple[Leaf, ...]:
        choices: list[Sequence[str | int | Name]] = []
        for step in self.steps:
            if not isinstance(step, Range):
                choices.append((step,))
            elif step.end is None:
                raise FieldError(f'the length of `{self}` is known only from a message: give '
                                 'the end of the range, or bind() the path to a message')
            else:
                choices.append(range(step.first, step.end))
        return tuple(product(*choices))

    def bind(self, length_of: Callable[[tuple[Step, ...]], int]) -> FieldPath:
        """
        Close the open ranges.

        Parameters
        ----------
        length_of : callable
            Takes the steps to an array (ranges before it by their first element), gives its
            length.

        Raises
        ------
        FieldError
            If a range would be empty.
        """
        steps: list[Step] = []
        for step in self.steps:
            if isinstance(step, Range) and step.end is None:
                to_array = tuple(s.first if isinstance(s, Range) else s for s in steps)
                step = Range(step.first, length_of(to_array))
                if step.first >= (step.end or 0):
                    raise FieldError(f'`{self}`: {path_text(to_array)} has {step.end} elements '
                                     'in this message')
            steps.append(step)
        return replace(self, steps=tuple(steps))

    def combine(self, numbers: Sequence[float]) -> list[float]:
        """Turn the numbers at `leaves` into the scalars of this path."""
        if not self.euler:
            return list(numbers)
        scalars: list[float] = []
        for k in range(0, len(numbers), 4):
            angles = roll_pitch_yaw(*numbers[k:k + 4])
            scalars += [angles[EULER_PARTS.index(part)] for part in self.euler]
        return scalars

    def get(self, message: object) -> list[float]:
        """
        Read the scalars from a message object of rclpy or rosbags (or alike).

        Raises
        ------
        FieldError
            If a field does not exist, an index lies beyond the array, it is not a number, or is
            chosen by name.
        """
        targets = _reach(message, self.steps, self)
        if self.euler:
            return self.combine([_number(_reach_name(target, part, self), self)
                                 for target in targets for part in QUATERNION])
        return [_number(target, self) for target in targets]


def parse_field(text: str) -> FieldPath:
    """
    Parse a field path.

    Raises
    ------
    ParseError
        If it does not follow the grammar.
    """
    return FieldPath(*parse_steps(text))


def plain(text: str) -> str:
    """Return a field without the names of elements: people give them, whatever it is."""
    return re.sub(r'\[[^\]\d][^\]]*\]', '[]', text)


def nearest(name: str, names: Sequence[str]) -> str:
    """Return a hint: the names most like `name`, and all of them where they are few."""
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    hint = f'; nearest: {", ".join(near)}' if near else ''
    rest = [other for other in names if other not in near]
    if rest and len(names) <= 12:
        hint += f'; {"also" if near else "there are"}: {", ".join(rest)}'
    return hint


def _reach(target: object, steps: Sequence[Step], path: FieldPath) -> Iterator[object]:
    if not steps:
        yield target
        return
    step, rest = steps[0], steps[1:]
    if isinstance(step, str):
        yield from _reach(_reach_name(target, step, path), rest, path)
        return
    if isinstance(target, str | bytes) or not hasattr(target, '__getitem__'):
        raise FieldError(f'`{path}`: {type(target).__name__} before {path_text((step,))} is not '
                         'an array')
    if isinstance(step, Name):
        raise FieldError(f'`{path}`: elements of message objects are chosen by index')
    elements: Any = target
    count = len(elements)
    chosen = range(step, step + 1) if isinstance(step, int) else range(
        step.first, count if step.end is None else step.end)
    if chosen.stop > count:
        raise FieldError(f'`{path}`: the array has {count} elements in this message')
    for i in chosen:
        yield from _reach(elements[i], rest, path)


def _reach_name(target: object, name: str, path: FieldPath) -> object:
    # Both rclpy and rosbags append an underscore to a field that is a keyword of Python.
    for attribute in (name, f'{name}_'):
        if hasattr(target, attribute):
            return getattr(target, attribute)
    names = [n for n in dir(target) if not n.startswith('_') and not n.isupper()
             and not callable(getattr(target, n))]  # constants are upper case
    raise FieldError(f'`{path}`: {type(target).__name__} has no field {name!r}'
                     + nearest(name, names))


def _number(value: Any, path: FieldPath) -> float:
    if isinstance(value, bytes) and len(value) == 1:  # rclpy's `byte`
        return float(value[0])
    if isinstance(value, str | bytes) or hasattr(value, '__len__'):
        raise FieldError(f'`{path}` is not a number but {type(value).__name__}')
    try:
        return float(value)
    except (TypeError, ValueError):
        raise FieldError(f'`{path}` is not a number but {type(value).__name__}; name one of its '
                         'fields') from None
