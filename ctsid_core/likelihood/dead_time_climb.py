# SPDX-License-Identifier: Apache-2.0
"""
The joint maximum of the likelihood over a model and its dead times.

At the maximum over A, B, C, D (and K) for given dead times d, the slope of the likelihood by d is
that of the inputs' lines alone, and its curvature is a Schur complement: with the columns F of the
model's Jacobian and c of the dead times', whitened,

    step d = (c' (1 - P) c)^-1 c' E,      P the projector on F,      step model = -F^+ c step d.

The model climbs again after each step, from where that leaves it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.projection import Projection
from ctsid_core.likelihood.delay_columns import delay_columns
from ctsid_core.likelihood.prediction_errors import (
    innovation_cost,
    jacobian,
    output_error_cost,
    predict,
)
from ctsid_core.likelihood.refine import (
    by_parameter,
    growth,
    refine_innovation,
    refine_output_error,
    whitener,
)
from ctsid_core.linear.free_entries import GAUGE, FreeEntries
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.matrix_functions import svd
from ctsid_core.linear.resolvent import resolvent
from ctsid_core.linear.types import Array

_ROUNDS = 8
_HALVINGS = 4
_CLIMB = 6            # steps of the model after each step of the dead times
_ARRIVED = 1e-3       # promised gain of -2 log likelihood that is not worth a step


@dataclass(frozen=True)
class Climbed:
    """
    A model and its dead times.

    Parameters
    ----------
    matrices : Matrices
    delays : ndarray, shape (nu,)
        [s]
    cost : float
        -2 log likelihood.
    """

    matrices: Matrices
    delays: Array
    cost: float


def climb_jointly(at: Callable[[Array], Projection], start: Matrices, delays: Array, *,
                  feedthrough: bool, process_noise: bool, longest: float) -> Climbed:
    """
    Take a model and its dead times to the joint maximum of the likelihood.

    Parameters
    ----------
    at : callable
        From dead times to the projection with them, with `slopes`.
    start : Matrices
        At the maximum for the given dead times, or near it.
    delays : ndarray, shape (nu,)
        [s]; those without a slope stay.
    feedthrough, process_noise : bool
        Whether D is free; whether the likelihood is the innovation form's.
    longest : float
        That a dead time may become [s].
    """
    projection = at(delays)
    m = start if process_noise else replace(start, K=np.zeros_like(start.K))
    cost = innovation_cost(projection, m) if process_noise else output_error_cost(projection, m)
    here = Climbed(m, delays, cost)
    for _ in range(_ROUNDS):
        step, along, promise = _step(projection, here.matrices, feedthrough, process_noise)
        if not promise > _ARRIVED:
            break
        for halving in range(_HALVINGS):
            part = 0.5 ** halving
            there = np.clip(here.delays + part * step, 0.0, longest)
            beside = at(there)
            entries = FreeEntries.of(here.matrices, feedthrough, noise=process_noise)
            trial = entries.moved(here.matrices, part * along)
            limit = max(growth(here.matrices), 1.0 / (projection.end - projection.start))
            refine = refine_innovation if process_noise else refine_output_error
            m, cost = refine(beside, trial, feedthrough, limit=limit, steps=_CLIMB)
            if cost < here.cost:
                break
        else:
            break
        gain = here.cost - cost
        projection, here = beside, Climbed(m, there, cost)
        if gain < _ARRIVED:
            break
    return here


def _step(projection: Projection, m: Matrices, feedthrough: bool,
          process_noise: bool) -> tuple[Array, Array, float]:
    """Return the steps of dead times and model, and the gain they promise."""
    closed = resolvent(m.A - m.K @ m.C, projection.s)
    prediction = predict(projection, m, closed)
    whiten, error = whitener(projection, m)
    if not process_noise:       # a simulation's errors count as independent of each other
        whiten = np.diag(np.sqrt(projection.count / np.sum(error ** 2 + 1e-300, axis=1)))
    columns = by_parameter(jacobian(
        projection, m, feedthrough, with_noise=process_noise, whiten=whiten,
        prediction=prediction)).T
    late, error = delay_columns(projection, m, whiten, closed), (whiten @ error).ravel()
    moves = np.any(late != 0.0, axis=0)
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0.0] = np.inf
    q, r = np.linalg.qr(columns / norm)
    left, s, right = svd(r)
    kept = s > GAUGE * s[0]
    basis = q @ left[:, kept]
    inside = basis.T @ late[:, moves]
    beyond = late[:, moves] - basis @ inside
    found = np.linalg.lstsq(beyond.T @ beyond, late[:, moves].T @ error, rcond=1e-12)[0]
    step = np.zeros(late.shape[1])
    step[moves] = found
    along = -(right[kept].T @ ((inside @ found) / s[kept])) / norm
    return step, along, float((late[:, moves].T @ error) @ found)
