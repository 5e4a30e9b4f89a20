# SPDX-License-Identifier: Apache-2.0
"""Robots whose actuators or mechanics are not linear, or do not stay as they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_ros.studies.robots.experiment import Family, Random, Robot
from ctsid_ros.studies.robots.inputs import drive
from ctsid_ros.studies.robots.linear import Held, Linear
from ctsid_ros.studies.robots.linear_families import motor_speed_plant, pair
from ctsid_ros.studies.robots.mechanics import Law, accelerated

FINE = 4e-3             # grid of what changes between commands [s]


def behind(plant: Linear, actuator: Callable[[Held], Held], band: float) -> Robot:
    """Return a linear plant behind an actuator that is not linear."""
    def move(held: Held, times: Array, rng: Random | None) -> Array:
        return plant.move(actuator(held), times)
    return Robot(move, band, plant.nu)


def second_order(rng: Random) -> Linear:
    """Return a pair of 3 to 9 rad/s, after 0 to 60 ms."""
    return Linear.of_roots(1.0, pair(rng.uniform(3.0, 9.0), rng.uniform(0.4, 0.9)),
                           rng.uniform(0.0, 0.06))


def _saturation(rng: Random, kind: str, share: float) -> Robot:
    """Commands beyond a limit count as the limit: of moving ones this share."""
    time = np.arange(0.0, 200.0, 0.02)
    size = np.abs(drive(kind, rng, time, 200.0, 2.0))
    limit = min(float(np.quantile(size[size > 0.05], 1.0 - share)), 0.5 + 0.4 * (1.0 - share))
    return behind(second_order(rng),
                  lambda held: Held(held.time, np.clip(held.values, -limit, limit)), 2.0)


def saturation_30(rng: Random, kind: str) -> Robot:
    """Return a robot that saturates for 30 % of the time."""
    return _saturation(rng, kind, 0.3)


def saturation_60(rng: Random, kind: str) -> Robot:
    """Return a robot that saturates for 60 % of the time."""
    return _saturation(rng, kind, 0.6)


def finely(held: Held, end: float) -> Held:
    """Return the same inputs at stamps that are at most `FINE` apart."""
    time = np.union1d(held.time, np.arange(held.time[0], end, FINE))
    return Held(time, held.at(time))


def rate_limit(rng: Random, kind: str) -> Robot:
    """Return a robot whose actuator follows its command at a limited rate."""
    fastest, plant = rng.uniform(3.0, 6.0), second_order(rng)

    def limited(held: Held) -> Held:
        fine = finely(held, held.time[-1] + 0.5)
        place, steps = 0.0, fastest * np.diff(fine.time, append=fine.time[-1])
        for k, (wanted, step) in enumerate(zip(fine.values[:, 0].tolist(), steps.tolist(),
                                               strict=True)):
            fine.values[k] = place = place + min(max(wanted - place, -step), step)
        return fine
    return behind(plant, limited, 2.0)


def backlash(rng: Random, kind: str) -> Robot:
    """Return a robot with play of 10 to 30 % of the motion between command and actuator."""
    half, plant = rng.uniform(0.05, 0.15), second_order(rng)

    def played(held: Held) -> Held:
        values, place = np.empty_like(held.values), 0.0
        for k, wanted in enumerate(held.values[:, 0].tolist()):
            values[k] = place = min(max(place, wanted - half), wanted + half)
        return Held(held.time, values)
    return behind(plant, played, 2.0)


def dead_zone(rng: Random, kind: str) -> Robot:
    """Return a robot that ignores commands below 0.1 to 0.25."""
    half, plant = rng.uniform(0.1, 0.25), second_order(rng)
    return behind(plant, lambda held: Held(
        held.time, held.values - np.clip(held.values, -half, half)), 2.0)


def _of_law(law: Law, band: float, what: int) -> Robot:
    def move(held: Held, times: Array, rng: Random | None) -> Array:
        return accelerated(law, held, times)[what][:, np.newaxis]
    return Robot(move, band)


def coulomb(rng: Random, kind: str) -> Robot:
    """Return a motor's speed with dry friction of 10 to 25 % of the largest torque."""
    friction, slow = rng.uniform(0.1, 0.25), 1.0 / rng.uniform(0.15, 0.5)

    def law(x: float, v: float, u: float) -> float:
        dry = friction * min(max(v / 0.02, -1.0), 1.0)
        return slow * (u - v - dry)
    return _of_law(law, 2.0, 1)


def quadratic_drag(rng: Random, kind: str) -> Robot:
    """Return a boat's speed: drag grows with its square."""
    drag, linear, force = rng.uniform(0.8, 2.0), rng.uniform(0.3, 1.0), rng.uniform(1.0, 2.5)

    def law(x: float, v: float, u: float) -> float:
        return force * u - linear * v - drag * abs(v) * v
    return _of_law(law, 1.0, 1)


def pendulum(rng: Random, kind: str) -> Robot:
    """Return a hanging pendulum's angle, of 5 to 20 degrees."""
    w, damping, torque = rng.uniform(3.0, 7.0), rng.uniform(0.05, 0.3), rng.uniform(0.05, 0.15)

    def law(x: float, v: float, u: float) -> float:
        sine = x * (1.0 - x * x / 6.0 * (1.0 - x * x / 20.0))
        return w * (w * (torque * u - sine) - 2.0 * damping * v)
    return _of_law(law, 1.5, 0)


def gain_drift(rng: Random, kind: str) -> Robot:
    """Return a robot whose gain drifts by 30 % while it is recorded."""
    plant, way = motor_speed_plant(rng), rng.choice((-0.3, 0.3))

    def move(held: Held, times: Array, rng: Random | None) -> Array:
        if rng is None:
            return plant.move(held, times)
        fine = finely(held, times[-1])
        gain = 1.0 + way * (np.clip(fine.time / times[-1], 0.0, 1.0) - 0.5)
        return plant.move(Held(fine.time, gain[:, np.newaxis] * fine.values), times)
    return Robot(move, 2.0)


FAMILIES = {
    'saturation-30': Family(saturation_30, 'saturated 30 % of the time'),
    'saturation-60': Family(saturation_60, 'saturated 60 % of the time'),
    'rate-limit': Family(rate_limit, 'actuator of limited rate'),
    'backlash': Family(backlash, 'play of 10 to 30 %'),
    'coulomb': Family(coulomb, 'dry friction'),
    'dead-zone': Family(dead_zone, 'commands below 10 to 25 % ignored'),
    'quadratic-drag': Family(quadratic_drag, 'drag with the square of speed'),
    'pendulum': Family(pendulum, 'pendulum, 5 to 20 degrees'),
    'gain-drift': Family(gain_drift, 'gain drifts by 30 %'),
}
