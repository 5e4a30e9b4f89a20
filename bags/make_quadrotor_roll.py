# SPDX-License-Identifier: Apache-2.0
"""
Make the example bags: the roll loop of a simulated quadrotor, and its true model.

Usage: python bags/make_quadrotor_roll.py [FOLDER]

What flies is `ctsid_ros.examples.quadrotor_roll`: torque commands at 50 Hz, an inertial sensor at
nominally 200 Hz. Commands and measurements have their own jittered stamps, are logged later than
they are stamped, and some measurements are lost.

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

from ctsid_core.model import storage
from ctsid_ros.examples.quadrotor_roll import (
    ANGLE_NOISE,
    COMMAND_RATE,
    GYRO_NOISE,
    GYRO_STEP,
    IMU_RATE,
    Motion,
    Plant,
    quantised,
)

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

SEED = 20250614
EPOCH_NS = 1_749_888_000_000_000_000  # 2025-06-14 08:00 UTC
DURATION = 40.0  # s
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
    command_times, imu_times = jittered(rng, COMMAND_RATE, 0.1), jittered(rng, IMU_RATE, 0.25)
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


def simulate(rng: np.random.Generator, command_ns: Stamps, imu_ns: Stamps, wanted: Array,
             noise: Array) -> tuple[Array, Array, Array]:
    """Return held torques at the commands, measured rates and roll angles at the sensor."""
    motion, events = Motion(rng), np.union1d(command_ns, imu_ns)
    torque, rate, roll = np.zeros(len(wanted)), np.zeros(len(noise)), np.zeros(len(noise))
    j = k = 0
    for time_ns, is_sample, is_command in zip(
            events, np.isin(events, imu_ns), np.isin(events, command_ns), strict=True):
        motion.move(int(time_ns))
        if is_sample:
            rate[j], roll[j] = motion.measure(GYRO_NOISE * noise[j, 0], ANGLE_NOISE * noise[j, 1])
            j += 1
        if is_command:
            torque[k] = motion.command(wanted[k])
            k += 1
    return torque, rate, roll


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
    storage.save_model(folder / 'quadrotor_roll_truth.json', Plant().true_model(), force=True)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
