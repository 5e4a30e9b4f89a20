# SPDX-License-Identifier: Apache-2.0
"""
How to use the models of an identifier: a node that tunes a controller by them.

Four steps for every model: 1. decode it, 2. object to it, 3. design with it, 4. publish. A model
that fails any of them changes nothing: the last good gains stay, and a sentence on `~/verdict`
says why.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64MultiArray, String

from ctsid_core.errors import CtsidError
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_ros.examples.acceptance import Limits, objection, old
from ctsid_ros.examples.lqr import Gains, Weights, design
from ctsid_ros.messages import decode_metadata, decode_model, encode_matrix, encode_system_matrix

_PARAMETERS: dict[str, tuple[Any, str]] = {
    'inputs': (['torque'], 'Names of the inputs that the model must have, in this order.'),
    'outputs': (['rate'], 'Names of the outputs that the model must have, in this order.'),
    'outputs_allowed': ([1.0], 'Deviation of each output that is as unwelcome as ... [its unit]'),
    'inputs_allowed': ([0.1], '... this use of each input [its unit]. Larger: faster control.'),
    'disturbance': (0.02, 'Drive at the inputs that nobody measures: standard deviation of its '
                          'mean over a second, as a part of inputs_allowed [-].'),
    'least_margin': (0.4, 'Smallest disc margin of the loop, 0 to 2, also with poles moved by '
                          'three standard deviations [-].'),
    'vague': (0.2, 'Largest standard deviation of a pole, as a part of its size [-].'),
    'fit': (70.0, 'Least fit of each output, on the window and held out [%].'),
    'fresh_fit': (50.0, 'Least fit of the model before on the data that have come since [%].'),
    'age': (5.0, 'Longest time since the end of the window [s].'),
}


class GainTuner(Node):  # type: ignore[misc]  # rclpy has no types
    """
    Publish a controller for the plant that an identifier sees.

    Subscribes to `identifier/model`. Publishes, latched, `~/verdict` (a sentence for every
    model), and for accepted ones `~/controller` (the complete controller from y to u, as the
    matrices [A B K; C D I] that `ctsid_ros.messages.models.decode_system_matrix` reads; K is 0),
    `~/feedback` and `~/observer` (the gains F and L of `ctsid_ros.examples.lqr`, which mean
    something only together with the model that they were computed from).
    """

    def __init__(self) -> None:
        super().__init__('gain_tuner')
        for name, (default, meaning) in _PARAMETERS.items():
            self.declare_parameter(name, default, ParameterDescriptor(description=meaning))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._verdict = self.create_publisher(String, '~/verdict', latched)
        self._outlets = {name: self.create_publisher(Float64MultiArray, f'~/{name}', latched)
                         for name in ('controller', 'feedback', 'observer')}
        self.create_subscription(String, 'identifier/model', self._take, latched)

    def _take(self, message: String) -> None:
        """Tune by one model, or say why not."""
        try:
            estimate, more = decode_model(message), decode_metadata(message)  # 1.
            verdict, gains = self._tune(estimate, more.get('fresh_fit', np.empty(0)))
            verdict = f'Window {more.get("window", "?")}: {verdict}'
        except CtsidError as error:  # no model of an identifier, or parameters that cannot be
            verdict, gains = f'Refused: {error}.', None
        if gains is not None:
            self._publish(gains)  # 4.
        self._verdict.publish(String(data=verdict))
        self.get_logger().info(verdict)

    def _tune(self, estimate: Estimate, fresh_fit: Array) -> tuple[str, Gains | None]:
        why = objection(estimate, fresh_fit, self._now_ns(), self._limits())  # 2.
        if estimate.model is None or why:
            return f'Refused: {why}.', None
        found = design(estimate.model, estimate.pole_std, self._weights(),  # 3.
                       self._value('least_margin'))
        if found.gains and (why := old(estimate, self._now_ns(), self._limits())):
            return f'Refused after the design, which took its time: {why}.', None
        return found.verdict, found.gains

    def _now_ns(self) -> int:
        now: int = self.get_clock().now().nanoseconds
        return now

    def _publish(self, gains: Gains) -> None:
        self._outlets['controller'].publish(encode_system_matrix(gains.controller))
        self._outlets['feedback'].publish(encode_matrix('F', gains.feedback, 'u', 'x'))
        self._outlets['observer'].publish(encode_matrix('L', gains.observer, 'x', 'y'))

    def _limits(self) -> Limits:
        return Limits(tuple(self._value('inputs')), tuple(self._value('outputs')),
                      *(self._value(name) for name in ('vague', 'fit', 'fresh_fit', 'age')))

    def _weights(self) -> Weights:
        return Weights(tuple(self._value('outputs_allowed')),
                       tuple(self._value('inputs_allowed')), self._value('disturbance'))

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value
