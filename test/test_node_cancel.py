# SPDX-License-Identifier: Apache-2.0
"""What ends the work of the running node ends an identification under way, at once."""

from pathlib import Path
import signal
from threading import Thread

from marks import slow
import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import Live, seconds_until  # noqa: E402
from robot import Robot, motion, params  # noqa: E402

from ctsid_ros.messages import Level  # noqa: E402

SOON = 0.1  # s, of one that asks every 5 ms
BESIDE = 0.4  # s: the way of a request and its answer on a busy computer


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        pace = tmp_path / 'seconds'
        pace.write_text('1000', encoding='ascii')
        made.env |= {'SLOW_NODE_SECONDS': str(pace), 'PYTHONPATH': ':'.join(
            (made.env['PYTHONPATH'], str(Path(__file__).parent)))}
        made.pace = pace
        yield made


def busy(live, more=''):
    """Return a node in the middle of its first identification, and a robot that goes on."""
    node = live.identifier(params(f'ingest.timeout: 60.0\n{more}'.strip(), length=2.0),
                           module='slow_node')
    robot = Robot(live, motion(30.0), node.name)
    robot.send(3.0, speed=10.0)
    live.wait(lambda: 'begun' in node.log, 'an identification')
    return node, robot


def count(node, word: str) -> int:
    return node.log.splitlines().count(word)


def begun_after(live, node, act):
    before = count(node, 'begun')
    act()
    live.wait(lambda: count(node, 'begun') > before, 'an identification')


def cancelled_within(node, act) -> float:
    """Return how long it takes until an identification is broken off [s]."""
    before, acting = count(node, 'cancelled'), Thread(target=act)
    acting.start()
    seconds = seconds_until(lambda: count(node, 'cancelled') > before, 'the end of it')
    acting.join()
    return seconds


def test_deactivation_and_reset_break_off_and_the_next_window_begins(live):
    node, robot = busy(live)
    assert node.change_state('deactivate')  # makes the clients: discovery takes its time
    assert count(node, 'cancelled') == 1
    assert node.change_state('activate')
    begun_after(live, node, lambda: robot.send(7.0, speed=10.0))
    assert cancelled_within(node, lambda: node.change_state('deactivate')) < SOON + BESIDE
    assert count(node, 'begun') == count(node, 'cancelled')  # and no other is begun on the way
    assert node.change_state('activate')
    begun_after(live, node, lambda: robot.send(11.0, speed=10.0))
    node.trigger('reset')
    begun_after(live, node, lambda: robot.send(15.0, speed=10.0))
    assert cancelled_within(node, lambda: node.trigger('reset')) < SOON + BESIDE
    live.pace.write_text('0', encoding='ascii')
    robot.send(18.5, speed=10.0)
    node.wait_models(1)  # of the real one
    assert 'TWO AT ONCE' not in node.log
    assert node.program.alive


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGTERM, *slow(signal.SIGINT)])
def test_a_signal_breaks_off(live, number):
    node, _ = busy(live)
    assert cancelled_within(
        node, lambda: node.program.process.send_signal(number)) < SOON + BESIDE
    code, seconds = node.program.end(number)
    assert code == 0
    assert seconds < 1.0


@pytest.mark.slow
def test_diagnostics_say_how_long_it_has_taken_and_what_it_skips(live):
    node, robot = busy(live, 'window.stride: 0.5')
    said = node.wait_health('identification', lambda h: 'is being identified' in h.message
                            or 'under way' in h.message, 'what it does')
    assert said.message.endswith('there is no result yet')
    robot.send(8.0, speed=10.0)
    said = node.wait_health('identification', lambda h: int(h.values['skipped meanwhile']) > 2
                            and float(h.values['under way for [s]']) > 2.0, 'windows skipped')
    assert said.level == Level.WARN
    assert said.message.startswith('window 1 has been under way for ')
    assert f'{said.values["skipped meanwhile"]} newer windows were skipped' in said.message
    assert said.values['window under way'] == '1'
    live.pace.write_text('0', encoding='ascii')
    robot.wait_taken(node)
    node.trigger('reset')
    for number, end in enumerate(np.arange(10.45, 12.0, 0.5), 1):  # none is skipped any more
        robot.send(end, speed=10.0)
        node.wait_models(number)
    said = node.wait_health('identification', lambda h: 'skipped' not in h.message
                            and 'verdict' in h.values, 'the end of the warning')
    assert int(said.values['skipped windows']) > 2
    assert said.level == {'GOOD': Level.OK, 'WEAK': Level.WARN}.get(said.values['verdict'],
                                                                  Level.ERROR)
