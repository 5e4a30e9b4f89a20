# SPDX-License-Identifier: Apache-2.0
"""
The simulated robot as a ROS node.

It publishes what a flight sends, in real time, and what is to be found in it, on `~/truth`. Its
clock is the one that runs evenly: a stamp is the node's time at the start, plus the time since.
"""

from __future__ import annotations

from dataclasses import replace
import math
from threading import Event, Thread
import time
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
import numpy as np
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.storage import to_json
from ctsid_core.settings import Settings
from ctsid_ros.examples.flight import Command, Conditions, Flight, Measurement
from ctsid_ros.examples.quadrotor_roll import (
    ANGLE_NOISE,
    COMMAND_RATE,
    GYRO_NOISE,
    IMU_RATE,
    Plant,
)

TORQUE_TOPIC, IMU_TOPIC = 'command/torque', 'imu'
_HELD_UP_NS = 50_000_000  # messages sent so much after their time are reported
# Name: default, lowest, highest, meaning. Only those of _CHANGEABLE may change while it flies.
_PARAMETERS: dict[str, tuple[Any, Any, Any, str]] = {
    'payload': (0.0, 0.0, 5.0, 'Mass attached below body and boom [kg]; may change in flight.'),
    'change_after': (0.0, 0.0, 1e6, 'When a payload is attached by itself [s]; 0: never.'),
    'change_to': (0.5, 0.0, 5.0, 'That payload [kg].'),
    'command_rate': (COMMAND_RATE, 1.0, 1000.0, 'Torque commands a second [Hz].'),
    'imu_rate': (IMU_RATE, 1.0, 2000.0, 'Measurements a second [Hz].'),
    'noise': (1.0, 0.01, 100.0, "The sensor's noise, as a factor of the usual one [-]."),
    'gusts': (1.0, 0.01, 100.0, 'The gusts, as a factor of the usual ones [-].'),
    'lost': (0.005, 0.0, 0.9, 'Share of the measurements that are never sent [-].'),
    'seed': (0, 0, 2**31 - 1, 'Number that all chance is drawn from; 0: another each time.'),
}
_CHANGEABLE = ('payload',)


class SimulatedRobot(Node):  # type: ignore[misc]  # rclpy has no types
    """
    Publish commands and measurements of a flight in real time.

    If the computer is busy, messages are sent later, but none is left out and their stamps stay
    those of their time; `held_up` counts how often.

    Attributes
    ----------
    held_up : int
    """

    def __init__(self) -> None:
        super().__init__('simulated_robot')
        for name, (default, low, high, meaning) in _PARAMETERS.items():
            self.declare_parameter(name, default, _descriptor(name, meaning, low, high))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._truth = self.create_publisher(String, '~/truth', latched)
        self._commands = self.create_publisher(WrenchStamped, TORQUE_TOPIC, 10)
        self._samples = self.create_publisher(Imu, IMU_TOPIC, qos_profile_sensor_data)
        self._command_message = WrenchStamped()
        self._command_message.header.frame_id = 'base_link'
        self._imu_message = _imu_message(self._value('noise'))
        self._payload = self._value('payload')
        self.add_post_set_parameters_callback(self._parameters_set)
        if after := self._value('change_after'):
            self._attach = self.create_timer(after, self._attach_payload)
        self.held_up = 0
        self._ended = Event()
        self._thread = Thread(target=self._fly, name='flight')
        self._thread.start()

    def close(self) -> None:
        """Land: send nothing more."""
        self._ended.set()
        self._thread.join()

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _attach_payload(self) -> None:
        self._attach.cancel()
        self.set_parameters([Parameter('payload', value=self._value('change_to'))])

    def _parameters_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == 'payload':
                self._payload = parameter.value  # taken up by the flight's thread

    def _fly(self) -> None:
        try:
            self._send_all()
        except Exception:
            # A signal may have taken the context away under a call of the middleware.
            if self.context.ok():
                raise

    def _send_all(self) -> None:
        plant = Plant(self._payload, self._value('gusts'))
        flight = Flight(self._conditions(), self._seed(), plant)
        start_ns, began_ns = self.get_clock().now().nanoseconds, time.monotonic_ns()
        self._tell_truth(plant, start_ns)
        while not self._ended.is_set():
            now_ns = time.monotonic_ns() - began_ns
            self._send(flight.sent(now_ns), start_ns, now_ns)
            if self._payload != plant.payload:
                plant = replace(plant, payload=self._payload)
                flight.change(plant, now_ns)
                self._tell_truth(plant, start_ns + now_ns)
            wait_ns = flight.next_ns() - (time.monotonic_ns() - began_ns)
            if wait_ns > 0:
                self._ended.wait(wait_ns * 1e-9)

    def _conditions(self) -> Conditions:
        return Conditions(**{name: self._value(name) for name in
                             ('command_rate', 'imu_rate', 'noise', 'lost')})

    def _seed(self) -> int:
        seed = self._value('seed') or int(np.random.default_rng().integers(1, 2**31))
        self.get_logger().info(f'flying; repeat this flight with seed {seed}')
        return seed

    def _send(self, due: list[Command | Measurement], start_ns: int, now_ns: int) -> None:
        if due and now_ns - due[0].sent_ns > _HELD_UP_NS:
            self.held_up += 1
            self.get_logger().warning(
                f'held up for {(now_ns - due[0].sent_ns) * 1e-9:.2f} s: {len(due)} messages are '
                f'sent late, with the stamps of their time ({self.held_up} times so far)')
        for message in due:
            stamp_ns = start_ns + message.stamp_ns
            if isinstance(message, Command):
                self._command_message.header.stamp = _stamp(stamp_ns)
                self._command_message.wrench.torque.x = message.torque
                self._commands.publish(self._command_message)
            else:
                _fill(self._imu_message, message, stamp_ns)
                self._samples.publish(self._imu_message)

    def _tell_truth(self, plant: Plant, since_ns: int) -> None:
        rate = self._value('imu_rate') * (1 - self._value('lost'))
        model = plant.true_model(self._value('noise') * GYRO_NOISE, rate)
        estimate = Estimate(status=Status.OK, settings=Settings(), model=model, start_ns=since_ns,
                            notes=('This is the simulated plant itself, from start_ns on.',))
        self._truth.publish(String(data=to_json(estimate, {'payload_kg': plant.payload})))
        self.get_logger().info(f'the payload is {plant.payload:g} kg')


def _descriptor(name: str, meaning: str, low: float, high: float) -> ParameterDescriptor:
    limits = {'from_value': low, 'to_value': high}
    return ParameterDescriptor(
        description=meaning, read_only=name not in _CHANGEABLE,
        **({'integer_range': [IntegerRange(**limits)]} if isinstance(low, int) else
           {'floating_point_range': [FloatingPointRange(**limits)]}))


def _stamp(time_ns: int) -> Time:
    return Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def _covariance(deviation: float) -> list[float]:
    return np.diag([deviation**2] * 3).ravel().tolist()


def _imu_message(noise: float) -> Imu:
    """Return a message in which all is filled that stays the same."""
    message = Imu()
    message.header.frame_id = 'base_link'
    message.linear_acceleration.z = 9.81
    message.orientation_covariance = _covariance(noise * ANGLE_NOISE)
    message.angular_velocity_covariance = _covariance(noise * GYRO_NOISE)
    message.linear_acceleration_covariance = _covariance(noise * 0.15)
    return message


def _fill(message: Imu, measured: Measurement, stamp_ns: int) -> None:
    message.header.stamp = _stamp(stamp_ns)
    rate = message.angular_velocity
    rate.x, rate.y, rate.z = measured.rates
    message.orientation.x = math.sin(measured.roll / 2)
    message.orientation.w = math.cos(measured.roll / 2)
