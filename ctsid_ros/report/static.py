# SPDX-License-Identifier: Apache-2.0
"""Drawings by matplotlib: as SVG within a page, or as a file (SVG, PDF, PNG) of their own."""

from __future__ import annotations

from collections.abc import Sequence
import io
from pathlib import Path
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from ctsid_ros.report.compact_svg import compact
from ctsid_ros.report.drawing import COLORS, INK, LINE, PAPER, SOFT, Axes, Curve, Drawing, thinned
from ctsid_ros.report.words import cell

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NARROW, WIDE = 350.0, 900.0     # points: of a phone, and of a page
_POINTS = 1200  # more than these make a file large and no curve finer
_FONT = 11.0    # points; the page shows drawings at their size or larger
_DOT = 2.5      # points
_PIXEL = 0.75   # points of one of the page
_GAP = 30.0     # above each axes, for its title
_LEFT, _RIGHT, _BOTTOM = 58.0, 12.0, 42.0
_STYLE = {'font.size': _FONT, 'font.family': 'sans-serif', 'svg.fonttype': 'none',
          'text.parse_math': False, 'axes.edgecolor': LINE, 'axes.labelcolor': SOFT,
          'xtick.color': SOFT, 'ytick.color': SOFT, 'text.color': INK, 'axes.titlesize': _FONT,
          'axes.labelsize': _FONT, 'xtick.labelsize': _FONT, 'ytick.labelsize': _FONT,
          'svg.hashsalt': 'ctsid', 'path.simplify': True, 'axes.formatter.useoffset': False,
          'axes.unicode_minus': True, 'pdf.fonttype': 42}
_VARIABLES = {INK: '--ink', SOFT: '--soft', LINE: '--line', PAPER: '--paper',
              **{color: f'--c{i}' for i, color in enumerate(COLORS)}}


def inline_svg(drawing: Drawing, width: float) -> str:
    """Return a drawing as an element of a page, in the colours of the page."""
    text = _saved(_stacked(drawing, width), 'svg').decode()
    text = text[text.index('<svg'):]
    text = re.sub(r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" role="img" '
                  f'style="max-width:{1.35 * width:.0f}px">', text, count=1)
    return re.sub(r'#[0-9a-f]{6}\b', lambda m: f'var({_VARIABLES[m[0]]})'
                  if m[0] in _VARIABLES else m[0], text)


def write_drawings(path: Path, rows: Sequence[Axes | Sequence[Axes]]) -> None:
    """Write drawings, those of a row side by side, as one file: .svg, .pdf or .png."""
    table = [[row] if isinstance(row, Axes) else list(row) for row in rows]
    width = max(sum(axes.width for axes in row) for row in table)
    figure = _figure(width, sum(max(axes.height for axes in row) for row in table))
    top = 0.0
    for row in table:
        left = 0.0
        for axes in row:
            _draw(figure, axes, (left + _LEFT + 8, top + _GAP,
                                 axes.width - _LEFT - _RIGHT - 8, axes.height - _GAP - _BOTTOM))
            left += axes.width
        top += max(axes.height for axes in row)
    write_figure(path, figure)


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure of matplotlib; the suffix says which format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_saved(figure, path.suffix.lower().removeprefix('.')))


def _saved(figure: Figure, kind: str) -> bytes:
    import matplotlib

    stream = io.BytesIO()
    known: dict[str, Any] = {'svg': {'Date': None}, 'pdf': {'CreationDate': None}, 'png': {}}
    with matplotlib.rc_context(_STYLE):
        figure.savefig(stream, format=kind, metadata=known[kind], dpi=144,
                       transparent=False, facecolor=PAPER)
    return compact(stream.getvalue().decode(), _DOT).encode() if kind == 'svg' else \
        stream.getvalue()


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width / 72.0, height / 72.0))


def _stacked(drawing: Drawing, width: float) -> Figure:
    heights = [panel.height * 0.75 for panel in drawing.panels]
    figure = _figure(width, sum(heights) + len(heights) * _GAP + _BOTTOM)
    top = 0.0
    for k, (panel, height) in enumerate(zip(drawing.panels, heights, strict=True)):
        own = _draw(figure, panel, (_LEFT, top + _GAP, width - _LEFT - _RIGHT, height),
                    legend=False, limits=_shared(drawing))
        if k < len(heights) - 1:
            own.tick_params(labelbottom=False)
            own.set_xlabel('')
        top += _GAP + height
    return figure


def _shared(drawing: Drawing) -> tuple[float, float] | None:
    """Return the limits of x of all axes that stand above each other."""
    own = [panel.x_limits for panel in drawing.panels if panel.x_limits]
    if own or len(drawing.panels) == 1:
        return own[0] if own else None
    known = np.concatenate([*(c.x[np.isfinite(c.x)] for p in drawing.panels for c in p.curves),
                            *([s.low, s.high] for p in drawing.panels for s in p.spans)]
                           or [np.empty(0)])
    return (float(known.min()), float(known.max())) if len(known) and np.ptp(known) > 0 else None


def _draw(figure: Figure, axes: Axes, box: tuple[float, float, float, float], *,
          legend: bool = True, limits: tuple[float, float] | None = None) -> Any:
    """Draw axes into a box: left, top, width and height [points]."""
    import matplotlib

    across, up = figure.get_size_inches() * 72.0
    left, top, width, height = box
    with matplotlib.rc_context(_STYLE):
        own = figure.add_axes((left / across, 1.0 - (top + height) / up, width / across,
                               height / up))
        own.set_title(cell(axes.title), loc='left', fontweight='bold', color=INK)
        own.set_xlabel(cell(axes.x_label))
        own.set_ylabel(cell(axes.y_label))
        own.grid(visible=True, color=LINE, linewidth=0.8)
        own.set_axisbelow(True)
        _scales(own, axes, limits)
        for span in axes.spans:
            own.axvspan(span.low, span.high, color=COLORS[span.color], alpha=span.opacity,
                        linewidth=0)
        for curve in axes.curves:
            _curve(own, thinned(curve, _POINTS))
        for level in axes.levels:
            own.axhline(level, color=INK, linewidth=1.0, linestyle=(0, (5, 4)), alpha=0.6)
        for at, text in axes.marks:
            own.axvline(at, color=INK, linewidth=1.0, linestyle=(0, (5, 4)), alpha=0.6)
            own.text(at, 0.98, f' {cell(text)}', transform=own.get_xaxis_transform(), va='top')
        _limits(own, axes, limits)
        shown = [line for line in own.get_lines() if not str(line.get_label()).startswith('_')]
        if legend and shown:
            own.legend(handles=shown, loc='best', frameon=False)
    return own


def _scales(own: Any, axes: Axes, limits: tuple[float, float] | None) -> None:
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.ticker import LogFormatter, MultipleLocator

    class Plain(LogFormatter):
        """Numbers where a LogFormatter has them, 0.1 and not 1e-01."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f'{x:g}' if super().__call__(x, pos) else ''

    for log, axis, set_scale in ((axes.x_log, own.xaxis, own.set_xscale),
                                 (axes.y_log, own.yaxis, own.set_yscale)):
        if log:
            set_scale('log')
            axis.set_major_formatter(Plain(minor_thresholds=(2, 0.5)))
            axis.set_minor_formatter(Plain(minor_thresholds=(1.2, 0.4)))
    for step, axis in ((axes.x_step, own.xaxis), (axes.step, own.yaxis)):
        if step:
            axis.set_major_locator(MultipleLocator(step))
    if axes.x_dates:
        ticks = AutoDateLocator(maxticks=8)
        own.xaxis.set_major_locator(ticks)
        own.xaxis.set_major_formatter(ConciseDateFormatter(ticks))
    if axes.bare:
        own.tick_params(labelleft=False, left=False)
        own.grid(visible=False, axis='y')


def _limits(own: Any, axes: Axes, limits: tuple[float, float] | None) -> None:
    if axes.x_limits or limits:
        own.set_xlim(axes.x_limits or limits)
    elif all(c.kind in ('line', 'dashed', 'steps') for c in axes.curves) and axes.curves:
        own.margins(x=0.0)
    if axes.y_limits:
        own.set_ylim(axes.y_limits)


def _curve(own: Any, curve: Curve) -> None:
    # What begins with _ has no place in matplotlib's legends; a name that does gets a blank.
    color, name = COLORS[curve.color], cell(curve.label)
    label = f' {name}' if name.startswith('_') else name or '_none'
    y = np.where(np.isfinite(curve.y), curve.y, np.nan)
    _around(own, curve, color)
    line: dict[str, Any] = {'linewidth': curve.width, 'alpha': curve.opacity, 'color': color,
                            'label': label}
    if curve.kind == 'cross':
        own.plot(curve.x, y, 'x', markersize=5 + 2 * curve.width, markeredgewidth=2, color=color,
                 label=label)
    elif curve.kind in ('cloud', 'dots'):
        own.plot(curve.x, y, 'o', markersize=_DOT, markeredgewidth=0, color=color,
                 alpha=curve.opacity, label=label)
    elif curve.kind == 'stems':
        own.vlines(curve.x, 0.0, y, **line)
    elif curve.kind == 'steps':
        own.step(curve.x, y, where='post', **line)
    elif curve.opacity > 0.0:
        dash = tuple(length / curve.width * _PIXEL for length in curve.dash)
        own.plot(curve.x, y, linestyle=(0, dash) if curve.dash[1] else '-',
                 marker='o' if curve.kind == 'both' else None, markersize=4, **line)


def _around(own: Any, curve: Curve, color: str) -> None:
    for x, low, high in curve.bands:
        if curve.bars or len(x) == 1:
            own.errorbar(x, 0.5 * (low + high), yerr=0.5 * (high - low), fmt='none', ecolor=color,
                         elinewidth=1.2, capsize=3)
        else:
            own.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)
