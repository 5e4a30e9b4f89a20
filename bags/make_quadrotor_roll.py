# SPDX-License-Identifier: Apache-2.0
"""
Make the example bags: the roll loop of a simulated quadrotor, and its true model.

Usage: python bags/make_quadrotor_roll.py [FOLDER]

An attitude controller commands a roll torque at 50 Hz, held until the next command. The torque
passes the motors' lag and turns a body that carries a camera boom on a slightly flexible joint,
in gusty air. An inertial sensor at nominally 200 Hz measures roll rate and attitude. Commands and
measurements have their own jittered stamps, are logged later than they are stamped, and some
measurements are lost. Between any two stamps the motion is integrated exactly.

The same messages are written as rosbag2 MCAP (quadrotor_roll/), rosbag2 sqlite3
(quadrotor_roll_sqlite3/) and ROS 1 (quadrotor_roll.bag), and the model from torque to roll rate
to quadrotor_roll_truth.json. Everything is drawn from one seed: a rerun gives the same messages.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import shutil
import sys

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from scipy.linalg import expm, solve_continuous_are

from ctsid_core import storage
from ctsid_core.statespace import StateSpace

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

SEED = 20250614
EPOCH_NS = 1_749_888_000_000_000_000  # 2025-06-14 08:00 UTC
DURATION = 40.0  # s

# The plant. States: motor torque [N m], body roll rate [rad/s], joint angle [rad], boom rate.
MOTOR_POLE = -20.0  # rad/s
AIR_POLE = -2.0  # rad/s: aerodynamic damping of the rigid vehicle
BODY, BOOM = 0.016, 0.004  # kg m^2: roll inertia of body and boom
MODE, DAMPING = 2 * np.pi * 5.0, 0.05  # rad/s, -: the boom's mode on the free vehicle
TORQUE_OFFSET = 0.008  # N m: centre of gravity beside the centre of thrust
GUST = 6e-7  # N^2 m^2 s: spectral density of the gusts' torque

# The sensor and the controller.
GYRO_NOISE, GYRO_BIAS = 0.02, 0.015  # rad/s
GYRO_STEP = np.deg2rad(2000.0) / 2**15  # rad/s: a 16-bit gyro of +- 2000 deg/s
ANGLE_NOISE = 0.003  # rad
ANGLE_GAIN, RATE_GAIN = 36.0, 9.0  # 1/s^2, 1/s
TORQUE_LIMIT, TORQUE_STEP = 0.4, 1e-4  # N m

IMU_TOPIC, IMU_TYPE = '/imu', 'sensor_msgs/msg/Imu'
TORQUE_TOPIC, TORQUE_TYPE = '/command/torque', 'geometry_msgs/msg/WrenchStamped'


@dataclass(frozen=True)
class Flight:
    """What was recorded: stamps and log times [ns], commands [N m], rates [rad/s], angles."""

    command_ns: Stamps
    command_log_ns: Stamps
    torque: Array
    imu_ns: Stamps
    imu_log_ns: Stamps
    rate: Array  # (N, 3), body axes [rad/s]
    roll: Array  # (N,) [rad]
    acceleration: Array  # (N, 3) [m/s^2]


def plant() -> tuple[Array, Array, Array, Array]:
    """Return A, B, C and the column by which a roll torque acts on the body."""
    stiffness = MODE**2 / (1 / BODY + 1 / BOOM)
    joint = 2 * DAMPING * stiffness / MODE
    air = -AIR_POLE * (BODY + BOOM)
    A = np.array([
        [MOTOR_POLE, 0.0, 0.0, 0.0],
        [1 / BODY, -(air + joint) / BODY, -stiffness / BODY, joint / BODY],
        [0.0, 1.0, 0.0, -1.0],
        [0.0, joint / BOOM, stiffness / BOOM, -joint / BOOM]])
    B = np.array([[-MOTOR_POLE], [0.0], [0.0], [0.0]])
    C = np.array([[0.0, 1.0, 0.0, 0.0]])
    return A, B, C, np.array([[0.0], [1 / BODY], [0.0], [0.0]])


def true_model() -> StateSpace:
    """Return the true model in innovation form; K is the stationary Kalman gain."""
    A, B, C, torque_on_body = plant()
    noise = np.array([[GYRO_NOISE**2 / 200.0]])
    gusts = GUST * torque_on_body @ torque_on_body.T
    covariance = solve_continuous_are(A.T, C.T, gusts, noise)
    return StateSpace(
        A=A, B=B, C=C, D=np.zeros((1, 1)), K=covariance @ C.T / noise, delay=(0.0,),
        x_trim=TORQUE_OFFSET * torque_on_body[:, 0], y_trim=np.array([GYRO_BIAS]),
        input_names=('torque',), output_names=('rate',), input_units=('N m',),
        output_units=('rad/s',), noise=noise)


def jittered(rng: np.random.Generator, rate: float, jitter: float) -> Array:
    """Return stamps at `rate` [Hz], each displaced by up to `jitter` of a period [s]."""
    count = int(DURATION * rate)
    return np.sort(np.arange(1, count + 1) + jitter * rng.uniform(-1, 1, count)) / rate


def log_times(rng: np.random.Generator, stamps_ns: Stamps) -> Stamps:
    """Return when a recorder receives the messages: in order, some ms late, at times more."""
    late = 1e6 + rng.gamma(2.0, 1.5e6, len(stamps_ns))
    late += 2e7 * (rng.uniform(size=len(stamps_ns)) < 0.005)
    return np.maximum.accumulate(stamps_ns + late.astype(np.int64))


def reference(rng: np.random.Generator, times: Array) -> Array:
    """Return the commanded roll angle at `times`: random steps [rad]."""
    holds = rng.uniform(0.2, 0.9, 400)
    return rng.uniform(-0.4, 0.4, 401)[np.searchsorted(np.cumsum(holds), times)]


def fly(seed: int = SEED) -> Flight:
    """Simulate the flight and what is recorded of it."""
    rng = np.random.default_rng(seed)
    command_times, imu_times = jittered(rng, 50.0, 0.1), jittered(rng, 200.0, 0.25)
    # Stamps have a microsecond's resolution; the plant lives by the stamps as written.
    command_ns, imu_ns = (np.round(t * 1e6).astype(np.int64) * 1000
                          for t in (command_times, imu_times))
    noise = rng.standard_normal((len(imu_ns), 7))
    wanted = reference(rng, command_times)
    torque, rate, roll = simulate(rng, command_ns, imu_ns, wanted, noise)
    rates = np.column_stack([rate, GYRO_NOISE * noise[:, 2:4]])
    kept = rng.uniform(size=len(imu_ns)) > 0.005
    kept[5000:5010] = False  # one longer gap
    single = noise.astype(np.float32).astype(np.float64)
    return Flight(
        EPOCH_NS + command_ns, EPOCH_NS + log_times(rng, command_ns), torque,
        EPOCH_NS + imu_ns[kept], EPOCH_NS + log_times(rng, imu_ns)[kept],
        quantised(rates[kept], GYRO_STEP), roll[kept],
        quantised(0.15 * single[kept, 4:7] + [0.0, 0.0, 9.81], 9.81 * 16 / 2**15))


def quantised(values: Array, step: float) -> Array:
    """Round to multiples of `step`, as a converter does."""
    return np.round(values / step) * step


def simulate(rng: np.random.Generator, command_ns: Stamps, imu_ns: Stamps, wanted: Array,
             noise: Array) -> tuple[Array, Array, Array]:
    """Return held torques at the commands, measured rates and roll angles at the sensor."""
    stamps = np.concatenate([[0], np.union1d(command_ns, imu_ns)])
    commands, samples = np.isin(stamps, command_ns), np.isin(stamps, imu_ns)
    steps = transitions(np.diff(stamps) * 1e-9)
    gusts = rng.standard_normal(len(steps)) * np.sqrt(GUST / (np.diff(stamps) * 1e-9))
    torque, rate, roll = np.zeros(len(wanted)), np.zeros(len(noise)), np.zeros(len(noise))
    state, held, k, j = np.zeros(5), 0.0, 0, 0
    for step, gust, is_command, is_sample in zip(
            steps, gusts, commands[1:], samples[1:], strict=True):
        state = step @ np.concatenate([state, [held, gust + TORQUE_OFFSET]])
        if is_sample:
            rate[j] = state[1] + GYRO_BIAS + GYRO_NOISE * noise[j, 0]
            roll[j] = state[4] + ANGLE_NOISE * noise[j, 1]
            j += 1
        if is_command:
            last = max(j - 1, 0)
            turn = ANGLE_GAIN * (wanted[k] - roll[last]) - RATE_GAIN * rate[last]
            held = float(quantised(np.clip((BODY + BOOM) * turn, -TORQUE_LIMIT, TORQUE_LIMIT),
                                   TORQUE_STEP))
            torque[k] = held
            k += 1
    return torque, rate, roll


def transitions(durations: Array) -> Array:
    """
    Return how states, roll angle and held torques change over each duration.

    Parameters
    ----------
    durations : ndarray, shape (N,)
        Intervals [s].

    Returns
    -------
    ndarray, shape (N, 5, 7)
        From the 4 states, the angle, the commanded and the disturbing torque to the 5 first.
    """
    A, B, C, torque_on_body = plant()
    motion = np.zeros((7, 7))
    motion[:4, :4], motion[:4, 5:6], motion[:4, 6:7], motion[4, :4] = A, B, torque_on_body, C[0]
    return np.asarray(expm(motion * durations[:, np.newaxis, np.newaxis])[:, :5])


def messages(flight: Flight, store: Typestore) -> Iterator[tuple[int, str, object]]:
    """Yield (log time [ns], topic, message) in the order in which they were logged."""
    logs = [(int(t), TORQUE_TOPIC, i) for i, t in enumerate(flight.command_log_ns)]
    logs += [(int(t), IMU_TOPIC, i) for i, t in enumerate(flight.imu_log_ns)]
    for log_ns, topic, i in sorted(logs):
        make = torque_message if topic == TORQUE_TOPIC else imu_message
        yield log_ns, topic, make(flight, store, i)


def header(store: Typestore, stamp_ns: int, sequence: int) -> object:
    """Return a header of ROS 1 or ROS 2."""
    stamp = store.types['builtin_interfaces/msg/Time'](
        sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9))
    kind = store.types['std_msgs/msg/Header']
    of_ros1 = {'seq': sequence} if 'seq' in getattr(kind, '__dataclass_fields__', ()) else {}
    return kind(stamp=stamp, frame_id='base_link', **of_ros1)


def vector(store: Typestore, x: float, y: float, z: float) -> object:
    """Return a geometry_msgs Vector3."""
    return store.types['geometry_msgs/msg/Vector3'](x=float(x), y=float(y), z=float(z))


def torque_message(flight: Flight, store: Typestore, i: int) -> object:
    """Return the i-th command."""
    wrench = store.types['geometry_msgs/msg/Wrench'](
        force=vector(store, 0, 0, 0), torque=vector(store, flight.torque[i], 0, 0))
    return store.types[TORQUE_TYPE](
        header=header(store, flight.command_ns[i], i), wrench=wrench)


def imu_message(flight: Flight, store: Typestore, i: int) -> object:
    """Return the i-th measurement."""
    half = np.float32(flight.roll[i] / 2)
    attitude = store.types['geometry_msgs/msg/Quaternion'](
        x=float(np.sin(half)), y=0.0, z=0.0, w=float(np.cos(half)))
    return store.types[IMU_TYPE](
        header=header(store, flight.imu_ns[i], i), orientation=attitude,
        orientation_covariance=np.diag([ANGLE_NOISE**2] * 3).ravel(),
        angular_velocity=vector(store, *flight.rate[i]),
        angular_velocity_covariance=np.diag([GYRO_NOISE**2] * 3).ravel(),
        linear_acceleration=vector(store, *flight.acceleration[i]),
        linear_acceleration_covariance=np.diag([0.15**2] * 3).ravel())


def write_ros2(path: Path, flight: Flight, plugin: StoragePlugin, mode: CompressionMode) -> None:
    """Write a rosbag2 folder; one that is there already is replaced."""
    shutil.rmtree(path, ignore_errors=True)
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=store)
                  for topic, kind in ((TORQUE_TOPIC, TORQUE_TYPE), (IMU_TOPIC, IMU_TYPE))}
        for log_ns, topic, message in messages(flight, store):
            connection = topics[topic]
            writer.write(connection, log_ns, store.serialize_cdr(message, connection.msgtype))


def write_ros1(path: Path, flight: Flight) -> None:
    """Write a ROS 1 bag; one that is there already is replaced."""
    path.unlink(missing_ok=True)
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    writer.set_compression(Ros1Writer.CompressionFormat.BZ2)
    with writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=store)
                  for topic, kind in ((TORQUE_TOPIC, TORQUE_TYPE), (IMU_TOPIC, IMU_TYPE))}
        for log_ns, topic, message in messages(flight, store):
            connection = topics[topic]
            writer.write(connection, log_ns, store.serialize_ros1(message, connection.msgtype))


def main(folder: Path) -> None:
    """Write all three bags and the truth into `folder`."""
    flight = fly()
    write_ros2(folder / 'quadrotor_roll', flight, StoragePlugin.MCAP, CompressionMode.STORAGE)
    write_ros2(folder / 'quadrotor_roll_sqlite3', flight, StoragePlugin.SQLITE3,
               CompressionMode.FILE)
    write_ros1(folder / 'quadrotor_roll.bag', flight)
    storage.save_model(folder / 'quadrotor_roll_truth.json', true_model(), force=True)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
