# SPDX-License-Identifier: Apache-2.0
"""Transitions and parameters of the running node."""

import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import Live  # noqa: E402
from robot import EPOCH, Robot, S, motion, params  # noqa: E402

from ctsid_ros.messages import Level  # noqa: E402


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def test_the_node_is_led_through_its_states(live):
    node = live.identifier(params('autostart: false\ningest.timeout: 60.0'))
    assert node.state() == 'unconfigured'
    said = node.wait_health('ingest', lambda h: 'not configured' in h.message, 'that it waits')
    assert said.level == Level.STALE
    assert 'correct' not in said.message
    assert not node.change_state('activate')
    assert 'not possible now' in node.log
    assert node.change_state('configure')
    assert node.state() == 'inactive'
    said = node.wait_health('ingest', lambda h: 'not active' in h.message, 'that it waits')
    assert said.level == Level.STALE
    assert node.trigger('identify') == (False, 'the node is not active; activate it first')
    assert not node.trigger('reset')[0]
    assert not node.trigger('save')[0]
    assert node.change_state('activate')
    said = node.wait_health('ingest', lambda h: 'no message has come' in h.message, 'the same')
    assert said.level == Level.STALE
    Robot(live, motion(4.5), node.name).feed(node)
    assert node.change_state('deactivate')
    count = len(node.wait_models(1))
    idle = Robot(live, motion(6.5))
    idle.send(speed=20.0)
    node.next_health('ingest')
    assert len(node.models) == count
    assert node.change_state('activate')
    Robot(live, motion(4.5), node.name, start_ns=EPOCH + 1000 * S).feed(node)
    assert min(e.start_ns for e in node.estimates()[count:]) // S == EPOCH // S + 1000
    assert node.change_state('deactivate')
    assert node.change_state('cleanup')
    live.wait(lambda: not live.node.count_publishers('/identifier/model'), 'the end of topics')
    assert node.set(window__length=3.0) == ''
    assert node.change_state('configure')
    assert node.change_state('activate')
    before = len(node.models)
    Robot(live, motion(3.5), node.name, start_ns=EPOCH + 2000 * S).feed(node, length=3.0)
    live.wait(lambda: len(node.models) > before, 'models of the new length')
    last = node.estimates()[-1]
    assert last.end_ns - last.start_ns == 3 * S
    assert node.program.end()[0] == 0


def test_all_faults_of_configuration_and_activation_are_told_and_can_be_corrected(live):
    text = params('order: 99\nmax_order: 4\nvalidation.held_out: 0.9\ntrim: 3')
    node = live.identifier(text.replace('effort[0]', 'effort['))
    live.wait(lambda: 'not configured; correct the parameters' in node.log, 'the refusal')
    for name in ('`order`', '`validation.held_out`', '`trim`', '`torque.field`'):
        assert node.log.count(name) == 1, name
    assert node.state() == 'unconfigured'
    assert not node.change_state('configure')
    assert node.program.alive
    assert node.set(order=77)
    assert node.set(order=2, validation__held_out=0.0, trim=True,
                    torque__field='effort[0]') == ''
    assert node.set(ingest__record='/proc/no/flight.mcap') == ''
    assert node.change_state('configure')
    assert not node.change_state('activate')
    live.wait(lambda: 'not activated: /proc/no/flight.mcap cannot be written' in node.log,
              'the refusal')
    assert node.state() == 'inactive'
    assert 'is fixed' in node.set(ingest__record='')
    assert node.change_state('cleanup')
    assert node.set(ingest__record='') == ''
    assert node.change_state('configure')
    assert node.change_state('activate')
    assert node.state() == 'active'
    Robot(live, motion(4.5), node.name).feed(node)
    estimate, = node.wait_models(1)
    assert estimate.ok
    assert estimate.settings.held_out == 0.0


@pytest.mark.slow
def test_parameters_while_it_runs(live):
    node = live.identifier(params('ingest.timeout: 60.0'))
    robot = Robot(live, motion(6.5), node.name)
    robot.send(4.5)
    node.wait_models(1)
    refused = node.set(window__length=5.0, order=3)
    assert '`window.length` is fixed while the node is configured' in refused
    assert 'ros2 lifecycle set /identifier cleanup' in refused
    assert 'is fixed' in node.set(torque__topic='/other')
    assert 'Max: 50' in node.set(order=51)
    assert node.set(order=3, validation__held_out=0) == ''
    robot.send(5.5)
    node.wait_models(2)
    assert node.set(order=2, validation__held_out=0.3) == ''
    robot.send(6.5)
    first, second, third = node.wait_models(3)
    assert [e.settings.order for e in (first, second, third)] == [2, 3, 2]
    assert np.isfinite(first.held_out_fit).all()
    assert not np.isfinite(second.held_out_fit).any()
    numbers = [data['realisation'] for data in node.metadata()]
    assert numbers[0] == 1
