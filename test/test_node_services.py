# SPDX-License-Identifier: Apache-2.0
"""Services, simulated time and jumps of time of the running node."""

from pathlib import Path
import time

import pytest

pytest.importorskip('rclpy')
from builtin_interfaces.msg import Time  # noqa: E402
from live import RELIABLE, Live  # noqa: E402
from plants import match  # noqa: E402
from robot import EPOCH, SOFT, Robot, S, motion, params  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402

from ctsid_core.model.model_json import to_json  # noqa: E402
from ctsid_core.model.storage import load_estimate  # noqa: E402
from ctsid_ros.messages import Level  # noqa: E402


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def test_identify_save_and_reset(live, tmp_path):
    folder = tmp_path / 'a' / 'models'
    node = live.identifier(params(f"window.stride: 100.0\nsave.folder: '{folder}'"))
    robot = Robot(live, motion(10.5), node.name)
    robot.send(3.0)
    success, why = node.trigger('identify')
    assert not success
    assert 'there are no 4 s of data' in why
    assert node.trigger('save') == (False, 'there is no accepted model yet; see /diagnostics')
    robot.send(6.0)
    node.wait_models(1)
    robot.wait_taken(node)
    success, _ = node.trigger('identify')
    assert success
    regular, requested = node.wait_models(2)
    assert [data['requested'] for data in node.metadata()] == [False, True]
    assert [data['window'] for data in node.metadata()] == [1, 2]
    assert requested.end_ns == pytest.approx(EPOCH + 6 * S - 3 * S // 10, abs=S // 50)
    assert requested.end_ns - requested.start_ns == 4 * S

    success, said = node.trigger('save')
    assert success
    path = Path(said.removeprefix('GOOD: window 2 is written to '))
    assert path.parent == folder
    assert to_json(load_estimate(path)) == to_json(requested)

    assert node.trigger('reset')[0]
    assert not node.trigger('save')[0]
    assert not node.trigger('identify')[0]
    robot.send(10.5)
    after = node.wait_models(3)[2]
    assert after.start_ns > requested.end_ns
    said = node.wait_health('ingest', lambda h: h.values['/imu messages'] == '900',
                            'the messages after the reset')
    assert said.values['windows'] == '1'
    assert node.metadata()[2]['realisation'] > node.metadata()[1]['realisation']
    assert set(node.metadata()[2]['modes']).isdisjoint(node.metadata()[1]['modes'])


def simulate(robot, clock, seconds, speed=2.0):
    """Publish messages and /clock as a simulator does: in small steps, twice the real time."""
    start, step = time.monotonic(), 0.008
    for k in range(round(seconds / step)):
        now = k * step
        clock.publish(Clock(clock=Time(sec=10 + int(now), nanosec=int(now % 1 * 1e9))))
        robot.send(now, speed=1e6)
        time.sleep(max(0.0, start + (k + 1) * step / speed - time.monotonic()))


def test_simulated_time_stamps_what_has_no_header(live):
    node = live.identifier(params('ingest.timeout: 60.0', header=False, length=3.0,
                                  max_delay=0.3), '-p', 'use_sim_time:=true')
    clock, = live.publishers({'/clock': Clock}, RELIABLE, node.name)
    robot = Robot(live, motion(5.0), node.name, header=False, start_ns=10 * S)
    simulate(robot, clock, 3.8)
    estimates = node.wait_models(1)
    assert 10 * S <= estimates[0].start_ns < 10.5 * S
    said = robot.wait_taken(node)
    assert said.values['torque stamps from'] == 'log'
    for estimate in estimates:
        assert estimate.ok
        found = match(estimate.model.poles, SOFT.poles)
        assert abs(found - SOFT.poles).max() < 0.15 * abs(SOFT.poles[0])
    count = len(node.models)
    simulate(Robot(live, motion(5.0), node.name, header=False, start_ns=10 * S), clock, 3.8)
    live.wait(lambda: any(10 * S <= estimate.start_ns < 10.5 * S
                          for estimate in node.estimates()[count:]),
              'a window from the start of the new time')
    node.wait_health('ingest', lambda h: h.values['resets'] == '1', 'the jump')


@pytest.mark.slow
def test_a_bag_that_loops_begins_anew(live):
    node = live.identifier(params('ingest.timeout: 60.0'))
    for _ in range(3):
        Robot(live, motion(4.6), node.name).feed(node)
    said = node.wait_health('ingest', lambda h: h.values['resets'] == '2', 'resets')
    assert said.level == Level.WARN
    assert 'the time stamps jumped back ' in said.message    # of late; in all twice
    node.wait_models(3)
    starts = [estimate.start_ns // S - EPOCH // S for estimate in node.estimates()]
    assert starts.count(0) == 3
    assert all(estimate.ok for estimate in node.estimates())
    assert {d['realisation'] for d in node.metadata()} == {1}
