# SPDX-License-Identifier: Apache-2.0
"""
Drawings by plotly: zoom, hover, linked axes.

What is written is the JSON of plotly.js; colours are named (`--c1/0.2` is the page's colour 1, a
fifth of it) and filled in by the page, so that they follow light, dark and print.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from functools import cache
import gzip
from html import escape
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.report.drawing import Axes, Curve, Drawing, thinned
from ctsid_ros.report.words import cell

POINTS = 4000   # of a curve
_GAP = 30.0     # pixels above each axes, for its title
_BOTTOM = 46.0
_TOP = 28   # pixels above all, for the bar of buttons, which else covers the first title
_DIGITS = 6
_MOST_DECADES = 6   # that have a number along a logarithmic axis
# Numbers along a logarithmic axis of fewer decades than these; plotly's own would be small.
_TICKS = ((0.5, (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8)), (1.2, (1, 2, 3, 5, 7)),
          (2.6, (1, 2, 5)))
_DIGITS, _DATE_DIGITS = 8, 12    # of x; days since 1970 to less than a second


def plotly_js() -> str | None:
    """Return the library for a page, as base64 of gzip; None where plotly is not installed."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        return None
    return _packed(get_plotlyjs())


@cache
def _packed(text: str) -> str:
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def figure(drawing: Drawing, points: int = POINTS) -> dict[str, Any]:
    """Return a drawing as a figure of plotly: `data`, `layout`."""
    total = sum(panel.height + _GAP for panel in drawing.panels)
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        'height': total + _TOP + _BOTTOM, 'margin': {'l': 56, 'r': 10, 't': _TOP, 'b': _BOTTOM},
        'showlegend': False, 'annotations': [], 'shapes': [],
        'hovermode': 'closest' if any(
            c.kind == 'cross' for p in drawing.panels[:1] for c in p.curves[:1]) else 'x',
        'dragmode': 'zoom', 'font': {'size': 12, 'color': '--soft'},
        'hoverlabel': {'font': {'size': 12, 'color': '--ink'}, 'bgcolor': '--paper',
                       'bordercolor': '--line', 'namelength': -1},
        'paper_bgcolor': '--paper', 'plot_bgcolor': '--paper'}
    top = 0.0
    for k, panel in enumerate(drawing.panels, 1):
        first = 1.0 - (top + _GAP) / total
        top += _GAP + panel.height
        number = '' if k == 1 else str(k)
        last = k == len(drawing.panels)
        layout[f'xaxis{number}'] = _across(panel, number, last=last)
        layout[f'yaxis{number}'] = _up(panel, number, (max(1.0 - top / total, 0.0), first))
        _words(layout, panel, number, first)
        for curve in panel.curves:
            data += [_dated(trace, panel) | {'xaxis': f'x{number}', 'yaxis': f'y{number}'}
                     for trace in _traces(
                         thinned(curve, points), _DATE_DIGITS if panel.x_dates else _DIGITS)]
    return {'data': data, 'layout': layout}


def _across(panel: Axes, number: str, *, last: bool) -> dict[str, Any]:
    axis: dict[str, Any] = {
        'anchor': f'y{number}', 'showticklabels': last, 'gridcolor': '--line', 'zeroline': False,
        'linecolor': '--line', 'tickfont': {'size': 11}, 'hoverformat': '.5~g',
        'title': {'text': _text(panel.x_label) if last else '', 'standoff': 6}}
    if number:
        axis['matches'] = 'x'
    if panel.x_log:
        axis |= _log(panel.x_limits, [c.x for c in panel.curves])
    if panel.x_dates:
        axis |= {'type': 'date', 'hoverformat': '%Y-%m-%d %H:%M'}
        if panel.x_limits:
            axis['range'] = [_date(x) for x in panel.x_limits]
    elif panel.x_limits:
        low, high = panel.x_limits
        axis['range'] = [math.log10(low), math.log10(high)] if panel.x_log else [low, high]
    if panel.x_step:
        axis |= {'dtick': panel.x_step, 'tick0': 0}
    return axis


def _dated(trace: dict[str, Any], panel: Axes) -> dict[str, Any]:
    """Return a trace with dates as plotly takes them, where x are dates."""
    if not panel.x_dates:
        return trace
    return trace | {'x': [None if x is None else _date(x) for x in trace['x']]}


def _date(days: float) -> str:
    """Return days since 1970 as plotly takes dates."""
    return str(np.datetime64(round(days * 86400), 's'))


def _log(limits: tuple[float, float] | None, values: Sequence[Array]) -> dict[str, Any]:
    """Return a logarithmic axis with numbers of full size, and enough of them."""
    axis: dict[str, Any] = {'type': 'log', 'exponentformat': 'none', 'dtick': 1,
                            'tickangle': 0}
    with np.errstate(invalid='ignore'):
        known = np.concatenate([*(v[np.isfinite(v) & (v > 0.0)] for v in values),
                                np.array(limits or ())])
    if not len(known):
        return axis
    low, high = limits or (float(np.min(known)), float(np.max(known)))
    if low == high:                             # plotly shows a decade on either side
        low, high = low / 10.0, high * 10.0
    axis['dtick'] = max(math.ceil(math.log10(high / low) / _MOST_DECADES), 1)
    for most, factors in _TICKS:
        if math.log10(high / low) < most:
            decades = range(math.floor(math.log10(low)) - 2, math.ceil(math.log10(high)) + 3)
            ticks = [float(f'{f}e{d}') for d in decades for f in factors]
            return axis | {'tickvals': ticks, 'ticktext': [f'{t:g}' for t in ticks]}
    return axis


def _up(panel: Axes, number: str, domain: tuple[float, float]) -> dict[str, Any]:
    axis: dict[str, Any] = {
        'anchor': f'x{number}', 'domain': [round(d, 5) for d in domain], 'gridcolor': '--line',
        'zeroline': False, 'linecolor': '--line', 'tickfont': {'size': 11},
        'hoverformat': '.5~g', 'showticklabels': not panel.bare, 'nticks': 6,
        'exponentformat': 'e',
        'showgrid': not panel.bare,
        'title': {'text': _text(panel.y_label), 'standoff': 2}}
    if panel.y_log:
        axis |= _log(panel.y_limits, [c.y for c in panel.curves])
    if panel.y_limits:
        low, high = panel.y_limits
        axis['range'] = [math.log10(low), math.log10(high)] if panel.y_log else [low, high]
    if panel.step:
        axis |= {'dtick': panel.step, 'tick0': 0}
    return axis


def _words(layout: dict[str, Any], panel: Axes, number: str, top: float) -> None:
    """Add title, levels, spans and marks of axes."""
    if panel.title:
        layout['annotations'].append({
            'text': f'<b>{_text(panel.title)}</b>', 'xref': 'paper', 'yref': 'paper', 'x': 0,
            'y': round(top, 5), 'xanchor': 'left', 'yanchor': 'bottom', 'showarrow': False,
            'font': {'size': 12, 'color': '--ink'}})
    dash = {'color': '--ink/0.6', 'width': 1, 'dash': 'dash'}
    x, y = f'x{number}', f'y{number}'
    for level in panel.levels:
        layout['shapes'].append({'type': 'line', 'xref': f'{x} domain', 'yref': y, 'x0': 0,
                                 'x1': 1, 'y0': _plain(level), 'y1': _plain(level), 'line': dash})
    for span in panel.spans:
        layout['shapes'].append({
            'type': 'rect', 'xref': x, 'yref': f'{y} domain', 'x0': _plain(span.low),
            'x1': _plain(span.high), 'y0': 0, 'y1': 1, 'line': {'width': 0}, 'layer': 'below',
            'fillcolor': f'--c{span.color}/{span.opacity:g}'})
    for at, text in panel.marks:
        layout['shapes'].append({'type': 'line', 'xref': x, 'yref': f'{y} domain',
                                 'x0': _plain(at), 'x1': _plain(at), 'y0': 0, 'y1': 1,
                                 'line': dash})
        if text:
            layout['annotations'].append({
                'text': _text(text), 'xref': x, 'yref': f'{y} domain', 'showarrow': False,
                'x': _plain(math.log10(at) if panel.x_log else at), 'y': 1, 'xanchor': 'left',
                'yanchor': 'top', 'font': {'size': 11, 'color': '--ink'}})


def _traces(curve: Curve, digits: int) -> list[dict[str, Any]]:
    color, traces = f'--c{curve.color}', _around(curve, digits)
    own: dict[str, Any] = {
        'type': 'scatter', 'x': numbers(curve.x, digits), 'y': numbers(curve.y),
        'name': _text(curve.label), 'meta': cell(curve.label), 'mode': 'lines',
        'opacity': curve.opacity,
        'line': {'color': color, 'width': curve.width}}
    if curve.texts:
        own |= {'text': [_text(text) for text in curve.texts], 'hoverinfo': 'text'}
    elif not curve.label:
        own['hoverinfo'] = 'x+y'
    if curve.dash[1]:
        own['line']['dash'] = ','.join(f'{length:g}px' for length in curve.dash)
    if curve.kind == 'steps':
        own['line']['shape'] = 'hv'
    elif curve.kind == 'both':
        own |= {'mode': 'lines+markers', 'marker': {'color': color, 'size': 5}}
    elif curve.kind in ('dots', 'cloud'):
        own |= {'mode': 'markers', 'marker': {'color': color, 'size': 4}}
    elif curve.kind == 'cross':
        own |= {'mode': 'markers', 'marker': {
            'color': color, 'size': 7 + 2 * curve.width, 'symbol': 'x-thin',
            'line': {'color': color, 'width': 2}}}
    elif curve.kind == 'stems':
        own = {key: own[key] for key in ('x', 'y', 'name', 'meta', 'opacity')} | {
            'type': 'bar', 'marker': {'color': color}}
    return [*traces, own] if curve.opacity > 0.0 else traces


def _around(curve: Curve, digits: int) -> list[dict[str, Any]]:
    base = {'type': 'scatter', 'hoverinfo': 'skip', 'name': _text(curve.label),
            'meta': cell(curve.label)}
    found = []
    for x, low, high in curve.bands:
        if curve.bars or len(x) == 1:
            found.append(base | {
                'x': numbers(x, digits), 'y': numbers(0.5 * (low + high)), 'mode': 'markers',
                'marker': {'opacity': 0, 'color': f'--c{curve.color}'},
                'error_y': {'type': 'data', 'array': numbers(0.5 * (high - low)),
                            'color': f'--c{curve.color}', 'thickness': 1.2}})
        else:
            # Closed shapes: bands above each other would be filled to one another.
            found.append(base | {
                'x': numbers(np.concatenate((x, x[::-1])), digits), 'mode': 'lines',
                'y': numbers(np.concatenate((low, high[::-1]))), 'fill': 'toself',
                'fillcolor': f'--c{curve.color}/0.2', 'line': {'width': 0}})
    return found


def numbers(values: Array | NDArray[Any], digits: int = _DIGITS) -> list[float | None]:
    """Return numbers as JSON has them: rounded to so many digits, none for what is not finite."""
    return [_plain(v, digits) for v in np.asarray(values, dtype=float).tolist()]


def _plain(value: float, digits: int = _DIGITS) -> float | None:
    if not math.isfinite(value):
        return None
    rounded = float(f'{value:.{digits}g}')
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e9 else rounded


def _text(text: str) -> str:
    """Return text that plotly, which has a little HTML of its own, shows as it is."""
    return escape(cell(text), quote=False)
