# SPDX-License-Identifier: Apache-2.0
"""
Does a gain change and come back? What one gain misses, and one that jumps at some instants not.

Wheels slip on one floor and not on the next, a gripper picks up and puts down, a supply sags under
other loads: no division of the record and no straight line in time follows that, and the model is
right at no time. Looked at to first order, jump by jump, the one that explains most first
(orthogonal matching pursuit). How many errors are independent say those of one gain beside a drift
or curves: they are of one sign for long where gains vary, and in gusts, and what is slow by chance
does not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.curve import curves_of
from ctsid_core.judge.drift import Drift, InputDrift, over_all
from ctsid_core.judge.jumps import INSTANTS, NOTHING, jumps_of, moved_by, under_loads
from ctsid_core.judge.slopes import SEARCHED, Own, Slopes, in_records, only, recordings, slopes_of
from ctsid_core.likelihood.output_error import Fit, Free, Residuals
from ctsid_core.likelihood.residuals import coloured_power, independent, mean_square
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array

_LEFT = 0.3           # power of errors, noise apart, that jumps may leave of what others do
_BACK = 0.25          # of what a gain jumps by, at most, that it does not come back
_ASKED = 'whether gains vary'


def varying_gains(samples: Samples, fit: Fit, free: Free, names: Sequence[str],
                  means: Sequence[Array]) -> Drift:
    """
    Return how gains vary in the record where that costs most, if more than `NOTED` [%].

    `means` are those of the inputs in each record, (nu,), which the samples are without.
    """
    if not np.max(fit.power) > (0.01 * NOTED) ** 2:
        return Drift()
    found = max((_of_recording(samples, (fit.model, free), k, names, means)
                 for k in recordings(samples)), key=lambda one: one.cost, default=Drift())
    return over_all(found, samples)


def _of_recording(samples: Samples, own: Own, place: int, names: Sequence[str],
                  means: Sequence[Array]) -> Drift:
    means = [mean for r, mean in zip(samples.records, means, strict=True)
             if r.recording == samples.records[place].recording and r.end > r.start]
    samples = only(samples, place).thinned(SEARCHED // 2)
    if not samples.counts.all() or samples.effort.leaves_out(_ASKED):
        return Drift()
    slopes = slopes_of(samples, own)
    rival = min(slopes.beside(slopes.drift), slopes.beside(
        slopes.rows[:, :0], curves_of(samples, slopes.fit)), key=lambda left: left.cost)
    if not rival.errors:
        return Drift()
    errors = _errors(slopes, np.concatenate(rival.errors))
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
    told = loaded.errors and np.any(best < _LEFT * coloured_power(_errors(
        slopes, np.concatenate(loaded.errors))))
    return found if told else Drift()


def _span(at: Array) -> tuple[float, ...]:
    """Return from when to when gains are others than in most of the record, if it is so."""
    first, last = int(at[0]), int(at[-1])
    return (first / INSTANTS, last / INSTANTS) if 0 < last - first < INSTANTS / 2 else ()


def _errors(slopes: Slopes, errors: Array) -> Residuals:
    """Return errors over those of one gain as errors over the motion."""
    parts = np.split(errors, np.cumsum(slopes.counts.astype(int))[:-1])
    return in_records([size * e[:, np.newaxis] for e, size in zip(
        parts, np.sqrt(slopes.fit.power.ravel()), strict=True)], slopes.samples)


def _spread(slopes: Slopes, moved: Array, at: Array) -> tuple[float, bool]:
    """
    Return the rms by which a gain that jumps differs from its mean, over what is moved.

    And whether in the end it is what it was.
    """
    columns, error = slopes.without(moved[at].T)
    jumps = np.linalg.lstsq(columns, error, rcond=NOTHING)[0]
    levels = np.append(0.0, np.cumsum(jumps))
    gains = levels[
        np.searchsorted(at, (slopes.shares * INSTANTS).astype(int), side='right')]
    mean = np.average(gains, weights=moved[0] ** 2)
    return (float(np.sqrt(np.average((gains - mean) ** 2, weights=moved[0] ** 2))),
            bool(abs(levels[-1]) < _BACK * np.max(np.abs(levels))))
