# SPDX-License-Identifier: Apache-2.0
"""The same messages live and replayed: the same models to the last bit."""

import importlib

import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import RELIABLE, Live  # noqa: E402
from marks import slow  # noqa: E402
from robot import EPOCH, Robot, S, joint_message, motion, params  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from ctsid_core.model.model_json import to_json  # noqa: E402
from ctsid_ros.config.parameter_file import read_config  # noqa: E402
from ctsid_ros.decoding.message_types import definition, of_message_class  # noqa: E402
from ctsid_ros.messages import Level, decode_metadata, encode_model  # noqa: E402
from ctsid_ros.recordings.bag import open_bag  # noqa: E402
from ctsid_ros.replay.replay import Replay  # noqa: E402


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def texts(estimates) -> dict[int, str]:
    """JSON by the end of the window: all bits of an estimate."""
    return {estimate.end_ns: to_json(estimate) for estimate in estimates}


@pytest.mark.parametrize(('order', 'header'), [
    ('order: 0\nmax_order: 4\nwindow.stride: 0.5', True),
    *slow(('feedthrough: false', False), ('feedthrough: false', True))])
def test_a_recording_of_the_node_gives_its_models_again(live, tmp_path, header, order):
    path = tmp_path / 'flight.mcap'
    node = live.identifier(params(f"{order}\ningest.record: '{path}'".strip(), header=header,
                                  length=3.0))
    robot = Robot(live, motion(4.6), node.name, header=header,
                  start_ns=EPOCH if header else None)
    if header:
        robot.feed(node, length=3.0, stride=0.5 if 'stride' in order else 1.0)
    else:
        robot.send(speed=1.0)  # the times of arrival are the stamps
    node.wait_models(3 if 'stride' in order else 1)
    assert node.next_health('identification').values['skipped windows'] == '0'
    assert node.program.end()[0] == 0
    published = texts(node.estimates())
    with open_bag(path) as bag:
        assert not bag.notes
        replay = Replay(bag, read_config(tmp_path / 'params0.yaml'))
        replay.run()
    again = texts(result.estimate for result in replay.results)
    assert len(published) >= 1
    # Without headers the times of arrival are the stamps: models are as good as those.
    assert not header or any(estimate.ok for estimate in node.estimates())
    assert {end: again.get(end) for end in published} == published
    tracked = {result.estimate.end_ns: result.tracked for result in replay.results}
    for estimate, data in zip(node.estimates(), node.metadata(), strict=True):
        expected = decode_metadata(encode_model(tracked[estimate.end_ns]))
        for key, value in expected.items():
            np.testing.assert_array_equal(data[key], value, err_msg=key)
    assert 0 <= min(published) - 3 * S - robot.start_ns < (S // 5 if header else 180 * S)


class Arm(Robot):
    """Publish the outputs as the speeds of two joints that change their order, and a gripper."""

    def __init__(self, live, made, reader):
        super().__init__(live, made)
        self.arm, self.gripper = (live.publishers({'/joints': JointState}, RELIABLE, reader)[0]
                                  for _ in range(2))

    def publish(self, name, stamp_ns, values):
        if name == 'command':
            super().publish(name, stamp_ns, values)
            return
        k = self.sent[name] = self.sent[name] + 1
        pair = list(zip('pq', values, strict=True))[::1 if k % 3 else -1]
        for publisher, joints in ((self.arm, pair), (self.gripper, [('finger', 0.0)])):
            if publisher is self.arm or k % 20 == 0:
                message = joint_message(stamp_ns, [])
                message.name = [name for name, _ in joints]
                message.velocity = [float(value) for _, value in joints]
                publisher.publish(message)


@pytest.mark.slow
def test_joints_by_name_are_those_of_their_publisher_live_and_again(live, tmp_path):
    path = tmp_path / 'arm.mcap'
    text = params(f"order: 2\ningest.record: '{path}'", imu='/joints', length=3.0)
    for name, axis in (('p', 'x'), ('q', 'y')):
        text = text.replace(f'Imu, field: angular_velocity.{axis}',
                            f"JointState, field: 'velocity[{name}]'")
    node = live.identifier(text)
    robot = Arm(live, motion(4.6), node.name)
    robot.feed(node, length=3.0)
    node.wait_models(1)
    assert node.next_health('ingest').level == Level.OK
    assert node.program.end()[0] == 0
    with open_bag(path) as bag:
        replay = Replay(bag, read_config(tmp_path / 'params0.yaml'))
        replay.run()
        assert not bag.notes
    again = texts(result.estimate for result in replay.results)
    published = texts(node.estimates())
    assert {end: again.get(end) for end in published} == published
    model = node.estimates()[0].model
    np.testing.assert_allclose(np.sort_complex(model.poles), [-1 - 4j, -1 + 4j], atol=0.2)


@pytest.mark.parametrize('name', [
    'sensor_msgs/Imu', 'sensor_msgs/JointState', 'nav_msgs/Odometry',
    'std_msgs/Float64MultiArray', 'geometry_msgs/WrenchStamped'])
def test_recorded_definitions_are_those_of_ros(name):
    package, kind = name.split('/')
    cls = getattr(importlib.import_module(f'{package}.msg'), kind)
    full = f'{package}/msg/{kind}'
    recorded = get_types_from_msg(definition(of_message_class(cls)), full)
    store = get_typestore(Stores.ROS2_JAZZY)
    assert full in recorded
    for part, (_, fields) in recorded.items():
        assert fields == store.fielddefs[part][1], part
    mine = get_typestore(Stores.EMPTY)
    mine.register(recorded)
    assert mine.hash_rihs01(full) == store.hash_rihs01(full)
