# SPDX-License-Identifier: Apache-2.0
"""
What a model says of corrupt samples: which stand out of its errors, and which it explains.

Neighbours (`signals/spikes.py`) do not know the inputs: where these jump, an output may bend as
well, or all but jump.
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
from ctsid_core.linear.types import Array, Mask
from ctsid_core.search.by_order import SEARCH
from ctsid_core.search.solution import Solution
from ctsid_core.signals.outliers import spikes
from ctsid_core.signals.spikes import MAD

_STANDING_OUT = 6.0   # robust deviations of an error, from which on it is looked at closely
_AGAIN = 0.5 * SEARCH  # of a budget: where more is spent, it does not last for the same again

Corrupt = list[list[Mask | None]]


def corrupt_rows(part: Joint) -> Corrupt:
    """Return which rows of each output signal of each record have a corrupt sample."""
    return [[f.mask.any(axis=1) if f.any else None for f in p.corrupt_y] for p in part.parts]


def hide_outliers(part: Joint, corrupt: Corrupt, samples: Samples, fit: Fit) -> int:
    """Mark the rows whose errors stand out, and return how many there are."""
    count = 0
    for errors, p, marks, record in zip(residuals(samples, fit), part.parts, corrupt,
                                        samples.records, strict=True):
        for k, (e, s, signal) in enumerate(zip(errors, record.streams, p.record.outputs,
                                               strict=True)):
            if not _stand_out(e).any():
                continue
            seen = spikes(s.times, e, closely=True)
            if not seen.any:
                continue
            rows = np.searchsorted(signal.time, s.times[seen.mask.any(axis=1)])
            mask = marks[k]
            if mask is None:
                mask = np.zeros(len(signal.time), dtype=bool)
            mask[rows] = True
            marks[k], count = mask, count + len(rows)
    return count


def _stand_out(errors: Array) -> Mask:
    """Return which errors lie far from 0, for most of them."""
    usual = MAD * np.median(np.abs(errors), axis=0)
    return np.asarray(np.abs(errors) > _STANDING_OUT * usual)


def given_back(part: Joint, found: Callable[[Joint], Solution | None],
               effort: Effort) -> Solution | None:
    """
    Return the model that is found without what its neighbours, and a model, take for corrupt.

    `found` returns the model of records, or None if they are too short for any. It is asked again
    with samples that the model of the others explains, where there is budget for it.
    """
    solution = found(part)
    while solution is not None and not effort.beyond(_AGAIN):
        told = solution.simulating if solution.by_prediction else (
            solution.samples, solution.fit, solution.free)
        honest = None if told is None else _honest(part, told[0], told[1])
        if honest is None:
            break
        part, solution = honest, found(honest) or solution
    return solution


def _honest(part: Joint, samples: Samples, fit: Fit) -> Joint | None:
    """Return the records with the corrupt samples that a model explains, or None."""
    if not any(f.any for p in part.parts for f in p.corrupt_y):
        return None
    records, parts = [p.record for p in part.parts], []
    whole = samples_of(records, [[None] * len(r.outputs) for r in records], effort=samples.effort)
    whole = replace(whole, records=tuple(replace(r, start=own.start, streams=tuple(
        s.of(s.times >= own.start) for s in r.streams))
        for r, own in zip(whole.records, samples.records, strict=True)))
    for errors, p, record in zip(residuals(whole, fit), part.parts, whole.records, strict=True):
        honest = []
        for e, s, signal, spiky in zip(errors, record.streams, p.record.outputs, p.corrupt_y,
                                       strict=True):
            rows, mask = np.searchsorted(signal.time, s.times), np.zeros_like(spiky.mask)
            # Of what was measured: a spike stands out from errors that are large, but smooth.
            e = e + np.where(spiky.mask, spiky.off, 0.0)[rows] / samples.size[s.channels]
            seen = spikes(s.times, e, closely=True)
            mask[rows] = spiky.mask[rows] & ~_stand_out(e) & ~seen.mask
            mask[:, list(seen.too_many)] = False
            honest.append(mask)
        parts.append(p.with_honest(honest))
    return replace(part, parts=tuple(parts)) if any(
        (new.mask != old.mask).any() for p, q in zip(parts, part.parts, strict=True)
        for new, old in zip(p.corrupt_y, q.corrupt_y, strict=True)) else None
