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
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from ctsid_core.model.estimate import Estimate
from ctsid_ros.examples.demo_processes import Processes
from ctsid_ros.examples.demo_table import Truth, Window, judge, line, summary
from ctsid_ros.messages import decode_metadata, decode_model

IDENTIFIER, ROBOT, TUNER = ('ctsid_ros.node', 'ctsid_ros.examples.simulated_robot',
                            'ctsid_ros.examples.gain_tuner')
_START = 30.0  # time for processes to start and to find each other [s]
_LAST = 1.0  # time for the last window to be identified, after the flight [s]


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
        self.create_subscription(String, 'identifier/model', self._on_model, every)
        self.create_subscription(String, 'gain_tuner/verdict', self._on_verdict, every)
        self.create_subscription(String, 'simulated_robot/truth', self._on_truth, every)

    def ready(self) -> bool:
        """Return whether identifier and tuner wait for the robot."""
        return bool(self.count_subscribers('imu') and self.count_subscribers('command/torque')
                    and self.count_subscribers('identifier/model') > 1)

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
    _spin(observer, processes, observer.ready, _START, 'identifier and tuner do not start')
    processes.start(ROBOT, '-p', f'seed:={plan.seed}', '-p', f'change_to:={float(plan.payload)!r}',
                    '-p', f'change_after:={plan.duration / 2!r}')
    _spin(observer, processes, lambda: bool(observer.truths), _START, 'the robot does not fly')
    print(f'a payload of {plan.payload:g} kg is attached after {plan.duration / 2:g} s. Each '
          'line: end of the window; then true pole: identified pole ± reported\n'
          'standard deviation (distance in standard deviations) [rad/s]')
    _spin(observer, processes, lambda: False, plan.duration)
    _spin(observer, processes, lambda: False, _LAST)
    observer.finish()


def _spin(observer: Observer, processes: Processes, until: Callable[[], bool], seconds: float,
          otherwise: str = '') -> None:
    """Spin until something is true, or for some time; that is an error if a text is given."""
    end = time.monotonic() + seconds
    while not until():
        if processes.interrupted:
            raise KeyboardInterrupt
        if ended := processes.ended():
            raise RuntimeError(f'{ended[0]} has ended')
        if time.monotonic() > end:
            if otherwise:
                raise TimeoutError(f'{otherwise} within {seconds:g} s')
            return
        rclpy.spin_once(observer, timeout_sec=0.1)
