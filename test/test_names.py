# SPDX-License-Identifier: Apache-2.0
"""Elements that are chosen by name, in messages, bags and windows."""

from __future__ import annotations

from dataclasses import replace
import math

from bag_fixtures import (
    ROS1,
    START,
    Sent,
    array,
    header,
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
from test_cdr import raw_of, type_of
from test_columns import laid, one_by_one

from ctsid_core.settings import Settings
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.config.parameter_text import dump_config
from ctsid_ros.decoding.cdr import ABSENT, DecodeError, Extractor
from ctsid_ros.decoding.field_path import FieldError, parse_field
from ctsid_ros.decoding.message_fields import bind
from ctsid_ros.decoding.names import mixed, title
from ctsid_ros.errors import BagError
from ctsid_ros.ingest.feed import Feed, Taken
from ctsid_ros.ingest.ingest import Ingest
from ctsid_ros.ingest.recent import Recent
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.guess import by_names, guess
from ctsid_ros.recordings.guess_named import named
from ctsid_ros.recordings.playback import Interval, play, read_record
from ctsid_ros.recordings.survey import survey
from ctsid_ros.replay.replay import Replay

S = 10**9
JOINTS = 'sensor_msgs/msg/JointState'
ARRAY = 'std_msgs/msg/Float64MultiArray'
MORE = {
    'control_msgs/msg/InterfaceValue': 'string[] interface_names\nfloat64[] values\n',
    'control_msgs/msg/DynamicJointState':
        'std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n',
    'my_msgs/msg/Late': 'float64[2] position\nint16[2] raw\nstring[2] names\n'
                        'geometry_msgs/Quaternion[2] turns\n',
}


def store_of_more():
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in MORE.items():
        store.register(get_types_from_msg(text, name))
    return store


STORE = store_of_more()


def extractor(kind: str, *texts: str, store=STORE) -> Extractor:
    return Extractor(type_of(kind, store), [parse_field(text) for text in texts])


def states(count: int = 400, store=None, seed: int = 0):
    """Return the messages of two publishers with other joints, one of which changes the order."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(count):
        names = ['shoulder', 'elbow', 'wrist'] if k % 5 else ['finger']
        names = list(rng.permutation(names)) if k > count // 2 else names
        values = rng.normal(size=len(names))
        found.append((dict(zip(names, values, strict=True)), joints(k + 1, values, names)))
    return found


@pytest.mark.parametrize('little', [True, False])
def test_an_element_is_found_wherever_its_name_is(little):
    sent = states()
    raws = [raw_of(message, little) for _, message in sent]
    fields = ('position[elbow]', 'velocity[elbow]', 'position[finger]', 'effort[0]')
    extract = extractor(JOINTS, *fields)
    rows = [extract(raw) for raw in raws]
    for (values, message), (stamp, scalars) in zip(sent, rows, strict=True):
        elbow, finger = (values.get(name, math.nan) for name in ('elbow', 'finger'))
        np.testing.assert_array_equal(scalars, [elbow, 10 * elbow, finger, message.effort[0]])
        assert [scalar is ABSENT for scalar in scalars] == [
            'elbow' not in values, 'elbow' not in values, 'finger' not in values, False]
        assert stamp == message.header.stamp.nanosec
    for again in (extractor(JOINTS, *fields), extract):
        columns = again.columns(laid(np.random.default_rng(1), raws))
        assert columns.sound.all()
        np.testing.assert_array_equal(columns.values, [scalars for _, scalars in rows])
        assert columns.absent.tolist() == [[x is ABSENT for x in scalars] for _, scalars in rows]
        assert columns.header_ns.tolist() == [stamp for stamp, _ in rows]


def test_names_of_equal_length_are_told_apart():
    extract = extractor(JOINTS, 'position[a1]')
    for names in (['a1', 'b1'], ['b1', 'a1'], ['b2', 'a1'], ['a1', 'a2']):
        values = [1.0 if name == 'a1' else 2.0 for name in names]
        assert extract(raw_of(joints(1, values, names)))[1] == (1.0,)
    assert extract(raw_of(joints(1, [1.0, 2.0], ['a2', 'a3'])))[1][0] is ABSENT
    assert extract(raw_of(joints(1, [], [])))[1][0] is ABSENT
    assert extract(raw_of(joints(1, [3.0, 4.0], ['', 'a1'])))[1] == (4.0,)


def test_a_name_without_its_number_is_a_message_that_cannot_be_decoded():
    message = joints(1, [1.0, 2.0])
    message.effort = np.empty(0)
    extract = extractor(JOINTS, 'effort[joint1]')
    with pytest.raises(DecodeError, match='0 elements'):
        extract(raw_of(message))
    columns = extract.columns(laid(np.random.default_rng(0), [raw_of(message)] * 3))
    assert not columns.sound.any()
    assert not columns.absent.any()


def test_ros1_angles_integers_and_names_that_come_last():
    state = ROS1.types[JOINTS](
        header(5 * S, store=ROS1, seq=1), ['a', 'bc'], np.array([1.0, 2.0]), np.zeros(2),
        np.zeros(2))
    extract = extractor(JOINTS, 'position[bc]', store=ROS1)
    assert extract(ROS1.serialize_ros1(state, JOINTS)) == (5 * S, (2.0,))
    turn = STORE.types['geometry_msgs/msg/Quaternion']
    late = STORE.types['my_msgs/msg/Late'](
        np.array([1.0, 2.0]), np.array([3, 4], np.int16), ['a', 'b'],
        [turn(0.0, 0.0, 0.0, 1.0), turn(0.0, 0.0, math.sin(0.25), math.cos(0.25))])
    raw = bytes(STORE.serialize_cdr(late, 'my_msgs/msg/Late'))
    extract = extractor('my_msgs/msg/Late', 'euler(turns[b]).yaw', 'raw[b]', 'euler(turns[c])')
    for scalars in (extract(raw)[1], extract.columns(
            laid(np.random.default_rng(0), [raw] * 4)).values[2]):
        np.testing.assert_allclose(scalars, [0.5, 4.0, *[math.nan] * 3], rtol=1e-15)


def test_names_around_an_array_and_names_within_names():
    points = [make('trajectory_msgs/msg/JointTrajectoryPoint', positions=np.array([x, 2 * x]))
              for x in (1.0, 2.0)]
    plan = make('trajectory_msgs/msg/JointTrajectory', joint_names=['a', 'b'], points=points)
    assert extractor('trajectory_msgs/msg/JointTrajectory', 'points[1].positions[b]')(
        raw_of(plan))[1] == (4.0,)
    value = STORE.types['control_msgs/msg/InterfaceValue']
    state = STORE.types['control_msgs/msg/DynamicJointState'](
        header(7), ['a', 'b'], [value(['position'], np.array([1.0])),
                                value(['effort', 'position'], np.array([2.0, 3.0]))])
    raw = bytes(STORE.serialize_cdr(state, 'control_msgs/msg/DynamicJointState'))
    extract = extractor('control_msgs/msg/DynamicJointState', *(
        f'interface_values[{joint}].values[{value}]'
        for joint, value in (('b', 'position'), ('a', 'effort'), (1, 0))))
    stamp, scalars = extract(raw)
    assert (stamp, scalars[0], scalars[2]) == (7, 3.0, 2.0)
    assert scalars[1] is ABSENT
    open_ = parse_field('interface_values[b].values[:]')
    assert str(bind(extract.message_type, open_, raw)) == 'interface_values[b].values[0:2]'


def test_a_type_without_names_is_said():
    with pytest.raises(FieldError, match=r'has no array of names .* choose by index: data\[0\]'):
        extractor(ARRAY, 'data[elbow]')
    with pytest.raises(FieldError, match='not an array'):
        extractor('sensor_msgs/msg/Imu', 'angular_velocity[x]')


def test_damaged_messages_one_by_one_and_as_columns():
    rng = np.random.default_rng(2)
    raws = [raw_of(message) for _, message in states(300)]
    for i in rng.integers(0, len(raws), 120):
        spoilt = bytearray(raws[i])
        spoilt[rng.integers(len(spoilt))] ^= 1 << rng.integers(8)
        raws[i] = bytes(spoilt[:rng.integers(4, len(spoilt) + 1)])
    fields = ('position[elbow]', 'velocity[0]', 'effort[finger]')
    rows = one_by_one(extractor(JOINTS, *fields), raws)
    columns = extractor(JOINTS, *fields).columns(laid(rng, raws))
    assert columns.sound.tolist() == [row is not None for row in rows]
    assert 200 < np.count_nonzero(columns.sound) < 300
    for i in np.flatnonzero(columns.sound):
        np.testing.assert_array_equal(columns.values[i], rows[i][1])
        assert columns.absent[i].tolist() == [x is ABSENT for x in rows[i][1]]


def arm(seconds: float = 12.0, *, gripper: bool = True, seed: int = 3) -> list[Sent]:
    """
    Return a recording of an elbow, w' = -3 w + 6 u, that moves beside others.

    The arm is published at 100 Hz, its joints change their order half-way; a gripper at 10 Hz.
    """
    rng = np.random.default_rng(seed)
    sent, w, step = [], 0.0, math.exp(-0.03)
    for k in range(round(100 * seconds)):
        stamp = START + k * S // 100
        if k % 20 == 0:
            u = float(rng.choice([-1.0, -0.5, 0.5, 1.0]))
            sent.append(Sent('/torque', ARRAY, stamp, array(u)))
        pair = {'shoulder': math.sin(k / 5), 'elbow': w + 0.01 * rng.normal()}
        names = sorted(pair, reverse=k < 50 * seconds)
        sent.append(Sent('/joint_states', JOINTS, stamp + 1000, joints(
            stamp, [0.1 * pair[name] for name in names], names)))  # velocity is ten times that
        if gripper and k % 10 == 3:
            sent.append(Sent('/joint_states', JOINTS, stamp + 2000, joints(
                stamp + 2_000_000, [0.0], ['finger'])))
        w = step * w + 2 * (1 - step) * u
    return sent


def config(*fields: str) -> Config:
    outputs = [Channel(f'w{i}', 'output', '/joint_states', JOINTS, field)
               for i, field in enumerate(fields)]
    return Config((Channel('torque', 'input', '/torque', ARRAY, 'data[0]'), *outputs), Settings(
        window_length=4.0, window_stride=2.0, window_max_delay=0.2, order=1, feedthrough=False))


def in_ros1(sent: list[Sent]) -> list[Sent]:
    def other(one: Sent) -> Sent:
        old, kind = one.message, ROS1.types[one.type]
        if one.type == ARRAY:
            layout = ROS1.types['std_msgs/msg/MultiArrayLayout']([], 0)
            return replace(one, message=kind(layout, old.data))
        stamp = old.header.stamp.sec * S + old.header.stamp.nanosec
        return replace(one, message=kind(header(stamp, store=ROS1, seq=0), old.name,
                                         old.position, old.velocity, old.effort))
    return [other(one) for one in sent]


@pytest.mark.parametrize('container', [
    'two files', *slow('mcap', 'sqlite3', 'packed', 'ros1')])
def test_of_two_publishers_and_a_changed_order_the_joint_is_read(tmp_path, container):
    sent = arm()
    path = {
        'mcap': lambda: write_mcap(tmp_path / 'b.mcap', sent),
        'sqlite3': lambda: write_rosbag2(tmp_path / 'b', sent, 'sqlite3'),
        'packed': lambda: write_rosbag2(tmp_path / 'b', sent, 'sqlite3', 'message'),
        'ros1': lambda: write_ros1(tmp_path / 'b.bag', in_ros1(sent)),
        'two files': lambda: [write_mcap(tmp_path / 'a.mcap', sent[:700]),
                              write_mcap(tmp_path / 'c.mcap', sent[700:])]}[container]()
    with open_bag(path) as bag:
        found = read_record(bag, config('velocity[elbow]'))
        assert not bag.notes
        replay = Replay(bag, config('velocity[elbow]'))
        replay.run()
    assert not found.complaints
    assert len(found.record.outputs[0].time) == pytest.approx(1200, abs=5)
    assert found.counts.channels['w0'].absent == 120
    assert len(replay.results) == 4
    for result in replay.results:
        assert result.estimate.good
        assert result.estimate.model.poles.real == pytest.approx([-3.0], abs=0.05)


def test_by_index_the_recording_says_that_joints_are_mixed(tmp_path):
    with open_bag(write_mcap(tmp_path / 'b.mcap', arm())) as bag:
        read_record(bag, config('velocity[0]'))
        assert bag.notes == ('topic /joint_states: `velocity[0]` is velocity[shoulder] in some '
                             'messages and velocity[finger] in others; choose one of them by '
                             'its name instead',)
    with open_bag(write_mcap(tmp_path / 'c.mcap', arm(gripper=False))) as bag:
        read_record(bag, config('velocity[0]'))
        assert 'velocity[elbow] in others' in bag.notes[0]
    with open_bag(write_mcap(tmp_path / 'd.mcap', arm(gripper=False)[:600])) as bag:
        read_record(bag, config('velocity[0]'))
        assert not bag.notes


def test_a_name_that_no_message_has_is_said_with_those_that_there_are(tmp_path):
    path = write_mcap(tmp_path / 'b.mcap', arm())
    with open_bag(path) as bag, pytest.raises(BagError) as error:
        read_record(bag, config('velocity[elbo]'))
    assert str(error.value) == ('`w0`: topic /joint_states: no message has `velocity[elbo]`; '
                                'nearest: elbow; also: shoulder, finger')


def test_joints_that_come_together_are_one_signal_and_others_have_their_own(tmp_path):
    with open_bag(write_mcap(tmp_path / 'b.mcap', arm())) as bag:
        record = read_record(bag, config(
            'velocity[elbow]', 'position[shoulder]', 'velocity[finger]')).record
    assert [signal.names for signal in record.outputs] == [('w0', 'w1'), ('w2',)]
    both, finger = record.outputs
    assert len(both.time) == pytest.approx(10 * len(finger.time), abs=10)
    k = np.round((both.time + (record.epoch_ns - START) * 1e-9) * 100)
    np.testing.assert_allclose(both.values[:, 1], 0.1 * np.sin(k / 5), atol=1e-12)
    assert not finger.values.any()


def taken(one: Sent) -> Taken:
    return Taken(one.log_ns, one.topic, raw_of(one.message), one.log_ns)


def live(sent: list[Sent], made: Config) -> tuple[Feed, list]:
    feed = Feed(made, {JOINTS_TOPIC: type_of(JOINTS), '/torque': type_of(ARRAY)}, lambda topic: 1)
    batch = [taken(one) for one in sent]
    return feed, feed.take(batch, batch[-1].arrival_ns)


JOINTS_TOPIC = '/joint_states'


def test_windows_live_equal_those_of_a_bag(tmp_path):
    sent, made = arm(), config('velocity[elbow]', 'velocity[shoulder]', 'velocity[finger]')
    feed, records = live(sent, made)
    ingest, windows = Ingest(made), []
    with open_bag(write_mcap(tmp_path / 'b.mcap', sent)) as bag:
        for _ in play(bag, ingest, Interval()):
            windows += ingest.due()
    assert len(records) == len(windows) == 4
    assert not feed.report()
    assert feed.counts() == ingest.counts()
    for one, other in zip(records, windows, strict=True):
        for a, b in zip(one.outputs, other.outputs, strict=True):
            assert a.names == b.names
            assert (a.time.tobytes(), a.values.tobytes()) == (b.time.tobytes(), b.values.tobytes())


def test_live_says_what_the_names_show():
    feed, records = live(arm(), config('velocity[0]', 'velocity[elbo]'))
    assert not records
    said = [
        '`w0`: topic /joint_states: `velocity[0]` is velocity[shoulder] in some messages and '
        'velocity[finger] in others; choose one of them by its name instead',
        '`w1`: topic /joint_states: no message has `velocity[elbo]`; nearest: elbow; also: '
        'shoulder, finger']
    assert feed.report() == said
    recent = Recent(4.0)
    assert feed.report(recent.added(0, feed.totals())) == said
    for seconds in (2, 6):
        lines = feed.report(recent.added(seconds * S, feed.totals()))
        assert all('no message has come' in line for line in lines)


def test_a_swap_between_two_looks_is_said_until_it_is_long_past():
    sent, recent = arm(gripper=False), Recent(4.0)
    feed, _ = live(sent[:500], config('velocity[0]'))
    for seconds, first, end in ((0, 500, 550), (1, 550, 600), (2, 640, 650), (4, 650, 660),
                                (6, 660, 670)):
        feed.take([taken(one) for one in sent[first:end]], 2**62)
        some = recent.added(seconds * S, feed.totals())
        assert bool(mixed(parse_field('velocity[0]'), some.called[JOINTS_TOPIC])) == (
            seconds in (2, 4))
    feed, _ = live(arm(), config('velocity[elbo]'))
    assert not any('no message has come' in line for line in feed.report())


def test_guesses_name_joints(tmp_path):
    """Of two publishers, whose joints change their order: the parameter file is by name."""
    with open_bag(write_mcap(tmp_path / 'b.mcap', arm(20.0))) as bag:
        found = survey(bag)
        joint_states, = (topic for topic in found.topics if topic.info.name == JOINTS_TOPIC)
        assert {f.field for f in joint_states.fields} == {
            f'{what}[{joint}]' for what in ('position', 'velocity', 'effort')
            for joint in ('elbow', 'shoulder', 'finger')}
        assert all(f.finite == 1.0 for f in joint_states.fields)
        assert not joint_states.undecodable
        assert [f.index for f in joint_states.fields if f.field.startswith('velocity')] == [
            'velocity[0]', 'velocity[1]', '']
        chosen = guess(bag, found, named=named(found, ['/torque'], ['velocity[elbow]'])).config
        by_index = named(found, ['data[0]'], ['velocity[0:2]', 'effort[{elbow,shoulder}]'])
        assert by_names(bag, {(JOINTS_TOPIC, 'velocity[1]'), ('/torque', 'data[0]')}) == {
            (JOINTS_TOPIC, 'velocity[elbow]'), ('/torque', 'data[0]')}
        assert not bag.notes
    output, = chosen.outputs
    assert (output.name, output.field, output.unit) == (
        'elbow_velocity', 'velocity[elbow]', '')
    assert "field: 'velocity[elbow]'" in dump_config(chosen)
    assert [field for _, field in by_index.outputs] == [
        'velocity[shoulder]', 'velocity[elbow]', 'effort[elbow]', 'effort[shoulder]']


@pytest.mark.parametrize(('names', 'fields'), [
    (['a', 'a'], ['position[0]', 'position[1]']), (['', 'b'], ['position[0]', 'position[b]']),
    (['1', 'x y'], ["position['1']", "position['x y']"]), (['a]', 'b'], ['position[0]',
                                                                         'position[b]'])])
def test_names_that_cannot_be_chosen_are_left_as_indices(tmp_path, names, fields):
    sent = [Sent('/j', JOINTS, START + k, joints(START + k, [1.0, 2.0], names)) for k in range(9)]
    with open_bag(write_mcap(tmp_path / 'b.mcap', sent)) as bag:
        found = bag.named_fields('/j', 9)
        assert [str(path) for path in found][:2] == fields
        assert list(found.values())[:2] == ['position[0]', 'position[1]']
        for block in bag.blocks({'/j': [*found][:2]}):
            assert (block.columns[0].values == [1.0, 2.0]).all()


@pytest.mark.parametrize(('field', 'called'), [
    ('velocity[elbow]', 'elbow_velocity'), ('interface_values[elbow].values[effort]',
                                            'elbow_effort'),
    ('pose[box].position.x', 'box_position_x'), ('velocity[0]', ''), ('twist.linear.x', ''),
    ('euler(pose[box].orientation).roll', 'box_orientation_roll'), ("effort['2']", '2_effort')])
def test_a_field_is_called_after_its_element(field, called):
    assert title(parse_field(field)) == called
