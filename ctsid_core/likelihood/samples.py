# SPDX-License-Identifier: Apache-2.0
"""The raw samples of records, ready for models to be compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from ctsid_core.effort import Effort
from ctsid_core.likelihood.kernel import Kernel, Layout, Shape, Timed, kernel_of
from ctsid_core.linear.types import Array, Mask, Places
from ctsid_core.model.modal import Drive
from ctsid_core.signals.gaps import FEWEST
from ctsid_core.signals.record import Record, Signal, placed

Residuals = tuple[tuple[Array, ...], ...]      # of each record and stream, (N, channels)
_DRIVES: WeakKeyDictionary[Signal, Drive] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Stream:
    """Samples of outputs that share their stamps."""

    times: Array     # (N,): increasing [s]
    y: Array         # (N, channels): over the size of each output
    channels: slice  # their places among all outputs

    @cached_property
    def period(self) -> float:
        """Median interval between stamps [s]; infinite for fewer than two samples."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else np.inf

    def of(self, rows: Places | Mask) -> Stream:
        """Return some of the samples."""
        return replace(self, times=self.times[rows], y=self.y[rows])


def slowest(signals: Sequence[Stream | Signal]) -> float:
    """Return the longest period, of what has one: a single sample has not."""
    return max((s.period for s in signals if s.period < np.inf), default=np.inf)


@dataclass(frozen=True, eq=False)
class RecordSamples:
    """The samples of one record."""

    inputs: tuple[Signal, ...]
    start: float  # where its states begin [s]
    end: float
    streams: tuple[Stream, ...]
    span: tuple[float, float]  # of the recording that it is all of, or a part of [s]
    recording: int             # the number of that
    commands: tuple[Signal, ...] = ()   # the inputs as they were sent

    @cached_property
    def drives(self) -> tuple[Drive, ...]:
        """The inputs as polynomials: of each made once, for all samples that have it."""
        for s in self.inputs:
            if s not in _DRIVES:
                _DRIVES[s] = Drive.of(s)
        return tuple(_DRIVES[s] for s in self.inputs)


@dataclass(frozen=True, eq=False)
class Samples:
    """The samples of all records of one plant."""

    records: tuple[RecordSamples, ...]
    nu: int         # number of inputs
    ny: int
    size: Array     # (ny,): standard deviation of each output, that it was divided by
    effort: Effort  # that looking at them is part of

    @property
    def rank(self) -> int:
        """Largest rank of a residue."""
        return min(self.nu, self.ny)

    @cached_property
    def counts(self) -> Array:
        """Number of samples of each record and output, (records, ny)."""
        found = np.zeros((len(self.records), self.ny))
        for row, record in zip(found, self.records, strict=True):
            for stream in record.streams:
                row[stream.channels] = len(stream.times)
        return found

    @cached_property
    def size_of_all(self) -> tuple[float, float]:
        """Number of stamps of all outputs, and of all inputs in the time of the records."""
        return (sum(float(len(s.times)) for r in self.records for s in r.streams), sum(
            float(len(s.time[s.rows(r.start, r.end)])) for r in self.records for s in r.inputs))

    @cached_property
    def layouts(self) -> dict[tuple[Shape, bool], Layout]:
        """Where columns are, as far as it was asked."""
        return {}

    @cached_property
    def kernel(self) -> Kernel | None:
        """The compiled kernel with these samples, where there is one."""
        return kernel_of([Timed(r.start, r.drives, [(s.times, s.y, s.channels.start)
                                                    for s in r.streams])
                          for r in self.records], self.nu, self.ny)

    def mean(self, values: Array) -> Array:
        """Return what records and outputs have, (records, ny), over all their samples, (ny,)."""
        return np.asarray(np.average(values, axis=0, weights=self.counts))

    @property
    def interval(self) -> float:
        """Median interval of the slowest output [s]."""
        return slowest([s for r in self.records for s in r.streams])

    @property
    def finest(self) -> float:
        """Median interval of the finest output [s]."""
        return min(s.period for r in self.records for s in r.streams)

    @cached_property
    def held(self) -> Array:
        """How long the values of each input are held in the first record [s], (nu,)."""
        inputs = self.records[0].inputs
        return np.repeat([s.held for s in inputs], [s.width for s in inputs])

    @cached_property
    def length(self) -> float:
        """Length of the longest record [s]."""
        return max(r.end - r.start for r in self.records)

    def thinned(self, most: int, scattered: bool = False) -> Samples:
        """
        Return one of every k samples of each stream, such that about `most` are left of each.

        And some more for each further record, for its states are more numbers. The first one, or
        `scattered`: any of them. At regular instants a fast resonance may look like a slow one,
        and what an input does as regularly is seen always or never.
        """
        longest = [sum(len(s.times) for s in streams)
                   for streams in zip(*(r.streams for r in self.records), strict=True)]
        most += FEWEST * (len(self.records) - 1)
        steps = [max(-(-total // most), 1) for total in longest]
        if max(steps) < 2:
            return self
        return replace(self, records=tuple(replace(r, streams=tuple(
            s.of(_places(len(s.times), step, scattered))
            for s, step in zip(r.streams, steps, strict=True)))
            for r in self.records))

    def between(self, bounds: Sequence[tuple[float, float]]) -> Samples:
        """Return the samples of each record within its bounds [s]; states begin where they do."""
        return replace(self, records=tuple(
            replace(r, streams=tuple(s.of((start <= s.times) & (s.times <= end))
                                     for s in r.streams))
            for r, (start, end) in zip(self.records, bounds, strict=True)))


def _places(count: int, step: int, scattered: bool) -> Places:
    """Return a place in every so many: the first, or any, the same ones each time."""
    places: Places = np.arange(0, count, step)
    if scattered:
        places += np.random.default_rng(0).integers(step, size=len(places))
    return np.minimum(places, count - 1, dtype=np.intp)


def samples_of(records: Sequence[Record], corrupt: Sequence[Sequence[Mask | None]],
               ahead: float = 0.0, effort: Effort | None = None) -> Samples:
    """
    Return the samples of records of the same channels.

    `corrupt` rows of each output signal of each record are left out, masks (N,) or None, and
    outputs for `ahead` [s], the longest dead time, after the first known value of an input.
    """
    levels = [np.concatenate([s.values[s.rows(r.start, r.end)] for r in records
                              for s in [r.outputs[i]]])
              for i in range(len(records[0].outputs))]
    size = np.concatenate([np.std(level, axis=0) for level in levels])
    size[~(size > 0.0)] = 1.0
    found, recordings = [], []
    for record, bad in zip(records, corrupt, strict=True):
        first = max(record.start, min(record.known_from([ahead] * record.nu), record.end))
        streams = []
        for (s, channels), left_out in zip(placed(record.outputs), bad, strict=True):
            rows = (s.time >= first) & (s.time <= record.end)
            if left_out is not None:
                rows &= ~left_out
            streams.append(Stream(s.time[rows], s.values[rows] / size[channels], channels))
        whole = record.recording
        if whole not in recordings:
            recordings.append(whole)
        span = (first, record.end) if whole is record else (whole.start, whole.end)
        found.append(RecordSamples(record.inputs, first, record.end, tuple(streams),
                                   span, recordings.index(whole), record.commands))
    return Samples(tuple(found), records[0].nu, len(size), size, effort or Effort())
