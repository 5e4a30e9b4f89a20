# SPDX-License-Identifier: Apache-2.0
"""Identification from the raw output samples: corrupt ones left out, and the result judged."""

from __future__ import annotations

import numpy as np

from ctsid_core.bases.base import Array
from ctsid_core.estimate import Choice, Estimate, Status
from ctsid_core.pbsid import Matrices
from ctsid_core.settings import Settings
from ctsid_core.time_estimate import Told, again, tell
from ctsid_core.time_refine import poles_in_time
from ctsid_core.usable import Usable
from ctsid_core.whole_model import moving_model, spread_out, whole_model

_LITTLE = 1.1           # errors' power over that without outliers that changes no choice


def identify_in_time(part: Usable, settings: Settings, delay: tuple[float, ...], why: str,
                     explained: float, vague: float, most: Array | None = None,
                     start: Matrices | None = None) -> Estimate | None:
    """
    Return the estimate from the raw samples, or None if no model of these is to be believed.

    Parameters
    ----------
    part : Usable
    settings : Settings
    delay : tuple of float
        Dead times of the moving inputs [s].
    why : str
        Reason for it, for the user.
    explained : float
        Fit below which an output counts as not explained [%].
    vague : float
        Standard deviation over size above which a pole is not known.
    most : ndarray, shape (moving outputs,), optional
        Mean square that a model may leave of the outputs.
    start : Matrices, optional
        Where to start if there are too many samples for a search.

    Notes
    -----
    Measurement noise only. There is no test for a change of the plant within the window.
    """
    told = tell(part.record, delay, settings, start)
    if told is not None:
        part, told = _without_outliers(part, settings, delay, told)
    if told is None or np.max(told.simulated) < explained or (
            most is not None and (told.fit.variance > most).all()):
        return None
    return _judged(part, settings, told, why, explained, vague)


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


def _judged(part: Usable, settings: Settings, told: Told, why: str, explained: float,
            vague: float) -> Estimate:
    m, ny = told.fit.matrices, part.whole.ny
    model = whole_model(part, m, settings.delays(part.whole.nu), np.diag(_density(part, told)))
    poles, deviation = poles_in_time(told.fit)
    tested = told.unseen[np.isfinite(told.unseen)]
    size = np.maximum(np.abs(poles), 2.0 * np.pi / part.record.duration)
    status = Status.OK
    if min([np.max(told.simulated), *tested.max(initial=-np.inf, keepdims=True)[:len(tested)]]
           ) < explained:
        status = Status.UNEXPLAINED
    elif np.min(deviation / size) > vague:
        status = Status.UNRELIABLE
    worst = np.fmin(told.simulated, told.unseen)
    corrupt, counts = part.corrupt()
    notes = [f'output {part.whole.output_names[j]} is not explained: fit {worst[i]:.0f} %'
             for i, j in enumerate(part.y) if worst[i] < explained]
    choices = [Choice('domain', 'time', f'{why}; the model was made from the samples themselves')]
    if told.table:
        choices.append(Choice('order', model.n, "Schwarz's criterion, above its smallest value, "
                              f'by order: {told.table}'))
    choices.append(Choice('noise', 'measurement', 'the only kind that is looked for in samples '
                          'that cannot be interpolated'))
    ok = status is Status.OK
    return Estimate(
        status=status, settings=settings.replace(order=model.n), model=model if ok else None,
        rejected_model=None if ok else model,
        pole_std=np.array([deviation[np.argmin(np.abs(poles - p))] for p in model.poles]),
        fit=spread_out(told.simulated, part.y, ny),
        held_out_fit=spread_out(told.unseen, part.y, ny), choices=tuple(choices),
        notes=(*(n.replace(': bridged by straight lines', '') for n in part.notes), *corrupt,
               *notes),
        statistics={**counts, 'process_noise': 0.0})
