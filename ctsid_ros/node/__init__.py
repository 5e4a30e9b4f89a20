# SPDX-License-Identifier: Apache-2.0
"""The node: `python -m ctsid_ros.node`. The only package that imports rclpy."""

from ctsid_ros.node.program import main

__all__ = ['main']
