# SPDX-License-Identifier: Apache-2.0
"""
Samples as predictors see them: with the outputs' own past among the inputs.

A predictor goes from sample to sample, and so does its time: stamps that jitter around even ones
are put there, and inputs with them, so that what comes before what stays as it is. On its way a
predictor forgets as much in a long interval as in a short one; with stamps as they are it would
forget more, and what it forgets would be taken for the plant's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ctsid_core.likelihood.output_error import Fit
from ctsid_core.likelihood.residuals import residuals
from ctsid_core.likelihood.samples import RecordSamples, Samples, Stream, slowest
from ctsid_core.likelihood.state_space import matrices_of, mean_around
from ctsid_core.linear.matrix_functions import exponentials, led_through
from ctsid_core.linear.types import Array, Mask, Matrices
from ctsid_core.signals.record import Signal

HORIZONS = (1, 10, 50)      # samples ahead that predictions go
AHEAD = 1                   # place of the one whose fit is reported
_JITTER = 0.1               # of a sample interval: of stamps that are of one instant
_AS_RARE = 0.7              # of the interval of the slowest output, from which on one is as slow
_FEW = 5                    # samples before and after a gap, that tell what is missing in it
_SAME = 1e-9                # of a record, by which even stamps are rounded
_RULE = 0.5                 # of the samples around that come after gaps: it is another rate

Lost = list[list[Mask]]      # rows of the own past that were lost, of each record and stream


def with_own_past(samples: Samples) -> Samples:
    """Return the samples with the outputs, held from each to the next, as further inputs."""
    even = [_even(_as_rare(r)) for r in _before_inputs(samples).records]
    return replace(samples, nu=samples.nu + samples.ny, records=tuple(
        replace(r, inputs=(*r.inputs, *(Signal(*carried_on(s.times, s.y), 'zoh')
                                        for s in r.streams))) for r in even))


def after_samples(joint: Samples) -> Samples:
    """Return the samples without those just after what was lost: no measured past tells these."""
    # Not where half of those around are so, for it is their rate there.
    def told(times: Array) -> Mask:
        after = np.append(0, _lost_after(times)[:-1])[:len(times)] > 0
        reach = min(HORIZONS[-1], max(len(times) - 1, 0))
        return ~after | (mean_around(after.astype(float), reach) > _RULE)

    return replace(joint, records=tuple(replace(r, streams=tuple(
        s.of(told(s.times)) for s in r.streams)) for r in joint.records))


def lost_of(joint: Samples) -> Lost:
    """Return which rows of the own past were lost, if any: of each record and stream, (N,)."""
    found = [[~np.isin(past.time, s.times) for past, s in zip(_past(r), r.streams, strict=True)]
             for r in joint.records]
    return found if any(rows.any() for own in found for rows in own) else []


def foretold(joint: Samples, fit: Fit, lost: Lost) -> Samples:
    """Return the samples with what was lost of the past as a predictor tells it."""
    # That is a filter which goes on without samples: what it does not learn, it does not correct.
    m, nu = matrices_of(fit.model, np.ones(joint.ny)), joint.nu - joint.ny
    there = replace(joint, records=tuple(replace(r, streams=tuple(
        replace(s, times=past.time[rows], y=past.values[rows])
        for s, past, rows in zip(r.streams, _past(r), own, strict=True)))
        for r, own in zip(joint.records, lost, strict=True)))
    return replace(joint, records=tuple(replace(r, inputs=(
        *r.inputs[:-len(r.streams)], *_told(m, m.B[:, nu:], r, own, errors)))
        for r, own, errors in zip(joint.records, lost, residuals(there, fit), strict=True)))


def _told(m: Matrices, K: Array, record: RecordSamples, lost: Sequence[Mask],
          errors: Sequence[Array]) -> list[Signal]:
    """Return the own past of a record with what a predictor tells where it was lost."""
    # `errors`: what stands there now less what is predicted. What another value there changes in
    # all later ones are states of the predictor (1), and in the values that are held.
    n, ny, pasts = len(m.A), len(m.C), _past(record)
    times = np.concatenate([past.time for past in pasts])
    order = np.argsort(times, kind='stable')
    hold, change = np.ones((len(times), ny)), np.zeros((len(times), ny))
    gone, at = np.zeros((len(times), ny), dtype=bool), 0
    for s, past, rows, e in zip(record.streams, pasts, lost, errors, strict=True):
        own = slice(at, at := at + len(past.time))
        hold[own, s.channels] = 0.0                     # a sample takes the place of the last one
        gone[own, s.channels] = rows[:, np.newaxis]
        change[own, s.channels][rows] = -e
    hold, gone, change = hold[order], gone[order], change[order]
    F, G = exponentials(m.A, np.diff(times[order], append=times[order[-1]]), 1)
    over, both = np.zeros((len(times), n + ny, n + ny)), np.zeros((len(times), n + ny, n + ny))
    over[:, :n, :n], over[:, :n, n:], over[:, n:, n:] = F, G @ K, np.eye(ny)
    both[:, :n, :n], both[:, n:, :n] = np.eye(n), gone[:, :, np.newaxis] * m.C
    both[:, n:, n:] = hold[:, :, np.newaxis] * np.eye(ny)
    states = led_through(over @ both, over[:, :, n:] @ change[:, :, np.newaxis],
                         np.zeros((n + ny, 1)))[:, :n, 0]
    change += gone * (states @ m.C.T)
    change[order] = change.copy()
    ends = np.cumsum([len(past.time) for past in pasts])[:-1]
    return [replace(past, values=past.values + made[:, s.channels])
            for s, past, made in zip(record.streams, pasts, np.split(change, ends), strict=True)]


def _past(record: RecordSamples) -> tuple[Signal, ...]:
    return record.inputs[-len(record.streams):]


def held_interval(joint: Samples) -> float:
    """Return the median interval of the slowest output, however thin the samples are [s]."""
    return slowest([s for r in joint.records for s in _past(r)])


def carried_on(times: Array, y: Array) -> tuple[Array, Array]:
    """
    Return samples with those that were lost, as far as the two before tell.

    On a straight line for as long as these are apart, held from there, and no further than
    predictions go: what comes later is what is to be predicted.
    """
    lost = _lost_after(times)
    lost[:1] = 0
    if not lost.any():
        return times, y
    gaps = np.diff(times)
    apart, lost = np.append(gaps, 0.0) / (lost + 1), np.minimum(lost, HORIZONS[-1])
    last = np.repeat(np.arange(len(times)), lost + 1)
    step = np.arange(len(last)) - np.repeat(np.cumsum(lost + 1) - lost - 1, lost + 1)
    after = step * apart[last]
    before = np.maximum(last - 1, 0)
    share = np.minimum(after / np.where(last > 0, times[last] - times[before], 1.0), 1.0)
    return times[last] + after, y[last] + share[:, np.newaxis] * (y[last] - y[before])


def _lost_after(times: Array) -> NDArray[np.intp]:
    """Return how many samples were lost after each."""
    # As many as are missing between those before and those after: one that is late itself is not.
    lost = np.zeros(len(times), dtype=np.intp)
    if len(times) > 1:
        gaps = np.diff(times) / np.median(np.diff(times))
        ahead = np.pad(np.cumsum(gaps - 1.0), (_FEW, _FEW - 1), mode='edge')
        ahead[:_FEW] = 0.0
        usual = np.median(sliding_window_view(ahead, _FEW), axis=1)
        missing = np.round(np.minimum(gaps - 1.0, usual[_FEW:] - usual[:-_FEW]))
        lost[:-1] = np.maximum(missing, 0.0)
    return lost


def _before_inputs(samples: Samples) -> Samples:
    """Return the samples, those that closely follow an input put to its instant."""
    # In closed loop an input is computed from the sample before it and tells its noise. Where
    # stamps jitter it may seem to be the earlier one, and would predict it.
    near = _JITTER * samples.interval

    def earlier(times: Array, inputs: tuple[Signal, ...], start: float) -> Array:
        stamps = np.unique(np.concatenate([s.time for s in inputs]))
        last = stamps[np.clip(np.searchsorted(stamps, times, side='right') - 1, 0, None)]
        moved = np.maximum(last, start)
        # Of two samples as near to it only the first one is put there.
        apart = moved > np.concatenate(([-np.inf], times[:-1]))
        return np.where((times >= last) & (times - last < near) & apart, moved, times)

    return replace(samples, records=tuple(replace(r, streams=tuple(
        replace(s, times=earlier(s.times, r.inputs, r.start)) for s in r.streams))
        for r in samples.records))


def _rarest(record: RecordSamples) -> Stream:
    return max(record.streams, key=lambda s: (s.period < np.inf, s.period))


def _as_rare(record: RecordSamples) -> RecordSamples:
    """Return a record with the last samples of all outputs before those of the slowest."""
    # A predictor of the samples of several rates is another one from each of them to the next.
    rarest = _rarest(record)
    return replace(record, streams=tuple(
        s if not len(s.times) or s.period > _AS_RARE * rarest.period or s is rarest else s.of(
            np.unique(np.clip(np.searchsorted(s.times, rarest.times, side='right') - 1, 0, None)))
        for s in record.streams))


def _even(record: RecordSamples) -> RecordSamples:
    """Return a record in the time of its slowest output's samples, those of others evened, too."""
    times = _rarest(record).times
    if len(times) < 2:
        return record
    even = _evened(times)

    def moved(stamps: Array) -> Array:
        beyond = stamps - np.clip(stamps, times[0], times[-1])
        return np.asarray(np.interp(stamps, times, even) + beyond)
    inputs = tuple(replace(s, time=moved(s.time)) for s in record.inputs)
    stamps = np.unique(np.concatenate([s.time for s in inputs]))
    # Not before the start by rounding
    return replace(record, inputs=inputs, streams=tuple(replace(s, times=np.maximum(_between(
        stamps, moved(s.times), _evened(s.times)), record.start)) for s in record.streams))


def _between(stamps: Array, times: Array, even: Array) -> Array:
    """Return times that are as even as can be without going past a stamp of an input."""
    ends, place = np.pad(stamps, 1, constant_values=(-1e300, 1e300)), np.searchsorted(
        stamps, times, side='right')
    low, high = ends[place], ends[place + 1]
    return np.where(times == low, times, np.clip(
        even, low + _JITTER * (times - low), high - _JITTER * (high - times)))


def _evened(times: Array) -> Array:
    """Return stamps as even as they are over the samples that predictions go ahead."""
    # The mean of as many on both sides, as if none was lost in between; samples that are further
    # apart are apart. The first and the last one stay where they are.
    lost, found = _lost_after(times), times.copy()
    for rows in np.split(np.arange(len(times)), np.flatnonzero(lost > HORIZONS[-1]) + 1):
        if not len(rows):
            continue
        place = np.cumsum(lost[rows] + 1) - lost[rows] - 1
        every = np.interp(np.arange(place[-1] + 1), place, times[rows])
        reach = min(HORIZONS[-1], len(every) - 1)
        found[rows] = every[0] + mean_around(every - every[0], reach, 'odd')[place]
    even = len(times) > 1 and np.max(np.abs(found - times)) <= _SAME * np.ptp(times)
    return times if even else found
