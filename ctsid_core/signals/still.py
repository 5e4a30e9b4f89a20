# SPDX-License-Identifier: Apache-2.0
"""
Outputs that stand still: a long run of samples that are equal to the last bit.

Long enough not to be chance: coarse sensors repeat values as well, but for a small part of the
window, or again and again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Record, channel_slices

_SHARE = 0.08         # of the window in one run
_TIMES = 3.0          # as long as the second longest run
_FEWEST = 10          # samples in it
_TWICE = 2.0          # as large as what the sensor resolves are steps of noise, half of them
_TURNS = 0.3          # of the steps from sample to sample turn around: of white noise 2/3 do, of
                      # what a sensor shows at 8 bits fewer, for some steps are 0


@dataclass(frozen=True, eq=False)
class Still:
    """A run of equal samples of an output, by its place among all."""

    output: int
    times: Array        # of these samples [s]
    resolution: float   # the smallest step between neighbouring samples elsewhere
    noise_ends: bool    # whether there is noise elsewhere, which never repeats


def longest_still(record: Record) -> tuple[Still, ...]:
    """Return the longest run of each output of a record, where it is too long to be chance."""
    found = []
    for signal, channels in zip(record.outputs, channel_slices(record.outputs), strict=True):
        inside = signal.rows(record.start, record.end)
        times, values = signal.time[inside], signal.values[inside]
        for output, y in enumerate(values.T, channels.start):
            run = _longest_run(times, y, record.duration)
            if run is not None:
                found.append(Still(output, times[run], float(least(np.diff(y))),
                                   _noise_ends(y, run)))
    return tuple(found)


def least(distances: Array) -> Array:
    """Return the smallest of some distances (N,) or (N, m) that is one, or inf."""
    distances = np.abs(distances)
    return np.asarray(np.min(distances, axis=0, where=distances > 0.0, initial=np.inf))


def _noise_ends(y: Array, run: slice) -> bool:
    """
    Return whether there is noise before or after a run, of more than the sensor resolves.

    An encoder that turns counts one more and one less in turns, and at rest it is still: there
    the value nearest to that of the run is a count away.
    """
    parts = (y[:run.start], y[run.stop:])
    steps = np.abs(np.concatenate([np.diff(part) for part in parts]))
    return is_noise(*parts) and float(np.median(steps)) > _TWICE * float(least(y - y[run.start]))


def _longest_run(times: Array, values: Array, duration: float) -> slice | None:
    """Return the places of a run too long to be chance, if any; other values are beside it."""
    ends = np.flatnonzero(np.diff(values, append=np.nan) != 0.0)
    starts = np.concatenate(([0], ends[:-1] + 1))
    spans = times[ends] - times[starts]
    longest = int(np.argmax(spans))
    others = np.delete(spans, longest)
    if len(others) < 2 or ends[longest] - starts[longest] < _FEWEST or \
            spans[longest] < max(_SHARE * duration, _TIMES * float(np.max(others))):
        return None
    return slice(int(starts[longest]), int(ends[longest]) + 1)


def is_noise(*parts: Array) -> bool:
    """Return whether the steps from sample to sample turn around as often as those of noise."""
    steps = [np.diff(part) for part in parts]
    count = sum(len(step) - 1 for step in steps if len(step) > 1)
    turns = sum(int(np.count_nonzero(step[1:] * step[:-1] < 0.0)) for step in steps)
    return count >= _FEWEST and turns > _TURNS * count
