# SPDX-License-Identifier: Apache-2.0
"""
Estimates from the raw output samples, where interpolation between these would not do.

A projection needs a signal at all times. What is put between the samples (splines, straight
lines across pauses) is a part of the data then, and wrong by more than the noise where samples
are few for what the outputs do. There the whole estimate is made on the samples themselves:
search, refinement, standard deviation, and the test on unseen data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.quadrature import (
    UNIFORM,
    pauses_between_bursts,
    smooth_values,
    spline_degree,
)
from ctsid_core.likelihood.samples_output_error import (
    MOST_GROWTH,
    InTime,
    errors_in_time,
    refine_in_time,
)
from ctsid_core.linear.least_squares import solve
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import OrderTried
from ctsid_core.model.mode_responses import Stamps, responses, stamps_of
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.search.samples_modes import search_in_time
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal, channel_slices

_PAUSES = 0.3         # of the window in pauses between bursts from which on it is not projected
_NOTICED = 0.01       # distortion of an output, over its motion, that is worth the time
_DISTORTED = 0.1      # of what a model leaves of an output that comes from interpolation
_BELIEVED = 0.7       # of what a model with process noise leaves, that one without may leave
_ENDS = 6             # samples that a trial of interpolation leaves out at either end


@dataclass(frozen=True)
class SamplesSolution:
    """
    A model made of the raw samples, and how it fits.

    Parameters
    ----------
    fit : InTime
    table : tuple of OrderTried
        The criterion by order, if the order was chosen.
    simulated, unseen : ndarray, shape (ny,)
        Fit of the simulation, and how much of the last part of the record the inputs explain to a
        model of the first part (see `prediction_errors.unseen_fit`) [%].
    """

    fit: InTime
    table: tuple[OrderTried, ...]
    simulated: Array
    unseen: Array


def in_bursts(record: Record) -> str:
    """Return why the outputs cannot be interpolated, judged by the stamps; '' if they can."""
    for signal in record.outputs:
        if signal.hold != 'smooth':
            continue
        pauses = pauses_between_bursts(signal, record.start, record.end)
        share = float(np.sum(pauses)) / record.duration
        if share > _PAUSES:
            return (f'samples of {", ".join(signal.names) or "the outputs"} come in bursts, and '
                    f'{100 * share:.0f} % of the window lies in the pauses')
    return ''


def distorted(record: Record, model: StateSpace, process_noise: bool) -> tuple[str, Array]:
    """
    Return why the outputs should not have been interpolated, judged by their model.

    Parameters
    ----------
    record : Record
    model : StateSpace
        Of a projection of the interpolated outputs.
    process_noise : bool
        Whether the model was found with process noise.

    Returns
    -------
    why : str
        '' if interpolation does no harm.
    most : ndarray, shape (ny,)
        Of what an estimate from the raw samples may leave of the outputs' power to be accepted: a
        process noise that only seemed to be one goes with the interpolation.

    Notes
    -----
    The model's own outputs, known at all times, are interpolated from their values at the stamps,
    and compared with themselves halfway between the stamps.
    """
    most = np.full(model.ny, np.inf)
    if all(s.hold != 'smooth' or _dense(s, record, model) for s in record.outputs):
        return '', most
    seen = simulation(model, record)
    explodes = np.max(model.poles.real) * record.duration > MOST_GROWTH
    if explodes or not np.isfinite(seen.y_hat).all():
        return '', most
    left = np.nanmean((seen.y - seen.y_hat) ** 2, axis=0)
    power = np.zeros(model.ny)
    for signal, own in zip(record.outputs, channel_slices(record.outputs), strict=True):
        if signal.hold == 'smooth' and not _dense(signal, record, model):
            power[own] = _distortion(record, model, signal, own, seen.times, seen.x0)
    size = np.sqrt(power / (np.nanvar(seen.y, axis=0) + 1e-300))
    worst = int(np.argmax(size))
    if size[worst] < _NOTICED or not (power > _DISTORTED * left).any():
        return '', most
    return (f'between the samples of {record.output_names[worst]} interpolation distorts by '
            f'{100 * size[worst]:.2g} % what the model does',
            _BELIEVED * left if process_noise else left)


def _dense(signal: Signal, record: Record, model: StateSpace) -> bool:
    """Return whether a signal is sampled densely for the poles of a model."""
    t = signal.time[(signal.time >= record.start) & (signal.time <= record.end)]
    step = np.diff(t)
    if len(step) < 4 * _ENDS:
        return True
    fastest = float(np.max(np.abs(model.poles.imag), initial=0.0))
    fourth = float(np.sum(step ** 5) / np.sum(step))            # mean over time of h^4
    return fastest ** 4 * fourth < 120.0 * _NOTICED ** 2        # of a sine on straight lines


def _distortion(record: Record, model: StateSpace, signal: Signal, channels: slice, times: Array,
                x0: Array) -> Array:
    """Return the mean square of what interpolation adds to the model's outputs, (channels,)."""
    t = signal.time[(signal.time >= record.start) & (signal.time <= record.end)]
    middle = 0.5 * (t[1:] + t[:-1])
    at = np.unique(np.concatenate((times[:1], t, middle)))
    y = model.simulate(record.inputs, at, x0)[:, channels]
    own, clean = y[np.searchsorted(at, t)].T, y[np.searchsorted(at, middle)].T
    measured = signal.values[np.isin(signal.time, t)].T
    step = np.diff(t)
    # The trapezoid rule of uniform stamps is that of a band-limited signal.
    degree = 5 if np.ptp(step) <= UNIFORM * step.mean() else spline_degree(t, measured)
    between = smooth_values(t, own, middle, degree)
    inner = slice(_ENDS, len(middle) - _ENDS)
    step = step[inner]
    # Between two samples it is nearly a parabola: its mean square is 8/15 of its middle's.
    found: Array = 8.0 / 15.0 * (between - clean)[:, inner] ** 2 @ step / step.sum()
    return found


def solve_samples(record: Record, delay: tuple[float, ...], settings: Settings,
                  start: Matrices | None = None) -> SamplesSolution | None:
    """
    Estimate on the raw samples; None if no model can be made of them.

    Parameters
    ----------
    record : Record
    delay : tuple of float, length nu
        Dead time of each input [s].
    settings : Settings
        Of which order, max_order, feedthrough, trim and held_out matter here.
    start : Matrices, optional
        Where to start if there are too many samples for a search.
    """
    found = search_in_time(record, delay, settings)
    if found is not None:
        return SamplesSolution(found.fit, found.table, *_fits(record, delay, settings, found.fit))
    return None if start is None else _from(record, delay, settings, start, ())


def refit_samples(record: Record, delay: tuple[float, ...], settings: Settings,
                  solution: SamplesSolution) -> SamplesSolution | None:
    """Return the same for other samples (without corrupt ones), from the model that was found."""
    return _from(record, delay, settings, solution.fit.matrices, solution.table)


def _from(record: Record, delay: tuple[float, ...], settings: Settings, start: Matrices,
          table: tuple[OrderTried, ...]) -> SamplesSolution | None:
    fit = refine_in_time(record, start, delay, feedthrough=settings.feedthrough,
                         limit=1.0 / record.duration)
    return None if fit is None else \
        SamplesSolution(fit, table, *_fits(record, delay, settings, fit))


def _fits(record: Record, delay: tuple[float, ...], settings: Settings,
          fit: InTime) -> tuple[Array, Array]:
    stamps = stamps_of(record, delay, settings.trim)
    errors = errors_in_time(stamps, fit.matrices)
    simulated = np.concatenate([
        _nrmse(e, y - y.mean(axis=1, keepdims=True))
        for e, y in zip(errors or stamps.y, stamps.y, strict=True)])
    return simulated, _unseen(record, delay, settings, fit)


def _unseen(record: Record, delay: tuple[float, ...], settings: Settings, fit: InTime) -> Array:
    nothing = np.full(record.ny, np.nan)
    if settings.held_out == 0.0:
        return nothing
    split = record.end - settings.held_out * record.duration
    lead = max(delay, default=0.0)
    first = refine_in_time(record.between(record.start, split, lead=lead), fit.matrices, delay,
                           feedthrough=settings.feedthrough, limit=1.0 / record.duration)
    last = stamps_of(record.between(split, record.end, lead=lead), delay, settings.trim)
    if first is None or min(last.counts) < len(fit.matrices.A) + 2:
        return nothing
    m = replace(first.matrices, tail=np.zeros((len(first.matrices.A), 1)))
    errors, found = errors_in_time(last, m), responses(last, m)
    if errors is None or found is None:
        return nothing
    # As in a projection: the state at the start and a level are no merit of the inputs.
    free = found.modes.right[:, :, np.newaxis] * found.s[:, last.nu]
    states = np.concatenate((free.real, free.imag), axis=1).swapaxes(0, 1)  # (2 m, n, M)
    size = np.sqrt(np.concatenate([np.var(y, axis=1) for y in last.y]) + 1e-300)
    error, moving = _stacked(last, errors, size), _stacked(last, last.y, size)
    modes = _stacked_rows(last, m.C @ states, size)
    levels = np.repeat(np.eye(record.ny), last.counts.astype(int), axis=1)
    left = error - solve(modes, error[np.newaxis], 1e-10)[0][0] @ modes
    both = np.vstack((modes, levels))
    quiet = moving - solve(both, moving[np.newaxis], 1e-10)[0][0] @ both
    bounds = np.cumsum(last.counts.astype(int))[:-1]
    return np.array([_nrmse(e[np.newaxis], y[np.newaxis])[0] for e, y in
                     zip(np.split(left, bounds), np.split(quiet, bounds), strict=True)])


def _stacked(stamps: Stamps, parts: tuple[Array, ...], size: Array) -> Array:
    rows = np.concatenate([row for part in parts for row in part])
    return rows / np.repeat(size, stamps.counts.astype(int))


def _stacked_rows(stamps: Stamps, rows: Array, size: Array) -> Array:
    """Put outputs (k, ny, M) in rows (k, sum of N) at their own stamps."""
    return np.stack([_stacked(stamps, tuple(
        row[channels][:, places] for channels, places in stamps.streams), size) for row in rows])


def _nrmse(error: Array, moving: Array) -> Array:
    size = np.maximum(np.linalg.norm(moving, axis=1), 1e-300)
    fit: Array = 100.0 * (1.0 - np.linalg.norm(error, axis=1) / size)
    return fit
