# SPDX-License-Identifier: Apache-2.0
"""The numbers behind a verdict, from the projection that a model was made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctsid_core.bases.projection import Projection, as_real, of_records
from ctsid_core.judge.excitation import LinePrediction, combined, excitations
from ctsid_core.judge.residual_tests import prediction_error_test
from ctsid_core.likelihood.prediction_errors import simulate_lines
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array
from ctsid_core.model.verdict import UNJUDGED, Verdict
from ctsid_core.signals.record import Record


def examine(projection: Projection, m: Matrices, records: Sequence[Record], unseen: Array, *,
            feedthrough: bool) -> Verdict:
    """
    Return a verdict of which the numbers are those of a model, and the grade is still open.

    Parameters
    ----------
    projection : Projection
    m : Matrices
        Made of it.
    records : sequence of Record
        That were projected.
    unseen : ndarray, shape (ny,)
        Density of the errors on data held out [unit^2 s].
    feedthrough : bool
        Whether D is free.
    """
    with np.errstate(over='ignore', invalid='ignore'):  # of absurdly small or large signals
        return _examine(projection, m, records, unseen, feedthrough)


def _examine(projection: Projection, m: Matrices, records: Sequence[Record],
             unseen: Array, feedthrough: bool) -> Verdict:
    n, nu, ny = len(m.A), len(projection.u), len(projection.y)
    prediction = LinePrediction(projection, m)
    excitation = combined([
        excitations(LinePrediction(p, own), record, n + ny * feedthrough) for p, own, record in
        zip(projection.records, of_records(m, projection), records, strict=True)])
    highest = max((x.high for x in excitation if x.high > 0.0), default=0.0)
    test = prediction_error_test(
        prediction, highest or float(np.abs(projection.s).max()),
        n * (nu + 2 * ny) + ny * nu * feedthrough)
    error = as_real(projection.y - simulate_lines(projection, m))
    spare = max(projection.count - n * (nu / ny + 1) - nu * feedthrough, 1.0)
    density = projection.unit * np.sum(error ** 2, axis=1) / spare
    return replace(UNJUDGED, excitation=excitation, missing=test.missing,
                   missing_p_value=test.p_value, whiteness=test.whiteness,
                   next_ratio=unseen / np.maximum(density, 1e-300))
