# SPDX-License-Identifier: Apache-2.0
"""Kalman filters that know the robot: what predictions are possible without knowing the loop."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_continuous_are

from ctsid_core.linear.types import Array
from ctsid_core.model.statespace import StateSpace
from ctsid_ros.studies.robots.linear import Linear
from ctsid_ros.studies.robots.mechanics import cart_slopes

GUSTS = 2.0 * np.pi * 0.8       # bandwidth of the gusts, about [rad/s]
NO_NOISE = 1e-9                 # of the states, so that there is a filter at all


def steady(A: Array, B: Array, C: Array, drive: Array, noise: Array, delay: float) -> StateSpace:
    """
    Return a model with the gain of its steady Kalman filter.

    Parameters
    ----------
    A, B, C : ndarray
    drive : ndarray, shape (n, n)
        Intensity of the noise that drives the states.
    noise : ndarray, shape (ny, ny)
        Intensity of the measurement noise.
    delay : float
        [s]
    """
    # In units of the measurement noise: else Schur's form is lost where it is very small.
    whitened = np.linalg.solve(np.linalg.cholesky(noise), C)
    P = solve_continuous_are(A.T, whitened.T, drive + NO_NOISE * np.eye(len(A)), np.eye(len(C)))
    K = P @ C.T @ np.linalg.inv(noise)
    return StateSpace(A, B, C, K=K, delay=(delay,) * B.shape[1], noise=noise)


def rate_filter(plant: Linear, levels: tuple[float, float], rate: float) -> StateSpace:
    """
    Return the filter of a quadrotor's rates, the gusts among its states.

    Parameters
    ----------
    plant : Linear
    levels : pair of float
        Of the gyro's noise [rad/s] and of the gusts [rad/s^2].
    rate : float
        Of the gyro [Hz].
    """
    n, axes = len(plant.A), len(plant.C)
    A = np.zeros((n + axes, n + axes))
    A[:n, :n], A[:axes, n:] = plant.A, levels[1] * np.eye(axes)
    A[n:, n:] = -GUSTS * np.eye(axes)
    B = np.vstack((plant.B, np.zeros((axes, plant.nu))))
    drive = np.zeros_like(A)
    drive[n:, n:] = 2.0 * GUSTS * np.eye(axes)
    noise = levels[0] ** 2 / rate * np.eye(axes)
    return steady(A, B, np.eye(axes, n + axes), drive, noise, plant.delay)


def upright_filter(length: float, noise: Array) -> StateSpace:
    """
    Return the filter of a cart and its pole near the upright.

    Parameters
    ----------
    length : float
        [m]
    noise : ndarray, shape (2,)
        Intensity of the errors of place and angle.
    """
    step, still = 1e-6, np.zeros(5)
    slopes = [np.array(cart_slopes(tuple(x[:4]), x[4], length)) / step
              for x in still + step * np.eye(5)]
    joined = np.column_stack(slopes)
    return steady(joined[:, :4], joined[:, 4:], np.eye(2, 4), np.zeros((4, 4)), np.diag(noise),
                  0.0)
