# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM end the node within a second, with exit code 0, from any state."""

from pathlib import Path
import random
import re
import signal
import time

from marks import slow
import pytest

pytest.importorskip('rclpy')
from live import Live  # noqa: E402
from robot import Robot, motion, params  # noqa: E402

SIGNALS = [signal.SIGINT, signal.SIGTERM]


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def caught(program) -> int:
    """Return the mask of the signals that a process handles by itself."""
    status = Path(f'/proc/{program.process.pid}/status').read_text(encoding='ascii')
    return int(re.search(r'SigCgt:\s*([0-9a-f]+)', status)[1], 16)


def starting(live):
    node = live.identifier(params())
    live.wait(lambda: caught(node.program) >> (signal.SIGTERM - 1) & 1, 'the program to begin')
    time.sleep(random.uniform(0.0, 1.5))
    return node


def unconfigured(live):
    node = live.identifier(params('autostart: false'))
    node.wait_state('unconfigured')
    return node


def inactive(live):
    node = unconfigured(live)
    assert node.change_state('configure')
    return node


def without_data(live):
    node = live.identifier(params())
    node.wait_state('active')
    return node


def busy(live):
    """A node in the middle of an identification of seconds, while messages come."""
    more = 'order: 30\npbsid.past: 50\nhermite.nmax: 5000\nhermite.parts: 4'
    node = live.identifier(params(more, length=6.0))
    robot = Robot(live, motion(8.5, rates=(400.0, 400.0)), node.name)
    robot.send(8.0, speed=15.0)
    node.wait_health('identification', lambda h: int(h.values.get('windows', 0)), 'a window')
    assert not node.models, [e.verdict.reason for e in node.estimates()]
    robot.send(speed=5.0)
    return node


STATES = [starting, unconfigured, inactive, without_data, busy]


def assert_ends(node, number):
    code, seconds = node.program.end(number)
    assert code == 0
    assert seconds < 1.0
    assert 'Traceback' not in node.log
    assert 'rror' not in node.log.replace('[ERROR]', 'rror')


def test_a_signal_ends_the_node(live):
    assert_ends(starting(live), signal.SIGTERM)


@pytest.mark.parametrize('pause', slow(0.0, 0.03, 0.06, 0.1))
def test_signals_while_it_ends_do_not_matter(live, pause):
    node = without_data(live)
    node.program.process.send_signal(signal.SIGINT)
    time.sleep(pause)
    assert_ends(node, random.choice(SIGNALS))


@pytest.mark.slow
@pytest.mark.parametrize('number', SIGNALS)
@pytest.mark.parametrize('state', STATES)
def test_a_signal_ends_the_node_20_times_of_20(tmp_path, state, number):
    for k in range(20):
        folder = tmp_path / str(k)
        folder.mkdir()
        with Live(folder) as live:
            assert_ends(state(live), number)
