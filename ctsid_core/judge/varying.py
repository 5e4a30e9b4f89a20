# SPDX-License-Identifier: Apache-2.0
"""
Does a gain change and come back? What one gain misses, and gains of parts of the record do not.

Wheels slip on one floor and not on the next, a gripper picks up and puts down, a supply sags under
other loads: no division of the record and no straight line in time follows that, and the model is
right at no time. Looked at to first order: what each input moves, apart in each part of the
record. How many errors are independent say those of one gain, which are of one sign for long where
gains vary, as they are in gusts: what is slow by chance does not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.curve import curves_of
from ctsid_core.judge.drift import Drift, InputDrift
from ctsid_core.judge.slopes import (
    SEARCHED,
    Left,
    Own,
    Slopes,
    in_records,
    only,
    recordings,
    slopes_of,
)
from ctsid_core.likelihood.output_error import Fit, Free
from ctsid_core.likelihood.residuals import coloured_power, independent
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array

_PARTS = (3, 6, 12, 24)   # of a record, alike in length, that have gains of their own
_LEFT = 0.3               # power of errors, noise apart, that these may leave of what others do
_ASKED = 'whether gains vary'


def varying_gains(samples: Samples, fit: Fit, free: Free, names: Sequence[str]) -> Drift:
    """Return how gains vary in the record where that costs most, if more than `NOTED` [%]."""
    if not np.max(fit.power) > (0.01 * NOTED) ** 2:
        return Drift()
    return max((_of_recording(only(samples, k).thinned(SEARCHED), (fit.model, free), k, names)
                for k in recordings(samples)), key=lambda one: one.cost, default=Drift())


def _of_recording(samples: Samples, own: Own, place: int, names: Sequence[str]) -> Drift:
    if not samples.counts.all() or samples.effort.leaves_out(_ASKED):
        return Drift()
    slopes, most = slopes_of(samples, own), max(_PARTS)
    rival = min((slopes.beside(more) for more in (slopes.drift, curves_of(samples, slopes.fit))),
                key=lambda left: left.cost)
    if not rival.errors:
        return Drift()
    n_eff, before, noisy = _known(slopes, rival)
    price = float(np.log(max(float(np.max(n_eff)), 2.0)))
    steps = np.array([_from_then_on(slopes, k / most) for k in range(most)])
    found, worth = Drift(), 0.0
    # Of one input, or of all of them alike, as where a battery sags
    for inputs in {*((j,) for j in range(samples.nu)), tuple(range(samples.nu))}:
        moved = steps[:, :, inputs].sum(axis=2)
        for count in _PARTS:
            left = slopes.beside(moved[most // count::most // count].T)
            if not left.errors:
                break
            _, after, coloured = _known(slopes, left)
            gain = float(n_eff @ np.log(before / after)) - price * (count - 1)
            i = int(np.argmax(before - after))
            if gain > worth and coloured[i] < _LEFT * noisy[i]:
                worth, spread = gain, _spread(slopes, moved[::most // count])
                found = Drift(
                    place, 100.0 * float(np.sqrt((before - after)[i])),
                    inputs=tuple(InputDrift(names[j], spread, 0.0) for j in inputs),
                    parts=float(np.diff(samples.records[0].span)[0]) / count)
    return found if found.cost > NOTED else Drift()


def _from_then_on(slopes: Slopes, share: float) -> Array:
    """
    Return what inputs move from an instant on, by themselves, (N, nu), outputs over errors.

    It is what they move at all, less what is left of that by then, which decays.
    """
    samples, model = slopes.samples, slopes.fit.model
    found: list[Array] = []
    for record, triangles, power in zip(samples.records, slopes.fit.columns.triangles,
                                        slopes.fit.power, strict=True):
        start, end = record.span
        for s, t in zip(record.streams, triangles, strict=True):
            later = s.times >= start + share * (end - start)
            times, z, u = s.times[later], t.z[later, :, :samples.nu], t.u[later]
            z = z - z[:1] * np.exp(np.multiply.outer(
                times - times[:1], model.poles))[:, :, np.newaxis]
            moved = np.zeros((s.y.shape[1], len(later), samples.nu))
            moved[:, later] = (np.einsum('im,mj,tmj->itj', model.c[s.channels], model.b, z).real
                               + u * model.D[s.channels, np.newaxis])
            moved /= np.sqrt(power[s.channels])[:, np.newaxis, np.newaxis]
            found.extend(moved)
    return np.concatenate(found)


def _known(slopes: Slopes, left: Left) -> tuple[Array, Array, Array]:
    """Return how many errors are independent, their power, and that without noise, (ny,)."""
    samples = slopes.samples
    errors = in_records([e[:, np.newaxis] for e in left.errors], samples)
    power = samples.mean(left.power.reshape(-1, samples.ny) * slopes.fit.power)
    return independent(errors), power, coloured_power(errors)


def _spread(slopes: Slopes, steps: Array) -> float:
    """Return by how much the gains of parts differ, rms over what is moved in them."""
    found = slopes.weights(steps[1:].T)
    gains = np.append(0.0, np.cumsum(found))[
        np.minimum((slopes.shares * len(steps)).astype(int), len(steps) - 1)]
    mean = np.average(gains, weights=steps[0] ** 2)
    return float(np.sqrt(np.average((gains - mean) ** 2, weights=steps[0] ** 2)))
