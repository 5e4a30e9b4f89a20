# SPDX-License-Identifier: Apache-2.0
"""What runs while the node is active: it begins as a whole, or not at all."""

from dataclasses import replace
import threading
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')
from builtin_interfaces.msg import Time  # noqa: E402
from live import claim_domain, wait  # noqa: E402
import rclpy  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rosgraph_msgs.msg import Clock as ClockMessage  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from ctsid_core.settings import Settings  # noqa: E402
from ctsid_ros.config.channels import Channel, Config  # noqa: E402
from ctsid_ros.config.node_settings import NodeSettings  # noqa: E402
from ctsid_ros.decoding.message_types import message_class, of_message_class  # noqa: E402
from ctsid_ros.ingest.feed import Feed  # noqa: E402
from ctsid_ros.ingest.sim_clock import SimClock  # noqa: E402
from ctsid_ros.node.intake import Intake  # noqa: E402
from ctsid_ros.node.plan import Plan  # noqa: E402
from ctsid_ros.node.run import begin  # noqa: E402

S = 10**9


@pytest.fixture
def node(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    context, (domain, claim) = Context(), claim_domain()
    rclpy.init(context=context, domain_id=domain, args=[])
    made = Node('test', context=context)
    yield made
    made.destroy_node()
    rclpy.shutdown(context=context)
    claim.close()


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
    assert run.stop(180.0)
    assert not ours()


def test_what_cannot_begin_leaves_nothing_behind(node, tmp_path):
    good, path = plan(tmp_path / 'a.mcap'), tmp_path / 'a.mcap'
    with pytest.raises(Exception, match='_TYPE_SUPPORT'):
        begin(node, replace(good, classes={**good.classes, '/y': object}), lambda _: None)
    assert not ours()
    assert path.read_bytes().endswith(b'\x89MCAP0\r\n')  # it was finished


def test_messages_have_simulated_times_between_those_of_the_ticks_around_them(node):
    cls = message_class('geometry_msgs/msg/Vector3Stamped')
    clock, pushed = SimClock(), []
    recorder = SimpleNamespace(write=lambda topic, log_ns, *_: pushed.append(log_ns))
    made = plan('')
    feed = Feed(made.config, made.types, lambda _: 1, recorder, clock)
    intake = Intake(node, feed, made.classes, NodeSettings(), lambda _: None, clock)
    ticks = node.create_publisher(ClockMessage, '/clock', 10)
    messages = node.create_publisher(cls, '/u', 10)
    wait(lambda: ticks.get_subscription_count() and messages.get_subscription_count(), 'discovery')
    with intake.lock:  # as if the thread had been held up: all is there when it goes on
        for seconds in (10, 11, 12, 13):
            ticks.publish(ClockMessage(clock=Time(sec=seconds)))
            messages.publish(cls())
        ticks.publish(ClockMessage(clock=Time(sec=14)))
    wait(lambda: len(pushed) >= 4, 'all messages')
    assert intake.stop(180.0)
    for log_ns, (low, high) in zip(pushed, ((10, 11), (11, 12), (12, 13), (13, 14)), strict=True):
        assert low * S < log_ns < high * S


def test_a_publisher_is_told_of_once_it_has_a_name_or_stays_without(node, monkeypatch):
    made = plan('')
    intake = Intake(node, Feed(made.config, made.types, lambda _: 1), made.classes,
                    NodeSettings(), lambda _: None)
    ends = {'/u': [SimpleNamespace(node_namespace='_NODE_NAMESPACE_UNKNOWN_', topic_type='other',
                                   node_name='_NODE_NAME_UNKNOWN_', endpoint_gid=[1] * 16)]}
    monkeypatch.setattr(node, 'get_publishers_info_by_topic', lambda topic: ends.get(topic, []))
    assert list(intake.faults()) == []
    assert 'a publisher of /u that is no node sends other' in next(intake.faults())
    ends['/u'][0].endpoint_gid = [2] * 16
    assert list(intake.faults()) == []
    ends['/u'][0].node_namespace, ends['/u'][0].node_name = '/', 'camera'
    assert 'the publisher `/camera` of /u sends other' in next(intake.faults())
    assert intake.stop(180.0)


def test_two_publishers_of_one_topic_are_named(node):
    made = plan('')
    intake = Intake(node, Feed(made.config, made.types, lambda _: 1), made.classes,
                    NodeSettings(), lambda _: None)
    others = [Node(name, context=node.context) for name in ('left', 'right')]
    publishers = [other.create_publisher(made.classes['/u'], '/u', 10) for other in others]
    wait(lambda: all(publisher.get_subscription_count() for publisher in publishers), 'discovery')
    wait(lambda: sorted(end.node_name for end in node.get_publishers_info_by_topic('/u')) ==
         ['left', 'right'], 'both names')
    fault, = intake.faults()
    assert fault.startswith('2 publishers are on /u, whose samples are mixed into the same '
                            'channels: the publisher `/')
    assert '`/left`' in fault
    assert '`/right`' in fault
    by_name = made.config.with_fields({'u': 'effort[left]'})
    other = Intake(node, Feed(by_name, made.types | {'/u': of_message_class(JointState)},
                              lambda _: 1), made.classes, NodeSettings(), lambda _: None)
    assert list(other.faults()) == []
    assert other.stop(180.0)
    others[0].destroy_node()
    wait(lambda: len(node.get_publishers_info_by_topic('/u')) == 1, 'the end of one')
    assert list(intake.faults()) == []
    others[1].destroy_node()
    assert intake.stop(180.0)
