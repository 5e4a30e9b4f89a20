# SPDX-License-Identifier: Apache-2.0
"""What the running node says of topics that do not come, and of messages that are no good."""

import math

import pytest

pytest.importorskip('rclpy')
from live import DEEP, RELIABLE, Live  # noqa: E402
from robot import EPOCH, Robot, S, joint_message, motion, params  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402

from ctsid_ros.messages import Level  # noqa: E402

MS = 10**6


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def test_publishers_that_cannot_be_heard_are_told_with_the_cure(live):
    node = live.identifier(params('ingest.reliability: reliable\ningest.timeout: 0.5',
                                  imu='sensors/imu'), '-r', 'sensors/imu:=/other/imu')
    imu, command = live.publishers(
        {'/other/imu': Imu, '/command': Float64MultiArray}, DEEP)

    def told(health) -> bool:
        imu.publish(Imu())
        command.publish(Float64MultiArray(data=[1.0]))
        return all(words in health.message for words in (
            'best effort', 'sends', 'on sensors/imu', 'on /command'))

    message = node.wait_health('ingest', told, 'four faults').message
    assert ('the publisher `/test` of /other/imu is best effort, but `ingest.reliability` asks '
            'for reliable, so its messages do not come; set it to best_effort') in message
    assert ('the publisher `/test` of /command sends std_msgs/msg/Float64MultiArray, but `type` '
            'says sensor_msgs/msg/JointState; correct it') in message
    assert 'no message has come on sensors/imu' in message
    assert 'no message has come on /command' in message
    assert node.health('ingest')[-1].level == Level.STALE
    for sentence in ('so its messages do not come', 'correct it',
                     'no message has come on /command'):
        live.wait(lambda: sentence in node.log, sentence)  # noqa: B023
    node.next_health('ingest')
    assert all(node.log.count(sentence) == 1 for sentence in (
        'so its messages do not come', 'correct it', 'no message has come on /command'))


@pytest.mark.slow
def test_topics_that_never_appear_are_named_even_if_only_a_number_differs(live):
    node = live.identifier(params('ingest.timeout: 0.5', command='/rotor1', imu='/rotor2'))
    node.wait_health('ingest', lambda h: 'on /rotor2' in h.message, 'silence')
    for topic in ('/rotor1', '/rotor2'):
        live.wait(lambda: f'no message has come on {topic}' in node.log,  # noqa: B023
                  f'a word on {topic}')
    command, = live.publishers({'/rotor1': JointState}, RELIABLE, node.name)
    command.publish(joint_message(EPOCH, [1.0]))
    said = node.wait_health('ingest', lambda h: h.values['/rotor1 messages'] == '1', 'one of two')
    assert 'no message has come on /rotor2' in said.message
    assert 'no message has come on /rotor1' not in said.message
    assert said.level in (Level.WARN, Level.STALE)
    assert said.values['/rotor2 messages'] == '0'


def test_junk_is_counted_and_told_and_never_fatal(live):
    node = live.identifier(params('ingest.timeout: 60.0'))
    robot = Robot(live, motion(6.5), node.name)
    robot.send(2.0)
    at = EPOCH + 1960 * MS  # still in the last `window.max_delay`
    for k in range(3):  # whole numbers of milliseconds that no sample has
        robot.publish('imu', at + k * MS + 1, [math.nan, 0.0])
    robot.publish('imu', at + 7 * MS, [0.0, math.inf])
    for k in range(5):
        robot.publish('command', at + k * MS + 3, [])
    for _ in range(2):
        robot.publish('imu', 0, [1.0, 1.0])
    robot.publish('imu', at + 1_500_000, [9.0, 9.0])  # that of a sample
    for k in range(4):
        robot.publish('imu', EPOCH + 1000 * MS + k, [5.0, 5.0])
    robot.publish('command', EPOCH + 900 * S, [7.0])
    robot.feed(node)
    assert all(estimate.ok for estimate in node.wait_models(3))
    said = robot.wait_taken(node)
    told = max(node.health('ingest'), key=lambda h: len(h.message))
    found = {key: int(value) for key, value in said.values.items() if key.split()[-1] in (
        'non_finite', 'wrong_width', 'bad_stamp', 'duplicate', 'late', 'astray')}
    shared = {'non_finite': None, 'bad_stamp': 2, 'duplicate': 1, 'late': 4}
    assert found == {'p non_finite': 3, 'q non_finite': 1, 'torque wrong_width': 5,
                     'torque astray': 1,
                     **{f'{name} {key}': count for name in 'pq' for key, count in shared.items()
                        if count}}
    assert told.level == Level.WARN
    for sentence in ('`p`: 3 of', '`q`: 1 of', 'are not finite', 'arrays are too short',
                     'have a stamp of zero', 'have the stamp of another', 'came too late',
                     'stamps far from all others'):
        assert sentence in told.message
    assert said.values['resets'] == '0'
    assert node.program.alive


@pytest.mark.slow
def test_a_warning_ends_when_its_cause_has(live):
    node = live.identifier(params('ingest.timeout: 60.0', length=2.0))
    robot = Robot(live, motion(30.0), node.name)
    robot.send(1.0)
    robot.publish('command', EPOCH + 3600 * S, [7.0])
    robot.send(2.0)
    said = node.wait_health('ingest', lambda h: 'torque astray' in h.values, 'the stray one')
    assert said.level == Level.WARN
    assert '`torque`: 1 of' in said.message
    assert 'samples of the last 2 s have stamps far from all others, up to 3.6e+03 s ahead' in \
        said.message
    assert 'too late' not in said.message
    for _ in range(270):
        robot.send(robot.sent['command'] / 50.0 + 0.1, speed=1.0)
        if (said := node.health('ingest')[-1]).level == Level.OK:
            break
    assert (said.level, said.message) == (Level.OK, 'messages come in')
    assert said.values['torque astray'] == '1'
    assert said.values['torque astray in the last window'] == '0'
    assert int(said.values['p samples in the last window']) < int(said.values['p samples'])


@pytest.mark.slow
def test_a_missing_package_and_wrong_fields_are_named_at_configure(live):
    text = params().replace('sensor_msgs/msg/JointState', 'px4_msgs/msg/Motors')
    node = live.identifier(text)
    live.wait(lambda: 'not configured' in node.log, 'the refusal')
    assert '`torque.type`' in node.log
    assert 'the messages of px4_msgs are not installed here' in node.log
    assert node.state() == 'unconfigured'
    assert node.set(torque__type='sensor_msgs/msg/Imu') == ''
    assert not node.change_state('configure')
    assert '`torque.field`: topic /command (sensor_msgs/msg/Imu)' in node.log
    assert node.set(torque__field='angular_velocity.w', p__field='angular_velocity') == ''
    assert not node.change_state('configure')
    live.wait(lambda: '`p.field`: topic /imu' in node.log, 'both faults')
    assert 'angular_velocity.x' in node.log.split('angular_velocity.w')[1]
    said = node.wait_health('ingest', lambda h: h.level == Level.ERROR, 'an error')
    assert 'not configured' in said.message
    assert node.program.alive


def test_a_parameter_file_that_is_missing_is_said_in_plain_words(live):
    program = live.start('-m', 'ctsid_ros.node', '--ros-args', '--params-file', 'nowhere.yaml')
    assert program.process.wait(180.0) == 1
    assert program.log.startswith('identifier: the parameter file nowhere.yaml does not exist')
    assert 'Traceback' not in program.log


@pytest.mark.slow
def test_a_rate_of_work_that_is_none_is_said_at_configure(live):
    live.env['CTSID_WORK_RATE'] = 'fast'
    node = live.identifier(params())
    live.wait(lambda: 'not configured' in node.log, 'the refusal')
    assert "the environment variable CTSID_WORK_RATE is 'fast'; set it to a positive" in node.log
    assert 'by a fault of ctsid' not in node.log
