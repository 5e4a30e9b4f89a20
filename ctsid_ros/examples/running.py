# SPDX-License-Identifier: Apache-2.0
"""Run an example node until it is told to end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import signal
from types import FrameType

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

_TURN = 0.2  # within this time a signal is noticed [s]


def run(make: Callable[[], Node], argv: Sequence[str] | None = None) -> int:
    """
    Spin a node until SIGINT or SIGTERM; return the exit code, 0.

    Parameters
    ----------
    make : callable
        Makes the node. If that has a method `close`, it is called before the end.
    argv : sequence of str, optional
        Command line; that of the process if not given.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    node = None
    try:
        rclpy.init(args=None if argv is None else list(argv))
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok():  # spin() may sleep through a signal until something else wakes it
            executor.spin_once(timeout_sec=_TURN)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # A signal may have taken the context away under a call of the middleware.
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            getattr(node, 'close', lambda: None)()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
