# SPDX-License-Identifier: Apache-2.0
"""
Validation of a model: simulation, prediction, and tests of the residuals.

Everything here compares at the outputs' own stamps; nothing is resampled. The tests of whiteness,
and of independence of past inputs, hold their level at any stamps. P-values are uniform between 0
and 1 where there is nothing left to explain; a small one (below 0.01, say) speaks against the
model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from ctsid_core.errors import DataError
from ctsid_core.linear.matrix_functions import exponentials
from ctsid_core.linear.types import Array
from ctsid_core.model.predictor import Stream, filter_states, predictor_gain, spread, start_rows
from ctsid_core.model.simulation import free_response, input_polynomials, respond
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.actuators import acting, settled
from ctsid_core.signals.gaps import between_pauses
from ctsid_core.signals.record import Record, placed

LAGS = 20
FEWEST = 50    # samples
_CELLS = 10.0  # for each residual, at most


@dataclass(frozen=True, kw_only=True)
class Validation:
    """Measured and computed outputs, and how well they agree."""

    times: Array  # (M,): merged stamps of all outputs within the record [s]
    y: Array      # (M, ny): measured; NaN where an output has no sample at that stamp
    # (M, ny): computed. Of a prediction: NaN where an output has no sample, or cannot be predicted
    # yet
    y_hat: Array
    fit: Array    # (ny,): NRMSE fit of each output [%], see `fit`
    vaf: Array    # (ny,): variance accounted for, of each output [%], see `vaf`
    x0: Array     # (n,): state at `times[0]`
    notes: tuple[str, ...] = ()  # what else the reader should know
    offset: Array | float = 0.0  # (ny,): what was added to the trim of the outputs


def fit(y: ArrayLike, y_hat: ArrayLike) -> Array:
    """
    Return 100 (1 - |y - y_hat| / |y - mean y|) per output [%]: the NRMSE fit, (ny,).

    100: perfect; 0: no better than the mean of y; negative: worse. Rows of y and y_hat, (M, ny),
    do not count where either is NaN. NaN for a constant output or fewer than two rows, -inf if
    y_hat is infinite. Raises `DataError` if the shapes differ.
    """
    norm = np.linalg.norm
    return _compared(y, y_hat, lambda a, b: (norm(a - b), norm(a - a.mean())))


def vaf(y: ArrayLike, y_hat: ArrayLike) -> Array:
    """
    Return 100 (1 - var(y - y_hat) / var(y)) per output [%]: variance accounted for.

    Unlike `fit` it forgives a constant offset. Parameters, NaN and errors: as for `fit`.
    """
    return _compared(y, y_hat, lambda a, b: (
        (a - b).var() if np.isfinite(b).all() else np.inf, a.var()))


def _compared(y: ArrayLike, y_hat: ArrayLike, sizes: Callable[[Array, Array], tuple[Any, Any]]
              ) -> Array:
    """Return 100 (1 - size of the error / size of the motion) of each output [%]."""
    a, b = np.asarray(y, dtype=float), np.asarray(y_hat, dtype=float)
    if a.shape != b.shape or a.ndim != 2:
        raise DataError(f'`y` has shape {a.shape} and `y_hat` {b.shape}; wanted are two of the '
                        'same shape (M, ny)')
    found = np.full(a.shape[1], np.nan)
    for i, known in enumerate(~(np.isnan(a) | np.isnan(b)).T):
        with np.errstate(over='ignore'):  # a diverged simulation
            error, motion = sizes(a[known, i], b[known, i]) if known.sum() > 1 else (0.0, 0.0)
        if motion > 0 and np.ptp(a[known, i]) > 0:     # a mean is rounded
            found[i] = 100 * (1 - error / motion)
    return found


def _samples(model: StateSpace, record: Record) -> tuple[Array, Array, list[Stream]]:
    """Return the merged stamps of all outputs, their samples there, and where each has its own."""
    # From when what acts has been recorded.
    model.check_width('input', record.nu, model.nu)
    model.check_width('output', record.ny, model.ny)
    start = max(record.start, record.known_from(model.delay))
    inside = [s.rows(start, record.end) for s in record.outputs]
    stamps = [s.time[rows] for s, rows in zip(record.outputs, inside, strict=True)]
    times = np.unique(np.concatenate(stamps))
    y, streams = np.full((len(times), record.ny), np.nan), []
    for (signal, places), own, rows in zip(placed(record.outputs), stamps, inside, strict=True):
        streams.append(Stream(places, np.searchsorted(times, own)))
        y[streams[-1].rows, places] = signal.values[rows]
    return times, y, streams


def _respond(model: StateSpace, record: Record, times: Array) -> tuple[Array, Array]:
    # Outputs of a bounded solution of the model, and its state at times[0]
    x, u = respond(model.A, model.B, model.x_trim, acting(record.inputs, model.actuators),
                   model.delay, times, None)
    with np.errstate(over='ignore', invalid='ignore'):
        y = x @ model.C.T + u @ model.D.T + model.y_trim
    return np.where(np.isnan(y), np.inf, y), x[0] if len(x) else np.zeros(model.n)


def simulation(model: StateSpace, record: Record, *,
               trim: Literal['model', 'refit'] = 'model') -> Validation:
    """
    Compare a record with the simulation of a model from its inputs and the best initial state.

    That is the least-squares one, outputs weighted by their spread. It is found together with a
    bounded solution: the fit of an unstable model is right even where simulating onward from `x0`
    would lose all digits. For an unbiased test, take another record than for the identification.

    After a pause of all channels, or of a measured input, state and offsets begin anew; results
    have the state at the start, and the offsets of the part with most samples. It begins where it
    is known where ramps and gears of the actuators are.

    Offsets of the outputs (`trim`) are the model's, or fitted to this record on top of them:
    'refit', if the robot may have been trimmed otherwise. Raises `DataError` if the record's
    channels do not fit the model, or an option is unknown.
    """
    if trim not in ('model', 'refit'):
        raise DataError(f'`trim` is {trim!r}; choose model or refit')
    model.check_width('input', record.nu, model.nu)
    parts = [_simulation(model, part, trim)
             for part in between_pauses(settled(record, model.actuators))]
    times, y, y_hat = (np.concatenate([getattr(part, name) for part in parts])
                       for name in ('times', 'y', 'y_hat'))
    first = next((part for part in parts if len(part.times)), parts[0])
    return Validation(times=times, y=y, y_hat=y_hat, x0=first.x0, fit=fit(y, y_hat),
                      vaf=vaf(y, y_hat), offset=max(parts, key=lambda p: len(p.times)).offset)


def _simulation(model: StateSpace, record: Record, trim: str) -> Validation:
    """Simulate a record without pauses, or a part between them."""
    times, y, _ = _samples(model, record)
    y_hat, x0 = _respond(model, record, times)
    offset: Array | float = 0.0
    with np.errstate(over='ignore', invalid='ignore'):  # poles that explode and coincide
        columns, states = free_response(model.A, model.C, times)
    if trim == 'refit':
        offsets = np.broadcast_to(np.eye(model.ny), (len(times), model.ny, model.ny))
        columns = np.concatenate((columns, offsets), axis=2)
        states = np.hstack((states, np.zeros((model.n, model.ny))))
    if len(times):
        found = _least_squares(columns, y - y_hat, spread(y))
        with np.errstate(over='ignore', invalid='ignore'):
            y_hat, x0 = y_hat + columns @ found, x0 + states @ found
        offset = found[-model.ny:] if trim == 'refit' else 0.0
        y_hat = np.where(np.isnan(y_hat), np.inf, y_hat)
    return Validation(times=times, y=y, y_hat=y_hat, fit=fit(y, y_hat), vaf=vaf(y, y_hat), x0=x0,
                      offset=offset)


def _least_squares(columns: Array, wanted: Array, scale: Array) -> Array:
    # columns (M, ny, k) on wanted (M, ny), where all of that is known and finite
    with np.errstate(over='ignore'):  # beyond 1e154 a column is left out: size inf
        matrix, right = columns / scale[:, np.newaxis], wanted / scale
        rows = np.isfinite(right) & np.isfinite(matrix).all(axis=2)
        matrix, right = matrix[rows], right[rows]
        size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1
    return np.linalg.lstsq(matrix / size, right, rcond=1e-12)[0] / size


def prediction(model: StateSpace, record: Record, horizon_steps: int) -> Validation:
    """
    Compare a record with the predictions of a model a number of samples ahead.

    The sample j of an output is predicted from the samples of all outputs up to the stamp of
    its own sample j - `horizon_steps`, and from the inputs, which are taken as known throughout.
    In between the model runs freely. The first tenth of the record starts the filter: nothing is
    predicted from within it, `y_hat` is NaN, and `fit` does not count it. The initial state is
    fitted there, and anew with each sample as long as the filter remembers it. Raises `DataError`
    if the record's channels do not fit the model, or the horizon is not a positive integer.

    The model's K is the gain of the filter (`ctsid_core.model.predictor`: stamps that differ).
    With K = 0 and a stable model the filter trusts the model: all horizons are simulations from
    the samples so far. If A - K C is not stable, a Kalman filter takes over and a note says so.
    """
    return predictions(model, record, (horizon_steps,))[horizon_steps]


def predictions(model: StateSpace, record: Record,
                horizons: Sequence[int]) -> dict[int, Validation]:
    """Return the predictions by several horizons, of one filter; all else as for `prediction`."""
    for steps in horizons:
        if not isinstance(steps, int | np.integer) or steps < 1:
            raise DataError(f'`horizon_steps` is {steps!r}; wanted is a whole number of samples, '
                            'at least 1')
    times, y, streams = _samples(model, record)
    y_known, p0 = _respond(model, record, times)
    noise = np.diag(spread(y[:start_rows(times, model.n)]) ** 2)
    if model.noise is not None and min(np.linalg.eigvalsh(model.noise), default=0) > 0:
        noise = model.noise
    K, note = predictor_gain(model, noise, record.duration)
    found, x0 = {}, p0
    if K is None:
        streams = []
    else:
        with np.errstate(over='ignore', invalid='ignore'):      # of a filter that explodes
            xi, xi_0, started = filter_states(model, K, noise, times, y - y_known, streams)
        x0 = p0 + xi_0
    for steps in horizons:
        y_hat = np.full_like(y, np.nan)
        for stream in streams:
            goal, origin = stream.rows[steps:], stream.rows[:-steps]
            goal, origin = goal[origin >= started], origin[origin >= started]
            ahead = exponentials(model.A, times[goal] - times[origin], 0)[0]
            with np.errstate(over='ignore', invalid='ignore'):
                free = np.einsum('kij,kj->ki', model.C[stream.channels] @ ahead, xi[origin])
            y_hat[goal, stream.channels] = y_known[goal, stream.channels] + np.where(
                np.isnan(free), np.inf, free)
        found[steps] = Validation(
            times=times, y=y, y_hat=y_hat, x0=x0, fit=fit(y, y_hat), vaf=vaf(y, y_hat),
            notes=(note,) if note else ())
    return found


@dataclass(frozen=True, kw_only=True)
class ResidualTests:
    """
    P-values of two hypotheses that a good model fulfils; small ones speak against it.

    NaN where nothing can be tested: fewer than 50 residuals, or residuals below 1e-9 of the
    output's spread (rounding), or an input that does not move.
    """

    # (ny,): 'The residuals of this output are independent of each other.' Simulation residuals
    # pass only if all noise is white measurement noise; residuals of one-step predictions should
    # pass whenever K describes the noise
    whiteness: Array
    # (ny, nu): 'The residuals of this output know nothing of the past of this input.' What fails
    # here, the dynamics from that input miss
    independence: Array


def residual_tests(model: StateSpace, record: Record, *,
                   residuals: Literal['simulation', 'prediction'] = 'simulation',
                   ) -> ResidualTests:
    """
    Test the residuals of a model, output by output at the output's own stamps.

    They are those of `simulation` with refitted trim (an offset is not a fault of the dynamics),
    or of the one-step `prediction`. Levels are exact for another record than that of the
    identification; how lags are counted under uneven stamps: see `ctsid_core.model.validation`.
    Raises `DataError` if the record's channels do not fit the model, or for other residuals.
    """
    if residuals not in ('simulation', 'prediction'):
        raise DataError(f'`residuals` is {residuals!r}; choose simulation or prediction')
    found = simulation(model, record, trim='refit') if residuals == 'simulation' else \
        prediction(model, record, 1)
    size, slowest = spread(found.y), float(min(model.natural_frequency, default=np.inf))
    memory = 3 / slowest if slowest > 0 else np.inf
    inputs = acting(record.inputs, model.actuators)
    white, independent = [], []
    for i in range(model.ny):
        e = found.y[:, i] - found.y_hat[:, i]
        rows = np.isfinite(e) & (np.abs(e).max(initial=0, where=np.isfinite(e)) > 1e-9 * size[i])
        white.append(whiteness(e[rows]))
        independent.append(np.full(model.nu, np.nan) if not rows.any() else independence(
            found.times[rows], e[rows],
            lambda t: input_polynomials(inputs, model.delay, t)[0], memory))
    return ResidualTests(whiteness=np.array(white),
                         independence=np.array(independent).reshape(model.ny, model.nu))


def whiteness(e: Array) -> float:
    """
    Return the p-value of 'these residuals (N,) are independent of each other' (Ljung-Box).

    Lags 1 to 20 are counted in samples, not in seconds: independent residuals are uncorrelated at
    any spacing, so uneven stamps and gaps leave the level of the test as it is; they only blur in
    time what it would find. NaN for fewer than 50 samples or constant residuals.

    G. M. Ljung, G. E. P. Box, "On a measure of lack of fit in time series models", Biometrika 65,
    1978. No degrees of freedom are taken off for estimated parameters: of a model's own record,
    the p-value is a little too large.
    """
    count, e = len(e), e - e.mean() if len(e) else e
    power = float(e @ e)
    if count < FEWEST or not power > 0:
        return float('nan')
    lags = np.arange(1, LAGS + 1)
    r = np.array([e[:-k] @ e[k:] for k in lags]) / power
    return float(chdtrc(LAGS, count * (count + 2) * np.sum(r ** 2 / (count - lags))))


def cell(times: Array) -> float:
    """Return the median interval of stamps (N,), N > 1 [s]."""
    # More for those that came in bursts: there are a few times as many cells, not all that fit.
    return float(max(np.median(np.diff(times)), np.ptp(times) / (_CELLS * len(times))))


def independence(times: Array, e: Array, inputs_at: Callable[[Array], Array],
                 memory: float) -> Array:
    """
    Return the p-value, per input, of 'these residuals are independent of the input's past'.

    The statistic is the sum of the squared cross-correlations at lags from 0 to about `memory`
    [s], at least 20 cells and at most a tenth of the record. It is ranked among the values it
    takes when the input is shifted against the residuals in time, circularly and by more than
    these lags: shifted by a whole different time, the two have nothing to do with each other but
    keep their own spectra. Coloured residuals and coloured inputs are thereby allowed for without
    being modelled. Residuals e (N,) at increasing times (N,) [s] go into cells of one median
    interval, or more if there were many (lags are right to half a cell), empty cells do not
    count, and the inputs are known everywhere by their holds: `inputs_at` stamps (G,) gives
    (G, nu), after their dead time.

    NaN for fewer than 50 samples, constant residuals, or an input that does not move. Conservative
    for the model's own record. Under feedback, residuals also act on *later* inputs; the test
    looks at earlier ones only, but a slow loop smears one into the other.
    """
    if len(times) < FEWEST or not np.ptp(e) > 0:
        return np.full(inputs_at(times[:1]).shape[-1] if len(times) else 0, np.nan)
    step = cell(times)
    cells = np.rint((times - times[0]) / step).astype(int)
    count = int(cells[-1]) + 1
    binned = np.bincount(cells, e - e.mean(), count)
    u = inputs_at(times[0] + step * np.arange(count))
    moves = np.ptp(u, axis=0) > 0
    spectra = np.fft.rfft(binned)[:, np.newaxis] * np.fft.rfft(u - u.mean(axis=0), axis=0).conj()
    correlation = np.fft.irfft(spectra, count, axis=0)  # (lag, input), circular
    lags = int(np.clip(min(memory, times[-1] - times[0]) / step, LAGS, max(count // 10, 1)))
    sums = np.cumsum(np.concatenate([np.zeros_like(u[:1]), correlation ** 2]), axis=0)
    statistic = sums[lags:] - sums[:-lags]  # at shifts 0 ... count - lags
    higher = (statistic[lags:] >= statistic[0]).sum(axis=0)
    p: Array = (1 + higher) / (1 + len(statistic) - lags)
    return np.where(moves, p, np.nan)
