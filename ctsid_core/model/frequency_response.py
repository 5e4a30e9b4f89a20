# SPDX-License-Identifier: Apache-2.0
"""Frequency response of a state-space model, also exactly at its poles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.linear.matrix_functions import balanced
from ctsid_core.linear.types import Array, ComplexArray

_CIRCLE = 64  # points of the circle around a pole
_SEEN = 1e-10  # a principal part below this fraction of |C row| |B column| or entry is rounding


def transfer(A: Array, B: Array, C: Array, D: Array, delay: Sequence[float],
             omega: Array) -> ComplexArray:
    """Return (C (j omega I - A)^-1 B + D) exp(-j omega delay), shape (M, ny, nu)."""
    s = np.asarray(1j * omega, dtype=complex)
    late: ComplexArray = np.exp(-s[:, np.newaxis, np.newaxis] * np.asarray(delay))
    if not len(A):
        return np.asarray(D * late)
    scaled, scale = balanced(A)
    B, C = B / scale[:, np.newaxis], C * scale
    poles: ComplexArray = np.linalg.eigvals(scaled).astype(complex)
    rounding = len(A) * np.finfo(float).eps * np.linalg.norm(scaled)
    distance: Array = np.abs(s[:, np.newaxis] - poles)
    near = (distance.min(axis=1) <= rounding) | (np.linalg.slogdet(_system(scaled, s))[0] == 0.0)
    response = np.empty((len(s), *D.shape), dtype=complex)
    response[~near] = C @ np.linalg.solve(_system(scaled, s[~near]), B[np.newaxis])
    for k in np.flatnonzero(near):
        response[k] = _at_pole(scaled, B, C, s[k], distance[k], rounding)
    response += D
    return np.where(np.isfinite(response), response * late, response)


def _system(A: Array, s: ComplexArray) -> ComplexArray:
    return np.asarray(s[:, np.newaxis, np.newaxis] * np.eye(len(A)) - A)


def _at_pole(A: Array, B: Array, C: Array, s: complex, distance: Array,
             rounding: float) -> ComplexArray:
    # Laurent series around s from a circle that encloses only the poles at s: an entry with a
    # principal part is infinite there, any other is its mean over the circle.
    others = distance[distance > max(1e-4 * float(np.max(distance)), rounding)]
    radius = float(np.min(others)) / 2 if len(others) else 1.0
    circle = np.exp(2j * np.pi * np.arange(_CIRCLE) / _CIRCLE)
    values = C @ np.linalg.solve(_system(A, np.asarray(s + radius * circle)), B[np.newaxis])
    series = np.fft.fft(values, axis=0) / _CIRCLE
    principal = np.abs(series[_CIRCLE - len(A):]).max(axis=0)
    size = np.linalg.norm(C, axis=1)[:, np.newaxis] * np.linalg.norm(B, axis=0) / radius
    seen = principal > _SEEN * np.maximum(np.abs(values).max(axis=0), size)
    return np.where(seen, complex(np.inf, np.nan), series[0])
