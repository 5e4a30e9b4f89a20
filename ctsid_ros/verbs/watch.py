# SPDX-License-Identifier: Apache-2.0
"""`ctsid watch`: what a running node hears and finds, in a terminal."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from functools import partial
import sys
import time
from typing import TYPE_CHECKING, Any

from ctsid_ros.errors import LiveError
from ctsid_ros.verbs.arguments import ACCEPTED, positive_seconds, say

if TYPE_CHECKING:
    from ctsid_ros.report.watching import Watched

HELP = 'watch a running node: rates, losses, verdicts, poles, computing time'
EPILOG = """example: ctsid watch
example: ctsid watch /drone1/identifier --once

It listens to /diagnostics and ~/model, in the domain of ROS_DOMAIN_ID, and ends on Ctrl-C. Without
a terminal it prints a line for each window."""
_TURN = 0.1     # s: so soon it notices Ctrl-C
_FRAME = 0.25   # s between pictures
_SETTLE = 1.0   # s in which a latched model comes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('node', nargs='?', default='/identifier', metavar='NODE',
                        help='full name of the node [default /identifier]')
    parser.add_argument('--once', action='store_true', help='print one picture, and end')
    parser.add_argument('--timeout', type=positive_seconds, default=10.0, metavar='S',
                        help='how long to wait for the node [s, default 10]')


def command(args: argparse.Namespace) -> int:
    """Listen and show, until Ctrl-C."""
    name = '/' + args.node.strip('/')
    _check_packages()
    from ctsid_ros.node.listening import listening
    from ctsid_ros.report.watching import Watched

    watched = Watched(name)
    try:
        with listening(name, partial(_diagnostics, watched), partial(_model, watched)) as wait:
            _meet(watched, wait, args.timeout)
            if args.once:
                _settle(watched, wait)
                _print(watched)
            elif sys.stdout.isatty():
                _show(watched, wait)
            else:
                _tell(watched, wait)
    except KeyboardInterrupt:   # the way to end it
        pass
    return ACCEPTED


def _diagnostics(watched: Watched, message: Any) -> None:
    from ctsid_core.errors import StorageError
    from ctsid_ros.messages.health import decode_diagnostics

    with suppress(StorageError):    # somebody else's, and wrong
        watched.diagnostics(decode_diagnostics(message)[1], time.monotonic())


def _model(watched: Watched, message: Any) -> None:
    from ctsid_ros.messages.models import decode_metadata, decode_model

    watched.model(decode_model(message), decode_metadata(message))


def _check_packages() -> None:
    """Raise `LiveError` if what it needs is not installed."""
    from importlib.util import find_spec

    if not find_spec('rich'):
        raise LiveError('`ctsid watch` needs the Python package rich, which is not installed '
                        'here: pip install rich (key of rosdep: python3-rich)')
    if not find_spec('rclpy'):
        raise LiveError('`ctsid watch` needs rclpy: source ROS 2 (source /opt/ros/jazzy/setup.bash'
                        "), or in the folder of ctsid: pip install '.[ros]'")


def _meet(watched: Watched, wait: Callable[[float], None], timeout: float) -> None:
    """Wait until the node has said something; raise `LiveError` if it does not."""
    from ctsid_ros.node.listening import domain

    end = time.monotonic() + timeout
    said = False
    while not watched.answered:
        wait(_TURN)
        if not said and time.monotonic() > end - timeout + 1.0:
            say(f'waiting for {watched.name} ...')
            said = True
        if time.monotonic() > end:
            others = ', '.join(sorted(watched.others))
            raise LiveError(
                f'no identifier answers as {watched.name} in ROS domain {domain()} within '
                f'{timeout:g} s; ' + (f'there is {others}: give that name' if others else
                'check that it runs (`ros2 node list`), its name (`ctsid watch NAME`), that '
                'ROS_DOMAIN_ID and RMW_IMPLEMENTATION are the same here and there, and '
                'ROS_AUTOMATIC_DISCOVERY_RANGE if it runs on another computer'))


def _settle(watched: Watched, wait: Callable[[float], None]) -> None:
    end = time.monotonic() + _SETTLE
    while time.monotonic() < end and not (watched.health and watched.estimate):
        wait(_TURN)


def _print(watched: Watched) -> None:
    from rich.console import Console

    from ctsid_ros.report.watching import picture

    Console().print(picture(watched, time.monotonic(), time.time()))


def _show(watched: Watched, wait: Callable[[float], None]) -> None:
    from rich.live import Live

    from ctsid_ros.report.watching import picture

    with Live(picture(watched, time.monotonic(), time.time()), auto_refresh=False) as live:
        shown = time.monotonic()
        while True:
            wait(_TURN)
            if time.monotonic() > shown + _FRAME:
                shown = time.monotonic()
                live.update(picture(watched, shown, time.time()), refresh=True)


def _tell(watched: Watched, wait: Callable[[float], None]) -> None:
    told = None
    while True:
        if watched.estimate is not told:
            told = watched.estimate
            print(watched.line(), flush=True)
        wait(_TURN)
