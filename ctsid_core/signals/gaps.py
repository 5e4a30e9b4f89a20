# SPDX-License-Identifier: Apache-2.0
"""
Pauses of a record: where samples are missing, and nobody knows what inputs did.

Outputs need not be known all the time. Where a measured input is not, or where all channels are
silent at a time (a network that drops out, a recorder that is paused or cannot keep up), states,
and what inputs hold, begin anew after it. What is before and what is after are as two records of
one plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array
from ctsid_core.signals.instants import after_start
from ctsid_core.signals.record import Record, Signal, common_interval

GAP_PERIODS = 5.0       # longer intervals, in usual ones, are gaps: not splined over
_USUAL = 0.9            # of the intervals of a signal are no longer than the usual one: pauses
                        # between bursts, and intervals at random, are part of the sampling
_MOST = 50              # pauses of a record, the longest: each costs states and offsets anew
FEWEST = 20             # samples of an output in what can be used


def between_pauses(record: Record) -> tuple[Record, ...]:
    """
    Return the parts of a record between its pauses, in their order.

    In a pause every channel misses several of its samples, or an input does that is not held: one
    that is sent when it changes tells nothing by its silence. Parts too short to be used are left
    out, but where most samples are in such parts the record is returned as it is.
    """
    signals = (*record.inputs, *record.outputs)
    stamps = np.unique(np.concatenate([s.time for s in signals]))
    known = max(float(s.time[0]) for s in signals if len(s.time)) if len(stamps) else 0.0
    pauses = _silent(stamps[stamps >= min(known, record.start)], signals, record)
    for s in record.inputs:
        if s.hold != 'zoh':
            pauses += _silent(np.union1d(s.time, record.end), (s,), record)
    parts, first = [], -np.inf
    for last, following in (*sorted(sorted(pauses, key=_backwards)[:_MOST]), (np.inf, np.inf)):
        if last > first and (part := _part(record, first, last)) is not None:
            parts.append(part)
        first = max(first, following)
    long = [part for part in parts if np.min(_samples(part)) >= FEWEST]
    kept, seen = (sum(float(np.sum(_samples(part))) for part in some) for some in (long, parts))
    return tuple(long) if pauses and kept > 0.5 * seen else (record,)


def missing(signal: Signal, record: Record) -> float:
    """Return the part of a record in which samples of a signal are missing."""
    start, end = record.start, record.end
    stamps = np.concatenate(([start], signal.time[signal.rows(start, end)], [end]))
    silent = sum(b - a for a, b in _silent(np.unique(stamps), (signal,), record))
    return silent / record.duration


def _silent(stamps: Array, signals: Sequence[Signal], record: Record
            ) -> list[tuple[float, float]]:
    """Return where all of these signals miss samples, of which these are the stamps."""
    before = np.arange(np.searchsorted(stamps[:-1], record.end))
    for s in signals:
        step = np.diff(s.time)
        usual = float(np.quantile(step, _USUAL)) if len(step) else np.inf
        k = np.searchsorted(s.time, stamps[before], side='right')
        own = np.diff(s.time, prepend=-np.inf, append=np.inf)[k]
        before = before[own > GAP_PERIODS * usual]
    return list(zip(stamps[before].tolist(), stamps[before + 1].tolist(), strict=True))


def _backwards(pause: tuple[float, float]) -> float:
    return pause[0] - pause[1]


def in_words(parts: Sequence[Record]) -> str:
    """Return when a recording pauses, of its parts; empty if it does not."""
    whole = parts[0].recording
    known = [whole.start, *(t for part in parts for t in (part.start, part.end)), whole.end]
    pauses = [(a - whole.start, b - whole.start)
              for a, b in zip(known[::2], known[1::2], strict=True) if b > a]
    if parts[0] is whole or not pauses:
        return ''
    when = after_start(*max(pauses, key=lambda pause: pause[1] - pause[0]))
    return (f'samples are missing {when}' if len(pauses) == 1 else
            f'samples are missing in {len(pauses)} pauses, the longest {when}'
            ) + ': what moved there is not known, and states and offsets begin anew after it'


def _part(record: Record, first: float, last: float) -> Record | None:
    """Return what a record has from one stamp to another, or None if that is nothing."""
    if last <= record.start or first >= record.end:
        return None
    inputs, outputs = (tuple(replace(s, time=s.time[rows], values=s.values[rows])
                             for s in signals for rows in [s.rows(first, last)])
                       for signals in (record.inputs, record.outputs))
    try:
        start, end = common_interval((*inputs, *outputs))
    except DataError:
        return None
    part = replace(record, inputs=inputs, outputs=outputs, start=max(start, record.start),
                   end=min(end, record.end), part_of=record)
    return part if part.duration > 0.0 else None


def _samples(record: Record) -> Array:
    """Return the number of samples of each output signal."""
    return np.array([float(len(s.time[s.rows(record.start, record.end)]))
                     for s in record.outputs])
