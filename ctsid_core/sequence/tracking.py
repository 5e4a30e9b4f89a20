# SPDX-License-Identifier: Apache-2.0
"""
The models of consecutive windows as one moving model.

Each window is identified separately. A controller that takes the models one after the other wants
entries of A, B, C and K that move as the plant does, eigenvalues that keep their rows, and a word
on how well the last model simulates what has been measured since. That is added here; and once a
window has shown that the plant changed, no model of data from both sides of it is accepted. All
else is as `identify` gives it, up to the choice of states.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from ctsid_core.bases.preparation import without_corrupt
from ctsid_core.identify import identify
from ctsid_core.judge.rules import in_sequence, rejected_over_change
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import Validation, simulation
from ctsid_core.sequence.alignment import Rows, aligning, follow, referring
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.actuators import acting, in_words
from ctsid_core.signals.gaps import silent_at_end
from ctsid_core.signals.record import Record

_FEWEST = 10          # samples of an output that its model has not seen, for a test worth the name
_STRETCH = 0.1        # of a window, at least, are stretches whose errors are compared
_ROUNDED = 1.0 + 1e-6  # stamps of today in seconds are rounded to a quarter of a microsecond
EDGE = 1 / 40         # part of a window: half of the steps in which the time of a change is found
_SAME_STAMP = 0.5e-9  # [s] stamps have whole nanoseconds


@dataclass(frozen=True, eq=False)
class Tracked:
    """The estimate of one window, in sequence with the windows before it."""

    estimate: Estimate       # its model, if accepted, in the states of this realisation
    # Matrices with the same number have the same states. Counts up from 1 whenever the states
    # start anew (another order, or a plant too unlike); 0 before the first model.
    realisation: int = 0
    # Length n: the identity of each row of the eigenvalues: the same number is the same mode, in
    # all realisations. Empty if there is no accepted model.
    modes: tuple[int, ...] = ()
    # (n,) [rad/s]: a mode keeps its row as long as the modes above it are there
    eigenvalues: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=complex))
    # As `Estimate.pole_std`, in the order of `eigenvalues`
    eigenvalue_std: Array = field(default_factory=lambda: np.empty(0))
    # (ny,): how well the last accepted model, from an earlier window, simulates that part of this
    # one which it has not seen [%]: 100 (1 - rms(error there) / rms(y - mean y)), with mean and
    # rms of y over the whole window. NaN without such a model, or for fewer than 10 new samples.
    fresh_fit: Array = field(default_factory=lambda: np.empty(0))
    fresh_start_ns: int = 0  # the part tested, absolute [ns]; 0 if none was
    fresh_end_ns: int = 0


@dataclass(frozen=True)
class _Past:
    """What is kept of earlier windows."""

    realisation: int = 0
    reference: StateSpace | None = None
    model: StateSpace | None = None
    error: Array = field(default_factory=lambda: np.empty(0))   # (ny,): rms, of its simulation
    settings: Settings | None = None    # that it was found with
    by_predictions: bool = False
    actuators: tuple[Actuator, ...] = ()  # of the last GOOD one
    end_ns: int = 0
    rows: Rows = field(default_factory=Rows)
    next_mode: int = 1


class Tracker:
    """
    Identify windows one after the other, and keep states and rows through them.

    What `take` returns depends on the records and settings given so far and on nothing else. A
    window without an accepted model leaves everything as it was for the next one. The attribute
    `settings` may be replaced between windows.
    """

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self._past = _Past()
        self._changed_ns = 0  # when the plant has changed, as far as windows have shown it

    def take(self, record: Record, cancelled: Callable[[], bool] | None = None) -> Tracked:
        """
        Identify a window.

        Raises `DataError` if the record has other channels than those before (call `reset` first),
        and like `identify`; a window that is broken off because of `cancelled` leaves no trace.
        """
        past, settings = self._past, self.settings
        estimate = identify(record, settings, cancelled=cancelled)
        return self._joined(past, settings, record, estimate, cancelled)

    def join(self, record: Record, estimate: Estimate) -> Tracked:
        """
        Take a window that another process has identified: the same bits as of `take`.

        What a window is identified from does not depend on those before it, so that several can be
        identified at a time; they have to be joined in their order. `estimate` is that of
        `identify` for this record and these settings; here it may be identified once more, with
        what windows before have found to act of inputs. Raises `DataError` as `take` does.
        """
        return self._joined(self._past, self.settings, record, estimate)

    def _joined(self, past: _Past, settings: Settings, record: Record, estimate: Estimate,
                cancelled: Callable[[], bool] | None = None) -> Tracked:
        clean = without_corrupt(record, settings)[0]
        last = _simulated(past.model, clean)
        test = _fresh(past, clean, last)
        estimate = _with_actuators(past, settings, record, estimate, cancelled)
        if not record.faults:  # else the samples changed, not the plant
            estimate = self._reject_straddling(estimate)
        alike = last if past.settings == settings else None     # else others may be wanted
        estimate = in_sequence(estimate, test.fit, test.ratio,
                               _apart(past, estimate, clean, alike), silent_at_end(record))
        model = estimate.model
        if model is None:
            return Tracked(estimate, past.realisation, fresh_fit=test.fit,
                           fresh_start_ns=test.start_ns, fresh_end_ns=test.end_ns)
        estimate, now = _following(past, estimate, model, 2 * np.pi / record.duration)
        if self._past is past:  # else somebody has called reset() in the meantime
            self._past = replace(now, error=_error(estimate, clean), settings=settings,
                                 by_predictions=estimate.by_predictions)
        rows = now.rows
        return Tracked(estimate, now.realisation, rows.identities, rows.eigenvalues,
                       estimate.pole_std[list(rows.order)], test.fit, test.start_ns, test.end_ns)

    def reset(self) -> None:
        """Forget the models; numbers of realisations and modes go on where they were."""
        self._past = _Past(realisation=self._past.realisation, next_mode=self._past.next_mode)
        self._changed_ns = 0

    def _reject_straddling(self, estimate: Estimate) -> Estimate:
        """Return an estimate, rejected if an earlier window showed a change within its window."""
        # A change near the ends of a window hardly shows in it, and its model may be wrong all the
        # same; but it stood in the middle of a window before.
        straddles = time_of(estimate, EDGE) < self._changed_ns < estimate.end_ns
        if estimate.status is Status.CHANGED:
            # The first window to show it dates it best: later ones take it for later.
            found_ns = time_of(estimate, estimate.statistics['change_share'])
            self._changed_ns = min(found_ns, self._changed_ns) if straddles else found_ns
        elif estimate.model is not None and straddles:
            share = (self._changed_ns - estimate.start_ns) / (estimate.end_ns - estimate.start_ns)
            return rejected_over_change(estimate, share)
        return estimate


def time_of(estimate: Estimate, share: float) -> int:
    """Return when a share of a window is over, absolute [ns]."""
    return estimate.start_ns + round(share * (estimate.end_ns - estimate.start_ns))


def _with_actuators(past: _Past, settings: Settings, record: Record, estimate: Estimate,
                    cancelled: Callable[[], bool] | None) -> Estimate:
    """Return the estimate of what acts by the last GOOD model, unless its own is better."""
    # A window may have too few silences, or too small motions, to tell it, or none, to which it is
    # all the same.
    if not any(map(any, past.actuators)):
        return estimate
    own, unknown = estimate.settings.actuators(record.nu), [
        settings.unknown_actuators(kind, record.nu) for kind in Actuator._fields]
    known = tuple(Actuator(*(
        before if sought and not (estimate.good and (mine if k == 0 else any(whole[1:]))) else mine
        for k, (mine, before, sought) in enumerate(zip(whole, last, free, strict=True))))
        for whole, last, free in zip(own, past.actuators, zip(*unknown, strict=True), strict=True))
    spent, other = estimate.statistics.get('seconds_spent', 0.0), estimate
    if known == own or 0.0 < settings.budget <= spent:
        return estimate
    if acting(record.inputs, known) != acting(record.inputs, own):
        left = settings.with_actuators(known).replace(budget=max(settings.budget - spent, 0.0))
        other = identify(record, left, cancelled=cancelled)
        spent += other.statistics.get('seconds_spent', 0.0)
    if other.model is None or _merit(other) < _merit(estimate):
        return estimate
    words = in_words(record.input_names, [
        Actuator(*(k if k != o else 0.0 for k, o in zip(*both, strict=True)))
        for both in zip(known, own, strict=True)], record.input_units)
    return replace(
        other, settings=other.settings.with_actuators(known).replace(budget=settings.budget),
        model=replace(other.model, actuators=known),
        statistics=other.statistics | {'seconds_spent': spent},
        notes=(*other.notes, *(f'{each}, as in windows before' for each in words)))


def _merit(one: Estimate) -> tuple[bool, bool, bool, float]:
    """Return what tells which of two estimates of one window is better: it is greater."""
    return one.good, one.ok, not one.by_predictions, float(np.nansum(one.fit))


def _following(past: _Past, estimate: Estimate, model: StateSpace, resolution: float
               ) -> tuple[Estimate, _Past]:
    """Return an estimate in the states of those before it, and what to keep for the next."""
    reference, realisation = past.reference, past.realisation
    T = aligning(model, reference) if reference else None
    if reference is None or T is None:
        reference, T = referring(model)
        aligned, realisation = reference, realisation + 1
    else:
        aligned = model.transform(T)
    rows = follow(past.rows, aligned.poles, resolution, past.next_mode)
    estimate = replace(estimate, model=aligned, pole_std=_carried(estimate, model, aligned),
                       covariance=estimate.covariance and estimate.covariance.transform(T))
    next_mode = max((past.next_mode, *(1 + mode for mode in rows.identities)))
    return estimate, replace(
        past, realisation=realisation, reference=reference, model=aligned,
        actuators=model.actuators if estimate.good else past.actuators,
        end_ns=estimate.end_ns, rows=rows, next_mode=next_mode)


def _error(estimate: Estimate, record: Record) -> Array:
    """Return the rms error with which a model simulates each output of its window, if known."""
    # On the part that was held out, if that is more: what is new it has not seen, either.
    if estimate.by_predictions:
        return np.full(record.ny, np.nan)
    with np.errstate(over='ignore', invalid='ignore'):  # torn values
        motion = [s.values[s.rows(record.start, record.end)].std(axis=0) for s in record.outputs]
    return np.fmax(estimate.verdict.error, estimate.verdict.held_out_error) \
        * np.concatenate(motion)


def _carried(estimate: Estimate, model: StateSpace, aligned: StateSpace) -> Array:
    """Return the deviations of the poles in the order of the aligned model's poles."""
    # A change of states moves poles by rounding, and poles of equal size may swap places.
    if len(estimate.pole_std) != model.n:
        return np.full(model.n, np.nan)
    away = np.abs(aligned.poles[:, np.newaxis] - model.poles)
    return np.asarray(estimate.pole_std[linear_sum_assignment(away)[1]])


def _apart(past: _Past, estimate: Estimate, record: Record, last: Validation | None) -> Array:
    """Return how far apart a model and the last one simulate a record, see `Verdict.apart`."""
    nothing = np.full(record.ny, np.nan)
    if estimate.model is None or last is None or estimate.by_predictions or past.by_predictions:
        return nothing
    own = _simulated(estimate.model, record)
    if own is None:
        return nothing
    # Where what lies between input and model is another, one may be known later.
    _, *rows = np.intersect1d(own.times, last.times, return_indices=True)
    y = own.y[rows[0]]
    with np.errstate(over='ignore', invalid='ignore'):
        away = np.nan_to_num(own.y_hat[rows[0]] - last.y_hat[rows[1]], nan=np.inf)
        return _rms(np.where(np.isnan(y), y, away)) / _motion(y)


def _simulated(model: StateSpace | None, record: Record,
               trim: Literal['model', 'refit'] = 'refit') -> Validation | None:
    """Return what a model, if there is one, simulates of a record; offsets are fitted to it."""
    try:
        return None if model is None else simulation(model, record, trim=trim)
    except np.linalg.LinAlgError:  # of the data's making: no caller must die of it
        return None


@dataclass(frozen=True)
class _Test:
    """Fit of the last model on unseen data, and its error there over that on older data."""

    fit: Array
    ratio: Array
    start_ns: int = 0
    end_ns: int = 0


def _fresh(past: _Past, record: Record, last: Validation | None) -> _Test:
    """Test the last model on the part of a record that is later than its own window."""
    start_ns, end_ns = (record.epoch_ns + round(t * 1e9) for t in (record.start, record.end))
    none = _Test(np.full(record.ny, np.nan), np.full(record.ny, np.nan))
    found = _simulated(past.model, record, 'model') if past.end_ns < end_ns else None
    if found is None or last is None:
        return none
    seen = (past.end_ns - record.epoch_ns) * 1e-9 + _SAME_STAMP
    fit = 100.0 * (1.0 - _rms(_errors(found)[found.times > seen]) / _motion(found.y))
    if np.isnan(fit).all():
        return none
    # Stretches as long as what is new, that last. What disturbs a plant slowly, or moves the zero
    # of a sensor, is no change of it: each has offsets of its own; and it varies from one to the
    # next. Where no older data are left that are as long, the model's own window tells.
    length = max(record.end - max(seen, record.start), _STRETCH * record.duration)
    count = max(int(_ROUNDED * record.duration / length), 1)
    edges = record.end - length * np.arange(count, 0, -1)
    *old, new = (_rms(own - _mean(own)) for own in np.split(
        _errors(last), np.searchsorted(last.times, edges))[1:])
    before = reduce(np.fmax, old) if old else past.error
    ratio = np.where(new > 0.0, new, np.nan) / np.where(before > 0.0, before, np.nan)
    return _Test(fit, ratio, max(start_ns, past.end_ns), end_ns)


def _motion(y: Array) -> Array:
    """Return the standard deviation of each output, where known; NaN if it does not move."""
    known = [own[~np.isnan(own)] for own in y.T]
    return np.array([np.std(own) if len(own) and np.ptp(own) > 0.0 else np.nan for own in known])


def _errors(found: Validation) -> Array:
    """Return the errors of each output, NaN where it has no sample."""
    with np.errstate(over='ignore', invalid='ignore'):
        return np.asarray(found.y - found.y_hat)


def _mean(values: Array) -> Array:
    """Return the mean of each column, where known."""
    with np.errstate(over='ignore', invalid='ignore'):
        return np.asarray(np.nansum(values, axis=0) / np.maximum(
            np.sum(~np.isnan(values), axis=0), 1))


def _rms(values: Array) -> Array:
    """Return the root mean square of each column, where known; NaN for too few."""
    number = np.sum(~np.isnan(values), axis=0)
    with np.errstate(over='ignore', invalid='ignore'):  # a model that explodes
        power = np.nansum(values ** 2, axis=0) / np.maximum(number, 1)
    return np.where(number >= _FEWEST, np.sqrt(power), np.nan)
