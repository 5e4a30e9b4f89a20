# SPDX-License-Identifier: Apache-2.0
"""
Pauses of a record: where samples are missing, and nobody knows what inputs did.

Outputs need not be known all the time. Where a measured input is not, or a held one that did not
stay as it was sent last, or where all channels are silent at a time (a network that drops out, a
recorder that is paused or cannot keep up), states, and what inputs hold, begin anew after it. What
is before and what is after are as two records of one plant.

Instants in words, of pauses and of all else, count from the start of the window, for that is all
that a judge of one window knows; people read them by the clock of what the window was cut from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
import re

import numpy as np

from ctsid_core.linear.types import Array, Mask
from ctsid_core.signals.actuators import unramped
from ctsid_core.signals.record import Record, Signal, placed

GAP_PERIODS = 5.0       # longer intervals, in usual ones, are gaps: not splined over
_USUAL = 0.9            # of the intervals of a signal are no longer than the usual one: pauses
                        # between bursts, and intervals at random, are part of the sampling
_LONG = 0.01            # of a record: shorter pauses are bridged, for each costs states and
                        # offsets anew, and a shorter part is none if it has few samples
_MANY = 5               # times as many as any part has: a short experiment in a long recording
_LAST = 0.1             # of a window: silence at its end, after which it tells nothing of now, ...
_BEFORE = 2.0           # ... if it is longer than any before it, so many times
FEWEST = 20             # samples of an output in what can be used
_AFTER = 's after the start of the window'
_NUMBER = r'(?<![\w./-])(-?\d+(?:\.\d+)?)'   # no part of a name
_INSTANTS = re.compile(rf'(?:from {_NUMBER} to )?{_NUMBER} {_AFTER}')


def between_pauses(record: Record, lost: bool = False) -> tuple[Record, ...]:
    """
    Return the parts of a record between its pauses, in their order.

    In a pause every channel misses several of its samples, or an input does that is not held; or,
    if what was sent was `lost`, one that is. Else it stays while it is silent. Parts too short to
    be used, or with one sample of an output, are left out, but where most samples are in such
    parts the record is returned as it is.
    """
    signals = (*record.commands, *record.outputs)
    pauses = _silent(np.unique(np.concatenate([s.time for s in signals])), signals, record)
    for s in record.commands:
        if s.hold != 'zoh':
            pauses += _silent(np.union1d(s.time, record.end), (s,), record)
    pauses += silences(record) if lost else []
    pauses = [(a, b) for a, b in pauses if b - a > _LONG * record.duration]
    if not pauses:
        return (record,)
    parts, first = [], -np.inf
    for last, following in (*sorted(pauses), (np.inf, np.inf)):
        if last > max(first, record.start) and first < record.end:
            parts.append(_part(record, first, last))
        first = max(first, following)
    counts = [[len(s.time[s.rows(part.start, part.end)]) for s in part.outputs] for part in parts]
    kept = [max(own) >= (FEWEST if part.duration > _LONG * record.duration else _MANY * FEWEST)
            and 1 not in own and all(len(s.time) for s in part.inputs)
            for own, part in zip(counts, parts, strict=True)]
    if sum(map(sum, compress(counts, kept))) > 0.5 * sum(map(sum, counts)):
        return tuple(compress(parts, kept))
    return (record,)


def silences(record: Record) -> list[tuple[float, float]]:
    """Return where a held input is silent for long, from a usual interval after a sample on."""
    return [(a + _usual(s.time), b) for s in record.inputs if s.hold == 'zoh'
            for a, b in _silent(s.time, (s,), record) if b - a > _LONG * record.duration]


def silent_between(signal: Signal, start: float, end: float, rest: Array) -> Mask:
    """
    Return after which samples a held input is silent for far longer than it mostly is, (N,).

    Not where it was sent to `rest` last.
    """
    t, moves = signal.time, np.any(signal.values != rest, axis=1)
    inside = signal.rows(start, end)
    usual = float(np.median(np.diff(t[inside]))) if len(t[inside]) > 1 else np.inf
    if signal.hold != 'zoh':
        return np.zeros(len(t), dtype=bool)
    return np.asarray(moves & (np.diff(t, append=max(end, t[-1])) > GAP_PERIODS * usual))


def missing(signal: Signal, record: Record) -> float:
    """Return the part of a record in which samples of a signal are missing."""
    start, end = record.start, record.end
    stamps = np.concatenate(([start], signal.time[signal.rows(start, end)], [end]))
    silent = sum(b - a for a, b in _silent(np.unique(stamps), (signal,), record))
    return silent / record.duration


def silent_at_end(record: Record) -> tuple[tuple[str, float], ...]:
    """
    Return the signals that end long before their record does, and for how long they are silent.

    Names of their first channels, and seconds. An input that is held is not silent.
    """
    found = []
    for signals, names in ((record.outputs, record.output_names),
                           (record.inputs, record.input_names)):
        for s, places in placed(signals):
            own = s.time[s.rows(record.start, record.end)]
            silent = record.end - own[-1] if len(own) > 1 else 0.0
            if not (signals is record.inputs and s.hold == 'zoh') and silent > max(
                    _LAST * record.duration, _BEFORE * np.max(np.diff(own), initial=0.0)):
                found.append((names[places.start], float(silent)))
    return tuple(found)


def _silent(stamps: Array, signals: Sequence[Signal], record: Record) -> list[tuple[float, float]]:
    """Return where all of these signals miss samples, of which these are the stamps."""
    before = np.arange(np.searchsorted(stamps[:-1], record.end))
    for s in signals:
        before = before[_misses(s, stamps[before], record)]
    return list(zip(stamps[before].tolist(), stamps[before + 1].tolist(), strict=True))


def _usual(t: Array) -> float:
    """Return the usual interval of stamps."""
    return float(np.quantile(np.diff(t), _USUAL)) if len(t) > 1 else np.inf


def _misses(signal: Signal, after: Array, record: Record) -> Mask:
    """Return whether a signal misses samples after some of these stamps."""
    t = signal.time
    if not len(t):
        return np.ones(len(after), dtype=bool)
    # What was sent last is held.
    end = t[-1] if signal.hold == 'zoh' else max(t[-1], record.end)
    own = np.diff(t, prepend=min(t[0], record.start), append=end)
    return np.asarray(own[np.searchsorted(t, after, side='right')] > GAP_PERIODS * _usual(t))


def in_words(parts: Sequence[Record]) -> str:
    """Return when a recording pauses, of its parts; empty if it does not."""
    whole = parts[0].recording
    known = [whole.start, *(t for part in parts for t in (part.start, part.end)), whole.end]
    pauses = [(a - whole.start, b - whole.start)
              for a, b in zip(known[::2], known[1::2], strict=True) if b > a]
    if not pauses:
        return ''
    when = after_start(*max(pauses, key=lambda pause: pause[1] - pause[0]))
    return ('there is nothing to be used '
            + (when if len(pauses) == 1 else f'in {len(pauses)} pauses, the longest {when}')
            + ': samples are missing, and states and offsets begin anew after it')


def _part(record: Record, first: float, last: float) -> Record:
    """Return what is from the end of a pause to the start of the next one."""
    # An input that missed no samples in a pause is known through it, and is kept from before.
    inputs = tuple(_known(s, sent, first, last, record) for s, sent in zip(
        record.inputs, unramped(record.inputs, record.commands), strict=True))
    outputs = tuple(s.of(s.rows(first, last)) for s in record.outputs)
    return replace(record, inputs=inputs, outputs=outputs, start=max(first, record.start),
                   end=min(last, record.end), part_of=record)


def _known(signal: Signal, sent: Signal, first: float, last: float, record: Record) -> Signal:
    """Return an input without what is beyond gaps of what was sent at both ends."""
    from_there, to_there = _misses(sent, np.array([np.nextafter(first, -np.inf), last]), record)
    t = signal.time
    return signal.of((t >= first if from_there else t > -np.inf)
                     & (t <= last if to_there else t < np.inf))


def after_start(time: float, until: float | None = None) -> str:
    """Return an instant, or from when to when, after the start of the window [s], in words."""
    at = f'{time:z.1f}' if until is None else f'from {time:z.1f} to {until:z.1f}'
    return f'{at} {_AFTER}'


def by_clock(text: str, start: float, of: str) -> str:
    """
    Return a text with all such instants by another clock, which counts from the start of `of`.

    The window starts at `start` [s] by that clock.
    """
    def shifted(found: re.Match[str]) -> str:
        first, last = ('' if t is None else f'{float(t) + start:.1f}' for t in found.groups())
        return f'{f"from {first} to " if first else ""}{last} s after the start of {of}'

    return _INSTANTS.sub(shifted, text)
