# SPDX-License-Identifier: Apache-2.0
"""A model from the raw output samples, where interpolation would not do; corrupt ones left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.bases.all_channels import moving_model
from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.records import Joint
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array
from ctsid_core.model.verdict import EXPLAINED
from ctsid_core.search.samples_model import Told, again, distorted, in_bursts, tell
from ctsid_core.search.solution import Found, own_delays
from ctsid_core.settings import Settings

_LITTLE = 1.1           # errors' power over that without outliers that changes no choice


@dataclass(frozen=True, eq=False)
class OnSamples:
    """
    A model that was found on the raw output samples.

    Parameters
    ----------
    part : Usable
        The record, its corrupt samples left out.
    told : Told
        What they tell.
    settings : Settings
        That it was made with.
    why : str
        Reason for it, for the user.
    lines : Found, optional
        The model of interpolated outputs, if there is one.
    """

    part: Usable
    told: Told
    settings: Settings
    why: str
    lines: Found | None = None


def of_bursts(part: Joint, settings: Settings) -> OnSamples | None:
    """Return the model of the raw samples if their stamps forbid to interpolate them."""
    if part.several or not settings.refine:
        return None
    usable = part.parts[0]
    why = in_bursts(usable.record)
    told = _told(usable, settings, why) if why else None
    return None if told is None else OnSamples(*told, settings, why)


def undistorted(part: Joint, found: Found) -> OnSamples | None:
    """Return the model of the raw samples if a model tells that interpolation did harm."""
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
    return None if told is None else OnSamples(*told, found.settings, why, found)


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
    if not part.doubtful(density(part, told)):
        return part, told
    cleaned, gain = part.cleaned(moving_model(told.fit.matrices, delay))
    if cleaned is part:
        return part, told
    fresh = tell(cleaned.record, delay, settings) if gain > _LITTLE else \
        again(cleaned.record, delay, settings, told)
    return (part, told) if fresh is None else (cleaned, fresh)


def density(part: Usable, told: Told) -> Array:
    """Return the spectral density of white noise of such power at the outputs' stamps."""
    period = np.array([s.period for s in part.record.outputs for _ in range(s.width)])
    return np.asarray(told.fit.variance * period)
