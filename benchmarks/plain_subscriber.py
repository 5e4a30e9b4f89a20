# SPDX-License-Identifier: Apache-2.0
"""
The ordinary rclpy subscriber that the node is compared with.

Usage: python benchmarks/plain_subscriber.py

One callback per message and topic, deserialised; each keeps stamp and values in an array, as
anybody would write it. Ends on SIGINT or SIGTERM.
"""

from __future__ import annotations

import signal

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

SIZE = 100_000


class Subscriber(Node):
    """Keep what comes."""

    def __init__(self) -> None:
        super().__init__('plain_subscriber')
        qos = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.rates, self.commands = np.zeros((SIZE, 4)), np.zeros((SIZE, 3))
        self.count = [0, 0]
        self.create_subscription(Imu, '/imu', self.on_imu, qos)
        self.create_subscription(Float64MultiArray, '/command', self.on_command, qos)

    def on_imu(self, msg: Imu) -> None:
        """Keep a measurement."""
        stamp, rate = msg.header.stamp, msg.angular_velocity
        self.rates[self.count[0] % SIZE] = (stamp.sec + 1e-9 * stamp.nanosec, rate.x, rate.y,
                                            rate.z)
        self.count[0] += 1

    def on_command(self, msg: Float64MultiArray) -> None:
        """Keep a command."""
        now = self.get_clock().now().nanoseconds
        self.commands[self.count[1] % SIZE] = (1e-9 * now, *msg.data)
        self.count[1] += 1


def main() -> None:
    """Spin until a signal comes."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    rclpy.init()
    node = Subscriber()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        print(*node.count)


if __name__ == '__main__':
    main()
