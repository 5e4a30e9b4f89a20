# SPDX-License-Identifier: Apache-2.0
"""
Outputs that stop moving: a sensor that hangs, or a driver that repeats its last value.

A long run of samples equal to the last bit says so, if the output does not stand still elsewhere,
and inputs move meanwhile as they do in the rest of the window, or there is noise elsewhere,
which never repeats. Coarse sensors repeat values as well, but for a small part of the window, or
at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Record, Signal, channel_slices

_SHARE = 0.08         # of the window in one run
_TIMES = 3.0          # as long as the second longest run
_FEWEST = 10          # samples in it
_MOVES = 0.3          # spread of an input in the run over that in the window
_TURNS = 0.3          # of the steps from sample to sample turn around: of white noise 2/3 do, of
                      # what a sensor shows at 8 bits fewer, for some steps are 0


@dataclass(frozen=True)
class Stuck:
    """An output, by its place among all, and from when to when after the start it is stuck [s]."""

    output: int
    start: float
    end: float


def stuck_outputs(record: Record) -> tuple[Stuck, ...]:
    """Return the outputs of a record that are stuck for a part of it."""
    found = []
    for signal, channels in zip(record.outputs, channel_slices(record.outputs), strict=True):
        inside = signal.rows(record.start, record.end)
        times, values = signal.time[inside], signal.values[inside]
        for output, y in enumerate(values.T, channels.start):
            run = _longest_run(times, y, record.duration)
            if run is None:
                continue
            start, end = times[run]
            if _is_noise(y[:run[0]], y[run[1] + 1:]) or _inputs_move(record, start, end):
                found.append(Stuck(output, start - record.start, end - record.start))
    return tuple(found)


def _longest_run(times: Array, values: Array, duration: float) -> list[int] | None:
    """Return the places of the first and last sample of a run too long to be chance, if any."""
    if len(values) < _FEWEST:
        return None
    ends = np.flatnonzero(np.diff(values, append=np.nan) != 0.0)
    starts = np.concatenate(([0], ends[:-1] + 1))
    spans = times[ends] - times[starts]
    longest = int(np.argmax(spans))
    others = np.delete(spans, longest)
    if len(others) < 2 or ends[longest] - starts[longest] < _FEWEST or \
            spans[longest] < max(_SHARE * duration, _TIMES * float(np.max(others))):
        return None
    return [int(starts[longest]), int(ends[longest])]


def _is_noise(*parts: Array) -> bool:
    """Return whether the steps from sample to sample turn around as often as those of noise."""
    steps = [np.diff(part) for part in parts]
    count = sum(len(step) - 1 for step in steps if len(step) > 1)
    turns = sum(int(np.count_nonzero(step[1:] * step[:-1] < 0.0)) for step in steps)
    return count >= _FEWEST and turns > _TURNS * count


def _inputs_move(record: Record, start: float, end: float) -> bool:
    return any((_spread(s, start, end) > _MOVES * _spread(s, record.start, record.end)).any()
               for s in record.inputs)


def _spread(signal: Signal, start: float, end: float) -> Array:
    values = signal.values[signal.rows(start, end)]
    return values.std(axis=0) if len(values) > 1 else np.zeros(signal.width)
