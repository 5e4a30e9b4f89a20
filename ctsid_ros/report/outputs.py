# SPDX-License-Identifier: Apache-2.0
"""Measured and simulated outputs drawn, residuals above them and inputs below; sampling."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np

from ctsid_core.bases.preparation import corrupt_outputs
from ctsid_core.linear.types import Array, Mask
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import Validation
from ctsid_core.settings import Settings
from ctsid_core.signals.actuators import as_acting
from ctsid_core.signals.record import Record, Signal, placed
from ctsid_ros.report.document import Figure
from ctsid_ros.report.drawing import RED, Axes, Curve, Drawing, Span
from ctsid_ros.report.tables import label, percent

MOST_OUTPUTS = 12
_GAP = 5.0          # periods: a longer interval is a gap, as `ctsid info` counts them
_MOST_SPANS = 60
_ROUNDING = 1e-4    # of a period: what intervals differ by no more is of the stamps, and not drawn
_TIME = 'time after the start of the bag [s]'


@dataclass(frozen=True)
class Part:
    """
    A part of a record with what a model makes of it.

    Parameters
    ----------
    what : str
        Which data these are.
    found : Validation
    fit : ndarray, shape (ny,)
        The fits that the report gives for these data [%].
    how : str
        What the model does: it has simulated them, or predicted.
    """

    what: str
    found: Validation
    fit: Array
    how: str = 'simulated'


def output_figures(model: StateSpace, record: Record, parts: Sequence[Part], offset: float,
                   settings: Settings, marks: Sequence[tuple[float, str]] = ()) -> list[Figure]:
    """
    Draw measured and simulated outputs of a record.

    Parameters
    ----------
    model : StateSpace
    record : Record
        All of it.
    parts : sequence of Part
        Those after the first are shaded.
    offset : float
        Added to its times [s].
    settings : Settings
        Which tell how corrupt samples are found.
    marks : sequence of (float, str)
        Times that are marked, in the time of the record [s].
    """
    inputs = input_axes(as_acting(record, model.actuators), offset, model.input_names,
                        model.input_units)
    spoilt = corrupt_outputs(record, settings)
    seen = [Span(float(p.found.times[0]) + offset, float(p.found.times[-1]) + offset, 4, p.what)
            for p in parts[1:] if len(p.found.times)]
    figures = []
    for i in range(min(model.ny, MOST_OUTPUTS)):
        times, y, y_hat = _joined(parts, i, offset)
        bad = spoilt.get(i, np.empty(0))
        used = np.where(np.isin(times, bad + offset), np.nan, y)
        low, high = _limits(used)
        simulated = np.clip(y_hat, low - (high - low), high + (high - low))
        gaps = [Span(a + offset, b + offset, RED, 'gap')
                for a, b in gaps_of(_signal_of(record.outputs, i))]
        curves = [Curve(times, y, 'measured', 0, opacity=0.6, width=3.0),
                  Curve(times, simulated, parts[0].how, 1, width=1.4)]
        if len(bad):    # at the edge, if they are far off: else nothing but them was seen
            inset = 0.04 * (high - low)
            curves.append(_corrupt(record, i, bad, offset, (low + inset, high - inset)))
        wild = not bool(np.all((y_hat >= low) & (y_hat <= high) | np.isnan(y_hat)))
        spans = [*seen, *gaps]
        at = [(t + offset, text) for t, text in marks]
        name = label(model.output_names[i], model.output_units[i])
        left = 'residual' if parts[0].how == 'simulated' else f'residual, {parts[0].how}'
        panels = (Axes([Curve(times, used - simulated, left, 2, width=1.0)],
                       f'residual of {name}', spans=spans, marks=[(t, '') for t, _ in at],
                       levels=(0.0,), height=80.0),
                  Axes(curves, name, spans=spans, marks=at, height=200.0,
                       y_limits=(low, high) if wild or len(bad) else None),
                  *inputs)
        words = '; '.join(f'{p.what}: fit {percent(p.fit[i])} %' for p in parts
                          if i < len(p.fit)) + '.'
        figures.append(Figure(Drawing(panels, link='time', wide=True), words, name))
    return figures


def compared_figures(record: Record, parts: Mapping[str, Part], offset: float) -> list[Figure]:
    """
    Draw what several models make of the outputs of a record, in the same axes.

    Parameters
    ----------
    record : Record
    parts : mapping
        By the names of the models: all of the record, with as many outputs as it has.
    offset : float
        Added to its times [s].
    """
    inputs = input_axes(record, offset, record.input_names, record.input_units)
    figures = []
    for i in range(min(len(record.output_names), MOST_OUTPUTS)):
        name = label(record.output_names[i], record.output_units[i])
        spans = [Span(a + offset, b + offset, RED, 'gap')
                 for a, b in gaps_of(_signal_of(record.outputs, i))]
        curves: list[Curve] = []
        residuals: list[Curve] = []
        for color, (model, part) in enumerate(parts.items(), 1):
            times, y, y_hat = _joined([part], i, offset)
            low, high = _limits(y)
            shown = np.clip(y_hat, low - (high - low), high + (high - low))
            if not curves:
                curves = [Curve(times, y, 'measured', 0, opacity=0.6, width=3.0)]
            layer = color, len(parts)
            curves.append(Curve(times, shown, model, color, layer=layer))
            residuals.append(Curve(times, y - shown, model, color, width=1.0, layer=layer))
        panels = (Axes(residuals, f'residual of {name}', spans=spans, levels=(0.0,), height=90.0),
                  Axes(curves, name, spans=spans, height=220.0, y_limits=(low, high)), *inputs)
        how = {f', {p.how}' for p in parts.values() if p.how != 'simulated'}
        words = '; '.join(f'{model}: fit {percent(part.fit[i])} %'
                          for model, part in parts.items()) + f'{"".join(how)}.'
        figures.append(Figure(Drawing(panels, link='time', wide=True), words, name))
    return figures


def raw_figures(record: Record, offset: float, settings: Settings) -> list[Figure]:
    """Draw the signals of a record of which there is no model."""
    spoilt = corrupt_outputs(record, settings)
    panels = []
    for i, (signal, column) in enumerate(_columns(record.outputs)):
        if i >= MOST_OUTPUTS:
            break
        inside = _inside(signal, record)
        curves = [Curve(signal.time[inside] + offset, signal.values[inside, column], 'measured',
                        0)]
        if i in spoilt:
            curves.append(_corrupt(record, i, spoilt[i], offset, (-math.inf, math.inf)))
        panels.append(Axes(curves, label(record.output_names[i], record.output_units[i]),
                           spans=[Span(a + offset, b + offset, RED, 'gap')
                                  for a, b in gaps_of(signal)], height=130.0))
    inputs = input_axes(record, offset, record.input_names, record.input_units)
    return [Figure(Drawing((*panels, *inputs), link='time', wide=True),
                   'There is no model of these data; shaded: gaps.', 'Signals as recorded')]


def _corrupt(record: Record, i: int, times: Array, offset: float, limits: tuple[float, float]
             ) -> Curve:
    """Return crosses at the corrupt samples of an output, within limits."""
    signal, column = [*_columns(record.outputs)][i]
    rows = np.isin(signal.time, times)
    return Curve(signal.time[rows] + offset, np.clip(signal.values[rows, column], *limits),
                 'corrupt, not used', RED, 'cross')


def _joined(parts: Sequence[Part], i: int, offset: float) -> tuple[Array, Array, Array]:
    """Return times, measured and simulated values of an output, with a break between parts."""
    rows: list[list[Array]] = []
    for part in parts:
        good = np.isfinite(part.found.y[:, i])
        rows.append([np.append(v[good], np.nan) for v in (
            part.found.times + offset, part.found.y[:, i], part.found.y_hat[:, i])])
    times, y, y_hat = (np.concatenate(v) for v in zip(*rows, strict=True))
    return times, y, y_hat


def _limits(y: Array) -> tuple[float, float]:
    known = y[np.isfinite(y)]
    low, high = np.quantile(known, (0.002, 0.998)) if len(known) else (0.0, 1.0)
    room = 0.3 * (float(high - low) or 1.0)
    return float(low) - room, float(high) + room


def input_axes(record: Record, offset: float, names: Sequence[str], units: Sequence[str]
               ) -> tuple[Axes, ...]:
    """Return the inputs of a record, those of one unit together; as sent, too, if that differs."""
    groups: dict[str, list[Curve]] = {}
    for j, ((signal, column), sent) in enumerate(zip(
            _columns(record.inputs), _columns(record.commands), strict=True)):
        own, colour = groups.setdefault(units[j] or names[j], []), 3 + (j + 3) % 4 if j < 4 else \
            j % 7
        acts = sent[0].hold != signal.hold or not np.array_equal(
            sent[0].values[:, sent[1]], signal.values[:, column])
        for (one, k), name, shade in (
                ((signal, column), names[j] + ', as it acts' * acts, colour),
                *(((sent, f'{names[j]}, as sent', (colour + 1) % 7),) if acts else ())):
            inside = _inside(one, record)
            own.append(Curve(one.time[inside] + offset, one.values[inside, k], name, shade,
                             'steps' if one.hold == 'zoh' else 'line', width=1.2))
    panels = [Axes(curves, label(', '.join(c.label for c in curves), unit * (unit in units)),
                   height=90.0) for unit, curves in groups.items()]
    last = panels[-1]
    panels[-1] = Axes(last.curves, last.title, _TIME, height=last.height)
    return tuple(panels)


def _columns(signals: Sequence[Signal]) -> Iterator[tuple[Signal, int]]:
    for signal in signals:
        for column in range(signal.width):
            yield signal, column


def _signal_of(signals: Sequence[Signal], i: int) -> Signal:
    return next(s for s, place in placed(signals) if place.start <= i < place.stop)


def _inside(signal: Signal, record: Record) -> Mask:
    found: Mask = (signal.time >= record.start) & (signal.time <= record.end)
    return found


def gaps_of(signal: Signal) -> list[tuple[float, float]]:
    """Return the longest gaps of a signal in the order of time: intervals of many periods."""
    steps = np.diff(signal.time)
    places = np.flatnonzero(steps > _GAP * signal.period)
    kept = sorted(places[np.argsort(-steps[places])][:_MOST_SPANS].tolist())
    return [(float(signal.time[k]), float(signal.time[k + 1])) for k in kept]


def sampling_figures(record: Record, offset: float) -> list[Figure]:
    """Draw the intervals between the samples of each signal: jitter, gaps, losses."""
    figures, done = [], set()
    for signal in (s.between(record.start, record.end) for s in (*record.inputs, *record.outputs)):
        key = (len(signal.time), float(signal.time[0]), float(signal.time[-1]))
        if len(signal.time) < 2 or key in done:      # channels of one message
            continue
        done.add(key)
        steps, usual = 1e3 * np.diff(signal.time), 1e3 * signal.period
        steps = np.where(np.abs(steps - usual) < _ROUNDING * usual, usual, steps)
        gaps = gaps_of(signal)
        title = ', '.join(signal.names) or 'signal'
        figures.append(Figure(Drawing((Axes(
            [Curve(signal.time[1:] + offset, steps, 'interval', 1, 'dots', opacity=0.7)],
            'interval between samples [ms]', _TIME, levels=(usual,), height=130.0,
            y_log=bool(gaps), spans=[Span(a + offset, b + offset, RED, 'gap') for a, b in gaps]),
        ), link='time'), f'Median {usual:.4g} ms, jitter (standard deviation, gaps left out) '
            f'{_jitter(steps, usual):.2g} ms, {len(gaps) or "no"} gap'
            f'{"" if len(gaps) == 1 else "s"} of more than five periods.', title))
    return figures


def _jitter(steps: Array, usual: float) -> float:
    near = steps[steps <= _GAP * usual]
    jitter = float(near.std()) if len(near) else math.nan
    return 0.0 if jitter < 1e-9 * usual else jitter
