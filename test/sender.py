# SPDX-License-Identifier: Apache-2.0
"""
A process that publishes /imu and /command in real time as fast as is asked for.

Usage: python sender.py IMU_RATE COMMAND_RATE SECONDS

It begins once /identifier hears both topics, publishes all in the order of stamps whatever holds
it up, prints how many messages it has sent, and stays until it is ended. Messages are serialised
once; each publication writes stamp and values into the bytes.
"""

from __future__ import annotations

import signal
import struct
import sys
import time

from live import RELIABLE, meet
import rclpy
from rclpy.node import Node
from rclpy.serialization import serialize_message
from robot import SOFT, motion
from sensor_msgs.msg import Imu, JointState

STAMP, RATES = 4, 4 + 16 + 104  # where the values stand, with an empty frame_id
EFFORT = serialize_message(JointState(effort=[1.5])).index(struct.pack('<d', 1.5))


def main(imu_rate: float, command_rate: float, seconds: float) -> None:
    made = motion(min(seconds, 20.0), phases=((0.0, SOFT),), rates=(command_rate, imu_rate))
    rclpy.init()
    node = Node('sender', start_parameter_services=False)
    publishers = [node.create_publisher(kind, topic, RELIABLE) for kind, topic in (
        (Imu, '/imu'), (JointState, '/command'))]
    raw = [bytearray(serialize_message(Imu())),
           bytearray(serialize_message(JointState(effort=[0.0])))]

    def wait(condition, _) -> None:
        while not condition():
            rclpy.spin_once(node, timeout_sec=0.01)

    wait(lambda: all(publisher.get_subscription_count() for publisher in publishers), '')
    meet(node, '/identifier', wait)
    kinds = [(imu_rate, made.y, RATES, '<dd'), (command_rate, made.u, EFFORT, '<d')]
    sent, start = [0, 0], time.time_ns()
    while min(sent[k] / kinds[k][0] for k in (0, 1)) < seconds and rclpy.ok():
        passed = min((time.time_ns() - start) * 1e-9, seconds)
        while (due := min((sent[k] / kinds[k][0], k) for k in (0, 1)))[0] < passed:
            stamp, k = start + int(due[0] * 1e9), due[1]
            _, values, place, form = kinds[k]
            struct.pack_into('<iI', raw[k], STAMP, *divmod(stamp, 10**9))
            struct.pack_into(form, raw[k], place, *values[sent[k] % len(values)])
            publishers[k].publish(bytes(raw[k]))
            sent[k] += 1
        time.sleep(0.001)
    print('sent', *sent, flush=True)
    signal.pause()  # what is under way needs it


if __name__ == '__main__':
    main(*map(float, sys.argv[1:4]))
