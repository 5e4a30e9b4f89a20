# SPDX-License-Identifier: Apache-2.0
"""Field paths: their grammar, what they read from message objects, and angles."""

from __future__ import annotations

import math
from types import SimpleNamespace

from bag_fixtures import joints, make, vector
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctsid_ros.decoding.field_path import (
    FieldError,
    Name,
    ParseError,
    Range,
    parse_field,
    roll_pitch_yaw,
)

GOOD = {
    'data': ('data',),
    'twist.linear.x': ('twist', 'linear', 'x'),
    'position[2]': ('position', 2),
    'position[0:6]': ('position', Range(0, 6)),
    'position[:6]': ('position', Range(0, 6)),
    'effort[:]': ('effort', Range(0, None)),
    'effort[2:]': ('effort', Range(2, None)),
    'poses[1].position.x': ('poses', 1, 'position', 'x'),
    'm[1][2:3]': ('m', 1, Range(2, 3)),
    'velocity[elbow]': ('velocity', Name('elbow')),
    "velocity['1']": ('velocity', Name('1')),
    'velocity["it\'s 2 m"]': ('velocity', Name("it's 2 m")),
    'pose[robot::arm/link-1.a].position.x': ('pose', Name('robot::arm/link-1.a'), 'position', 'x'),
    'values[joint_1].values[position]': (
        'values', Name('joint_1'), 'values', Name('position')),
    'euler': ('euler',),
    'euler.x': ('euler', 'x'),
}


@pytest.mark.parametrize('text', GOOD)
def test_grammar(text):
    path = parse_field(text)
    assert path.steps == GOOD[text]
    assert path.euler == ()
    assert parse_field(str(path)) == path


@pytest.mark.parametrize(('text', 'euler'), [
    ('euler(pose.orientation).roll', ('roll',)), ('euler(q).yaw', ('yaw',)),
    ('euler(pose.orientation)', ('roll', 'pitch', 'yaw')), ('euler(a[0:2].q).pitch', ('pitch',))])
def test_grammar_of_euler(text, euler):
    path = parse_field(text)
    assert path.euler == euler
    assert str(path) == text
    assert parse_field(str(path)) == path


@pytest.mark.parametrize(('text', 'position'), [
    ('', 0), ('.x', 0), ('a.', 2), ('a..b', 2), ('a[', 2), ('a[]', 2), ('a[-1]', 2), ('a[1', 3),
    ('a[1.5]', 3), ('a[3:3]', 4), ('a[3:2]', 4), ('a[:0]', 3), ('a[0:5:2]', 5), ('a b', 2),
    ('/imu/x', 0), ('a/b', 1), ('2a', 0), ('norm(v)', 0), ('euler(q', 7), ('euler(q).rol', 9),
    ('euler()', 6), ('euler(q).roll.x', 13), ('a[12345678]', 2), ('a[²]', 2), ('a)', 1),
    ("a['']", 2), ("a['x]", 2), ('a[b c]', 4), ('a[b', 3), ('a[b]c', 4)])
def test_bad_syntax_is_pointed_at(text, position):
    with pytest.raises(ParseError) as error:
        parse_field(text)
    said, shown, caret = str(error.value).split('\n')
    assert 'expected' in said
    assert f'position {position} ' in said
    assert shown == f'    {text}'
    assert caret.index('^') == 4 + position


@pytest.mark.parametrize('text', [3, None, ['a']])
def test_only_text_is_parsed(text):
    with pytest.raises(ParseError, match='is text such as'):
        parse_field(text)


def test_absurd_ranges_are_refused():
    with pytest.raises(ParseError, match='10000 scalars'):
        parse_field('a[0:999999]')
    with pytest.raises(ParseError, match='10000 scalars'):
        parse_field('a[0:1000].b[0:1000]')


def test_width_and_angles():
    assert parse_field('a.b').angles == (False,)
    assert parse_field('a[1:4]').angles == (False,) * 3
    assert parse_field('euler(pose[arm].q)').angles == (True,) * 3
    assert parse_field('a[x].b[y]').elements == ('x', 'y')
    assert parse_field('euler(a).yaw').angles == (True,)
    assert parse_field('euler(a[0:2].q)').width == 6
    with pytest.raises(FieldError, match='bind'):
        _ = parse_field('a[:]').angles


def test_bind_closes_open_ranges():
    lengths = {('a',): 3, ('a', 0, 'b'): 2}
    path = parse_field('a[:].b[1:]').bind(lengths.__getitem__)
    assert str(path) == 'a[0:3].b[1:2]'
    assert path.leaves == (('a', 0, 'b', 1), ('a', 1, 'b', 1), ('a', 2, 'b', 1))
    with pytest.raises(FieldError, match='0 elements'):
        parse_field('a[:]').bind(lambda steps: 0)


def test_get_reads_messages():
    message = joints(0, [1.0, 2.0, 3.0])
    assert parse_field('position[1]').get(message) == [2.0]
    assert parse_field('velocity[0:2]').get(message) == [10.0, 20.0]
    assert parse_field('effort[1:]').get(message) == [-2.0, -3.0]
    twist = make('geometry_msgs/msg/TwistStamped', twist=make(
        'geometry_msgs/msg/Twist', linear=vector(7)))
    assert parse_field('twist.linear.x').get(twist) == [7.0]


def test_get_reads_what_rclpy_makes_of_primitives():
    message = SimpleNamespace(flag=True, octet=b'\x07', whole=np.uint16(9), lambda_=2.5,
                              rows=[SimpleNamespace(v=1), SimpleNamespace(v=2)])
    texts = ('flag', 'octet', 'whole', 'lambda', 'rows[0:2].v')
    assert [parse_field(text).get(message) for text in texts] == [
        [1.0], [7.0], [9.0], [2.5], [1.0, 2.0]]


@pytest.mark.parametrize(('text', 'said'), [
    ('positon[0]', "no field 'positon'; nearest: position"), ('position[3]', '3 elements'),
    ('position[1:5]', '3 elements'), ('position', 'not a number'), ('name[0]', 'not a number'),
    ('header', 'not a number but std_msgs__msg__Header; name one of its fields'),
    ('header[0]', 'not an array'), ('header.frame_id[0]', 'not an array'),
    ('euler(header.stamp)', "no field 'x'"), ('header.stamp.sec.x', "no field 'x'")])
def test_get_says_what_is_wrong(text, said):
    with pytest.raises(FieldError, match=said.replace('[', r'\[')):
        parse_field(text).get(joints(0, [1.0, 2.0, 3.0]))


def test_roll_pitch_yaw_against_scipy():
    rng = np.random.default_rng(1)
    for q in rng.normal(size=(500, 4)) * rng.uniform(0.01, 100, size=(500, 1)):
        yaw, pitch, roll = Rotation.from_quat(q).as_euler('ZYX')
        np.testing.assert_allclose(roll_pitch_yaw(*q), (roll, pitch, yaw), atol=1e-9)


def test_roll_pitch_yaw_turn_about_the_axes_of_their_names():
    for axis, angle in ((0, 0.3), (1, -0.4), (2, 2.0)):
        q = [0.0, 0.0, 0.0, math.cos(angle / 2)]
        q[axis] = math.sin(angle / 2)
        expected = [0.0, 0.0, 0.0]
        expected[axis] = angle
        np.testing.assert_allclose(roll_pitch_yaw(*q), expected, atol=1e-15)


def test_roll_pitch_yaw_at_the_pole_and_of_nonsense():
    half = math.sqrt(0.5)
    assert roll_pitch_yaw(0.0, half, 0.0, half)[1] == pytest.approx(math.pi / 2, abs=1e-7)
    for yaw in np.linspace(-3, 3, 400):  # rounding may lift the sine above 1
        q = 1.7 * Rotation.from_euler('ZYX', [yaw, math.pi / 2, 0.0]).as_quat()
        assert roll_pitch_yaw(*q)[1] == pytest.approx(math.pi / 2, abs=1e-7)
    for q in ((0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 1.0)):
        assert all(math.isnan(angle) for angle in roll_pitch_yaw(*q))


def test_euler_of_messages():
    q = Rotation.from_euler('ZYX', [1.0, -0.5, 0.25]).as_quat()
    message = make('geometry_msgs/msg/PoseStamped')
    message.pose.orientation = make('geometry_msgs/msg/Quaternion',
                                    **dict(zip('xyzw', map(float, q), strict=True)))
    assert parse_field('euler(pose.orientation)').get(message) == pytest.approx([0.25, -0.5, 1.0])
    assert parse_field('euler(pose.orientation).yaw').get(message) == pytest.approx([1.0])
