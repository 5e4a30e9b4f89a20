# SPDX-License-Identifier: Apache-2.0
"""
How messages are made: with the classes of ROS, or where there is none with others of that name.

Encoders say the type and the fields; what makes the message is their argument `make`. All fields
are given, for not every maker has defaults.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ctsid_ros.decoding.message_types import message_class

Make = Callable[..., Any]  # of the name of a type and its fields
_LAST = 2**31 - 1  # seconds: as far as stamps go


def ros_message(kind: str, **fields: Any) -> Any:
    """Return a message of rclpy: `ros_message('std_msgs/msg/String', data='a')`."""
    return message_class(kind)(**fields)


def header(stamp_ns: int, make: Make) -> Any:
    """Return a `std_msgs/Header` without frame; stamps before 1970 and after 2038 have no name."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    stamp = make('builtin_interfaces/msg/Time', sec=min(max(sec, 0), _LAST), nanosec=nanosec)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id='')
