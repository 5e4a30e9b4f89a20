# SPDX-License-Identifier: Apache-2.0
"""
The lifecycle node: topics in, models out.

Three threads: the executor's for services, parameters and transitions; that of the intake, which
takes messages whatever the others do; and that of identification. Transitions: configure reads
the parameters and makes publishers and services, activate subscribes, and back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
import re
from threading import Lock
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from ctsid_core.errors import SettingsError, StorageError
from ctsid_ros.config.channels import Config
from ctsid_ros.decoding.message_types import message_class
from ctsid_ros.messages.health import Health, Level, encode_diagnostics
from ctsid_ros.messages.interface import DIAGNOSTICS, SERVICES
from ctsid_ros.messages.publication import TOPICS, messages_of
from ctsid_ros.node import parameters
from ctsid_ros.node.diagnosis import IDENTIFICATION, INGEST
from ctsid_ros.node.plan import Plan, read_plan
from ctsid_ros.node.run import Answer, Run, begin
from ctsid_ros.node.session import Identified

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_STOP = 0.3  # time for the thread of identification to end [s]
_NUMBER = re.compile(r'(?<!\w)\d+(\.\d+)?(?!\w)')  # not that in a name, as in /imu2


class Identifier(LifecycleNode):  # type: ignore[misc]  # rclpy has no types
    """The node; `start` brings it to the state in which it identifies."""

    def __init__(self, **options: Any) -> None:
        super().__init__('identifier', **options)
        parameters.declare(self)
        parameters.watch(self, lambda: self._plan is not None, self._change)
        self._plan: Plan | None = None
        self._now: Run | None = None
        self._turn = Lock()  # of identification: there is never a second one beside the first
        self._outputs: dict[str, Any] = {}
        self._offered: list[Any] = []
        self._told: set[str] = set()  # what is wrong now, and has been logged
        self._refused = False  # whether parameters were, when it was to be configured last
        self._last_verdict = ''
        self._diagnostics = self.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        self.create_timer(1.0, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._survive_transitions()

    def start(self) -> None:
        """Configure and activate, if `autostart` says so."""
        if (self.get_parameter('autostart').value is not False
                and self.trigger_configure() == _SUCCESS):
            self.trigger_activate()

    def close(self, patience: float) -> bool:
        """End all threads; return whether the one of identification has ended in time [s]."""
        return self._halt(patience)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read and check the parameters; make publishers and services."""
        self._refused = True
        try:
            self._plan = read_plan(self)
        except SettingsError as error:
            for fault in error.faults:
                self.get_logger().error(fault)
            self.get_logger().error(
                'not configured; correct the parameters, then configure again')
            return _FAILURE
        except Exception as error:  # rclpy would go to the error state without a word
            self.get_logger().error(f'not configured, by a fault of ctsid: {_trace(error)}')
            return _FAILURE
        self._outputs = {name: self.create_lifecycle_publisher(
                             message_class(kind), f'~/{name}', LATCHED)
                         for name, kind in TOPICS.items()}
        acts = {'identify': Run.identify, 'reset': Run.reset,
                'save': lambda run: run.save(self._folder())}
        self._offered = [self._offer(name, acts[name]) for name in SERVICES]
        self._refused = False
        return _SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and begin."""
        assert self._plan is not None
        try:
            self._now = begin(self, self._plan, self._publish, self._turn)
        except StorageError as error:
            self.get_logger().error(f'not activated: {error}')
            return _FAILURE
        except Exception as error:
            self.get_logger().error(f'not activated, by a fault of ctsid: {_trace(error)}')
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

    def _halt(self, patience: float) -> bool:
        """End what runs; return whether the thread of identification has ended in time [s]."""
        run, self._now = self._now, None
        try:
            return run is None or run.stop(patience)
        except StorageError as error:
            self.get_logger().error(str(error))
            return False

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
        verdict = tracked.estimate.verdict
        for name, message in messages_of(tracked, run.metadata(result)).items():
            self._outputs[name].publish(message)
        news = f'{verdict.grade.name} {tracked.estimate.status.name}'
        if news != self._last_verdict:
            self._last_verdict = news
            if tracked.estimate.good:  # rclpy wants a line of its own for each severity
                self.get_logger().info(f'{verdict.grade.name}: {verdict.reason}')
            else:
                self.get_logger().warning(f'{verdict.grade.name}: {verdict.reason}')

    def _offer(self, name: str, act: Callable[[Run], Answer]) -> Any:
        """Make a service that does something with what runs."""
        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = (
                    (False, 'the node is not active; activate it first') if self._now is None
                    else act(self._now))
            except Exception as error:  # a service must not end the node
                self.get_logger().error(f'a fault of ctsid in ~/{name}: {_trace(error)}')
                response.success, response.message = False, f'a fault of ctsid: {error}'
            return response

        return self.create_service(Trigger, f'~/{name}', answer)

    def _folder(self) -> Path:
        return Path(self.get_parameter('save.folder').value).expanduser()

    def _diagnose(self) -> None:
        try:
            self._tell()
        except Exception as error:  # what tells of faults must not end the node by its own
            if self.context.ok():
                self.get_logger().error(f'no diagnostics, by a fault of ctsid: {_trace(error)}',
                                        throttle_duration_sec=60.0)

    def _tell(self) -> None:
        """Publish the diagnostics, log what is new in them."""
        run, name = self._now, self.get_fully_qualified_name()
        if run is None:
            words = 'configured, but not active' if self._plan else 'not configured; ' + (
                'correct the parameters and configure it, see the log' if self._refused else
                'it waits for that (`ros2 lifecycle set`, or a lifecycle manager)')
            level = Level.ERROR if self._refused else Level.STALE
            found = [Health(part, level, words) for part in (INGEST, IDENTIFICATION)]
        else:
            found = run.health(self.get_parameter('ingest.timeout').value)
            self._log_news(run.diagnosis.troubles)
        self._diagnostics.publish(encode_diagnostics(
            self.get_clock().now().nanoseconds,
            [replace(health, name=f'{name}: {health.name}') for health in found]))

    def _log_news(self, troubles: Sequence[str]) -> None:
        """Log what has become wrong since the last look, once, whatever its numbers."""
        sentences = {_NUMBER.sub('#', trouble): trouble for trouble in troubles}
        for key in sentences.keys() - self._told:
            self.get_logger().warning(sentences[key])
        self._told = set(sentences)


def _trace(error: Exception) -> str:
    return ''.join(traceback.format_exception(error))
