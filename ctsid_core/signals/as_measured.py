# SPDX-License-Identifier: Apache-2.0
"""
Samples that were not measured when, or as often as, they say, and outputs that stand still.

Several that arrive at a time, and are stamped then: a radio, a serial port that is polled, a
logger that writes in blocks. What was measured evenly comes with the stamps of its arrival, most
of a sample's interval too late, and by another time each. Models follow these stamps with dead
times and fast poles. Each sample is put back to where it was: evenly between the burst before and
its own. What is measured in bursts is another matter: the signal does not move within one, and
moves in the pauses. What arrives in bursts moves from the first half of one to the second by as
much as between its neighbours, for the time that it stands for.

Values that a slower sensor has sent again tell nothing new, and are late. A sensor of 10 Hz in
messages of 100 has each value ten times in a row. Taken as samples they are as many times as sure,
and a plant that simulates them holds its output: half an interval of lag, and states that stand in
for it. The first of each is when the sensor was read. A slower clock is told by its regularity.
What is coarse repeats values as well, while it moves little, and not as regularly; where it moves
steadily, all its steps are alike.

Samples on straight lines between those of a slower sensor, a table that was resampled, tell
nothing new, either, their noise is no noise, and what lies between two samples tells the later one
before it was measured. Where neighbouring lines meet the sensor was read.

An output stands still where a long run of samples is equal to the last bit. Long enough not to be
chance: coarse sensors repeat values as well, but for a small part of the window, or again and
again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array, Mask
from ctsid_core.signals.gaps import FEWEST
from ctsid_core.signals.record import Record, Signal, placed, with_each

_AT_ONCE = 0.1        # of the mean interval: samples less apart arrive together
_REGULAR = 0.8        # of the bursts have as many samples as the median one, or one more or less;
                      # of the values come as often in a row as the median, or once more or less
                      # often
_MOVES = (0.4, 2.0)   # of the motion between neighbours, for its time, that a burst has in itself
_ALIKE = 1e-6         # of the largest step: steps that differ by less are the same
_DISTINCT = 0.5       # of the steps, if there is no noise: those of a coarse sensor are few
_STRAIGHT = 0.01      # of the usual change of a slope: less is none
_PAIRED = 0.95        # of neighbours that would be pairs are
_BLOCK = 40           # samples in which the same neighbours are
_MOST = 0.8           # of the samples lie on lines, and of these meet where they should
_SHARE = 0.08         # of the window in one run
_TIMES = 3.0          # as long as the second longest run
_FEWEST = 10          # samples in it
_TWICE = 2.0          # as large as what the sensor resolves are steps of noise, half of them
_TURNS = 0.3          # of the steps from sample to sample turn around: of white noise 2/3 do, of
                      # what a sensor shows at 8 bits fewer, for some steps are 0


def as_measured(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record with samples when and as often as they were measured, and notes on that."""
    record, late = with_each(record, _without_bursts)
    record, often = _without_repeats(record)
    record, between = without_interpolated(record)
    return record, (*late, *often, *between)


def _without_bursts(signal: Signal, names: tuple[str, ...]) -> tuple[Signal, str]:
    """Return a signal with samples of bursts where they were, and a sentence if it has any."""
    times, usual = _spread(signal.time, signal.values)
    return (signal, '') if usual < 2 else (replace(signal, time=times), (
        f'samples of {", ".join(names)} come about {usual} at a time, and are taken as '
        'measured evenly since the ones before; stamp them where they are measured (in a bag: '
        '`stamp: auto` takes such stamps)'))


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


def _without_repeats(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record with each value of slower sensors once, and a sentence on each of them."""
    found: list[Signal] = []
    notes: list[str] = []
    for signal, channels in placed(record.outputs):
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


def without_interpolated(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record with outputs where their sensors were read, and a sentence on each."""
    def sensed(signal: Signal, names: tuple[str, ...]) -> tuple[Signal, str]:
        read = _read(signal)
        return (signal, '') if read is None else (read, (
            f'samples of {", ".join(names)} lie on straight lines, about '
            f'{len(signal.time) / len(read.time):.2g} on each, as between those of a slower '
            'sensor in a table that was resampled; where lines meet it was read, and that counts'))
    return with_each(record, sensed, outputs_alone=True)
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
    """Return the first and last slopes of lines on which two samples lie each, or none."""
    # Between two lines slopes turn to the same side twice, within one and to the next they do not:
    # a smooth signal always does. Which neighbours are pairs may change as clocks run apart.
    same = np.all(turns[:-1] * turns[1:] > 0.0, axis=1)
    blocks = same[:len(same) // _BLOCK * _BLOCK].reshape(-1, _BLOCK // 2, 2).mean(axis=1)
    none = np.empty(0, dtype=np.intp)
    if not len(blocks) or np.mean(blocks.max(axis=1)) < _PAIRED or \
            np.mean(blocks.min(axis=1)) > _MOST:
        return none, none
    starts = np.arange(0, len(blocks) * _BLOCK, 2).reshape(len(blocks), -1)
    first = 2 + (starts + np.argmax(blocks, axis=1)[:, np.newaxis]).ravel()
    return first, first


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
    for signal, channels in placed(record.outputs):
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
    """Return whether there is noise before or after a run, of more than the sensor resolves."""
    # An encoder that turns counts one more and one less in turns, and at rest it is still: there
    # the value nearest to that of the run is a count away.
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
