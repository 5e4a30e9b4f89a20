# SPDX-License-Identifier: Apache-2.0
"""Motion that is not linear: one coordinate under a force law, a cart with a pole on it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import ceil, cos, sin

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_ros.studies.robots.linear import Held

STEP = 4e-3     # longest step of Runge and Kutta's [s]: errors below 1e-6 of these motions
Law = Callable[[float, float, float], float]


def accelerated(law: Law, held: Held, times: Array, delay: float = 0.0) -> tuple[Array, Array]:
    """
    Return place and speed of x'' = law(x, x', u) from rest, by Runge and Kutta's fourth order.

    Parameters
    ----------
    law : callable
        Of place, speed and input.
    held : Held
        One input.
    times : ndarray, shape (N,)
    delay : float
        [s]

    Returns
    -------
    place, speed : ndarray, shape (N,)
    """
    ends = np.append(held.time, max(times[-1] - delay, held.time[-1]) + STEP)
    x = v = 0.0
    grid = [(float(ends[0]), x, v, 0.0)]
    for (start, end), u in zip(pairwise(ends.tolist()), held.values[:, 0].tolist(), strict=True):
        count = ceil((end - start) / STEP)
        h = (end - start) / count
        for i in range(count):
            x, v, a = _step(law, x, v, u, h)
            grid.append((start + (i + 1) * h, x, v, a))
    return _between(np.array(grid), times - delay)


def _step(law: Law, x: float, v: float, u: float, h: float) -> tuple[float, float, float]:
    """Return place and speed after a step, and the mean acceleration in it."""
    a = law(x, v, u)
    v2 = v + 0.5 * h * a
    b = law(x + 0.5 * h * v, v2, u)
    v3 = v + 0.5 * h * b
    c = law(x + 0.5 * h * v2, v3, u)
    v4 = v + h * c
    d = law(x + h * v3, v4, u)
    mean = (a + 2.0 * b + 2.0 * c + d) / 6.0
    return x + h * (v + 2.0 * v2 + 2.0 * v3 + v4) / 6.0, v + h * mean, mean


def _between(grid: Array, times: Array) -> tuple[Array, Array]:
    """Return place (cubic) and speed (linear: accelerations jump with the input) at instants."""
    t, x, v, _ = grid.T
    k = np.clip(np.searchsorted(t, times, side='right') - 1, 0, len(t) - 2)
    h = t[k + 1] - t[k]
    s = np.clip((times - t[k]) / h, 0.0, 1.0)
    place = x[k] * (1 + 2 * s) * (1 - s) ** 2 + x[k + 1] * s * s * (3 - 2 * s) \
        + h * (v[k] * s * (1 - s) ** 2 - v[k + 1] * s * s * (1 - s))
    return place, v[k] + s * (v[k + 1] - v[k])


def cart_pole(pushes: Array, noise: Array, period: float,
              gains: tuple[float, ...], length: float) -> tuple[Array, Array]:
    """
    Return what the controller of a cart commanded and the states of cart and pole.

    Parameters
    ----------
    pushes : ndarray, shape (J,)
        Added to the controller's command [N].
    noise : ndarray, shape (J, 2)
        Of the place and the angle that the controller measures [m, rad].
    period : float
        Of the controller [s]; it holds its command in between.
    gains : tuple of 4 floats
        Of place, angle, and their difference quotients behind a lag of four periods.
    length : float
        From the joint to the pole's centre of mass [m]; the cart has 1 kg, the pole 0.1 kg.

    Returns
    -------
    u : ndarray, shape (J,)
    states : ndarray, shape (J, 4)
        Place, angle and their speeds at each command.
    """
    x: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    u, states = np.empty(len(pushes)), np.empty((len(pushes), 4))
    last, slow = (float(noise[0, 0]), float(noise[0, 1])), [0.0, 0.0]
    for k, (push, off) in enumerate(zip(pushes.tolist(), noise.tolist(), strict=True)):
        seen = (x[0] + off[0], x[1] + off[1])
        slow = [s + 0.25 * ((new - old) / period - s)
                for s, new, old in zip(slow, seen, last, strict=True)]
        u[k] = push + gains[0] * seen[0] + gains[1] * seen[1] + gains[2] * slow[0] \
            + gains[3] * slow[1]
        states[k], last = x, seen
        for _ in range(4):
            x = _cart_step(x, float(u[k]), period / 4.0, length)
    return u, states


def _cart_step(x: tuple[float, ...], u: float, h: float, length: float) -> tuple[float, ...]:
    """Take a step of Heun's method."""
    a = cart_slopes(x, u, length)
    b = cart_slopes(tuple(p + h * q for p, q in zip(x, a, strict=True)), u, length)
    return tuple(p + 0.5 * h * (q + r) for p, q, r in zip(x, a, b, strict=True))


def cart_slopes(x: tuple[float, ...], u: float, length: float) -> tuple[float, ...]:
    """Return the derivatives of place, angle and their speeds under a force."""
    _, angle, speed, turn = x
    s, c = sin(angle), cos(angle)
    push = (u - 0.5 * speed + 0.1 * length * turn * turn * s) / 1.1
    turned = (9.81 * s - c * push - 0.2 * turn) / (length * (4.0 / 3.0 - 0.1 * c * c / 1.1))
    return speed, turn, push - 0.1 * length * turned * c / 1.1, turned
