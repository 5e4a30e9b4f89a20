# SPDX-License-Identifier: Apache-2.0
"""Experiments in closed loop: what the inputs do is known only once the robot has moved."""

from __future__ import annotations

from functools import partial

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record
from ctsid_ros.studies.robots.experiment import (
    Experiment,
    Family,
    Random,
    generator,
    record_of,
    stamps,
)
from ctsid_ros.studies.robots.filters import rate_filter, upright_filter
from ctsid_ros.studies.robots.inputs import drive
from ctsid_ros.studies.robots.linear import Held, Linear
from ctsid_ros.studies.robots.loops import RatePid, under_pi
from ctsid_ros.studies.robots.mechanics import cart_pole
from ctsid_ros.studies.robots.sensor_families import gusts

NO_FEEDTHROUGH = Settings(feedthrough=False)


def set_points(family: str, kind: str, seed: int, number: int) -> Experiment:
    """Return steps of the set point of a drive under PI."""
    rng = generator(family, seed, number, 1)
    slow, fast = rng.uniform(0.3, 0.8), rng.uniform(0.05, 0.12)
    plant = Linear.of_roots(rng.uniform(0.7, 1.4), (-1 / slow, -1 / fast),
                            rng.uniform(0.02, 0.06))
    gain = rng.uniform(0.8, 1.6)
    duration, period, snr = rng.uniform(8.0, 20.0), 1.0 / rng.uniform(20.0, 60.0), 0.1 ** \
        rng.uniform(0.75, 2.0)
    rate = rng.uniform(50.0, 200.0)

    def once(rng: Random, noise: float) -> tuple[Held, Array, Array]:
        time = np.arange(-0.5, duration, period)
        wanted = drive(kind, rng, time, duration, 1.0)[:, 0]
        u = under_pi(plant, wanted, noise * rng.standard_normal(len(time)), period,
                     (gain, gain / slow))
        held, times = Held(time, u), stamps(rng, 0.0, duration, rate)
        return held, times, plant.move(held, times)

    rng = generator(family, seed, number, 2)
    held, times, clean = once(rng, 0.3 * snr)
    noise = snr * clean.std() * rng.standard_normal(clean.shape)
    test = record_of(*once(generator(family, seed, number, 3), 0.0))
    return Experiment(family, kind, seed, number, record_of(held, times, clean + noise),
                      settings=NO_FEEDTHROUGH, test=test, response=plant.response,
                      noise_time=times, noise=noise)


def balanced_pole(family: str, kind: str, seed: int, number: int) -> Experiment:
    """Return a pole that a cart balances under PD: an unstable plant, pushed about."""
    rng = generator(family, seed, number, 1)
    length, rate, duration = rng.uniform(0.4, 0.8), rng.uniform(60.0, 100.0), \
        rng.uniform(8.0, 20.0)
    noise = np.array([1e-3, 1e-3]) * np.exp(rng.uniform(np.log(0.5), np.log(3.0)))

    def once(part: int) -> Record:
        rng = generator(family, seed, number, part)
        time = np.arange(-0.5, duration, 1.0 / rate)
        pushes = 2.0 * drive(kind, rng, time, duration, 1.5)[:, 0]
        off = noise * rng.standard_normal((len(time), 2))
        u, states = cart_pole(pushes, off, 1.0 / rate, (1.5, 32.0, 2.5, 7.0), length)
        late = time >= 0.0
        return record_of(Held(time, u[:, np.newaxis]), time[late], (states[:, :2] + off)[late])
    return Experiment(family, kind, seed, number, once(2), 'prediction', NO_FEEDTHROUGH,
                      once(3), truth=upright_filter(length, noise ** 2 / rate))


def rate_plant(rng: Random, axes: int, delay: float) -> tuple[Linear, Array]:
    """
    Return a quadrotor's rates (near integrators behind motor lags), and how axes are mixed.

    Returns
    -------
    Linear
        States are the rates, then the motors' thrusts.
    share : ndarray, shape (motors, axes)
        Commands of the motors for an angular acceleration.
    """
    signs = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])
    size = rng.uniform((40.0, 40.0, 8.0), (80.0, 80.0, 15.0))[:, np.newaxis]
    effect = size * signs * rng.uniform(0.9, 1.1, (3, 4)) if axes > 1 else \
        np.array([[rng.uniform(100.0, 250.0)]])
    motors, lag = effect.shape[1], rng.uniform(0.02, 0.05)
    drag = np.diag(rng.uniform(0.1, 1.0, axes))
    A = np.block([[-drag, effect], [np.zeros((motors, axes)), -np.eye(motors) / lag]])
    B = np.vstack((np.zeros((axes, motors)), np.eye(motors) / lag))
    return Linear(_apart(A), B, np.eye(axes, axes + motors), delay), np.linalg.pinv(effect)


def _apart(A: Array) -> Array:
    """Return a matrix whose equal motors differ by some parts in a thousand, as motors do."""
    n = len(A)
    return A * (1.0 + 2e-3 * np.outer(np.arange(n), np.ones(n)) * (np.arange(n) > 0))


def flown_rates(family: str, kind: str, seed: int, number: int, axes: int) -> Experiment:
    """Return a quadrotor's rates under their PID, in light turbulence."""
    rng = generator(family, seed, number, 1)
    rate, each = rng.uniform(100.0, 250.0), int(rng.integers(1, 3))
    delay, duration = rng.uniform(5e-3, 30e-3), rng.uniform(8.0, 20.0)
    plant, share = rate_plant(rng, axes, delay)
    lag = -1.0 / plant.A[axes, axes]
    cross = 0.4 / (lag + delay + each / rate)
    pid = RatePid(plant, share, cross, 0.3 * cross ** 2, 0.3 * lag * cross, each)
    levels = rng.uniform(0.005, 0.03), rng.uniform(0.2, 1.0) * cross * 0.2

    def once(part: int) -> Record:
        return _flight(pid, kind, generator(family, seed, number, part), rate, duration, levels)
    return Experiment(family, kind, seed, number, once(2), 'prediction', NO_FEEDTHROUGH,
                      once(3), truth=rate_filter(plant, levels, rate))


def _flight(pid: RatePid, kind: str, rng: Random, rate: float, duration: float,
            levels: tuple[float, float]) -> Record:
    """Fly once; levels are those of the gyro's noise [rad/s] and of the gusts [rad/s^2]."""
    axes, motors = pid.share.shape[1], pid.share.shape[0]
    time = np.arange(-1.0, duration, 1.0 / rate)
    wanted = drive(kind, rng, time, duration, 2.0, axes)
    throttle = drive('pilot', rng, time, duration, 2.0) * (0.1 if motors > 1 else 0.0)
    kicks = np.zeros((len(time), len(pid.plant.A)))
    for i in range(axes):
        kicks[:, i] = levels[1] / rate * gusts(time, rng)[:, 0]
    noise = levels[0] * rng.standard_normal((len(time), axes))
    u, y = pid.fly(wanted, np.repeat(throttle, motors, axis=1), noise, kicks, 1.0 / rate)
    own, late = np.arange(0, len(time), pid.each), time >= 0.0
    jitter = 1e-4 * np.clip(rng.standard_normal(len(time)), -3.0, 3.0)
    return record_of(Held(time[own], u[own]), (time + jitter)[late], y[late])


FAMILIES = {
    'set-points': Family(None, 'set points under PI', ('step', 'staircase', 'doublets'),
                         set_points),
    'cart-pole': Family(None, 'cart-pole under PD', make=balanced_pole),
    'rates-1x1': Family(None, "quadrotor's roll rate under PID",
                        make=partial(flown_rates, axes=1)),
    'rates-4x3': Family(None, "quadrotor's rates under PID, 4 motors",
                        make=partial(flown_rates, axes=3)),
}
