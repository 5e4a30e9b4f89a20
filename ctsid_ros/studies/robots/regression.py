# SPDX-License-Identifier: Apache-2.0
"""Ridge regression of each horizon: what any model of a robot in flight is held against."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import prediction
from ctsid_core.signals.record import Record
from ctsid_ros.studies.robots.experiment import Experiment

HORIZONS = (1, 10, 50)          # samples of the outputs
PAST = 20                       # samples that it knows of
STRENGTHS = tuple(10.0 ** power for power in range(-7, 2))


def _means(record: Record) -> Array:
    """Return each input's mean from each output's stamp to the next one's (N, nu)."""
    held, times = record.inputs[0], record.outputs[0].time
    whole = np.vstack((np.zeros(held.width), np.cumsum(
        np.diff(held.time)[:, np.newaxis] * held.values[:-1], axis=0)))
    place = np.clip(np.searchsorted(held.time, times, side='right') - 1, 0, None)
    until = whole[place] + (times - held.time[place])[:, np.newaxis] * held.values[place]
    means = np.diff(until, axis=0) / np.diff(times)[:, np.newaxis]
    return np.vstack((means, means[-1:]))


def _rows(record: Record, horizon: int) -> tuple[Array, Array]:
    """Return what is known for each prediction, and the samples that are predicted."""
    y, u = record.outputs[0].values, _means(record)
    origin = np.arange(PAST, len(y) - horizon)
    known = [y[origin - i] for i in range(PAST)] + [u[origin - i] for i in range(1, PAST + 1)]
    known += [u[origin + i] for i in range(horizon)]
    return np.hstack(known), y[origin + horizon]


def _trained(known: Array, wanted: Array, strengths: Sequence[float]) -> list[Array]:
    gram, right = known.T @ known, known.T @ wanted
    return [np.linalg.solve(gram + s * len(known) * np.eye(len(gram)), right)
            for s in strengths]


def regressed(train: Record, test: Record, horizon: int) -> Array:
    """
    Return the predictions of a ridge regression, NaN at the first samples (N, ny).

    Its strength is chosen on the last quarter of the record that it is trained with.
    """
    known, wanted = _rows(train, horizon)
    middle, size = known.mean(axis=0), known.std(axis=0) + 1e-12
    known, mean = (known - middle) / size, wanted.mean(axis=0)
    first = 3 * len(known) // 4
    tried = _trained(known[:first], (wanted - mean)[:first], STRENGTHS)
    errors = [np.mean(((known @ w + mean - wanted) / wanted.std(axis=0))[first:] ** 2)
              for w in tried]
    weights = _trained(known, wanted - mean, [STRENGTHS[int(np.argmin(errors))]])[0]
    other, goal = _rows(test, horizon)
    found = np.full_like(test.outputs[0].values, np.nan)
    found[PAST + horizon:PAST + horizon + len(goal)] = (other - middle) / size @ weights + mean
    return found


def predicted(model: StateSpace, test: Record, horizon: int) -> Array:
    """Return the predictions of a model: a filter of what has been measured, then free (N, ny)."""
    told = prediction(model, test, horizon)
    found = np.full_like(test.outputs[0].values, np.nan)
    found[np.searchsorted(test.outputs[0].time, told.times)] = told.y_hat
    return found


def error_of(found: Array, test: Record) -> float:
    """
    Return the root mean square of errors over the outputs' standard deviations.

    The first tenth of the record starts the filter; the longest horizon after it does not count
    either, so that all horizons are judged by the same samples.
    """
    y = test.outputs[0].values
    first = len(y) // 10 + max(HORIZONS) + PAST
    with np.errstate(over='ignore', invalid='ignore'):
        squares = np.mean(((found - y)[first:] / y.std(axis=0)) ** 2)
    return float(np.sqrt(squares)) if np.isfinite(squares) else np.inf


def regression_errors(train: Record, test: Record) -> tuple[float, ...]:
    """Return the errors of the regression of each horizon."""
    return tuple(error_of(regressed(train, test, h), test) for h in HORIZONS)


def prediction_reach(given: Experiment) -> tuple[float, ...]:
    """Return the errors of the regression at each horizon, then those of the true filter."""
    assert given.test is not None
    assert given.truth is not None
    found = regression_errors(given.record, given.test)
    return (*found, *prediction_errors(given.truth, given.test))


def prediction_errors(model: StateSpace, test: Record) -> tuple[float, ...]:
    """Return the errors of a model at each horizon."""
    return tuple(error_of(predicted(model, test, h), test) for h in HORIZONS)
