# SPDX-License-Identifier: Apache-2.0
"""
What a model says of corrupt samples, and of commands that were lost.

Which samples stand out of its errors, and which it explains: neighbours (`signals/spikes.py`) do
not know the inputs; where these jump, an output may bend as well, or all but jump.

And, of held inputs that fall silent, whether what they were sent last went on. A stick, keys and
goals are sent when they change, or while they do, and robots hold what was sent last. Where a
recorder has lost a topic the model errs while it is silent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Fit
from ctsid_core.likelihood.residuals import mean_square, residuals
from ctsid_core.likelihood.samples import Samples, samples_of
from ctsid_core.likelihood.state_space import matrices_of
from ctsid_core.linear.types import Array, Mask
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.search.solution import Solution
from ctsid_core.search.task import corrupt_rows
from ctsid_core.search.tried import SEARCH, UNEXPLAINED, tried
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.gaps import FEWEST, silences
from ctsid_core.signals.spikes import MAD, SURE, spikes

AGAIN = 0.5 * SEARCH  # of a budget: where more is spent, it does not last for the same again
_MORE = 1.5           # times the error elsewhere: what was sent last did not go on; times that of
                      # the model of the others, where a sensor may be clipped: it is


def without_outliers(part: Joint, samples: Samples, fit: Fit) -> Joint:
    """Return the records with samples corrupt whose errors stand out, or the same if none do."""
    parts = []
    for errors, p, record in zip(residuals(samples, fit), part.parts, samples.records,
                                 strict=True):
        found = list(p.corrupt_y)
        for k, (e, s, signal, spiky) in enumerate(zip(errors, record.streams, p.record.outputs,
                                                      p.corrupt_y, strict=True)):
            if len(e) and (_stand_out(e).any() or spiky.too_many):
                seen = spikes(s.times, e, closely=True, check=samples.effort.check)
                mask = spiky.mask.copy()
                mask[np.searchsorted(signal.time, s.times)] = seen.mask
                found[k] = replace(spiky, mask=mask, too_many=tuple(
                    j for j in spiky.too_many if j in seen.too_many))
        parts.append(replace(p, corrupt_y=tuple(found)))
    return replace(part, parts=tuple(parts)) if _differ(parts, part) else part


def _stand_out(errors: Array) -> Mask:
    """Return which errors lie far from 0, for most of them."""
    usual = MAD * np.median(np.abs(errors), axis=0)
    return np.asarray(np.abs(errors) > SURE * usual)


def given_back(part: Joint, found: Callable[[Joint], Solution | None],
               effort: Effort) -> Solution | None:
    """
    Return the model that is found without what its neighbours, and a model, take for corrupt.

    `found` returns the model of records, or None if they are too short for any. It is asked again
    with inputs as they were measured; and with samples that the model of the others explains, or
    else that of all: without the few that show when an output jumps, another dead time does as
    well. Where there is budget for it.
    """
    part, solution = _with_inputs(part, found, effort)
    whole = _all_of(part)
    while solution is not None and not effort.beyond(AGAIN):
        honest = _honest(part, part, solution)
        if honest is None and whole is not None:
            other = found(whole)
            honest, whole = None if other is None else _honest(part, whole, other), None
        if honest is None or effort.beyond(AGAIN):
            break
        part, solution = honest, found(honest) or solution
    return solution


def _with_inputs(part: Joint, found: Callable[[Joint], Solution | None],
                 effort: Effort) -> tuple[Joint, Solution | None]:
    """Return the records and their model, each input as measured if outputs tell that it was."""
    solution = found(part)
    for signal, width in enumerate([s.width for s in part.parts[0].record.inputs]):
        for channel in range(width):
            if not any(p.corrupt_u[signal].mask[:, channel].any() for p in part.parts):
                continue
            if effort.beyond(AGAIN):
                return part, solution
            given = replace(part, parts=tuple(p.with_input(signal, channel) for p in part.parts))
            other = found(given)
            if _left(given, other) < _left(part, solution):
                part, solution = given, other
    return part, solution


def _left(part: Joint, solution: Solution | None) -> float:
    """Return what a model leaves of all outputs but spikes, though it stands out of its errors."""
    if solution is None or solution.simulated is None:
        return float('nan')
    samples, fit, _ = solution.simulated
    seen = _seen(part, samples, [corrupt_rows(p) for p in part.parts])
    return float(np.sum(np.log(mean_square(residuals(seen, fit)))))


def _seen(part: Joint, samples: Samples, corrupt: Sequence[Sequence[Mask | None]]) -> Samples:
    """Return all samples of records but corrupt ones, since those of a model begin."""
    seen = samples_of([p.record for p in part.parts], corrupt, effort=samples.effort)
    return replace(seen, records=tuple(replace(r, start=own.start, streams=tuple(
        s.of(s.times >= own.start) for s in r.streams))
        for r, own in zip(seen.records, samples.records, strict=True)))


def _all_of(part: Joint) -> Joint | None:
    """Return the records with all that was measured, or None if that is what they have."""
    if not any(f.any for p in part.parts for f in p.corrupt_y):
        return None
    return replace(part, parts=tuple(p.with_honest([f.mask for f in p.corrupt_y])
                                     for p in part.parts))


def _honest(part: Joint, seen: Joint, solution: Solution) -> Joint | None:
    """Return the records with corrupt samples that the model of those seen explains, or None."""
    told = solution.simulating if solution.by_prediction else (
        solution.samples, solution.fit, solution.free)
    if told is None or _all_of(part) is None:
        return None
    samples, fit, _ = told
    whole, parts = _seen(seen, samples, [[None] * len(p.corrupt_y) for p in seen.parts]), []
    for errors, p, other, record in zip(residuals(whole, fit), part.parts, seen.parts,
                                        whole.records, strict=True):
        honest = []
        for e, s, signal, spiky, bridged in zip(errors, record.streams, p.record.outputs,
                                                p.corrupt_y, other.corrupt_y, strict=True):
            rows, mask = np.searchsorted(signal.time, s.times), np.zeros_like(spiky.mask)
            # Of what was measured: a spike stands out from errors that are large, but smooth.
            e = e + np.where(bridged.mask, bridged.off, 0.0)[rows] / samples.size[s.channels]
            left = spikes(s.times, e, closely=True, check=samples.effort.check)
            mask[rows] = spiky.mask[rows] & ~_stand_out(e) & ~left.mask
            mask[:, list(left.too_many)] = False
            honest.append(mask)
        parts.append(p.with_honest(honest))
    return replace(part, parts=tuple(parts)) if _differ(parts, part) else None


def _differ(parts: Sequence[Usable], part: Joint) -> bool:
    """Return whether other samples are corrupt in them."""
    return any(new.too_many != old.too_many or (new.mask != old.mask).any()
               for p, q in zip(parts, part.parts, strict=True)
               for new, old in zip(p.corrupt_y, q.corrupt_y, strict=True))


def reads_better(one: Solution, other: Solution) -> bool:
    """
    Return whether a model leaves but noise of its samples, and one of more samples clearly more.

    Where a sensor is clipped the model of all imitates that. A plant that comes to rest the other
    one explains no better, nor one that strikes a stop: there it errs when that is left.
    """
    parts = one.part.parts
    if one.by_prediction or other.by_prediction or any(
            (p.u, p.y) != (q.u, q.y) for p, q in zip(parts, other.part.parts, strict=False)) \
            or tried(one.samples, one.fit, one.free).unexplained > UNEXPLAINED:
        return False
    left = []
    for solution in (one, other):
        m = matrices_of(solution.fit.model, solution.samples.size)
        model = StateSpace(m.A, m.B, m.C, m.D, delay=tuple(solution.delay.tolist()))
        found = [simulation(model, p.record, trim='refit') for p in parts]
        left.append(np.nanmean(np.concatenate([s.y - s.y_hat for s in found]) ** 2, axis=0))
    return bool(np.any(left[1] > _MORE ** 2 * left[0]))


def of_lost_inputs(solution: Solution, settings: Settings,
                   again: Callable[[Settings, bool], Solution | None]) -> Solution:
    """
    Return the model of records that are divided where commands are lost, if it is the better one.

    `again` identifies the records with other settings, and divided. What was sent last went on, as
    far as what acts of it says, unless the model errs clearly more there.
    """
    if not _lost_inputs(solution):
        return solution
    given = settings.with_actuators(solution.settings.actuators(solution.part.parts[0].whole.nu))
    divided = [again(each, True) for each in dict.fromkeys((settings, given))]
    _, found = min(((tried(*one.simulated).unexplained, one) for one in divided
                    if one and one.simulated), key=lambda own: own[0], default=(0.0, solution))
    doubt = solution.doubt if solution.doubt and any(
        f'.{kind}: ' in solution.doubt[1] for kind in Actuator._fields) else found.doubt
    return replace(found, doubt=doubt, deviations=solution.deviations)


def _lost_inputs(solution: Solution) -> bool:
    """Return whether the model errs clearly more where held inputs are silent than elsewhere."""
    silent = [silences(own.whole) for own in solution.part.parts]
    if not any(silent):
        return False
    samples, fit, _ = solution.simulated or solution.source
    inside, elsewhere = np.zeros(2), np.zeros(2)
    for spans, record, own in zip(silent, samples.records, residuals(samples, fit), strict=True):
        for s, errors in zip(record.streams, own, strict=True):
            within = np.any([(a < s.times) & (s.times < b) for a, b in spans], axis=0) \
                if spans else np.zeros(len(s.times), dtype=bool)
            for rows, found in ((within, inside), (~within, elsewhere)):
                found += np.sum(errors[rows] ** 2), np.sum(rows) * errors.shape[1]
    if min(inside[1], elsewhere[1]) < FEWEST:
        return False
    return bool(inside[0] / inside[1] > _MORE ** 2 * elsewhere[0] / elsewhere[1])
