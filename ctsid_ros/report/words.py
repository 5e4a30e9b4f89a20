# SPDX-License-Identifier: Apache-2.0
"""
Text that may come from a bag, made harmless for where it is shown.

Names of topics, frames and units are written by others: they may hold markup, escape sequences of
a terminal, or a megabyte of anything.
"""

from __future__ import annotations

import re

LONGEST = 1200      # characters of a paragraph
LONGEST_CELL = 160  # ... of a cell of a table, a title, a label
_CODE = re.compile(r'(?<!`)`([^`\n]+)`(?!`)')
# What Markdown would take for markup; not the _ within a word, nor the [ ] around a unit.
_MARKUP = re.compile(r'([\\`*<&|$~]|(?<![^\W_])_|_(?![^\W_])|\](?=[(\[:])|^[#>]|^[-+](?=\s))')


def printable(text: str, longest: int = LONGEST) -> str:
    r"""
    Return text on one line without control characters (as \x1b), cut in the middle if long.

    Whatever is not printable for Python is escaped: control characters, line breaks of Unicode,
    changes of the writing direction, lone surrogates.
    """
    if len(text) > longest:
        text = f'{text[:longest * 2 // 3]} … {text[-longest // 4:]}'
    if text.isprintable():
        return text
    text = re.sub(r'[\t\r\n]+', ' ', text)
    return ''.join(c if c.isprintable() else c.encode('unicode_escape').decode() for c in text)


def lines(text: str) -> str:
    """Return text that may have several lines, each printable."""
    return '\n'.join(printable(line) for line in text.split('\n'))


def cell(text: str) -> str:
    """Return the text of a cell, a title or a label."""
    return printable(text, LONGEST_CELL)


def parts(text: str) -> list[tuple[str, bool]]:
    """Return a paragraph in parts: text, and whether it is `code`."""
    pieces = _CODE.split(text)
    return [(piece, bool(i % 2)) for i, piece in enumerate(pieces) if piece]


def markdown(text: str) -> str:
    """Return a paragraph for Markdown: markup stays text, `code` stays code."""
    return ''.join(f'`{piece}`' if code else _MARKUP.sub(r'\\\1', piece)
                   for piece, code in parts(text))


def spreadsheet(text: str, *, whole: bool = False) -> str:
    """Return the text of a cell of a CSV file, short or whole: a formula becomes text."""
    shown = printable(text) if whole else cell(text)
    return f"'{shown}" if shown[:1] in tuple('=+-@') else shown
