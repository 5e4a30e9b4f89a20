# SPDX-License-Identifier: Apache-2.0
"""
What the node costs beside a robot, with real processes and real messages.

A robot publishes sensor_msgs/Imu and Float64MultiArray (5 channels); one case after the other
listens to it: the node as a whole, its ingest alone, the same ingest by callbacks of an executor,
and an ordinary rclpy subscriber. Counted is the processor time of the listening process between
two of its diagnostics, after the first window.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import time

os.environ |= {'ROS_DOMAIN_ID': os.environ.get('ROS_DOMAIN_ID') or str(random.randrange(1, 100)),
               'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}

from common import machine, table  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
import rclpy  # noqa: E402
from rclpy.executors import ExternalShutdownException  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402

from ctsid_ros.config.parameter_file import read_config  # noqa: E402
from ctsid_ros.decoding.message_types import message_class, of_message_class  # noqa: E402
from ctsid_ros.ingest.feed import Feed, Taken  # noqa: E402
from ctsid_ros.messages import decode_diagnostics  # noqa: E402

HERE = Path(__file__).resolve().parent
CHANNELS = """/**:
  ros__parameters:
    inputs: [u]
    outputs: [p, q, r]
    u: {topic: /command, type: std_msgs/msg/Float64MultiArray, field: 'data[0:2]'}
    p: {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.x}
    q: {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.y}
    r: {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.z}
    feedthrough: false
"""
SHORT = {'window.max_delay': 0.05}  # nothing comes late here; models appear that much later
TICK = os.sysconf('SC_CLK_TCK')


@dataclass
class Case:
    """What listens: parameters of a program by name, or None for the plain subscriber."""

    name: str
    parameters: Mapping[str, object] | None
    program: Sequence[str] = ('-m', 'ctsid_ros.node')
    values: dict[str, str] = field(default_factory=dict)
    cpu: float = 0.0  # processor time over time


NEVER = {'window.length': 1000.0, 'window.stride': 1000.0, 'ingest.rate': 50.0}
CASES = {case.name: case for case in (
    Case('node, nothing set', {}),
    Case('node, order given', {'order': 4}),
    Case('node, order given, no held-out test', {'order': 4, 'validation.held_out': 0.0}),
    Case('ingest alone, drained', NEVER),
    Case('ingest alone, callbacks', NEVER, (__file__, '--rival')),
    Case('plain rclpy subscriber', None))}


class Listener(Node):  # type: ignore[misc]  # rclpy has no types
    """Remember the last diagnostics."""

    def __init__(self) -> None:
        super().__init__('benchmark')
        self.values: dict[str, str] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self.on_diagnostics, 10)

    def on_diagnostics(self, msg: DiagnosticArray) -> None:
        """Take a message."""
        for health in decode_diagnostics(msg)[1]:
            self.values |= {key: str(value) for key, value in health.values.items()}
            self.values[health.name.rpartition(': ')[2]] = health.message

    def wait(self, seconds: float) -> None:
        """Listen for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self, timeout_sec=left)


@contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program; it is told to end at the end."""
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            process.kill()


def processor_seconds(pid: int) -> float:
    """Return the processor time that a process has used [s]."""
    user, system = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[11:13]
    return (int(user) + int(system)) / TICK


def command(case: Case, folder: Path) -> list[str]:
    """Return the command line of what listens."""
    if case.parameters is None:
        return [str(HERE / 'plain_subscriber.py')]
    path = folder / 'params.yaml'
    path.write_text(CHANNELS + ''.join(
        f'    {name}: {value}\n' for name, value in case.parameters.items()))
    return [*case.program, '--ros-args', '--params-file', str(path)]


def measure(case: Case, listener: Listener, rates: Sequence[float], seconds: float,
            settle: float, folder: Path) -> Case:
    """Let one case listen; return it with what was measured."""
    listener.values = {}
    robot = [str(HERE / 'fast_robot.py'), *map(str, (*rates, settle + seconds + 10.0))]
    with running(*command(case, folder)) as process, running(*robot):
        listener.wait(settle)
        begin, used = time.monotonic(), processor_seconds(process.pid)
        listener.wait(seconds)
        cpu = (processor_seconds(process.pid) - used) / (time.monotonic() - begin)
        return replace(case, values=dict(listener.values), cpu=cpu)


def rival(path: str) -> None:
    """Feed the ingest of the node from callbacks of an executor; ends on SIGTERM."""
    config, called = read_config(path), []
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    rclpy.init()
    node = Node('rival')

    def take(topic: str, raw: bytes, info: Mapping[str, int]) -> None:
        called.append(Taken(info['received_timestamp'], topic, raw, info['source_timestamp'],
                            info['publication_sequence_number']))

    def push() -> None:
        feed.take(called, time.time_ns())
        called.clear()

    classes = {channel.topic: message_class(channel.type) for channel in config.channels}
    feed = Feed(config, {topic: of_message_class(cls) for topic, cls in classes.items()},
                lambda topic: 1)
    for topic, cls in classes.items():
        node.create_subscription(cls, topic, partial(take, topic), QoSProfile(
            depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT), raw=True)
    node.create_timer(1.0 / config.node.ingest_rate, push)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


def row(case: Case, plain: float) -> tuple[str, ...]:
    """Return a line of the table."""
    values = case.values
    lost = [v for k, v in values.items() if k.endswith(' lost')]
    return (case.name, f'{100 * case.cpu:.1f} %', f'{plain / case.cpu:.1f}' if plain else '',
            *(f'{1e3 * float(values[key]):.0f}' if values.get(key) else '-'
              for key in ('computing time [s]', 'latency [s]')),
            values.get('windows', '-'), values.get('skipped windows', '-'),
            ' + '.join(lost) or '-',
            ' + '.join(v for k, v in values.items() if k.endswith(' messages')) or '-')


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=30.0, help='per case [%(default)s]')
    parser.add_argument('--rates', type=float, nargs=2, default=(1000.0, 500.0),
                        metavar=('IMU', 'COMMAND'), help='[Hz], [%(default)s]')
    parser.add_argument('--only', nargs='+', choices=CASES, default=list(CASES), metavar='CASE')
    parser.add_argument('--set', nargs='+', default=[], metavar='NAME=VALUE',
                        help='further parameters of the node')
    options = parser.parse_args(arguments)
    more = dict(setting.split('=', 1) for setting in options.set)
    settle = 3.0 + float(more.get('window.length', 10.0)) + 2.0
    rclpy.init()
    listener, done = Listener(), []
    with tempfile.TemporaryDirectory() as folder:
        for name in options.only:
            case = CASES[name]
            if case.parameters is not None:
                case.parameters = {**SHORT, **case.parameters, **more}
            done.append(measure(case, listener, options.rates, options.seconds, settle,
                                Path(folder)))
    rclpy.try_shutdown()
    plain = next((case.cpu for case in done if case.parameters is None), 0.0)
    print(f'Imu at {options.rates[0]:g} Hz and commands at {options.rates[1]:g} Hz, '
          f'{options.seconds:g} s per case.\n{machine()}\n')
    print(table(('listening', 'processor', 'plain / this', 'computing [ms]', 'latency [ms]',
                 'windows', 'skipped', 'lost', 'messages'), [row(case, plain) for case in done]))
    return 0


if __name__ == '__main__':
    if '--rival' in sys.argv:
        sys.exit(rival(sys.argv[-1]))
    sys.exit(main())
