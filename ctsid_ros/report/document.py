# SPDX-License-Identifier: Apache-2.0
"""A report once: for the terminal and as Markdown here, as a page in `page.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import textwrap
from typing import TYPE_CHECKING

from ctsid_ros.report.tables import Table
from ctsid_ros.report.words import cell, markdown, printable

if TYPE_CHECKING:
    from ctsid_ros.report.drawing import Drawing

WIDTH = 99

GLOSSARY = 'Each quantity is explained in docs/glossary.md of ctsid.'


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Command:
    """A line for the shell."""

    line: str


@dataclass(frozen=True)
class Figure:
    """A drawing with its title and caption; on the page only."""

    drawing: Drawing
    caption: str = ''
    title: str = ''


@dataclass(frozen=True)
class Gallery:
    """Figures side by side in so many columns, where there is room; on the page only."""

    figures: tuple[Figure, ...]
    columns: int = 1


@dataclass(frozen=True)
class Explorer:
    """The place of the page where one of a series is shown: a window, or an order."""

    first: int = 0
    what: str = 'window'


@dataclass(frozen=True)
class Picture:
    """A drawing that is there already, as SVG, and what it shows; on the page only."""

    svg: bytes
    title: str


Part = str | Table | Bullets | Command | Figure | Gallery | Explorer | Picture


@dataclass(frozen=True)
class Section:
    """
    A heading and what comes below.

    Parameters
    ----------
    title : str
    parts : tuple
        Paragraphs, tables, lists and figures.
    brief : bool
        Whether it belongs on the terminal too.
    folded : bool
        Whether the page shows it on request only.
    """

    title: str
    parts: tuple[Part, ...]
    brief: bool = True
    folded: bool = False


@dataclass(frozen=True)
class Headline:
    """
    What a report says first.

    Parameters
    ----------
    grade : str
        GOOD, WEAK or REJECT; of a whole bag, or of several, CHANGED or PARTLY as well.
    sentence : str
        Why.
    command : str
        What to try next; empty if there is nothing.
    purpose : str
        What the command is good for, without a full stop.
    facts : tuple of (str, str)
        The numbers that matter most, by name.
    """

    grade: str
    sentence: str
    command: str = ''
    facts: tuple[tuple[str, str], ...] = ()
    purpose: str = ''


def to_text(sections: Sequence[Section]) -> str:
    """Return the brief sections as text for a terminal."""
    blocks = []
    for section in sections:
        parts = [text for part in section.parts if (text := _text(part))]
        if section.brief and parts:
            title = cell(section.title)
            blocks.append('\n'.join([title, *parts]) if title else '\n'.join(parts))
    return '\n\n'.join(blocks)


def _text(part: Part) -> str:
    if isinstance(part, Table):
        return part.text()
    if isinstance(part, Bullets):
        return '\n'.join(wrapped(item, '  - ', '    ') for item in part.items)
    if isinstance(part, Command):
        return f'  {printable(part.line)}'
    return wrapped(part, '  ', '  ') if isinstance(part, str) else ''


def next_text(headline: Headline) -> str:
    """Return what to try next as text for a terminal."""
    return f'{wrapped(f"Try next{_purpose(headline)}:")}\n  {printable(headline.command)}'


def wrapped(text: str, first: str = '', rest: str = '') -> str:
    """Return text in lines of a terminal's width."""
    return textwrap.fill(printable(text), WIDTH, initial_indent=first, subsequent_indent=rest,
                         break_long_words=False, break_on_hyphens=False)


def to_markdown(title: str, sections: Sequence[Section], headline: Headline | None = None) -> str:
    """Return all sections as Markdown, without figures."""
    blocks = [f'# {markdown(cell(title))}']
    if headline:
        blocks += [f'**{headline.grade}.** {markdown(printable(headline.sentence))}',
                   *(_try(headline) if headline.command else [])]
    for section in sections:
        parts = [text for part in section.parts if (text := _markdown(part))]
        if parts:
            blocks += [f'## {markdown(cell(section.title))}'] if section.title else []
            blocks += parts
    return '\n\n'.join(blocks) + '\n'


def _markdown(part: Part) -> str:
    if isinstance(part, Table):
        return part.markdown()
    if isinstance(part, Bullets):
        return '\n'.join(f'- {markdown(printable(item))}' for item in part.items)
    if isinstance(part, Command):
        return _code(part.line)
    return markdown(printable(part)) if isinstance(part, str) else ''


def _try(headline: Headline) -> tuple[str, ...]:
    return markdown(printable(f'Try next{_purpose(headline)}:')), _code(headline.command)


def _purpose(headline: Headline) -> str:
    return f': {headline.purpose}' if headline.purpose else ''


def _code(line: str) -> str:
    """Return a line of code as an indented block, which nothing in it can end."""
    return f'    {printable(line)}'
