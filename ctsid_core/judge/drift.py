# SPDX-License-Identifier: Apache-2.0
"""
Does the plant drift? What constant numbers miss, and such that move in a straight line do not.

A car that gains speed, a battery that sags, a motor that warms up: a model of the mean is as good
as one can be, and may be what is wanted, but its user should know. Dead times alone drift where
the clocks of input and output run apart. Looked at to first order, beside curves, which a plant
that is not linear follows better.

Or does a gain change and come back? Wheels slip on one floor and not on the next, a gripper picks
up and puts down, a supply sags under other loads: no division of the record and no straight line
in time follows that, and the model is right at no time. What one gain misses, and one that jumps
at some instants does not: jump by jump, the one that explains most first (orthogonal matching
pursuit). How many errors are independent say those of one gain beside a drift or curves: they are
of one sign for long where gains vary, and in gusts, and what is slow by chance does not count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.slopes import (
    INSTANTS,
    NOTHING,
    SEARCHED,
    Own,
    Slopes,
    jumps_of,
    moved_by,
    only,
    recordings,
    slopes_of,
    under_loads,
)
from ctsid_core.likelihood.output_error import Fit, Fitted, Free
from ctsid_core.likelihood.residuals import coloured_power, independent, mean_square
from ctsid_core.likelihood.samples import Residuals, Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.drifting import standing

_PART = 0.3           # of what drifts, that is not told
_LEFT = 0.3           # power of errors, noise apart, that jumps may leave of what others do
_BACK = 0.25          # of what a gain jumps by, at most, that it does not come back


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
    return _costliest(samples, fit, least, lambda k: _drifting(
        only(samples, k).thinned(SEARCHED), (fit.model, free), k, least))


def varying_gains(samples: Samples, fit: Fit, free: Free, names: Sequence[str],
                  means: Sequence[Array]) -> Drift:
    """
    Return how gains vary in the record where that costs most, if more than `NOTED` [%].

    `means` are those of the inputs in each record, (nu,), which the samples are without.
    """
    return _costliest(samples, fit, NOTED, lambda k: _varying(
        samples, (fit.model, free), k, names, means))


def _costliest(samples: Samples, fit: Fit, least: float, of: Callable[[int], Drift]) -> Drift:
    """Return the drift of the recording where it costs most, if a model misses so much [%]."""
    if not np.max(fit.power) > (0.01 * least) ** 2:
        return Drift()
    found = max(map(of, recordings(samples)), key=lambda drift: drift.cost, default=Drift())
    if found.record < 0:
        return found
    # Of a short record it is a small part of all motion.
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
    return Drift(-1, cost(mean.power), late, found, cost(standing(*drifting).power))


def _of_input(name: str, poles: ComplexArray, b: ComplexArray, moved: ComplexArray) -> InputDrift:
    """Return what residues of an input times the time say of its gain and dead time."""
    # Of a gain that changes by a they are a b, of a dead time that changes by d they are -d p b:
    # one of them, if that explains most. Of one state nothing tells these apart: it is the gain
    # then.
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


def _drifting(samples: Samples, own: Own, place: int, least: float) -> Drift:
    asked = 'whether the plant drifts'
    if not samples.counts.all() or samples.effort.leaves_out(asked):
        return Drift()
    slopes = slopes_of(samples, own)
    constant, drifting = slopes.beside(slopes.rows[:, :0]), slopes.beside(slopes.drift)
    if not drifting.cost < constant.cost:
        return Drift()
    numbers, ny = drifting.numbers - constant.numbers, samples.ny
    n_eff = independent(slopes.in_records(drifting.errors))
    before, after = slopes.power(constant), slopes.power(drifting)
    gain = float(n_eff @ np.log(before / after))
    by_chance = after * numbers / ny / np.maximum(n_eff - drifting.numbers / ny, 1.0)
    missed = np.maximum(before - after - by_chance, 0.0)
    if gain <= numbers * float(np.log(max(float(np.max(n_eff)), 2.0))) \
            or np.max(missed) <= (0.01 * least) ** 2 or samples.effort.leaves_out(asked):
        return Drift()
    if drifting.cost >= slopes.curved().cost:
        return Drift()
    late = slopes.beside(slopes.drift[:, slopes.delays[~slopes.states]])
    most = int(np.argmax(missed))
    return Drift(place, 100.0 * float(np.sqrt(missed[most])),
                 bool((2.0 * slopes.power(late) < before + after)[most]))


def _varying(samples: Samples, own: Own, place: int, names: Sequence[str],
             means: Sequence[Array]) -> Drift:
    means = [mean for r, mean in zip(samples.records, means, strict=True)
             if r.recording == samples.records[place].recording and r.end > r.start]
    samples = only(samples, place).thinned(SEARCHED // 2)
    if not samples.counts.all() or samples.effort.leaves_out('whether gains vary'):
        return Drift()
    slopes = slopes_of(samples, own)
    rival = min(slopes.beside(slopes.drift), slopes.curved(), key=lambda left: left.cost)
    if rival.cost == np.inf:            # there are too few samples for either
        return Drift()
    errors = _errors(slopes, rival.errors)
    n_eff, before, noisy = independent(errors), mean_square(errors), coloured_power(errors)
    if not np.max(noisy) > (0.01 * NOTED) ** 2:
        return Drift()
    price = 2.0 * float(np.log(max(float(np.max(n_eff)), 2.0)))     # its size and its instant
    gains = moved_by(slopes, means)
    found, worth = Drift(), 0.0
    # Of one input, or of all of them alike, as where a battery sags
    for inputs in dict.fromkeys((*((j,) for j in range(samples.nu)), tuple(range(samples.nu)))):
        moved = gains[:, :, inputs].sum(axis=2)
        for jumps, left in jumps_of(slopes, moved[:, :, np.newaxis]):
            errors = _errors(slopes, left)
            gain = float(n_eff @ np.log(before / mean_square(errors))) - price * len(jumps)
            coloured = coloured_power(errors)
            i = int(np.argmax(noisy - coloured))
            if gain > worth and coloured[i] < _LEFT * noisy[i]:
                at = np.sort([end for _, _, end in jumps])
                worth, (spread, back) = gain, _spread(slopes, moved, at)
                found = Drift(place, 100.0 * float(np.sqrt((noisy - coloured)[i])), inputs=tuple(
                    InputDrift(names[j], spread, 0.0) for j in inputs), jumps=len(jumps),
                    span=_span(at) if back else ())
                best = coloured
    if not found.cost > NOTED:
        return Drift()
    # Of gusts and pushes loads leave as little.
    loaded = under_loads(slopes, found.jumps, slopes.rows[:, :0])
    told = loaded.cost < np.inf and np.any(
        best < _LEFT * coloured_power(_errors(slopes, loaded.errors)))
    return found if told else Drift()


def _span(at: Array) -> tuple[float, ...]:
    """Return from when to when gains are others than in most of the record, if it is so."""
    first, last = int(at[0]), int(at[-1])
    return (first / INSTANTS, last / INSTANTS) if 0 < last - first < INSTANTS / 2 else ()


def _errors(slopes: Slopes, errors: Array) -> Residuals:
    """Return errors over those of one gain as errors over the motion."""
    size = np.repeat(np.sqrt(slopes.fit.power), slopes.samples.counts.ravel().astype(int))
    return slopes.in_records(size * errors)


def _spread(slopes: Slopes, moved: Array, at: Array) -> tuple[float, bool]:
    """Return the rms by which a gain that jumps differs from its mean, over what is moved."""
    # And whether in the end it is what it was.
    columns, error = slopes.without(moved[at].T)
    jumps = np.linalg.lstsq(columns, error, rcond=NOTHING)[0]
    levels = np.append(0.0, np.cumsum(jumps))
    gains = levels[np.searchsorted(at, (slopes.shares * INSTANTS).astype(int), side='right')]
    mean = np.average(gains, weights=moved[0] ** 2)
    return (float(np.sqrt(np.average((gains - mean) ** 2, weights=moved[0] ** 2))),
            bool(abs(levels[-1]) < _BACK * np.max(np.abs(levels))))
