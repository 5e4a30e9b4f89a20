# SPDX-License-Identifier: Apache-2.0
"""The example bags are what their script makes, and their truth is true."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import sys
from types import ModuleType

from marks import slow
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from ctsid_core.model.storage import load_model
from ctsid_core.signals.record import Signal
from ctsid_ros.examples import quadrotor_roll

BAGS = Path(__file__).resolve().parent.parent / 'bags'
NAMES = ('quadrotor_roll', 'quadrotor_roll_sqlite3', 'quadrotor_roll.bag')


@pytest.fixture(scope='module')
def maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location('maker', BAGS / 'make_quadrotor_roll.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules['maker'] = module  # where dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def flight(maker):
    return maker.fly()


def stamp_ns(message) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def numbers(message) -> list[float]:
    if hasattr(message, 'wrench'):
        parts = [message.wrench.torque, message.wrench.force]
    else:
        q = message.orientation
        parts = [message.angular_velocity, message.linear_acceleration, q]
        assert q.w**2 + q.x**2 == pytest.approx(1.0, abs=1e-6)
    return [x for part in parts for x in (part.x, part.y, part.z)]


def content(messages) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Stamps (log, header) [ns] and numbers of all messages, by topic."""
    by_topic: dict[str, list] = {}
    for log_ns, topic, message in messages:
        by_topic.setdefault(topic, []).append(((log_ns, stamp_ns(message)), numbers(message)))
    return {topic: (np.array([s for s, _ in rows]), np.array([x for _, x in rows]))
            for topic, rows in by_topic.items()}


def read(path: Path):
    with AnyReader([path]) as reader:
        for connection, log_ns, raw in reader.messages():
            yield log_ns, connection.topic, reader.deserialize(raw, connection.msgtype)


@pytest.fixture(scope='module')
def made(maker, flight):
    return content(maker.messages(flight, maker.get_typestore(maker.Stores.ROS2_JAZZY)))


@pytest.mark.parametrize('name', [NAMES[0], *slow(*NAMES[1:])])
def test_bag_holds_what_the_script_makes(maker, made, name):
    stored = content(read(BAGS / name))
    assert set(made) == set(stored) == {'/imu', '/command/torque'}
    for topic, (stamps, values) in made.items():
        np.testing.assert_array_equal(stored[topic][0], stamps)
        # Another machine's rounding may turn a converter's last digit.
        np.testing.assert_allclose(stored[topic][1], values, rtol=0, atol=2 * maker.GYRO_STEP)
        assert np.mean(np.abs(stored[topic][1] - values) > 1e-6) < 0.001


def test_bags_are_small():
    for name in NAMES:
        files = [f for f in [BAGS / name, *(BAGS / name).glob('*')] if f.is_file()]
        assert 1e5 < sum(f.stat().st_size for f in files) < 1.5e6


def test_stamps_are_jittered_late_and_lossy(flight):
    for stamps, logs, period in ((flight.command_ns, flight.command_log_ns, 20e6),
                                 (flight.imu_ns, flight.imu_log_ns, 5e6)):
        assert np.median(np.diff(stamps)) == pytest.approx(period, rel=0.05)
        assert (np.diff(stamps) > 0).all()
        assert (np.diff(logs) >= 0).all()
        assert 1e6 <= (logs - stamps).min() < 5e6 < (logs - stamps).max() < 50e6
    imu = np.diff(flight.imu_ns)
    assert 0.1 < np.std(imu[imu < 8e6]) / 5e6 < 0.3
    assert len(flight.imu_ns) < 0.995 * 8000
    assert imu.max() > 50e6


def test_truth_explains_the_recorded_rate(maker, flight):
    """From rest to the end of the bag, open loop, but for the sensor's noise and the gusts."""
    model = load_model(BAGS / 'quadrotor_roll_truth.json')
    times = (flight.imu_ns - maker.EPOCH_NS) * 1e-9
    commands = np.concatenate([[0.0], (flight.command_ns - maker.EPOCH_NS) * 1e-9])
    torque = np.concatenate([[0.0], flight.torque])[:, np.newaxis]
    rate = model.simulate(
        (Signal(commands, torque, 'zoh'),), [0.0, *times], x0=np.zeros(model.n))[1:]
    error = flight.rate[:, 0] - rate[:, 0]
    assert maker.GYRO_NOISE < np.std(error) < 1.5 * maker.GYRO_NOISE < 0.05 * np.std(rate)
    assert abs(np.mean(error)) < 0.005


def test_truth_has_the_poles_that_the_plant_was_given(maker):
    poles = load_model(BAGS / 'quadrotor_roll_truth.json').poles
    real = np.sort(poles[abs(poles.imag) < 1e-9].real)
    wanted = [quadrotor_roll.MOTOR_POLE, quadrotor_roll.AIR_POLE]
    np.testing.assert_allclose(real, wanted, rtol=2e-3)
    pair = poles[poles.imag > 0]
    np.testing.assert_allclose(abs(pair), quadrotor_roll.MODE, rtol=2e-3)
    assert -pair.real / abs(pair) == pytest.approx(0.058, abs=0.003)
