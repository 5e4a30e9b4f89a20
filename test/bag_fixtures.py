# SPDX-License-Identifier: Apache-2.0
"""Small real bags in every container, and the messages in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
import shutil
from typing import Any

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag

CUSTOM = {
    'my_msgs/msg/Sample': 'uint8 flag\nfloat64 value\nstring note\nint16[3] triple\n',
    'my_msgs/msg/Flat': 'uint8 flag\nfloat64 value\nuint16 count\n',
    'my_msgs/msg/State': """
        string name
        std_msgs/Empty nothing
        Sample[] history
        Flat[] track
        Flat[2] pair
        string[] labels
        float32[] gains
        float64[<=4] few
        bool armed
        int8 mode
        uint64 ticks
        byte raw
        char letter
        Sample latest
        geometry_msgs/Quaternion attitude
        """,
}


def custom_store():
    """Return Jazzy's types and our own."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in CUSTOM.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


STORE = custom_store()
ROS1 = get_typestore(Stores.ROS1_NOETIC)
START = 1_700_000_000_000_000_000
IMU = 'sensor_msgs/msg/Imu'


@dataclass(frozen=True)
class Sent:
    """One message to be written."""

    topic: str
    type: str
    log_ns: int
    message: Any
    publish_ns: int | None = None


def make(name: str, /, **values: Any) -> Any:
    """Make a Jazzy or custom message; what is not given is zero or empty."""
    return _make(STORE, name, values)


def _make(store, name: str, values: dict[str, Any]) -> Any:
    fields = dict(store.fielddefs[name][1])
    filled = {field: values[field] if field in values else _zero(store, *description)
              for field, description in fields.items()}
    assert values.keys() <= filled.keys(), values.keys() - filled.keys()
    return store.types[name](**filled)


def _zero(store, node: int, content: Any) -> Any:
    if node == 1:
        return '' if content[0] == 'string' else 0
    if node == 2:
        return _make(store, content, {})
    (inner, name), count = content
    count = count if node == 3 else 0
    if inner == 1 and name[0] != 'string':
        return np.zeros(count, np.dtype({'char': 'uint8', 'byte': 'int8'}.get(*name[:1] * 2)))
    return [_zero(store, inner, name) for _ in range(count)]


def header(stamp_ns: int, frame: str = 'base', store=STORE, **more: Any) -> Any:
    stamp = store.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return _make(store, 'std_msgs/msg/Header', {'stamp': stamp, 'frame_id': frame, **more})


def header_stamp_ns(message: Any) -> int | None:
    """Return `message.header.stamp` [ns], or None where there is no such field."""
    stamp = getattr(getattr(message, 'header', None), 'stamp', None)
    return None if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)


def vector(x: float, y: float = 0.0, z: float = 0.0, store=STORE) -> Any:
    return store.types['geometry_msgs/msg/Vector3'](float(x), float(y), float(z))


def imu(stamp_ns: int, rate: float, frame: str = 'base', store=STORE) -> Any:
    return _make(store, 'sensor_msgs/msg/Imu', {
        'header': header(stamp_ns, frame, store), 'angular_velocity': vector(rate, store=store),
        'linear_acceleration': vector(0.1, 0.2, 9.81, store)})


def array(*values: float) -> Any:
    return make('std_msgs/msg/Float64MultiArray', data=np.array(values, float))


def joints(stamp_ns: int, position: Sequence[float], names: Sequence[str] | None = None) -> Any:
    position = np.array(position, float)
    return make('sensor_msgs/msg/JointState', header=header(stamp_ns, ''), position=position,
                name=list(names or [f'joint{i}' for i in range(len(position))]),
                velocity=10 * position, effort=-position)


def flight(count: int = 40, start_ns: int = START, step_ns: int = 5_000_000,
           log_late_ns: int = 1_000_000) -> list[Sent]:
    """Return a small recording: /imu with header, /cmd without at a quarter of its rate."""
    sent = []
    for k in range(count):
        stamp = start_ns + k * step_ns
        sent.append(Sent('/imu', 'sensor_msgs/msg/Imu', stamp + log_late_ns, imu(stamp, 0.01 * k)))
        if k % 4 == 0:
            sent.append(Sent('/cmd', 'std_msgs/msg/Float64MultiArray', stamp + log_late_ns,
                             array(k, -k, 0.5)))
    return sent


def write_rosbag2(folder: Path, sent: Iterable[Sent], storage: str = 'mcap',
                  compression: str = 'none', store=STORE) -> Path:
    """Write a rosbag2 folder; compression is none, file, message, or storage (MCAP chunks)."""
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for one in sent:
            if one.topic not in connections:
                connections[one.topic] = writer.add_connection(one.topic, one.type,
                                                               typestore=store)
            writer.write(connections[one.topic], one.log_ns,
                         store.serialize_cdr(one.message, one.type))
    return folder


def write_ros1(path: Path, sent: Iterable[Sent], compression: str = 'none',
               threshold: int = 2048) -> Path:
    """Write a ROS 1 bag of messages made with the store ROS1."""
    writer = Ros1Writer(path)
    writer.chunk_threshold = threshold
    if compression != 'none':
        writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
    with writer:
        connections: dict[str, Any] = {}
        for one in sent:
            if one.topic not in connections:
                connections[one.topic] = writer.add_connection(one.topic, one.type,
                                                               typestore=ROS1)
            writer.write(connections[one.topic], one.log_ns,
                         ROS1.serialize_ros1(one.message, one.type))
    return path


def flight_ros1(count: int = 40, start_ns: int = START) -> list[Sent]:
    """Return a small ROS 1 recording of /imu."""
    stamps = [start_ns + k * 5_000_000 for k in range(count)]
    return [Sent('/imu', 'sensor_msgs/msg/Imu', stamp + 1_000_000, imu(stamp, 0.01 * k, 'b', ROS1))
            for k, stamp in enumerate(stamps)]


def write_mcap(path: Path, sent: Iterable[Sent], compression: str = 'zstd',
               chunk_size: int = 2048, schema: tuple[str, bytes] | None = None,
               encoding: str = 'cdr', store=STORE, **options: Any) -> Path:
    """
    Write a bare MCAP file with the writer of the mcap library.

    `schema` (encoding, text) replaces that of every topic; `options` are those of the writer.
    """
    with path.open('wb') as file:
        writer = McapWriter(file, compression=CompressionType[compression.upper()],
                            chunk_size=chunk_size, **options)
        writer.start('ros2')
        channels: dict[str, int] = {}
        for one in sent:
            if one.topic not in channels:
                number = writer.register_schema(one.type, *(schema or (
                    'ros2msg', store.generate_msgdef(one.type, ros_version=2)[0].encode())))
                channels[one.topic] = writer.register_channel(one.topic, encoding, number)
            raw = one.message if isinstance(one.message, bytes) else bytes(
                store.serialize_cdr(one.message, one.type))
            writer.add_message(channels[one.topic], one.log_ns, raw,
                               one.publish_ns or one.log_ns)
        writer.finish()
    return path


def rows(path, topics=None) -> list[tuple[str, int, bytes]]:
    """Return what a bag gives: topic, log time, message."""
    with open_bag(path) as bag:
        return [(m.topic, m.log_ns, bytes(m.raw)) for m in bag.messages(topics)]


def written(sent: list[Sent]) -> list[tuple[str, int, bytes]]:
    """Return what it should give: by log time, equal ones as they were written."""
    return [(s.topic, s.log_ns, bytes(STORE.serialize_cdr(s.message, s.type)))
            for s in sorted(sent, key=lambda s: s.log_ns)]


def notes(path) -> str:
    with open_bag(path) as bag:
        for _ in bag.messages():
            pass
        return '\n'.join(bag.notes)


def numbers(path, topic: str, *texts: str) -> list[tuple[float, ...]]:
    with open_bag(path) as bag:
        extract = bag.extractor(topic, [parse_field(text) for text in texts])
        return [extract(m.raw)[1] for m in bag.messages([topic])]


def bare(folder: Path, suffix: str) -> Path:
    """Take the storage file out of a rosbag2 folder."""
    (file,) = folder.glob(f'*{suffix}')
    return Path(shutil.move(file, folder.parent / f'bare{suffix}'))


def refused(path) -> str:
    with pytest.raises(BagError) as error:
        open_bag(path)
    assert str(error.value).count(str(path)) <= 1
    return str(error.value)
