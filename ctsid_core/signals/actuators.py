# SPDX-License-Identifier: Apache-2.0
"""
What acts of a command: drivers and actuators stop, ignore, limit or drag it.

A mobile base counts a command as 0 when it hears no more (`cmd_vel_timeout`), small commands move
nothing (a dead zone), large ones no more than a limit, a gear has play, and speed follows its set
point no faster than an acceleration allows. Each is one number of an input that is held; behind
them the plant may be linear.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import copysign, inf

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.settings import Actuator
from ctsid_core.signals.record import Record, Signal, placed

_APART = 1e-6           # [s] that a ramp ends from a message: nearer ones are one instant
_WORDS = {
    'timeout': 'counts as 0 from {} s after a message on, until the next one',
    'dead_zone': 'moves nothing by the first {}{unit} from 0',
    'limit': 'acts by at most {}{unit}',
    'backlash': 'has a play of {}{unit}',
    'rate_limit': 'acts as if it changed by at most {}{unit}/s'}


def acting(inputs: Sequence[Signal], actuators: Sequence[Actuator]) -> tuple[Signal, ...]:
    """Return inputs as they act, given the actuator of each channel; some as several signals."""
    return tuple(one for signal, k in placed(inputs) for one in _acting(signal, actuators[k]))


def as_acting(record: Record, actuators: Sequence[Actuator]) -> Record:
    """Return a record whose inputs are as they act."""
    return replace(record, inputs=acting(record.inputs, actuators), sent=record.commands) if any(
        map(any, actuators)) else record


def settled(record: Record, actuators: Sequence[Actuator]) -> Record:
    """
    Return a record from where it is known where ramps and gears are.

    All of it where that is in its second half only: as if they were where they had been sent.
    """
    start = max((
        _settled(signal.columns([j]), own) for signal, place in placed(record.inputs)
        if signal.hold == 'zoh' and len(signal.time)
        for j, own in enumerate(actuators[place]) if own.backlash or own.rate_limit),
        default=record.start)
    late = record.start < start < 0.5 * (record.start + record.end)
    return replace(record, start=start) if late else record


def _settled(signal: Signal, actuator: Actuator) -> float:
    """Return when what acts is the same, wherever it began among all that was sent, and rest."""
    moves = behind(signal, actuator._replace(backlash=0.0, rate_limit=0.0)).values
    ends = [behind(signal, actuator, begin=begin) for begin in (
        np.min(moves, initial=0.0), np.max(moves, initial=0.0))]
    times = np.union1d(ends[0].time, ends[1].time)
    one, other = (np.interp(times, end.time, end.values[:, 0]) if end.hold == 'linear' else
                  end.values[:, 0] for end in ends)
    same = np.abs(one - other) <= 1e-9 * np.ptp(signal.values)
    return float(times[np.argmax(same)]) if same.any() else np.inf


def unramped(inputs: Sequence[Signal], sent: Sequence[Signal]) -> tuple[Signal, ...]:
    """Return inputs as they act, but such that ramps drag as they were sent."""
    if all(own is other for own, other in zip(inputs, sent, strict=False)):
        return tuple(inputs)
    each = [s.columns([j]) for s in sent for j in range(s.width)]
    return tuple(own if own.hold == each[k.start].hold else each[k.start]
                 for own, k in placed(inputs))


def behind(signal: Signal, actuator: Actuator, level: float = 0.0,
           begin: float | None = None) -> Signal:
    """
    Return what acts of one channel, held; `level` was taken off it.

    Ramps and gears begin where they are sent first, or at `begin`.
    """
    if signal.hold != 'zoh':
        return signal
    signal = stopped(signal, actuator.timeout, -level) if actuator.timeout else signal
    u = signal.values[:, 0] + level
    if actuator.dead_zone:
        u = np.sign(u) * np.maximum(np.abs(u) - actuator.dead_zone, 0.0)
    if actuator.limit:
        u = np.clip(u, -actuator.limit, actuator.limit)
    if actuator.backlash:
        u = _with_play(u, 0.5 * actuator.backlash, begin)
    u = (u - level)[:, np.newaxis]
    signal = signal if np.array_equal(u, signal.values) else replace(signal, values=u)
    return _ramped(signal, actuator.rate_limit, begin) if actuator.rate_limit else signal


def stopped(signal: Signal, timeout: float, rest: Array | float = 0.0) -> Signal:
    """Return a signal that, if it is held, is at rest so long after messages, if none follows."""
    t, late = signal.time, signal.time + timeout
    at = np.flatnonzero((t < late) & (late < np.append(t[1:], np.inf))
                        & np.any(signal.values != rest, axis=1))
    if signal.hold != 'zoh' or not len(at):
        return signal
    return replace(signal, time=np.insert(t, at + 1, late[at]),
                   values=np.insert(signal.values, at + 1, rest, axis=0))


def in_words(names: Sequence[str], actuators: Sequence[Actuator], units: Sequence[str] = (),
             deviations: Sequence[Actuator] = ()) -> tuple[str, ...]:
    """Return a sentence on what acts of each input that is not all of it; with deviations."""
    units, deviations = units or ('',) * len(names), deviations or (Actuator(),) * len(names)
    return tuple(
        f'input {name} ' + _WORDS[kind].format(
            f'{value:.3g}' + (f' ± {off:.1g}' if off else ''), unit=unit and ' ' + unit)
        for name, own, unit, known in zip(names, actuators, units, deviations, strict=True)
        for kind, value, off in zip(Actuator._fields, own, known, strict=True) if value)


def by_kind(actuators: Sequence[Actuator]) -> dict[str, tuple[float, ...]]:
    """Return the numbers of all inputs, (nu,), of each kind that any of them has."""
    return {kind: values for kind, values in zip(
        Actuator._fields, zip(*actuators, strict=True), strict=False) if any(values)}


def _acting(signal: Signal, actuators: Sequence[Actuator]) -> Iterator[Signal]:
    """Yield what acts of a signal: whole where its channels share at most a timeout."""
    if signal.hold != 'zoh' or not any(map(any, actuators)):
        yield signal
    elif all(own == Actuator(actuators[0].timeout) for own in actuators):
        yield stopped(signal, actuators[0].timeout)
    else:
        yield from (behind(signal.columns([j]), own) for j, own in enumerate(actuators))


def _with_play(u: Array, half: float, begin: float | None) -> Array:
    """Return what follows u with play: it moves when it is pushed."""
    found, place = [], begin if begin is not None else float(u[0]) if len(u) else 0.0
    for value in u.tolist():
        place = min(max(place, value - half), value + half)
        found.append(place)
    return np.array(found)


def _ramped(signal: Signal, rate: float, begin: float | None) -> Signal:
    """Return what follows a held channel at a rate, on straight lines; it ends at rest."""
    stamps, values = signal.time.tolist(), signal.values[:, 0].tolist()
    times, places, place = [], [], values[0] if values and begin is None else begin or 0.0
    for start, end, value in zip(stamps, [*stamps[1:], inf], values, strict=False):
        times.append(start)
        places.append(place)
        reached = start + abs(value - place) / rate
        if start + _APART < reached < end - _APART:
            times.append(reached)
            places.append(value)
        place = value if reached < end else place + copysign(rate * (end - start), value - place)
    if times:
        times.append(2.0 * times[-1] - times[0] + 1.0)
        places.append(place)
    return replace(signal, time=np.array(times), values=np.array(places)[:, np.newaxis],
                   hold='linear')
