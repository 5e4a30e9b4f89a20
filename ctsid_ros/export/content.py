# SPDX-License-Identifier: Apache-2.0
"""
What every export says of a model, and how text from bags is kept harmless in it.

Names, units and reasons may hold anything: quotes, line breaks, ends of comments. In a comment a
text is one line of printable ASCII; in a string each target escapes it by its own rules.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from ctsid_core.model.estimate import Estimate
from ctsid_core.model.model_json import EQUATIONS
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.actuators import in_words


@dataclass(frozen=True)
class Content:
    """
    A model on its way out.

    Parameters
    ----------
    model : StateSpace
        The accepted model of the estimate, or its rejected one.
    estimate : Estimate
    origin : str
        Where it comes from, for people.
    """

    model: StateSpace
    estimate: Estimate
    origin: str

    @property
    def grade(self) -> str:
        """GOOD, WEAK or REJECT."""
        return self.estimate.verdict.grade.name

    def comments(self) -> Iterator[str]:
        """Yield what people should know, as lines of printable ASCII."""
        model = self.model
        yield f'Exported by ctsid from {comment(self.origin)}.'
        yield f'Verdict {self.grade}: {comment(self.estimate.verdict.reason)}'
        yield comment(EQUATIONS)
        yield from channel_lines('input', model.input_names, model.input_units)
        yield from channel_lines('output', model.output_names, model.output_units)
        for words in in_words(named(model.input_names, 'u'), model.actuators,
                              model.input_units):
            yield comment(f'{words}; this is not in the equations')


def channel_lines(kind: str, names: Sequence[str], units: Sequence[str]) -> Iterator[str]:
    """Yield a line for each channel, printable ASCII."""
    for i, (name, unit) in enumerate(zip(named(names, kind[0]), units, strict=True), 1):
        yield f'{kind} {i}: {comment(name)}' + (f' [{comment(unit)}]' if unit else '')


def named(names: Iterable[str], letter: str) -> list[str]:
    """Return names of channels, u1, u2, ... or y1, y2, ... for those that have none."""
    return [name or f'{letter}{i}' for i, name in enumerate(names, 1)]


def comment(text: str) -> str:
    """Return text as printable ASCII on one line, in which no comment of C begins or ends."""
    line = ''.join(c if c.isprintable() and c.isascii() else c.encode(
        'unicode_escape').decode() for c in text)
    return line.replace('*/', '* /').replace('/*', '/ *')
