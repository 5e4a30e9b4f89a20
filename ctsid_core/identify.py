# SPDX-License-Identifier: Apache-2.0
"""The one entry: check, project, regress, refine, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.base import Projection, as_real
from ctsid_core.deviation import pole_deviation
from ctsid_core.estimate import Choice, Estimate, RecordShare, Status
from ctsid_core.joint import Joint, Layout, balanced, check_alike, join_records
from ctsid_core.order import Candidate, Search
from ctsid_core.pbsid import Matrices
from ctsid_core.prediction_errors import line_fit, prediction_errors, unseen_fit
from ctsid_core.refine import affordable
from ctsid_core.sameness import Differing, likeliest_difference
from ctsid_core.selection import choose_order, likeliest_simulation, most_likely
from ctsid_core.settings import Settings
from ctsid_core.signals import Array, Record
from ctsid_core.statespace import StateSpace
from ctsid_core.usable import Usable

_VAGUE = 0.5            # standard deviation over size above which a pole is not known
_ROUNDS = 2             # of removing corrupt samples by the model found without them
_REWEIGHTED = 2         # rounds of weighting records by the noise that a model finds in them
_LITTLE = 1.1           # errors' power over that without outliers that changes no choice
_EXPLAINED = 30.0       # fit [%] below which an output counts as not explained


def identify(record: Record | Sequence[Record], settings: Settings | None = None) -> Estimate:
    """
    Identify a continuous-time state-space model from one record, or from several of one plant.

    Parameters
    ----------
    record : Record or sequence of Record
        Inputs and outputs, each with its own stamps. Several share the plant; each has a trim,
        states at its ends and a level of noise of its own, and may be of any duration and rates.
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
    DataError
        If several records differ in the number, names or units of their channels.

    Notes
    -----
    Pure: the same record and settings give the same bits.

    Of several records: the trim and the noise of the model are those of the record that ends last
    (of several, the last given), those of all are in `Estimate.records`. The order does not matter
    otherwise. What is held out is the last part of every record; of four and more, whole ones.

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
    records = (record,) if isinstance(record, Record) else tuple(record)
    check_alike(records)
    estimate = _identify(records, settings or Settings())
    return replace(estimate, start_ns=min(r.epoch_ns + round(r.start * 1e9) for r in records),
                   end_ns=max(r.epoch_ns + round(r.end * 1e9) for r in records))


def _identify(records: tuple[Record, ...], settings: Settings) -> Estimate:
    part = join_records(records, settings)
    if isinstance(part, Estimate):
        return part
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
    layout: Layout


def _estimate(part: Joint, settings: Settings, layout: Layout | None = None) -> _Found | None:
    """
    Return the model of records, or None if they are too short for any.

    Several are weighted by the noise that their model finds in them.
    """
    choices: list[Choice] = []
    if layout is None:
        layout, why = part.layout(settings)
        choices += [Choice('hermite.nmax', max(layout.sizes)[0], why)] if why else []
    found = _estimate_on(layout, part, settings, list(choices))
    for _ in range(_REWEIGHTED * part.several):
        if found is None:
            break
        better = balanced(found.projection, found.matrices, found.layout)
        if better is found.layout:
            break
        weighted = ', '.join(f'{w:.2g}' for w in better.weights)
        found = _estimate_on(better, part, settings, [*choices, Choice(
            'weights', weighted, 'the noise of the records differs')])
    return found


def _estimate_on(layout: Layout, part: Joint, settings: Settings,
                 choices: list[Choice]) -> _Found | None:
    nmax, parts = max(layout.sizes)
    own = _own_delays(part.parts[0], settings.replace(parts=parts))
    projection = part.project(own, layout)
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
                  layout)


def _without_outliers(part: Joint, found: _Found,
                      settings: Settings) -> tuple[Joint, _Found]:
    """
    Return record and model without the corrupt samples that only a model can tell.

    Those that were taken out without one are put back if the model explains them. What was chosen
    from the data stays as it is, unless the samples made a large difference.
    """
    for _ in range(_ROUNDS):
        own, matrices = found.projection, found.matrices.of_records(found.projection)
        errors = [as_real(prediction_errors(p, m))
                  for p, m in zip(own.records, matrices, strict=True)]
        densities = [own.unit * np.mean(error ** 2, axis=1) / weight ** 2
                     for error, weight in zip(errors, found.layout.weights, strict=True)]
        if not (np.isfinite(found.matrices.A).all() and part.doubtful(densities)):
            break
        cleaned, gain = part.cleaned([_simulating(usable, m, found.settings)
                                      for usable, m in zip(part.parts, matrices, strict=True)])
        large = gain > _LITTLE
        again = None if cleaned is part else _estimate(cleaned, settings) if large else \
            _estimate(cleaned, found.settings, found.layout)
        if again is None:
            break
        part, found = cleaned, again if large else replace(again, choices=found.choices)
        if not large:
            break
    return part, found


def _simulating(part: Usable, m: Matrices, settings: Settings) -> StateSpace:
    """Return the model of the moving channels of one record, for simulations."""
    return StateSpace(
        A=m.A, B=m.B, C=m.C, D=m.D, delay=_own_delays(part, settings).delays(part.record.nu),
        x_trim=m.x_trim[:, 0] if m.x_trim.size else np.zeros(len(m.A)),
        y_trim=m.y_trim[:, 0] if m.y_trim.size else np.zeros(len(m.C)))


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


def _held_out(part: Joint, found: _Found) -> Array:
    """Return the fit on the last part of each record of a model of the first parts [%]."""
    nothing = np.full(len(found.matrices.C), np.nan)
    if found.settings.held_out == 0.0:
        return nothing
    own = _own_delays(part.parts[0], found.settings)
    first, last = part.divided(own, found.layout)
    pair = Search(first, own).pair(own.order)
    if pair is None:
        return nothing
    # Simulation judges: without process noise the gain of the first part's model is of no use.
    model = most_likely(first, pair, own)[0] if found.process_noise else \
        likeliest_simulation(first, pair, own)[0]
    return unseen_fit(last, model, trimmed=not part.many)


def _judge(part: Joint, found: _Found) -> Estimate:
    model = _to_statespace(part, found)
    fit, held_out = line_fit(found.projection, found.matrices), _held_out(part, found)
    deviation = pole_deviation(found.projection, found.matrices, found.settings.feedthrough,
                               process_noise=found.process_noise)
    poles = np.linalg.eigvals(found.matrices.A).astype(complex)
    status = _status(found, fit, held_out)
    if status is Status.OK and _vague(part, poles, deviation):
        status = Status.UNRELIABLE
    # The test is for a model at the maximum of the likelihood.
    tested = found.settings.refine and (status is Status.OK or part.several)
    differing = likeliest_difference(
        found.projection, found.matrices, found.settings, found.layout) \
        if tested and np.isfinite(found.matrices.A).all() else Differing()
    change = differing.change
    if change.matters:
        status = Status.CHANGED
    whole = part.parts[0].whole
    ny, y = whole.ny, part.parts[0].y
    worst = np.fmin(fit, held_out)
    corrupt, counts = part.corrupt()
    notes = [f'output {whole.output_names[j]} is not explained: fit {worst[i]:.0f} %'
             for i, j in enumerate(y) if worst[i] < _EXPLAINED]
    if status is Status.CHANGED:
        notes.append(_change_note(part, differing))
    return Estimate(
        status=status, settings=found.settings, model=model if status is Status.OK else None,
        rejected_model=None if status is Status.OK else model,
        pole_std=np.array([deviation[np.argmin(np.abs(poles - p))] for p in model.poles]),
        fit=_spread(fit, y, ny), held_out_fit=_spread(held_out, y, ny),
        singular_values=found.best.subspace.singular_values,
        condition=found.best.subspace.condition, choices=found.choices,
        notes=(*part.notes, *corrupt, *notes),
        statistics={**counts, 'process_noise': float(found.process_noise),
                    'change_p_value': change.p_value, 'change_size': change.size,
                    'change_gain': change.gain, 'change_share': change.share},
        records=_shares(part, found) if part.several else ())


def _change_note(part: Joint, differing: Differing) -> str:
    change, place = differing.change, differing.place
    if not differing.within:
        numbers = part.numbers
        who = f'records {numbers[0]} and {numbers[1]} show different plants' \
            if len(numbers) == 2 else \
            f'record {numbers[place]} shows another plant than the other records'
        cure = 'each' if len(numbers) == 2 else 'it'
        return (f'{who}: the responses to the inputs differ by {100 * change.size:.0f} %; '
                f'identify {cure} by itself')
    where = f'record {part.numbers[place]}: ' if part.several else ''
    record = part.parts[place].record
    return (f'{where}the likeliest time of the change is {change.share * 100:.0f} % of the '
            f'window, {change.share * record.duration:.2g} s after its start')


def _shares(part: Joint, found: _Found) -> tuple[RecordShare, ...]:
    """Return what is each record's own."""
    matrices, projection, shares = found.matrices, found.projection, []
    for i, (usable, p, m) in enumerate(zip(part.parts, projection.records,
                                           matrices.of_records(projection), strict=True)):
        whole, epoch = usable.whole, usable.whole.epoch_ns
        x_trim, y_trim = _trim(usable, m)
        shares.append(RecordShare(
            part.numbers[i], epoch + round(whole.start * 1e9), epoch + round(whole.end * 1e9),
            x_trim, y_trim, _spread(line_fit(p, m), usable.y, whole.ny), found.layout.weights[i]))
    return tuple(shares)


def _status(found: _Found, fit: Array, held_out: Array) -> Status:
    if not (np.isfinite(fit).all() and np.isfinite(found.matrices.A).all()):
        return Status.UNRELIABLE
    tested = held_out[np.isfinite(held_out)]
    best = min(np.max(fit), np.max(tested)) if len(tested) else np.max(fit)
    return Status.OK if best >= _EXPLAINED else Status.UNEXPLAINED


def _vague(part: Joint, poles: NDArray[np.complex128], deviation: Array) -> bool:
    """Return whether not a single pole is known to half its size (or the window's resolution)."""
    size = np.maximum(np.abs(poles), 2.0 * np.pi / part.length)
    return bool(np.min(deviation / size) > _VAGUE)


def _spread(values: Array, places: tuple[int, ...], count: int) -> Array:
    """Put the values of moving channels among all channels; NaN for the constant ones."""
    out = np.full(count, np.nan)
    out[list(places)] = values
    return out


def _trim(part: Usable, m: Matrices) -> tuple[Array, Array]:
    """Return the trim of the states and of all outputs of a record, given its own model."""
    whole, y = part.whole, list(part.y)
    level = np.zeros(whole.ny) if len(y) == whole.ny else \
        np.concatenate([s.values.mean(axis=0) for s in whole.outputs])
    level[y] = (m.y_trim[:, 0] if m.y_trim.size else 0.0) + part.y_level - m.D @ part.u_level
    drift = (m.x_trim[:, 0] if m.x_trim.size else np.zeros(len(m.A))) - m.B @ part.u_level
    return drift, level


def _to_statespace(joint: Joint, found: _Found) -> StateSpace:
    """Return the model of all channels: constant ones have zero rows and columns."""
    part = joint.parts[joint.last]
    m, whole = found.matrices.of_records(found.projection)[joint.last], part.whole
    n, nu, ny = len(m.A), whole.nu, whole.ny
    u, y = list(part.u), list(part.y)
    B, C, D, K = np.zeros((n, nu)), np.zeros((ny, n)), np.zeros((ny, nu)), np.zeros((n, ny))
    B[:, u], C[y], D[np.ix_(y, u)], K[:, y] = m.B, m.C, m.D, m.K
    drift, level = _trim(part, m)
    error = as_real(prediction_errors(found.projection, found.matrices))
    noise, weight = np.zeros((ny, ny)), found.layout.weights[joint.last]
    noise[np.ix_(y, y)] = found.projection.unit * (error @ error.T) / error.shape[1] / weight ** 2
    return StateSpace(
        A=m.A, B=B, C=C, D=D, K=K, delay=found.settings.delays(nu),
        x_trim=drift, y_trim=level, noise=noise,
        input_names=whole.input_names, output_names=whole.output_names,
        input_units=whole.input_units, output_units=whole.output_units)
