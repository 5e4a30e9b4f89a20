# SPDX-License-Identifier: Apache-2.0
"""Linear robots: motors, aircraft axes, joints, skid steering, and plants drawn at random."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_ros.studies.robots.experiment import Family, Random, Robot
from ctsid_ros.studies.robots.linear import Held, Linear


def robot_of(plant: Linear, band: float, **more: Any) -> Robot:
    """Return a robot that is a linear plant and nothing else."""
    def move(held: Held, times: Array, rng: Random | None) -> Array:
        return plant.move(held, times)
    return Robot(move, band, plant.nu, plant.response, **more)


def pair(frequency: float, damping: float) -> tuple[complex, complex]:
    """Return the poles of a natural frequency [rad/s] and a damping ratio."""
    p = frequency * complex(-damping, np.sqrt(1.0 - damping ** 2))
    return p, p.conjugate()


def motor_speed_plant(rng: Random) -> Linear:
    """Return a dc motor, its inertia and its winding, from voltage to speed."""
    slow, fast = 1.0 / rng.uniform(0.1, 0.6), 1.0 / rng.uniform(0.005, 0.03)
    return Linear.of_roots(rng.uniform(0.5, 2.0), (-slow, -fast))


def motor_speed(rng: Random, kind: str) -> Robot:
    """Return the same, to be recorded."""
    return robot_of(motor_speed_plant(rng), 3.0)


def motor_position(rng: Random, kind: str) -> Robot:
    """Return a dc motor from voltage to position."""
    return robot_of(Linear.of_roots(rng.uniform(0.5, 2.0), (0.0, -1.0 / rng.uniform(0.1, 0.5))),
                    2.0)


def sliding_mass(rng: Random, kind: str) -> Robot:
    """Return a mass with a little viscous drag, from force to place."""
    drag = rng.uniform(0.1, 0.6)
    return robot_of(Linear.of_roots(1.0 / drag, (0.0, -drag)), 1.0)


def roll_plant(rng: Random) -> Linear:
    """Return a quadrotor's roll under its autopilot: motor lag and dead time beside the pair."""
    lag, delay = rng.uniform(0.02, 0.06), rng.uniform(0.03, 0.12)
    roots = (*pair(rng.uniform(5.0, 11.0), rng.uniform(0.45, 0.85)), -1.0 / lag)
    return Linear.of_roots(rng.uniform(0.8, 1.1), roots, delay)


def roll(rng: Random, kind: str) -> Robot:
    """Return the same, to be recorded."""
    return robot_of(roll_plant(rng), 3.0)


def delayed_lag(rng: Random, kind: str) -> Robot:
    """Return a rover's speed: first order after a dead time."""
    return robot_of(Linear.of_roots(rng.uniform(0.7, 1.3), (-1.0 / rng.uniform(0.15, 0.6),),
                                    rng.uniform(0.05, 0.25)), 2.0)


def flexible_joint(rng: Random, kind: str) -> Robot:
    """Return a joint with a mode of 1 % damping behind a lag."""
    f = rng.uniform(2.0, 6.0)
    roots = (*pair(2.0 * np.pi * f, 0.01), -1.0 / rng.uniform(0.05, 0.2))
    return robot_of(Linear.of_roots(1.0, roots), 1.5 * f)


def two_masses(rng: Random, kind: str) -> Robot:
    """Return two masses between springs, pushed at the first: both places."""
    k, c = rng.uniform(40.0, 160.0, 3), rng.uniform(0.5, 2.5, 3)
    spring = np.array([[k[0] + k[1], -k[1]], [-k[1], k[1] + k[2]]])
    damper = np.array([[c[0] + c[1], -c[1]], [-c[1], c[1] + c[2]]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-spring, -damper]])
    B, C = np.array([[0.0], [0.0], [60.0], [0.0]]), np.eye(2, 4)
    return robot_of(Linear(A, B, C), 4.0)


def skid_steer_plant(rng: Random) -> Linear:
    """Return speed and yaw rate of a robot from the speeds of its two sides."""
    slow, turn = 1.0 / rng.uniform(0.15, 0.5), 1.0 / rng.uniform(0.08, 0.3)
    width = rng.uniform(0.4, 0.8)
    A, B = np.diag([-slow, -turn]), np.array([[0.5, 0.5], [-0.7 / width, 0.7 / width]])
    return Linear(A, np.diag([slow, turn]) @ B, np.eye(2), rng.uniform(0.0, 0.1))


def skid_steer(rng: Random, kind: str) -> Robot:
    """Return the same, to be recorded."""
    return robot_of(skid_steer_plant(rng), 2.0)


def _random(rng: Random, size: int) -> Robot:
    order, poles = size + int(rng.integers(0, 3)), np.zeros((0, 0))
    while len(poles) < order:
        w = np.exp(rng.uniform(np.log(1.5), np.log(15.0)))
        turn = np.sqrt(1.0 - rng.uniform(0.1, 0.9) ** 2) if order - len(poles) > 1 \
            and rng.random() < 0.5 else 0.0
        block = w * np.array([[-np.sqrt(1.0 - turn ** 2), turn],
                              [-turn, -np.sqrt(1.0 - turn ** 2)]]) if turn else -w * np.eye(1)
        old = len(poles)
        poles = np.pad(poles, (0, len(block)))
        poles[old:, old:] = block
    B = rng.standard_normal((order, size)) * np.sqrt(np.sum(poles ** 2, axis=1))[:, np.newaxis]
    return robot_of(Linear(poles, B, rng.standard_normal((size, order))), 3.0,
                    duration=(8.0, 20.0))


def random_2x2(rng: Random, kind: str) -> Robot:
    """Return a plant of order 2 to 4 with two inputs and two outputs."""
    return _random(rng, 2)


def random_3x3(rng: Random, kind: str) -> Robot:
    """Return a plant of order 3 to 5 with three inputs and three outputs."""
    return _random(rng, 3)


def integrator(rng: Random, kind: str) -> Robot:
    """Return a heading from a rate that is commanded, after a dead time."""
    return robot_of(Linear.of_roots(rng.uniform(0.5, 1.5), (0.0,), rng.uniform(0.0, 0.1)), 1.0)


def slow_pole(rng: Random, kind: str) -> Robot:
    """Return a time constant of 60 s, recorded for 10 s."""
    return robot_of(Linear.of_roots(10.0, (-1.0 / 60.0,)), 0.8, duration=(9.0, 11.0))


def fast_pole(rng: Random, kind: str) -> Robot:
    """Return a time constant of 8 to 20 ms."""
    return robot_of(Linear.of_roots(1.0, (-1.0 / rng.uniform(0.008, 0.02),)), 6.0,
                    output_rate=(100.0, 200.0), input_rate=(40.0, 100.0))


def _scaled(rng: Random, gain: float) -> Robot:
    p = pair(rng.uniform(3.0, 9.0), rng.uniform(0.2, 0.7))
    return robot_of(Linear.of_roots(gain * rng.uniform(1.0, 3.0), p), 2.5)


def small_gain(rng: Random, kind: str) -> Robot:
    """Return a pair with a gain of 1e-6."""
    return _scaled(rng, 1e-6)


def large_gain(rng: Random, kind: str) -> Robot:
    """Return a pair with a gain of 1e6."""
    return _scaled(rng, 1e6)


def sensor_lowpass(rng: Random, kind: str) -> Robot:
    """Return a motor's speed behind the low-pass of its sensor."""
    slow = -1.0 / rng.uniform(0.15, 0.5)
    return robot_of(Linear.of_roots(1.0, (slow, *pair(2 * np.pi * rng.uniform(4.0, 12.0), 0.7))),
                    3.0)


FAMILIES = {
    'motor-speed': Family(motor_speed, 'dc motor, speed'),
    'motor-position': Family(motor_position, 'dc motor, position'),
    'sliding-mass': Family(sliding_mass, 'double integrator with drag'),
    'roll': Family(roll, 'quadrotor roll, motor lag, dead time 30 to 120 ms'),
    'delayed-lag': Family(delayed_lag, 'first order after 50 to 250 ms'),
    'flexible-joint': Family(flexible_joint, 'mode of 1 % damping'),
    'two-masses': Family(two_masses, 'fourth order, two outputs'),
    'skid-steer': Family(skid_steer, 'skid steering, 2 x 2'),
    'random-2x2': Family(random_2x2, 'random plants, 2 x 2'),
    'random-3x3': Family(random_3x3, 'random plants, 3 x 3'),
    'integrator': Family(integrator, 'integrator after a dead time'),
    'slow-pole': Family(slow_pole, '60 s in a window of 10 s'),
    'fast-pole': Family(fast_pole, '8 to 20 ms'),
    'small-gain': Family(small_gain, 'gain of 1e-6'),
    'large-gain': Family(large_gain, 'gain of 1e6'),
    'sensor-lowpass': Family(sensor_lowpass, 'speed behind a low-pass'),
}
