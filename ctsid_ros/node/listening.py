# SPDX-License-Identifier: Apache-2.0
"""Listen to a running identifier, as any other node could: `ctsid watch`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from ctsid_ros.interrupts import deferred

_MODELS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)


@contextmanager
def listening(name: str, diagnostics: Callable[[DiagnosticArray], None],
              model: Callable[[String], None]) -> Iterator[Callable[[float], None]]:
    """
    Give a function that waits for messages so long [s], and hands over those that come.

    Parameters
    ----------
    name : str
        Full name of the node that is listened to.
    diagnostics, model : callable
        Given each message of `/diagnostics`, and of the topic `model` of the node.
    """
    context = Context()
    rclpy.init(context=context, args=[])
    node = Node(f'ctsid_watch_{os.getpid()}', context=context, start_parameter_services=False,
                enable_rosout=False)
    executor = SingleThreadedExecutor(context=context)
    try:
        executor.add_node(node)
        node.create_subscription(DiagnosticArray, '/diagnostics', diagnostics, 10)
        node.create_subscription(String, f'{name}/model', model, _MODELS)
        with deferred() as check:

            def wait(seconds: float) -> None:
                executor.spin_once(timeout_sec=seconds)
                check()

            yield wait
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def domain() -> str:
    """Return the ROS domain that is listened to."""
    return os.environ.get('ROS_DOMAIN_ID') or '0'
