# SPDX-License-Identifier: Apache-2.0
"""
Signals between samples as polynomials through the nearest samples, [TM] section IV-C.

[TM] eq. 21 wants the polynomial of degree p through the p + 1 samples around each interval. The
range of samples printed there, floor(-p/2) .. floor(p/2) - 1, has p of them for even p, and for
odd p it leaves out the interval's own first sample: here the p + 1 nearest are taken, one more
before the interval than after it for even p. At the ends of a signal the nearest ones are those
inside of it: the paper puts zeros outside, which is right only for signals that start and end at
rest, and wrong by the size of the signal otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.simulation import Pieces
from ctsid_core.signals.record import Signal


def local_polynomials(degree: int) -> Pieces:
    """Return a function like `simulation.input_polynomials`, by polynomials of a degree."""

    def pieces(signals: Sequence[Signal], delay: Sequence[float], knots: Array) -> Array:
        found, first = [], 0
        for signal in signals:
            for j in range(signal.width):
                found.append(derivatives(signal.time + delay[first + j], signal.values[:, j],
                                         degree, knots))
            first += signal.width
        return np.stack(found, axis=2) if found else np.zeros((1, len(knots), 0))

    return pieces


def derivatives(stamps: Array, values: Array, degree: int, knots: Array) -> Array:
    """
    Return the derivatives 0 ... degree of the local polynomial at each knot, (degree + 1, K).

    Parameters
    ----------
    stamps, values : ndarray, shape (N,)
        Increasing [s]. With fewer than degree + 1 samples the degree is lower. Before the first
        and after the last the signal is held.
    degree : int
    knots : ndarray, shape (K,)
        [s]
    """
    order = min(degree, len(stamps) - 1)
    interval = np.clip(np.searchsorted(stamps, knots, side='right') - 1, 0, len(stamps) - 1)
    first = np.clip(interval - order // 2, 0, len(stamps) - 1 - order)
    span = first[:, np.newaxis] + np.arange(order + 1)
    away = stamps[span] - np.clip(knots, stamps[0], stamps[-1])[:, np.newaxis]
    size = np.maximum(np.abs(away).max(axis=1, keepdims=True), 1e-300)
    vandermonde = (away / size)[:, :, np.newaxis] ** np.arange(order + 1)
    taylor = np.linalg.solve(vandermonde, values[span][:, :, np.newaxis])[:, :, 0]
    found = np.zeros((degree + 1, len(knots)))
    for j in range(order + 1):
        found[j] = factorial(j) * taylor[:, j] / size[:, 0] ** j
    outside = (knots < stamps[0]) | (knots >= stamps[-1])
    found[1:, outside] = 0.0
    return found
