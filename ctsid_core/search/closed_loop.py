# SPDX-License-Identifier: Apache-2.0
"""
Unstable plants with process noise: identified by predictions of the raw samples.

An unstable plant is flown under a controller, and process noise comes round the loop in its
inputs. The likelihood of lines is then that of a loop whose controller it does not know, and may
prefer the controller's inverse to the plant. One-step predictions of the samples
(`likelihood/samples_prediction_error.py`) are free of that: they choose the
order and place the poles.
"""

from __future__ import annotations

import numpy as np

from ctsid_core.bases.projection import Projection
from ctsid_core.likelihood.process_noise import with_linear_entries
from ctsid_core.likelihood.samples_prediction_error import (
    Predictor,
    Samples,
    continuous_gain,
    likeliest,
    refine_in_time,
    uniform_samples,
)
from ctsid_core.linear.matrices import Matrices
from ctsid_core.model.statespace import StateSpace
from ctsid_core.search.order import Search
from ctsid_core.signals.record import Record

_GLANCE = 6           # steps of the orders that are compared
_LARGEST = 3e7        # samples times outputs times parameters squared: more takes too long


def by_prediction(record: Record, search: Search, found: Matrices) -> Matrices | None:
    """
    Return the model with the best one-step predictions of the samples of an unstable plant.

    Parameters
    ----------
    record : Record
        What was projected.
    search : Search
        Its subspace models, from which it starts; if its settings have an order, that is kept.
    found : Matrices
        The likeliest model of the lines, from which it starts, too.

    Returns
    -------
    Matrices or None
        None where this is not called for: without unstable models, with feedthrough, or if
        outputs are not sampled uniformly and at the same instants.
    """
    settings, n = search.settings, len(found.A)
    samples = uniform_samples(record)
    if settings.feedthrough or samples is None or not _affordable(samples, n) \
            or not _unstable(search, n, found):
        return None
    best, least = None, np.inf
    for order in [settings.order] if settings.order else range(1, settings.max_order + 1):
        trial = _likeliest(record, search, samples, order, found)
        value = np.inf if trial is None else trial[1] + _price(samples, trial[0].model)
        if trial is not None and value < least:
            best, least = trial[0], value
        elif best is not None:
            break
    if best is None or np.max(best.model.poles.real) <= search.resolution:
        return None
    best, _ = refine_in_time(samples, best, feedthrough=False, trim=settings.trim)
    return to_matrices(search.projection, best, samples.step, trim=settings.trim)


def _unstable(search: Search, n: int, found: Matrices) -> bool:
    """Return whether there are models at all with a pole that grows within the window."""
    poles = [np.linalg.eigvals(found.A)]
    poles += [c.poles for c in search.candidates(n, search.subspaces.some_tunings(n))]
    fastest = max(float(np.max(p.real)) for p in poles)
    return fastest > search.resolution


def _affordable(samples: Samples, n: int) -> bool:
    ny, nu = samples.y.shape[1], sum(signal.width for signal in samples.inputs)
    parameters = n * (3 + nu + 2 * ny) + ny * (nu + 1)
    return bool(samples.y.size * parameters ** 2 < _LARGEST)


def _price(samples: Samples, model: StateSpace) -> float:
    """Return what Schwarz's criterion charges."""
    n, nu, ny = model.n, model.nu, model.ny
    return float((n * (nu + 2 * ny + 1) + ny) * np.log(samples.y.size))


def _likeliest(record: Record, search: Search, samples: Samples, order: int,
               found: Matrices) -> tuple[Predictor, float] | None:
    starts = [c.matrices for c in search.candidates(order, search.subspaces.some_tunings(order))]
    if len(found.A) == order:
        starts.append(found)
    delay = search.settings.delays(record.nu)
    return likeliest(samples, [to_statespace(m, delay) for m in starts], feedthrough=False,
                     trim=search.settings.trim, steps=_GLANCE)


def to_statespace(m: Matrices, delay: tuple[float, ...]) -> StateSpace:
    """Return the model of matrices of the projected domain."""
    n, ny = len(m.A), len(m.C)
    return StateSpace(m.A, m.B, m.C, m.D, m.K, delay,
                      x_trim=m.x_trim[:, 0] if m.x_trim.size else np.zeros(n),
                      y_trim=m.y_trim[:, 0] if m.y_trim.size else np.zeros(ny))


def to_matrices(projection: Projection, p: Predictor, step: float, *,
                trim: bool) -> Matrices | None:
    """Return a predictor's model in the projected domain, with its tail; None if it has none."""
    model, K = p.model, continuous_gain(p.model, p.L, step)
    if not np.isfinite(K).all():
        return None
    ones = len(projection.ones) * trim
    m = Matrices(
        A=model.A, B=model.B, C=model.C, D=model.D, K=K,
        tail=np.zeros((model.n, len(projection.tail))),
        x_trim=np.repeat(model.x_trim[:, np.newaxis], ones, axis=1),
        y_trim=np.repeat(model.y_trim[:, np.newaxis], ones, axis=1))
    return with_linear_entries(projection, m, feedthrough=False, ends_only=True)
