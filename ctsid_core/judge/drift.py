# SPDX-License-Identifier: Apache-2.0
"""
Does the plant drift? What constant numbers miss, and such that move in a straight line do not.

A car that gains speed, a battery that sags, a motor that warms up: a model of the mean is as good
as one can be, and may be what is wanted, but its user should know. Dead times alone drift where
the clocks of input and output run apart. Looked at to first order, beside curves, which a plant
that is not linear follows better.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.curve import curves_of
from ctsid_core.judge.slopes import SEARCHED, Own, only, slopes_of
from ctsid_core.likelihood.output_error import Fit, Free
from ctsid_core.likelihood.residuals import independent
from ctsid_core.likelihood.samples import Samples


class Drift(NamedTuple):
    """What a model misses of the motion because the plant drifts."""

    record: int = -1        # its place; -1 if none does
    cost: float = 0.0       # rms over the motion, of the output where it is most [%]
    late: bool = False      # whether dead times alone explain most of it


def drift_of(samples: Samples, fit: Fit, free: Free, least: float = NOTED) -> Drift:
    """Return the drift of the record where it costs most, if more than the `least` [%]."""
    if not np.max(fit.power) > (0.01 * least) ** 2:
        return Drift()
    return max((_of_record(only(samples, k).thinned(SEARCHED), (fit.model, free), k, least)
                for k, record in enumerate(samples.records) if record.end > record.start),
               key=lambda drift: drift.cost, default=Drift())


def _of_record(samples: Samples, own: Own, place: int, least: float) -> Drift:
    if samples.effort.over or not samples.counts.all():
        return Drift()
    slopes = slopes_of(samples, own)
    constant, drifting = slopes.beside(slopes.rows[:, :0]), slopes.beside(slopes.drift)
    if not drifting.cost < constant.cost:
        return Drift()
    numbers = drifting.numbers - constant.numbers
    n_eff = independent((tuple(e[:, np.newaxis] for e in drifting.errors),))
    gain = float(n_eff @ np.log(constant.power / drifting.power))
    by_chance = drifting.power * numbers / samples.ny / np.maximum(
        n_eff - drifting.numbers / samples.ny, 1.0)
    missed = np.maximum(constant.power - drifting.power - by_chance, 0.0) * slopes.fit.power[0]
    if gain <= numbers * float(np.log(max(float(np.max(n_eff)), 2.0))) \
            or np.max(missed) <= (0.01 * least) ** 2 or samples.effort.over:
        return Drift()
    if drifting.cost >= slopes.beside(curves_of(samples, slopes.fit)).cost:
        return Drift()
    late = slopes.beside(slopes.drift[:, slopes.delays[~slopes.states]])
    most = int(np.argmax(missed))
    return Drift(place, 100.0 * float(np.sqrt(missed[most])), bool(
        (2.0 * late.power < constant.power + drifting.power)[most]))
