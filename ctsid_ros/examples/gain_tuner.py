# SPDX-License-Identifier: Apache-2.0
"""
The program of the gain tuner: `ros2 run ctsid gain_tuner`.

Without an installation: `python -m ctsid_ros.examples.gain_tuner`. Its models come on the topic
`identifier/model`: remap it if the identifier has another name.
"""

from __future__ import annotations

from collections.abc import Sequence
import sys

from ctsid_ros.blas import use_one_thread


def main(argv: Sequence[str] | None = None) -> int:
    """Tune until told to end; return the exit code."""
    use_one_thread()  # before NumPy is imported, hence the imports here
    from ctsid_ros.examples.running import run
    from ctsid_ros.examples.tuner_node import GainTuner

    return run(GainTuner, argv)


if __name__ == '__main__':
    sys.exit(main())
