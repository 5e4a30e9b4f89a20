# SPDX-License-Identifier: Apache-2.0
"""
Signals of a bag side by side: all of it, or stretches that are spread over its length.

What is read and kept is bounded whatever the size of the bag. The time of a sample is its
header's, moved to the clock of the recording where that is another one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_ros.decoding.block import Columns
from ctsid_ros.decoding.field_path import FieldPath
from ctsid_ros.recordings.bag import Bag
from ctsid_ros.recordings.portions import portions
from ctsid_ros.recordings.survey import CLOCKS, Survey, TopicSurvey

MOST_NUMBERS = 20_000_000  # that are kept: 160 MB
_MOST_RATE, _MOST_TICKS = 100.0, 60_000  # of the common clock [Hz]; robots move below 20 Hz
_LOST = 5.0  # intervals without a sample after which an output is not known, and a driver may stop
_LOST_S = 0.3  # s: but not before
_SECOND, _SAMPLES = 1.0, 10.0  # s: a unit of time; more where samples are rare: plants are slower


@dataclass(frozen=True)
class Samples:
    """
    The samples of some fields of a topic.

    Parameters
    ----------
    time : ndarray, shape (N,)
        After the start of the bag [s], not decreasing.
    values : ndarray, shape (N, k)
    """

    time: Array
    values: Array


@dataclass(frozen=True)
class Clock:
    """
    The common clock of an excerpt of several stretches.

    Parameters
    ----------
    time : ndarray, shape (N,)
        Its ticks, after the start of the bag [s].
    step : float
        Between two ticks of a stretch [s].
    starts : tuple of int
        Where stretches begin.
    """

    time: Array
    step: float
    starts: tuple[int, ...]

    @property
    def unit(self) -> float:
        """The unit of time, in ticks."""
        return unit_of_time(self.step) / self.step

    @property
    def parts(self) -> list[slice]:
        """The stretches."""
        return [slice(*pair) for pair in
                zip(self.starts, (*self.starts[1:], len(self.time)), strict=True)]


def unit_of_time(step: float) -> float:
    """Return what a second is to a robot where samples are so far apart [s]."""
    return max(_SECOND, _SAMPLES * step)


def gather(bag: Bag, survey: Survey, fields: Mapping[str, Sequence[FieldPath]]
           ) -> tuple[dict[str, Samples], list[tuple[float, float]]]:
    """
    Return the samples of some fields by topic, and the stretches they are of [s].

    Parameters
    ----------
    bag : Bag
    survey : Survey
    fields : mapping of str to sequence of FieldPath

    Raises
    ------
    BagError
        If the bag cannot be read on.
    """
    numbers = sum(bag.topics[topic].count * len(paths) for topic, paths in fields.items())
    parts = portions(bag, MOST_NUMBERS / max(numbers, 1))
    found: dict[str, list[Columns]] = {topic: [] for topic in fields}
    for first, last in parts:
        span = tuple(bag.start_ns + round(t * 1e9) for t in (first, last))
        for block in bag.blocks(fields, (span[0], span[1])):
            for rows in block.columns:
                found[rows.topic].append(rows[np.flatnonzero(
                    rows.sound & (rows.log_ns >= span[0]) & (rows.log_ns <= span[1]))])
    topics = {t.info.name: t for t in survey.topics}
    return {name: _samples(rows, topics[name], fields[name], bag.start_ns)
            for name, rows in found.items()}, parts


def _samples(rows: Sequence[Columns], topic: TopicSurvey, paths: Sequence[FieldPath],
             start_ns: int) -> Samples:
    if not rows:
        return Samples(np.empty(0), np.empty((0, len(paths))))
    log = np.concatenate([r.log_ns for r in rows])
    stamps = log
    if topic.stamp == 'header':
        header = np.concatenate([r.header_ns for r in rows if r.header_ns is not None])
        late = round(topic.late * 1e9) if abs(topic.late) > CLOCKS else 0
        stamps = np.where(header > 0, header + late, log)
    values = np.concatenate([r.values for r in rows]).astype(float)
    order = np.argsort(stamps, kind='stable')
    values = values[order]
    for i, path in enumerate(paths):
        good = np.isfinite(values[:, i])
        if path.euler and good.any():
            values[good, i] = np.unwrap(values[good, i])
    return Samples((stamps[order] - start_ns) * 1e-9, values)


def clock_for(rates: Sequence[float], parts: Sequence[tuple[float, float]]) -> Clock:
    """Return a clock on which signals of these rates [Hz] can be compared."""
    total = sum(last - first for first, last in parts)
    rate = min(_MOST_RATE, max([r for r in rates if math.isfinite(r)], default=_MOST_RATE),
               _MOST_TICKS / max(total, 1e-9))
    ticks = [np.arange(first, last, 1 / rate) for first, last in parts]
    starts = np.cumsum([0, *(len(t) for t in ticks)])[:-1]
    return Clock(np.concatenate(ticks), 1 / rate, tuple(starts.tolist()))


def held(time: Array, values: Array, clock: Clock, timeout: float = math.inf) -> Array:
    """
    Return a signal that is held from sample to sample at the ticks; NaN before the first.

    After a `timeout` [s] without a sample within a stretch it is 0, until the next one.
    """
    if not len(time):
        return np.full(len(clock.time), np.nan)
    at = np.searchsorted(time, clock.time + 1e-9, side='right') - 1
    last = np.maximum(at, 0)
    begun = np.concatenate([np.full(p.stop - p.start, clock.time[p][0]) for p in clock.parts])
    silent = clock.time - np.maximum(time[last], begun)
    acts = np.where(silent < timeout, values[last], 0.0)
    return np.where(at >= 0, acts, np.nan)


def lost_after(time: Array) -> float:
    """Return for how long no sample comes before one is missing [s]."""
    return max(_LOST * float(np.median(np.diff(time))), _LOST_S) if len(time) > 1 else math.inf


def averaged(time: Array, values: Array, clock: Clock) -> Array:
    """Return a measured signal at the ticks, averaged around them; NaN where it is not known."""
    if len(time) < 2:
        return np.full(len(clock.time), np.nan)
    result = np.interp(clock.time, time, values)
    period = float(np.median(np.diff(time)))
    if 2 * period < clock.step:      # without the mean, noise would be folded into the band
        for part in clock.parts:
            own = clock.time[part]
            cell = np.floor((time - own[0]) / clock.step + 0.5).astype(int)
            inside = (cell >= 0) & (cell < len(own))
            count = np.bincount(cell[inside], minlength=len(own))
            mean = np.bincount(cell[inside], values[inside], minlength=len(own))
            result[part] = np.where(count > 0, mean / np.maximum(count, 1), result[part])
    after = np.clip(np.searchsorted(time, clock.time), 1, len(time) - 1)
    gap = time[after] - time[after - 1]
    lost = (gap > lost_after(time)) | (clock.time < time[0]) | (clock.time > time[-1])
    return np.where(lost, np.nan, result)
