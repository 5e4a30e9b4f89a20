# SPDX-License-Identifier: Apache-2.0
"""
Samples that arrive several at a time, and are stamped then.

A radio, a serial port that is polled, a logger that writes in blocks: what was measured evenly
comes with the stamps of its arrival, most of a sample's interval too late, and by another time
each. Models follow these stamps with dead times and fast poles. Each sample is put back to where
it was: evenly between the burst before and its own.

What is measured in bursts is another matter: the signal does not move within one, and moves in the
pauses. What arrives in bursts moves from the first half of one to the second by as much as between
its neighbours, for the time that it stands for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_core.signals.gaps import FEWEST
from ctsid_core.signals.record import Record, Signal, with_each

_AT_ONCE = 0.1        # of the mean interval: samples less apart arrive together
_REGULAR = 0.8        # of the bursts have as many samples as the median one, or one more or less
_MOVES = (0.4, 2.0)   # of the motion between neighbours, for its time, that a burst has in itself


def without_bursts(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record with samples of bursts where they were, and a sentence on each signal."""
    def spread(signal: Signal, names: tuple[str, ...]) -> tuple[Signal, str]:
        times, usual = _spread(signal.time, signal.values)
        return (signal, '') if usual < 2 else (replace(signal, time=times), (
            f'samples of {", ".join(names)} come about {usual} at a time, and are taken as '
            'measured evenly since the ones before; stamp them where they are measured (in a bag: '
            '`stamp: auto` takes such stamps)'))
    return with_each(record, spread)


def _spread(times: Array, values: Array) -> tuple[Array, int]:
    """Return where samples were, and how many there are in a burst; 1 if there are none."""
    if len(times) < FEWEST:
        return times, 1
    gaps = np.diff(times)
    between = gaps >= _AT_ONCE * (times[-1] - times[0]) / len(gaps)
    last = np.flatnonzero(np.append(between, True))     # of each burst
    counts = np.diff(last, prepend=-1)
    usual = int(np.median(counts))
    if usual < 2 or len(last) < FEWEST or np.mean(np.abs(counts - usual) <= 1) < _REGULAR or \
            not _MOVES[0] < _motion(values, last) < _MOVES[1]:
        return times, 1
    arrived = times[last - counts + 1]      # all are measured before the first is stamped
    pauses = np.diff(arrived)
    period = float(np.median(pauses))
    # Records end within bursts: the first one ends whole, the last one begins so.
    steps = np.concatenate(([period / usual], np.minimum(pauses, period) / counts[1:]))
    behind = np.repeat(last, counts) - np.arange(len(times))        # until the last of its burst
    found = np.repeat(arrived, counts) - np.repeat(steps, counts) * behind
    cut = int(counts[-1])
    found[-cut:] = arrived[-2] + np.minimum(pauses[-1], period) / max(cut, usual) * np.arange(
        1, cut + 1)
    return found, usual


def _motion(values: Array, last: NDArray[np.intp]) -> float:
    """Return how much of the motion between neighbours bursts have in themselves: 1 if even."""
    own = np.split(values / np.maximum(np.std(values, axis=0), 1e-300), last[:-1] + 1)
    inside, between = [], []
    for before, burst, after in zip(own, own[1:], own[2:], strict=False):
        half = len(burst) // 2
        if half:
            inside.append(burst[-half:].mean(axis=0) - burst[:half].mean(axis=0))
            between.append(0.5 * (after.mean(axis=0) - before.mean(axis=0))
                           * (len(burst) - half) / len(burst))
    moved, expected = np.ravel(inside), np.ravel(between)
    return float(moved @ expected) / max(float(expected @ expected), 1e-300)
