# SPDX-License-Identifier: Apache-2.0
"""
The program of the node: `ros2 run ctsid identifier`, or `python -m ctsid_ros.node`.

SIGINT and SIGTERM end it with exit code 0, in any state, within a second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
import os
from pathlib import Path
import signal
import sys
from types import FrameType

from ctsid_ros.blas import use_one_thread

_TURN = 0.05  # within this time a signal is noticed [s]
_PATIENCE = 0.3  # time for threads to end by themselves [s]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end; return the exit code."""
    _handle(_leave)
    try:
        return _run(argv)
    except KeyboardInterrupt:  # while it was starting
        return 0


def _leave(number: int, frame: FrameType | None) -> None:
    """
    End the program at once: nothing is lost with it yet.

    An interrupt while modules are imported would not do: Python notes those that pass through
    code that is made from text, as that of dataclasses, and dies of SIGINT in the end.
    """
    os._exit(0)


def _interrupt(number: int, frame: FrameType | None) -> None:
    _handle(_pass)  # another one, as by a second ctrl-C, must not break off the ending
    raise KeyboardInterrupt


def _pass(number: int, frame: FrameType | None) -> None:
    pass


def _handle(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def _run(argv: Sequence[str] | None) -> int:
    if missing := _missing_file(sys.argv if argv is None else argv):
        print(f'identifier: the parameter file {missing} does not exist, or is no file; give '
              'another with --params-file (ctsid init BAG -o params.yaml writes one)',
              file=sys.stderr)
        return 1
    use_one_thread()  # before NumPy is imported, hence the imports here
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    from ctsid_ros.node.identifier import Identifier

    _handle(_interrupt)  # before those of rclpy, which call them
    try:
        rclpy.init(args=None if argv is None else list(argv))
    except Exception as error:
        if 'param' not in str(error):
            raise
        print(f'identifier: ROS cannot read the parameters: {error}\n(Each list is of one kind, '
              'no value is left out, and words that mean something to YAML - y, n, on, off - '
              'stand in quotes.)', file=sys.stderr)
        return 1
    node, ended = None, True
    try:
        node = Identifier()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.start()
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
            ended = node.close(_PATIENCE)
            node.destroy_node()
        rclpy.try_shutdown()
        _handle(signal.SIG_IGN)  # Python takes back all other handlers before it ends
    if not ended:  # a long identification is under way: nothing is lost with it
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def _missing_file(words: Sequence[str]) -> str:
    """Return the first parameter file on a command line that is none; '' if all are there."""
    return next((value for flag, value in pairwise(words)
                 if flag == '--params-file' and not Path(value).is_file()), '')


if __name__ == '__main__':
    sys.exit(main())
