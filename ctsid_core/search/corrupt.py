# SPDX-License-Identifier: Apache-2.0
"""
Corrupt samples as a model sees them: those that stand out in its errors.

Neighbours (`signals/spikes.py`) do not know the inputs: where these jump, an output may bend or
jump as well; and a spike that is small beside the motion shows in the errors only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Fit
from ctsid_core.likelihood.residuals import residuals
from ctsid_core.likelihood.samples import Samples, samples_of
from ctsid_core.linear.types import Mask
from ctsid_core.search.by_order import SEARCH
from ctsid_core.search.solution import Solution
from ctsid_core.signals.outliers import no_spikes, spikes

_STANDING_OUT = 6.0   # robust deviations of an error, from which on it is looked at closely

Corrupt = list[list[Mask | None]]


def corrupt_rows(part: Joint) -> Corrupt:
    """Return which rows of each output signal of each record have a corrupt sample."""
    return [[f.mask.any(axis=1) if f.any else None for f in p.corrupt_y] for p in part.parts]


def agreed(part: Joint, found: Callable[[Joint], Solution | None],
           effort: Effort) -> Solution | None:
    """
    Return the model that is found without what is corrupt, as neighbours and a model see it.

    `found` returns the model of records, or None if they are too short for any. It is asked again
    where the model of what neighbours have left says otherwise, and there is budget for it.
    """
    solution = found(part)
    if solution is None:
        return None
    told = solution.simulating if solution.by_prediction else (
        solution.samples, solution.fit, solution.free)
    if told is None:
        return solution
    again = _as_explained(part, told[0], told[1])
    if all(np.array_equal(new, old) for rows in zip(corrupt_rows(again), corrupt_rows(part),
                                                    strict=True)
           for new, old in zip(*rows, strict=True)):
        return replace(solution, part=again)
    return solution if effort.beyond(SEARCH) else found(again) or solution


def _as_explained(part: Joint, samples: Samples, fit: Fit) -> Joint:
    """Return the records with those samples taken for corrupt of which a model says so, too."""
    records, parts = [p.record for p in part.parts], []
    whole = samples_of(records, [[None] * len(r.outputs) for r in records])
    whole = replace(whole, records=tuple(replace(r, start=own.start, streams=tuple(
        s.of(s.times >= own.start) for s in r.streams))
        for r, own in zip(whole.records, samples.records, strict=True)))
    for errors, p, record in zip(residuals(whole, fit), part.parts, whole.records, strict=True):
        found = []
        for e, s, signal, was in zip(errors, record.streams, p.record.outputs, p.corrupt_y,
                                     strict=True):
            rows, size = np.searchsorted(signal.time, s.times), samples.size[s.channels]
            mask, off, seen = was.mask.copy(), was.off.copy(), no_spikes(e)
            limit = _STANDING_OUT * 1.4826 * np.median(np.abs(e), axis=0)
            e = e + np.where(mask[rows], off[rows], 0.0) / size     # of what was measured
            far = np.abs(e) > limit
            if far.any():
                seen = spikes(s.times, e, closely=True)
            mask[rows] = mask[rows] & far | seen.mask
            off[rows] = np.where(seen.mask, seen.off * size, off[rows])
            found.append(replace(was, mask=mask, off=off, too_many=tuple(
                j for j in was.too_many if j in seen.too_many)))
        parts.append(p.with_corrupt(found))
    return replace(part, parts=tuple(parts))
