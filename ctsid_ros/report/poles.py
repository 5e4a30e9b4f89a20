# SPDX-License-Identifier: Apache-2.0
"""Poles drawn: in the plane with their confidence regions, and along windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance, pole_covariance
from ctsid_core.model.statespace import StateSpace
from ctsid_ros.report.document import Figure
from ctsid_ros.report.drawing import Axes, Curve, Drawing, over
from ctsid_ros.report.tables import number, pole_text
from ctsid_ros.report.tracks import Mode, Track

_ELLIPSE = math.sqrt(5.991)     # 95 % of a normal distribution in the plane ...
_LINE = 1.960                   # ... and along a line, of a real pole
_TURN = np.linspace(0.0, 2.0 * math.pi, 61)
_COLORS = 6
_MOST_DOTS = 400
_LASTING = 3  # windows: what shows up in fewer is drawn in grey
_ROOM = 0.12    # of the size of the picture, around poles
_FAR = 0.6      # ... and that an uncertain pole may ask for


def pole_figure(models: Mapping[str, tuple[StateSpace, Covariance | None]],
                truth: StateSpace | None = None) -> Figure:
    """
    Draw the poles of models in the complex plane, with regions of 95 % confidence.

    Parameters
    ----------
    models : mapping
        Models with their covariances, by their names in the legend.
    truth : StateSpace, optional
    """
    crosses, regions = [], []
    for color, (name, (model, covariance)) in enumerate(models.items(), 1):
        spread = pole_covariance(covariance, model) if covariance is not None else \
            np.full((model.n, 2, 2), np.nan)
        crosses.append(Curve(model.poles.real, model.poles.imag, name, color, 'cross',
                             width=over(color, models), texts=[
            f'{name}: {pole_text(p)} rad/s, std {number(float(np.sqrt(np.trace(s))), 2)}'
            for p, s in zip(model.poles, spread, strict=True)]))
        regions += [region(complex(p), s, color) for p, s in zip(model.poles, spread, strict=True)
                    if np.isfinite(s).all()]
    if truth is not None:                               # below those that are found
        crosses.insert(0, Curve(truth.poles.real, truth.poles.imag, 'true', 2, 'cross', texts=[
            f'true: {pole_text(p)} rad/s' for p in truth.poles], width=over(0, models)))
    every = np.concatenate([np.array([0.0]), *(c.x + 1j * c.y for c in crosses)])
    wide = np.concatenate([every, *(r.x + 1j * r.y for r in regions)])
    limits = [_limits(f(every), f(wide)) for f in (np.real, np.imag)]
    small = [r for r in regions if np.ptp(r.x) <= np.ptp(limits[0])
             and np.ptp(r.y) <= np.ptp(limits[1])]   # of a larger one only its sides were seen
    words = ['Regions of 95 % confidence (lines at real poles).'] if small else []
    if len(small) < len(regions):
        words.append(f'{len(regions) - len(small)} of {len(regions)} regions of 95 % confidence '
                     'are larger than the drawing and not shown.')
    words.append('Right of the dashed line a pole is unstable.')
    return Figure(Drawing((Axes(
        [*crosses, *small], 'imaginary part [rad/s]', 'real part [rad/s]',
        marks=[(0.0, '')], x_limits=limits[0], y_limits=limits[1], height=300.0),)),
        ' '.join(words), 'Poles')


def region(pole: complex, covariance: Array, color: int) -> Curve:
    """Return the outline of the region of 95 % confidence; the covariance is 2 x 2."""
    values, vectors = np.linalg.eigh(covariance)
    size = np.sqrt(np.maximum(values, 0.0)) * (_ELLIPSE if pole.imag else _LINE)
    x, y = vectors @ (size[:, np.newaxis] * np.array([np.cos(_TURN), np.sin(_TURN)]))
    return Curve(pole.real + x, pole.imag + y, '', color, width=1.0)


def _limits(near: Array, wide: Array) -> tuple[float, float]:
    """Return what holds all poles, and their regions unless these are huge."""
    low, high = float(np.min(near)), float(np.max(near))
    size = (high - low) or 1.0
    low, high = (max(float(np.min(wide)), low - _FAR * size),
                 min(float(np.max(wide)), high + _FAR * size))
    return low - _ROOM * size, high + _ROOM * size


def around(values: Sequence[float], *, log: bool, std: Array | None = None
           ) -> tuple[float, float]:
    """Return limits for values and usual bands; what is hardly known would make them too wide."""
    if log:
        known = [v for v in values if v > 0] or [1.0]
        return min(known) / 2, max(known) * 2
    usual = 0.0 if std is None or np.isnan(std).all() else float(np.nanmedian(std))
    room = max(0.2 * (max(values) - min(values)), 2.4 * usual, 0.02 * abs(max(values)))
    room = room or 1.0
    return min(values) - room, max(values) + room


def track_curve(track: Track, times: Array, number: int, *, frequency: bool) -> Curve:
    """Return natural frequency or damping of a track over time, with its band; with breaks."""
    windows = range(track.windows[0], track.windows[-1] + 1)
    seen, none = dict(zip(track.windows, track.modes, strict=True)), Mode(complex(math.nan))
    at, chosen = times[windows.start:windows.stop], [
        m if frequency or m.pole.imag > 0 else none for m in (seen.get(k, none) for k in windows)]
    values = np.array([m.frequency if frequency else m.damping for m in chosen])
    std = np.array([_known_std(m, frequency=frequency) for m in chosen])
    low = np.maximum(values - 2 * std, values / 10) if frequency else values - 2 * std
    high = np.minimum(values + 2 * std, 10 * values) if frequency else values + 2 * std
    color = 1 + number % _COLORS if len(track.modes) >= _LASTING else 0
    return Curve(at, values, f'mode {number + 1}' if color else 'seen in few windows', color,
                 'both' if len(track.windows) <= _MOST_DOTS else 'line', low, high)


def scattered(tracks: Sequence[Track], times: Array, *, frequency: bool) -> Curve:
    """Return natural frequency or damping of modes that were seen in few windows, as dots."""
    found = [(times[k], m.frequency if frequency else m.damping) for t in tracks
             for k, m in zip(t.windows, t.modes, strict=True) if frequency or m.pole.imag > 0]
    at, values = np.array(found, dtype=float).reshape(-1, 2).T
    return Curve(at, values, 'seen in few windows', 0, 'dots')


def _known_std(mode: Mode, *, frequency: bool) -> float:
    """Return the deviation of natural frequency or damping, made from the pole's if it must be."""
    known = mode.frequency_std if frequency else mode.damping_std
    if not math.isnan(known):
        return known
    # As if that of a pair had two directions alike: along its radius, and across.
    along = mode.std / (math.sqrt(2) if mode.pole.imag else 1.0)
    return along if frequency else along / abs(mode.pole)
