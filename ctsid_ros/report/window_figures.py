# SPDX-License-Identifier: Apache-2.0
"""Models of consecutive windows drawn: verdicts, modes, gains and dead times over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.gains import gains
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Grade
from ctsid_ros.replay.along import Windows, changes
from ctsid_ros.report.document import Figure
from ctsid_ros.report.drawing import AMBER, GREEN, RED, Axes, Curve, Drawing, Span
from ctsid_ros.report.poles import around, scattered, track_curve
from ctsid_ros.report.tables import label
from ctsid_ros.report.tracks import modes, tracks

PAINT = {Grade.GOOD: GREEN, Grade.WEAK: AMBER, Grade.REJECT: RED}
_TIME = 'time after the start of the bag [s]'
_MOST_TRACKS, _MOST_GAINS = 12, 12


def window_figure(windows: Windows, truth: StateSpace | None = None) -> Figure:
    """Draw verdicts, fits, natural frequency, damping and dead time over time."""
    seen = [(c.time, 'change') for c in changes(windows) if c.rejects]
    panels = [_strip(windows, [(t, '') for t, _ in seen]), _fits(windows, seen),
              *_modes(windows, truth, seen),
              *_dead_times(windows, seen)]
    last = panels[-1]
    panels[-1] = Axes(last.curves, last.title, _TIME, '', y_log=last.y_log, levels=last.levels,
                      marks=last.marks, y_limits=last.y_limits, height=last.height)
    dashed = ' Dashed across: the truth.' if truth else ''
    return Figure(Drawing(tuple(panels), link='time', wide=True, picks=True),
                  'One dot per window, at its middle; bands are two standard deviations.'
                  f'{dashed} A click shows the model of a window below, where the page is '
                  'interactive.')


def _strip(windows: Windows, marks: Sequence[tuple[float, str]]) -> Axes:
    """Return the verdicts as a strip, neighbours of one kind together."""
    middles, grades = windows.middles, [e.verdict.grade for e in windows.estimates]
    edges = _edges(windows)
    spans, first = [], 0
    for k in range(1, len(grades) + 1):
        if k == len(grades) or grades[k] is not grades[first]:
            spans.append(Span(float(edges[first]), float(edges[k]), PAINT[grades[first]],
                              grades[first].name, 0.45))
            first = k
    curves = []
    for grade, color in PAINT.items():
        rows = [k for k, g in enumerate(grades) if g is grade]
        if rows:
            curves.append(Curve(middles[rows], np.full(len(rows), 0.5), grade.name, color, 'dots',
                                texts=[f'window {k + 1}: {windows.estimates[k].status.name}, '
                                       f'{grade.name}' for k in rows]))
    return Axes(curves, 'verdict', spans=spans, marks=marks, y_limits=(0.0, 1.0), bare=True,
                height=46.0)


def _edges(windows: Windows) -> Array:
    """Return where the strip goes from one window to the next [s]."""
    m = windows.middles
    if len(m) == 1:
        return np.array([windows.starts[0], windows.ends[0]])
    inner = 0.5 * (m[1:] + m[:-1])
    edges: Array = np.concatenate(([m[0] - (inner[0] - m[0])], inner,
                                   [m[-1] + (m[-1] - inner[-1])]))
    return edges


def _fits(windows: Windows, marks: Sequence[tuple[float, str]]) -> Axes:
    names = _names(windows)
    curves = []
    for i, name in enumerate(names):
        fits = np.array([e.fit[i] if i < len(e.fit) else np.nan for e in windows.estimates])
        curves.append(Curve(windows.middles, fits, f'fit of {name}', 1 + i % 6, 'both'))
        curves.append(Curve(windows.middles, windows.next_fits[:, i], f'next fit of {name}',
                            1 + i % 6, 'dashed'))
    known = np.concatenate([c.y[np.isfinite(c.y)] for c in curves] or [np.empty(0)])
    low = max(float(known.min()), 0.0) if len(known) else 0.0
    return Axes(curves, 'fit [%]', marks=marks, height=110.0,
                y_limits=(low - 4.0, 102.0))


def _names(windows: Windows) -> tuple[str, ...]:
    known = [m.output_names for e in windows.estimates if (m := e.model or e.rejected_model)]
    return known[0] if known else ()


def _modes(windows: Windows, truth: StateSpace | None, marks: Sequence[tuple[float, str]]
           ) -> Iterator[Axes]:
    every = tracks(windows.estimates)
    found, rest = every[:_MOST_TRACKS], every[_MOST_TRACKS:]
    lines, true = [(t, '') for t, _ in marks], modes(truth)
    if not found:
        return
    yield Axes([*(track_curve(t, windows.middles, i, frequency=True) for i, t in enumerate(found)),
                *([scattered(rest, windows.middles, frequency=True)] if rest else [])],
               'natural frequency [rad/s]', y_log=True, levels=[m.frequency for m in true],
               height=180.0, marks=lines,
               y_limits=around([m.frequency for t in found for m in t.modes], log=True))
    # A real pole has damping 1 and says nothing more; an oscillating one does.
    swinging = [t for t in found if any(m.pole.imag > 0 for m in t.modes)]
    if swinging:
        yield Axes([*(track_curve(t, windows.middles, found.index(t), frequency=False)
                      for t in swinging),
                    *([scattered(rest, windows.middles, frequency=False)] if rest else [])],
                   'damping ratio of the oscillating modes', marks=lines,
                   levels=[m.damping for m in true if m.pole.imag > 0], height=150.0,
                   y_limits=around([m.damping for t in swinging for m in t.modes
                                    if m.pole.imag > 0], log=False, std=np.array(
                                        [m.damping_std for t in swinging for m in t.modes
                                         if m.pole.imag > 0])))


def _dead_times(windows: Windows, marks: Sequence[tuple[float, str]]) -> Iterator[Axes]:
    known = [e.model for e in windows.estimates if e.model is not None]
    if not any(any(m.delay) for m in known):
        return
    none = np.full(known[0].nu, np.nan)
    late, deviations = (1e3 * np.array(rows) for rows in zip(*(
        (none, none) if e.model is None else (e.model.delay, e.delay_std)
        for e in windows.estimates), strict=True))
    curves = [Curve(windows.middles, values, f'dead time of {name}', 1 + j % 6, 'both',
                    values - 2 * std, values + 2 * std)
              for j, (name, values, std) in enumerate(zip(known[0].input_names, late.T,
                                                          deviations.T, strict=True))]
    low, high = float(np.nanmin(late)), float(np.nanmax(late))
    room = 0.3 * (high - low or high or 1.0)
    yield Axes(curves, 'dead time [ms]', marks=[(t, '') for t, _ in marks], height=110.0,
               y_limits=(max(low - room, 0.0), high + room))


def gain_figures(windows: Windows) -> list[Figure]:
    """Draw the gains over time, of the models that have any: most of them DC gains, or rates."""
    found = [None if e.model is None else gains(e.model, e.covariance) for e in windows.estimates]
    first = next((e.model for e, own in zip(windows.estimates, found, strict=True) if own), None)
    if first is None:
        return []
    rates = np.mean([own.rate for own in found if own], axis=0) > 0.5
    none = np.full(rates.shape, np.nan)
    values, stds = (np.array([none if own is None else np.where(
        own.rate == rates, getattr(own, key), np.nan) for own in found])
        for key in ('value', 'std'))
    figures = []
    for i, j in [(i, j) for i in range(first.ny) for j in range(first.nu)][:_MOST_GAINS]:
        y, s = values[:, i, j], stds[:, i, j]
        unit = _per(first.output_units[i], first.input_units[j])
        limits = around(y[np.isfinite(y)].tolist(), log=False, std=s)
        name = 'gain per second' if rates[i, j] else 'DC gain'
        figures.append(Figure(Drawing((Axes(
            [Curve(windows.middles, y, '', 1, 'both', y - 2 * s, y + 2 * s)],
            label(name, unit), _TIME, height=140.0, y_limits=limits),),
            link='time', picks=True), '', f'{first.input_names[j]} → {first.output_names[i]}'))
    return figures


def _per(above: str, below: str) -> str:
    """Return the unit of a gain; empty if it is not known."""
    if not above:
        return ''
    over, under = (f'({u})' if '/' in u or ' ' in u else u for u in (above, below))
    return f'{over}/{under}' if below else above
