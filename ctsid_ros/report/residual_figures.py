# SPDX-License-Identifier: Apache-2.0
"""What is left of the outputs, drawn: its correlation, and fits by horizon."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.simulation import input_polynomials
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import LAGS, Validation, cell, predictions
from ctsid_core.signals.actuators import acting
from ctsid_core.signals.record import Record
from ctsid_ros.report.document import Figure
from ctsid_ros.report.drawing import Axes, Curve, Drawing, Span

_NINETY_NINE = 2.576    # standard deviations that hold 99 % of a normal distribution
_FEWEST = 50            # residuals
_CELLS = 60             # lags of an input
HORIZONS = (1, 2, 5, 10, 20, 50, 100, 200)
_MOST = 20_000          # samples that are predicted
_MOST_OUTPUTS = 8


def residual_figures(model: StateSpace, record: Record, found: Validation) -> list[Figure]:
    """
    Draw the correlation of the residuals with themselves and with the inputs.

    Parameters
    ----------
    model : StateSpace
    record : Record
    found : Validation
        Its simulation, with refitted trim, or prediction, as in `residual_tests`.
    """
    figures = []
    for i in range(min(model.ny, _MOST_OUTPUTS)):
        e = found.y[:, i] - found.y_hat[:, i]
        good = np.isfinite(e)
        if good.sum() < _FEWEST or not np.ptp(e[good]) > 0:
            continue
        own = _itself(e[good])
        panels = [own, *_inputs(model, record, found.times[good], e[good])]
        figures.append(Figure(Drawing(tuple(panels[:1])), '', model.output_names[i]))
        figures += [Figure(Drawing((panel,), link='lag'), '',
                           f'{model.input_names[j]} → {model.output_names[i]}')
                    for j, panel in enumerate(panels[1:])]
    return figures


def _itself(e: Array) -> Axes:
    e = e - e.mean()
    r = np.array([e[:-k] @ e[k:] for k in range(1, LAGS + 1)]) / float(e @ e)
    bound = _NINETY_NINE / np.sqrt(len(e))
    return Axes([Curve(np.arange(1.0, LAGS + 1), r, '', 1, 'stems', width=3.0)],
                'correlation of the residuals', 'lag [samples]', levels=(-bound, bound),
                y_limits=(min(-0.3, 1.2 * float(np.min(r))), 1.05), height=130.0)


def _inputs(model: StateSpace, record: Record, times: Array, e: Array) -> list[Axes]:
    """Return the correlation of residuals with each input after its dead time, in cells."""
    step = cell(times)
    cells = np.rint((times - times[0]) / step).astype(int)
    count = int(cells[-1]) + 1
    binned = np.bincount(cells, e - e.mean(), count)
    u = input_polynomials(acting(record.inputs, model.actuators), model.delay,
                          times[0] + step * np.arange(count))[0]
    lags = min(_CELLS, count // 4)
    axes = []
    for row in (u - u.mean(axis=0)).T:
        size = float(np.linalg.norm(row) * np.linalg.norm(binned))
        if not size > 0.0:
            continue
        r = correlation(row, binned, count)
        # Bartlett: both are coloured, and correlations of neighbouring lags alike.
        own = np.prod([correlation(x, x, count)[:count // 4] for x in (row, binned)], axis=0)
        bound = _NINETY_NINE * np.sqrt(max(2.0 * own.sum() - own[0], own[0]) / count) / size
        k = np.arange(-lags, lags + 1)
        axes.append(Axes([Curve(step * k.astype(float), r[k] / size, '', 1)],
                         'correlation with the input before', 'lag [s]', levels=(-bound, bound),
                         spans=[Span(0.0, lags * step, 0, 'past inputs')], height=130.0,
                         y_limits=(
                             min(-0.3, -1.3 * bound, 1.2 * float(np.min(r[k])) / size),
                             max(0.3, 1.3 * bound, 1.2 * float(np.max(r[k])) / size))))
    return axes


def correlation(a: Array, b: Array, count: int) -> Array:
    """Return sum_t a(t) b(t + k), circular in k, with room for what would meet at the ends."""
    size = 1 << (2 * count - 1).bit_length()
    found: Array = np.fft.irfft(np.fft.rfft(a, size).conj() * np.fft.rfft(b, size), size)
    return found


def horizon_fits(model: StateSpace, record: Record) -> dict[float, Array]:
    """Return the fit of predictions by how far they look ahead [s], of the first samples."""
    periods = [s.period for s in record.outputs]
    count = min(len(s.time) for s in record.outputs)
    if count > _MOST:
        end = record.start + _MOST * min(periods)
        lead = max(model.delay, default=0.0)
        record, count = record.between(record.start, end, lead=lead), _MOST
    found = predictions(model, record, [k for k in HORIZONS if k < count // 4])
    return {k * max(periods): one.fit for k, one in found.items()}


def horizon_figure(model: StateSpace, fits: Mapping[float, Array], simulated: Array) -> Figure:
    """Draw the fit of predictions by horizon, above that of the simulation."""
    ahead = np.array(list(fits))
    rows = np.array(list(fits.values()))
    curves = [Curve(ahead, rows[:, i], f'{name}, predicted', 1 + i % 6, 'both')
              for i, name in enumerate(model.output_names)]
    curves += [Curve(ahead[[0, -1]], np.repeat(simulated[i], 2), f'{name}, simulated', 1 + i % 6,
                     'dashed') for i, name in enumerate(model.output_names)]
    known = np.concatenate([rows.ravel(), simulated])
    known = known[np.isfinite(known)]
    low = max(float(known.min(initial=0.0)), -20.0) if len(known) and known.min() < 40.0 else \
        float(known.min(initial=100.0)) - 3.0
    least = float(known.min(initial=low))
    beyond = f' The least fit, {least:.0f} %, is below the figure.' if least < low - 2.0 else ''
    return Figure(Drawing((Axes(curves, 'fit [%]', 'looking ahead [s]', x_log=True,
                                y_limits=(low - 2.0, 101.0), height=200.0),)),
                  'Predicted: from the outputs up to so long before, and all inputs. Simulated: '
                  f'from the inputs alone.{beyond}', 'Fit by horizon')
