# SPDX-License-Identifier: Apache-2.0
"""
Outputs that stop moving: a sensor that hangs, or a driver that repeats its last value.

A long run of samples equal to the last bit says so, if inputs move meanwhile as they do in the
rest of the window and the output does not stand still elsewhere. Coarse sensors repeat values as
well, but for a small part of the window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Record, Signal

_SHARE = 0.08         # of the window in one run
_TIMES = 3.0          # as long as the second longest run
_FEWEST = 10          # samples in it
_MOVES = 0.3          # spread of an input in the run over that in the window


@dataclass(frozen=True)
class Stuck:
    """An output, by its place among all, and from when to when after the start it is stuck [s]."""

    output: int
    start: float
    end: float


def stuck_outputs(record: Record) -> tuple[Stuck, ...]:
    """Return the outputs of a record that are stuck for a part of it."""
    found, first = [], 0
    for signal in record.outputs:
        inside = (signal.time >= record.start) & (signal.time <= record.end)
        times, values = signal.time[inside], signal.values[inside]
        for i in range(signal.width):
            run = _longest_run(times, values[:, i], record.duration)
            if run is not None and _inputs_move(record, *run):
                found.append(Stuck(first + i, run[0] - record.start, run[1] - record.start))
        first += signal.width
    return tuple(found)


def _longest_run(times: Array, values: Array, duration: float) -> tuple[float, float] | None:
    """Return the first and the last stamp of the run that is too long to be chance, if any."""
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
    return float(times[starts[longest]]), float(times[ends[longest]])


def _inputs_move(record: Record, start: float, end: float) -> bool:
    return any((_spread(s, start, end) > _MOVES * _spread(s, record.start, record.end)).any()
               for s in record.inputs)


def _spread(signal: Signal, start: float, end: float) -> Array:
    inside = (signal.time >= start) & (signal.time <= end)
    values = signal.values[inside]
    spread: Array = values.std(axis=0) if len(values) > 1 else np.zeros(signal.width)
    return spread
