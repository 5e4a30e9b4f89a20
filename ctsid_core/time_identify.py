# SPDX-License-Identifier: Apache-2.0
"""Identification from the raw output samples: corrupt ones left out, and the result judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.base import Array
from ctsid_core.covariance import Covariance, pole_deviation, spread
from ctsid_core.deviation import entries_of
from ctsid_core.estimate import Choice, Estimate, Status
from ctsid_core.examination import examine
from ctsid_core.found import Found, own_delays
from ctsid_core.joint import Joint
from ctsid_core.judgement import EXPLAINED, Evidence, judge, pole_uncertainty
from ctsid_core.pbsid import Matrices
from ctsid_core.settings import Settings
from ctsid_core.statespace import StateSpace
from ctsid_core.stuck import stuck_outputs
from ctsid_core.time_estimate import Told, again, distorted, in_bursts, tell
from ctsid_core.usable import Usable
from ctsid_core.verdict import UNJUDGED, Grade, Verdict
from ctsid_core.whole_model import moving_model, spread_out, whole_model

_LITTLE = 1.1           # errors' power over that without outliers that changes no choice
_UNEXAMINED = ('Samples that come in bursts do not tell whether the model misses some of the '
               'response; test it on other data before using it.')


def told_in_time(part: Joint, settings: Settings) -> Estimate | None:
    """Return the estimate from the raw samples if their stamps forbid to interpolate them."""
    if part.several or not settings.refine:
        return None
    usable = part.parts[0]
    why = in_bursts(usable.record)
    told = _told(usable, settings, why) if why else None
    return None if told is None else _judged(*told, settings, why, None)


def undistorted(part: Joint, found: Found) -> Estimate | None:
    """Return the estimate from the raw samples if a model tells that interpolation did harm."""
    usable = part.parts[0]
    known = found.projection.slopes is None and not found.projection.bent
    if part.several or not (known and found.settings.refine and np.isfinite(
            found.matrices.A).all()):
        return None
    delay = own_delays(usable, found.settings).delays(usable.record.nu)
    why, most = distorted(usable.record, moving_model(found.matrices, delay), found.process_noise)
    # Its order was chosen of distorted data.
    free = found.settings.replace(order=0) if found.orders else found.settings
    told = _told(usable, free, why, most, found.matrices) if why else None
    if told is None:
        return None
    nothing = np.full(len(found.matrices.C), np.nan)
    numbers = examine(found.projection, found.matrices, [usable.record], nothing,
                      feedthrough=found.settings.feedthrough)
    return _judged(*told, found.settings, why, numbers)


def _told(part: Usable, settings: Settings, why: str, most: Array | None = None,
          start: Matrices | None = None) -> tuple[Usable, Told] | None:
    """
    Return what raw samples tell, and which; None if no model of these is to be believed.

    Parameters
    ----------
    part : Usable
    settings : Settings
    why : str
        Reason for it, for the user.
    most : ndarray, shape (moving outputs,), optional
        Mean square that a model may leave of the outputs.
    start : Matrices, optional
        Where to start if there are too many samples for a search.

    Notes
    -----
    Measurement noise only. There is no test for a change of the plant within the window.
    """
    delay = own_delays(part, settings).delays(part.record.nu)
    told = tell(part.record, delay, settings, start)
    if told is not None:
        part, told = _without_outliers(part, settings, delay, told)
    if told is None or np.max(told.simulated) < EXPLAINED or (
            most is not None and (told.fit.variance > most).all()):
        return None
    return part, told


def _without_outliers(part: Usable, settings: Settings, delay: tuple[float, ...],
                      told: Told) -> tuple[Usable, Told]:
    if not part.doubtful(_density(part, told)):
        return part, told
    cleaned, gain = part.cleaned(moving_model(told.fit.matrices, delay))
    if cleaned is part:
        return part, told
    fresh = tell(cleaned.record, delay, settings) if gain > _LITTLE else \
        again(cleaned.record, delay, settings, told)
    return (part, told) if fresh is None else (cleaned, fresh)


def _density(part: Usable, told: Told) -> Array:
    """Return the spectral density of white noise of such power at the outputs' stamps."""
    period = np.array([s.period for s in part.record.outputs for _ in range(s.width)])
    density: Array = told.fit.variance * period
    return density


def _judged(part: Usable, told: Told, settings: Settings, why: str,
            numbers: Verdict | None) -> Estimate:
    """Return the estimate; the numbers behind its verdict are those of a projection, if any."""
    m = told.fit.matrices
    model = whole_model(part, m, settings.delays(part.whole.nu), np.diag(_density(part, told)))
    covariance = _covariance(part, told, settings, model)
    deviation = np.full(model.n, np.nan) if covariance is None else \
        pole_deviation(covariance, model)
    evidence = _evidence(part, told, model, deviation, numbers)
    status, verdict = judge(evidence)
    if numbers is None and status is Status.OK:
        verdict = replace(verdict, grade=Grade.WEAK, reason=_UNEXAMINED)
    corrupt, counts = part.corrupt()
    notes = [f'output {part.whole.output_names[j]} is not explained: fit {evidence.worst[j]:.0f} %'
             for j in part.y if evidence.worst[j] < EXPLAINED]
    ok = status is Status.OK
    return Estimate(
        status=status, settings=settings.replace(order=model.n), model=model if ok else None,
        rejected_model=None if ok else model, pole_std=deviation, covariance=covariance,
        verdict=verdict, fit=evidence.fit, held_out_fit=evidence.held_out,
        choices=_choices(told, model.n, why), orders=told.table,
        notes=(*(n.replace(': bridged by straight lines', '') for n in part.notes), *corrupt,
               *notes),
        statistics={**counts, 'process_noise': 0.0})


def _choices(told: Told, order: int, why: str) -> tuple[Choice, ...]:
    choices = [Choice('domain', 'time', f'{why}; the model was made from the samples themselves')]
    if told.table:
        table = ', '.join(f'{one.order}: {one.criterion:.0f}' for one in told.table)
        choices.append(Choice('order', order, "Schwarz's criterion, above its smallest value, "
                              f'by order: {table}'))
    return (*choices, Choice('noise', 'measurement', 'the only kind that is looked for in samples '
                             'that cannot be interpolated'))


def _covariance(part: Usable, told: Told, settings: Settings,
                model: StateSpace) -> Covariance | None:
    changes = entries_of(told.fit.root, told.fit.matrices, settings.feedthrough, delays=False)
    if not all(np.isfinite(block).all() for block in changes):
        return None
    return Covariance.of_entries(spread(changes, part.u, part.y, model.nu, model.ny), model)


def _evidence(part: Usable, told: Told, model: StateSpace, deviation: Array,
              numbers: Verdict | None) -> Evidence:
    whole, resolution = part.whole, 2.0 * np.pi / part.record.duration
    unknown = np.full(len(part.y), np.nan)
    known = numbers or replace(UNJUDGED, missing=unknown, missing_p_value=unknown,
                               whiteness=unknown, next_ratio=unknown)

    def everywhere(values: Array) -> Array:
        return spread_out(values, part.y, whole.ny)

    return Evidence(
        input_names=whole.input_names, output_names=whole.output_names,
        fixed_inputs=tuple(j for j in range(whole.nu) if j not in part.u),
        fixed_outputs=tuple(i for i in range(whole.ny) if i not in part.y),
        stuck=stuck_outputs(whole), fit=everywhere(told.simulated),
        held_out=everywhere(told.unseen), poles=model.poles, deviation=deviation,
        resolution=resolution, change='', process_noise=False,
        numbers=replace(
            known, missing=everywhere(known.missing),
            missing_p_value=everywhere(known.missing_p_value),
            whiteness=everywhere(known.whiteness), next_ratio=everywhere(known.next_ratio),
            pole_uncertainty=pole_uncertainty(model.poles, deviation, resolution)))
