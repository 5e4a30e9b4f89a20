# SPDX-License-Identifier: Apache-2.0
"""The one entry: check, project, regress, refine, judge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_continuous_are

from ctsid_core.bandwidth import choose_nmax
from ctsid_core.bases.base import Projection, as_real
from ctsid_core.bases.hermite import project_record
from ctsid_core.bases.quadrature import gap_time
from ctsid_core.estimate import Choice, Estimate, Status
from ctsid_core.prediction_errors import simulate_lines
from ctsid_core.order import Candidate, Pair, Search, choose_order
from ctsid_core.pbsid import Matrices, solve
from ctsid_core.refine import (
    pole_deviation,
    realise_poles,
    refine_innovation,
    refine_output_error,
)
from ctsid_core.settings import Settings
from ctsid_core.signals import Array, Record, Signal
from ctsid_core.statespace import StateSpace

_CONSTANT = 1e-9        # a channel whose range is below this part of its size does not move
_FEWEST = 20            # samples of an output
_GAP_SHARE = 0.3        # of the window that may lie in gaps
_HELD_OUT = 0.3         # last part of the window on which the model is tested
_EXPLAINED = 20.0       # fit [%] below which outputs count as not explained
_CONDITION = 1e14


def identify(record: Record, settings: Settings | None = None) -> Estimate:
    """
    Identify a continuous-time state-space model from one record.

    Parameters
    ----------
    record : Record
        Inputs and outputs, each with its own stamps.
    settings : Settings, optional
        What is not to be found from the data; by default everything is.

    Returns
    -------
    Estimate
        With a model if its status is `Status.OK`; else its status says what to do.

    Raises
    ------
    SettingsError
        If `settings.delay` does not fit the number of inputs.

    Notes
    -----
    Pure: the same record and settings give the same bits.

    References
    ----------
    [HD] section 4.
    """
    settings = settings or Settings()
    window = {'start_ns': record.epoch_ns + round(record.start * 1e9),
              'end_ns': record.epoch_ns + round(record.end * 1e9)}
    checked = _check(record, settings)
    if isinstance(checked, Status):
        return Estimate(status=checked, settings=settings, **window)
    found = _estimate(checked, settings)
    if isinstance(found, Status):
        return Estimate(status=found, settings=settings, notes=checked.notes, **window)
    return _judge(checked, found, window)


@dataclass(frozen=True)
class _Checked:
    """A record with the channels that move, and where they belong among all channels."""

    record: Record
    all_of: Record
    moving_u: tuple[int, ...]
    moving_y: tuple[int, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Found:
    """A model of the moving channels and how it was found."""

    settings: Settings
    projection: Projection
    matrices: Matrices
    best: Candidate
    process_noise: bool
    choices: tuple[Choice, ...]


def _check(record: Record, settings: Settings) -> _Checked | Status:
    delays = settings.delays(record.nu)
    known = max((s.time[0] + d for s, d in zip(record.inputs, _delay_per_signal(record, delays),
                                               strict=True)), default=record.start)
    notes = []
    if known > record.start:
        notes.append(f'the first {known - record.start:.3g} s were left out: an input has no '
                     'known value there, because of its dead time')
    if known >= record.end:
        return Status.TOO_SHORT
    record = replace(record, start=max(record.start, float(known)))
    inputs, moving_u, note_u = _moving(record.inputs, record, record.input_names, 'input')
    outputs, moving_y, note_y = _moving(record.outputs, record, record.output_names, 'output')
    if not outputs:
        return Status.NO_RESPONSE
    if not inputs:
        return Status.NO_EXCITATION
    if min(_count(s, record) for s in outputs) < _FEWEST:
        return Status.TOO_SHORT
    for signal in (*inputs, *outputs):
        share = gap_time(signal, record.start, record.end) / record.duration
        if share > _GAP_SHARE:
            return Status.GAPS
        if share > 0.0:
            notes.append(f'{100 * share:.2g} % of the window lies in gaps of '
                         f'{", ".join(signal.names) or "a signal"}: bridged by straight lines')
    moving = replace(record, inputs=tuple(inputs), outputs=tuple(outputs))
    return _Checked(moving, record, moving_u, moving_y, (*notes, *note_u, *note_y))


def _delay_per_signal(record: Record, delays: tuple[float, ...]) -> list[float]:
    """Return the largest dead time among the channels of each input signal."""
    ends = np.cumsum([s.width for s in record.inputs])
    return [max(delays[end - s.width:end]) for s, end in zip(record.inputs, ends, strict=True)]


def _count(signal: Signal, record: Record) -> int:
    return int(np.count_nonzero((signal.time >= record.start) & (signal.time <= record.end)))


def _moving(signals: tuple[Signal, ...], record: Record, names: tuple[str, ...], kind: str,
            ) -> tuple[list[Signal], tuple[int, ...], list[str]]:
    """Return the signals without channels that are constant, which were kept, and notes."""
    kept_signals, kept, notes, first = [], [], [], 0
    for signal in signals:
        inside = signal.between(record.start, record.end, 1).values
        size = np.abs(inside).max(axis=0, initial=0.0)
        moves = np.ptp(inside, axis=0) > _CONSTANT * size if len(inside) else size > 0.0
        for j in np.flatnonzero(~moves):
            notes.append(f'{kind} {names[first + j]} is constant over the window; the model '
                         'leaves it out')
        kept += [first + int(j) for j in np.flatnonzero(moves)]
        first += signal.width
        if moves.all():
            kept_signals.append(signal)
        elif moves.any():
            kept_signals.append(replace(
                signal, values=signal.values[:, moves],
                names=tuple(np.array(signal.names)[moves]) if signal.names else (),
                units=tuple(np.array(signal.units)[moves]) if signal.units else ()))
    return kept_signals, tuple(kept), notes


def _estimate(checked: _Checked, settings: Settings) -> _Found | Status:
    choices = []
    delays = settings.delays(checked.all_of.nu)
    used = settings.replace(delay=tuple(delays[j] for j in checked.moving_u))
    if not used.nmax:
        nmax, why = choose_nmax(checked.record)
        used = used.replace(nmax=nmax)
        choices.append(Choice('hermite.nmax', nmax, why))
    projection = project_record(checked.record, used, used.nmax)
    search = Search(projection, used)
    if not used.order:
        trials = search.orders()
        if not trials:
            return Status.TOO_SHORT
        chosen, noisy = choose_order(trials)
        used = used.replace(order=chosen.order)
        values = [t.innovation if noisy else t.simulation for t in trials]
        table = ', '.join(f'{t.order}: {v - min(values):.0f}'
                          for t, v in zip(trials, values, strict=True))
        choices.append(Choice('order', chosen.order, "Schwarz's criterion, above its smallest "
                              f'value, by order: {table}'))
    pair = search.pair(used.order)
    if pair is None:
        return Status.TOO_SHORT
    tried, best = len(search.tunings(used.order)), pair.best
    used = used.replace(beta=best.tuning.beta, gamma=best.tuning.gamma,
                        past=best.tuning.past, future=best.tuning.future)
    if tried > 1:
        choices.append(Choice('pbsid', f'beta {best.tuning.beta:.3g}, p {best.tuning.past}',
                              f'the most likely of {tried} subspace models'))
    matrices, process_noise = _refined(search, pair, used)
    return _Found(used.replace(delay=settings.delay), projection, matrices, best, process_noise,
                  tuple(choices))


def _refined(search: Search, pair: Pair, settings: Settings) -> tuple[Matrices, bool]:
    """Return the model at the maximum of the likelihood, and whether it has process noise."""
    if not settings.refine:
        return pair.best.matrices, pair.process_noise
    projection, feed, limit = search.projection, settings.feedthrough, pair.limit
    first = pair.simulating
    top = search.output_error.fit(first.simulated.poles, 12, limit)
    starts = [first.matrices]
    if len(set(np.round(top.poles, 12))) == len(top.poles):
        starts.append(realise_poles(projection, top.poles, feed))
    model, cost = min((refine_output_error(projection, start, feed, limit) for start in starts),
                      key=lambda found: found[1])
    weight = np.log(2.0 * len(projection.s) * len(projection.y))
    if pair.process_noise:
        noisy, noisy_cost = refine_innovation(projection, pair.predicting.matrices, feed,
                                              limit=limit)
        if noisy_cost + model.K.size * weight < cost:
            return noisy, True
    start = replace(model, K=_gain(projection, model))
    noisy, noisy_cost = refine_innovation(projection, start, feed, plant=False)
    return noisy if noisy_cost + model.K.size * weight < cost else start, False


def _gain(projection: Projection, m: Matrices) -> Array:
    """
    Return the stationary Kalman gain where there is no process noise.

    Zero for a stable plant. An unstable one needs a predictor: the gain that mirrors its
    unstable poles, the limit of small process noise.
    """
    if np.linalg.eigvals(m.A).real.max() < 0.0:
        return np.zeros_like(m.K)
    error = as_real(projection.y - simulate_lines(projection, m))
    R = np.diag(np.mean(error ** 2, axis=1) + 1e-300)
    state = np.linalg.norm(m.A) * np.eye(len(m.A)) * 1e-9 * np.trace(R) / np.trace(m.C @ m.C.T)
    try:
        P = solve_continuous_are(m.A.T, m.C.T, state, R)
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros_like(m.K)
    gain: Array = np.linalg.solve(R, m.C @ P).T
    return gain


def line_fit(projection: Projection, m: Matrices, *, refit_tail: bool = False) -> Array:
    """
    Return the simulation fit (NRMSE) of each output, in the band of the projection [%].

    Parameters
    ----------
    projection : Projection
    m : Matrices
    refit_tail : bool
        Estimate the state at the ends of the window anew (for data the model has not seen).
    """
    y = as_real(projection.y)
    if refit_tail and projection.tail.size:
        still = replace(m, tail=np.zeros_like(m.tail))
        error = y - as_real(simulate_lines(projection, still))
        modes = np.concatenate([as_real(_free(projection, m, i)) for i in range(len(m.A))])
        weights, _ = solve(modes, error.reshape(1, -1), 1e-10)
        error = error - (weights @ modes).reshape(y.shape)
    else:
        error = y - as_real(simulate_lines(projection, m))
    ones = as_real(projection.ones)
    if len(ones):
        y = y - (y @ ones.T) / np.sum(ones ** 2) * ones
    fit: Array = 100.0 * (1.0 - np.linalg.norm(error, axis=1) / np.linalg.norm(y, axis=1))
    return fit


def _free(projection: Projection, m: Matrices, i: int) -> Array:
    """Return the outputs' lines if only state i is driven, by the tail: one row."""
    start = np.zeros_like(m.tail)
    start[i] = 1.0
    quiet = replace(m, tail=start, B=np.zeros_like(m.B), D=np.zeros_like(m.D),
                    x_trim=np.zeros_like(m.x_trim), y_trim=np.zeros_like(m.y_trim))
    return simulate_lines(projection, quiet).reshape(1, -1)


def _held_out(checked: _Checked, found: _Found) -> Array:
    """Return the fit on the last part of the window of a model of the first part [%]."""
    record, settings = checked.record, found.settings
    used = settings.replace(delay=tuple(settings.delays(checked.all_of.nu)[j]
                                        for j in checked.moving_u))
    split = record.end - _HELD_OUT * record.duration
    lead = max(used.delays(record.nu), default=0.0)
    first = project_record(record.between(record.start, split, lead=lead), used,
                           max(int(used.nmax * (1.0 - _HELD_OUT)), 8))
    last = project_record(record.between(split, record.end, lead=lead), used,
                          max(int(used.nmax * _HELD_OUT), 8))
    search = Search(first, used)
    pair = search.pair(used.order)
    if pair is None:
        return np.full(record.ny, np.nan)
    return line_fit(last, _refined(search, pair, used)[0], refit_tail=True)


def _judge(checked: _Checked, found: _Found, window: dict[str, int]) -> Estimate:
    model = _to_statespace(checked, found)
    fit = line_fit(found.projection, found.matrices)
    held_out = _held_out(checked, found)
    deviation = pole_deviation(found.projection, found.matrices, found.settings.feedthrough)
    poles = np.linalg.eigvals(found.matrices.A)
    status = _status(found, fit, held_out)
    statistics = {'process_noise': float(found.process_noise)}
    return Estimate(
        status=status, settings=found.settings, model=model if status is Status.OK else None,
        rejected_model=None if status is Status.OK else model,
        pole_std=np.array([deviation[np.argmin(np.abs(poles - p))] for p in model.poles]),
        fit=_spread(fit, checked.moving_y, checked.all_of.ny),
        held_out_fit=_spread(held_out, checked.moving_y, checked.all_of.ny),
        singular_values=found.best.singular_values, condition=found.best.condition,
        choices=found.choices, notes=checked.notes, statistics=statistics, **window)


def _status(found: _Found, fit: Array, held_out: Array) -> Status:
    if not np.isfinite(fit).all():
        return Status.UNRELIABLE
    best = np.nanmax(held_out) if np.isfinite(held_out).any() else fit.max()
    return Status.OK if min(best, fit.max()) >= _EXPLAINED else Status.UNEXPLAINED


def _spread(values: Array, places: tuple[int, ...], count: int) -> Array:
    """Put the values of moving channels among all channels; NaN for the constant ones."""
    out = np.full(count, np.nan)
    out[list(places)] = values
    return out


def _to_statespace(checked: _Checked, found: _Found) -> StateSpace:
    """Return the model of all channels: constant ones have zero rows and columns."""
    m, whole = found.matrices, checked.all_of
    n, nu, ny = len(m.A), whole.nu, whole.ny
    u, y = list(checked.moving_u), list(checked.moving_y)
    B, C, D, K = np.zeros((n, nu)), np.zeros((ny, n)), np.zeros((ny, nu)), np.zeros((n, ny))
    B[:, u], C[y], D[np.ix_(y, u)], K[:, y] = m.B, m.C, m.D, m.K
    level = np.concatenate([s.values.mean(axis=0) for s in whole.outputs])
    level[y] = m.y_trim[:, 0] if m.y_trim.size else 0.0
    error = as_real(found.projection.y - simulate_lines(found.projection, m))
    noise = np.zeros((ny, ny))
    noise[np.ix_(y, y)] = error @ error.T / error.shape[1]
    return StateSpace(
        A=m.A, B=B, C=C, D=D, K=K, delay=found.settings.delays(nu),
        x_trim=m.x_trim[:, 0] if m.x_trim.size else np.zeros(n), y_trim=level, noise=noise,
        input_names=whole.input_names, output_names=whole.output_names,
        input_units=whole.input_units, output_units=whole.output_units)


