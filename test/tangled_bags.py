# SPDX-License-Identifier: Apache-2.0
"""
Recordings of simulated robots, as tangled as real ones, and what in them is the experiment.

A robot of one axis with its own dynamics, dead time, noise and often a loop around it is
recorded among copies of its commands, setpoints, motors, a joystick, a second robot, several
sensors of the same motion, batteries, covariances and counters; names, rates, times of start and
what is there at all are drawn by the seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bag_fixtures import START, STORE, Sent, header, make, vector, write_mcap
import numpy as np
from rosbags.typesys import get_types_from_msg

TYPES = {
    'fc_msgs/msg/Outputs': 'std_msgs/Header header\nuint32 count\nfloat32[4] motor\n'
                           'float32 supply\nbool armed\n',
    'fc_msgs/msg/Wanted': 'builtin_interfaces/Time t\nfloat32 roll\nfloat32 pitch\n'
                          'float32 yaw_rate\nfloat32 thrust\nuint8 mode\n',
    'fc_msgs/msg/Channels': 'uint64 timestamp\nuint16[6] values\nuint8 flags\n',
}
for _name, _text in TYPES.items():
    if _name not in STORE.types:
        STORE.register(get_types_from_msg(_text, _name))
KINDS = ('roll', 'pitch', 'yaw_rate', 'climb', 'wheel')
Signal = Callable[[np.ndarray], np.ndarray]
_FINE = 0.0025  # s: step of the simulation
DITHER = np.random.default_rng(99).choice([-1.0, 1.0], 997)  # that a loop is excited by as well


@dataclass
class Tangled:
    """
    A recording and its truth.

    Parameters
    ----------
    kind : str
    sent : list of Sent
    inputs : list of (topic, field)
        What drives the plant and its copies, the best stamped first.
    setpoints : list of (topic, field)
        What drives the closed loop, if there is one.
    outputs : list of (topic, field)
        What measures the motion of the axis: rate or angle, speed or height.
    other : Tangled, optional
        Of the second robot; it is an experiment as well.
    """

    kind: str
    sent: list[Sent] = field(default_factory=list)
    inputs: list[tuple[str, str]] = field(default_factory=list)
    setpoints: list[tuple[str, str]] = field(default_factory=list)
    outputs: list[tuple[str, str]] = field(default_factory=list)
    other: Tangled | None = None

    def holds(self, u: tuple[str, str], y: tuple[str, str], setpoint: bool = False) -> bool:
        """Whether this pair is input and output of the plant (or its loop) of one robot."""
        own = u in (*self.inputs, *(self.setpoints if setpoint else ())) and y in self.outputs
        return own or (self.other is not None and self.other.holds(u, y, setpoint))


@dataclass(frozen=True)
class Motion:
    """What a simulation gave, every `_FINE` seconds: setpoint, command, rate, its integral."""

    time: np.ndarray
    wanted: np.ndarray
    command: np.ndarray
    rate: np.ndarray
    angle: np.ndarray
    closed: bool

    def at(self, values: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.interp(t, self.time, values)

    def held(self, values: np.ndarray, t: np.ndarray) -> np.ndarray:
        return values[np.clip((t / _FINE).astype(int), 0, len(values) - 1)]


def excitation(rng, t: np.ndarray) -> np.ndarray:
    """Return steps of random length, a sweep, or doublets; at rest before and after."""
    first, last = 0.15 * t[-1], rng.uniform(0.75, 0.95) * t[-1]
    kind = rng.integers(3)
    if kind == 0:
        edges = np.cumsum(rng.uniform(0.25, 1.5, int(t[-1] / 0.2)))
        u = rng.uniform(-1, 1, len(edges) + 1)[np.searchsorted(edges, t)]
    elif kind == 1:
        share = np.clip((t - first) / (last - first), 0, 1)
        u = np.sin(2 * np.pi * 0.2 * (last - first) * (10 ** share - 1) / np.log(10))
    else:
        period = rng.uniform(2.0, 4.0)
        phase = (t % period) / period
        size = 1.0 + 0.5 * np.sin(np.floor(t / period) * 2.3)
        u = size * np.where(phase < 0.2, 1.0, np.where(phase < 0.4, -1.0, 0.0))
    return np.where((t > first) & (t < last), u, 0.0)


def simulate(rng, kind: str, duration: float, size: float = 1.0) -> Motion:
    """Simulate actuator, dead time and body of one axis, with gusts, most often in a loop."""
    t = np.arange(0.0, duration, _FINE)
    slow = {'roll': 1.0, 'pitch': 0.8, 'yaw_rate': 2.5, 'climb': 0.5, 'wheel': 6.0}[kind]
    damping, actuator = slow * rng.uniform(0.7, 1.5), rng.uniform(12.0, 30.0)
    dead, gain = rng.integers(2, 16), slow * rng.uniform(2.0, 5.0)
    closed = kind in ('roll', 'pitch', 'climb') or bool(rng.integers(2))
    every = int(round(1 / rng.choice([25.0, 50.0, 100.0]) / _FINE))
    wanted = size * excitation(rng, t)
    gust = np.convolve(rng.standard_normal(len(t)), np.exp(-np.arange(0, 2, _FINE) / 0.4), 'same')
    gust *= 0.06 * size * gain / np.std(gust)
    command, rate, angle = (np.zeros(len(t)) for _ in range(3))
    moment, p, phi, integral, u = 0.0, 0.0, 0.0, 0.0, 0.0
    hold_angle = kind in ('roll', 'pitch', 'climb')
    k_angle, k_rate = (4.0, 4.0 / gain) if hold_angle else (0.0, 2.0 / gain)
    for k in range(len(t)):
        if k % every == 0:
            noisy = p + 0.01 * size * rng.standard_normal()
            if not closed:
                u = wanted[k]
            elif hold_angle:
                u = k_rate * (k_angle * (0.4 * wanted[k] - phi) - noisy)
            else:
                integral += every * _FINE * (wanted[k] - noisy)
                u = wanted[k] * damping / gain + k_rate * (wanted[k] - noisy) + integral / gain
            u += 0.15 * size * DITHER[k // 12 % len(DITHER)] * closed
        command[k], rate[k], angle[k] = u, p, phi
        moment += _FINE * actuator * (command[max(k - dead, 0)] - moment)
        p += _FINE * (gain * moment - damping * p + gust[k])
        phi += _FINE * p
    return Motion(t, wanted * (0.4 if hold_angle else 1.0), command, rate, angle, closed)


class Recorder:
    """Collects the messages of one robot in one recording."""

    def __init__(self, rng, duration: float, prefix: str) -> None:
        self.rng, self.duration, self.prefix, self.sent = rng, duration, prefix, []

    def name(self, *choices: str) -> str:
        return self.prefix + str(self.rng.choice(choices))

    def write(self, topic: str, kind: str, rate: float, make_one: Callable[[int, float, Any], Any],
              late: float = 0.003, start: float = 0.0) -> None:
        """Send messages at jittered times; `make_one` gets number, time and header."""
        t = np.arange(start, self.duration - 0.05, 1 / rate)
        t += self.rng.uniform(0, 0.15 / rate, len(t))
        for k, when in enumerate(t):
            stamp = START + round(when * 1e9)
            log = stamp + round((late + self.rng.exponential(0.002)) * 1e9)
            self.sent.append(Sent(topic, kind, log, make_one(k, when, header(stamp))))


def quaternion(axis: str, angle: float):
    half, other = 0.5 * angle, {'x': 0.0, 'y': 0.0, 'z': 0.0}
    return make('geometry_msgs/msg/Quaternion', w=np.cos(half), **(other | {axis: np.sin(half)}))


def on(axis: str, value: float, noise: np.ndarray):
    return vector(*(noise[i] + (value if name == axis else 0.0) for i, name in enumerate('xyz')))


AXIS = {'roll': 'x', 'pitch': 'y', 'yaw_rate': 'z', 'climb': 'z', 'wheel': 'y'}


def tangled(seed: int, kind: str, duration: float = 60.0) -> Tangled:
    """Draw a recording."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    two = bool(rng.integers(2))
    prefix = str(rng.choice(['/uav1', '/r7', '/alpha', '/vehicle_3'])) if two or rng.integers(2) \
        else ''
    truth = Tangled(kind)
    own = Recorder(rng, duration, prefix)
    motion = simulate(rng, kind, duration)
    commands(own, motion, kind, truth)
    sensors(own, motion, kind, truth)
    clutter(own, motion)
    truth.sent += own.sent
    if two:
        other = Recorder(rng, duration * rng.uniform(0.8, 1.0), prefix[:-1] + 'b')
        beside, aside = simulate(rng, kind, duration, rng.uniform(0.3, 1.0)), Tangled(kind)
        commands(other, beside, kind, aside)
        sensors(other, beside, kind, aside)
        truth.sent += other.sent
        truth.other = aside
    truth.sent.sort(key=lambda s: s.log_ns)
    return truth


def commands(to: Recorder, motion: Motion, kind: str, truth: Tangled) -> None:
    """Send the command, most often twice, and the setpoint if there is a loop."""
    rng, axis, rate = to.rng, AXIS[kind], float(to.rng.choice([25.0, 50.0, 100.0]))
    ask = lambda when: float(motion.held(motion.command, np.array([when]))[0])  # noqa: E731
    stamped = bool(rng.integers(3))
    if kind == 'yaw_rate':
        topic = to.name('/cmd_vel', '/base/cmd', '/mux/out')
        plain = lambda k, t, h: make('geometry_msgs/msg/Twist', linear=vector(0.3),  # noqa: E731
                                     angular=vector(0, 0, ask(t)))
        truth.inputs.append((topic, 'angular.z'))
        to.write(topic, 'geometry_msgs/msg/Twist', rate, plain)
        if stamped:
            twin = to.name('/cmd_vel_stamped', '/twist_mux/cmd', '/drive_in')
            truth.inputs.insert(0, (twin, 'twist.angular.z'))
            to.write(twin, 'geometry_msgs/msg/TwistStamped', rate, lambda k, t, h: make(
                'geometry_msgs/msg/TwistStamped', header=h, twist=plain(k, t, h)))
    elif kind == 'wheel':
        topic = to.name('/wheel/cmd', '/motor_voltage', '/drives/set')
        truth.inputs.append((topic, 'data[1]'))
        wobble = rng.uniform(0.5, 2.0, 4)
        to.write(topic, 'std_msgs/msg/Float64MultiArray', rate, lambda k, t, h: make(
            'std_msgs/msg/Float64MultiArray', data=np.array(
                [np.sin(wobble[0] * t), ask(t), np.sign(np.sin(wobble[1] * t)), 0.0])))
    else:
        scale = float(rng.choice([1.0, 0.2, 300.0]))
        topic = to.name('/command/torque', '/ctrl/u', '/fcu/act_in', '/outputs/low_level')
        place = {'x': 'torque.x', 'y': 'torque.y', 'z': 'force.z'}[axis]
        inner = lambda when: make('geometry_msgs/msg/Wrench', **{  # noqa: E731
            'force': vector(0, 0, 9.8 + (scale * ask(when) if kind == 'climb' else 0.0)),
            'torque': on(axis if kind != 'climb' else '', scale * ask(when),
                         0.01 * scale * rng.standard_normal(3))})
        if stamped:
            truth.inputs.append((topic, f'wrench.{place}'))
            to.write(topic, 'geometry_msgs/msg/WrenchStamped', rate, lambda k, t, h: make(
                'geometry_msgs/msg/WrenchStamped', header=h, wrench=inner(t)))
        else:
            truth.inputs.append((topic, place))
            to.write(topic, 'geometry_msgs/msg/Wrench', rate, lambda k, t, h: inner(t))
        if rng.integers(2):
            twin = to.name('/mixer/in', '/log/u', '/actuator_controls')
            truth.inputs.append((twin, 'data[0]'))
            to.write(twin, 'std_msgs/msg/Float64MultiArray', rate / 2, lambda k, t, h: make(
                'std_msgs/msg/Float64MultiArray', data=np.array([3 * ask(t), 0.5, k % 7])))
        motors(to, motion, kind)
    if motion.closed:
        setpoints(to, motion, kind, truth)


def motors(to: Recorder, motion: Motion, kind: str) -> None:
    """Send the four motors, which the command moves among other things."""
    rng, phases = to.rng, to.rng.uniform(0, 6, 3)
    signs = {'roll': (1, -1, -1, 1), 'pitch': (1, 1, -1, -1), 'climb': (1, 1, 1, 1)}[kind]

    def outputs(k, t, h):
        u = float(motion.held(motion.command, np.array([t]))[0])
        rest = 0.15 * np.sin(0.7 * t + phases[0]) * np.array([1, -1, 1, -1])
        mixed = 0.5 + 0.1 * u * np.array(signs) + rest + 0.02 * rng.standard_normal(4)
        return make('fc_msgs/msg/Outputs', header=h, count=k, motor=mixed.astype(np.float32),
                    supply=np.float32(16 - 0.01 * t - 0.3 * mixed.mean()), armed=True)

    to.write(to.name('/motors', '/esc/out', '/fcu/pwm'), 'fc_msgs/msg/Outputs', 50.0, outputs)


def setpoints(to: Recorder, motion: Motion, kind: str, truth: Tangled) -> None:
    """Send what the loop is told."""
    want = lambda when: float(motion.held(motion.wanted, np.array([when]))[0])  # noqa: E731
    topic = to.name('/setpoint', '/desired', '/ref/attitude', '/guidance')
    place = {'roll': 'roll', 'pitch': 'pitch', 'climb': 'thrust'}.get(kind, 'yaw_rate')
    truth.setpoints.append((topic, place))
    to.write(topic, 'fc_msgs/msg/Wanted', float(to.rng.choice([10.0, 20.0])), lambda k, t, h: make(
        'fc_msgs/msg/Wanted', t=h.stamp, mode=3, **{place: np.float32(want(t))}))


def sensors(to: Recorder, motion: Motion, kind: str, truth: Tangled) -> None:
    """Send one to three sensors of the motion, and what else they measure."""
    rng, axis = to.rng, AXIS[kind]
    size = float(np.std(motion.rate))
    rate_of = lambda when: float(motion.at(motion.rate, np.array([when]))[0])  # noqa: E731
    angle_of = lambda when: float(motion.at(motion.angle, np.array([when]))[0])  # noqa: E731
    turning = kind in ('roll', 'pitch', 'yaw_rate')
    part = {'roll': 'roll', 'pitch': 'pitch', 'yaw_rate': 'yaw'}.get(kind, '')
    for number in range(1 + int(rng.integers(2)) if kind != 'wheel' else 1):
        noise = size * rng.uniform(0.02, 0.1)
        topic = to.name(f'/imu{number}', f'/sensor{number}/data', f'/s{number}')
        if turning:
            truth.outputs += [(topic, f'angular_velocity.{axis}'),
                              (topic, f'euler(orientation).{part}')]
        to.write(topic, 'sensor_msgs/msg/Imu', float(rng.choice([80.0, 125.0])),
                 lambda k, t, h, noise=noise: make(
            'sensor_msgs/msg/Imu', header=h,
            angular_velocity=on(axis if turning else '', rate_of(t),
                                noise * rng.standard_normal(3)),
            orientation=quaternion(axis if turning else 'x', angle_of(t) if turning else 0.01
                                   * rng.standard_normal()),
            angular_velocity_covariance=np.abs(rng.standard_normal(9)),
            linear_acceleration=on('z', 9.8, 0.3 * rng.standard_normal(3))),
            start=rng.uniform(0, 3))
    if kind == 'wheel':
        topic = to.name('/joint_states', '/encoders', '/wheels')
        truth.outputs += [(topic, 'velocity[b]'), (topic, 'position[b]')]
        drift = rng.uniform(0.3, 2.0, 4)

        def wheels(k, t, h):
            speed = size * np.sin(drift * t) * 0.7 + 0.05 * size * rng.standard_normal(4)
            speed[1] = rate_of(t) + 0.03 * size * rng.standard_normal()
            return make('sensor_msgs/msg/JointState', header=h, name=list('abcd'), velocity=speed,
                        position=np.array([0.1 * t, angle_of(t), 0, -t]), effort=np.zeros(4))

        to.write(topic, 'sensor_msgs/msg/JointState', 50.0, wheels)
    elif rng.integers(2) or kind == 'climb':
        topic = to.name('/odom', '/local_position', '/estimator')
        truth.outputs += [(topic, f'twist.twist.{"angular" if turning else "linear"}.{axis}')]
        truth.outputs.append((topic, f'euler(pose.pose.orientation).{part}' if turning
                              else 'pose.pose.position.z'))
        walk = np.cumsum(0.02 * rng.standard_normal((int(to.duration * 60), 3)), axis=0)

        def odometry(k, t, h):
            wind = 0.02 * size * rng.standard_normal(3)
            twist = make('geometry_msgs/msg/Twist',
                         linear=on('' if turning else 'z', rate_of(t), wind),
                         angular=on(axis if turning else '', rate_of(t), wind))
            pose = make('geometry_msgs/msg/Pose', orientation=quaternion(
                axis if turning else 'z', angle_of(t) if turning else 0.2),
                position=make('geometry_msgs/msg/Point', x=walk[k, 0], y=walk[k, 1],
                              z=walk[k, 2] if turning else angle_of(t)))
            return make('nav_msgs/msg/Odometry', header=h, pose=make(
                'geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=np.abs(
                    rng.standard_normal(36))), twist=make(
                'geometry_msgs/msg/TwistWithCovariance', twist=twist))

        to.write(topic, 'nav_msgs/msg/Odometry', 50.0, odometry, late=0.02)


def clutter(to: Recorder, motion: Motion) -> None:
    """Send a joystick, radio channels, a battery, a temperature, and a mode."""
    rng = to.rng
    if rng.integers(4):
        sway = rng.uniform(0.2, 0.9, 2)
        follows = bool(rng.integers(2))

        def joy(k, t, h):
            axes = [np.sin(sway[0] * t) ** 3, np.round(np.sin(sway[1] * t), 1), 0.0, 1.0]
            if follows:
                axes[2] = np.round(float(motion.held(motion.wanted, np.array([t - 0.15]))[0]), 2)
            return make('sensor_msgs/msg/Joy', header=h, axes=np.array(axes, np.float32),
                        buttons=np.array([int(7 < t < 8), 0, int(t > 20)], np.int32))

        to.write(to.name('/joy', '/teleop/joy'), 'sensor_msgs/msg/Joy', 20.0, joy)
    if rng.integers(2):
        to.write(to.name('/rc/in', '/radio'), 'fc_msgs/msg/Channels', 15.0, lambda k, t, h: make(
            'fc_msgs/msg/Channels', timestamp=int(t * 1e6), flags=1, values=np.array(
                [1500 + 200 * np.sin(0.3 * t), 1500, 1500 + rng.integers(-2, 3), 1000,
                 2000 if t > 12 else 1000, 1500], np.uint16)))
    to.write(to.name('/battery', '/power'), 'sensor_msgs/msg/BatteryState', 2.0,
             lambda k, t, h: make('sensor_msgs/msg/BatteryState', header=h,
                                  voltage=np.float32(16 - 0.01 * t),
                                  current=np.float32(5 + abs(motion.held(
                                      motion.command, np.array([t]))[0]))))
    to.write(to.name('/temp', '/baro'), 'sensor_msgs/msg/Temperature', 5.0, lambda k, t, h: make(
        'sensor_msgs/msg/Temperature', header=h, temperature=20 + 0.01 * t
        + 0.05 * rng.standard_normal()))
    for when in (0.4 * to.duration, 0.9 * to.duration):
        to.sent.append(Sent(to.prefix + '/arm_switch', 'std_msgs/msg/Float64',
                            START + round(when * 1e9), make('std_msgs/msg/Float64', data=when)))


def write_tangled(path: Path, seed: int, kind: str, duration: float = 60.0
                  ) -> tuple[Path, Tangled]:
    """Write a recording; return its path and truth."""
    truth = tangled(seed, kind, duration)
    return write_mcap(path, truth.sent, chunk_size=1 << 18), truth
