# SPDX-License-Identifier: Apache-2.0
"""
Does the plant drift? What constant numbers miss, and such that move in a straight line do not.

A car that gains speed, a battery that sags, a motor that warms up: a model of the mean is as good
as one can be, and may be what is wanted, but its user should know. Dead times alone drift where
the clocks of input and output run apart. Looked at to first order, beside curves, which a plant
that is not linear follows better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.curve import curves_of
from ctsid_core.judge.slopes import SEARCHED, Own, only, slopes_of
from ctsid_core.likelihood.output_error import Fit, Fitted, Free
from ctsid_core.likelihood.residuals import independent
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, ComplexArray

_PART = 0.2           # of what drifts, that is told


class InputDrift(NamedTuple):
    """What changes of an input from the start of a record to its end; 0 if little."""

    name: str
    gain: float         # by what part of itself
    late: float         # by how much its dead time does [s]


class Drift(NamedTuple):
    """What a model misses of the motion because the plant drifts."""

    record: int = -1        # its place; -1 if none does
    cost: float = 0.0       # rms over the motion, of the output where it is most [%]
    late: bool = False      # whether dead times alone explain most of it
    inputs: tuple[InputDrift, ...] = ()     # of which the model is the mean, as far as it is known


def drift_of(samples: Samples, fit: Fit, free: Free, least: float = NOTED) -> Drift:
    """Return the drift of the record where it costs most, if more than the `least` [%]."""
    if not np.max(fit.power) > (0.01 * least) ** 2:
        return Drift()
    return max((_of_record(only(samples, k).thinned(SEARCHED), (fit.model, free), k, least)
                for k, record in enumerate(samples.records) if record.end > record.start),
               key=lambda drift: drift.cost, default=Drift())


def drift_of_inputs(names: Sequence[str], mean: Fit, drifting: Fitted) -> Drift:
    """Return how the inputs drift of which a model is the mean."""
    samples, fit, _ = drifting
    missed = np.maximum(samples.mean(mean.power) - samples.mean(fit.power), 0.0)
    model, nu = fit.model, len(names)
    # Each mode counts as much as it moves the outputs.
    weight = np.linalg.norm(model.c, axis=0) / np.maximum(
        np.abs(model.poles), 1.0 / samples.length)
    found = [_of_input(name, model.poles, weight * model.b[:, k], weight * model.b[:, nu + k])
             for k, name in enumerate(names)]
    return Drift(-1, 100.0 * float(np.sqrt(np.max(missed))),
                 not any(one.gain for one in found),
                 tuple(one for one in found if one.gain or one.late))


def _of_input(name: str, poles: ComplexArray, b: ComplexArray, moved: ComplexArray) -> InputDrift:
    """
    Return what residues of an input times the time say of its gain and dead time.

    Of a gain that changes by a they are a b, of a dead time that changes by d they are -d p b. Of
    one state nothing tells these apart: it is the gain then.
    """
    both = np.column_stack((b, -poles * b))[:, :2 if np.iscomplex(poles).any() else len(poles)]
    columns = np.vstack((both.real, both.imag))
    told: Array = np.linalg.lstsq(columns, np.append(moved.real, moved.imag), rcond=None)[0]
    sizes = np.linalg.norm(columns * told, axis=0)
    told = np.append(np.where(sizes > _PART * sizes.sum(), told, 0.0), 0.0)
    return InputDrift(name, float(told[0]), float(told[1]))


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
