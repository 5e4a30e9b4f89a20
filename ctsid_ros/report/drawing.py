# SPDX-License-Identifier: Apache-2.0
"""
What is drawn: curves in axes, axes above each other.

`static.py` draws it by matplotlib, `interactive.py` by plotly; both alike. Colours are numbers of
the palette below, so that a page can follow light and dark.
"""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import dataclass, field, replace
import math
from typing import Literal

import numpy as np

from ctsid_core.linear.types import Array

Kind = Literal['line', 'dots', 'both', 'dashed', 'cloud', 'cross', 'steps', 'stems']
INK, SOFT, LINE, PAPER = '#1c2733', '#5b6b7b', '#dde3e9', '#ffffff'
MOST_MODELS = 6     # in one drawing: each has a colour of its own
_DASH, _PART = (7.0, 5.0), 7.0     # dashes, and what shows of each of lines that agree [pixels]
COLORS = ('#6b7a89', '#1769c4', '#cf222e', '#15803d', '#7e22ce', '#bf8700', '#0e7490')
GREEN, AMBER, RED = 3, 5, 2     # numbers among them


@dataclass(frozen=True, eq=False)
class Curve:
    """
    One curve.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        Breaks where either is not finite.
    label : str
        In the legend; empty for none.
    color : int
        Number of the colour.
    kind : str
        A cloud is of very many dots, a cross marks single points, steps are held values, stems
        stand on zero.
    low, high : ndarray, shape (N,), optional
        A band around it; breaks likewise.
    opacity : float
        Of lines and clouds.
    bars : bool
        Draw a bar at each x instead of the band.
    width : float
        Of the line; crosses grow with it.
    texts : sequence of str
        What is said of each point where a pointer is on it; numbers if empty.
    layer : (int, int)
        Its number, from 1, among so many lines that may lie on each other.
    """

    x: Array
    y: Array
    label: str = ''
    color: int = 1
    kind: Kind = 'line'
    low: Array | None = None
    high: Array | None = None
    opacity: float = 1.0
    bars: bool = False
    width: float = 1.5
    texts: Sequence[str] = ()
    layer: tuple[int, int] = (1, 1)

    @property
    def bands(self) -> list[tuple[Array, Array, Array]]:
        """x, low and high of each stretch of the band between breaks."""
        if self.low is None or self.high is None:
            return []
        known = np.isfinite(self.x) & np.isfinite(self.low) & np.isfinite(self.high)
        edges = np.flatnonzero(np.diff(known, prepend=False, append=False))
        return [(self.x[a:b], self.low[a:b], self.high[a:b])
                for a, b in zip(edges[::2], edges[1::2], strict=True)]

    @property
    def dash(self) -> tuple[float, float]:
        """
        Length of its dashes and of the gaps between them; no gaps if it is a whole line.

        Each layer leaves one part more of the period than the one below, so that lines that agree
        show one part of each.
        """
        if self.kind == 'dashed':
            return _DASH
        number, count = self.layer
        return _PART * (count - number + 1), _PART * (number - 1)


@dataclass(frozen=True)
class Span:
    """An interval of x that is shaded, what it is, and how dense the shade is."""

    low: float
    high: float
    color: int = 1
    text: str = ''
    opacity: float = 0.13


@dataclass(frozen=True)
class Axes:
    """
    Curves in one pair of axes.

    Parameters
    ----------
    curves : sequence of Curve
    title, x_label, y_label : str
    x_log, y_log : bool
    x_dates : bool
        Whether x are days since the beginning of 1970 (UTC), and shown as dates.
    levels : sequence of float
        Dashed lines across.
    spans : sequence of Span
    marks : sequence of (float, str)
        Dashed lines upward, with a word at each.
    x_limits, y_limits : (low, high), optional
        Instead of those of the curves.
    step, x_step : float
        Between the numbers along y, such as 45 degrees, and along x; 0 for what suits.
    bare : bool
        Whether y has no numbers.
    width, height : float
    """

    curves: Sequence[Curve]
    title: str = ''
    x_label: str = ''
    y_label: str = ''
    x_log: bool = False
    y_log: bool = False
    x_dates: bool = False
    levels: Sequence[float] = field(default=())
    spans: Sequence[Span] = field(default=())
    marks: Sequence[tuple[float, str]] = field(default=())
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    step: float = 0.0
    x_step: float = 0.0
    bare: bool = False
    width: float = 840.0
    height: float = 240.0


@dataclass(frozen=True)
class Drawing:
    """
    Axes above each other that share their x.

    Parameters
    ----------
    panels : tuple of Axes
        From the top; the last one has the numbers and the label along x.
    link : str
        Drawings of one page with the same word show the same interval of x.
    wide : bool
        Whether it takes the width of the page.
    picks : bool
        Whether a click chooses the window at that x (of the series that the page has).
    """

    panels: tuple[Axes, ...]
    link: str = ''
    wide: bool = False
    picks: bool = False

    @property
    def legend(self) -> list[tuple[str, int, Kind]]:
        """What the labels stand for: label, colour and kind, each once."""
        entries = {c.label: (c.label, c.color, c.kind)
                   for panel in self.panels for c in panel.curves if c.label}
        return list(entries.values())


def over(number: int, every: Sized) -> float:
    """Return the width of crosses, counted from 1, of which the next ones may lie on top."""
    return 1.5 + 1.8 * (len(every) - number)


def thinned(curve: Curve, most: int) -> Curve:
    """
    Return a curve of about so many points with the same peaks.

    Of lines the extremes of stretches are kept; of dots every so many, and those far off.
    """
    if len(curve.x) <= most or curve.texts:
        return curve
    rows = _dots(curve.y, most) if curve.kind in ('dots', 'cloud') else _peaks(curve.y, most)
    low, high = (None if v is None else v[rows] for v in (curve.low, curve.high))
    return replace(curve, x=curve.x[rows], y=curve.y[rows], low=low, high=high)


def _peaks(y: Array, most: int) -> list[int]:
    size, rows = -(-2 * len(y) // most), set()
    for first in range(0, len(y), size):
        part = np.where(np.isfinite(y[first:first + size]), y[first:first + size], math.nan)
        if np.isnan(part).any():
            rows.add(first + int(np.argmax(np.isnan(part))))     # a break stays one
        if not np.isnan(part).all():
            rows |= {first + int(np.nanargmin(part)), first + int(np.nanargmax(part))}
    return sorted(rows)


def _dots(y: Array, most: int) -> list[int]:
    away = np.nan_to_num(np.abs(y - np.median(y[np.isfinite(y)] if np.isfinite(y).any() else 0)))
    far = np.argsort(away)[-(most // 4):].tolist()
    return sorted({*range(0, len(y), -(-4 * len(y) // (3 * most))), *far})
