# SPDX-License-Identifier: Apache-2.0
"""The layout extractor against the deserialisation of rosbags."""

from __future__ import annotations

from dataclasses import replace
import struct

from bag_fixtures import (
    ROS1,
    STORE,
    array,
    flight_ros1,
    header,
    header_stamp_ns,
    imu,
    joints,
    make,
    vector,
)
import numpy as np
import pytest
from rosbags.serde import SerdeError

from ctsid_ros.decoding.cdr import DecodeError, Extractor
from ctsid_ros.decoding.cdr_layout import layout_of
from ctsid_ros.decoding.field_path import FieldError, parse_field
from ctsid_ros.decoding.message_fields import bind, scalar_fields
from ctsid_ros.decoding.message_types import FieldType, MessageType, of_message_class, reachable
from ctsid_ros.recordings.definitions import message_type
from ctsid_ros.recordings.recording import Connection


def type_of(name: str, store=STORE) -> MessageType:
    ros1 = store is ROS1
    text = store.generate_msgdef(name, ros_version=1 if ros1 else 2)[0]
    return message_type(Connection(0, '/t', name, 'ros1' if ros1 else 'cdr',
                                   'ros1msg' if ros1 else 'ros2msg', text, 1))


def fields(*texts: str):
    return [parse_field(text) for text in texts]


def extractor(name: str, *texts: str, store=STORE) -> Extractor:
    return Extractor(type_of(name, store), fields(*texts))


def raw_of(message, little: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little))


def expected(message, *texts: str):
    scalars = [x for text in texts for x in parse_field(text).get(message)]
    return header_stamp_ns(message), tuple(scalars)


def state(rng: np.random.Generator, sizes=(2, 3, 2, 5, 2)):
    """Return a message with strings and sequences of random lengths before everything else."""
    def text() -> str:
        return 'x' * int(rng.integers(0, 9))

    def sample():
        return make('my_msgs/msg/Sample', flag=int(rng.integers(256)), value=float(rng.normal()),
                    note=text(), triple=rng.integers(-9, 9, 3).astype(np.int16))

    def flat():
        return make('my_msgs/msg/Flat', flag=1, value=float(rng.normal()), count=7)

    history, track, labels, gains, few = sizes
    return make(
        'my_msgs/msg/State', name=text(), history=[sample() for _ in range(history)],
        track=[flat() for _ in range(track)], pair=[flat(), flat()],
        labels=[text() for _ in range(labels)], gains=rng.normal(size=gains).astype(np.float32),
        few=rng.normal(size=few), armed=bool(rng.integers(2)), mode=-5, raw=100, letter=200,
        ticks=int(rng.integers(2**62)), latest=sample(), attitude=make(
            'geometry_msgs/msg/Quaternion', x=0.1, y=0.2, z=0.3, w=0.9))


ODOMETRY = make('nav_msgs/msg/Odometry', header=header(5_000_000_007, 'odom'),
                child_frame_id='base_link', twist=make(
                    'geometry_msgs/msg/TwistWithCovariance', covariance=np.arange(36.0),
                    twist=make('geometry_msgs/msg/Twist', angular=vector(1, 2, 3))))
POSE = make('geometry_msgs/msg/PoseStamped', header=header(1, 'world'), pose=make(
    'geometry_msgs/msg/Pose', orientation=make('geometry_msgs/msg/Quaternion',
                                               x=0.5, y=-0.5, z=0.1, w=0.7)))
PWM = make('std_msgs/msg/UInt16MultiArray', data=np.array([1500, 65535, 0], np.uint16))
CASES = [
    (imu(1_700_000_000_123_456_789, 0.25), ('angular_velocity.x', 'linear_acceleration.z')),
    (imu(3, 0.25), ('linear_acceleration.z', 'angular_velocity.x', 'orientation_covariance[8]')),
    (joints(7, [1, 2, 3]), ('position[0]', 'position[2]', 'effort[0:3]', 'velocity[1]')),
    (array(1.5, 2.5), ('data[1]', 'data[0]', 'data[1]')),
    (PWM, ('data[0:3]',)),
    (ODOMETRY, ('twist.twist.angular.z', 'twist.covariance[35]', 'pose.pose.position.x')),
    (POSE, ('euler(pose.orientation)', 'pose.position.y', 'euler(pose.orientation).pitch')),
    (state(np.random.default_rng(0)), (
        'history[1].value', 'history[0].triple[2]', 'track[2].value', 'track[0].count',
        'pair[1].value', 'gains[0:5]', 'few[1]', 'armed', 'mode', 'ticks', 'raw', 'letter',
        'latest.value', 'latest.triple[0:3]', 'euler(attitude)')),
]


@pytest.mark.parametrize('little', [True, False], ids=['little', 'big'])
@pytest.mark.parametrize(('message', 'texts'), CASES, ids=lambda x: getattr(x, '__msgtype__', ''))
def test_equals_deserialisation(message, texts, little):
    raw = raw_of(message, little)
    extract = extractor(message.__msgtype__, *texts)
    first, again = extract(raw), extract(memoryview(raw))
    assert first == again == expected(STORE.deserialize_cdr(raw, message.__msgtype__), *texts)
    assert all(type(x) is float for x in first[1])


def test_nothing_but_the_stamp():
    extract = extractor('sensor_msgs/msg/Imu')
    assert extract(raw_of(imu(12, 1.0))) == (12, ())
    assert extractor('std_msgs/msg/Float64MultiArray')(raw_of(array(1))) == (None, ())
    assert extract(raw_of(make('sensor_msgs/msg/Imu'))) == (0, ())


def test_frames_of_any_length_and_byte_orders_mixed():
    texts = ('orientation_covariance[3]', 'angular_velocity.x')
    extract = extractor('sensor_msgs/msg/Imu', *texts)
    for k in range(300):
        message = imu(k, float(k), 'f' * (k % 23))
        assert extract(raw_of(message, k % 3 > 0)) == expected(message, *texts)


def test_byte_orders_mixed_without_any_length_word():
    extract = extractor('geometry_msgs/msg/Vector3', 'y')
    for little in (True, False, True):
        assert extract(raw_of(vector(1, 2, 3), little)) == (None, (2.0,))


def test_random_messages_of_a_custom_type():
    rng = np.random.default_rng(2)
    texts = ('latest.value', 'history[0].value', 'armed', 'ticks', 'few[0]', 'pair[1].value')
    extract = extractor('my_msgs/msg/State', *texts)
    for _ in range(200):
        sizes = rng.integers(0, 4, size=5)
        message = state(rng, sizes)
        if sizes[0] and sizes[4]:
            assert extract(raw_of(message)) == expected(message, *texts)
        else:
            with pytest.raises(DecodeError, match='element 0 is wanted'):
                extract(raw_of(message))


def test_same_shape_is_walked_once(monkeypatch):
    walks = []
    monkeypatch.setattr('ctsid_ros.decoding.cdr.layout_of',
                        lambda *a: walks.append(1) or layout_of(*a))
    extract = extractor('sensor_msgs/msg/JointState', 'effort[1]')
    for k in range(30):  # two publishers with joints of their own take turns
        extract(raw_of(joints(k, [k, 1.0] if k % 2 else [k, 1.0, 2.0])))
    assert len(walks) == 2


def test_elements_that_come_and_go():
    extract = extractor('sensor_msgs/msg/JointState', 'position[3]')
    for k in (5, 3, 4, 0, 6):
        raw = raw_of(joints(k, np.arange(k)))
        if k > 3:
            assert extract(raw) == (k, (3.0,))
        else:
            with pytest.raises(DecodeError, match=f'has {k} elements'):
                extract(raw)


def test_open_ranges_are_closed_by_the_first_message_that_has_elements():
    extract = extractor('sensor_msgs/msg/JointState', 'position[1:]')
    with pytest.raises(DecodeError, match='0 elements'):
        extract(raw_of(joints(1, [])))
    assert extract(raw_of(joints(2, [1, 2, 3]))) == (2, (2.0, 3.0))
    assert [str(field) for field in extract.fields] == ['position[1:3]']
    assert extract(raw_of(joints(3, [1, 2, 3, 4]))) == (3, (2.0, 3.0))
    with pytest.raises(DecodeError, match='element 2'):
        extract(raw_of(joints(4, [1, 2])))


def test_bind_by_type_and_by_message():
    kind = type_of('sensor_msgs/msg/Imu')
    raw = raw_of(imu(1, 1.0))
    assert bind(kind, parse_field('orientation_covariance[7:]'), raw).width == 2
    kind = type_of('sensor_msgs/msg/JointState')
    raw = raw_of(joints(1, [5, 6]))
    assert str(bind(kind, parse_field('velocity[:]'), raw)) == 'velocity[0:2]'


@pytest.mark.parametrize('keep', [0, 1, 3, 4, 7, 11, 40, 200])
def test_short_messages_are_errors_of_their_own(keep):
    raw = raw_of(imu(9, 0.5))
    fresh, used = (extractor('sensor_msgs/msg/Imu', 'linear_acceleration.z') for _ in range(2))
    used(raw)
    for extract in (fresh, used):
        with pytest.raises(DecodeError, match=f'{keep} bytes'):
            extract(raw[:keep])
        assert extract(raw) == (9, (9.81,))
    with pytest.raises(SerdeError):  # the rival agrees
        STORE.deserialize_cdr(raw[:keep], 'sensor_msgs/msg/Imu')


def test_foreign_encapsulations_are_errors():
    raw = bytearray(raw_of(imu(9, 0.5)))
    raw[1] = 7  # XCDR2
    with pytest.raises(DecodeError, match='begin with 00 07'):
        extractor('sensor_msgs/msg/Imu', 'linear_acceleration.z')(raw)


def test_mad_lengths_are_errors_at_once():
    raw = bytearray(raw_of(make('my_msgs/msg/State', gains=np.ones(3, np.float32))))
    raw[4:8] = b'\xff\xff\xff\xff'  # the first string claims 4 GB
    with pytest.raises(DecodeError, match='ends after'):
        extractor('my_msgs/msg/State', 'armed')(raw)
    raw = bytearray(raw_of(make('geometry_msgs/msg/PoseArray')))
    raw[-4:] = b'\xff\xff\xff\x7f'  # two thousand million poses
    with pytest.raises(DecodeError, match='ends after'):
        extractor('geometry_msgs/msg/PoseArray', 'poses[0].position.x')(raw)


def test_random_bytes_never_raise_anything_else():
    rng = np.random.default_rng(3)
    raw = raw_of(state(rng))
    extract = extractor('my_msgs/msg/State', 'latest.value', 'gains[0]', 'history[0].value')
    outcomes = set()
    for _ in range(2000):
        spoilt = bytearray(raw)
        for at in rng.integers(4, len(raw), size=3):
            spoilt[at] = rng.integers(256)
        try:
            outcomes.add(len(extract(spoilt[:rng.integers(4, len(raw) + 1)])[1]))
        except DecodeError:
            outcomes.add('error')
    assert outcomes == {3, 'error'}


def test_ros1_messages():
    kind = type_of('sensor_msgs/msg/Imu', ROS1)
    extract = Extractor(kind, fields('angular_velocity.x', 'linear_acceleration.z'))
    for k, sent in enumerate(flight_ros1(20)):
        named = replace(sent.message.header, frame_id='f' * (k % 5))
        message = replace(sent.message, header=named)
        raw = bytes(ROS1.serialize_ros1(message, sent.type))
        assert extract(raw) == (header_stamp_ns(message), (message.angular_velocity.x, 9.81))
        with pytest.raises(DecodeError):
            extract(raw[:100])


@pytest.mark.parametrize(('name', 'text', 'said'), [
    ('sensor_msgs/msg/Imu', 'angular_velocty.x', r"'angular_velocty'; nearest: angular_velocity"),
    ('sensor_msgs/msg/Imu', 'angular_velocity.w', r"Vector3 has no field 'w'; there are: x, y, z"),
    ('sensor_msgs/msg/Imu', 'yaw', r'did you mean euler\(orientation\).yaw'),
    ('sensor_msgs/msg/Imu', 'z', r'did you mean angular_velocity.z or linear_acceleration.z'),
    ('sensor_msgs/msg/Imu', 'angular_velocity', r'choose from: angular_velocity.x, angular_velo'),
    ('sensor_msgs/msg/Imu', 'header.frame_id', r'not a number but string'),
    ('sensor_msgs/msg/Imu', 'header', r'no number lies below'),
    ('sensor_msgs/msg/Imu', 'orientation_covariance', r'choose elements: orienta'),
    ('sensor_msgs/msg/Imu', 'orientation_covariance[9]', r'has 9 elements, the last'),
    ('sensor_msgs/msg/Imu', 'orientation_covariance[4:10]', r'has 9 elements'),
    ('sensor_msgs/msg/Imu', 'orientation[0]', r'not an array; leave out \[0\]'),
    ('sensor_msgs/msg/Imu', 'orientation.x.y', r"orientation.x is float64 and has no field 'y'"),
    ('sensor_msgs/msg/Imu', 'euler(angular_velocity)', r'needs a quaternion'),
    ('sensor_msgs/msg/JointState', 'position', r'float64\[\]; choose elements: position\[0\] or'),
    ('sensor_msgs/msg/JointState', 'name[0]', r'not a number but string'),
    ('geometry_msgs/msg/PoseArray', 'poses.position', r'choose an element: poses\[0\].position')])
def test_fields_that_do_not_fit_the_type(name, text, said):
    with pytest.raises(FieldError, match=said):
        extractor(name, text)


def listed(name: str, message, **options) -> list[str]:
    raw = None if message is None else raw_of(message)
    return [str(field) for field in scalar_fields(type_of(name), raw, **options)]


def test_scalar_fields_of_common_types():
    assert listed('geometry_msgs/msg/PoseStamped', POSE) == [
        'pose.position.x', 'pose.position.y', 'pose.position.z',
        'euler(pose.orientation).roll', 'euler(pose.orientation).pitch',
        'euler(pose.orientation).yaw']
    assert listed('sensor_msgs/msg/JointState', joints(0, [1, 2])) == [
        f'{name}[{i}]' for name in ('position', 'velocity', 'effort') for i in (0, 1)]
    assert listed('sensor_msgs/msg/JointState', None) == []
    assert len(listed('sensor_msgs/msg/Imu', imu(0, 0), most=8)) == 9
    assert len(listed('sensor_msgs/msg/Imu', imu(0, 0))) == 9 + 27


def test_scalar_fields_skip_pictures_and_cut_long_lists():
    picture = make('sensor_msgs/msg/Image', data=np.zeros(10_000, np.uint8))
    assert not any(text.startswith('data') for text in listed('sensor_msgs/msg/Image', picture))
    poses = make('geometry_msgs/msg/PoseArray', poses=[make('geometry_msgs/msg/Pose')] * 100)
    assert len(listed('geometry_msgs/msg/PoseArray', poses, most=5)) == 5 * 6


def test_every_scalar_field_can_be_extracted():
    message = state(np.random.default_rng(5))
    texts = listed('my_msgs/msg/State', message)
    assert len(texts) > 40
    assert extractor('my_msgs/msg/State', *texts)(raw_of(message)) == expected(message, *texts)


def test_definitions_that_contain_themselves_are_refused():
    loop = {'a/msg/A': {'b': FieldType('a/msg/B')}, 'a/msg/B': {'a': FieldType('a/msg/A')}}
    with pytest.raises(ValueError, match='contains itself'):
        reachable('a/msg/A', loop)


def test_a_missing_inner_definition_is_a_matter_of_what_lies_before_it():
    text = 'float64 before\nother_msgs/Thing thing\nfloat64 after\n'
    kind = message_type(Connection(0, '/t', 'a_msgs/msg/A', 'cdr', 'ros2msg', text, 1))
    raw = b'\0\1\0\0' + np.array([1.5, 2.5]).tobytes()
    assert Extractor(kind, fields('before'))(raw) == (None, (1.5,))
    with pytest.raises(DecodeError, match='other_msgs/msg/Thing is missing'):
        Extractor(kind, fields('after'))(raw)


def test_types_of_rosidl_classes_equal_those_of_definitions():
    """Where ROS 2 is there: the class of a message tells the same as its definition."""
    sensor, nav = pytest.importorskip('sensor_msgs.msg'), pytest.importorskip('nav_msgs.msg')
    for cls, name in ((sensor.Imu, 'sensor_msgs/msg/Imu'), (nav.Odometry, 'nav_msgs/msg/Odometry'),
                      (sensor.JointState, 'sensor_msgs/msg/JointState'),
                      (sensor.BatteryState, 'sensor_msgs/msg/BatteryState'),
                      (nav.Path, 'nav_msgs/msg/Path')):
        assert of_message_class(cls) == type_of(name)


def test_of_message_class_wants_a_message_class():
    with pytest.raises(TypeError, match='not a message class'):
        of_message_class(dict)


@pytest.mark.parametrize(('kind', 'name'), [(7, 'PLAIN_CDR2'), (9, 'DELIMITED_CDR2'),
                                            (11, 'PL_CDR2')])
def test_xcdr2_is_called_by_its_name(kind, name):
    raw = bytearray(raw_of(array(1.0)))
    raw[1] = kind
    with pytest.raises(DecodeError, match=f'begin with 00 {kind:02x} .{name} of XCDR2'):
        extractor('std_msgs/msg/Float64MultiArray', 'data[0]')(bytes(raw))


def test_a_text_of_wide_characters_hides_what_comes_behind_it():
    kind = message_type(Connection(0, '/t', 'p/msg/T', 'cdr', 'ros2msg',
                                   'float64 x\nwstring w\nfloat64 y\n', 1))
    raw = bytes((0, 1, 0, 0)) + struct.pack('<dI2H4xd', 0.5, 2, 65, 66, 1.5)
    assert Extractor(kind, fields('x'))(raw) == (None, (0.5,))
    with pytest.raises(DecodeError, match='wstring'):
        Extractor(kind, fields('y'))(raw)
