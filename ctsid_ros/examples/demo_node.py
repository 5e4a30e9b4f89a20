# SPDX-License-Identifier: Apache-2.0
"""What watches the live demonstration, and prints what it sees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
import re
import time

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from ctsid_core.model.estimate import Estimate
from ctsid_ros.examples.demo_processes import Processes
from ctsid_ros.examples.demo_table import AGAIN, Truth, Window, judge, line, summary
from ctsid_ros.messages import decode_metadata, decode_model

IDENTIFIER, ROBOT, TUNER = ('ctsid_ros.node', 'ctsid_ros.examples.simulated_robot',
                            'ctsid_ros.examples.gain_tuner')
# How long processes may take to start, to find each other, or to identify a window [s]: a busy
# computer is waited for.
_PATIENCE = 60.0
_BEFORE = 3  # windows before the payload comes, however long the computer takes for them


@dataclass(frozen=True)
class Plan:
    """Parameter file of the identifier, duration [s] and payload [kg] of the flight, its seed."""

    params: str
    duration: float
    payload: float
    seed: int


class Observer(Node):  # type: ignore[misc]  # rclpy has no types
    """Collect models, verdicts and truths; print a line for each window."""

    def __init__(self) -> None:
        super().__init__('live_demo')
        every = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.truths: list[Truth] = []
        self.windows: list[Window] = []
        self._waiting: dict[int, Estimate] = {}  # for their verdicts, by number of the window
        self._robot = AsyncParameterClient(self, 'simulated_robot')
        self.create_subscription(String, 'identifier/model', self._on_model, every)
        self.create_subscription(String, 'gain_tuner/verdict', self._on_verdict, every)
        self.create_subscription(String, 'simulated_robot/truth', self._on_truth, every)

    def ready(self) -> bool:
        """Return whether identifier and tuner wait for the robot."""
        return bool(self.count_subscribers('imu') and self.count_subscribers('command/torque')
                    and self.count_subscribers('identifier/model') > 1)

    def attach(self, payload: float) -> None:
        """Let the robot carry a payload [kg] from now on."""
        self._robot.set_parameters([Parameter('payload', value=payload)])

    def seen(self, phase: str) -> int:
        """Return how many windows of a phase are judged."""
        return sum(window.phase == phase for window in self.windows)

    def finish(self, number: float = math.inf, verdict: str = '') -> None:
        """Judge the windows up to a number, to which the verdict belongs; without it, all."""
        for window in sorted(n for n in self._waiting if n <= number):
            self.windows.append(judge(self._waiting.pop(window), self.truths,
                                      verdict if window == number else ''))
            print(line(self.windows[-1], self.truths[0].since_ns))

    def _on_model(self, message: String) -> None:
        self._waiting[decode_metadata(message)['window']] = decode_model(message)

    def _on_verdict(self, message: String) -> None:
        if found := re.fullmatch(r'Window (\d+): (.*)', message.data, re.DOTALL):
            self.finish(int(found[1]), found[2])

    def _on_truth(self, message: String) -> None:
        truth = decode_model(message)
        assert truth.model is not None
        self.truths.append(Truth(truth.start_ns, truth.model))
        after = (truth.start_ns - self.truths[0].since_ns) * 1e-9
        print(f'{after:5.1f} s  the true poles are now '
              f'{", ".join(f"{pole:.3g}" for pole in truth.model.poles)} rad/s')


def fly(processes: Processes, plan: Plan) -> bool:
    """
    Start all, watch the flight, and print it; return whether all was as promised.

    Raises
    ------
    RuntimeError
        If a process ends too early.
    TimeoutError
        If they do not find each other.
    KeyboardInterrupt
        If a signal has come.
    """
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    observer = Observer()
    try:
        _watch(observer, processes, plan)
    finally:
        unclean = processes.stop()
        observer.destroy_node()
        rclpy.try_shutdown()
    if unclean:
        raise RuntimeError('; '.join(unclean))
    lines, good = summary(observer.windows)
    print('', *lines, sep='\n')
    return good


def _watch(observer: Observer, processes: Processes, plan: Plan) -> None:
    print('starting identifier, gain tuner and robot ...')
    processes.start(IDENTIFIER, '--params-file', plan.params)
    processes.start(TUNER)
    _spin(observer, processes, observer.ready, 'identifier and tuner do not start')
    processes.start(ROBOT, '-p', f'seed:={plan.seed}')
    _spin(observer, processes, lambda: bool(observer.truths), 'the robot does not fly')
    print(f'a payload of {plan.payload:g} kg is attached after {plan.duration / 2:g} s. Each '
          'line: end of the window; then true pole: identified pole ± reported\n'
          'standard deviation (distance in standard deviations) [rad/s]')
    began = time.monotonic()
    _spin(observer, processes, lambda: time.monotonic() - began > plan.duration / 2
          and observer.seen('before') >= _BEFORE, 'no models before the payload')
    observer.attach(plan.payload)
    _spin(observer, processes, lambda: len(observer.truths) > 1, 'the payload is not attached')
    _spin(observer, processes, lambda: time.monotonic() - began > plan.duration
          and observer.seen('after') >= AGAIN, 'no models after the payload')
    observer.finish()


def _spin(observer: Observer, processes: Processes, until: Callable[[], bool],
          otherwise: str) -> None:
    """
    Spin until something is true.

    Raises
    ------
    TimeoutError
        If nothing new has been judged for too long; it begins with `otherwise`.
    """
    seen, since = len(observer.windows), time.monotonic()
    while not until():
        if processes.interrupted:
            raise KeyboardInterrupt
        if ended := processes.ended():
            raise RuntimeError(f'{ended[0]} has ended')
        if len(observer.windows) > seen:
            seen, since = len(observer.windows), time.monotonic()
        if time.monotonic() - since > _PATIENCE:
            raise TimeoutError(f'{otherwise}: nothing new for {_PATIENCE:g} s')
        rclpy.spin_once(observer, timeout_sec=0.1)
