# SPDX-License-Identifier: Apache-2.0
"""
The lifecycle node: topics in, models out.

Three threads: the executor's for services, parameters and transitions; that of the intake, which
takes messages whatever the others do; and that of identification. Transitions: configure reads
the parameters and makes publishers and services, activate subscribes, and back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
import re
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from ctsid_core.errors import SettingsError, StorageError
from ctsid_core.signals import Record
from ctsid_core.storage import save_model
from ctsid_ros import messages, parameters
from ctsid_ros.bag_writer import BagWriter
from ctsid_ros.channels import Config
from ctsid_ros.diagnosis import (
    IDENTIFICATION,
    INGEST,
    IngestDiagnosis,
    diagnose_identification,
)
from ctsid_ros.feed import Feed
from ctsid_ros.health import Health, Level
from ctsid_ros.intake import Intake
from ctsid_ros.message_types import MessageType, message_class, of_message_class
from ctsid_ros.session import Identified, Session, Window
from ctsid_ros.sim_clock import SimClock

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = {'model': String, **dict.fromkeys(
    ('system_matrix', 'a', 'b', 'c', 'd', 'k', 'eigenvalues'), Float64MultiArray)}
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_STOP = 0.3  # time for the thread of the intake to end [s]


@dataclass(frozen=True)
class _Plan:
    """What was configured."""

    config: Config
    classes: Mapping[str, Any]
    types: Mapping[str, MessageType]


@dataclass(frozen=True)
class _Run:
    """What runs between activation and deactivation."""

    feed: Feed
    intake: Intake
    session: Session
    diagnosis: IngestDiagnosis
    recorder: BagWriter | None


class Identifier(LifecycleNode):  # type: ignore[misc]  # rclpy has no types
    """The node; `start` brings it to the state in which it identifies."""

    def __init__(self, **options: Any) -> None:
        super().__init__('identifier', **options)
        parameters.declare(self)
        parameters.watch(self, lambda: self._plan is not None, self._change)
        self._plan: _Plan | None = None
        self._now: _Run | None = None
        self._outputs: dict[str, Any] = {}
        self._offered: list[Any] = []
        self._told: set[str] = set()  # what is wrong now, and has been logged
        self._status = ''
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_timer(1.0, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._survive_transitions()

    def start(self) -> None:
        """Configure and activate, if `autostart` says so."""
        if (self.get_parameter('autostart').value
                and self.trigger_configure() == _SUCCESS):
            self.trigger_activate()

    def close(self, patience: float) -> bool:
        """End all threads; return whether the one of identification has ended in time [s]."""
        return self._halt(patience)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read and check the parameters; make publishers and services."""
        try:
            self._plan = self._read()
        except SettingsError as error:
            for fault in error.faults:
                self.get_logger().error(fault)
            self.get_logger().error(
                'not configured; correct the parameters, then configure again')
            return _FAILURE
        self._outputs = {name: self.create_lifecycle_publisher(kind, f'~/{name}', LATCHED)
                         for name, kind in TOPICS.items()}
        self._offered = [self.create_service(Trigger, f'~/{name}', answer) for name, answer in (
            ('identify', self._on_identify), ('reset', self._on_reset), ('save', self._on_save))]
        return _SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and begin."""
        assert self._plan is not None
        try:
            self._now = self._begin(self._plan)
        except StorageError as error:
            self.get_logger().error(f'not activated: {error}')
            return _FAILURE
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe and end the threads."""
        self._halt(_STOP)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the parameters; remove publishers and services."""
        self._halt(_STOP)
        for output in self._outputs.values():
            self.destroy_lifecycle_publisher(output)
        for service in self._offered:
            self.destroy_service(service)
        self._outputs, self._offered, self._plan = {}, [], None
        return _SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the threads."""
        self._halt(_STOP)
        return _SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to the unconfigured state."""
        return self.on_cleanup(state)

    def _survive_transitions(self) -> None:
        """Refuse transitions that are impossible now: rclpy raises, which would end it all."""
        service = self._service_change_state
        change = service.callback

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RuntimeError as error:  # RCLError: its class is private
                self.get_logger().error('this transition is not possible now: '
                                        + str(error).partition(', at ')[0])
                response.success = False
                return response

        service.callback = answer

    def _read(self) -> _Plan:
        config, faults = parameters.read(self), []
        classes: dict[str, Any] = {}
        for channel in config.channels:
            try:
                classes[channel.topic] = message_class(channel.type)
            except ImportError as error:
                faults.append(f'`{channel.name}.type` is {channel.type!r}: {error}')
        if faults:
            raise SettingsError(faults)
        types = {topic: of_message_class(cls) for topic, cls in classes.items()}
        Feed(config, types, lambda _: 1)  # for its check of the fields
        return _Plan(config, classes, types)

    def _begin(self, plan: _Plan) -> _Run:
        node, settings = plan.config.node, plan.config.settings
        recorder = BagWriter(node.ingest_record, plan.types) if node.ingest_record else None
        if recorder is not None:
            self.get_logger().info(f'recording the messages to {recorder.path}')
        simulated = self.get_parameter('use_sim_time').value
        clock = SimClock() if simulated else None
        feed = Feed(plan.config, plan.types, self._count_publishers, recorder, clock)
        session = Session(settings, self._publish, self.get_logger().error)

        def deliver(record: Record) -> None:
            end_ns = record.epoch_ns + round(record.end * 1e9)
            number = session.progress.windows + 1
            session.submit(Window(record, number, feed.arrival_ns(end_ns)))

        intake = Intake(self, feed, plan.classes, node, deliver, clock)
        return _Run(feed, intake, session, IngestDiagnosis(plan.config, time.time_ns()),
                    recorder)

    def _halt(self, patience: float) -> bool:
        """End what runs; return whether the thread of identification has ended in time [s]."""
        run, self._now = self._now, None
        if run is None:
            return True
        run.intake.stop(_STOP)
        ended = run.session.stop(patience)
        if run.recorder is not None:
            try:
                run.recorder.close()
            except StorageError as error:
                self.get_logger().error(str(error))
        return ended

    def _count_publishers(self, topic: str) -> int:
        return int(self.count_publishers(self.resolve_topic_name(topic)))

    def _change(self, config: Config) -> None:
        if self._plan is not None:
            self._plan = replace(self._plan, config=config)
        if self._now is not None:
            self._now.session.change(config.settings)

    def _publish(self, result: Identified) -> None:
        """Publish a result; called by the thread of identification."""
        tracked, run = result.tracked, self._now
        if run is None:
            return
        model, status = tracked.estimate.model, tracked.estimate.status
        found = {'model': messages.encode_model(tracked, self._metadata(run, result))}
        if model is not None:
            found |= {'system_matrix': messages.encode_system_matrix(model),
                      **messages.encode_matrices(model),
                      'eigenvalues': messages.encode_eigenvalues(tracked)}
        for name, message in found.items():
            self._outputs[name].publish(message)
        if status.name != self._status:
            self._status = status.name
            if model is not None:  # rclpy wants a line of its own for each severity
                self.get_logger().info(status.value)
            else:
                self.get_logger().warning(status.value)

    def _on_identify(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Identify the last window of data now, out of turn."""
        run = self._now
        if run is None:
            return _say(answer, False, 'the node is not active; activate it first')
        with run.intake.lock:
            record = run.feed.latest()
            arrival_ns = None if record is None else run.feed.arrival_ns(
                record.epoch_ns + round(record.end * 1e9))
        if record is None:
            length = run.feed.config.settings.window_length
            return _say(answer, False, f'there are no {length:g} s of data of all channels yet; '
                        'see /diagnostics')
        run.session.submit(Window(record, run.session.progress.windows + 1, arrival_ns, True))
        return _say(answer, True, 'the model of the last window is on its way to ~/model')

    def _on_reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Forget all data and models."""
        run = self._now
        if run is None:
            return _say(answer, False, 'the node is not active, so there is nothing to forget')
        with run.intake.lock:
            run.feed.reset()
        run.session.reset()
        return _say(answer, True, 'data and models are forgotten')

    def _on_save(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Write the last accepted model to a file."""
        run = self._now
        accepted = None if run is None else run.session.progress.accepted
        if run is None or accepted is None:
            return _say(answer, False, 'there is no accepted model yet; see /diagnostics')
        estimate = accepted.tracked.estimate
        moment = datetime.fromtimestamp(estimate.end_ns // 10**9, UTC).strftime('%Y%m%dT%H%M%SZ')
        folder = Path(self.get_parameter('save.folder').value).expanduser()
        path = folder / f'{self.get_name()}-{moment}-{accepted.window.number}.json'
        try:
            folder.mkdir(parents=True, exist_ok=True)
            save_model(path, estimate, self._metadata(run, accepted), force=True)
        except (StorageError, OSError) as error:
            return _say(answer, False, f'not written: {error}')
        return _say(answer, True, f'written to {path.absolute()}')

    def _metadata(self, run: _Run, result: Identified) -> dict[str, object]:
        return messages.provenance(
            run.feed.config, self.get_fully_qualified_name(), result.window.number,
            requested=result.window.requested, computing_seconds=result.computing)

    def _diagnose(self) -> None:
        run, name = self._now, self.get_fully_qualified_name()
        if run is None:
            words = ('configured, but not active' if self._plan else 'not configured; correct the '
                     'parameters and configure it, see the log')
            level = Level.STALE if self._plan else Level.ERROR
            found = [Health(part, level, words) for part in (INGEST, IDENTIFICATION)]
        else:
            faults = list(run.intake.faults())
            timeout = self.get_parameter('ingest.timeout').value
            with run.intake.lock:
                ingest = run.diagnosis.look(run.feed, time.time_ns(), timeout, faults,
                                            run.intake.failure)
            found = [ingest, diagnose_identification(run.session.progress)]
            self._log_news(run.diagnosis.troubles)
        self._diagnostics.publish(messages.encode_diagnostics(
            self.get_clock().now().nanoseconds,
            [replace(health, name=f'{name}: {health.name}') for health in found]))

    def _log_news(self, troubles: Sequence[str]) -> None:
        """Log what has become wrong since the last look, once, whatever its numbers."""
        sentences = {re.sub(r'\d+(\.\d+)?', '#', trouble): trouble for trouble in troubles}
        for key in sentences.keys() - self._told:
            self.get_logger().warning(sentences[key])
        self._told = set(sentences)


def _say(answer: Trigger.Response, success: bool, message: str) -> Trigger.Response:
    answer.success, answer.message = success, message
    return answer
