# SPDX-License-Identifier: Apache-2.0
"""What the running node says of the cause of bad models, and of what has ended."""

from __future__ import annotations

from dataclasses import replace
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import RELIABLE, Live  # noqa: E402
from robot import EPOCH, Robot, S, joint_message, motion, params  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from test_feed import CONFIG, TYPES, command, rate  # noqa: E402

from ctsid_core.model.verdict import Grade  # noqa: E402
from ctsid_ros.config.parameter_file import read_config  # noqa: E402
from ctsid_ros.ingest.feed import Feed, Taken  # noqa: E402
from ctsid_ros.messages import Level  # noqa: E402
from ctsid_ros.node.diagnosis import IngestDiagnosis, no_window  # noqa: E402
from ctsid_ros.node.session import Progress  # noqa: E402
from ctsid_ros.recordings.bag import open_bag  # noqa: E402
from ctsid_ros.replay.replay import Replay  # noqa: E402

MIXED = ('Samples of several publishers are mixed in torque, of /command; stop all but one of '
         'them, or give them topics of their own.')


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


@pytest.mark.slow
def test_windows_of_two_publishers_are_never_good(live, tmp_path):
    path = tmp_path / 'flight.mcap'
    node = live.identifier(params(
        f"ingest.timeout: 60.0\nwindow.stride: 1.5\ningest.record: '{path}'"))
    robot = Robot(live, motion(11.5), node.name)
    idle, = live.publishers({'/command': JointState}, RELIABLE, node.name)
    robot.send(4.7)
    first, = node.wait_models(1)  # the second publisher is there, and silent
    assert 'publishers are on' not in node.next_health('ingest').message
    assert first.good
    for k in range(100):
        robot.send(4.7 + 0.02 * k)
        idle.publish(joint_message(EPOCH + round((4.69 + 0.02 * k) * 1e9), [0.0]))
    node.wait_models(2)
    robot.feed(node, length=7.0, stride=1.5)
    found = node.wait_models(5)
    for estimate in found:
        mixed = estimate.start_ns < EPOCH + 6.67 * S and estimate.end_ns > EPOCH + 4.72 * S
        assert estimate.good != mixed, estimate.verdict
        assert not mixed or estimate.verdict.reason == MIXED
    said = node.wait_health('ingest', lambda h: 'publishers are on /command' in h.message, 'two')
    assert said.level == Level.WARN
    assert node.program.end()[0] == 0
    with open_bag(path) as bag:
        replay = Replay(bag, read_config(tmp_path / 'params0.yaml'))
        replay.run()
    again = {result.estimate.end_ns: result.estimate.verdict.reason for result in replay.results}
    assert {e.end_ns: e.verdict.reason for e in found}.items() <= again.items()


def test_a_weak_model_is_saved_with_its_reason(live, tmp_path):
    node = live.identifier(params(f"validation.held_out: 0.0\nsave.folder: '{tmp_path}'"))
    Robot(live, motion(4.6), node.name).send(4.6)
    estimate, = node.wait_models(1)
    assert estimate.verdict.grade is Grade.WEAK
    live.wait(lambda: node.trigger('save')[0], 'a file')
    said = node.trigger('save')[1]
    assert f'but it is WEAK: {estimate.verdict.reason}' in said
    assert said.endswith('Save again after a window that is GOOD')


def test_topics_that_fell_silent_leave_nothing_that_is_well(live):
    node = live.identifier(params('ingest.timeout: 1.0'))
    Robot(live, motion(4.6), node.name).send(4.6)
    assert node.wait_models(1)[0].good
    said = node.wait_health('identification', lambda h: 'Every test' in h.message and
                            h.level == Level.STALE, 'silence')
    assert said.message.startswith('no messages come in, see ingest; of the last window: ')


@pytest.mark.slow
def test_where_no_window_comes_any_more_nothing_is_well(live):
    """Both channels are dead, and both topics alive: no window comes that could say so."""
    node = live.identifier(params('ingest.timeout: 1.0', length=2.0))
    robot = Robot(live, motion(40.0), node.name)
    robot.send(4.0)
    node.wait_models(1)

    def spoilt() -> None:
        t, name, _ = robot._rest.pop(0)
        robot.publish(name, EPOCH + round(t * 1e9), [float('nan')] * (2 if name == 'imu' else 1))
        time.sleep(0.002)

    said = node.wait_health('identification', lambda h: spoilt() or h.message.startswith(
        'no window has come for '), 'that no window comes')
    assert said.level == Level.STALE
    assert ' s, see ingest; of the last window: ' in said.message
    last = robot._rest[0][0]
    for end in np.arange(last + 3.0, last + 20.0, 1.0):
        robot.send(end, speed=3.0)
        said = node.health('identification')[-1]
        if said.level == Level.OK:
            break
    assert (said.level, said.values['verdict']) == (Level.OK, 'GOOD')


def test_a_cause_that_only_the_ingest_knows_is_told_beside_the_verdict(live):
    node = live.identifier(params('ingest.timeout: 60.0'))
    robot = Robot(live, motion(8.0), node.name)
    robot.send(4.6)
    node.wait_models(1)
    while robot._rest:
        t, name, values = robot._rest.pop(0)
        robot.publish(name, EPOCH + round(t * 1e9) - (S if name == 'command' else 0), values)
        live.wait(lambda: len(node.models) > t - 4.6 - 1.0, 'a window')  # noqa: B023
    said = node.wait_health('identification', lambda h: 'came too late' in h.message or
                            'not one of' in h.message, 'the cause')
    assert said.level in (Level.WARN, Level.ERROR)
    assert '; the ingest may know why: `torque`: ' in said.message
    assert 'raise `window.max_delay`' in said.message


@pytest.mark.slow
def test_header_stamps_that_become_zero_are_told_with_a_cure_that_helps(live):
    node = live.identifier(params('ingest.timeout: 60.0', length=2.0))
    robot = Robot(live, motion(2.6), node.name)
    robot.send(2.6)
    node.wait_models(1)

    def only_zeros(health) -> bool:
        robot.publish('command', 0, [1.0])
        return '`torque`: not one of' in health.message

    said = node.wait_health('ingest', only_zeros, 'nothing but zeros')
    assert ('has a stamp in its header, though the first ones had; correct the publisher, or set '
            '`torque.stamp` to log') in said.message


@pytest.mark.slow
def test_after_a_reset_no_window_is_full(live):
    node = live.identifier(params('ingest.timeout: 60.0'))
    Robot(live, motion(4.6), node.name).send(4.6)
    node.wait_models(1)
    assert node.trigger('reset')[0]
    assert node.next_health('identification').message == 'no window is full yet'


def test_a_parameter_file_for_another_node_is_said(live):
    node = live.identifier(params().replace('/**:', 'tuner:'))
    live.wait(lambda: 'not configured' in node.log, 'the refusal')
    assert 'there is no input' in node.log
    assert ('no parameter of a file is for this node: the file has to name it, as `/identifier:`, '
            'or all, as `/**:`; or start the node by the name in the file, with `-r '
            '__node:=NAME`') in node.log


@pytest.mark.parametrize('dead', ['/cmd', '/rate'])
def test_a_silence_within_the_last_window_is_told_until_it_has_left(dead):
    """A topic is lost for 3 s; of a command, perhaps sent when it changes, as a cause only."""
    config = replace(CONFIG, settings=CONFIG.settings.replace(
        window_length=4.0, window_max_delay=2.0))
    feed, look = Feed(config, TYPES, lambda _: 1), IngestDiagnosis(config, EPOCH)
    said, causes, levels = {}, {}, {}
    for second in range(20):
        now_ns = EPOCH + second * S
        feed.take([Taken(now_ns, topic, raw) for topic, raw in (
            ('/rate', rate(now_ns, 0.1)), ('/cmd', command([0, 1])))
            if topic != dead or not 5 <= second < 8], now_ns)
        found = look.look(feed, now_ns, 1.5, [], '')
        said[second], levels[second] = found.message, found.level
        causes[second] = '; '.join(look.causes)
    assert 'silent' not in causes[5]
    assert f'{dead} has been silent for 3.0 s' in causes[7]
    assert ('has been silent' in said[7]) == (dead == '/rate')
    assert levels[7] == (Level.WARN if dead == '/rate' else Level.OK)
    assert f'{dead} was silent for 3.0 s until 1 s ago' in causes[8]
    assert f'{dead} was silent for 3.0 s until 3 s ago' in causes[10]
    assert ('was silent' in said[8]) == (dead == '/rate')
    assert 'silent' in causes[13]                  # a verdict stands until the next window
    assert 'silent' not in causes[14]
    # The computer's clock is set back.
    look.look(feed, EPOCH + 30 * S, 1.5, [], '')
    feed.take([Taken(EPOCH + 27 * S, '/rate', rate(EPOCH, 0.1)),
               Taken(EPOCH + 27 * S, '/cmd', command([0, 1]))], EPOCH + 27 * S)
    look.look(feed, EPOCH + 27 * S, 1.5, [], '')
    assert 'silent' not in '; '.join(look.causes)


def test_how_full_the_next_window_is_is_told_while_none_comes():
    late = Progress(idle=12.94, overdue=9.9)
    assert no_window(late, 2.0, 0.34) == \
        'no window has come for 12.9 s, the next one is filled to 34 %'
    assert no_window(late, 2.0, 0.9995) == 'no window has come for 12.9 s'
    assert not no_window(late, 10.0, 0.34)
