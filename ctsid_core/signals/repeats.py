# SPDX-License-Identifier: Apache-2.0
"""
Samples that a slower sensor has sent again: they tell nothing new, and are late.

A sensor of 10 Hz in messages of 100 has each value ten times in a row. Taken as samples they are
as many times as sure, and a plant that simulates them holds its output: half an interval of lag,
and states that stand in for it. The first of each is when the sensor was read.

A slower clock is told by its regularity. What is coarse repeats values as well, while it moves
little, and not as regularly; where it moves steadily, all its steps are alike.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array, Mask
from ctsid_core.signals.gaps import FEWEST
from ctsid_core.signals.record import Record, Signal, channel_slices
from ctsid_core.signals.still import is_noise

_REGULAR = 0.8        # of the values come as often in a row as the median, or once more or less
                      # often
_ALIKE = 1e-6         # of the largest step: steps that differ by less are the same
_DISTINCT = 0.5       # of the steps, if there is no noise: those of a coarse sensor are few


def without_repeats(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record with each value of slower sensors once, and a sentence on each of them."""
    found: list[Signal] = []
    notes: list[str] = []
    for signal, channels in zip(record.outputs, channel_slices(record.outputs), strict=True):
        own = [_new(y) for y in signal.values.T]
        # Neighbours of one clock stay together.
        starts = [j for j, new in enumerate(own) if not j or (new != own[j - 1]).any()]
        for first, end in pairwise((*starts, signal.width)):
            new, columns = own[first], slice(first, end)
            if not new.all():
                names = ', '.join(record.output_names[channels][columns])
                notes.append(f'each value of {names} comes about {len(new) / np.sum(new):.2g} '
                             'times in a row, as when a sensor is slower than its messages; the '
                             'first one counts')
            found.append(signal if new.all() and len(starts) == 1 else replace(
                signal, time=signal.time[new], values=signal.values[new, columns],
                names=signal.names[columns], units=signal.units[columns]))
    return (replace(record, outputs=tuple(found)) if notes else record), tuple(notes)


def _new(values: Array) -> Mask:
    """Return which samples of a channel are new; all of them unless a slower clock is seen."""
    new = np.append(True, np.diff(values) != 0.0)[:len(values)]
    starts = np.flatnonzero(new)
    lengths = np.diff(starts)       # the last one may have been cut
    usual = int(np.median(lengths)) if len(lengths) >= FEWEST else 1
    if usual > 1 and _regular(lengths, usual) >= _REGULAR and (
            is_noise(values[new]) or _distinct(values[new])) and \
            len(np.unique(values[new])) >= FEWEST:
        # Where it stands still for longer it was read as often.
        lengths = np.diff(starts, append=len(values))
        since = np.arange(len(values)) - np.repeat(starts, lengths)
        new |= (since % usual == 0) & np.repeat(lengths > usual + 1, lengths)
        return new
    return np.ones(len(values), dtype=bool)


def _regular(lengths: NDArray[np.intp], usual: int) -> float:
    """Return the share of values that come as often as usual, or once more or less."""
    near = [np.mean(np.abs(lengths - usual - half) < 1.0) for half in (-0.5, 0.5)]
    # One, two or three times in a row is anything: two neighbours of these.
    return float(max(near) if usual == 2 else np.mean(np.abs(lengths - usual) <= 1))


def _distinct(values: Array) -> bool:
    """Return whether steps are as many different ones as those of a fine sensor."""
    steps = np.abs(np.diff(values))
    largest = float(np.max(steps))
    return largest > 0.0 and len(np.unique(np.round(steps / (_ALIKE * largest)))) \
        > _DISTINCT * len(steps)
