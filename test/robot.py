# SPDX-License-Identifier: Apache-2.0
"""A plant that publishes: the exact motion for held inputs, as messages at any speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import time

from live import RELIABLE, Identifier, Live
import numpy as np
from plants import Plant, plant
from scipy.linalg import expm
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray

from ctsid_ros.messages import Health

S = 10**9
EPOCH = 1_700_000_000 * S
SOFT = plant([[-1.0, 4.0], [-4.0, -1.0]], [[1.0], [2.0]], [[1.0, 0.0], [0.0, 1.0]])
STIFF = plant([[-2.0, 9.0], [-9.0, -2.0]], [[2.0], [3.0]], [[1.0, 0.0], [0.0, 1.0]])
NOISE = 0.02  # of each output, relative


@dataclass(frozen=True)
class Motion:
    """What one experiment gives: stamps [s], inputs (N_u, 1) and noisy outputs (N_y, 2)."""

    t_u: np.ndarray
    u: np.ndarray
    t_y: np.ndarray
    y: np.ndarray


def motion(seconds: float, *, phases: Sequence[tuple[float, Plant]] = ((0.0, SOFT),),
           rates: tuple[float, float] = (50.0, 200.0), seed: int = 0) -> Motion:
    """
    Return the motion under random levels of 0.1 s; phases tell from when on which plant it is.

    The stamps of the outputs are 0.3 of their interval off those of the inputs.
    """
    rng = np.random.default_rng(seed)
    t_u, t_y = (np.arange(round(seconds * rate)) / rate for rate in rates)
    t_y = t_y + 0.3 / rates[1]
    u = rng.standard_normal(int(seconds * 10) + 1)[(t_u * 10 + 1e-6).astype(int)]
    knots = np.unique(np.concatenate((t_u, t_y, [start for start, _ in phases])))
    x, states, index = np.zeros(2), [], np.searchsorted(t_u, knots, side='right') - 1
    steps = {}
    for k, now in enumerate(knots):
        states.append(x)
        if k + 1 < len(knots):
            p = [p for start, p in phases if start <= now][-1]
            key = (round((knots[k + 1] - now) * 1e9), id(p))
            if key not in steps:
                joined = np.zeros((3, 3))
                joined[:2] = np.hstack((p.A, p.B))
                steps[key] = expm((knots[k + 1] - now) * joined)[:2]
            x = steps[key] @ [*x, u[index[k]]]
    y = np.array(states)[np.searchsorted(knots, t_y)]
    return Motion(t_u, u[:, np.newaxis], t_y,
                  y + NOISE * y.std(axis=0) * rng.standard_normal(y.shape))


def params(more: str = '', *, command: str = '/command', imu: str = '/imu', header: bool = True,
           length: float = 4.0, max_delay: float = 0.3) -> str:
    """
    Return a parameter file for the plant; quick to identify.

    Reliable, since a computer that is busy may lose messages otherwise; and with a delay that is
    long enough at ten times the speed.
    """
    kind, field = (('sensor_msgs/msg/JointState', 'effort[0]') if header else
                   ('std_msgs/msg/Float64MultiArray', 'data[0]'))
    lines = ''.join(f'    {line}\n' for line in more.splitlines())
    for name, value in (('order', '2'), ('ingest.reliability', 'reliable')):
        lines += '' if f'{name}:' in more else f'    {name}: {value}\n'
    return f"""\
/**:
  ros__parameters:
    inputs: [torque]
    outputs: [p, q]
    torque: {{topic: {command}, type: {kind}, field: '{field}', unit: N m}}
    p: {{topic: {imu}, type: sensor_msgs/msg/Imu, field: angular_velocity.x, unit: rad/s}}
    q: {{topic: {imu}, type: sensor_msgs/msg/Imu, field: angular_velocity.y, unit: rad/s}}
    window.length: {length}
    window.max_delay: {max_delay}
{lines}"""


class Robot:
    """
    Publish a motion, from where it stopped on.

    Its stamps count from `start_ns`; None is the moment of the first message. The nodes that are
    named as readers hear it from the first message on.
    """

    def __init__(self, live: Live, made: Motion, *readers: str, command: str = '/command',
                 imu: str = '/imu', header: bool = True, start_ns: int | None = EPOCH) -> None:
        kinds = {command: JointState if header else Float64MultiArray, imu: Imu}
        self.publishers = dict(zip(('command', 'imu'), live.publishers(kinds, RELIABLE, *readers),
                                   strict=True))
        self._header, self.start_ns = header, start_ns
        both = [(t, 'command', u) for t, u in zip(made.t_u, made.u, strict=True)]
        both += [(t, 'imu', y) for t, y in zip(made.t_y, made.y, strict=True)]
        self._rest = sorted(both, key=lambda entry: entry[0])
        self.sent = {'command': 0, 'imu': 0}

    def send(self, until: float = np.inf, *, speed: float = 6.0, shift: float = 0.0) -> None:
        """Publish what is stamped before a time [s], so many times faster than real time."""
        start, first = time.monotonic(), self._rest[0][0] if self._rest else 0.0
        if self.start_ns is None:
            self.start_ns = time.time_ns()
        while self._rest and self._rest[0][0] < until:
            t, name, values = self._rest.pop(0)
            ahead = (t - first) / speed - (time.monotonic() - start)
            if ahead > 0.002:
                time.sleep(ahead)
            self.publish(name, self.start_ns + round((t + shift) * 1e9), values)

    def feed(self, node: Identifier, *, length: float = 4.0, stride: float = 1.0) -> None:
        """Publish all, as fast as the models come: no window is skipped."""
        end, count, last = length, len(node.models), self._rest[-1][0]
        while end + 0.45 < last:  # `window.max_delay` and the samples after the window
            self.send(end + 0.45, speed=10.0)
            count, end = count + 1, end + stride
            node.wait_models(count)
        self.send(speed=10.0)

    def wait_taken(self, node: Identifier) -> Health:
        """Return what the node says of its ingest once it has all that was sent."""
        return node.wait_health('ingest', lambda h: all(
            h.values[f'{publisher.topic_name} messages'] == str(self.sent[name])
            for name, publisher in self.publishers.items()), 'all messages')

    def publish(self, name: str, stamp_ns: int, values: Sequence[float]) -> None:
        """Publish one message."""
        self.sent[name] += 1
        self.publishers[name].publish(
            imu_message(stamp_ns, values) if name == 'imu' else
            joint_message(stamp_ns, values) if self._header else
            Float64MultiArray(data=[float(v) for v in values]))


def imu_message(stamp_ns: int, values: Sequence[float]) -> Imu:
    message = Imu()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, S)
    message.angular_velocity.x, message.angular_velocity.y = (float(v) for v in values[:2])
    return message


def joint_message(stamp_ns: int, values: Sequence[float]) -> JointState:
    message = JointState(effort=[float(v) for v in values])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, S)
    return message
