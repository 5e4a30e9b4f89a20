# SPDX-License-Identifier: Apache-2.0
"""
Samples on straight lines between those of a slower sensor: a table that was resampled.

They tell nothing new, their noise is no noise, and what lies between two samples tells the later
one before it was measured. Where neighbouring lines meet the sensor was read.

Values that are sent again are left out before (`repeats.py`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_core.signals.gaps import FEWEST
from ctsid_core.signals.record import Record, Signal, channel_slices

_STRAIGHT = 0.01      # of the usual change of a slope: less is none
_PAIRED = 0.95        # of neighbours that would be pairs are
_BLOCK = 40           # samples in which the same neighbours are
_MOST = 0.8           # of the samples lie on lines, and of these meet where they should


def without_interpolated(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record with outputs where their sensors were read, and a sentence on each."""
    found: list[Signal] = []
    notes: list[str] = []
    for signal, channels in zip(record.outputs, channel_slices(record.outputs), strict=True):
        read = _read(signal)
        found.append(read or signal)
        if read:
            notes.append(f'samples of {", ".join(record.output_names[channels])} lie on straight '
                         f'lines, about {len(signal.time) / len(read.time):.2g} on each, as '
                         'between those of a slower sensor in a table that was resampled; where '
                         'lines meet it was read, and that counts')
    return (replace(record, outputs=tuple(found)) if notes else record), tuple(notes)


def _read(signal: Signal) -> Signal | None:
    """Return the samples of a slower sensor that those of a signal lie between, if they do."""
    t, y = signal.time, signal.values
    if len(t) < FEWEST:
        return None
    with np.errstate(all='ignore'):         # torn values
        slopes = np.diff(y, axis=0) / np.diff(t)[:, np.newaxis]
        turns = np.diff(slopes, axis=0)
        least = _STRAIGHT * np.sqrt(np.mean(turns ** 2, axis=0))
        first, last = _in_pairs(turns)
        if not len(first):
            inner = np.all(np.abs(turns) <= least, axis=1)
            first, last = np.flatnonzero(np.diff(np.pad(inner, 1).astype(int))).reshape(-1, 2).T
            if np.mean(np.convolve(inner, np.ones(3)) > 0.0) < _MOST:
                return None
        # Lines from sample `first` to `last` + 1; the next one begins there, or a sample later.
        i, j = last[:-1] + 1, first[1:]
        near = (j - i >= 0) & (j - i <= 1) & (t[j] - t[i] < 2.0 * (t[i] - t[i - 1]))
        if len(i) < FEWEST or np.mean(near) < _MOST:
            return None
        i, j = i[near], j[near]
        before, after, apart = slopes[i - 1], slopes[j], (t[j] - t[i])[:, np.newaxis]
        since = np.sum((y[j] - y[i] - after * apart) * (before - after), axis=1) \
            / np.sum((before - after) ** 2, axis=1)
        meet = (since >= -_STRAIGHT * apart[:, 0]) & (since <= (1.0 + _STRAIGHT) * apart[:, 0])
        straight = np.all(np.abs(slopes[first] - slopes[last]) <= 2.0 * least, axis=1)
    if min(np.mean(meet), np.mean(straight)) < _MOST:
        return None
    return replace(signal, time=(t[i] + since)[meet],
                   values=(y[i] + before * since[:, np.newaxis])[meet])


def _in_pairs(turns: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """
    Return the first and last slopes of lines on which two samples lie each, or none.

    Between two lines slopes turn to the same side twice, within one and to the next they do not:
    a smooth signal always does. Which neighbours are pairs may change as clocks run apart.
    """
    same = np.all(turns[:-1] * turns[1:] > 0.0, axis=1)
    blocks = same[:len(same) // _BLOCK * _BLOCK].reshape(-1, _BLOCK // 2, 2).mean(axis=1)
    none = np.empty(0, dtype=np.intp)
    if not len(blocks) or np.mean(blocks.max(axis=1)) < _PAIRED or \
            np.mean(blocks.min(axis=1)) > _MOST:
        return none, none
    starts = np.arange(0, len(blocks) * _BLOCK, 2).reshape(len(blocks), -1)
    first = 2 + (starts + np.argmax(blocks, axis=1)[:, np.newaxis]).ravel()
    return first, first
