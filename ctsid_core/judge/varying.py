# SPDX-License-Identifier: Apache-2.0
"""
Does a gain change and come back? What one gain misses, and one that jumps at some instants not.

Wheels slip on one floor and not on the next, a gripper picks up and puts down, a supply sags under
other loads: no division of the record and no straight line in time follows that, and the model is
right at no time. Looked at to first order, jump by jump, the one that explains most first
(orthogonal matching pursuit). How many errors are independent say those of one gain beside a drift
or curves: they are of one sign for long where gains vary, and in gusts, and what is slow by chance
does not count.

References
----------
Pati, Rezaiifar and Krishnaprasad 1993, Asilomar Conference (orthogonal matching pursuit).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np

from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.curve import curves_of
from ctsid_core.judge.drift import Drift, InputDrift, over_all
from ctsid_core.judge.slopes import SEARCHED, Own, Slopes, in_records, only, recordings, slopes_of
from ctsid_core.likelihood.output_error import Fit, Free, Residuals
from ctsid_core.likelihood.residuals import coloured_power, independent, mean_square
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array

_INSTANTS = 48        # parts of a record, between which a gain may jump, ...
_MOST = 20            # ... so many times
_LEFT = 0.3           # power of errors, noise apart, that jumps may leave of what others do
_NOTHING = 1e-4       # of a column: less is left of it by rounding
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
    gains = _moved(slopes, means)
    found, worth = Drift(), 0.0
    # Of one input, or of all of them alike, as where a battery sags
    for inputs in dict.fromkeys((*((j,) for j in range(samples.nu)), tuple(range(samples.nu)))):
        moved = gains[:, :, inputs].sum(axis=2)
        for jumps, left in _jumps(slopes, moved[1:].T):
            errors = _errors(slopes, left)
            gain = float(n_eff @ np.log(before / mean_square(errors))) - price * len(jumps)
            coloured = coloured_power(errors)
            i = int(np.argmax(noisy - coloured))
            if gain > worth and coloured[i] < _LEFT * noisy[i]:
                worth, spread = gain, _spread(slopes, moved, np.sort(jumps) + 1)
                found = Drift(place, 100.0 * float(np.sqrt((noisy - coloured)[i])), inputs=tuple(
                    InputDrift(names[j], spread, 0.0) for j in inputs), jumps=len(jumps),
                    span=_span(jumps))
                best = coloured
    # Gusts are jumps of a load, which those of a gain imitate.
    imitated = found.cost > NOTED and any(
        not np.any(best < _LEFT * coloured_power(_errors(slopes, left)))
        for load in _moved(slopes, None).T
        for _, left in islice(_jumps(slopes, load[:, 1:]), found.jumps - 1, found.jumps))
    return found if found.cost > NOTED and not imitated else Drift()


def _span(jumps: Sequence[int]) -> tuple[float, ...]:
    """Return from when to when gains are others than in most of the record, if it is so."""
    first, last = min(jumps) + 1, max(jumps) + 1
    return (first / _INSTANTS, last / _INSTANTS) if 0 < last - first < _INSTANTS / 2 else ()


def _errors(slopes: Slopes, errors: Array) -> Residuals:
    """Return errors over those of one gain as errors over the motion."""
    parts = np.split(errors, np.cumsum(slopes.counts.astype(int))[:-1])
    return in_records([size * e[:, np.newaxis] for e, size in zip(
        parts, np.sqrt(slopes.fit.power.ravel()), strict=True)], slopes.samples)


def _jumps(slopes: Slopes, columns: Array) -> Iterator[tuple[list[int], Array]]:
    """Yield the columns that explain most beside those before, and the errors that are left."""
    slopes.samples.effort.spend(2.0 * columns.size * slopes.rows.shape[1])
    columns, error = slopes.without(columns)
    least, found = _NOTHING * np.linalg.norm(columns, axis=0), list[int]()
    while len(found) < _MOST:
        slopes.samples.effort.spend(3.0 * columns.size)
        size = np.linalg.norm(columns, axis=0)
        tells = np.where(size > least, np.abs(error @ columns) / np.maximum(size, 1e-300), 0.0)
        if not np.max(tells) > 0.0:
            return
        found.append(int(np.argmax(tells)))
        best = columns[:, found[-1]] / size[found[-1]]
        error = error - best * (best @ error)
        columns = columns - np.multiply.outer(best, best @ columns)
        yield found.copy(), error


def _moved(slopes: Slopes, means: Sequence[Array] | None) -> Array:
    """
    Return what inputs move from each instant on, (instants, N, nu), outputs over errors.

    By themselves: what they move at all, less what is left of that by then, which decays, and
    what their `means` move. Without these what a constant load at each of them moves.
    """
    samples, model = slopes.samples, slopes.fit.model
    found = np.zeros((_INSTANTS, len(slopes.error), samples.nu))
    at = 0
    for r, (record, triangles) in enumerate(zip(samples.records, slopes.fit.columns.triangles,
                                                strict=True)):
        mean = np.ones(samples.nu) if means is None else means[r]
        start, end = record.span
        for s, t in zip(record.streams, triangles, strict=True):
            (count, channels), size = s.y.shape, np.sqrt(slopes.fit.power[r, s.channels])
            residues = (model.c[s.channels] / size[:, np.newaxis]).T \
                * model.b.T[:, :, np.newaxis]                           # (nu, m, channels)
            direct = (model.D[s.channels] / size[:, np.newaxis]).T[:, np.newaxis]
            inputs = (t.z[:, :, :samples.nu], t.u) if means is not None else (
                np.zeros((count, len(model.poles), samples.nu)), np.zeros((count, samples.nu)))
            for k in range(_INSTANTS):
                first = int(np.searchsorted(s.times, start + k / _INSTANTS * (end - start)))
                if first == count:
                    break
                z, u = (one[first:] for one in inputs)
                since = s.times[first:, np.newaxis] - s.times[first:first + 1]
                rising = np.where(model.poles == 0.0, since, np.expm1(since * model.poles)
                                  / np.where(model.poles == 0.0, 1.0, model.poles))
                z = z - z[:1] * np.exp(since * model.poles)[:, :, np.newaxis] \
                    + np.multiply.outer(rising, mean)
                moved = (z.transpose(2, 0, 1) @ residues).real \
                    + (u + mean).T[:, :, np.newaxis] * direct           # (nu, N, channels)
                places = at + first + count * np.arange(channels)[:, np.newaxis] \
                    + np.arange(count - first)
                found[k, places] = moved.transpose(2, 1, 0)
            at += count * channels
    return found


def _spread(slopes: Slopes, moved: Array, at: Array) -> float:
    """Return the rms by which a gain that jumps differs from its mean, over what is moved."""
    columns, error = slopes.without(moved[at].T)
    jumps = np.linalg.lstsq(columns, error, rcond=_NOTHING)[0]
    gains = np.append(0.0, np.cumsum(jumps))[
        np.searchsorted(at, (slopes.shares * _INSTANTS).astype(int), side='right')]
    mean = np.average(gains, weights=moved[0] ** 2)
    return float(np.sqrt(np.average((gains - mean) ** 2, weights=moved[0] ** 2)))
