# SPDX-License-Identifier: Apache-2.0
"""
A robot that only publishes: Imu and Float64MultiArray at given rates, numbered and time-stamped.

Usage: python benchmarks/fast_robot.py IMU_RATE COMMAND_RATE SECONDS

Messages are serialised once; each publication writes stamp and values into the bytes, so that
this costs little and the subscriber is what is measured. The plant has two inputs, three outputs
and four states; its motion is computed beforehand, for held inputs exactly, and repeats.
"""

from __future__ import annotations

import signal
import struct
import sys
import threading
import time

import numpy as np
from numpy.typing import NDArray
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from scipy.signal import cont2discrete, dlsim
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

Array = NDArray[np.float64]
A = np.array([[-2.0, 8.0, 0.0, 0.0], [-8.0, -2.0, 0.0, 0.0], [0.0, 0.0, -5.0, 0.0],
              [0.0, 0.0, 0.0, -1.0]])
B = np.array([[1.0, 0.3], [-0.4, 1.2], [2.0, -1.0], [0.5, 0.8]])
C = np.array([[1.0, 0.2, 0.5, 0.3], [0.1, 1.0, -0.4, 0.6], [0.3, -0.5, 1.0, 1.0]])
PERIOD = 20.0  # s, after which the motion repeats
HOLD = 0.1  # s, for which a command stays the same
# Where the values stand in the serialised messages, with an empty frame_id.
SECONDS, RATES, DATA = 4, 4 + 16 + 104, 20


def motion(rate: float) -> tuple[Array, Array]:
    """Return commands (N, 2) and noisy outputs (N, 3) at a rate [Hz], in periodic motion."""
    rng = np.random.default_rng(1)
    count = int(PERIOD * rate)
    levels = rng.standard_normal((int(PERIOD / HOLD), 2))
    u = np.repeat(levels, count // len(levels), axis=0)
    system = cont2discrete((A, B, C, np.zeros((3, 2))), 1.0 / rate)
    y = np.asarray(dlsim(system, np.concatenate([u, u]))[1])[count:]
    return u, y + 0.05 * y.std(axis=0) * rng.standard_normal(y.shape)


def main(imu_rate: float, command_rate: float, seconds: float) -> None:
    """Publish for some seconds."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node('fast_robot', start_parameter_services=False)
    qos = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)
    imu, command = (node.create_publisher(kind, topic, qos) for kind, topic in (
        (Imu, '/imu'), (Float64MultiArray, '/command')))
    imu_bytes = bytearray(serialize_message(Imu()))
    command_bytes = bytearray(serialize_message(Float64MultiArray(data=[0.0, 0.0])))
    u, y = motion(max(imu_rate, 1000.0))
    base = max(imu_rate, 1000.0)
    start = time.time_ns()
    sent = [0, 0]
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):  # not rclpy's: a publication is not cut off
        signal.signal(number, lambda *_: ended.set())
    while (passed := (time.time_ns() - start) * 1e-9) < seconds and not ended.is_set():
        for k, (rate, publisher) in enumerate(((imu_rate, imu), (command_rate, command))):
            while sent[k] < passed * rate:
                at = int(sent[k] / rate * base) % len(u)
                if publisher is imu:
                    stamp = start + int(sent[k] / rate * 1e9)
                    struct.pack_into('<iI', imu_bytes, SECONDS, *divmod(stamp, 10**9))
                    struct.pack_into('<ddd', imu_bytes, RATES, *y[at])
                    imu.publish(bytes(imu_bytes))
                else:
                    struct.pack_into('<dd', command_bytes, DATA, *u[at])
                    command.publish(bytes(command_bytes))
                sent[k] += 1
        time.sleep(min(0.5 / max(imu_rate, command_rate), 0.001))
    print(*sent)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main(*map(float, sys.argv[1:4]))
