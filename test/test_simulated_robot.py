# SPDX-License-Identifier: Apache-2.0
"""The flight is what it says of itself; the node sends it in time, or late but whole."""

from __future__ import annotations

import re
import signal
import time

import numpy as np
import pytest

from ctsid_core.model.storage import from_json
from ctsid_core.signals.record import Signal
from ctsid_ros.examples.flight import Command, Conditions, Flight
from ctsid_ros.examples.quadrotor_roll import GYRO_NOISE, Plant

S = 10**9
ROBOT = 'ctsid_ros.examples.simulated_robot'


def flown(steps: list[float], seed: int = 1, change: float | None = None,
          conditions: Conditions | None = None) -> list:
    """What is sent, asked for at `steps` [s]."""
    flight, sent = Flight(conditions or Conditions(), seed, Plant()), []
    for step in steps:
        sent += flight.sent(round(step * S))
        if step == change:
            flight.change(Plant(0.5), round(step * S))
    return sent


def split(sent: list) -> tuple[list, list]:
    return ([m for m in sent if isinstance(m, Command)],
            [m for m in sent if not isinstance(m, Command)])


def test_the_flight_does_not_depend_on_when_it_is_asked_for():
    often = flown([*np.arange(0.0, 6.0, 0.0037), 6.0], change=None)
    assert often == flown([6.0])
    assert often != flown([6.0], seed=2)
    assert flown([2.0, 6.0], change=2.0) == flown([0.7, 1.1, 2.0, 5.9, 6.0], change=2.0)
    assert flown([2.0, 6.0], change=2.0) != flown([2.0005, 6.0], change=2.0005)  # no stamp between


def test_rates_stamps_and_losses_are_those_of_the_conditions():
    commands, samples = split(flown([20.0], conditions=Conditions(100.0, 400.0, lost=0.1)))
    assert len(commands) == pytest.approx(2000, abs=5)
    assert len(samples) == pytest.approx(0.9 * 8000, rel=0.02)
    for messages, period in ((commands, 10e6), (samples, 2.5e6)):
        stamps, sent = np.array([[m.stamp_ns, m.sent_ns] for m in messages]).T
        assert np.median(np.diff(stamps)) == pytest.approx(period, rel=0.05)
        assert (np.diff(stamps) > 0).all()
        assert (np.diff(sent) >= 0).all()
        assert (stamps % 1000 == 0).all()
        late = sent - stamps
        assert 1e6 <= late.min() < 3e6 < 15e6 < late.max() < 60e6


def test_nothing_is_sent_before_its_time_nor_forgotten():
    flight = Flight(Conditions(), 1, Plant())
    now, count = 0, 0
    while now < 3 * S:
        now = flight.next_ns()
        sent = flight.sent(now)
        assert all(m.sent_ns <= now for m in sent)
        assert len(sent) <= 8  # one each time (if it is not lost), or those that one held up
        count += len(sent)
    assert count == pytest.approx(250 * 3, abs=15)


@pytest.mark.parametrize('payload', [0.0, 0.5])
def test_truth_explains_the_flight(payload):
    """From rest to the end, open loop, but for the sensor's noise and the gusts."""
    plant = Plant(payload)
    commands, samples = split(Flight(Conditions(), 4, plant).sent(20 * S))
    torque = Signal(np.array([0.0, *(m.stamp_ns / S for m in commands)]),
                    np.array([[0.0], *([m.torque] for m in commands)]), 'zoh')
    rates = np.array([m.rates[0] for m in samples])
    model = plant.true_model()
    computed = model.simulate((torque,), [0.0, *(m.stamp_ns / S for m in samples)],
                              x0=np.zeros(4))[1:, 0]
    error = np.std(rates - computed)
    assert GYRO_NOISE < error < 2 * GYRO_NOISE < 0.1 * np.std(computed)


def test_payload_moves_the_poles_of_the_air_and_of_the_boom_only():
    before, after = Plant().true_model().poles, Plant(0.5).true_model().poles
    assert before[1] == pytest.approx(-20) == after[1]
    assert abs(after[0]) < 0.6 * abs(before[0])
    assert abs(after[3]) < 0.75 * abs(before[3])


def test_nothing_jumps_when_the_payload_is_attached():
    _, samples = split(flown([5.0, 8.0], change=5.0, conditions=Conditions(noise=0.01)))
    times, rates = (np.array(x) for x in zip(*((m.stamp_ns / S, m.rates[0]) for m in samples),
                                             strict=True))
    at = np.searchsorted(times, 5.0)
    assert abs(rates[at] - rates[at - 1]) < 3 * np.std(np.diff(rates))
    _, other = split(flown([8.0], conditions=Conditions(noise=0.01)))
    same = [a.rates == b.rates for a, b in zip(samples, other, strict=False)]
    assert all(same[:at])
    assert not any(same[at + 20:at + 40])


@pytest.fixture
def live(tmp_path):
    pytest.importorskip('rclpy')
    from live import Live
    with Live(tmp_path) as domain:
        yield domain


class Heard:
    """What arrives from the robot."""

    def __init__(self, live) -> None:
        from geometry_msgs.msg import WrenchStamped
        from live import DEEP, RELIABLE
        from sensor_msgs.msg import Imu
        from std_msgs.msg import String
        self.commands = live.listen(WrenchStamped, '/command/torque', RELIABLE)
        self.samples, self.late = [], []  # s, between stamp and receipt
        live.node.create_subscription(Imu, '/imu', self._on_sample, DEEP)
        self._truths = live.listen(String, '/simulated_robot/truth')

    def _on_sample(self, message) -> None:
        stamp = message.header.stamp
        self.late.append(time.time() - stamp.sec - stamp.nanosec * 1e-9)
        self.samples.append(message)

    def truths(self) -> list:
        return [from_json(message.data) for message in list(self._truths)]

    def stamps(self) -> np.ndarray:
        return np.array([m.header.stamp.sec + m.header.stamp.nanosec * 1e-9
                         for m in list(self.samples)])


@pytest.mark.slow
def test_the_node_flies_in_time_changes_and_catches_up(live):
    heard = Heard(live)
    robot = live.start('-m', ROBOT, '--ros-args', '-p', 'seed:=3', '-p', 'change_after:=2.0',
                       '-p', 'change_to:=0.7')
    live.wait(lambda: heard.truths() and heard.truths()[-1].model == Plant(0.7).true_model(
        imu_rate=199.0), 'the change')
    live.wait(lambda: len(heard.samples) > 200, 'measurements')
    assert 0 < min(heard.late[-200:]) < 0.2  # whatever holds up this process at times
    assert len(heard.samples) / len(heard.commands) == pytest.approx(4.0, rel=0.1)
    began = re.search(r'\[([\d.]+)\] \[simulated_robot\]: the payload is 0 kg', robot.log)
    assert heard.truths()[-1].start_ns / S - float(began[1]) == pytest.approx(2.0, abs=1.0)

    robot.process.send_signal(signal.SIGSTOP)
    time.sleep(0.4)
    count = len(heard.samples)
    robot.process.send_signal(signal.SIGCONT)
    live.wait(lambda: len(heard.samples) > count + 150, 'what was held up')
    assert np.diff(heard.stamps()).max() < 0.08  # only lost ones are missing
    assert 'held up for ' in robot.log
    assert robot.end()[0] == 0


@pytest.mark.slow
def test_the_payload_is_a_parameter_and_the_rest_is_fixed(live):
    from rcl_interfaces.srv import DescribeParameters, SetParameters
    from rclpy.parameter import Parameter
    heard = Heard(live)
    robot = live.start('-m', ROBOT, '--ros-args', '-p', 'seed:=3')
    live.wait(heard.truths, 'the truth')
    assert heard.truths()[-1].model == Plant().true_model(imu_rate=199.0)
    wanted = [Parameter(name, value=value).to_parameter_msg()
              for name, value in (('payload', 1.0), ('payload', -1.0), ('seed', 4))]
    answer = live.call(SetParameters, '/simulated_robot/set_parameters',
                       SetParameters.Request(parameters=wanted))
    assert [result.successful for result in answer.results] == [True, False, False]
    truth = Plant(1.0).true_model(imu_rate=199.0)
    live.wait(lambda: heard.truths() and heard.truths()[-1].model == truth, 'the payload')
    answer = live.call(DescribeParameters, '/simulated_robot/describe_parameters',
                       DescribeParameters.Request(names=['payload', 'gusts']))
    assert all(d.description and d.floating_point_range for d in answer.descriptors)
    code, seconds = robot.end(signal.SIGINT)
    assert code == 0
    assert seconds < 3.0


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_robot_20_times_of_20(live, number):
    for _ in range(20):
        robot = live.start('-m', ROBOT, '--ros-args', '-p', 'seed:=3')
        live.wait(lambda: 'the payload is' in robot.log, 'the flight')  # noqa: B023
        code, seconds = robot.end(number)
        assert code == 0
        assert seconds < 3.0
        assert 'Traceback' not in robot.log
