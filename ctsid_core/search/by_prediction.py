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

from dataclasses import dataclass, replace
import warnings

import numpy as np
from scipy.linalg import logm

from ctsid_core.effort import Effort
from ctsid_core.likelihood.noise_gain import continuous_gain, predicted_states, with_noise
from ctsid_core.likelihood.output_error import Fit, Free, climb, fit_at
from ctsid_core.likelihood.residuals import residuals
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import matrices_of
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.matrix_functions import exponentials
from ctsid_core.linear.types import Array, Mask
from ctsid_core.model.covariance import Entries
from ctsid_core.model.simulation import respond
from ctsid_core.search.by_order import SubspacePoles, Tried, choose, search_orders, tried
from ctsid_core.signals.record import Record, Signal

HORIZONS = (1, 10, 50)      # samples ahead
AHEAD = 1                   # place of the one whose fit is reported
_SHARE = 0.3                # of a record, at its end, that two kinds of model are compared on
_SEARCHED = 4000            # samples of a stream that they are made of then
_GROWTH = 3.0               # times e, that an unstable mode grows at least to be believed
_LITTLE = 1e-5              # relative step of a difference
_BETTER = 0.95              # geometric mean of the errors over these, over those of a simulation


@dataclass(frozen=True, eq=False)
class PredictionFit:
    """
    A model by its predictions.

    Parameters
    ----------
    matrices : Matrices
        Of the plant, outputs in their own units; `tail` is zero.
    samples : Samples
        With the outputs' own past among the inputs.
    found : Tried
        The predictor (1), of these.
    free : Free
    orders : dict of int to Tried
    """

    matrices: Matrices
    samples: Samples
    found: Tried
    free: Free
    orders: dict[int, Tried]


def solve_by_prediction(samples: Samples, free: Free, subspace: SubspacePoles, effort: Effort, *,
                        order: int, max_order: int, known_delay: Array) -> PredictionFit | None:
    """
    Return the model that predicts the samples best, or None.

    Parameters
    ----------
    samples : Samples
    free : Free
    subspace : callable
        From an order and dead times to the poles of predictors of HD-PBSID's models.
    effort : Effort
    order, max_order : int
    known_delay : ndarray, shape (nu,)
    """
    joint = with_own_past(samples)
    own = replace(free, feedthrough=False, delays=free.delays + (False,) * samples.ny)
    known = np.concatenate((known_delay, np.zeros(samples.ny)))
    orders = search_orders(joint, own, subspace, effort, order=order, max_order=max_order,
                           known_delay=known, enough=0.0)
    if not orders or order not in (0, *orders):
        return None
    found = orders[order or choose(orders, 0.0)]
    found = tried(joint, climb(joint, fit_at(
        joint, found.fit.model.poles, found.fit.model.delay, own, found.fit), own, effort), own)
    m = plant_of(found.fit, joint, len(joint.records) - 1)
    return None if m is None else PredictionFit(m, joint, found, own, orders)


def with_own_past(samples: Samples) -> Samples:
    """Return the samples with the outputs, held from each to the next, as further inputs."""
    records = tuple(replace(r, inputs=(*r.inputs, *(
        Signal(s.times, s.y, 'zoh') for s in r.streams))) for r in samples.records)
    return replace(samples, records=records, nu=samples.nu + samples.ny)


def plant_of(fit: Fit, samples: Samples, record: int) -> Matrices | None:
    """Return the plant of a predictor (1), with the trim of a record; None if there is none."""
    m, ny = matrices_of(fit.model, samples.size, record), samples.ny
    nu = samples.nu - ny
    step = sample_interval(samples)
    K = m.B[:, nu:] / samples.size                          # outputs were over their size
    try:
        A, B, drive = _open_loop(m.A, m.B[:, :nu], K, m.C, step, samples.length)
        if not np.isfinite(A).all():
            return None
        transition, integral = (x[0] for x in exponentials(A, np.array([step]), 1))
        gain = continuous_gain(A, m.C, np.linalg.solve(transition, integral @ drive), step)
    except np.linalg.LinAlgError:
        return None
    return replace(m, A=A, B=B, D=m.D[:, :nu], K=gain, x_trim=drive @ m.y_trim,
                   tail=np.zeros_like(m.tail))


def _open_loop(A: Array, B: Array, K: Array, C: Array, step: float,
               length: float) -> tuple[Array, Array, Array]:
    """Return A, B and the drive of the innovations of the plant, from its predictor (1)."""
    transition, integral = (x[0] for x in exponentials(A, np.array([step]), 1))
    with warnings.catch_warnings():                 # it judges its own accuracy too strictly
        warnings.simplefilter('ignore', RuntimeWarning)
        plant = np.asarray(logm(transition + integral @ K @ C)) / step
    if not np.isfinite(plant).all():
        raise np.linalg.LinAlgError('a transition of the plant has no logarithm')
    if np.abs(np.imag(plant)).max() > 1e-6 * np.abs(plant).max():
        raise np.linalg.LinAlgError('a transition of the plant has no real logarithm')
    plant = _proven(np.real(plant), length)
    back = np.linalg.solve(exponentials(plant, np.array([step]), 1)[1][0], integral)
    return plant, back @ B, back @ K


def sample_interval(samples: Samples) -> float:
    """Return the median interval of the slowest output [s]."""
    return max(float(np.median(np.diff(s.times))) for r in samples.records for s in r.streams)


def prediction_errors(m: Matrices, delay: Array, record: Record, horizons: tuple[int, ...],
                      corrupt: tuple[Mask | None, ...], since: float = -np.inf) -> Array:
    """
    Return rms errors of predictions so many samples ahead, over the motion, (horizons, ny).

    Parameters
    ----------
    m : Matrices
    delay : ndarray, shape (nu,)
        [s]
    record : Record
    horizons : tuple of int
    corrupt : tuple of (ndarray of bool or None)
        Rows of each output signal that do not count.
    since : float
        Predictions of earlier samples do not count [s].
    """
    slowest = max(range(len(record.outputs)), key=lambda i: record.outputs[i].period)
    t = record.outputs[slowest].time
    t = t[(t >= record.start) & (t <= record.end)]
    step = float(np.median(np.diff(t)))
    y = np.column_stack([
        np.interp(t, s.time[rows], column[rows]) for s, bad in zip(
            record.outputs, corrupt, strict=True)
        for rows in [slice(None) if bad is None else ~bad] for column in s.values.T])
    with np.errstate(over='ignore', invalid='ignore'):
        x, u = respond(m.A, m.B, m.x_trim[:, 0], record.inputs, delay.tolist(), t, None)
        rest = y - x @ m.C.T - u @ m.D.T - m.y_trim[:, 0]
        F = exponentials(m.A, np.array([step]), 0)[0][0]
        closed = m.A - m.K @ m.C
        M = exponentials(closed, np.array([step]), 1)[1][0] @ m.K
        states = predicted_states(F, F @ M, m.C, rest)
        errors, first = [], max(len(t) // 10, int(np.searchsorted(t, since)))
        for horizon in horizons:
            ahead = np.linalg.matrix_power(F, horizon - 1)
            e = rest[horizon - 1:] - states[:len(rest) - horizon + 1] @ (m.C @ ahead).T
            errors.append(np.sqrt(np.mean(e[max(first - horizon, 0):] ** 2, axis=0))
                          / np.std(y, axis=0))
    found = np.array(errors)
    return np.where(np.isfinite(found), found, np.inf)


def held_out_errors(found: PredictionFit, simulating: Fit, samples: Samples, free: Free,
                    record: Record, corrupt: tuple[Mask | None, ...], effort: Effort,
                    ) -> tuple[Array, Array]:
    """
    Return errors ahead on the last part of a record, of both models made of the first parts.

    Parameters
    ----------
    found : PredictionFit
    simulating : Fit
        An output-error model, whose noise is found after the plant.
    samples : Samples
        Of that.
    free : Free
        Of that.
    record : Record
        The last of the samples.
    corrupt : tuple of (ndarray of bool or None)
    effort : Effort
    """
    bounds = [(r.start, r.end - _SHARE * (r.end - r.start)) for r in samples.records]
    since, errors = bounds[-1][1], []
    early = found.samples.between(bounds).thinned(_SEARCHED)
    own = climb(early, fit_at(early, found.found.fit.model.poles, found.found.fit.model.delay,
                              found.free, found.found.fit), found.free, effort, steps=4)
    plant = plant_of(own, early, len(early.records) - 1)
    early = samples.between(bounds).thinned(_SEARCHED)
    other = climb(early, fit_at(early, simulating.model.poles, simulating.model.delay, free),
                  free, effort, steps=6)
    rival, _ = with_noise(early, other, residuals(early, other), len(early.records) - 1)
    for m, delay in ((plant, own.model.delay[:samples.nu]), (rival, other.model.delay)):
        errors.append(np.full((len(HORIZONS), samples.ny), np.inf) if m is None else
                      prediction_errors(m, delay, record, HORIZONS, corrupt, since))
    return errors[0], errors[1]


def predicts_better(one: Array, other: Array) -> bool:
    """Return whether predictions of the first are better by far than those of the second."""
    ratio = np.log(np.maximum(one, 1e-12) / np.maximum(other, 1e-12))
    return bool(np.exp(np.mean(np.clip(ratio, -3.0, 3.0))) < _BETTER)


def _proven(A: Array, length: float) -> Array:
    """Return A with the unstable modes that grow too little within the record put on the axis."""
    values, right = np.linalg.eig(A)
    doubtful = (values.real > 0.0) & (values.real * length < _GROWTH)
    if not doubtful.any():
        return A
    values = np.where(doubtful, 1j * values.imag, values)
    found: Array = np.real(right @ np.diag(values) @ np.linalg.inv(right))
    return found


def changes_of_plant(samples: Samples, fit: Fit, changes: Entries) -> Entries:
    """Return changes of A, B, C and dead times of the plant, from those of its predictor (1)."""
    m, nu, step = matrices_of(fit.model, samples.size), samples.nu - samples.ny, \
        sample_interval(samples)
    K = m.B[:, nu:] / samples.size
    found = []
    for k in range(len(changes.A)):
        size = max(float(np.max(np.abs(d))) / (float(np.max(np.abs(x))) + 1e-12)
                   for d, x in ((changes.A[k], m.A), (changes.B[k], m.B), (changes.C[k], m.C)))
        little = _LITTLE / max(size, 1e-12)
        sides = [_open_loop(m.A + h * changes.A[k], (m.B + h * changes.B[k])[:, :nu],
                            K + h * changes.B[k][:, nu:] / samples.size,
                            m.C + h * changes.C[k], step, samples.length)
                 for h in (little, -little)]
        found.append([(a - b) / (2.0 * little) for a, b in zip(*sides, strict=True)])
    A, B = (np.array([f[i] for f in found]) for i in (0, 1))
    return Entries(A, B, changes.C, changes.D[:, :, :nu], changes.delay[:, :nu])
