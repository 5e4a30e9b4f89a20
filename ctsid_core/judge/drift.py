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
from ctsid_core.judge.slopes import SEARCHED, Left, Own, in_records, only, recordings, slopes_of
from ctsid_core.likelihood.output_error import Fit, Fitted, Free
from ctsid_core.likelihood.residuals import independent
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.drifting import standing

_PART = 0.3           # of what drifts, that is not told
_ASKED = 'whether the plant drifts'


class InputDrift(NamedTuple):
    """What changes of an input from the start of a record to its end; 0 if little."""

    name: str
    gain: float         # by what part of itself; if it comes back, the rms of that
    late: float         # by how much its dead time does [s]


class Drift(NamedTuple):
    """What a model misses of the motion because the plant drifts."""

    record: int = -1        # its place; -1 if none does, or all alike
    cost: float = 0.0       # rms over the motion, of the output where it is most [%]
    late: bool = False      # whether dead times alone explain most of it
    inputs: tuple[InputDrift, ...] = ()     # of which the model is the mean, as far as it is known
    moved: float = 0.0      # the same over all records, of gains and dead times alone if known [%]
    jumps: int = 0          # how often gains jump, if they come back
    span: tuple[float, ...] = ()    # from when to when they are others, as parts of the record


def drift_of(samples: Samples, fit: Fit, free: Free, least: float = NOTED) -> Drift:
    """Return the drift of the record where it costs most, if more than the `least` [%]."""
    if not np.max(fit.power) > (0.01 * least) ** 2:
        return Drift()
    found = max((_of_recording(only(samples, k).thinned(SEARCHED), (fit.model, free), k, least)
                 for k in recordings(samples)), key=lambda drift: drift.cost, default=Drift())
    return over_all(found, samples)


def over_all(found: Drift, samples: Samples) -> Drift:
    """Return a drift with what it costs of all motion: of a short record that is a small part."""
    if found.record < 0:
        return found
    share = np.sum(only(samples, found.record).counts) / np.sum(samples.counts)
    return found._replace(moved=found.cost * float(np.sqrt(share)))


def drift_of_inputs(names: Sequence[str], mean: Fit, drifting: Fitted) -> Drift:
    """Return how the inputs drift of which a model is the mean."""
    samples, fit, _ = drifting
    model, nu = fit.model, len(names)
    # Each mode counts as much as it moves the outputs, and each input as much as it moves.
    weight = np.linalg.norm(model.c, axis=0) / np.maximum(
        np.abs(model.poles), 1.0 / samples.length)
    size = np.sqrt(np.mean([np.concatenate([np.var(s.values, axis=0) for s in r.inputs])[:nu]
                            for r in samples.records], axis=0))
    weights = weight[:, np.newaxis] * size
    b, moved = weights * model.b[:, :nu], weights * model.b[:, nu:2 * nu]
    sizes = np.linalg.norm(moved, axis=0)
    found = tuple(_of_input(name, model.poles, b[:, j], moved[:, j])
                  for j, name in enumerate(names) if sizes[j] > _PART * np.max(sizes))

    def cost(power: Array) -> float:
        missed = samples.mean(power) - samples.mean(fit.power)
        return 100.0 * float(np.sqrt(max(float(np.max(missed)), 0.0)))
    late = any(one.late for one in found) and not any(one.gain for one in found)
    return Drift(-1, cost(mean.power), late, found,
                 cost(standing(*drifting).power))


def _of_input(name: str, poles: ComplexArray, b: ComplexArray, moved: ComplexArray) -> InputDrift:
    """
    Return what residues of an input times the time say of its gain and dead time.

    Of a gain that changes by a they are a b, of a dead time that changes by d they are -d p b: one
    of them, if that explains most. Of one state nothing tells these apart: it is the gain then.
    """
    columns, target = (np.concatenate((x.real, x.imag)) for x in (
        np.column_stack((b, -poles * b)), moved))
    for both in ((True, False), (False, True), (True, True)):
        told = np.zeros(2)
        told[list(both)] = np.linalg.lstsq(columns[:, list(both)], target, rcond=None)[0]
        if np.linalg.norm(columns @ told - target) < _PART * np.linalg.norm(target):
            break
    if np.abs(told[0]) > 2.0:                       # it would change its sign: nothing is told
        told = np.zeros(2)
    return InputDrift(name, float(told[0]), float(told[1]))


def _of_recording(samples: Samples, own: Own, place: int, least: float) -> Drift:
    if not samples.counts.all() or samples.effort.leaves_out(_ASKED):
        return Drift()
    slopes = slopes_of(samples, own)
    none = slopes.rows[:, :0]
    constant, drifting = slopes.beside(none), slopes.beside(slopes.drift)
    if not drifting.cost < constant.cost:
        return Drift()

    def power(left: Left) -> Array:
        return samples.mean(left.power.reshape(-1, samples.ny) * slopes.fit.power)
    numbers, ny = drifting.numbers - constant.numbers, samples.ny
    errors = [e[:, np.newaxis] for e in drifting.errors]
    n_eff = independent(in_records(errors, samples))
    before, after = power(constant), power(drifting)
    gain = float(n_eff @ np.log(before / after))
    by_chance = after * numbers / ny / np.maximum(n_eff - drifting.numbers / ny, 1.0)
    missed = np.maximum(before - after - by_chance, 0.0)
    if gain <= numbers * float(np.log(max(float(np.max(n_eff)), 2.0))) \
            or np.max(missed) <= (0.01 * least) ** 2 or samples.effort.leaves_out(_ASKED):
        return Drift()
    if drifting.cost >= slopes.beside(none, curves_of(samples, slopes.fit)).cost:
        return Drift()
    late = slopes.beside(slopes.drift[:, slopes.delays[~slopes.states]])
    most = int(np.argmax(missed))
    return Drift(place, 100.0 * float(np.sqrt(missed[most])),
                 bool((2.0 * power(late) < before + after)[most]))
