# SPDX-License-Identifier: Apache-2.0
"""One table for terminal, Markdown and page; and numbers for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

from ctsid_ros.report.words import cell, markdown

if TYPE_CHECKING:
    from ctsid_core.linear.types import Array


@dataclass(frozen=True)
class Table:
    """
    A table of words.

    Parameters
    ----------
    head : tuple of str
    rows : tuple of tuples of str
    left : str
        Headings of the columns that are set flush left; the others hold numbers.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        assert all(len(row) == len(self.head) for row in self.rows), self

    def text(self, indent: int = 2) -> str:
        """Return aligned lines for a terminal."""
        head, *rows = ([cell(text) for text in row] for row in (self.head, *self.rows))
        widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
        rule = ['─' * width for width in widths]
        lines = []
        for row in (head, rule, *rows):
            cells = (text.ljust(width) if name in self.left else text.rjust(width)
                     for text, width, name in zip(row, widths, self.head, strict=True))
            lines.append((' ' * indent + '  '.join(cells)).rstrip())
        return '\n'.join(lines)

    def markdown(self) -> str:
        """Return a table of Markdown."""
        rule = ('---' if name in self.left else '---:' for name in self.head)
        head, *rows = ([markdown(cell(text)) for text in row] for row in (self.head, *self.rows))
        return '\n'.join(f'| {" | ".join(row)} |' for row in (head, list(rule), *rows))


def thinned(rows: Sequence[tuple[str, ...]], most: int, keep: int = 0
            ) -> tuple[tuple[str, ...], ...]:
    """Return about `most` rows, evenly chosen; the first, the last and row `keep` among them."""
    if len(rows) <= most:
        return tuple(rows)
    chosen = {round(i * (len(rows) - 1) / (most - 1)) for i in range(most)} | {keep}
    return tuple(rows[i] for i in sorted(chosen))


def number(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, trailing zeros kept; '-' for NaN."""
    if math.isnan(value):
        return '-'
    if math.isinf(value):
        return 'inf' if value > 0 else '-inf'
    if value == 0:
        return '0'
    if not 1e-4 <= abs(value) < 1e6:
        return f'{value:.{digits - 1}e}'
    shown = f'{value:.{digits - 1}e}'  # rounded first, for 9.999 may have one digit more
    return f'{value:.{max(digits - 1 - int(shown.partition("e")[2]), 0)}f}'


def plus_minus(value: float, std: float, digits: int = 4) -> str:
    """Return a number and its standard deviation: 12.35 ± 0.04; the number alone if that is 0."""
    shown, alone = number(value, digits), math.isnan(std) or std == 0 or math.isinf(value)
    return shown if alone else f'{shown} ± {number(std, 2)}'


def gain_text(value: float, std: float, rate: bool) -> str:
    """Return a gain, marked where it says how fast the output moves."""
    return plus_minus(value, std) + (' /s' if rate else '')


def percent(value: float) -> str:
    """Return a fit [%] with one decimal; '-' for NaN, '< -999' for a diverged one."""
    return '-' if math.isnan(value) else '< -999' if value < -999 else f'{value:.1f}'


def pole_text(pole: complex, digits: int = 4) -> str:
    """Return a pole; a conjugate pair, given by either of the two, as -1.820 ± 31.35j."""
    if not pole:
        return '0 (integrator)'
    real = number(pole.real, digits)
    return real if pole.imag == 0 else f'{real} ± {number(abs(pole.imag), digits)}j'


def join(words: Sequence[str]) -> str:
    """Return words as a list in a sentence."""
    return words[0] if len(words) == 1 else ', '.join(words[:-1]) + ' and ' + words[-1] \
        if words else ''


def label(name: str, unit: str) -> str:
    """Return a name with its unit."""
    return f'{name} [{unit}]' if unit else name


def fit_words(values: Array) -> str:
    """Return the fits of all outputs [%]."""
    return ' / '.join(percent(v) for v in values) if len(values) else '-'
