# SPDX-License-Identifier: Apache-2.0
"""How a model of the first part of every record does on the last part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.bases.records import Joint
from ctsid_core.likelihood.prediction_errors import unseen, unseen_predicted_fit, without_level
from ctsid_core.linear.types import Array
from ctsid_core.search.closed_loop import by_prediction
from ctsid_core.search.order import Search
from ctsid_core.search.selection import most_likely, most_likely_simulation
from ctsid_core.search.solution import Solution, own_delays
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record

_STILL = 0.01         # of an input's motion in the whole: too little to tell a model


@dataclass(frozen=True, eq=False)
class HeldOut:
    """
    The fit of a model of the first parts on the last parts; NaN if nothing was held out.

    Parameters
    ----------
    fit : ndarray, shape (number of moving outputs,)
        [%]
    density : ndarray, shape (number of moving outputs,)
        Of the errors [unit^2 s].
    """

    fit: Array
    density: Array

    @property
    def left(self) -> float:
        """The unexplained part, geometric mean over the outputs [%]."""
        return float(np.exp(np.mean(np.log(np.maximum(100.0 - self.fit, 1e-9)))))


def held_out(part: Joint, solution: Solution) -> HeldOut:
    """
    Return the fit of a model of the first part of every record on the last part.

    Parameters
    ----------
    part : Joint
    solution : Solution
        Of the whole records: its order and tuning are used.
    """
    nothing = nothing_held_out(len(solution.matrices.C))
    given = solution.settings
    if given.held_out == 0.0 or given.edges == 'paper':  # parts are not at rest
        return nothing
    own = own_delays(part.parts[0], solution.settings)
    first, last = part.divided(own, solution.layout)
    if not _moving(first, solution.projection):
        return nothing
    search = Search(first, own, lenient=solution.search.lenient)
    pair = search.pair(own.order)
    if pair is None:
        return nothing
    if solution.by_prediction:
        model = most_likely(first, pair, own)[0]
        early = _first_part(part.parts[0].record, own)
        predictor = by_prediction(early, search, model)
        return HeldOut(unseen_predicted_fit(last, model if predictor is None else predictor),
                       nothing.density)
    # Simulation judges: without process noise the gain of the first part's model is of no use.
    model = most_likely(first, pair, own)[0] if solution.process_noise else \
        most_likely_simulation(first, pair, own)[0]
    return HeldOut(*unseen(last, model, trimmed=not part.many))


def nothing_held_out(outputs: int) -> HeldOut:
    """Return that nothing is known of so many outputs."""
    return HeldOut(np.full(outputs, np.nan), np.full(outputs, np.nan))


def _first_part(record: Record, settings: Settings) -> Record:
    split = record.end - settings.held_out * record.duration
    return record.between(record.start, split, lead=max(settings.delays(record.nu), default=0.0))


def _moving(first: Projection, whole: Projection) -> bool:
    """Return whether every input moves in the first part, measured by what it does in all."""
    sizes = [np.linalg.norm(without_level(as_real(p.u), as_real(p.ones)), axis=1)
             for p in (first, whole)]
    return bool(np.all(sizes[0] > _STILL * sizes[1]))
