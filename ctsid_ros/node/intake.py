# SPDX-License-Identifier: Apache-2.0
"""
The subscriptions of the node, drained by a thread of their own.

An executor spends 100 to 200 microseconds on each message; taking all that have come every few
milliseconds costs a tenth of it. The subscriptions therefore belong to a second node that is in
no executor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from threading import Event, Lock, Thread
import time
from typing import Any

import rclpy.node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosgraph_msgs.msg import Clock

from ctsid_core.signals.record import Record
from ctsid_ros.config.node_settings import NodeSettings
from ctsid_ros.decoding.message_types import type_name
from ctsid_ros.ingest.feed import Feed, Taken
from ctsid_ros.ingest.sim_clock import SimClock

_AHEAD_NS = 500_000  # a message may be handed out so much later than it arrived
_NO_NAME = '_NODE_NAME_UNKNOWN_'  # of rmw, for what is no node or has only just been discovered
_TOO_MANY = 20_000  # messages of a topic taken at once: then it is the turn of the others
RELIABILITY = {'best_effort': ReliabilityPolicy.BEST_EFFORT,
               'reliable': ReliabilityPolicy.RELIABLE}


class Intake:
    """
    Subscribe to the topics of a feed and push their messages into it.

    Parameters
    ----------
    node : rclpy.node.Node
        In whose name it subscribes; its remappings count.
    feed : Feed
    classes : mapping of str to class
        Message class of each topic.
    settings : NodeSettings
    deliver : callable
        Given each window that is due, in the thread of the intake, which holds the lock.
    clock : SimClock, optional
        The simulated clock of the feed; /clock is subscribed to for it.

    Attributes
    ----------
    lock : Lock
        To be held by whoever asks the feed something.
    failure : str
        What has gone wrong in the thread last, if anything has: a fault of ctsid itself.
    """

    def __init__(self, node: rclpy.node.Node, feed: Feed, classes: Mapping[str, Any],
                 settings: NodeSettings, deliver: Callable[[Record], None],
                 clock: SimClock | None = None) -> None:
        self._node, self._feed, self._deliver, self._clock = node, feed, deliver, clock
        self.lock = Lock()
        self.failure = ''
        # `-r __node:=name` would rename it as well: hence no global arguments.
        self._own = rclpy.node.Node(
            f'{node.get_name()}_intake', namespace=node.get_namespace(), context=node.context,
            use_global_arguments=False, start_parameter_services=False, enable_rosout=False)
        self._qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=settings.ingest_depth,
            reliability=RELIABILITY[settings.ingest_reliability],
            durability=DurabilityPolicy.VOLATILE)
        self._classes = dict(classes)
        self._mixing = {channel.topic for channel in feed.config.channels
                        if not channel.path.elements}  # these take what anybody publishes
        self._names = {topic: node.resolve_topic_name(topic) for topic in classes}
        self._subscriptions = {
            topic: self._own.create_subscription(cls, self._names[topic], _not_called, self._qos,
                                                 raw=True) for topic, cls in classes.items()}
        self._ticks = None if clock is None else self._own.create_subscription(
            Clock, '/clock', _not_called, QoSProfile(
                depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT))
        self._nameless: frozenset[bytes] = frozenset()  # publishers without a name of a node
        self._period = 1.0 / settings.ingest_rate
        self._stopping = Event()
        self._thread = Thread(target=self._run, name='intake', daemon=True)
        self._thread.start()

    def stop(self, timeout: float) -> bool:
        """End the thread [s] and the subscriptions; return whether it has ended."""
        self._stopping.set()
        self._thread.join(timeout)
        if self._thread.is_alive():
            return False
        self._own.destroy_node()
        return True

    def faults(self) -> Iterator[str]:
        """Yield a sentence on each publisher that cannot be heard, or is one too many."""
        for topic, name in self._names.items():
            heard = []
            for end in self._node.get_publishers_info_by_topic(name):
                if (who := self._who(end, name)) is None:
                    continue
                if fault := self._fault(end, topic):
                    yield f'{who} {fault}'
                else:
                    heard.append(who.removesuffix(f' of {name}'))
            if len(heard) > 1 and topic in self._mixing and self._feed.mixes(topic):
                yield (f'{len(heard)} publishers are on {name}, whose samples are mixed into the '
                       f'same channels: {", ".join(heard)}; stop all but one, or give them topics '
                       'of their own')

    def _fault(self, end: TopicEndpointInfo, topic: str) -> str:
        """Return why a publisher cannot be heard; '' if it can."""
        wanted = type_name(self._classes[topic])
        if end.topic_type != wanted:
            return f'sends {end.topic_type}, but `type` says {wanted}; correct it'
        verdict, _ = qos_check_compatible(end.qos_profile, self._qos)
        if verdict == QoSCompatibility.ERROR:
            return ('is best effort, but `ingest.reliability` asks for reliable, so its messages '
                    'do not come; set it to best_effort')
        return ''

    def _who(self, end: TopicEndpointInfo, topic: str) -> str | None:
        """Name a publisher; None if it is new and has no name, which may follow in a moment."""
        if end.node_name != _NO_NAME:
            return f'the publisher `{end.node_namespace.rstrip("/")}/{end.node_name}` of {topic}'
        known, end_id = self._nameless, bytes(end.endpoint_gid)
        self._nameless = known | {end_id}
        return f'a publisher of {topic} that is no node' if end_id in known else None

    def _run(self) -> None:
        while not self._stopping.wait(self._period):
            try:
                self._turn()
            except Exception as error:  # of any kind: the node goes on and reports it
                if not self._node.context.ok():
                    return
                self.failure = f'{type(error).__name__}: {error}'

    def _turn(self) -> None:
        until_ns = time.time_ns() - _AHEAD_NS
        batch = list(self._drain())
        self._tick()  # after the messages, whose times lie between those of the ticks around them
        now_ns = time.time_ns()
        with self.lock:
            for record in self._feed.take(batch, until_ns, now_ns):
                self._deliver(record)

    def _tick(self) -> None:
        if self._ticks is None or self._clock is None:
            return
        while taken := self._ticks.handle.take_message(Clock, False):
            message, info = taken
            now = message.clock
            self._clock.tick(_arrival_ns(info), now.sec * 10**9 + now.nanosec)

    def _drain(self) -> Iterator[Taken]:
        for topic, subscription in self._subscriptions.items():
            take, kind = subscription.handle.take_message, self._classes[topic]
            for _ in range(_TOO_MANY):
                taken = take(kind, True)
                if taken is None:
                    break
                yield _taken(topic, *taken)


def _taken(topic: str, raw: bytes, info: Mapping[str, Any]) -> Taken:
    return Taken(_arrival_ns(info), topic, raw, info['source_timestamp'] or 0,
                 info['publication_sequence_number'])


def _arrival_ns(info: Mapping[str, Any]) -> int:
    """Return when a message arrived, or the time now where the middleware does not say."""
    return info['received_timestamp'] or time.time_ns()


def _not_called(_: object) -> None:
    """Stand where rclpy wants a callback: the subscription is in no executor."""
