# SPDX-License-Identifier: Apache-2.0
"""The one entry: check, project, regress, refine, judge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bandwidth import choose_nmax
from ctsid_core.bases.base import Projection, as_real
from ctsid_core.bases.hermite import project_record
from ctsid_core.closed_loop import by_prediction
from ctsid_core.deviation import pole_deviation
from ctsid_core.estimate import Choice, Estimate, Status
from ctsid_core.order import Candidate, Search
from ctsid_core.pbsid import Matrices
from ctsid_core.prediction_errors import (
    line_fit,
    predicted_fit,
    prediction_errors,
    unseen_fit,
    unseen_predicted_fit,
)
from ctsid_core.refine import affordable
from ctsid_core.selection import choose_order, likeliest_simulation, most_likely
from ctsid_core.settings import Settings
from ctsid_core.signals import Array, Record
from ctsid_core.statespace import StateSpace
from ctsid_core.steadiness import Change, likeliest_change
from ctsid_core.usable import Usable, usable

_VAGUE = 0.5            # standard deviation over size above which a pole is not known
_ROUNDS = 2             # of removing corrupt samples by the model found without them
_LITTLE = 1.1           # errors' power over that without outliers that changes no choice
_EXPLAINED = 30.0       # fit [%] below which an output counts as not explained
_FORETOLD = 10.0        # the same where predictions are judged: by chance it is 1


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

    Examples
    --------
    >>> import numpy as np
    >>> from ctsid_core import Record, identify
    >>> t = np.linspace(0.0, 10.0, 1001)
    >>> u = np.sign(np.sin(2.0 * t) + np.sin(5.1 * t))
    >>> y = np.zeros(1001)
    >>> for k in range(1000):                           # dy/dt = -3 y + 3 u, u held
    ...     y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-0.03)
    >>> estimate = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'))
    >>> print(estimate.model.poles.real.round(2))
    [-3.]
    """
    estimate = _identify(record, settings or Settings())
    return replace(estimate, start_ns=record.epoch_ns + round(record.start * 1e9),
                   end_ns=record.epoch_ns + round(record.end * 1e9))


def _identify(record: Record, settings: Settings) -> Estimate:
    part = usable(record, settings)
    if isinstance(part, Status):
        return Estimate(status=part, settings=settings)
    try:
        found = _estimate(part, settings)
        if found is None:
            return Estimate(status=Status.TOO_SHORT, settings=settings, notes=part.notes)
        return _judge(*_without_outliers(part, found, settings))
    except np.linalg.LinAlgError as error:       # of the data's making: a node must not die of it
        return Estimate(status=Status.UNRELIABLE, settings=settings,
                        notes=(*part.notes, f'the arithmetic failed: {error}'))


@dataclass(frozen=True)
class _Found:
    """A model of the moving channels, and how it was found."""

    settings: Settings
    projection: Projection
    matrices: Matrices
    best: Candidate
    process_noise: bool
    choices: tuple[Choice, ...]
    by_prediction: bool = False   # an unstable plant with process noise: simulations mean nothing


def _estimate(part: Usable, settings: Settings) -> _Found | None:
    """Return the model of a record, or None if it is too short for any."""
    choices: list[Choice] = []
    nmax, parts = settings.nmax, settings.parts or 1
    if not nmax:
        nmax, parts, why = choose_nmax(part.record)
        choices.append(Choice('hermite.nmax', nmax, why))
    own = _own_delays(part, settings.replace(parts=parts))
    projection = project_record(part.record, own, nmax)
    search = Search(projection, own)
    order = settings.order or _order(search, choices)
    pair = search.pair(order) if order else None
    if pair is None:
        return None
    tuning, tried = pair.best.subspace.tuning, len(search.tunings(order))
    if tried > 1:
        choices.append(Choice('pbsid', f'beta {tuning.beta:.3g} rad/s, p {tuning.past}',
                              f'the most likely of {tried} subspace models'))
    matrices, process_noise = most_likely(search.projection, pair, own)
    told = by_prediction(part.record, search, matrices) \
        if settings.refine and process_noise else None
    if told is not None:
        matrices, order = told, len(told.A)
        pair = search.pair(order) or pair
        choices = [c for c in choices if c.name != 'order']
        choices.append(Choice('order', order, 'the plant is unstable, with process noise: told by '
                              'one-step predictions of the samples'))
    if settings.refine and not affordable(projection, order):
        choices.append(Choice('refine', False, 'with so many states and signals the maximum of '
                              'the likelihood takes too long; this is the subspace estimate'))
    elif settings.refine:
        choices.append(Choice(
            'noise', 'process' if process_noise else 'measurement',
            'the likelier of process noise (innovation form) and measurement noise alone'))
    used = settings.replace(nmax=nmax, parts=parts, order=order, beta=tuning.beta,
                            gamma=tuning.gamma, past=tuning.past, future=tuning.future)
    return _Found(used, projection, matrices, pair.best, process_noise, tuple(choices),
                  told is not None)


def _without_outliers(part: Usable, found: _Found,
                      settings: Settings) -> tuple[Usable, _Found]:
    """
    Return record and model without the corrupt samples that only a model can tell.

    Those that were taken out without one are put back if the model explains them. What was chosen
    from the data stays as it is, unless the samples made a large difference.
    """
    for _ in range(_ROUNDS):
        m = found.matrices
        error = as_real(prediction_errors(found.projection, m))
        density = found.projection.unit * np.mean(error ** 2, axis=1)
        if not (np.isfinite(m.A).all() and part.doubtful(density)):
            break
        model = StateSpace(
            A=m.A, B=m.B, C=m.C, D=m.D,
            delay=_own_delays(part, found.settings).delays(part.record.nu),
            x_trim=m.x_trim[:, 0] if m.x_trim.size else np.zeros(len(m.A)),
            y_trim=m.y_trim[:, 0] if m.y_trim.size else np.zeros(len(m.C)))
        cleaned, gain = part.cleaned(model)
        large = gain > _LITTLE
        again = None if cleaned is part else \
            _estimate(cleaned, settings if large else found.settings)
        if again is None:
            break
        part, found = cleaned, again if large else replace(again, choices=found.choices)
        if not large:
            break
    return part, found


def _own_delays(part: Usable, settings: Settings) -> Settings:
    """Return the settings with the dead times of the moving inputs only."""
    delays = settings.delays(part.whole.nu)
    if len(set(delays)) == 1:
        return settings
    return settings.replace(delay=tuple(delays[j] for j in part.u))


def _order(search: Search, choices: list[Choice]) -> int:
    """Choose the order; 0 if the data are too short for any model."""
    trials = search.orders()
    if not trials:
        return 0
    chosen, table = choose_order(search, trials)
    choices.append(Choice('order', chosen.order, "Schwarz's criterion, above its smallest value, "
                          f'by order: {table}'))
    return chosen.order


def _held_out(part: Usable, found: _Found) -> Array:
    """Return the fit on the last part of the window of a model of the first part [%]."""
    record, share = part.record, found.settings.held_out
    if share == 0.0:
        return np.full(record.ny, np.nan)
    own = _own_delays(part, found.settings)
    split = record.end - share * record.duration
    lead = max(own.delays(record.nu), default=0.0)
    early, late = (record.between(start, end, lead=lead)
                   for start, end in ((record.start, split), (split, record.end)))
    first, last = _share(early, own, 1.0 - share), _share(late, own, share)
    search = Search(first, own)
    pair = search.pair(own.order)
    if pair is None:
        return np.full(record.ny, np.nan)
    if found.by_prediction:
        model = most_likely(first, pair, own)[0]
        told = by_prediction(early, search, model)
        return unseen_predicted_fit(last, model if told is None else told)
    # Simulation judges: without process noise the gain of the first part's model is of no use.
    model = most_likely(first, pair, own)[0] if found.process_noise else \
        likeliest_simulation(first, pair, own)[0]
    return unseen_fit(last, model)


def _share(record: Record, settings: Settings, share: float) -> Projection:
    """Project a part of a record on a basis that reaches as far as that of the whole."""
    parts = max(round(settings.parts * share), 1)
    nmax = max(round(settings.nmax * settings.parts * share / parts), 8)
    return project_record(record, settings.replace(parts=parts), nmax)


def _judge(part: Usable, found: _Found) -> Estimate:
    model = _to_statespace(part, found)
    fit = (predicted_fit if found.by_prediction else line_fit)(found.projection, found.matrices)
    held_out = _held_out(part, found)
    deviation = pole_deviation(found.projection, found.matrices, found.settings.feedthrough,
                               process_noise=found.process_noise)
    poles = np.linalg.eigvals(found.matrices.A).astype(complex)
    status = _status(found, fit, held_out)
    if status is Status.OK and _vague(part, poles, deviation):
        status = Status.UNRELIABLE
    # The test is for a model at the maximum of the likelihood.
    change = likeliest_change(found.projection, found.matrices, found.settings) \
        if status is Status.OK and found.settings.refine else Change()
    if change.matters:
        status = Status.CHANGED
    ny = part.whole.ny
    worst = np.fmin(fit, held_out)
    corrupt, counts = part.corrupt()
    notes = [f'output {part.whole.output_names[j]} is not explained: fit {worst[i]:.0f} %'
             for i, j in enumerate(part.y) if worst[i] < _enough(found)]
    if status is Status.CHANGED:
        notes.append(f'the likeliest time of the change is {change.share * 100:.0f} % of the '
                     f'window, {change.share * part.record.duration:.2g} s after its start')
    return Estimate(
        status=status, settings=found.settings, model=model if status is Status.OK else None,
        rejected_model=None if status is Status.OK else model,
        pole_std=np.array([deviation[np.argmin(np.abs(poles - p))] for p in model.poles]),
        fit=_spread(fit, part.y, ny), held_out_fit=_spread(held_out, part.y, ny),
        singular_values=found.best.subspace.singular_values,
        condition=found.best.subspace.condition, choices=found.choices,
        notes=(*part.notes, *corrupt, *notes),
        statistics={**counts, 'process_noise': float(found.process_noise),
                    'change_p_value': change.p_value, 'change_size': change.size,
                    'change_gain': change.gain, 'change_share': change.share})


def _status(found: _Found, fit: Array, held_out: Array) -> Status:
    if not (np.isfinite(fit).all() and np.isfinite(found.matrices.A).all()):
        return Status.UNRELIABLE
    tested = held_out[np.isfinite(held_out)]
    best = min(np.max(fit), np.max(tested)) if len(tested) else np.max(fit)
    return Status.OK if best >= _enough(found) else Status.UNEXPLAINED


def _enough(found: _Found) -> float:
    """Return the fit above which an output counts as explained [%]."""
    return _FORETOLD if found.by_prediction else _EXPLAINED


def _vague(part: Usable, poles: NDArray[np.complex128], deviation: Array) -> bool:
    """Return whether not a single pole is known to half its size (or the window's resolution)."""
    size = np.maximum(np.abs(poles), 2.0 * np.pi / part.record.duration)
    return bool(np.min(deviation / size) > _VAGUE)


def _spread(values: Array, places: tuple[int, ...], count: int) -> Array:
    """Put the values of moving channels among all channels; NaN for the constant ones."""
    out = np.full(count, np.nan)
    out[list(places)] = values
    return out


def _to_statespace(part: Usable, found: _Found) -> StateSpace:
    """Return the model of all channels: constant ones have zero rows and columns."""
    m, whole = found.matrices, part.whole
    n, nu, ny = len(m.A), whole.nu, whole.ny
    u, y = list(part.u), list(part.y)
    B, C, D, K = np.zeros((n, nu)), np.zeros((ny, n)), np.zeros((ny, nu)), np.zeros((n, ny))
    B[:, u], C[y], D[np.ix_(y, u)], K[:, y] = m.B, m.C, m.D, m.K
    level = np.zeros(ny) if len(y) == ny else \
        np.concatenate([s.values.mean(axis=0) for s in whole.outputs])
    level[y] = (m.y_trim[:, 0] if m.y_trim.size else 0.0) + part.y_level - m.D @ part.u_level
    drift = (m.x_trim[:, 0] if m.x_trim.size else np.zeros(n)) - m.B @ part.u_level
    error = as_real(prediction_errors(found.projection, m))
    noise = np.zeros((ny, ny))
    noise[np.ix_(y, y)] = found.projection.unit * (error @ error.T) / error.shape[1]
    return StateSpace(
        A=m.A, B=B, C=C, D=D, K=K, delay=found.settings.delays(nu),
        x_trim=drift, y_trim=level, noise=noise,
        input_names=whole.input_names, output_names=whole.output_names,
        input_units=whole.input_units, output_units=whole.output_units)
