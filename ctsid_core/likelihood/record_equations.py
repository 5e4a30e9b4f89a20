# SPDX-License-Identifier: Apache-2.0
"""
The equations of a step for several records, one after the other.

What is a record's own, its states at the ends and its trim, moves nothing in other records: the
products of derivatives are summed over the records with no zero multiplied.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection, as_real, of_records
from ctsid_core.likelihood.levenberg_marquardt import NormalEquations, scaled_equations
from ctsid_core.likelihood.prediction_errors import Prediction, jacobian
from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array

_Places = NDArray[np.intp]


def record_equations(projection: Projection, m: Matrices, prediction: Prediction, whiten: Array,
                     feedthrough: bool, *, with_noise: bool,
                     free: Array | None = None) -> NormalEquations:
    """
    Return the equations of a step, by the entries that `jacobian` lists for all records.

    Parameters
    ----------
    projection : Projection
        Of several records.
    m : Matrices
    prediction : Prediction
        Of the model.
    whiten : ndarray, shape (ny, ny)
        Multiplies the errors.
    feedthrough : bool
    with_noise : bool
        Whether K moves.
    free : ndarray, shape (parameters,), optional
        1 for the entries that move, else 0.
    """
    count = FreeEntries.of(m, feedthrough, noise=with_noise).count
    gram, pull, first = np.zeros((count, count)), np.zeros(count), 0
    for record, own, places in _records(projection, m, feedthrough, with_noise):
        lines = slice(first, first + len(record.s))
        first += len(record.s)
        here = Prediction(prediction.resolvent.on(lines), prediction.x[:, lines],
                          prediction.error[:, lines])
        columns = jacobian(record, own, feedthrough, with_noise=with_noise, whiten=whiten,
                           prediction=here)
        rows = np.moveaxis(columns, -1, 0).reshape(columns.shape[2], -1)
        if free is not None:
            rows *= free[places][:, np.newaxis]
        gram[np.ix_(places, places)] += rows @ rows.T
        pull[places] += rows @ (whiten @ as_real(here.error)).ravel()
    return scaled_equations(gram, pull)


def equation_work(projection: Projection, n: int) -> float:
    """Return how many multiplications the equations of a step take for models of order n."""
    ny, work = len(projection.y), 0.0
    for p in projection.records:
        driven = len(p.u) + len(p.tail) + len(p.ones)
        work += 2.0 * len(p.s) * ny * (n * (n + driven + 2 * ny) + ny * driven) ** 2
    return work


def _records(projection: Projection, m: Matrices, feedthrough: bool, with_noise: bool,
             ) -> Iterator[tuple[Projection, Matrices, _Places]]:
    """Yield each record, its model, and the places of its parameters among all."""
    entries = FreeEntries.of(m, feedthrough, noise=with_noise)
    tail = level = 0
    for record, own in zip(projection.records, of_records(m, projection), strict=True):
        on, to = tail + len(record.tail), level + len(record.ones)
        yield record, own, entries.places(range(tail, on), range(level, to))
        tail, level = on, to
