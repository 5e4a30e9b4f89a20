# SPDX-License-Identifier: Apache-2.0
"""
What interpolation of the outputs misses between samples, as far as the inputs tell.

An output is D u + C B J u + C A B J^2 u + ..., J the integral, beside the smooth free response.
A held input jumps at its stamps, so J u has corners there, and J^2 u jumps of curvature. No
polynomial through samples of the output follows these. With S the interpolation, linear in the
samples, what it misses is (1 - S) y = C B (1 - S) J u + C A B (1 - S) J^2 u + ...: known signals
times unknown numbers. As inputs that act on the outputs at once, they make the equations of
interpolated outputs exact to the next power of the sampling period.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import factorial

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Signal

_NOTHING = 1e-12      # of a signal, that interpolation misses by rounding


def integrated(derivatives: Array, knots: Array) -> Array:
    """
    Return the integral from the first knot of piecewise polynomials, in the same form.

    From derivatives just after each knot, (degree + 1, K, m), at knots (K,) [s]; one degree more.
    """
    h = np.diff(knots)[:, np.newaxis]
    steps = sum((v[:-1] * h ** (j + 1) / factorial(j + 1) for j, v in enumerate(derivatives)),
                np.zeros(()))
    value = np.concatenate([np.zeros_like(derivatives[0, :1]), np.cumsum(steps, axis=0)])
    return np.concatenate([value[np.newaxis], derivatives])


def interpolation_errors(u: Array, knots: Array, outputs: Sequence[Signal],
                   interpolate: Callable[[Sequence[Signal], Sequence[float], Array], Array],
                   count: int, first: int = 1) -> Array:
    """
    Return what interpolation of each output signal misses of the inputs' integrals.

    Inputs u (degree + 1, K, nu) are given with derivatives just after each knot; all stamps are
    among the knots (K,) [s]. Of the outputs, stamps and holds count; `interpolate` is as
    `simulation.input_polynomials`. `count` integrals are looked at, none at all for 0, and with
    `first` = 0 the inputs themselves, which outputs follow at once. Shape (degree + 1 + count or
    less, K, (count + 1 - first) * nu * signals), zero where it is no more than rounding.
    """
    found: list[Array] = []
    integral = u
    for power in range(count + 1 if u.shape[2] and count else 0):
        integral = integrated(integral, knots) if power else integral
        if power >= first:
            found += [x for signal in outputs
                      for x in _interpolation_error(integral, knots, signal, interpolate)]
    return np.stack(of_one_degree(found), axis=2) if found else np.zeros((1, len(knots), 0))


def of_one_degree(parts: Sequence[Array]) -> list[Array]:
    """Return derivatives (degree + 1, ...) with zeros up to the highest degree among them."""
    degree = max(map(len, parts))
    return [np.concatenate((p, np.zeros((degree - len(p), *p.shape[1:])))) for p in parts]


def _interpolation_error(signal: Array, knots: Array, output: Signal,
            interpolate: Callable[[Sequence[Signal], Sequence[float], Array], Array],
            ) -> list[Array]:
    inside = np.isin(output.time, knots)
    places = np.searchsorted(knots, output.time[inside])
    m = signal.shape[2]
    sampled = replace(output, time=output.time[inside], values=signal[0, places], names=(),
                      units=())
    curve = interpolate((sampled,), (0.0,) * m, knots)
    whole, smooth = of_one_degree((signal, curve))
    error = whole - smooth
    size = np.abs(signal[0]).max(axis=0) + 1e-300
    error[:, :, np.abs(_middles(error, knots)).max(axis=0) <= _NOTHING * size] = 0.0
    return [error[:, :, j] for j in range(m)]


def _middles(derivatives: Array, knots: Array) -> Array:
    half = 0.5 * np.diff(knots)[:, np.newaxis]
    return sum((v[:-1] * half ** j / factorial(j) for j, v in enumerate(derivatives)),
               np.zeros(()))
