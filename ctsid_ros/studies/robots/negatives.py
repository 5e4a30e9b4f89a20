# SPDX-License-Identifier: Apache-2.0
"""Records that no model is right for: whatever is GOOD here is wrong."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_ros.studies.robots.experiment import (
    Experiment,
    Family,
    Layout,
    Random,
    flown,
    generator,
    record_of,
)
from ctsid_ros.studies.robots.inputs import KINDS, drive
from ctsid_ros.studies.robots.linear import Held, Linear
from ctsid_ros.studies.robots.linear_families import delayed_lag, motor_speed

LASTING = tuple(kind for kind in KINDS if kind != 'step')   # move on both sides of a jump
Fault = Callable[[Held, Array, Random], Array]


def _flight(family: str, kind: str, seed: int,
            number: int) -> tuple[Held, Array, Random, float]:
    """Return inputs, instants of the outputs, a generator of what comes of them, and an SNR."""
    rng = generator(family, seed, number, 1)
    robot = motor_speed(rng, kind)
    layout = Layout.drawn(robot, kind, rng)
    rng = generator(family, seed, number, 2)
    return *flown(robot, kind, layout, rng), rng, layout.snr


def _wrong(family: str, kind: str, seed: int, number: int, fault: Fault) -> Experiment:
    """Return the record of a robot of which only the inputs are what they seem."""
    held, times, rng, snr = _flight(family, kind, seed, number)
    y = fault(held, times, rng)
    noise = 10.0 ** (-0.05 * snr) * y.std(axis=0) * rng.standard_normal(y.shape)
    return Experiment(family, kind, seed, number, record_of(held, times, y + noise), 'none')


def _white(held: Held, times: Array, rng: Random) -> Array:
    return rng.standard_normal((len(times), 1))


def _walk(held: Held, times: Array, rng: Random) -> Array:
    return np.cumsum(rng.standard_normal((len(times), 1)), axis=0)


def _other_input(held: Held, times: Array, rng: Random) -> Array:
    """The robot was moved by something else than what was recorded."""
    other = drive('pilot', rng, held.time, times[-1], 1.0)
    return delayed_lag(rng, '').move(Held(held.time, other), times, None)


def _amid(y: Array, times: Array, rng: Random) -> float:
    """Return a time with at least 15 % of the motion's power on each side of it."""
    share = np.cumsum(y[:, 0] ** 2) / np.sum(y ** 2)
    place = times / times[-1]
    both = (share > 0.15) & (share < 0.85) & (place > 0.1) & (place < 0.9)
    return float(rng.choice(times[both] if both.any() else times[len(times) // 2:][:1]))


def _jump(held: Held, times: Array, rng: Random, gain: float, pace: float) -> Array:
    """At a time in the middle eight tenths a gain or a pole becomes another, from then on."""
    slow, sign = rng.uniform(2.0, 6.0), rng.choice((-1.0, 1.0))
    gain, other = 1.0 + sign * gain, slow * (1.0 + sign * pace)
    before = Linear.of_roots(1.0, (-slow,))
    when = _amid(before.move(held, times), times, rng)
    early, late = times < when, times >= when
    y = before.move(held, np.append(times[early], when))
    first = int(np.searchsorted(held.time, when, side='right'))
    rest = Held(np.append(when, held.time[first:]),
                np.vstack((held.at(np.array([when])), held.values[first:])))
    later = gain * Linear.of_roots(1.0, (-other,)).move(rest, times[late])
    return np.vstack((y[:-1], later + y[-1] * np.exp(-other * (times[late] - when))[:, None]))


def dead_sensor(family: str, kind: str, seed: int, number: int) -> Experiment:
    """Return a record with a sensor that has died: not even noise is left."""
    held, times, rng, snr = _flight(family, kind, seed, number)
    y = delayed_lag(rng, '').move(held, times, None)
    y += 0.02 * rng.standard_normal(y.shape)
    from_then = times >= times[-1] * rng.choice((0.0, rng.uniform(0.2, 0.7)))
    y[from_then] = y[np.argmax(from_then)]
    return Experiment(family, kind, seed, number, record_of(held, times, y), 'none')


def clipped_sensor(family: str, kind: str, seed: int, number: int) -> Experiment:
    """Return a record with a sensor that ends at 0.2, of motions of 0.5 to 1."""
    held, times, rng, snr = _flight(family, kind, seed, number)
    y = Linear.of_roots(1.0, (-rng.uniform(2.0, 6.0),)).move(held, times)
    y *= rng.uniform(0.5, 1.0) / np.abs(y).max()
    y = np.clip(y, -0.2, 0.2) + 0.02 * rng.standard_normal(y.shape)
    return Experiment(family, kind, seed, number, record_of(held, times, y), 'none')


FAMILIES = {
    'no-white': Family(None, 'white noise for outputs', make=partial(_wrong, fault=_white)),
    'no-walk': Family(None, 'random walks for outputs', make=partial(_wrong, fault=_walk)),
    'no-input': Family(None, 'inputs of another experiment',
                       make=partial(_wrong, fault=_other_input)),
    'no-gain-jump': Family(None, 'gain jumps by 40 %', LASTING, partial(
        _wrong, fault=partial(_jump, gain=0.4, pace=0.0))),
    'no-pole-jump': Family(None, 'pole jumps by 40 %', LASTING, partial(
        _wrong, fault=partial(_jump, gain=0.0, pace=0.4))),
    'no-sensor': Family(None, 'dead or stuck sensor', make=dead_sensor),
    'no-clipped': Family(None, 'sensor clipped at 0.2', make=clipped_sensor),
}
