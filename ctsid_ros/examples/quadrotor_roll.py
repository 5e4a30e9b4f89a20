# SPDX-License-Identifier: Apache-2.0
"""
The roll loop of a simulated quadrotor: the plant, its true model, and its flight step by step.

An attitude controller commands a roll torque, held until the next command. The torque passes the
motors' lag and turns a body that carries a camera boom on a slightly flexible joint, in gusty
air. An inertial sensor measures roll rate and attitude. Between any two stamps the motion is
integrated exactly. A payload may be attached, in flight too: it makes body and boom heavier, and
the controller does not know of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm, solve_continuous_are

from ctsid_core.linear.types import Array
from ctsid_core.model.statespace import StateSpace

# The plant. States: motor torque [N m], body roll rate [rad/s], joint angle [rad], boom rate.
MOTOR_POLE = -20.0  # rad/s
AIR_POLE = -2.0  # rad/s: aerodynamic damping of the rigid vehicle
BODY, BOOM = 0.016, 0.004  # kg m^2: roll inertia of body and boom
MODE, DAMPING = 2 * np.pi * 5.0, 0.05  # rad/s, -: the boom's mode on the free vehicle
TORQUE_OFFSET = 0.008  # N m: centre of gravity beside the centre of thrust
GUST = 6e-7  # N^2 m^2 s: spectral density of the gusts' torque
# What a payload adds: two thirds of it hang below the body, one third at the end of the boom.
BODY_PER_KG, BOOM_PER_KG = 0.024, 0.008  # kg m^2/kg

# The sensor and the controller.
COMMAND_RATE, IMU_RATE = 50.0, 200.0  # Hz
GYRO_NOISE, GYRO_BIAS = 0.02, 0.015  # rad/s
GYRO_STEP = np.deg2rad(2000.0) / 2**15  # rad/s: a 16-bit gyro of +- 2000 deg/s
ANGLE_NOISE = 0.003  # rad
ANGLE_GAIN, RATE_GAIN = 36.0, 9.0  # 1/s^2, 1/s
TORQUE_LIMIT, TORQUE_STEP = 0.4, 1e-4  # N m


@dataclass(frozen=True)
class Plant:
    """
    The vehicle and the air around it.

    Parameters
    ----------
    payload : float
        Mass attached below body and boom [kg].
    gusts : float
        Size of the gusts' torque, as a factor of the usual one.
    """

    payload: float = 0.0
    gusts: float = 1.0

    @property
    def body(self) -> float:
        """Roll inertia of the body with its part of the payload [kg m^2]."""
        return BODY + BODY_PER_KG * self.payload

    @property
    def boom(self) -> float:
        """Roll inertia of the boom with its part of the payload [kg m^2]."""
        return BOOM + BOOM_PER_KG * self.payload

    @property
    def gust_density(self) -> float:
        """Spectral density of the gusts' torque [N^2 m^2 s]."""
        return GUST * self.gusts**2

    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C and the column by which a roll torque acts on the body."""
        stiffness = MODE**2 / (1 / BODY + 1 / BOOM)
        joint = 2 * DAMPING * stiffness / MODE
        air = -AIR_POLE * (BODY + BOOM)
        body, boom = self.body, self.boom
        A = np.array([
            [MOTOR_POLE, 0.0, 0.0, 0.0],
            [1 / body, -(air + joint) / body, -stiffness / body, joint / body],
            [0.0, 1.0, 0.0, -1.0],
            [0.0, joint / boom, stiffness / boom, -joint / boom]])
        B = np.array([[-MOTOR_POLE], [0.0], [0.0], [0.0]])
        C = np.array([[0.0, 1.0, 0.0, 0.0]])
        return A, B, C, np.array([[0.0], [1 / body], [0.0], [0.0]])

    def true_model(self, gyro_noise: float = GYRO_NOISE, imu_rate: float = IMU_RATE
                   ) -> StateSpace:
        """
        Return the true model in innovation form; K is the stationary Kalman gain.

        Parameters
        ----------
        gyro_noise : float
            Standard deviation of one measured rate [rad/s].
        imu_rate : float
            How many are measured per second [Hz].
        """
        A, B, C, torque_on_body = self.matrices()
        noise = np.array([[gyro_noise**2 / imu_rate]])
        gusts = self.gust_density * torque_on_body @ torque_on_body.T
        covariance = solve_continuous_are(A.T, C.T, gusts, noise)
        return StateSpace(
            A=A, B=B, C=C, D=np.zeros((1, 1)), K=covariance @ C.T / noise, delay=(0.0,),
            x_trim=TORQUE_OFFSET * torque_on_body[:, 0], y_trim=np.array([GYRO_BIAS]),
            input_names=('torque',), output_names=('rate',), input_units=('N m',),
            output_units=('rad/s',), noise=noise)


@lru_cache(maxsize=8)
def motion_matrix(plant: Plant) -> Array:
    """Return the generator of states, roll angle, commanded and disturbing torque, (7, 7)."""
    A, B, C, torque_on_body = plant.matrices()
    motion = np.zeros((7, 7))
    motion[:4, :4], motion[:4, 5:6], motion[:4, 6:7], motion[4, :4] = A, B, torque_on_body, C[0]
    return motion


class Motion:
    """
    The vehicle in closed loop, moved from stamp to stamp.

    Parameters
    ----------
    rng : Generator
        Draws the gusts: one number per move.
    plant : Plant
        May be replaced at any time: a payload is attached with nothing jumping.
    """

    def __init__(self, rng: np.random.Generator, plant: Plant = Plant()) -> None:  # noqa: B008
        self.plant = plant
        self._rng = rng
        self._now_ns = 0
        self._state = np.zeros(5)  # the 4 states and the roll angle
        self._torque = 0.0
        self._measured = (0.0, 0.0)  # rate and angle, as the controller knows them

    def move(self, time_ns: int) -> None:
        """Let time pass until `time_ns`, since the start [ns]; never back."""
        duration_ns = int(time_ns - self._now_ns)
        if duration_ns <= 0:
            return
        gust = self._rng.standard_normal() * np.sqrt(
            self.plant.gust_density / (duration_ns * 1e-9))
        torques = [self._torque, gust + TORQUE_OFFSET]
        step = expm(motion_matrix(self.plant) * (duration_ns * 1e-9))[:5]
        self._state = step @ np.concatenate([self._state, torques])
        self._now_ns = int(time_ns)

    def measure(self, rate_error: float, angle_error: float) -> tuple[float, float]:
        """Return the roll rate [rad/s] and angle [rad] measured now, with the errors given."""
        rate = float(self._state[1] + GYRO_BIAS + rate_error)
        self._measured = rate, float(self._state[4] + angle_error)
        return self._measured

    def command(self, wanted: float) -> float:
        """Return the torque that is commanded from now on towards a roll angle [N m]."""
        rate, angle = self._measured
        turn = ANGLE_GAIN * (wanted - angle) - RATE_GAIN * rate
        limited = np.clip((BODY + BOOM) * turn, -TORQUE_LIMIT, TORQUE_LIMIT)
        self._torque = float(quantised(limited, TORQUE_STEP))
        return self._torque


def quantised(values: Array, step: float) -> Array:
    """Round to multiples of `step`, as a converter does."""
    return np.asarray(np.round(values / step) * step)
