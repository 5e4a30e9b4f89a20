# SPDX-License-Identifier: Apache-2.0
"""The drawings of a report: measured and simulated outputs, poles along the bag, Bode."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance, response_deviation
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import Validation
from ctsid_ros.report.document import Figure
from ctsid_ros.report.svg import Axes, Curve, draw
from ctsid_ros.report.tables import percent
from ctsid_ros.report.tracks import Mode, Track, modes, tracks

_MOST_OUTPUTS, _MOST_PAIRS, _MOST_TRACKS = 6, 9, 12
_MOST_DB, _MOST_DEG = 20.0, 90.0  # half the width of a band
_COLORS = 6
_MOST_DOTS = 400
_LASTING = 3  # windows: what shows up in fewer is drawn in grey
_SEGMENTS = 8  # of the record, for spectra
_EXPLAINED = 0.5  # of the power at a frequency: above, the data support the model there


def label(name: str, unit: str) -> str:
    """Return a name with its unit."""
    return f'{name} [{unit}]' if unit else name


def output_figures(model: StateSpace, found: Validation, offset: float, what: str,
                   fit: Array | None = None) -> list[Figure]:
    """
    Draw measured and simulated outputs.

    Parameters
    ----------
    model : StateSpace
    found : Validation
    offset : float
        Added to its times [s].
    what : str
        Which data these are.
    fit : ndarray, optional
        The fits that the report gives for these data, if they are others than those of the
        simulation [%].
    """
    figures, fits = [], found.fit if fit is None or len(fit) != model.ny else fit
    for i in range(min(model.ny, _MOST_OUTPUTS)):
        good = np.isfinite(found.y[:, i])
        times = found.times[good] + offset
        measured, simulated = found.y[good, i], found.y_hat[good, i]
        span = float(np.ptp(measured)) or 1.0
        low, high = float(measured.min()) - 0.3 * span, float(measured.max()) + 0.3 * span
        drawn = Axes(
            (Curve(times, measured, 'measured', 0, opacity=0.45, width=4.0),
             Curve(times, np.clip(simulated, low - span, high + span), 'simulated', 2,
                   width=1.2)),
            label(model.output_names[i], model.output_units[i]),
            x_label='time after the start of the bag [s]',
            y_limits=(low, high) if _leaves(simulated, low, high) else None)
        figures.append(Figure(draw(drawn), f'{what}: simulated from the inputs alone. Fit: '
                              f'{percent(fits[i])} %.'))
    return figures


def _leaves(values: Array, low: float, high: float) -> bool:
    with np.errstate(invalid='ignore'):
        return not bool(np.all((values >= low) & (values <= high)))


def track_figures(estimates: Sequence[Estimate], times: Array,
                  truth: StateSpace | None = None) -> list[Figure]:
    """
    Draw natural frequency and damping of all modes over time, with bands of two deviations.

    Parameters
    ----------
    estimates : sequence of Estimate
    times : ndarray
        Middle of each window [s].
    truth : StateSpace, optional
        Its modes are drawn as dashed lines.
    """
    found = tracks(estimates)[:_MOST_TRACKS]
    if not found:
        return []
    true = modes(truth)
    # A real pole has damping 1 and says nothing more; an oscillating one does.
    oscillating = [t for t in found if any(m.pole.imag > 0 for m in t.modes)]
    dashed = '; dashed: the truth' if truth else ''
    figures = [Figure(draw(Axes(
        [track_curve(t, times, i, frequency=True) for i, t in enumerate(found)],
        'natural frequency of the poles [rad/s]', 'time after the start of the bag [s]',
        y_log=True, levels=[m.frequency for m in true], height=300.0,
        y_limits=_around([m.frequency for t in found for m in t.modes], log=True))),
        f'One dot per window, at its middle; the band is two standard deviations{dashed}.')]
    if oscillating:
        figures.append(Figure(draw(Axes(
            [track_curve(t, times, found.index(t), frequency=False) for t in oscillating],
            'damping ratio of the oscillating poles', 'time after the start of the bag [s]',
            levels=[m.damping for m in true if m.pole.imag > 0],
            y_limits=_around([m.damping for t in oscillating for m in t.modes if m.pole.imag > 0],
                             log=False))), ''))
    return figures


def _around(values: Sequence[float], *, log: bool) -> tuple[float, float]:
    """Return limits for values; bands of what is hardly known would make them too wide."""
    if log:
        known = [v for v in values if v > 0] or [1.0]
        return min(known) / 2, max(known) * 2
    room = max(0.2 * (max(values) - min(values)), 0.02)
    return min(values) - room, max(values) + room


def track_curve(track: Track, times: Array, number: int, *, frequency: bool) -> Curve:
    """Return natural frequency or damping of a track over time, with its band."""
    at = times[list(track.windows)]
    chosen = [m if frequency or m.pole.imag > 0 else Mode(complex(math.nan)) for m in track.modes]
    values = np.array([m.frequency if frequency else m.damping for m in chosen])
    std = np.array([_known_std(m, frequency=frequency) for m in chosen])
    low = np.maximum(values - 2 * std, values / 10) if frequency else values - 2 * std
    high = np.minimum(values + 2 * std, 10 * values) if frequency else values + 2 * std
    color = 1 + number % _COLORS if len(track.modes) >= _LASTING else 0
    return Curve(at, values, '', color, 'both' if len(at) <= _MOST_DOTS else 'line', low, high)


def _known_std(mode: Mode, *, frequency: bool) -> float:
    """Return the deviation of natural frequency or damping, made from the pole's if it must be."""
    known = mode.frequency_std if frequency else mode.damping_std
    if not math.isnan(known):
        return known
    # As if that of a pair had two directions alike: along its radius, and across.
    along = mode.std / (math.sqrt(2) if mode.pole.imag else 1.0)
    return along if frequency else along / abs(mode.pole)


def frequencies(model: StateSpace, band: tuple[float, float] | None = None, count: int = 300
                ) -> Array:
    """Return frequencies that show all of a model's poles, and the band [rad/s]."""
    known = [w for w in model.natural_frequency if w > 0] + list(band or ())
    low, high = (min(known), max(known)) if known else (1.0, 1.0)
    return np.geomspace(low / 10, high * 10, count)


def bode_figures(model: StateSpace, bands: Sequence[tuple[float, float] | None] = (),
                 truth: StateSpace | None = None, covariance: Covariance | None = None
                 ) -> list[Figure]:
    """
    Draw magnitude and phase of each input to each output, up to nine pairs of them.

    Shaded where `bands` say so, one for each input [rad/s]. With a covariance, each with a band
    of two standard deviations.
    """
    shades = [*bands, *(None,) * model.nu]
    ends = [w for band in shades if band for w in band if 0.0 < w < math.inf]
    omega = frequencies(model, (min(ends), max(ends)) if ends else None)
    std = response_std(model, omega, covariance)
    figures: list[Figure] = []
    pairs = [(i, j) for i in range(model.ny) for j in range(model.nu)]
    for i, j in pairs[:_MOST_PAIRS]:
        curves = [(response_of(model, omega, i, j), 'identified' if truth else '', 1, False)]
        if truth and (truth.ny, truth.nu) == (model.ny, model.nu):
            curves.append((response_of(truth, omega, i, j), 'true', 2, True))
        title = f'{model.input_names[j]} → {model.output_names[i]}'
        figures += [Figure(draw(Axes(
            [Curve(omega, g[k], text, c, 'dashed' if dashed else 'line',
                   *(_around_curve(g[k], std[k][:, i, j], widest) if c == 1 else ()))
             for g, text, c, dashed in curves], f'{title}: {what}', 'rad/s', x_log=True,
            shade=shades[j], height=height)), '')
            for k, widest, what, height in ((0, _MOST_DB, 'magnitude [dB]', 220.0),
                                            (1, _MOST_DEG, 'phase [deg]', 200.0))]
    return figures


def _around_curve(values: Array, std: Array, widest: float
                  ) -> tuple[Array, Array] | tuple[None, None]:
    """Return the ends of a band of two deviations, not wider than makes a picture."""
    if np.isnan(std).all():
        return None, None
    half = np.minimum(2.0 * std, widest)
    return values - half, values + half


def response_std(model: StateSpace, omega: Array, covariance: Covariance | None
                 ) -> tuple[Array, Array]:
    """Return the standard deviations of magnitude [dB] and phase [deg]; NaN where unknown."""
    if covariance is None:
        nothing = np.full((len(omega), model.ny, model.nu), np.nan)
        return nothing, nothing
    found = response_deviation(covariance, model, omega)
    return 20.0 / math.log(10.0) * found.magnitude, np.degrees(found.phase)


def response_of(model: StateSpace, omega: Array, i: int, j: int) -> tuple[Array, Array]:
    """Return magnitude [dB] and continuous phase [deg] from input j to output i."""
    response = model.frequency_response(omega)[:, i, j]
    with np.errstate(divide='ignore', invalid='ignore'):
        gain = 20 * np.log10(np.abs(response))
    known = np.isfinite(response) & (response != 0)
    phase = np.full(len(omega), np.nan)
    phase[known] = np.degrees(np.unwrap(np.angle(response[known])))
    if known.any():  # begin between -270 and 90 degrees: a plant lags
        first = phase[known][0]
        phase -= 360.0 * math.ceil((first - 90.0 - 1e-6) / 360.0)
    return gain, phase


def supported_band(found: Validation) -> tuple[float, float] | None:
    """
    Return the band in which a model explains most of the power of some output [rad/s].

    Notes
    -----
    Spectra of the output and of the simulation's residuals (interpolated to uniform times,
    for this picture only), averaged over eight half-overlapping segments. Of several such bands
    the one with the most octaves; None if there is none.
    """
    bands = [band for i in range(found.y.shape[1]) if (band := _band_of(found, i))]
    return (min(b[0] for b in bands), max(b[1] for b in bands)) if bands else None


def _band_of(found: Validation, i: int) -> tuple[float, float] | None:
    good = np.isfinite(found.y[:, i]) & np.isfinite(found.y_hat[:, i])
    times, y, e = found.times[good], found.y[good, i], (found.y - found.y_hat)[good, i]
    if len(times) < 16 * _SEGMENTS:
        return None
    grid = np.linspace(times[0], times[-1], len(times))
    size = 2 * len(grid) // (_SEGMENTS + 1)
    power = [_spectrum(np.interp(grid, times, x), size) for x in (y, e)]
    step = 2 * math.pi / (size * (grid[1] - grid[0]))
    explained = np.concatenate([[False], power[1][1:] < (1 - _EXPLAINED) * power[0][1:], [False]])
    edges = np.flatnonzero(np.diff(explained.astype(int)))
    # What reaches down to the first line of the spectra reaches down to the length of the record.
    least = 2 * math.pi / float(times[-1] - times[0])
    runs = [(step * (a + 1) if a else least, step * b)
            for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return max(runs, key=lambda run: run[1] / run[0], default=None)


def _spectrum(values: Array, size: int) -> Array:
    window = np.hanning(size)
    parts = [values[first:first + size] for first in range(0, len(values) - size + 1, size // 2)]
    power: Array = np.mean([np.abs(np.fft.rfft(window * (p - p.mean()))) ** 2 for p in parts],
                           axis=0)
    return power
