# SPDX-License-Identifier: Apache-2.0
"""
Plants that simulations cannot tell: by one-step predictions of the raw samples.

An unstable plant under its controller, or one whose disturbances outweigh its inputs, is not
explained by any simulation. Its predictor is stable, and it is a simulation, too, from inputs and
from the outputs' own past, held from sample to sample:

    dz/dt = Abar z + Bbar u(t - d) + Kbar y_held,      y_hat = C z + y0.                     (1)

So prediction errors are output errors with further inputs, found and refined by the same search.
From sample to sample, h apart, (1) is z+ = e^(Abar h) z + L y + ..., and the plant's own
transition is e^(A h) = e^(Abar h) + L C, which gives A; B and the continuous gain K follow.

References
----------
Ljung, System Identification, 2nd edition, sections 4.3, 7.2 and 13.4 (closed loop).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import warnings

import numpy as np
from scipy.linalg import logm

from ctsid_core.likelihood.modal_model import canonical
from ctsid_core.likelihood.mode_columns import columns_of, least_cost
from ctsid_core.likelihood.noise_gain import continuous_gain, predicted_states, states_with_gaps
from ctsid_core.likelihood.output_error import Fit, Free, Guess, climb_roughly, fit_at, fit_states
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import matrices_of
from ctsid_core.linear.matrix_functions import change_of, exponentials, phi
from ctsid_core.linear.types import Array, ComplexArray, Mask, Matrices
from ctsid_core.model.covariance import Entries
from ctsid_core.model.simulation import respond
from ctsid_core.search.by_order import SEARCHED, affordable, nearest
from ctsid_core.search.direct import without_needless
from ctsid_core.search.own_past import (
    HORIZONS,
    Lost,
    after_samples,
    carried_on,
    foretold,
    held_interval,
    lost_of,
    with_own_past,
)
from ctsid_core.search.past_regression import Start, regressed
from ctsid_core.search.solution import GROWS
from ctsid_core.search.tried import LEAST, SEARCH, Tried, parameters, price, tried
from ctsid_core.signals.record import Record

_NOISES = 8                 # powers of noise in a plant, as far as its filters are tried, ...
_HALVINGS = 2               # ... and how often closer ones are
_PLANT, _AHEAD = 2e7, 7e3   # work of a plant, and of its predictions for each sample
_FINAL = 2                  # orders that are climbed with all samples
_REFITS = 2                 # of a predictor that tells itself what was lost
_FORGETS = 10.0             # times e, that predictors forget their start within the record
_QUICK = 0.05               # radians in a sample interval: the slowest that climbs from it find
_MIRRORED = 0.5             # of the fastest pole that grows: as slow is a filter of its plant
_DIVERGED = 2.0             # error of a prediction over the motion, from which on it is none
_PARALLEL = 1e5             # condition of eigenvectors, beyond which they lose digits
_STABLE = 1e-9              # real part over size of the largest pole that is rounding


@dataclass(frozen=True, eq=False)
class PredictionFit:
    """A model by its predictions."""

    matrices: Matrices        # of the plant, outputs in their own units, at rest
    samples: Samples          # with the outputs' own past among the inputs
    found: Tried              # the predictor (1), of these
    free: Free
    errors: Array             # (horizons, ny): of predictions on the last record, over the motion
    information: float        # Schwarz's criterion, by which orders are compared
    orders: dict[int, Tried]  # all that were tried
    others: tuple[PredictionFit, ...] = ()      # that were compared with it in the end


@dataclass(frozen=True)
class Compared:
    """A record that predictions are compared on: its place, and output rows that do not count."""

    place: int
    record: Record
    corrupt: tuple[Mask | None, ...]


def solve_by_prediction(samples: Samples, free: Free, *, order: int, max_order: int,
                        known_delay: Array, last: Compared) -> PredictionFit | None:
    """Return the model that predicts the samples best, or None; orders are compared on `last`."""
    joint = with_own_past(samples)
    lost = lost_of(joint)
    joint = after_samples(joint)
    own = replace(free, feedthrough=False, delays=free.delays + (False,) * samples.ny,
                  limit=-_FORGETS / samples.length)
    starts = regressed(joint, order or max_order, known_delay, own)
    if not starts or order not in (0, *starts):
        return None
    thin = joint.thinned(affordable(joint)).thinned(SEARCHED)
    begun, regression = _begun(thin, {order: starts[order]} if order else starts, own)
    found = _orders(thin, begun, own, last)
    likely = sorted(found.values(), key=lambda one: one.information)[:_FINAL]
    if thin is not joint and likely:
        joint = joint.thinned(affordable(joint, likely[0].found.fit.model.n))
    orders = {n: one.found for n, one in found.items()}
    straight = None if regression is None else _as_it_is(joint, regression, own, last)
    known = [] if straight is None else [straight]
    for one in likely:
        fit, final = one.found.fit, _judged if joint.effort.beyond(SEARCH) else _nearby
        climbed = one if joint is thin else final(
            joint, fit_at(joint, *fit.model.nonlinear, one.free, fit), one.free, last)
        known += [] if climbed is None else [_foretold(climbed, lost, last) if lost else climbed]
    if not known:
        return None
    # As they are used: the filter starts from the first samples, not from the best states.
    def as_used(one: PredictionFit) -> float:
        return information(one.errors, joint.counts.sum(axis=0), one.found.parameters)

    best = min(known, key=as_used)
    if best is straight:                    # its dead times were compared with none
        orders[best.found.fit.model.n] = best.found
    else:
        # One sample ahead any error is small where samples are dense.
        needed, fewer = without_needless(best.samples, best.found, best.free, 0.0, each=False)
        other = replace(best, free=fewer) if needed is best.found else \
            _judged(best.samples, needed.fit, fewer, last)
        # Far ahead a dead time may show that hardly does one sample ahead.
        if other is not None:
            known = [other, *(one for one in known if one is not best or needed is not one.found)]
            best = min(other, best, key=as_used)
    return replace(best, orders=orders, others=tuple(one for one in known if one is not best))


def _begun(joint: Samples, starts: dict[int, Start],
           free: Free) -> tuple[dict[int, Fit], Start | None]:
    """Return where climbs begin, of every order, and the likeliest start as it is."""
    begun: dict[int, Fit] = {}
    score: dict[int, float] = {}
    power = np.ones((len(joint.records), joint.ny))
    for n, start in starts.items():
        poles, delay = start.model.nonlinear
        columns = columns_of(joint, poles, delay, direct=False, slopes=False)
        with suppress(np.linalg.LinAlgError):
            begun[n] = fit_at(joint, poles, delay, free, Guess(start.model, power), columns)
            score[n] = fit_states(joint, start.model, free, columns).cost + price(joint) * (
                start.parameters + n * len(power))
    return begun, starts[min(score, key=lambda n: score[n])] if score else None


def _as_it_is(joint: Samples, start: Start, free: Free, last: Compared) -> PredictionFit | None:
    """Return the predictor of the regression as it is, or None."""
    with suppress(np.linalg.LinAlgError):
        fit = fit_states(joint, start.model, free)
        free = replace(free, delays=tuple((start.model.delay > 0.0) & free.delays))
        weights = fit.model.n * (joint.nu + joint.ny)
        return _judged(joint, fit, free, last, round(start.parameters) - weights)
    return None


def _orders(joint: Samples, begun: dict[int, Fit], free: Free,
            last: Compared) -> dict[int, PredictionFit]:
    """Return predictors of the orders next to that whose start predicts best."""
    best = min(begun, key=lambda n: begun[n].cost + price(joint) * parameters(
        joint, begun[n], free), default=0)
    found: dict[int, PredictionFit] = {}
    looked: set[int] = set()
    while not found or not joint.effort.beyond(SEARCH):
        n = nearest(begun, looked, best)
        if not n:
            break
        looked.add(n)
        one = _climbed(joint, begun[n], free, last)
        if one is not None:
            found[n] = one
            best = min(found, key=lambda n: found[n].information)
    return found


def _climbed(joint: Samples, start: Fit, free: Free, last: Compared) -> PredictionFit | None:
    """Return the best predictor near a start or near a filter of its plant; None: no plant."""
    # Slower than what the regression sees are filters alone, and of a plant that grows not much
    # slower than that, for a growing pole is mirrored: else states fit what is before the record,
    # and mislead elsewhere.
    quick = replace(free, limit=min(free.limit, -_QUICK / held_interval(joint)))
    best = _nearby(joint, start, quick, last)
    if best is None or joint.effort.beyond(SEARCH):
        return best
    growth = float(np.max(np.linalg.eigvals(best.matrices.A).real))
    if growth * joint.length > GROWS:
        free = replace(free, limit=min(free.limit, -_MIRRORED * growth))
    filtered = _filter(joint, best, free)
    other = _nearby(joint, filtered, free, last) if filtered is not None else None
    return min((one for one in (best, other) if one is not None), key=lambda one: one.information)


def _nearby(joint: Samples, start: Fit, free: Free, last: Compared) -> PredictionFit | None:
    """Return the likeliest predictor near a start; the start, if that one is of no plant."""
    top = start
    with suppress(np.linalg.LinAlgError):
        top = climb_roughly(joint, start, free)
    return _judged(joint, top, free, last) \
        or (None if top is start else _judged(joint, start, free, last))


def _foretold(one: PredictionFit, lost: Lost, last: Compared) -> PredictionFit:
    """Return the likeliest predictor that itself tells what was lost of the own past."""
    for _ in range(0 if one.samples.effort.beyond(SEARCH) else _REFITS):
        fit, joint = one.found.fit, foretold(one.samples, one.found.fit, lost)
        with suppress(np.linalg.LinAlgError):
            start = fit_at(joint, *fit.model.nonlinear, one.free, fit)
            one = _nearby(joint, start, one.free, last) or one
    return one


def _filter(joint: Samples, one: PredictionFit, free: Free) -> Fit | None:
    """Return the likeliest Kalman filter of a plant that noise moves as inputs do, if likelier."""
    # The noise at each input has the same effect on the outputs, over the frequencies looked at.
    # Predictors may be slower than the past of the regression, and climbs end before they are
    # there. With no noise in the plant poles are its own, those that grow mirrored.
    m, n = one.matrices, len(one.matrices.A)
    C = m.C / joint.size[:, np.newaxis]
    omega = np.geomspace(1.0 / joint.length, 1.0 / held_interval(joint), _NOISES)
    try:
        responses = C @ np.linalg.solve(1j * omega[:, np.newaxis, np.newaxis] * np.eye(n) - m.A,
                                        m.B[np.newaxis])
    except np.linalg.LinAlgError:
        return None
    size = np.maximum(np.linalg.norm(responses, axis=(0, 1)), 1e-300)
    moved, seen = (m.B / size) @ (m.B / size).T, C.T @ C
    known: dict[float, tuple[float, ComplexArray]] = {}
    delay = one.found.fit.model.delay

    def at(noise: float) -> float:
        if noise not in known:
            both = np.linalg.eigvals(np.block([[m.A.T, -seen], [-noise * moved, -m.A]]))
            poles = np.sort_complex(both)[:n]
            stable = bool(np.all(poles.real < free.limit))          # not if any is no number
            known[noise] = least_cost(columns_of(
                joint, canonical(poles), delay, direct=False, slopes=False), free.trim) \
                if stable else np.inf, poles
        return known[noise][0]

    noises = np.sort(np.linalg.norm(responses / size, 2, axis=(1, 2)) ** -2.0)
    step = np.sqrt(noises[1:] / noises[:-1]).mean()
    best = min((0.0, *noises.tolist()), key=at)
    for _ in range(_HALVINGS):
        best = min((best / step, best, best * step), key=at)
        step = np.sqrt(step)
    if np.isfinite(at(best)):
        with suppress(np.linalg.LinAlgError):
            fit = fit_at(joint, known[best][1], delay, free)
            return fit if fit.cost < one.found.fit.cost else None
    return None


def _judged(joint: Samples, fit: Fit, free: Free, last: Compared,
            more: int = 0) -> PredictionFit | None:
    """Return a predictor and how its plant predicts; None: there is no plant that does."""
    # So many `more` numbers than are free were determined.
    one = tried(joint, fit, free)
    one = replace(one, parameters=one.parameters + more)
    delay, nu = fit.model.delay, joint.nu - joint.ny
    # One sample ahead the likelihood itself says it, with the initial states that suit it best.
    likely = np.sqrt(joint.mean(fit.power))
    known: list[PredictionFit] = []
    for limit in (np.inf, 0.0):
        plant = plant_of(fit, joint, last.place, limit)
        if plant is None:
            continue
        joint.effort.spend(_PLANT + _AHEAD * max(len(s.time) for s in last.record.outputs))
        try:
            errors = prediction_errors(plant, delay[:nu], last)
        except np.linalg.LinAlgError:
            continue
        if np.max(errors) < _DIVERGED:
            known.append(PredictionFit(plant, joint, one, free, errors, information(
                np.vstack((likely, errors[1:])), joint.counts.sum(axis=0), one.parameters), {}))
        if is_stable(plant):
            break
    # Far ahead shows whether a mode really grows.
    return min(known, key=lambda fit: fit.information, default=None)


def information(errors: Array, counts: Array, parameters: int = 0) -> float:
    """
    Return Schwarz's criterion of predictions so many samples ahead, all horizons together.

    The least is most likely. Errors h samples ahead are alike for h samples, so that one of h is
    independent, of those that are counted of each output. They are root mean squares at the first
    of `HORIZONS`, (horizons, ny); those below `LEAST` are no evidence.
    """
    counts = counts / np.array(HORIZONS[:len(errors)])[:, np.newaxis]
    return float(2.0 * np.sum(counts * np.log(np.maximum(errors, LEAST)))) \
        + float(np.log(counts[0].max())) * parameters


def is_stable(plant: Matrices) -> bool:
    """Return whether no mode of a plant grows."""
    poles = np.linalg.eigvals(plant.A)
    return bool(np.all(poles.real <= _STABLE * np.max(np.abs(poles), initial=0.0)))


def plant_of(fit: Fit, samples: Samples, record: int, limit: float, *,
             predicts: bool = True) -> Matrices | None:
    """
    Return the plant of a predictor (1), with the trim of a record; None if there is none.

    What only simulates needs no filter and has no K; modes that alternate decay there as fast.

    Modes whose poles have a real part beyond `limit` are put there. That of simulations is just
    beside 0: then initial state and trim make the ramp that an offset of an input makes of an
    integrator; at 0 both are constants.
    """
    m, ny = matrices_of(fit.model, samples.size, record), samples.ny
    nu = samples.nu - ny
    step = held_interval(samples)
    K = m.B[:, nu:] / samples.size                          # outputs were over their size
    try:
        moved, held = _from_sample_to_sample(m.A, K, m.C, step)
        found = _logarithm(moved) / step
        if predicts and np.abs(found.imag).max() > 1e-6 * np.abs(found).max():
            return None                        # of no plant whose numbers are real
        A = found.real
        values, right = np.linalg.eig(A)
        beyond = values.real > limit
        if beyond.any():
            values = np.where(beyond, limit + 1j * values.imag, values)
            A = np.real(right @ np.diag(values) @ np.linalg.inv(right))
        transition, integral = (x[0] for x in exponentials(A, np.array([step]), 1))
        back = np.linalg.solve(integral, held)
        drive = back @ K                       # of the innovations
        gain = continuous_gain(A, m.C, np.linalg.solve(transition, integral @ drive), step) \
            if predicts else m.K
        if predicts and not np.all(np.linalg.eigvals(A - gain @ m.C).real < 0.0):
            return None                        # it predicts at these samples' rate, at no other
    except np.linalg.LinAlgError:
        return None
    return replace(m, A=A, B=back @ m.B[:, :nu], D=m.D[:, :nu], K=gain, x_trim=drive @ m.y_trim,
                   start=np.zeros_like(m.start))


def in_record(plant: Matrices, fit: Fit, samples: Samples, record: int) -> Matrices:
    """Return the plant of a predictor with the trim of another record."""
    return plant_of(fit, samples, record, 0.0 if is_stable(plant) else np.inf) or plant


def _from_sample_to_sample(A: Array, K: Array, C: Array, step: float) -> tuple[Array, Array]:
    """Return the plant's transition, and what a constant makes of the predictor's states in it."""
    transition, integral = (x[0] for x in exponentials(A, np.array([step]), 1))
    return transition + integral @ K @ C, integral


def _logarithm(transition: Array) -> ComplexArray:
    """Return the principal logarithm, by eigenvectors unless these are nearly parallel."""
    values, right = np.linalg.eig(transition)
    if np.linalg.cond(right) < _PARALLEL and np.all(values != 0.0):
        return np.asarray((right * np.log(values.astype(complex))) @ np.linalg.inv(right))
    with warnings.catch_warnings():                 # it judges its own accuracy too strictly
        warnings.simplefilter('ignore', RuntimeWarning)
        try:
            return np.asarray(logm(transition), dtype=complex)
        except ValueError as error:
            raise np.linalg.LinAlgError(f'a transition has no logarithm: {error}') from error


def prediction_errors(m: Matrices, delay: Array, last: Compared, *, simulates: bool = False,
                      horizons: Sequence[int] = HORIZONS) -> Array:
    """
    Return rms errors of predictions some samples ahead, over the motion, (horizons, ny).

    The first tenth of the record starts the filter and does not count. Of what `simulates` the
    state at its start is known: a filter without gain would never learn it. Infinite if the filter
    is not stable. Errors as many samples ahead are alike over as many: horizons beyond half of a
    short record, the last ones, are left out.
    """
    record = last.record
    rarest = max(range(len(record.outputs)), key=lambda i: record.outputs[i].period)
    seen = record.outputs[rarest].time
    seen = seen[(seen >= record.start) & (seen <= record.end)]
    step = float(np.median(np.diff(seen)))
    t, y = carried_on(seen, np.column_stack([
        np.interp(seen, s.time[rows], column[rows]) for s, bad in zip(
            record.outputs, last.corrupt, strict=True)
        for rows in [slice(None) if bad is None else ~bad] for column in s.values.T]))
    real = np.isin(t, seen)
    motion = np.std(y[real], axis=0)
    motion[motion == 0.0] = np.inf                 # of an output at rest nothing is asked
    with np.errstate(over='ignore', invalid='ignore'):
        if not simulates:
            x, u = respond(m.A, m.B, m.x_trim, record.inputs, delay.tolist(), t, None)
        else:
            x, u = (rows[1:] for rows in respond(
                m.A, m.B, m.x_trim, record.inputs, delay.tolist(), np.append(record.start, t),
                m.start))
        rest = y - x @ m.C.T - u @ m.D.T - m.y_trim
        F = exponentials(m.A, np.array([step]), 0)[0][0]
        closed = m.A - m.K @ m.C
        M = exponentials(closed, np.array([step]), 1)[1][0] @ m.K
        errors, first = [], len(t) // 10
        start = 0 if simulates else first
        states = predicted_states(F, F @ M, m.C, rest, start) if real.all() else \
            states_with_gaps(F, F @ M, m.C, rest, real, start)
        for horizon in [h for h in horizons if 2 * h <= len(t)]:
            ahead = np.linalg.matrix_power(F, horizon - 1)
            e = rest[horizon - 1:] - states[:len(rest) - horizon + 1] @ (m.C @ ahead).T
            e = e[max(first - horizon, 0):][real[horizon - 1:][max(first - horizon, 0):]]
            errors.append(np.sqrt(np.mean(e ** 2, axis=0)) / motion)
    found = np.array(errors)
    return np.where(np.isfinite(found), found, np.inf)


def changes_of_plant(samples: Samples, fit: Fit, changes: Entries) -> Entries:
    """Return changes of A, B, C and dead times of the plant, from those of its predictor (1)."""
    # Those of modes as they are found: on the axis they would not move, and seem to be known.
    m, nu, step = matrices_of(fit.model, samples.size), samples.nu - samples.ny, \
        held_interval(samples)
    K, dK = m.B[:, nu:] / samples.size, changes.B[:, :, nu:] / samples.size

    def grown(z: ComplexArray) -> ComplexArray:
        return phi(step * z, 0)[0]

    def summed(z: ComplexArray) -> ComplexArray:
        return step * phi(step * z, 1)[1]

    def slope(z: ComplexArray) -> ComplexArray:
        _, one, two = phi(step * z, 2)
        return step ** 2 * (one - two)

    moved, integral = _from_sample_to_sample(m.A, K, m.C, step)
    plant = np.real(_logarithm(moved)) / step
    of_integral = change_of(m.A, changes.A, summed, slope)
    of_moved = change_of(m.A, changes.A, grown, lambda z: step * grown(z)) \
        + of_integral @ K @ m.C + integral @ (dK @ m.C + K @ changes.C)
    A = change_of(moved, of_moved, np.log, np.reciprocal) / step
    own = exponentials(plant, np.array([step]), 1)[1][0]
    back = np.linalg.solve(own, integral)
    of_back = np.linalg.solve(own, of_integral - change_of(plant, A, summed, slope) @ back)
    return Entries(A, of_back @ m.B[:, :nu] + back @ changes.B[:, :, :nu], changes.C,
                   changes.D[:, :, :nu], changes.delay[:, :nu])
