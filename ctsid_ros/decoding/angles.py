# SPDX-License-Identifier: Apache-2.0
"""
Angles of quaternions, and their course over time.

Fixed-axis x, y, z (intrinsic z, y', x'': "ZYX") angles as in tf and REP-103:
R = Rz(yaw) Ry(pitch) Rx(roll), with roll and yaw in (-pi, pi], pitch in [-pi/2, pi/2].
"""

from __future__ import annotations

from collections.abc import Sequence
import math

EULER_PARTS = ('roll', 'pitch', 'yaw')
QUATERNION = ('x', 'y', 'z', 'w')


class Unwrapper:
    """
    Joins the angles of successive messages: no jump of more than pi from one to the next.

    Parameters
    ----------
    angles : sequence of bool
        Which scalars are angles [rad]; the others pass unchanged.
    """

    def __init__(self, angles: Sequence[bool]) -> None:
        self._angles = [i for i, angle in enumerate(angles) if angle]
        self._last: dict[int, float] = {}

    def __call__(self, values: Sequence[float]) -> tuple[float, ...]:
        """Return the values of one message, its angles unwrapped; NaN passes and is ignored."""
        if not self._angles:
            return tuple(values)
        joined = list(values)
        for i in self._angles:
            if math.isfinite(joined[i]):
                turns = round((self._last.get(i, joined[i]) - joined[i]) / math.tau)
                joined[i] += turns * math.tau
                self._last[i] = joined[i]
        return tuple(joined)

    def reset(self) -> None:
        """Forget the past, after a jump in time."""
        self._last.clear()


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
