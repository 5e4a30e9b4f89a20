# SPDX-License-Identifier: Apache-2.0
"""Linear robots whose sensors, clocks, air or other inputs are at fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_ros.studies.robots.actuator_families import second_order
from ctsid_ros.studies.robots.experiment import Family, Random, Response, Robot
from ctsid_ros.studies.robots.inputs import drive
from ctsid_ros.studies.robots.linear import Held, Linear
from ctsid_ros.studies.robots.linear_families import robot_of, roll_plant

Sense = Callable[[Array, Array, Random | None], tuple[Array, Array]]


def later(response: Response, late: float) -> Response:
    """Return the response that outputs have whose stamps are late."""
    def seen(omega: Array) -> ComplexArray:
        return np.asarray(response(omega) * np.exp(-1j * late * omega)[:, np.newaxis, np.newaxis])
    return seen


def _sensed(rng: Random, sense: Sense, late: float = 0.0) -> Robot:
    plant = second_order(rng)
    return replace(robot_of(plant, 2.0), sense=sense, response=later(plant.response, late))


def eight_bit(rng: Random, kind: str) -> Robot:
    """Return a robot with a sensor of 256 levels, of which the motion takes a quarter or so."""
    share = rng.uniform(3.0, 6.0)

    def sense(times: Array, y: Array, rng: Random | None) -> tuple[Array, Array]:
        level = share * np.ptp(y, axis=0) / 256.0
        return times, y if rng is None else level * np.round(y / level)
    return _sensed(rng, sense)


def lost_bursts(rng: Random, kind: str) -> Robot:
    """Return a robot of whose samples 5 to 20 % are lost, many at a time."""
    share = rng.uniform(0.05, 0.2)

    def sense(times: Array, y: Array, rng: Random | None) -> tuple[Array, Array]:
        keep = np.ones(len(times), dtype=bool)
        while rng is not None and keep.mean() > 1.0 - share:
            start = rng.uniform(times[0], times[-1])
            keep &= (times < start) | (times > start + rng.uniform(0.05, 0.3))
        return times[keep], y[keep]
    return _sensed(rng, sense)


def clock_drift(rng: Random, kind: str) -> Robot:
    """Return a robot whose sensor's clock is fast or slow by 1 %, as in every record."""
    pace = rng.choice((0.99, 1.01))
    plant = second_order(rng)

    def sense(times: Array, y: Array, rng: Random | None) -> tuple[Array, Array]:
        return pace * times, y
    return replace(robot_of(plant, 2.0), sense=sense, response=None, duration=(5.0, 10.0))


def clock_offset(rng: Random, kind: str) -> Robot:
    """Return a robot whose sensor's stamps are late by 20 to 50 ms."""
    late = rng.uniform(0.02, 0.05)
    return _sensed(rng, lambda times, y, rng: (times + late, y), late)


def rounded_stamps(rng: Random, kind: str) -> Robot:
    """Return a robot whose stamps are whole multiples of 10 ms."""
    def sense(times: Array, y: Array, rng: Random | None) -> tuple[Array, Array]:
        if rng is None:
            return times, y
        rounded, first = np.unique(np.round(times, 2), return_index=True)
        return rounded, y[first]
    return replace(_sensed(rng, sense), output_rate=(50.0, 90.0))


def receipt_stamps(rng: Random, kind: str) -> Robot:
    """Return a robot whose samples are stamped on receipt, 0 to 20 ms late."""
    def sense(times: Array, y: Array, rng: Random | None) -> tuple[Array, Array]:
        if rng is None:
            return times + 0.01, y
        arrived = np.maximum.accumulate(times + rng.uniform(0.0, 0.02, len(times)))
        return arrived + 1e-6 * np.arange(len(times)), y
    return _sensed(rng, sense, 0.01)


def jittering_delay(rng: Random, kind: str) -> Robot:
    """Return a robot whose commands take effect 20 to 60 ms late, each by another time."""
    plant = second_order(rng)

    def move(held: Held, times: Array, rng: Random | None) -> Array:
        late = np.full(len(held.time), 0.04) if rng is None else \
            rng.uniform(0.02, 0.06, len(held.time))
        begun = np.maximum.accumulate(held.time + late) + 1e-7 * np.arange(len(late))
        return plant.move(Held(begun, held.values), times)
    return Robot(move, 2.0, response=later(plant.response, 0.04))


def _disturbed(plant: Linear, share: float, noise: Callable[[Array, Random], Array]) -> Robot:
    """Return a plant at whose input something else acts that causes this share of the motion."""
    def move(held: Held, times: Array, rng: Random | None) -> Array:
        y = plant.move(held, times)
        if rng is None:
            return y
        grid = np.arange(-2.0, times[-1], 5e-3)
        other = plant.move(Held(grid, noise(grid, rng)), times)
        return y + other * share * np.std(y) / np.std(other)
    return replace(robot_of(plant, 2.0), move=move)


def gusts(grid: Array, rng: Random) -> Array:
    """Return first-order noise of 0.3 to 1.5 Hz on an even grid."""
    keep = np.exp(-2.0 * np.pi * rng.uniform(0.3, 1.5) * (grid[1] - grid[0]))
    white = rng.standard_normal((len(grid), 1)) * np.sqrt(1.0 - keep ** 2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


def weak_turbulence(rng: Random, kind: str) -> Robot:
    """Return a quadrotor's roll in gusts that cause 10 to 25 % of the motion."""
    return _disturbed(roll_plant(rng), rng.uniform(0.1, 0.25), gusts)


def strong_turbulence(rng: Random, kind: str) -> Robot:
    """Return the same with 25 to 50 %."""
    return _disturbed(roll_plant(rng), rng.uniform(0.25, 0.5), gusts)


def second_input(rng: Random, kind: str) -> Robot:
    """Return a robot that someone else moves as well, by 15 to 40 % of the motion."""
    def other(grid: Array, rng: Random) -> Array:
        return drive('pilot', rng, grid, grid[-1], 1.0)
    return _disturbed(second_order(rng), rng.uniform(0.15, 0.4), other)


FAMILIES = {
    'eight-bit': Family(eight_bit, 'sensor of 256 levels'),
    'lost-bursts': Family(lost_bursts, '5 to 20 % of the samples lost'),
    'clock-drift': Family(clock_drift, 'clocks that differ by 1 %'),
    'clock-offset': Family(clock_offset, 'stamps 20 to 50 ms late'),
    'rounded-stamps': Family(rounded_stamps, 'stamps rounded to 10 ms'),
    'receipt-stamps': Family(receipt_stamps, 'stamped on receipt, 0 to 20 ms late'),
    'jittering-delay': Family(jittering_delay, 'dead time of 20 to 60 ms, never the same'),
    'turbulence-weak': Family(weak_turbulence, 'gusts of 10 to 25 % of the motion'),
    'turbulence-strong': Family(strong_turbulence, 'gusts of 25 to 50 %'),
    'second-input': Family(second_input, 'a second input, not recorded'),
}
