# SPDX-License-Identifier: Apache-2.0
"""
Laguerre coefficients of sampled signals, seen from many instants.

The functions l_k(t) = sqrt(2 a) exp(-a t) L_k(2 a t), t >= 0, are orthonormal; their transforms
are sqrt(2 a) / (s + a) times powers of the all-pass (s - a) / (s + a). What follows t is
projected,

    c_k(t) = int_0^inf l_k(r) f(t + r) dr,

or, with r counted backwards, f(t - r): that is filtering. The functions obey a linear differential
equation, so that a shift is a matrix, l(t + h) = T(h) l(t), lower triangular Toeplitz with

    T_0 = exp(-a h),     T_j = exp(-a h) (L_j(2 a h) - L_(j-1)(2 a h)),

and the coefficients of one instant follow from those of the next: c(t) = T(h) c(t + h) plus the
integral over the h between, where the signal is held, a straight line or a piece of a spline.
All instants cost one sweep over the samples, at any stamps, and the sweep is exact: it never
leaves the bounded functions, whatever their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from typing import Literal

import numpy as np

from ctsid_core.bases.quadrature import SPLINED, UNIFORM, divided, smooth_values, spline_degree
from ctsid_core.linear.types import Array
from ctsid_core.model.simulation import CHUNK
from ctsid_core.signals.record import Signal

Direction = Literal['ahead', 'back']

_LONGEST = 4.0        # pole times interval: longer ones are divided
_EXTRA = 8            # Gauss-Legendre points beyond those that polynomials need
_DECAYED = 1e-10      # of a function: what counts as zero


def laguerre_functions(count: int, a: float, t: Array) -> Array:
    """Return Laguerre functions of pole a [rad/s] at t >= 0 [s]: (count, *t.shape) [s^-1/2]."""
    return np.asarray(np.sqrt(2.0 * a) * _damped(count, 2.0 * a * np.asarray(t, dtype=float)))


def _damped(count: int, x: Array) -> Array:
    """Return exp(-x / 2) L_k(x), shape (count, *x.shape); bounded by 1."""
    found = np.empty((count, *x.shape))
    found[0] = np.exp(-0.5 * x)
    if count > 1:
        found[1] = (1.0 - x) * found[0]
    for k in range(1, count - 1):
        found[k + 1] = ((2.0 * k + 1.0 - x) * found[k] - k * found[k - 1]) / (k + 1.0)
    return found


@lru_cache(maxsize=64)
def reach(count: int) -> float:
    """Return the time after which so many Laguerre functions have decayed, times their pole."""
    x = np.linspace(0.0, 12.0 * count + 80.0, 2000)
    alive = np.abs(_damped(count, x)).max(axis=0) > _DECAYED
    return 0.5 * float(x[np.flatnonzero(alive)[-1] + 1])


def shifted(count: int, a: float, h: Array) -> Array:
    """Return T(h) of shifts h >= 0 [s], l(t + h) = T(h) l(t): shape (*h.shape, count, count)."""
    column = _damped(count, 2.0 * a * h)
    column[1:] -= column[:-1].copy()
    apart = np.subtract.outer(np.arange(count), np.arange(count))
    matrix: Array = np.moveaxis(column[np.maximum(apart, 0)], (0, 1), (-2, -1))
    return np.ascontiguousarray(matrix * (apart >= 0))


@dataclass(frozen=True)
class Pieces:
    """A signal as polynomials between nodes."""

    nodes: Array  # (N + 1,), increasing [s]
    # (N, q, channels): at q equidistant points of each interval, both ends too; 1: constant
    values: Array


def coefficients(signals: Sequence[Signal], at: Array, span: tuple[float, float], a: float,
                 count: int, delays: Sequence[float], direction: Direction) -> Array:
    """
    Return `count` Laguerre coefficients of signals seen from instants (M,): (count, channels, M).

    Parameters
    ----------
    at : ndarray, shape (M,)
        Instants, increasing, within the span [s].
    span : (float, float)
        Interval outside of which the signals are taken as zero [s].
    a : float
        Pole [rad/s].
    delays : sequence of float
        Dead time of each signal: it is projected as f(t - delay) [s].
    direction : {'ahead', 'back'}
        Whether what follows an instant is projected, or what precedes it filtered.
    """
    found, pieces = [], [_pieces(s.time + delay, s, at, span, _LONGEST / a)
                         for s, delay in zip(signals, delays, strict=True)]
    for _, same in groupby(pieces, lambda p: p.nodes.tobytes()):     # are swept at once
        group = list(same)
        nodes = group[0].nodes
        seen = _swept(nodes, [p.values for p in group], a, count, direction)
        found.append(seen[np.searchsorted(nodes, at)].transpose(1, 2, 0))
    return np.concatenate(found, axis=1)


def _pieces(t: Array, signal: Signal, at: Array, span: tuple[float, float],
            longest: float) -> Pieces:
    inside = t[(t > span[0]) & (t < span[1])]
    nodes = divided(np.unique(np.concatenate((inside, at, span))), longest)
    step = np.diff(nodes)
    if signal.hold == 'zoh':
        row = np.clip(np.searchsorted(t, nodes[:-1], side='right') - 1, 0, None)
        return Pieces(nodes, signal.values[row][:, np.newaxis])
    values, degree = signal.values.T, 1
    if signal.hold == 'smooth' and len(t) >= SPLINED:
        degree = max(spline_degree(t, values), 3)
    x = np.arange(degree) / degree
    points = np.append((nodes[:-1, np.newaxis] + step[:, np.newaxis] * x).ravel(), nodes[-1])
    level = smooth_values(t, values, points, degree).T
    rows = np.arange(len(step))[:, np.newaxis] * degree + np.arange(degree + 1)
    return Pieces(nodes, level[rows])


def _swept(nodes: Array, values: list[Array], a: float, count: int,
           direction: Direction) -> Array:
    """Return the coefficients at all nodes, shape (N + 1, count, channels)."""
    step = np.diff(nodes)
    if np.ptp(step) <= UNIFORM * 1e-3 * step.mean():
        step = np.full(len(step), step.mean())
    if direction == 'back':
        step, values = step[::-1], [v[::-1, ::-1] for v in values]
    width = sum(v.shape[2] for v in values)
    found = np.zeros((len(step) + 1, count, width))
    for last in range(len(step), 0, -CHUNK):
        part = slice(max(last - CHUNK, 0), last)
        drive = np.concatenate([_drive(step[part], v[part], a, count) for v in values], axis=2)
        found[part] = _chunk(step[part], drive, found[last], a)
    return found[::-1] if direction == 'back' else found


def _drive(step: Array, values: Array, a: float, count: int) -> Array:
    """Return the integrals over the intervals, shape (N, count, channels)."""
    own = step[:1] if np.all(step == step[0]) else step
    q = values.shape[1]
    x, weight = np.polynomial.legendre.leggauss((count + q) // 2 + _EXTRA)
    x, weight = 0.5 * (x + 1.0), 0.5 * weight
    shares = np.linalg.solve(np.vander(np.arange(q) / max(q - 1, 1), increasing=True).T,
                             np.vander(x, q, increasing=True).T)     # of each point, (q, points)
    functions = laguerre_functions(count, a, own[:, np.newaxis] * x)  # (count, N, points)
    weights = (functions @ (weight * shares).T).transpose(1, 0, 2) * own[:, np.newaxis, np.newaxis]
    return np.asarray(np.matmul(weights, values))


def _chunk(step: Array, drive: Array, carry: Array, a: float) -> Array:
    """
    Sweep backwards: c_i = T(h_i) c_(i+1) + drive_i, with `carry` beyond the last.

    Blocks of intervals are swept side by side, then the carry from block to block; what is put
    before the first interval to fill its block is dropped.
    """
    n, count = len(step), drive.shape[1]
    size = int(np.ceil(np.sqrt(n)))
    blocks = -(-n // size)
    fill = blocks * size - n
    h = np.concatenate((np.full(fill, step[0]), step)).reshape(blocks, size)
    own = np.concatenate((np.zeros((fill, *drive.shape[1:])), drive)).reshape(
        blocks, size, *drive.shape[1:])
    left = np.cumsum(h[:, ::-1], axis=1)[:, ::-1]              # to the end of the block
    if np.all(h == h[0, 0]):
        h, left = h[:1], left[:1]
    one, all_left = shifted(count, a, h), shifted(count, a, left)
    for j in range(size - 2, -1, -1):
        own[:, j] += one[:, j] @ own[:, j + 1]
    beyond = np.empty((blocks, *carry.shape))
    for i in range(blocks - 1, -1, -1):
        beyond[i] = carry
        carry = own[i, 0] + all_left[i % len(all_left), 0] @ carry
    own += all_left @ beyond[:, np.newaxis]
    return own.reshape(-1, *carry.shape)[fill:]
