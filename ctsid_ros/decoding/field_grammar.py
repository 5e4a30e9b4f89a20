# SPDX-License-Identifier: Apache-2.0
"""
Grammar of field paths, and its parser.

    field     = path | 'euler(' path ')' [ '.roll' | '.pitch' | '.yaw' ]
    path      = name { '.' name | '[' index ']' | '[' [ first ] ':' [ end ] ']' | '[' element ']' }

Examples: `twist.linear.x`, `position[2]`, `position[0:6]`, `effort[:]`, `poses[0].position.x`,
`velocity[elbow]`, `euler(pose.orientation).roll`. Indices count from 0, `end` is excluded as in
Python. An element has the name that an array of names in the message gives it: letters, or any
characters in quotes (`velocity['1']`).
"""

from __future__ import annotations

from collections.abc import Sequence
import math
import re
from typing import NamedTuple, NoReturn

from ctsid_ros.decoding.angles import EULER_PARTS

MAX_WIDTH = 10_000
_TOKEN = re.compile(r'[A-Za-z_]\w*|\d+|\S', re.ASCII)
_PLAIN = re.compile(r'[A-Za-z_][^\s\[\]\'"]*')
_QUOTED = re.compile(r'\'([^\'\[\]]+)\'|"([^"\[\]]+)"')


class ParseError(ValueError):
    """A field path that does not follow the grammar; the message points at the position."""


class Range(NamedTuple):
    """Elements `first` to `end` (excluded) of an array; up to its end where `end` is None."""

    first: int
    end: int | None


class Name(NamedTuple):
    """The element of an array that a message calls so."""

    name: str

    def __str__(self) -> str:
        if _PLAIN.fullmatch(self.name):
            return self.name
        return f'"{self.name}"' if "'" in self.name else f"'{self.name}'"


Step = str | int | Range | Name


def path_text(steps: Sequence[Step]) -> str:
    """Return steps as text."""
    text = ''
    for step in steps:
        if isinstance(step, str):
            text += f'.{step}' if text else step
        elif isinstance(step, int | Name):
            text += f'[{step}]'
        else:
            end = '' if step.end is None else step.end
            text += f'[{step.first}:{end}]' if step != (0, None) else '[:]'
    return text


def parse_steps(text: str) -> tuple[tuple[Step, ...], tuple[str, ...]]:
    """
    Parse a field path into its steps and the angles wanted of a quaternion there, if any.

    Raises
    ------
    ParseError
        If it does not follow the grammar.
    """
    if not isinstance(text, str):
        raise ParseError(f'a field path is text such as twist.linear.x, not {text!r}')
    steps, euler = _Parser(text).field()
    ranges = [step for step in steps if isinstance(step, Range)]
    if math.prod(s.end - s.first for s in ranges if s.end is not None) > MAX_WIDTH:
        raise ParseError(f'{text} stands for more than {MAX_WIDTH} scalars; choose fewer')
    return steps, euler


class _Parser:
    """Recursive descent over the tokens of one text; one method per rule of the grammar."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = [(m.group(), m.start()) for m in _TOKEN.finditer(text)]
        self.tokens.append(('', len(text)))
        self.next = 0

    @property
    def token(self) -> str:
        return self.tokens[self.next][0]

    def field(self) -> tuple[tuple[Step, ...], tuple[str, ...]]:
        if len(self.tokens) > 1 and self.tokens[1][0] == '(':
            parsed = self.function()
        else:
            parsed = self.path(), ()
        if self.token:
            self.fail("'.', '[' or the end")
        return parsed

    def function(self) -> tuple[tuple[Step, ...], tuple[str, ...]]:
        if self.token != 'euler':
            self.fail("the function 'euler'")
        self.next += 2
        steps = self.path()
        self.expect(')')
        if self.token != '.':
            return steps, EULER_PARTS
        self.next += 1
        if self.token not in EULER_PARTS:
            self.fail('one of ' + ', '.join(EULER_PARTS))
        self.next += 1
        return steps, (self.tokens[self.next - 1][0],)

    def path(self) -> tuple[Step, ...]:
        steps: list[Step] = [self.name()]
        while self.token in ('.', '['):
            self.next += 1
            if self.tokens[self.next - 1][0] == '.':
                steps.append(self.name())
            else:
                steps.append(self.element() or self.index_or_range())
        return tuple(steps)

    def name(self) -> str:
        if not re.match(r'[A-Za-z_]', self.token):
            self.fail('a name')
        self.next += 1
        return self.tokens[self.next - 1][0]

    def element(self) -> Name | None:
        at = self.tokens[self.next][1]
        quoted = _QUOTED.match(self.text, at)
        found = quoted or _PLAIN.match(self.text, at)
        if not found:
            return None
        while self.tokens[self.next][1] < found.end():
            self.next += 1
        self.expect(']')
        return Name(quoted[1] or quoted[2] if quoted else found[0])

    def index_or_range(self) -> Step:
        first = self.number()
        if self.token != ':':
            if first is None:
                self.fail("an index such as 0 (counting from the front), ':' or a name")
            self.expect(']')
            return first
        self.next += 1
        at = self.next
        end = self.number()
        self.expect(']')
        if end is not None and end <= (first or 0):
            self.next = at
            self.fail(f'an end above {first or 0} (the range would be empty)')
        return Range(first or 0, end)

    def number(self) -> int | None:
        if not re.fullmatch(r'\d+', self.token, re.ASCII):
            return None
        if len(self.token) > 6:
            self.fail('an index below a million')
        self.next += 1
        return int(self.tokens[self.next - 1][0])

    def expect(self, token: str) -> None:
        if self.token != token:
            self.fail(repr(token))
        self.next += 1

    def fail(self, wanted: str) -> NoReturn:
        found, at = self.tokens[self.next]
        raise ParseError(f'expected {wanted} but found {repr(found) if found else "the end"} at '
                         f'position {at} of the field path\n    {self.text}\n    {" " * at}^')
