# SPDX-License-Identifier: Apache-2.0
"""A short flight of a known plant as a real bag, whole or spoilt, and parameter files for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from bag_fixtures import START, Sent, array, imu, write_rosbag2
import numpy as np

from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Signal

# -1.5 +- 3j rad/s, steady gain 2, at an operating point other than zero
TRUTH = StateSpace(
    [[0.0, 1.0], [-11.25, -3.0]], [[0.0], [22.5]], [[1.0, 0.0]], x_trim=[0.0, 3.0],
    y_trim=[0.4], input_names=('torque',), output_names=('rate',), input_units=('N m',),
    output_units=('rad/s',))
PARAMS = """
/**:
  ros__parameters:
    inputs: [torque]
    outputs: [rate]
    torque: {topic: /cmd, type: std_msgs/msg/Float64MultiArray, field: 'data[0]', unit: 'N m'}
    rate: {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.x, unit: rad/s}
    order: 2
    window: {length: 5.0, stride: 2.5}
"""
S = 10**9


def flight(duration: float = 20.0, noise: float = 0.02, seed: int = 1) -> list[Sent]:
    """Return /cmd at 20 Hz without header, held, and /imu at 100 Hz with one; log 2 ms late."""
    return list(_flight(duration, noise, seed))


@lru_cache
def _flight(duration: float, noise: float, seed: int) -> tuple[Sent, ...]:
    """Make a flight once; nobody changes its messages."""
    rng = np.random.default_rng(seed)
    t_u = np.arange(0.0, duration, 0.05) + rng.uniform(0, 0.01, int(np.ceil(duration / 0.05)))
    t_y = np.arange(0.0, duration, 0.01) + rng.uniform(0, 0.003, int(np.ceil(duration / 0.01)))
    u = rng.uniform(-1, 1, len(t_u))
    known = Signal(t_u, u[:, np.newaxis], 'zoh')
    y = TRUTH.simulate((known,), t_y)[:, 0] + noise * rng.standard_normal(len(t_y))
    sent = [Sent('/cmd', 'std_msgs/msg/Float64MultiArray', START + round(t * S), array(v, 0.5))
            for t, v in zip(t_u, u, strict=True)]
    for t, v in zip(t_y, y, strict=True):
        stamp = START + round(t * S)
        sent.append(Sent('/imu', 'sensor_msgs/msg/Imu', stamp + 2_000_000, imu(stamp, v)))
    return tuple(sorted(sent, key=lambda s: s.log_ns))


def spoilt(topic: str, spoil: Callable[[int, Sent], Sent | None],
           sent: Iterable[Sent] | None = None) -> list[Sent]:
    """Return a flight with the messages of one topic changed, or left out where None."""
    result: list[Sent] = []
    count = 0
    for one in flight() if sent is None else sent:
        if one.topic == topic:
            changed = spoil(count, one)
            result += [changed] if changed else []
            count += 1
        else:
            result.append(one)
    return result


def at(one: Sent, stamp_ns: int, rate: float | None = None) -> Sent:
    """Return an /imu message with another header stamp, and perhaps another rate."""
    value = one.message.angular_velocity.x if rate is None else rate
    return replace(one, message=imu(stamp_ns, value))


def stamp_of(one: Sent) -> int:
    """Return the header stamp of an /imu message [ns]."""
    stamp = one.message.header.stamp
    return stamp.sec * S + stamp.nanosec


def write_flight(folder: Path, sent: Iterable[Sent] | None = None) -> str:
    """Write a flight as rosbag2."""
    return str(write_rosbag2(folder, flight() if sent is None else sent))


def write_params(path: Path, text: str = PARAMS) -> str:
    """Write a parameter file."""
    path.write_text(text)
    return str(path)
