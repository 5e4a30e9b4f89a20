# SPDX-License-Identifier: Apache-2.0
"""
Small drawings of curves as SVG text: axes, lines, dots, bands; linear and logarithmic.

Colours are the CSS variables --c0, --c1, ... of the page, so that they follow light and dark.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
import math
from typing import Literal

import numpy as np

from ctsid_core.linear.types import Array

LEFT, RIGHT, TOP, BOTTOM = 64.0, 12.0, 30.0, 40.0
_TICK_ACROSS, _TICK_UP = 60.0, 24.0     # what the number at a tick needs
_POINTS = 1500  # more than these make a file large and no curve finer


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
    kind : {'line', 'dots', 'both', 'dashed', 'cloud', 'cross'}
        A cloud is of very many dots, a cross marks what is true.
    low, high : ndarray, shape (N,), optional
        A band around it.
    opacity : float
        Of lines and clouds.
    bars : bool
        Draw a bar at each x instead of the band.
    width : float
        Of the line.
    """

    x: Array
    y: Array
    label: str = ''
    color: int = 1
    kind: Literal['line', 'dots', 'both', 'dashed', 'cloud', 'cross'] = 'line'
    low: Array | None = None
    high: Array | None = None
    opacity: float = 1.0
    bars: bool = False
    width: float = 1.5


@dataclass(frozen=True)
class Axes:
    """
    One drawing.

    Parameters
    ----------
    curves : sequence of Curve
    title, x_label, y_label : str
    x_log, y_log : bool
    levels : sequence of float
        Dashed lines across.
    shade : (low, high), optional
        An interval of x that is shaded.
    x_limits, y_limits : (low, high), optional
        Instead of those of the curves.
    width, height : float
    """

    curves: Sequence[Curve]
    title: str = ''
    x_label: str = ''
    y_label: str = ''
    x_log: bool = False
    y_log: bool = False
    levels: Sequence[float] = field(default=())
    shade: tuple[float, float] | None = None
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    width: float = 840.0
    height: float = 240.0


@dataclass(frozen=True)
class _Scale:
    """From values to positions."""

    low: float
    high: float
    log: bool
    start: float
    end: float

    def __call__(self, values: Array) -> Array:
        if self.log:
            with np.errstate(invalid='ignore', divide='ignore'):
                share = np.log(values / self.low) / math.log(self.high / self.low)
        else:
            share = (values - self.low) / (self.high - self.low)
        return np.asarray(self.start + share * (self.end - self.start))

    def ticks(self) -> list[float]:
        if self.log:
            return log_ticks(self.low, self.high)
        across = self.end > self.start
        room = (self.end - self.start) / _TICK_ACROSS if across else \
            (self.start - self.end) / _TICK_UP
        return linear_ticks(self.low, self.high, max(2, min(7, int(room))))


def draw(axes: Axes) -> str:
    """Return the drawing as SVG text."""
    right, bottom = axes.width - RIGHT, axes.height - BOTTOM
    room = 0.0 if all(c.kind in ('line', 'dashed') for c in axes.curves) else 0.02
    x = _scale([c.x for c in axes.curves], axes.x_log, LEFT, right, room)
    ys = [values for c in axes.curves for values in (c.y, c.low, c.high) if values is not None]
    y = _scale([*ys, np.array(axes.levels, float)], axes.y_log, bottom, TOP, 0.06)
    if axes.x_limits:
        x = _Scale(*axes.x_limits, axes.x_log, LEFT, right)
    if axes.y_limits:
        y = _Scale(*axes.y_limits, axes.y_log, bottom, TOP)
    frame = (f'<clipPath id="{_name(axes)}"><rect x="{LEFT}" y="{TOP}" width="{right - LEFT:.1f}" '
             f'height="{bottom - TOP:.1f}"/></clipPath>')
    inside = ''.join([*_shade(axes, x, bottom), *_levels(axes, y, right),
                      *(_curve(c, x, y) for c in axes.curves)])
    return (f'<svg viewBox="0 0 {axes.width:g} {axes.height:g}" role="img" '
            f'aria-label="{escape(axes.title)}">{frame}{_grid(axes, x, y, right, bottom)}'
            f'<g clip-path="url(#{_name(axes)})">{inside}</g>{_words(axes, right)}</svg>')


def _name(axes: Axes) -> str:
    return f'clip-{axes.width:g}-{axes.height:g}'  # equal names are equal rectangles


def _scale(values: Sequence[Array], log: bool, start: float, end: float, margin: float) -> _Scale:
    known = np.concatenate([v[np.isfinite(v)] for v in values] or [np.empty(0)])
    known = known[known > 0] if log else known
    low, high = (float(known.min()), float(known.max())) if len(known) else (1.0, 10.0)
    if log:
        low, high = (low, high) if high > 1.5 * low else (low / 1.5, high * 1.5)
        stretch = (high / low) ** margin
        return _Scale(low / stretch, high * stretch, True, start, end)
    if high - low <= 1e-9 * max(abs(low), abs(high), 1e-300):
        low, high = low - max(abs(low), 1.0) / 10, high + max(abs(high), 1.0) / 10
    room = margin * (high - low)
    return _Scale(low - room, high + room, False, start, end)


def linear_ticks(low: float, high: float, most: int = 7) -> list[float]:
    """Return round numbers between two values."""
    rough = (high - low) / most
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(unit * k for k in (1, 2, 5, 10) if unit * k >= rough * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    count = math.floor(high / step + 1e-9) - first + 1
    return [(first + i) * step for i in range(count)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten between two values, and 2 and 5 times them where these are few."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1, 2, 5) if math.log10(high / low) < 3 else (1,)
    return [f * 10.0 ** d for d in decades for f in factors
            if low * (1 - 1e-9) <= f * 10.0 ** d <= high * (1 + 1e-9)]


def tick_text(value: float, others: Sequence[float]) -> str:
    """Return the number of a tick, with as many digits as its neighbours need."""
    step = min((abs(a - b) for a, b in zip(others, others[1:], strict=False)), default=abs(value))
    if value != 0 and not 1e-3 <= max(abs(v) for v in others) < 1e5:
        return f'{value:.3g}'
    digits = max(0, -math.floor(math.log10(step) + 1e-9)) if step > 0 else 0
    return f'{value + 0.0:.{min(digits, 6)}f}'.replace('-', '−')


def _grid(axes: Axes, x: _Scale, y: _Scale, right: float, bottom: float) -> str:
    parts = []
    for scale, is_x in ((x, True), (y, False)):
        ticks = scale.ticks()
        for value, at in zip(ticks, scale(np.array(ticks)), strict=True):
            text = f'{value:g}' if scale.log else tick_text(value, ticks)
            ends = f'x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{bottom}"' if is_x else \
                f'x1="{LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"'
            place = f'x="{at:.1f}" y="{bottom + 16}" text-anchor="middle"' if is_x else \
                f'x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end"'
            parts.append(f'<line {ends} stroke="var(--line)"/><text {place}>{text}</text>')
    return ''.join(parts)


def _shade(axes: Axes, x: _Scale, bottom: float) -> Iterator[str]:
    if axes.shade:
        first, last = x(np.clip(np.array(axes.shade), x.low, x.high))
        yield (f'<rect x="{first:.1f}" y="{TOP}" width="{last - first:.1f}" '
               f'height="{bottom - TOP:.1f}" fill="var(--shade)" opacity="0.1"/>')


def _levels(axes: Axes, y: _Scale, right: float) -> Iterator[str]:
    for at in y(np.array(axes.levels, float)):
        yield (f'<line x1="{LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}" '
               'stroke="var(--ink)" stroke-dasharray="5 4" opacity="0.6"/>')


def _curve(curve: Curve, x: _Scale, y: _Scale) -> str:
    paint = f'var(--c{curve.color})'
    if curve.kind in ('cloud', 'cross'):
        return _marks(curve, x(curve.x), y(curve.y), paint)
    across, up = _thinned(x(curve.x), y(curve.y))
    parts = []
    if curve.low is not None and curve.high is not None:
        draw_range = _bars if curve.bars else _band
        parts.append(draw_range(x(curve.x), y(curve.low), y(curve.high), paint))
    if curve.kind != 'dots':
        dash = ' stroke-dasharray="6 4"' if curve.kind == 'dashed' else ''
        faint = f' opacity="{curve.opacity:g}"' if curve.opacity < 1.0 else ''
        parts.append(f'<path d="{_path(across, up)}" fill="none" stroke="{paint}" '
                     f'stroke-width="{curve.width:g}" stroke-linejoin="round"{dash}{faint}/>')
    if curve.kind in ('dots', 'both'):
        good = np.isfinite(across) & np.isfinite(up)
        radius = 1.6 if curve.kind == 'dots' else 2.6
        parts += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{radius}" fill="{paint}"/>'
                  for a, b in zip(across[good], up[good], strict=True)]
    return ''.join(parts)


def _marks(curve: Curve, across: Array, up: Array, paint: str) -> str:
    """Return dots or crosses as one path: a line of no length with a round cap is a dot."""
    good = np.isfinite(across) & np.isfinite(up)
    shape, look = ('h0', 'stroke-width="3" stroke-linecap="round"') if curve.kind == 'cloud' \
        else ('m-5 -5l10 10m0 -10l-10 10', 'stroke-width="2"')
    path = ''.join(f'M{a:.1f} {b:.1f}{shape}' for a, b in zip(across[good], up[good], strict=True))
    return f'<path d="{path}" fill="none" stroke="{paint}" {look} opacity="{curve.opacity:g}"/>'


def _bars(across: Array, low: Array, high: Array, paint: str) -> str:
    good = np.isfinite(across) & np.isfinite(low) & np.isfinite(high)
    path = ''.join(f'M{a:.1f} {b:.1f}V{c:.1f}m-4 0h8M{a - 4:.1f} {b:.1f}h8' for a, b, c in
                   zip(across[good], low[good], high[good], strict=True))
    return f'<path d="{path}" fill="none" stroke="{paint}" stroke-width="1.2"/>'


def _band(across: Array, low: Array, high: Array, paint: str) -> str:
    good = np.isfinite(across) & np.isfinite(low) & np.isfinite(high)
    if good.sum() == 1:
        at, a, b = (float(v[good][0]) for v in (across, low, high))
        return (f'<line x1="{at:.1f}" x2="{at:.1f}" y1="{a:.1f}" y2="{b:.1f}" stroke="{paint}" '
                'stroke-width="4" opacity="0.3"/>')
    around = np.concatenate([across[good], across[good][::-1]])
    edges = np.concatenate([low[good], high[good][::-1]])
    shape = _path(around, edges)
    return f'<path d="{shape}Z" fill="{paint}" opacity="0.2"/>' if shape else ''


def _path(across: Array, up: Array) -> str:
    text, pen = [], 'M'
    for a, b in zip(across, up, strict=True):
        if math.isfinite(a) and math.isfinite(b):
            text.append(f'{pen}{a:.1f} {min(max(b, -1e4), 1e4):.1f}')
            pen = 'L'
        else:
            pen = 'M'
    return ''.join(text)


def _thinned(across: Array, up: Array) -> tuple[Array, Array]:
    """Return a curve of fewer points with the same peaks: the extremes of each stretch."""
    if len(across) <= _POINTS:
        return across, up
    size = -(-2 * len(across) // _POINTS)
    chosen = []
    for first in range(0, len(across), size):
        part = up[first:first + size]
        if np.isfinite(part).any():
            chosen += sorted({first + int(np.nanargmin(part)), first + int(np.nanargmax(part))})
    return across[chosen], up[chosen]


def _words(axes: Axes, right: float) -> str:
    parts = [f'<text class="title" x="{LEFT}" y="18">{escape(axes.title)}</text>',
             f'<text x="{(LEFT + right) / 2:.1f}" y="{axes.height - 6}" '
             f'text-anchor="middle">{escape(axes.x_label)}</text>']
    if axes.y_label:
        middle = (TOP + axes.height - BOTTOM) / 2
        parts.append(f'<text transform="translate(13 {middle:.1f}) rotate(-90)" '
                     f'text-anchor="middle">{escape(axes.y_label)}</text>')
    at = right
    for curve in reversed([c for c in axes.curves if c.label]):
        at -= 6.6 * len(curve.label)
        parts.append(f'<text x="{at:.1f}" y="18">{escape(curve.label)}</text>')
        dash = ' stroke-dasharray="4 3"' if curve.kind == 'dashed' else ''
        at -= 26
        parts.append(f'<line x1="{at:.1f}" x2="{at + 20:.1f}" y1="14" y2="14" '
                     f'stroke="var(--c{curve.color})" stroke-width="2.5"{dash}/>')
        at -= 12
    return ''.join(parts)
