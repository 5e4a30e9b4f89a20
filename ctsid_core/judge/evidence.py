# SPDX-License-Identifier: Apache-2.0
"""The numbers behind a verdict, from the projection that a model was made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.projection import Projection, as_real, of_records
from ctsid_core.judge.excitation import LinePrediction, combined, excitations
from ctsid_core.judge.residual_tests import prediction_error_test
from ctsid_core.likelihood.prediction_errors import simulate_lines
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.verdict import EXPLAINED, UNJUDGED, Verdict
from ctsid_core.signals.record import Record
from ctsid_core.signals.stuck import Stuck


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """
    The evidence on a model, for all channels of the record; `numbers` has the rest.

    Parameters
    ----------
    input_names, output_names : tuple of str
    fixed_inputs, fixed_outputs : tuple of int
        Places of the channels that are constant over the window.
    stuck : tuple of Stuck
        Outputs that stop moving within it.
    fit, held_out : ndarray, shape (ny,)
        [%]; NaN for constant outputs.
    poles : ndarray, shape (n,)
    deviation : ndarray, shape (n,)
        Standard deviations, in the same order [rad/s].
    resolution : float
        Slowest frequency that the window resolves [rad/s].
    change : str
        What to do about a change of the plant; empty if there was none.
    process_noise : bool
    enough : float
        Fit above which an output counts as explained [%].
    unexamined : bool
        Whether samples come in bursts, whose residuals no test of a projection can examine.
    numbers : Verdict
        With the numbers that have a place in it.
    """

    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    fixed_inputs: tuple[int, ...]
    fixed_outputs: tuple[int, ...]
    stuck: tuple[Stuck, ...]
    fit: Array
    held_out: Array
    poles: ComplexArray
    deviation: Array
    resolution: float
    change: str
    process_noise: bool
    numbers: Verdict
    enough: float = EXPLAINED
    unexamined: bool = False

    @property
    def worst(self) -> Array:
        """The lower of the fits, of each output [%]."""
        return np.asarray(np.fmin(self.fit, self.held_out))


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
