# SPDX-License-Identifier: Apache-2.0
"""What the page shows of one window, or order, when it is clicked: for all of them, briefly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.gains import gains, step_response
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.actuators import by_kind
from ctsid_ros.replay.along import Windows
from ctsid_ros.report.drawing import Axes, Curve, Drawing
from ctsid_ros.report.interactive import figure, numbers
from ctsid_ros.report.poles import region
from ctsid_ros.report.responses import excited, frequencies, response_of, response_std, step_length
from ctsid_ros.report.tables import fit_words, gain_text, label, number, plus_minus, pole_text
from ctsid_ros.report.tracks import modes_of
from ctsid_ros.report.words import cell, printable

_POINTS = 32            # of a curve
_NEAR = (0.85, 0.92, 0.97, 1.0, 1.03, 1.09, 1.18)    # of a resonance
_OUTLINE = 4            # every so many points of the outline of a region are kept
_DIGITS = 4
_OF_PAIR = 1400         # bytes that an input and an output take in a window ...
_MOST = 1_000_000       # ... and that all may take
_WIDEST = 20.0          # half the width of a band [dB]


@dataclass(frozen=True)
class Item:
    """
    One of a series.

    Parameters
    ----------
    title : str
    at : float
        Where a click on a drawing chooses it.
    estimate : Estimate
    facts : mapping of str to str
        Its numbers, as the tables have them.
    """

    title: str
    at: float
    estimate: Estimate
    facts: Mapping[str, str]


def window_series(windows: Windows) -> dict[str, Any]:
    """Return the series of consecutive windows."""
    return series([Item(
        f'Window {k + 1} of {len(windows.estimates)}, {start:z.1f} to {end:.1f} s', middle,
        estimate, facts(estimate, {'next fit [%]': fit_words(next_fit)}))
        for k, (estimate, start, end, middle, next_fit) in enumerate(zip(
            windows.estimates, windows.starts.tolist(), windows.ends.tolist(),
            windows.middles.tolist(), windows.next_fits, strict=True))])


def series(items: Sequence[Item]) -> dict[str, Any]:
    """Return frames that all items share, and what is filled in for each."""
    models = [i.estimate.model or i.estimate.rejected_model for i in items]
    known = [m for m in models if m is not None]
    if not known:
        return {'frames': [], 'windows': [_item(item, []) for item in items]}
    first = known[0]
    pairs = [(i, j) for i in range(first.ny) for j in range(first.nu)]
    pairs = pairs[:max(int(_MOST / (_OF_PAIR * len(models))), 1)]
    bands = [excited(i.estimate) for i, m in zip(items, models, strict=True) if m is not None]
    every = [frequencies(m, band, 2) for m, band in zip(known, bands, strict=True)]
    sizes = [m.n for m in known]
    usual = max(sizes, key=lambda n: (sizes.count(n), n))
    omega = _shown([m for m in known if m.n == usual], every)
    length = float(np.median([step_length(m, band) + max(m.delay, default=0.0)
                              for m, band in zip(known, bands, strict=True)]))
    times = np.linspace(0.0, length, _POINTS)
    frames = _frames(first, pairs, omega, times)
    found = []
    for item, model in zip(items, models, strict=True):
        filled = _filled(item.estimate, model, pairs, omega, times) if model is not None and (
            model.ny, model.nu) == (first.ny, first.nu) else []
        found.append(_item(item, filled))
    return {'frames': frames, 'windows': found}


def _shown(models: Sequence[StateSpace], ends: Sequence[Array]) -> Array:
    """Return frequencies for all items, closer where the median mode oscillates."""
    wide = np.geomspace(float(np.median([w[0] for w in ends])),
                        float(np.median([w[-1] for w in ends])), _POINTS)
    swinging = [float(np.median([abs(m.poles[k]) for m in models]))
                for k, p in enumerate(models[0].poles) if p.imag > 0.0]
    near = [w * f for w in swinging for f in _NEAR][:_POINTS // 2]
    return np.sort(np.concatenate((wide[::1 + bool(near)], near)))


def _frames(model: StateSpace, pairs: Sequence[tuple[int, int]], omega: Array, times: Array
            ) -> list[dict[str, Any]]:
    """Return the figures without their curves: the plane of the poles, then two of each pair."""
    nothing, none, still = np.zeros(len(omega)), np.zeros(1), np.zeros(_POINTS)
    bode = Drawing((
        Axes([Curve(omega, nothing, '', 1, 'line', nothing, nothing)], 'magnitude [dB]',
             x_log=True, height=120.0),
        Axes([Curve(omega, nothing, '', 1)], 'phase [deg]', 'frequency [rad/s]', x_log=True,
             height=110.0)))
    frames = [figure(Drawing((Axes(
        [Curve(none, none, 'pole', 1, 'cross'), Curve(none, none, '95 %', 1, width=1.0)],
        'imaginary part [rad/s]', 'real part [rad/s]', marks=[(0.0, '')], height=230.0),)))]
    for i, _ in pairs:
        frames += [figure(bode), figure(Drawing((Axes(
            [Curve(times, still, '', 1, 'line', still, still)],
            label(model.output_names[i], model.output_units[i]), 'time after the step [s]',
            height=230.0),)))]
    return frames


def _filled(estimate: Estimate, model: StateSpace, pairs: Sequence[tuple[int, int]],
            omega: Array, times: Array) -> list[dict[str, Any]]:
    """Return titles and values of the figures of one window."""
    x, y = _regions(estimate, model)
    found: list[dict[str, Any]] = [{'title': 'Poles', 'frame': 0, 'x': [
        _brief(model.poles.real), x], 'y': [_brief(model.poles.imag), y]}]
    std = response_std(model, omega, estimate.covariance)[0]
    longest = float(times[-1])
    step = step_response(model, estimate.covariance, length=longest, count=_POINTS)
    for k, (i, j) in enumerate(pairs):
        gain, phase = response_of(model, omega, i, j)
        name = f'{model.input_names[j]} → {model.output_names[i]}'
        found.append({'title': cell(f'{name}, frequency response'), 'frame': 1 + 2 * k, 'y': [
            _band(gain, np.minimum(2.0 * std[:, i, j], _WIDEST)), _brief(gain), _brief(phase)]})
        late = times - model.delay[j]
        values, s = (np.where(late < 0.0, 0.0, np.interp(late, step.times, v[:, i, j]))
                     for v in (step.values, step.std))
        found.append({'title': cell(f'{name}, unit step'), 'frame': 2 + 2 * k,
                      'y': [_band(values, 2.0 * s), _brief(values)]})
    return found


def _band(values: Array, half: Array) -> list[float | None] | None:
    if not np.isfinite(half).all():
        return None
    return _brief(np.concatenate((values - half, (values + half)[::-1])))


def _regions(estimate: Estimate, model: StateSpace
             ) -> tuple[list[float | None] | None, list[float | None] | None]:
    curves = [region(complex(p), c, 1) for p, c in zip(
        model.poles, estimate.pole_covariance, strict=True) if np.isfinite(c).all()]
    if not curves:
        return None, None
    x, y = (_brief(np.concatenate([np.append(v[::_OUTLINE], np.nan) for v in rows]))
            for rows in ([c.x for c in curves], [c.y for c in curves]))
    return x, y


def _brief(values: Array) -> list[float | None]:
    return numbers(values, _DIGITS)


def _item(item: Item, figures: list[dict[str, Any]]) -> dict[str, Any]:
    verdict = item.estimate.verdict
    return {'title': cell(item.title), 'at': float(f'{item.at:.9g}'),
            'grade': verdict.grade.name, 'reason': printable(verdict.reason),
            'facts': [[name, cell(value)] for name, value in item.facts.items()],
            'figures': figures}


def facts(estimate: Estimate, fits: Mapping[str, str]) -> Mapping[str, str]:
    """Return the numbers of one model, as the tables have them; `fits` are further ones."""
    model = estimate.model or estimate.rejected_model
    if model is None:
        return {'status': estimate.status.name}
    std = estimate.delay_std
    found = {
        'status': estimate.status.name, 'order': str(model.n),
        f'fit{", predicted" * estimate.by_predictions} [%]': fit_words(estimate.fit),
        'held-out fit [%]': fit_words(estimate.held_out_fit), **fits,
        'poles [rad/s]': '; '.join(f'{pole_text(m.pole)} (std {number(m.std, 2)})'
                                    for m in modes_of(estimate)),
        'natural frequency [rad/s], damping': '; '.join(
            f'{plus_minus(m.frequency, m.frequency_std)}, '
            f'{plus_minus(m.damping, m.damping_std, 3)}' for m in modes_of(estimate))}
    if any(model.delay):
        found['dead time [s]'] = '; '.join(
            plus_minus(d, s, 3) for d, s in zip(model.delay, std, strict=True))
    for kind, values in by_kind(model.actuators).items():
        name = 'timeout [s]' if kind == 'timeout' else kind.replace('_', ' ')
        found[name] = '; '.join(number(value, 3) for value in values)
    if known := gains(model, estimate.covariance):
        found['gain' if known.rate.any() else 'DC gain'] = '; '.join(
            gain_text(float(g), float(s), bool(rate)) for g, s, rate in zip(
                known.value.ravel(), known.std.ravel(), known.rate.ravel(), strict=True))
    return found


