# SPDX-License-Identifier: Apache-2.0
"""What runs while the node is active: it begins as a whole, or not at all."""

from dataclasses import replace
import random
import threading

import pytest

pytest.importorskip('rclpy')
import rclpy  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402

from ctsid_core.settings import Settings  # noqa: E402
from ctsid_ros.config.channels import Channel, Config  # noqa: E402
from ctsid_ros.config.node_settings import NodeSettings  # noqa: E402
from ctsid_ros.decoding.message_types import message_class, of_message_class  # noqa: E402
from ctsid_ros.node.plan import Plan  # noqa: E402
from ctsid_ros.node.run import begin  # noqa: E402


@pytest.fixture
def node(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    context = Context()
    rclpy.init(context=context, domain_id=random.randint(1, 100), args=[])
    made = Node('test', context=context)
    yield made
    made.destroy_node()
    rclpy.shutdown(context=context)


def plan(path) -> Plan:
    cls = message_class('geometry_msgs/msg/Vector3Stamped')
    config = Config((Channel('u', 'input', '/u', '', 'vector.x'),
                     Channel('y', 'output', '/y', '', 'vector.x')),
                    Settings(), NodeSettings(ingest_record=str(path)))
    return Plan(config, {'/u': cls, '/y': cls}, dict.fromkeys(('/u', '/y'), of_message_class(cls)))


def ours() -> set[str]:
    return {thread.name for thread in threading.enumerate()} & {'intake', 'identification'}


def test_it_begins_and_stops(node, tmp_path):
    run = begin(node, plan(tmp_path / 'a.mcap'), lambda _: None)
    assert ours() == {'intake', 'identification'}
    assert not run.identify()[0]
    assert run.reset()[0]
    assert run.stop(1.0)
    assert not ours()


def test_what_cannot_begin_leaves_nothing_behind(node, tmp_path):
    good, path = plan(tmp_path / 'a.mcap'), tmp_path / 'a.mcap'
    with pytest.raises(Exception, match='_TYPE_SUPPORT'):
        begin(node, replace(good, classes={**good.classes, '/y': object}), lambda _: None)
    assert not ours()
    assert path.read_bytes().endswith(b'\x89MCAP0\r\n')  # it was finished
