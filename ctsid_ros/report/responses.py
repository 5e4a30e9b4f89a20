# SPDX-License-Identifier: Apache-2.0
"""Responses drawn: Bode diagrams with bands, spectra and coherence; step responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance, response_deviation
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.gains import horizon, step_response
from ctsid_core.model.statespace import StateSpace
from ctsid_ros.report.document import Figure
from ctsid_ros.report.drawing import Axes, Curve, Drawing, Span
from ctsid_ros.report.spectra import Spectra
from ctsid_ros.report.tables import label

MOST_PAIRS = 36                     # of an input and an output
_MOST_DB, _MOST_DEG = 20.0, 90.0    # half the width of a band
_COHERENT = 0.3     # coherence below which spectra show no response
_BEYOND = 3.0       # times the supported frequencies: there the phase is worth its room
_AXIS = 'frequency [rad/s]'
_WIDTH = 1.8        # of lines of models
_BELOW = 10.0       # times below the excited band is nothing drawn
_STILL = 1e-4       # of the fastest pole: a slower one integrates

Bands = Sequence[tuple[float, float] | None]


def frequencies(model: StateSpace, band: tuple[float, float] | None = None, count: int = 300
                ) -> Array:
    """
    Return frequencies that show a model's poles, and the band [rad/s].

    What is slower than a tenth of the band was not seen: a pole there only goes on as a slope.
    Without a band that is a pole which integrates, beside the fastest.
    """
    known = [w for w in model.natural_frequency if w > 0]
    high = max((*known, *(band or ())), default=1.0)
    low = min(band) if band else min((w for w in known if w > _STILL * high), default=high)
    return np.geomspace(low / _BELOW, high * 10, count)


def excited(estimate: Estimate) -> tuple[float, float] | None:
    """Return the band in which inputs excite the plant, all together [rad/s]."""
    return _together([(x.low, x.high) for x in estimate.verdict.excitation if x.high > x.low])


def _together(bands: Bands) -> tuple[float, float] | None:
    ends = [w for band in bands if band for w in band if 0.0 < w < math.inf]
    return (min(ends), max(ends)) if ends else None


def step_length(model: StateSpace, band: tuple[float, float] | None = None) -> float:
    """Return how long a step response is shown [s]: nothing slower than `frequencies` does."""
    return min(horizon(model), _BELOW / band[0]) if band else horizon(model)


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
    late = np.degrees(omega * model.delay[j])      # its turns may be too quick to be followed
    phase[known] = np.degrees(np.unwrap(np.angle(
        response[known] * np.exp(1j * omega[known] * model.delay[j])))) - late[known]
    if known.any():  # begin between -270 and 90 degrees: a plant lags
        first = phase[known][0] + late[known][0]
        phase -= 360.0 * math.ceil((first - 90.0 - 1e-6) / 360.0)
    return gain, phase


def bode_figures(models: Mapping[str, tuple[StateSpace, Covariance | None]], bands: Bands = (),
                 seen: Spectra | None = None, truth: StateSpace | None = None) -> list[Figure]:
    """
    Draw magnitude and phase of each input to each output, and the coherence.

    Parameters
    ----------
    models : mapping
        Models with their covariances, by their names in the legend; of the same channels.
    bands : sequence of (low, high), optional
        Of each input, shaded [rad/s].
    seen : Spectra, optional
    truth : StateSpace, optional
        Drawn dashed.
    """
    first = next(iter(models.values()))[0]
    omega = _shown(models, bands, seen)
    shades = [*bands, *(None,) * first.nu]
    return [Figure(_bode(models, omega, (i, j), shades[j], seen, truth),
                   title=f'{first.input_names[j]} → {first.output_names[i]}')
            for i, j in pairs(first)]


def pairs(model: StateSpace) -> list[tuple[int, int]]:
    """Return outputs with inputs, row by row, as far as they are drawn."""
    return [(i, j) for i in range(model.ny) for j in range(model.nu)][:MOST_PAIRS]


def _shown(models: Mapping[str, tuple[StateSpace, Covariance | None]], bands: Bands,
           seen: Spectra | None) -> Array:
    band = _together(bands)
    known = [frequencies(model, band) for model, _ in models.values()]
    low, high = min(w[0] for w in known), max(w[-1] for w in known)
    if seen is not None:    # beyond the samples' highest frequency there is nothing to compare
        top = max([float(seen.omega[-1]), *(band or ()), *(
            2.0 * w for model, _ in models.values() for w in model.natural_frequency)])
        high = min(high, 1.5 * top)
    return np.geomspace(low, high, 300)


def _bode(models: Mapping[str, tuple[StateSpace, Covariance | None]], omega: Array,
          pair: tuple[int, int], band: tuple[float, float] | None, seen: Spectra | None,
          truth: StateSpace | None) -> Drawing:
    i, j = pair
    gains: list[Curve] = []
    phases: list[Curve] = []
    found = {name: response_of(model, omega, i, j) for name, (model, _) in models.items()}
    lead = next(iter(found.values()))
    if seen is not None:
        good = (seen.coherence[:, i, j] > _COHERENT) & (seen.omega >= omega[0])
        at, dots = seen.omega[good], seen.response[good, i, j]
        with np.errstate(divide='ignore'):
            gains.append(Curve(at, 20.0 * np.log10(np.abs(dots)), 'from spectra', 0, 'dots'))
        phases.append(Curve(at, _near(np.degrees(np.angle(dots)), at, omega, lead[1]),
                            'from spectra', 0, 'dots'))
    for color, (name, (model, covariance)) in enumerate(models.items(), 1):
        std = response_std(model, omega, covariance)
        for curves, values, own, most in ((gains, found[name][0], std[0], _MOST_DB),
                                          (phases, found[name][1], std[1], _MOST_DEG)):
            curves.append(Curve(omega, values, name, color, 'line',
                                *_around(values, own[:, i, j], most),
                                width=_WIDTH, layer=(color, len(models))))
    if truth and (truth.ny, truth.nu) == _sizes(models):
        for curves, values in zip((gains, phases), response_of(truth, omega, i, j), strict=True):
            curves.append(Curve(omega, values, 'true', 2, 'dashed'))
    spans = [Span(*band, text='excited')] if band else []
    limits, step = _phase_range(omega, lead[1], band)
    ends = (float(omega[0]), float(omega[-1]))
    panels = [Axes(gains, 'magnitude [dB]', spans=spans, x_log=True, x_limits=ends, height=150.0),
              Axes(phases, 'phase [deg]', spans=spans, x_log=True, y_limits=limits, step=step,
                   x_limits=ends, height=130.0)]
    if seen is not None:
        panels.append(Axes([Curve(seen.omega, seen.coherence[:, i, j], 'coherence', 6)],
                           'coherence', spans=spans, x_log=True, x_limits=ends,
                           y_limits=(0.0, 1.05), height=70.0))
    panels[-1] = _labelled(panels[-1], _AXIS)
    return Drawing(tuple(panels), link='frequency', wide=_sizes(models) == (1, 1))


def _sizes(models: Mapping[str, tuple[StateSpace, Covariance | None]]) -> tuple[int, int]:
    first = next(iter(models.values()))[0]
    return first.ny, first.nu


def _labelled(axes: Axes, words: str) -> Axes:
    from dataclasses import replace

    return replace(axes, x_label=words)


def _near(phase: Array, at: Array, omega: Array, reference: Array) -> Array:
    """Return phases by full turns as near as they can be to that of the model [deg]."""
    if not np.isfinite(reference).all():
        return phase
    own = np.interp(np.log(at), np.log(omega), reference)
    moved: Array = phase + 360.0 * np.round((own - phase) / 360.0)
    return moved


def _around(values: Array, std: Array, widest: float) -> tuple[Array | None, Array | None]:
    """Return the ends of a band of two deviations, not wider than makes a picture."""
    if np.isnan(std).all():
        return None, None
    half = np.minimum(2.0 * std, widest)
    return values - half, values + half


def _phase_range(omega: Array, phase: Array, band: tuple[float, float] | None
                 ) -> tuple[tuple[float, float] | None, float]:
    """Return limits of the phase where it matters, and the step of its numbers [deg]."""
    inside = np.isfinite(phase)
    if band and band[1] > 0.0:
        inside &= omega <= _BEYOND * band[1]
    if not inside.any():
        return None, 90.0
    low, high = float(np.min(phase[inside])), float(np.max(phase[inside]))
    step = 45.0 if high - low < 200.0 else 90.0 if high - low < 450.0 else 180.0 if \
        high - low < 1100.0 else 360.0 * math.ceil((high - low) / 2200.0)
    return (step * math.floor((low - 15.0) / step), step * math.ceil((high + 15.0) / step)), step


def step_figures(models: Mapping[str, tuple[StateSpace, Covariance | None]],
                 truth: StateSpace | None = None, bands: Bands = ()) -> list[Figure]:
    """Draw the response of each output to a unit step of each input, with bands."""
    first = next(iter(models.values()))[0]
    shown = max(step_length(model, _together(bands)) + max(model.delay, default=0.0)
                for model, _ in models.values())     # that of a small dead time goes on to there
    found = {name: step_response(model, covariance, length=shown if all(
        model.poles.real < 0.0) else None) for name, (model, covariance) in models.items()}
    true = step_response(truth) if truth and (truth.ny, truth.nu) == _sizes(models) else None
    figures = []
    for i, j in pairs(first):
        curves = []
        for color, (name, f) in enumerate(found.items(), 1):
            curves.append(_late(f.times, f.values[:, i, j], f.std[:, i, j],
                                models[name][0].delay[j], name, color,
                                layer=(color, len(found))))
        if true is not None and truth is not None:
            curves.append(_late(true.times, true.values[:, i, j], true.std[:, i, j],
                                truth.delay[j], 'true', 2, dashed=True))
        figures.append(Figure(Drawing((Axes(
            curves, label(first.output_names[i], first.output_units[i]), 'time after the step [s]',
            x_limits=(0.0, shown), height=170.0),), link='step'),
            title=f'{first.input_names[j]} → {first.output_names[i]}'))
    return figures


def _late(times: Array, values: Array, std: Array, delay: float, name: str, color: int, *,
          dashed: bool = False, layer: tuple[int, int] = (1, 1)) -> Curve:
    """Return a step response after its dead time, and zero before."""
    x = np.concatenate(([0.0, delay], times + delay))
    y, s = (np.concatenate(([0.0, 0.0], v)) for v in (values, std))
    known = bool(np.isfinite(std).any())
    return Curve(x, y, name, color, 'dashed' if dashed else 'line', y - 2 * s if known else None,
                 y + 2 * s if known else None, width=_WIDTH, layer=layer)
