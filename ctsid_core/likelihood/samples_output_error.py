# SPDX-License-Identifier: Apache-2.0
"""
Maximum likelihood on the raw output samples, for measurement noise.

The samples are compared with what the model makes of the inputs from a free initial state, exact
for held inputs at any stamps. Nothing is interpolated: pauses and gaps only tell nothing. White
noise of each output's own level is assumed, as in `refine.py`, whose coordinates and steps these
are, and whose model is the start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.likelihood.levenberg_marquardt import (
    LEAST_DAMPING,
    NormalEquations,
    climb,
    normal_equations,
)
from ctsid_core.likelihood.prediction_errors import ROUNDING
from ctsid_core.likelihood.refine import MOST_WORK
from ctsid_core.linear.free_entries import GAUGE, FreeEntries
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.matrix_functions import svd
from ctsid_core.linear.tall_qr import triangle
from ctsid_core.linear.types import Array
from ctsid_core.model.mode_responses import (
    Responses,
    Stamps,
    derivatives,
    outputs,
    responses,
    stamps_of,
)
from ctsid_core.signals.record import Record

MOST_GROWTH = 5.0         # time constants for which an unstable pole may grow over the record
_PASSES = 2           # of a regression that weights outputs by what the last one left of them


@dataclass(frozen=True)
class InTime:
    """
    A model at the maximum of the likelihood of the raw samples.

    Parameters
    ----------
    matrices : Matrices
        Its `tail` (n, 1) is the state at the first output sample; K = 0.
    cost : float
        -2 log likelihood, up to a constant.
    variance : ndarray, shape (ny,)
        Of the measurement noise, from the residuals and corrected for what the fit has taken out
        of them.
    root : ndarray, shape (r, parameters)
        root^T root is the covariance of the entries of A, [B tail x_trim], C, [D y_trim].
    start : float
        Time of the first output sample [s].
    """

    matrices: Matrices
    cost: float
    variance: Array
    root: Array
    start: float


@dataclass(frozen=True)
class _Fit:
    responses: Responses
    errors: tuple[Array, ...]

    def power(self) -> Array:
        """Return the mean square of each output's errors, (ny,)."""
        with np.errstate(over='ignore'):                # of a step that is refused
            return np.concatenate([np.mean(e ** 2, axis=1) for e in self.errors])


@dataclass(frozen=True)
class _Likelihood:
    cost: float
    prediction: _Fit | None
    poles: NDArray[np.complex128]


def refine_in_time(record: Record, start: Matrices, delay: tuple[float, ...], *,
                   feedthrough: bool, limit: float = np.inf, steps: int = 15) -> InTime | None:
    """
    Take a model to the maximum of the likelihood of the raw output samples.

    Parameters
    ----------
    record : Record
    start : Matrices
        Of which A and C are the start, and the others only say whether there is a trim: they
        are found anew, for they are linear in the samples.
    delay : tuple of float, length nu
        Dead time of each input [s].
    feedthrough : bool
    limit : float
        Steps may not take the real part of a pole beyond this [rad/s].
    steps : int
        At most.

    Returns
    -------
    InTime or None
        None where there are too few samples, or too many for so large a model, where it grows by
        more than e^5 over the record, or where its poles coincide.

    References
    ----------
    Ljung, System Identification, 2nd edition, section 7.5 (output error); local coordinates:
    McKelvey, Helmersson and Ribarits 2004, Automatica 40.
    """
    stamps = stamps_of(record, delay, bool(start.x_trim.size))
    found = climb_in_time(stamps, start, feedthrough, limit=limit, steps=steps)
    return None if found is None else with_covariance(stamps, *found, feedthrough)


def climb_in_time(stamps: Stamps, start: Matrices, feedthrough: bool, *, limit: float = np.inf,
                  steps: int = 15, rival: float = np.inf) -> tuple[Matrices, float] | None:
    """
    Do the same, given the samples, without the covariance.

    Parameters
    ----------
    stamps : Stamps
    start : Matrices
    feedthrough : bool
    limit : float
        [rad/s]
    steps : int
    rival : float
        Cost of another model: given up as soon as it is clear that it will not be beaten.

    Returns
    -------
    model : Matrices
        Its `tail` is the state at the first output sample.
    cost : float
        -2 log likelihood. (Or None, as above, and if the rival is not beaten.)
    """
    model = replace(start, K=np.zeros_like(start.K), tail=np.zeros((len(start.A), 1)))
    length = float(stamps.times[-1] - stamps.times[0])
    entries, samples = FreeEntries.of(model, feedthrough), stamps.counts.sum()
    if not (entries.count < samples and samples * entries.count ** 2 < MOST_WORK
            and np.max(np.linalg.eigvals(model.A).real) * length < MOST_GROWTH):
        return None
    best = _linear(stamps, model, feedthrough)
    if best is None:
        return None
    floor = _floor(stamps)

    def likelihood(m: Matrices) -> _Likelihood:
        return _likelihood(stamps, m, floor)

    def curvature(m: Matrices, fit: _Fit) -> NormalEquations:
        return normal_equations(*_whitened(stamps, m, fit, feedthrough))

    found, cost = climb(best, likelihood, curvature, entries.moved,
                        limit=min(limit, MOST_GROWTH / length), steps=steps, damping=LEAST_DAMPING,
                        rival=rival)
    return (found, cost) if cost < rival else None


def _fit(stamps: Stamps, m: Matrices) -> _Fit | None:
    found = responses(stamps, m)
    if found is None:
        return None
    y = outputs(stamps, m, found)
    return _Fit(found, tuple(measured - y[channels][:, rows] for measured, (channels, rows) in
                             zip(stamps.y, stamps.streams, strict=True)))


def errors_in_time(stamps: Stamps, m: Matrices) -> tuple[Array, ...] | None:
    """Return what a model leaves of each output signal, (channels, N); None if it explodes."""
    if not len(m.A):
        y = np.hstack((m.D, m.y_trim)) @ stamps.drive[0][stamps.places].T
        return tuple(measured - y[channels][:, rows] for measured, (channels, rows) in
                     zip(stamps.y, stamps.streams, strict=True))
    fit = _fit(stamps, m)
    return fit.errors if fit is not None else None


def _floor(stamps: Stamps) -> Array:
    power = np.concatenate([np.mean(y ** 2, axis=1) for y in stamps.y])
    floor: Array = ROUNDING * power + 1e-300
    return floor


def _likelihood(stamps: Stamps, m: Matrices, floor: Array) -> _Likelihood:
    fit = _fit(stamps, m)
    if fit is None:
        return _Likelihood(np.inf, None, np.linalg.eigvals(m.A).astype(complex))
    cost = float(stamps.counts @ np.log(np.maximum(fit.power(), floor)))
    return _Likelihood(cost, fit, fit.responses.modes.values)


def _whitened(stamps: Stamps, m: Matrices, fit: _Fit, feedthrough: bool) -> tuple[Array, Array]:
    """Return Jacobian (parameters, samples) and errors (samples,), both over the noise."""
    size = np.sqrt(fit.power()) + 1e-150
    rows = derivatives(stamps, m, fit.responses, size, feedthrough)
    error = np.concatenate([row for e in fit.errors for row in e])
    return rows, error / np.repeat(size, stamps.counts.astype(int))


def _linear(stamps: Stamps, m: Matrices, feedthrough: bool) -> Matrices | None:
    """Return the model with the B, D, trims and initial state that are best at its A and C."""
    entries = FreeEntries.of(m, feedthrough)
    linear = entries.mask('B', 'tail', 'x_trim', 'D', 'y_trim')
    for _ in range(_PASSES):
        fit = _fit(stamps, m)
        if fit is None:
            return None
        rows, error = _whitened(stamps, m, fit, feedthrough)
        step = np.zeros(len(rows))
        step[linear] = least_norm(rows[linear], error[np.newaxis], 1e-9)[0]
        m = entries.moved(m, step)
    return m


def with_covariance(stamps: Stamps, m: Matrices, cost: float,
                    feedthrough: bool) -> InTime | None:
    """Return a model at the maximum with the covariance of its entries; None if it explodes."""
    fit = _fit(stamps, m)
    if fit is None:
        return None
    rows, error = _whitened(stamps, m, fit, feedthrough)
    norm = np.sqrt(np.einsum('ij,ij->i', rows, rows))
    norm[norm == 0.0] = np.inf
    _, s, right = svd(triangle((rows / norm[:, np.newaxis]).T))
    kept = s > GAUGE * s[0]
    spare = max(1.0 - float(np.count_nonzero(kept)) / len(error), len(m.C) / len(error))
    root = right[kept] / s[kept, np.newaxis] / norm / np.sqrt(spare)
    return InTime(m, cost, fit.power() / spare, root, float(stamps.times[0]))


def poles_in_time(found: InTime) -> tuple[NDArray[np.complex128], Array]:
    """
    Return poles and their standard deviations [rad/s].

    Returns
    -------
    poles : ndarray, shape (n,)
    deviation : ndarray, shape (n,)
        Square root of the expected |error|^2.
    """
    poles, vectors = np.linalg.eig(found.matrices.A)
    left = np.linalg.inv(vectors)
    change = np.stack([np.outer(left[i], vectors[:, i]).ravel() for i in range(len(poles))])
    deviation = np.linalg.norm(change @ found.root[:, :change.shape[1]].T, axis=1)
    return poles.astype(complex), deviation
