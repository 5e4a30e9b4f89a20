# SPDX-License-Identifier: Apache-2.0
"""The one entry: check, project, regress, refine, judge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bandwidth import choose_nmax
from ctsid_core.bases.base import Projection, as_real
from ctsid_core.bases.hermite import input_slopes, project_inputs, project_record
from ctsid_core.dead_time import LONGEST, DeadTimeSearch, LateFit
from ctsid_core.deviation import deviations
from ctsid_core.estimate import Choice, Estimate, Status
from ctsid_core.joint_climb import climb_jointly
from ctsid_core.order import Candidate, Search
from ctsid_core.pbsid import Matrices
from ctsid_core.prediction_errors import line_fit, prediction_errors, unseen_fit
from ctsid_core.refine import affordable, refine_innovation
from ctsid_core.selection import (
    choose_order,
    likeliest_simulation,
    model_criterion,
    most_likely,
)
from ctsid_core.settings import Settings
from ctsid_core.signals import Array, Record
from ctsid_core.statespace import StateSpace
from ctsid_core.steadiness import Change, likeliest_change
from ctsid_core.usable import Usable, usable

_VAGUE = 0.5            # standard deviation over size above which a pole is not known
_ROUNDS = 2             # of removing corrupt samples by the model found without them
_LITTLE = 1.1           # errors' power over that without outliers that changes no choice
_EXPLAINED = 30.0       # fit [%] below which an output counts as not explained


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
    known = settings.with_known_delays()
    part = usable(record, known)
    if isinstance(part, Status):
        return Estimate(status=part, settings=settings)
    try:
        found = _estimate(part, known)
        if found is None:
            return Estimate(status=Status.TOO_SHORT, settings=settings, notes=part.notes)
        part, found = _without_outliers(part, found, known)
        return _judge(*_with_dead_time(part, found, settings))
    except np.linalg.LinAlgError as error:       # of the data's making: a node must not die of it
        return Estimate(status=Status.UNRELIABLE, settings=settings,
                        notes=(*part.notes, f'the arithmetic failed: {error}'))


@dataclass(frozen=True)
class _Found:
    """A model of the moving channels, and how it was found."""

    settings: Settings
    projection: Projection
    search: Search
    matrices: Matrices
    best: Candidate
    process_noise: bool
    choices: tuple[Choice, ...]


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
    if settings.refine and not affordable(projection, order):
        choices.append(Choice('refine', False, 'with so many states and signals the maximum of '
                              'the likelihood takes too long; this is the subspace estimate'))
    elif settings.refine:
        choices.append(Choice(
            'noise', 'process' if process_noise else 'measurement',
            'the likelier of process noise (innovation form) and measurement noise alone'))
    used = settings.replace(nmax=nmax, parts=parts, order=order, beta=tuning.beta,
                            gamma=tuning.gamma, past=tuning.past, future=tuning.future)
    return _Found(used, projection, search, matrices, pair.best, process_noise, tuple(choices))


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


def _with_dead_time(part: Usable, found: _Found, settings: Settings) -> tuple[Usable, _Found]:
    """Return record and model with the dead times that the data show; the same if none."""
    late = np.array(settings.unknown_delays(part.whole.nu))[list(part.u)]
    order = len(found.matrices.A)
    if not (late.any() and settings.refine and settings.edges == 'exact'
            and affordable(found.projection, order)):
        return part, found
    hunt = DeadTimeSearch(part.record, found.search, found.settings.nmax, late)
    rough = hunt.best(order, alone=bool(settings.order),
                      poles=np.linalg.eigvals(found.matrices.A).astype(complex))
    if rough is None or not _likelier(hunt, rough, found):
        return part, found
    known = _known(part, settings, rough.delays).replace(feedthrough=rough.direct)
    if not found.process_noise:         # else some states may stand for that
        known = known.replace(order=len(rough.poles))
    shorter = usable(part.whole, known)
    if isinstance(shorter, Status):
        return part, found
    other = _estimate(shorter, known)
    if other is None:
        return part, found
    shorter, other = _without_outliers(shorter, other, known)
    return shorter, _climbed(shorter, other, rough.late, rough.why(order))


def _likelier(hunt: DeadTimeSearch, rough: LateFit, found: _Found) -> bool:
    """Return whether dead times are likelier than none if the errors are not white, too."""
    if not found.process_noise:
        return True
    projection = hunt.projection(rough.delays)
    settings = found.settings.replace(feedthrough=rough.direct)
    search = Search(projection, settings.replace(beta=0.0, gamma=0.0, past=0, future=0))
    rival = model_criterion(found.search, found.matrices, True)
    for n in (len(rough.poles), len(rough.poles) + 1):       # gusts may ask for a state more
        pair = None if n > len(found.matrices.A) else search.pair(n)
        if pair is not None and model_criterion(
                search, *most_likely(projection, pair, settings)) \
                + float(rough.late.sum()) * search.charge < rival:
            return True
    return False


def _known(part: Usable, settings: Settings, delays: Array) -> Settings:
    """Return the settings with the dead times of the moving inputs filled in."""
    each = list(settings.delays(part.whole.nu))
    for j, delay in zip(part.u, delays.tolist(), strict=True):
        each[j] = delay
    return settings.replace(delay=each[0] if len(each) == 1 else tuple(each))


def _climbed(part: Usable, found: _Found, late: NDArray[np.bool_], why: str) -> _Found:
    """Return a model at the joint maximum over its entries and its dead times."""
    record, own, nmax = part.record, _own_delays(part, found.settings), found.settings.nmax

    def at(delays: Array) -> Projection:
        return replace(found.projection, u=project_inputs(record, own, nmax, delays.tolist()),
                       slopes=input_slopes(record, own, nmax, delays.tolist(), late))

    feed = found.settings.feedthrough
    joint = climb_jointly(at, found.matrices, np.array(own.delays(record.nu)), feedthrough=feed,
                          process_noise=found.process_noise, longest=LONGEST * record.duration)
    projection, matrices = at(joint.delays), joint.matrices
    if not found.process_noise and np.any(found.matrices.K):
        matrices = refine_innovation(projection, replace(matrices, K=found.matrices.K), feed,
                                     plant=False, steps=8)[0]
    choice = Choice('delay', tuple(float(d) for d in joint.delays), why)
    return replace(found, settings=_known(part, found.settings, joint.delays),
                   projection=projection, matrices=matrices, choices=(*found.choices, choice))


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
    first, last = (_share(record.between(start, end, lead=lead), own, share)
                   for start, end, share in ((record.start, split, 1.0 - share),
                                             (split, record.end, share)))
    pair = Search(first, own).pair(own.order)
    if pair is None:
        return np.full(record.ny, np.nan)
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
    fit, held_out = line_fit(found.projection, found.matrices), _held_out(part, found)
    deviation, late = deviations(found.projection, found.matrices, found.settings.feedthrough,
                                 process_noise=found.process_noise)
    delay_std = np.zeros(part.whole.nu)
    delay_std[list(part.u)] = late
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
             for i, j in enumerate(part.y) if worst[i] < _EXPLAINED]
    if status is Status.CHANGED:
        notes.append(f'the likeliest time of the change is {change.share * 100:.0f} % of the '
                     f'window, {change.share * part.record.duration:.2g} s after its start')
    return Estimate(
        status=status, settings=found.settings, model=model if status is Status.OK else None,
        rejected_model=None if status is Status.OK else model,
        pole_std=np.array([deviation[np.argmin(np.abs(poles - p))] for p in model.poles]),
        delay_std=delay_std, fit=_spread(fit, part.y, ny),
        held_out_fit=_spread(held_out, part.y, ny),
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
    return Status.OK if best >= _EXPLAINED else Status.UNEXPLAINED


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
