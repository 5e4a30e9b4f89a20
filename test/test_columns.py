# SPDX-License-Identifier: Apache-2.0
"""Messages as columns: the same as one by one, on random types, contents and damage."""

from __future__ import annotations

from dataclasses import replace
import math

from bag_fixtures import (
    Sent,
    array,
    bare,
    flight_ros1,
    header,
    header_stamp_ns,
    imu,
    joints,
    make,
    write_mcap,
    write_ros1,
    write_rosbag2,
)
from marks import slow
import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ctsid_core.settings import Settings
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.decoding.block import Block, Located
from ctsid_ros.decoding.cdr import DecodeError, Extractor
from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.decoding.message_fields import scalar_fields
from ctsid_ros.ingest.ingest import Ingest
from ctsid_ros.recordings import chunks, sqlite_file
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.definitions import message_type
from ctsid_ros.recordings.recording import Connection

S = 10**9
EPOCH = 1_700_000_000 * S
NUMBERS = ('bool', 'byte', 'char', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'int64',
           'uint64', 'float32', 'float64')
IDL = {'bool': 'boolean', 'byte': 'octet', 'char': 'uint8', 'float32': 'float',
       'float64': 'double'}


class RandomType:
    """A message type of random fields, its messages, and its definition in two languages."""

    def __init__(self, rng: np.random.Generator, ros1: bool = False) -> None:
        self.rng, self.ros1 = rng, ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        self.inner = self.fields(NUMBERS + ('string',), '')
        self.outer = self.fields(NUMBERS + ('string', 'a_msgs/Inner'), 'o')
        self.has_header = bool(rng.integers(2))
        lines = ['std_msgs/Header header'] * self.has_header + self.lines(self.outer)
        self.text = '\n'.join(lines)
        inner = '\n'.join(self.lines(self.inner))
        self.store.register(get_types_from_msg(inner, 'a_msgs/msg/Inner'))
        self.store.register(get_types_from_msg(self.text, 'a_msgs/msg/Outer'))
        # Some shapes, as a robot has some; a few strings and lengths differ from time to time.
        self.shapes = [int(seed) for seed in rng.integers(1 << 30, size=rng.choice([1, 2, 20]))]

    def fields(self, bases, prefix):
        kinds = ('single', 'single', 'array', 'sequence')
        return [(f'{prefix}f{i}', str(self.rng.choice(bases)), str(self.rng.choice(kinds)))
                for i in range(self.rng.integers(1, 7))]

    @staticmethod
    def lines(fields):
        return [f'{base}{ {"single": "", "array": "[2]", "sequence": "[]"}[kind]} {name}'
                for name, base, kind in fields]

    def definition(self) -> str:
        return self.store.generate_msgdef('a_msgs/msg/Outer', ros_version=1 if self.ros1 else 2)[0]

    def idl(self) -> str:
        """Return the definition in IDL."""
        def struct(name, fields):
            members, types = [], []
            for field, base, kind in fields:
                base = base.replace('a_msgs/', 'a_msgs::msg::')
                base = 'std_msgs::msg::Header' if 'Header' in base else IDL.get(base, base)
                if kind == 'array':
                    types.append(f'typedef {base} {name}_{field}__2[2];')
                    base = f'{name}_{field}__2'
                members.append(f'sequence<{base}> {field};' if kind == 'sequence' else
                               f'{base} {field};')
            return ('module a_msgs { module msg {\n' + '\n'.join(types) + f'\nstruct {name} {{\n'
                    + '\n'.join(members) + '\n};\n};\n};\n')
        head = [('header', 'std_msgs/Header', 'single')] * self.has_header
        return '\n'.join(f'{"=" * 80}\nIDL: a_msgs/msg/{name}\n{struct(name, fields)}' for
                         name, fields in (('Outer', head + self.outer), ('Inner', self.inner)))

    def message(self, stamp_ns: int):
        shape = np.random.default_rng(self.rng.choice(self.shapes))
        return self.build('a_msgs/msg/Outer', shape, stamp_ns)

    def build(self, name, shape, stamp_ns):
        if name.endswith('Header'):
            more = {'seq': 7} if self.ros1 else {}
            return header(stamp_ns, 'x' * int(shape.integers(5)), self.store, **more)
        return self.store.types[name](*(self.value(*content, shape, stamp_ns)
                                        for _, content in self.store.fielddefs[name][1]))

    def value(self, node, content, shape, stamp_ns):
        if node == 1:
            base = content[0]
            return 'y' * int(shape.integers(6)) if base == 'string' else self.number(base)
        if node == 2:
            return self.build(content, shape, stamp_ns)
        (inner, name), count = content
        count = count if node == 3 else int(shape.integers(0, 4))
        values = [self.value(inner, name, shape, stamp_ns) for _ in range(count)]
        base = name[0] if inner == 1 else ''
        if inner == 1 and base != 'string':
            kind = {'char': 'uint8', 'byte': 'uint8'}.get(base, base)
            return np.array(values, {'byte': 'int8'}.get(base, kind) if self.ros1 else kind)
        return values

    def number(self, base):
        if base == 'bool':
            return bool(self.rng.integers(2))
        if base.startswith('float'):
            return float(np.float32(self.rng.normal())) if base == 'float32' else float(
                self.rng.normal())
        low, high = {'byte': (-128 * self.ros1, 128),
                     'char': (0, 256)}.get(base) or (
            np.iinfo(base).min, np.iinfo(base).max)
        return int(self.rng.integers(low, high, dtype=base if base[-1].isdigit() else 'int64'))

    def raw(self, message, little: bool = True) -> bytes:
        name = 'a_msgs/msg/Outer'
        return bytes(self.store.serialize_ros1(message, name) if self.ros1 else
                     self.store.serialize_cdr(message, name, little_endian=little))


def laid(rng, raws, parts: int = 3):
    """Lay messages into a few buffers, with something between them."""
    found = []
    for own in np.array_split(np.arange(len(raws)), parts):
        content, offsets = b'', []
        for i in own:
            content += rng.bytes(rng.integers(9))
            offsets.append(len(content))
            content += raws[i]
        times = np.arange(len(own))
        found.append(Located(0, content, np.array(offsets, int),
                             np.array([len(raws[i]) for i in own], int), times, times))
    return found


def one_by_one(extract: Extractor, raws):
    rows = []
    for raw in raws:
        try:
            rows.append(extract(raw))
        except DecodeError:
            rows.append(None)
    return rows


def same(columns, rows, has_header) -> None:
    assert columns.sound.tolist() == [row is not None for row in rows]
    assert (columns.header_ns is not None) == has_header
    for i, row in enumerate(rows):
        if row is not None:
            assert columns.values[i].tobytes() == np.array(row[1], float).tobytes()
            assert not has_header or columns.header_ns[i] == row[0]


@pytest.mark.parametrize('seed', [*range(12), *slow(*range(12, 400))])
def test_random_types_equal_rosbags_and_one_by_one(seed):
    rng = np.random.default_rng(seed)
    ros1, little = seed % 3 == 2, seed % 3 != 1
    kind = RandomType(rng, ros1)
    text, form = (kind.idl(), 'ros2idl') if seed % 6 == 0 else (
        kind.definition(), 'ros1msg' if ros1 else 'ros2msg')
    type_ = message_type(Connection(0, '/t', 'a_msgs/msg/Outer', 'ros1' if ros1 else 'cdr', form,
                                    text, 1))
    messages = [kind.message(int(t)) for t in rng.integers(1, 2**31 * S, 60)]
    raws = [kind.raw(message, little) for message in messages]
    fields = scalar_fields(type_, raws[0])
    fields = [fields[i] for i in rng.permutation(len(fields))[:9]]
    for path in fields:  # rosbags agrees, as far as a message has the element
        columns = Extractor(type_, [path]).columns(laid(rng, raws))
        for i, message in enumerate(messages):
            if columns.sound[i]:
                assert columns.values[i].tolist() == path.get(message)
                assert type_.has_header is False or \
                    columns.header_ns[i] == header_stamp_ns(message)
            else:
                assert '[' in str(path)
    spoilt = list(raws)
    for i in rng.integers(0, len(raws), 12):
        spoilt[i] = [raws[i][:rng.integers(len(raws[i]))], b'\0\7' + raws[i][2:], rng.bytes(40),
                     b''][rng.integers(4)]
    rows = one_by_one(Extractor(type_, fields), spoilt)
    assert any(row is not None for row in rows)
    same(Extractor(type_, fields).columns(laid(rng, spoilt)), rows, type_.has_header)
    used = Extractor(type_, fields)
    one_by_one(used, spoilt[:20])
    same(used.columns(laid(rng, spoilt)), rows, type_.has_header)


def test_other_encodings_and_wide_strings_are_rows_that_are_not_sound():
    kind = message_type(Connection(0, '/t', 'a_msgs/msg/A', 'cdr', 'ros2msg',
                                   'float64 before\nwstring name\nfloat64 after\n', 1))
    body = np.array([1.5]).tobytes() + b'\2\0\0\0x\0y\0' + np.array([2.5]).tobytes()
    parts = laid(np.random.default_rng(0), [b'\0\1\0\0' + body, b'\0\7\0\0' + body])
    before = Extractor(kind, [parse_field('before')]).columns(parts)
    assert before.sound.tolist() == [True, False]
    assert before.values[0] == 1.5
    after = Extractor(kind, [parse_field('after')]).columns(parts)
    assert after.sound.tolist() == [False, False]
    assert after.values.shape == (2, 1)


CONTAINERS = {
    'zstd': lambda p, sent: write_mcap(p / 'b.mcap', sent, 'zstd'),
    'lz4': lambda p, sent: write_mcap(p / 'b.mcap', sent, 'lz4'),
    'none': lambda p, sent: write_mcap(p / 'b.mcap', sent, 'none', enable_crcs=False),
    'no chunks': lambda p, sent: write_mcap(p / 'b.mcap', sent, use_chunking=False),
    'no index': lambda p, sent: without_index(write_mcap(p / 'b.mcap', sent, 'none')),
    'sqlite3': lambda p, sent: bare(write_rosbag2(p / 'b', sent, 'sqlite3'), '.db3'),
    'messages packed': lambda p, sent: write_rosbag2(p / 'b', sent, 'sqlite3', 'message'),
}


def without_index(path):
    """Make the index records behind chunks records of an unknown kind."""
    data = bytearray(path.read_bytes())
    position = 8
    while position + 9 < len(data) - 8:
        data[position] = 0x7f if data[position] == 7 else data[position]
        position += 9 + int.from_bytes(data[position + 1:position + 9], 'little')
    path.write_bytes(data)
    return path


def shuffled(count: int = 400, seed: int = 1):
    """Messages of four topics: log times out of order and equal, frames and lengths differ."""
    rng = np.random.default_rng(seed)
    sent = []
    for k in range(count):
        stamp = EPOCH + int(rng.integers(0, 40)) * S // 100 + k * S // 200
        log = stamp + int(rng.integers(-3, 4)) * S // 100
        pick = rng.integers(4)
        frame = 'abcdefghijklmnopqrstuvwxyz'[:int(rng.integers(3) * (k % 50 == 0))]
        sent.append(
            Sent('/imu', 'sensor_msgs/msg/Imu', log, imu(stamp, k, frame)) if pick == 0 else
            Sent('/cmd', 'std_msgs/msg/Float64MultiArray', log, array(
                *rng.normal(size=3 if k % 37 else 2))) if pick == 1 else
            Sent('/joints', 'sensor_msgs/msg/JointState', log, joints(
                stamp, rng.normal(size=2), ['a', 'bb'] if k % 5 else ['ccc', 'dddddddd'])) if
            pick == 2 else
            Sent('/other', 'std_msgs/msg/String', log, make('std_msgs/msg/String', data='x' * k)))
    return sent


FIELDS = {'/imu': ['angular_velocity.x', 'linear_acceleration.z'], '/cmd': ['data[0:3]'],
          '/joints': ['effort[1]', 'position[0]']}


@pytest.mark.parametrize('batch', [5000, *slow(1, 1 << 20)])
@pytest.mark.parametrize('container', CONTAINERS)
def test_blocks_of_a_bag_equal_its_messages(tmp_path, container, batch, monkeypatch):
    monkeypatch.setattr(chunks, 'BATCH', batch)
    monkeypatch.setattr(sqlite_file, 'BATCH', batch)
    path = CONTAINERS[container](tmp_path, shuffled())
    fields = {topic: [parse_field(text) for text in texts] for topic, texts in FIELDS.items()}
    with open_bag(path) as bag:
        got = [row for block in bag.blocks(fields) for row in rows_of(block)]
        extract = {topic: bag.extractor(topic, paths) for topic, paths in fields.items()}
        wanted = [(m.topic, m.log_ns, m.publish_ns, *(one_by_one(extract[m.topic], [m.raw])))
                  for m in bag.messages(fields)]
        assert len(bag.notes) == 2
        assert all(note.startswith('topic /joints: ') and note.endswith('by its name instead')
                   for note in bag.notes)
    assert len(got) > 250
    assert [row[:3] for row in got] == [row[:3] for row in wanted]
    assert [row[1] for row in got] == sorted(row[1] for row in got)
    for (*_, a), (*_, b) in zip(got, wanted, strict=True):
        assert (a is None) == (b is None)
        assert a is None or (a[0] == b[0] and a[1].tobytes() == np.array(b[1]).tobytes())


def rows_of(block: Block):
    """Yield topic, log and publish time, and what was decoded, in order."""
    iterators = [iter(range(len(c))) for c in block.columns]
    for number in block.which:
        rows, i = block.columns[number], next(iterators[number])
        stamp = None if rows.header_ns is None else int(rows.header_ns[i])
        yield (rows.topic, int(rows.log_ns[i]), int(rows.publish_ns[i]),
               (stamp, rows.values[i]) if rows.sound[i] else None)


@pytest.mark.parametrize('compression', ['none', 'lz4', 'bz2'])
def test_blocks_of_a_ros1_bag(tmp_path, compression):
    path = write_ros1(tmp_path / 'b.bag', flight_ros1(300), compression)
    with open_bag(path) as bag:
        blocks = list(bag.blocks({'/imu': [parse_field('angular_velocity.x')]}))
    rates = np.concatenate([block.columns[0].values[:, 0] for block in blocks])
    np.testing.assert_array_equal(rates, [0.01 * k for k in range(300)])
    stamps = np.concatenate([block.columns[0].header_ns for block in blocks])
    assert stamps.tolist() == [s.log_ns - 1_000_000 for s in flight_ros1(300)]


def test_bags_that_overlap_are_merged_as_messages_are(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, 'BATCH', 3000)
    sent = shuffled(900, 3)
    for k in range(3):
        write_mcap(tmp_path / f'{k}.mcap', sorted(
            sent[k::3], key=lambda s: s.log_ns), chunk_size=1500)
    fields = {topic: [parse_field(text) for text in texts] for topic, texts in FIELDS.items()}
    with open_bag(tmp_path) as bag:
        blocks = list(bag.blocks(fields))
        assert len(blocks) > 20
        times = np.concatenate([block.log_ns for block in blocks])
        assert times.tolist() == sorted(
            s.log_ns for s in sent if s.topic in fields)
        assert [m.log_ns for m in bag.messages(fields)] == times.tolist()


def test_a_block_is_cut_and_merged_in_order():
    content = bytes(100)
    found = [Located(slot, content, np.array(at), np.array([1] * len(at)),
                     np.array(log, np.int64), np.array(log, np.int64))
             for slot, at, log in ((0, [3, 9, 30], [5, 1, 7]), (1, [4, 20], [5, 7]))]

    def places(parts):
        at = np.concatenate([part.offsets for part in parts]) if parts else np.empty(0, int)
        return None, at, np.ones(len(at), bool)

    block = Block.of(found, ('a', 'b'), (places, places))
    assert block.log_ns.tolist() == [1, 5, 5, 7, 7]
    assert block.which.tolist() == [0, 0, 1, 1, 0]
    for at in range(6):
        first, rest = block.split(at)
        again = first.merged(rest)
        assert (len(first), len(rest)) == (at, 5 - at)
        assert again.which.tolist() == block.which.tolist()
        assert [c.values.tolist() for c in again.columns] == [[9, 3, 30], [4, 20]]


def nasty(seed: int, count: int = 3000, rare: float | None = None):
    """Messages of two topics that are late, doubled, astray, not finite, short, restarted."""
    rng = np.random.default_rng(seed)
    stamp, messages = EPOCH, []
    rare = rng.choice([0.0, 0.003, 0.05, 0.4]) if rare is None else rare
    for k in range(count):
        stamp += int(rng.integers(1, 20)) * S // 1000
        topic = '/imu' if rng.random() < 0.7 else '/cmd'
        values = rng.normal(size=3 if topic == '/imu' else 1)
        own, header_ns, sound = stamp, stamp - S // 100, True
        if rng.random() < rare:
            fault = rng.integers(9)
            if fault == 0:
                header_ns -= int(rng.integers(S))
            elif fault == 1:
                header_ns = messages[-1][3] if messages and messages[-1][3] else 0
            elif fault == 2:
                header_ns += int(rng.integers(-10, 10)) * 10**13
            elif fault == 3:
                values[rng.integers(len(values))] = rng.choice([math.nan, math.inf, 1.7e308])
            elif fault == 4:
                sound = False
            elif fault == 5:
                header_ns = int(rng.choice([0, -5, 2**62, 2**63 - 1]))
            elif fault == 6 and k > 100:
                stamp -= int(rng.integers(5)) * S
            elif fault == 7:
                stamp += int(rng.integers(5)) * S
            else:
                own -= int(rng.integers(3)) * S // 10
        messages.append((topic, own, own + 5, header_ns if topic == '/imu' else None,
                         tuple(values.tolist()) if sound else ()))
    if seed % 4 == 2:  # those of the first stand still, for long enough or not
        messages[:8 * seed] = [(*m[:3], m[3] and EPOCH, m[4]) for m in messages[:8 * seed]]
    if seed % 2:  # no stamps in the first headers
        messages[:seed] = [(*m[:3], m[3] and 0, m[4]) for m in messages[:seed]]
    return messages


def blocks_of(messages, rng):
    """Yield the messages in blocks of random lengths."""
    from ctsid_ros.decoding.block import Columns
    topics, widths = ('/imu', '/cmd', '/none'), (3, 1, 1)
    while messages:
        count = int(rng.choice([1, 7, 40, 900]))
        now, messages = messages[:count], messages[count:]
        columns = []
        for topic, width in zip(topics, widths, strict=True):
            own = [m for m in now if m[0] == topic]
            values = np.array([m[4] or (math.nan,) * width for m in own]).reshape(-1, width)
            columns.append(Columns(
                topic, np.array([m[1] for m in own], np.int64),
                np.array([m[2] for m in own], np.int64),
                np.array([m[3] for m in own], np.int64) if topic == '/imu' else None, values,
                np.array([bool(m[4]) for m in own], bool)))
        yield Block(np.array([topics.index(m[0]) for m in now], np.intp), tuple(columns[:2]))


@pytest.mark.parametrize('seed', [*range(3), *slow(*range(3, 200))])
def test_ingest_takes_blocks_as_it_takes_messages(seed):
    u = Channel('u', 'input', '/cmd', '', 'data[0]')
    p = Channel('p', 'output', '/imu', '', 'a[0:2]')
    parted = replace(p, name='w', role='input' if seed % 3 else 'output', field='a[2]',
                     stamp='auto' if seed % 5 else 'publish')
    config = Config((u, p, parted), Settings(window_length=2.0, window_stride=0.5,
                                             window_max_delay=0.1))
    one, many = Ingest(config), Ingest(config)
    messages = nasty(seed)
    wanted, got = [], []
    for message in messages:
        one.push(*message)
        wanted += one.due()
    for block in blocks_of(messages, np.random.default_rng(seed)):
        many.push_block(block)
        got += many.due()
    assert one.newest_ns == many.newest_ns
    wanted += one.flush()
    got += many.flush()
    assert len(wanted) > 3
    assert one.counts() == many.counts()
    for a, b in zip(wanted, got, strict=True):
        assert (a.epoch_ns, a.start, a.end) == (b.epoch_ns, b.start, b.end)
        for x, y in zip(a.inputs + a.outputs, b.inputs + b.outputs, strict=True):
            assert x.time.tobytes() == y.time.tobytes()
            assert x.values.tobytes() == y.values.tobytes()


def test_most_samples_are_taken_at_once(monkeypatch):
    """Else blocks are of no use; those that are out of order are few, and go one by one."""
    from ctsid_core.signals.windows import SlidingWindow
    pushed = []
    push = SlidingWindow.push
    monkeypatch.setattr(SlidingWindow, 'push',
                        lambda *args: pushed.append(args) or push(*args))
    u = Channel('u', 'input', '/cmd', '', 'data[0]')
    p = Channel('p', 'output', '/imu', '', 'a[0:3]')
    messages = nasty(0, 4000, 0.0)
    messages[2000] = (*messages[2000][:3], 5, messages[2000][4])
    ingest = Ingest(Config((u, p), Settings(window_length=2.0)))
    monkeypatch.setattr(ingest, '_push', ingest._window.push)
    for block in blocks_of(messages, np.random.default_rng(1)):
        ingest.push_block(block)
    assert len(pushed) < 300
