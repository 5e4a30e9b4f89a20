# SPDX-License-Identifier: Apache-2.0
"""
Angles of quaternions.

Fixed-axis x, y, z (intrinsic z, y', x'': "ZYX") angles as in tf and REP-103:
R = Rz(yaw) Ry(pitch) Rx(roll), with roll and yaw in (-pi, pi], pitch in [-pi/2, pi/2].
"""

from __future__ import annotations

import math

EULER_PARTS = ('roll', 'pitch', 'yaw')
QUATERNION = ('x', 'y', 'z', 'w')


def roll_pitch_yaw(x: float, y: float, z: float, w: float) -> tuple[float, float, float]:
    """
    Return the ZYX angles [rad] of a quaternion that need not be normalised; NaN if it is zero.

    R = Rz(yaw) Ry(pitch) Rx(roll), read off R[2, :] and R[:, 0] multiplied by |q|^2.
    """
    square = x * x + y * y + z * z + w * w
    if not 0.0 < square < math.inf:
        return math.nan, math.nan, math.nan
    roll = math.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    sine = 2.0 * (w * y - z * x) / square
    yaw = math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return roll, math.asin(min(1.0, max(-1.0, sine))), yaw
