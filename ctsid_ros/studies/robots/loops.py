# SPDX-License-Identifier: Apache-2.0
"""Robots under their controllers: set points under PI, rates of a quadrotor under PID."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ctsid_core.linear.types import Array
from ctsid_ros.studies.robots.linear import Linear


class Stepped:
    """
    A linear plant that is moved from command to command.

    Parameters
    ----------
    plant : Linear
    period : float
        Of the commands; each acts from the dead time after its own instant on [s].
    """

    def __init__(self, plant: Linear, period: float) -> None:
        whole = int(plant.delay // period)
        rest = plant.delay - whole * period
        self._C = plant.C
        self._old, self._new = _held(plant, rest), _held(plant, period - rest)
        self._waiting = [np.zeros(plant.nu) for _ in range(whole + 2)]
        self._x = np.zeros(len(plant.A))

    @property
    def y(self) -> Array:
        """The outputs now."""
        return np.asarray(self._C @ self._x)

    def step(self, u: Array) -> None:
        """Command something, and go on to the next command's instant."""
        self._waiting = [*self._waiting[1:], u]
        for (F, G), acting in zip((self._old, self._new), self._waiting[:2], strict=True):
            self._x = F @ self._x + G @ acting

    def kick(self, change: Array) -> None:
        """Move the states."""
        self._x = self._x + change


def _held(plant: Linear, step: float) -> tuple[Array, Array]:
    n, nu = len(plant.A), plant.nu
    joined = expm(step * np.block([[plant.A, plant.B], [np.zeros((nu, n + nu))]]))
    return joined[:n, :n], joined[:n, n:]


def under_pi(plant: Linear, wanted: Array, noise: Array, period: float,
             gains: tuple[float, float]) -> Array:
    """
    Return what a PI controller commands.

    Parameters
    ----------
    plant : Linear
        One input, one output.
    wanted, noise : ndarray, shape (J,)
        Set point and error of the measurement at each command.
    period : float
        [s]
    gains : pair of float
        Of the error and of its integral.

    Returns
    -------
    ndarray, shape (J, 1)
    """
    loop, whole, u = Stepped(plant, period), 0.0, np.empty((len(wanted), 1))
    for k, (goal, off) in enumerate(zip(wanted.tolist(), noise.tolist(), strict=True)):
        error = goal - loop.y[0] - off
        whole += period * error
        u[k] = gains[0] * error + gains[1] * whole
        loop.step(u[k])
    return u


@dataclass(frozen=True, eq=False)
class RatePid:
    """
    A flight controller of rates.

    Parameters
    ----------
    plant : Linear
        From actuators to rates.
    share : ndarray, shape (nu, ny)
        What each actuator does for the command of an axis.
    gain, integral, differential : float
        Of the error [1], its integral [1/s] and the rates' differences [s].
    each : int
        Samples of the gyro between commands.
    """

    plant: Linear
    share: Array
    gain: float
    integral: float
    differential: float
    each: int

    def fly(self, wanted: Array, extra: Array, noise: Array, kicks: Array,
            period: float) -> tuple[Array, Array]:
        """
        Return the commands at every sample of the gyro, and what the gyro measures.

        Parameters
        ----------
        wanted : ndarray, shape (J, ny)
            Rates.
        extra : ndarray, shape (J, nu)
            Added to the actuators' commands.
        noise, kicks : ndarray, shapes (J, ny), (J, n)
            Of the gyro; of the states, from sample to sample.
        period : float
            Of the gyro [s].
        """
        loop, whole, slow = Stepped(self.plant, period), np.zeros(noise.shape[1]), 0.0
        u, y = np.empty_like(extra), np.empty_like(noise)
        last, keep = noise[0], np.exp(-self.each * period / 0.01)
        for k in range(len(y)):
            y[k] = loop.y + noise[k]
            if k % self.each == 0:
                error, step = wanted[k] - y[k], self.each * period
                whole = whole + step * error
                slow, last = keep * slow + (1.0 - keep) * (y[k] - last) / step, y[k]
                torque = self.gain * error + self.integral * whole - self.differential * slow
                now = self.share @ torque + extra[k]
            u[k] = now
            loop.step(now)
            loop.kick(kicks[k])
        return u, y
