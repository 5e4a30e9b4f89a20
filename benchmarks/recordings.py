# SPDX-License-Identifier: Apache-2.0
"""
Reading recordings: processor time and memory, beside rosbags in the same run.

300 000 messages of Imu, Float64MultiArray, JointState and Odometry (25 scalars of them are
wanted) among pictures that nobody wants, about 0.6 GB, in every container. Each case is a process
of its own, so that its memory is its own; cases of a container are interleaved.

- `floor`: read the file and decompress it, nothing else.
- `rosbags`: deserialize the wanted messages with rosbags, and keep log time and scalars.
- `columns`: the same into blocks of columns.
- `record`: on to a `Record`, through `Ingest`, as `ctsid identify` does.
- `one topic`: columns of /odom alone, 1 % of the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import os
from pathlib import Path
import resource
import subprocess
import sys
import tempfile
import time

os.environ |= {'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}

from common import machine, table  # noqa: E402
from mcap.writer import CompressionType  # noqa: E402
from mcap.writer import Writer as McapWriter  # noqa: E402
import numpy as np  # noqa: E402
from rosbags.highlevel import AnyReader  # noqa: E402
from rosbags.rosbag1 import Writer as Ros1Writer  # noqa: E402
from rosbags.rosbag2 import StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Ros2Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

START = 1_700_000_000_000_000_000
RATES = {'/imu': 500, '/command': 300, '/joints': 170, '/odom': 30, '/camera': 6.3}  # Hz
TYPES = {'/imu': 'sensor_msgs/msg/Imu', '/command': 'std_msgs/msg/Float64MultiArray',
         '/joints': 'sensor_msgs/msg/JointState', '/odom': 'nav_msgs/msg/Odometry',
         '/camera': 'sensor_msgs/msg/CompressedImage'}
FIELDS = {'/imu': ('angular_velocity.x', 'angular_velocity.y', 'angular_velocity.z',
                   'linear_acceleration.x', 'linear_acceleration.y', 'linear_acceleration.z'),
          '/command': ('data[0:6]',), '/joints': ('effort[0:7]',),
          '/odom': ('twist.twist.linear.x', 'twist.twist.linear.y', 'twist.twist.linear.z',
                    'twist.twist.angular.x', 'twist.twist.angular.y', 'twist.twist.angular.z')}
CONTAINERS = ('mcap zstd', 'mcap lz4', 'mcap none', 'sqlite3', 'ros1')
CASES = ('floor', 'rosbags', 'columns', 'record', 'one topic')
AIMS = {('mcap zstd', 'columns'): 10.0, ('mcap zstd', 'record'): 8.0, ('sqlite3', 'columns'): 8.0,
        ('sqlite3', 'record'): 6.0, ('ros1', 'columns'): 5.0}  # times less than rosbags


def schedule(count: int) -> Iterator[tuple[str, int, int]]:
    """Yield topic, number and log time of every message."""
    wanted = sum(rate for topic, rate in RATES.items() if topic != '/camera')
    stamps = {topic: START + (np.arange(int(count * rate / wanted)) * 1e9 / rate).astype(np.int64)
              for topic, rate in RATES.items()}
    log = np.concatenate(list(stamps.values()))
    which = np.repeat(np.arange(len(stamps)), [len(s) for s in stamps.values()])
    number = np.concatenate([np.arange(len(s)) for s in stamps.values()])
    names = list(stamps)
    for i in np.argsort(log, kind='stable'):
        yield names[which[i]], int(number[i]), int(log[i])


def payloads(count: int, ros1: bool) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time and message of everything."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    rng = np.random.default_rng(1)
    noise = rng.standard_normal(100_003)
    # Half of them are JPEG, which nothing compresses further, half raw with a camera's noise.
    pictures = [picture for _ in range(10) for picture in (
        rng.integers(0, 256, 307_200, dtype=np.uint8),
        np.clip(128 + 6 * rng.standard_normal(307_200), 0, 255).astype(np.uint8))]
    pack = store.serialize_ros1 if ros1 else store.serialize_cdr
    made = {}
    for topic, number, log_ns in schedule(count):
        kind = TYPES[topic]
        if topic not in made:
            made[topic] = _message(store, kind)
        message = made[topic]
        at = number % 100_000
        if hasattr(message, 'header'):
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(log_ns - 1_000_000, 10**9)
        if topic == '/imu':
            message.angular_velocity.x, message.linear_acceleration.z = noise[at], noise[at + 1]
        elif topic == '/command':
            message.data[:] = noise[number % 90_000:][:6]
        elif topic == '/joints':
            message.effort[:] = noise[number % 90_000:][:7]
        elif topic == '/odom':
            message.twist.twist.linear.x = noise[at]
        else:
            message.data = pictures[number % len(pictures)]
        yield topic, log_ns, bytes(pack(message, kind))


def _message(store, kind: str):
    """Make a message of zeros, with the arrays that a robot's have."""
    def make(name):
        return store.types[name](*(_zero(*field[1]) for field in store.fielddefs[name][1]))

    def _zero(node, content):
        if node == 1:
            return '' if content[0] == 'string' else 0
        if node == 2:
            return make(content)
        (inner, name), length = content
        return np.zeros(length if node == 3 else 0, name[0]) if inner == 1 and \
            name[0] != 'string' else []

    message = make(kind)
    if hasattr(message, 'header'):
        message.header.frame_id = 'base_link'
    if kind.endswith('JointState'):
        message.name = [f'arm_joint_{i}' for i in range(7)]
        message.position, message.velocity, message.effort = np.zeros((3, 7))
    elif kind.endswith('MultiArray'):
        message.data = np.zeros(6)
    return message


def write(folder: Path, container: str, count: int) -> Path:
    """Write the recording in one container."""
    path = folder / container.replace(' ', '_')
    kind, _, compression = container.partition(' ')
    if kind == 'mcap':
        path = path.with_suffix('.mcap')
        store = get_typestore(Stores.ROS2_JAZZY)
        with path.open('wb') as file:
            writer = McapWriter(file, compression=CompressionType[compression.upper()])
            writer.start('ros2')
            channels = {topic: writer.register_channel(topic, 'cdr', writer.register_schema(
                name, 'ros2msg', store.generate_msgdef(name, ros_version=2)[0].encode()))
                for topic, name in TYPES.items()}
            for topic, log_ns, raw in payloads(count, False):
                writer.add_message(channels[topic], log_ns, raw, log_ns)
            writer.finish()
        return path
    ros1 = kind == 'ros1'
    path = path.with_suffix('.bag') if ros1 else path
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    with Ros1Writer(path) if ros1 else Ros2Writer(
            path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {topic: writer.add_connection(topic, name, typestore=store)
                       for topic, name in TYPES.items()}
        for topic, log_ns, raw in payloads(count, ros1):
            writer.write(connections[topic], log_ns, raw)
    return path


def floor(path: Path) -> float:
    """Read all, decompress what is compressed, and compare checksums."""
    from contextlib import ExitStack
    import sqlite3

    from ctsid_ros.recordings.chunks import Room
    from ctsid_ros.recordings.files import scan_file
    from ctsid_ros.recordings.mcap_chunks import content_of
    if path.is_dir():
        (file,) = path.glob('*.db3')
        rows = sqlite3.connect(file).execute('SELECT timestamp, data FROM messages')
        return float(sum(len(data) for _, data in rows))
    with path.open('rb') as stream, ExitStack() as stack:
        if path.suffix != '.mcap':
            return float(sum(len(block) for block in iter(lambda: stream.read(1 << 20), b'')))
        room, (chunks,) = Room(), scan_file(path, stack).blocks.args[1:]
        return float(sum(len(content_of(stream, chunk, room.empty()).content)
                         for chunk in chunks))


def rosbags(path: Path) -> float:
    """Deserialize the wanted messages; keep log times and scalars."""
    times, rows = {t: [] for t in FIELDS}, {t: [] for t in FIELDS}
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic in FIELDS]
        for connection, log_ns, raw in reader.messages(wanted):
            m, topic = reader.deserialize(raw, connection.msgtype), connection.topic
            times[topic].append(log_ns)
            if topic == '/imu':
                w, a = m.angular_velocity, m.linear_acceleration
                rows[topic].append((w.x, w.y, w.z, a.x, a.y, a.z))
            elif topic == '/odom':
                w, a = m.twist.twist.linear, m.twist.twist.angular
                rows[topic].append((w.x, w.y, w.z, a.x, a.y, a.z))
            else:
                rows[topic].append(m.data if topic == '/command' else m.effort)
    return float(sum(np.array(r).sum() + len(r) for r in rows.values()))


def columns(path: Path, topics: tuple[str, ...] = tuple(FIELDS)) -> float:
    """Blocks of columns, and their sum."""
    from ctsid_ros.decoding.field_path import parse_field
    from ctsid_ros.recordings.bag import open_bag
    total = 0.0
    with open_bag(path) as bag:
        for block in bag.blocks({t: [parse_field(f) for f in FIELDS[t]] for t in topics}):
            total += sum(c.values.sum() + len(c.values) for c in block.columns)
        assert not bag.notes, bag.notes
    return float(total)


def record(path: Path) -> float:
    """Everything to a `Record`."""
    from ctsid_core import Settings
    from ctsid_ros.config.channels import Channel, Config
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.playback import read_record
    wanted = [(topic, text) for topic, texts in FIELDS.items() for text in texts]
    channels = tuple(
        Channel(f'c{i}', 'input' if topic == '/command' else 'output', topic, '', text)
        for i, (topic, text) in enumerate(wanted))
    with open_bag(path) as bag:
        found = read_record(bag, Config(channels, Settings())).record
    return float(sum(s.values.sum() + len(s.values) for s in (*found.inputs, *found.outputs)))


def one_topic(path: Path) -> float:
    return columns(path, ('/odom',))


def measured(path: Path, case: str) -> None:
    """Print the result, seconds of processor, and the largest memory [MB] of a case."""
    import ctsid_core  # noqa: F401  # what is loaded once is not counted
    import ctsid_ros.recordings.playback  # noqa: F401
    begin = time.process_time()
    result = globals()[case.replace(' ', '_')](path)
    spent = time.process_time() - begin
    print(result, spent, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('--messages', type=int, default=300_000)
    parser.add_argument('--containers', nargs='+', default=CONTAINERS[:1] + CONTAINERS[3:],
                        choices=CONTAINERS)
    parser.add_argument('--cases', nargs='+', default=CASES, choices=CASES)
    parser.add_argument('--rounds', type=int, default=3, help='of which the median is taken')
    parser.add_argument('--folder', type=Path, help='keep the recordings here, and use them again')
    parser.add_argument('--run', nargs=2, metavar=('FILE', 'CASE'), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run:
        measured(Path(args.run[0]), args.run[1])
        return
    rows = []
    with tempfile.TemporaryDirectory(dir=args.folder) as scratch:
        folder = args.folder or Path(scratch)
        for container in args.containers:
            rows += _rows(folder, container, args)
    print(machine())
    print(table(('container, case', 'us/message', 'x rosbags', 'aim', 'MB'), rows))


def _rows(folder: Path, container: str, args: argparse.Namespace) -> list[tuple[str, ...]]:
    made = list(folder.glob(container.replace(' ', '_') + '*'))
    path = made[0] if made else write(folder, container, args.messages)
    results, memory = {}, {}
    rounds: dict[str, list[float]] = {case: [] for case in args.cases}
    for case in args.rounds * list(args.cases):  # interleaved
        done = subprocess.run([sys.executable, __file__, '--run', path, case], check=True,
                              capture_output=True, text=True)
        results[case], spent, memory[case] = map(float, done.stdout.split())
        rounds[case].append(spent)
    seconds = {case: float(np.median(spent)) for case, spent in rounds.items()}
    rows = [(f'{container}, {case}', f'{seconds[case] / args.messages * 1e6:.2f}',
             f'{seconds.get("rosbags", np.nan) / seconds[case]:.1f}',
             f'{AIMS.get((container, case), "-")}', f'{memory[case]:.0f}') for case in args.cases]
    same = [results[case] for case in ('rosbags', 'columns') if case in results]
    if len(same) == 2 and not np.isclose(*same, rtol=1e-9):
        raise SystemExit(f'{container}: rosbags and columns differ: {same}')
    return rows


if __name__ == '__main__':
    main()
