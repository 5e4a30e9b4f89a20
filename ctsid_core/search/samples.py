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
from ctsid_core.search.lines import LITTLE
from ctsid_core.search.samples_model import (
    SamplesSolution,
    distorted,
    in_bursts,
    refit_samples,
    solve_samples,
)
from ctsid_core.search.solution import Solution, own_delays
from ctsid_core.settings import Settings


@dataclass(frozen=True, eq=False)
class OnSamples:
    """
    A model that was found on the raw output samples.

    Parameters
    ----------
    part : Usable
        The record, its corrupt samples left out.
    solution : SamplesSolution
        The model made of them.
    settings : Settings
        That it was made with.
    why : str
        Reason for it, for the user.
    lines : Solution, optional
        The model of interpolated outputs, if there is one.
    """

    part: Usable
    solution: SamplesSolution
    settings: Settings
    why: str
    lines: Solution | None = None


def solve_bursty_samples(part: Joint, settings: Settings) -> OnSamples | None:
    """Return the model of the raw samples if their stamps forbid to interpolate them."""
    if part.several or not settings.refine:
        return None
    usable = part.parts[0]
    why = in_bursts(usable.record)
    solution = _solve(usable, settings) if why else None
    return None if solution is None else OnSamples(*solution, settings, why)


def solve_if_distorted(part: Joint, found: Solution) -> OnSamples | None:
    """Return the model of the raw samples if a model shows that interpolation did harm."""
    usable = part.parts[0]
    known = found.projection.slopes is None and not found.projection.bent
    if part.several or not (known and found.settings.refine and np.isfinite(
            found.matrices.A).all()):
        return None
    delay = own_delays(usable, found.settings).delays(usable.record.nu)
    why, most = distorted(usable.record, moving_model(found.matrices, delay), found.process_noise)
    # Its order was chosen of distorted data.
    free = found.settings.replace(order=0) if found.orders else found.settings
    solution = _solve(usable, free, most, found.matrices) if why else None
    return None if solution is None else OnSamples(*solution, found.settings, why, found)


def _solve(part: Usable, settings: Settings, most: Array | None = None,
           start: Matrices | None = None) -> tuple[Usable, SamplesSolution] | None:
    """
    Return the samples used and their model; None if no model of these is acceptable.

    Parameters
    ----------
    part : Usable
    settings : Settings
    most : ndarray, shape (moving outputs,), optional
        Mean square that a model may leave of the outputs.
    start : Matrices, optional
        Where to start if there are too many samples for a search.

    Notes
    -----
    Measurement noise only. There is no test for a change of the plant within the window.
    """
    delay = own_delays(part, settings).delays(part.record.nu)
    solution = solve_samples(part.record, delay, settings, start)
    if solution is not None:
        part, solution = _without_outliers(part, settings, delay, solution)
    if solution is None or np.max(solution.simulated) < EXPLAINED or (
            most is not None and (solution.fit.variance > most).all()):
        return None
    return part, solution


def _without_outliers(part: Usable, settings: Settings, delay: tuple[float, ...],
                      solution: SamplesSolution) -> tuple[Usable, SamplesSolution]:
    if not part.may_hide_outliers(density(part, solution)):
        return part, solution
    cleaned, gain = part.cleaned(moving_model(solution.fit.matrices, delay))
    if cleaned is part:
        return part, solution
    fresh = solve_samples(cleaned.record, delay, settings) if gain > LITTLE else \
        refit_samples(cleaned.record, delay, settings, solution)
    return (part, solution) if fresh is None else (cleaned, fresh)


def density(part: Usable, solution: SamplesSolution) -> Array:
    """Return the spectral density of white noise of such power at the outputs' stamps."""
    period = np.array([s.period for s in part.record.outputs for _ in range(s.width)])
    return np.asarray(solution.fit.variance * period)
