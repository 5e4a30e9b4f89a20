# SPDX-License-Identifier: Apache-2.0
"""
The program of the simulated robot: `ros2 run ctsid simulated_robot`.

Without an installation: `python -m ctsid_ros.examples.simulated_robot`. Attach a payload while it
flies: `ros2 param set /simulated_robot payload 0.5`.
"""

from __future__ import annotations

from collections.abc import Sequence
import sys

from ctsid_ros.blas import use_one_thread


def main(argv: Sequence[str] | None = None) -> int:
    """Fly until told to end; return the exit code."""
    use_one_thread()  # before NumPy is imported, hence the imports here
    from ctsid_ros.examples.robot_node import SimulatedRobot
    from ctsid_ros.examples.running import run

    return run(SimulatedRobot, argv)


if __name__ == '__main__':
    sys.exit(main())
