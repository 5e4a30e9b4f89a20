# SPDX-License-Identifier: Apache-2.0
"""
Hermite coefficients of sampled signals, exact for what is known of them between the samples.

All is done in the dimensionless time x = (t - t_c) / alpha ([HD] eq. 31). A signal f is zero
outside of [start, end]. Integrating by parts moves the integral to the signal's jumps:

    c_(n+1) = sqrt(n / (n+1)) c_(n-1) + sqrt(2 / (n+1)) g_n,       g_n = <h_n, df/dx>     (eq. 19)

A held signal's derivative is a sum of impulses at its stamps, so that g is one sum over the
samples and c is exact. A signal of straight lines has a held derivative: the same step twice. A
smooth signal is a spline, integrated by the trapezoid rule where stamps are uniform (spectrally
accurate, the basis having decayed at the ends) and else by Gauss-Legendre points in every
interval. The degree of the spline, 1, 3 or 5, is the one that predicts every second sample from
the others best: straight lines where noise dominates, the fifth where the signal is clean and
its sampling coarse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import make_interp_spline

from ctsid_core.bases.hermite_functions import integral_of_first, project
from ctsid_core.linear.types import Array
from ctsid_core.signals.gaps import GAP_PERIODS
from ctsid_core.signals.record import Signal

_UNIFORM = 1e-6        # stamps whose intervals agree to this fraction count as uniform
_SPLINED = 8           # samples from which on there is a spline
_DEGREES = (1, 3, 5)
_PHASE = 0.6          # top frequency times interval [rad] up to which two points are enough
_STEEP = 1e-5         # the same, below which a straight line is a jump: its slope is all rounding


@dataclass(frozen=True)
class Samples:
    """A signal made ready for projection: weights at nodes, and the steps to its coefficients."""

    x: Array        # (N,): nodes, dimensionless
    weights: Array  # (m, N): summed with h_n at the nodes; several blocks if `finish` wants them
    # from sums (m, nmax + 1) to coefficients (channels, nmax + 1)
    finish: Callable[[Array], Array]


def coefficients(signals: Sequence[Signal], start: float, end: float, alpha: float, nmax: int,
                 delays: Sequence[float]) -> list[Array]:
    """
    Project signals on h_0 .. h_nmax, [HD] eq. 33, 34: each of shape (channels, nmax + 1).

    Signals are later by their delays [s], and zero outside of [start, end]. Alpha is the time
    scale [s]; the interval's centre is x = 0. Nodes that signals share are evaluated once.
    """
    top = np.sqrt(2.0 * nmax + 1.0)                    # highest frequency of the basis, per alpha
    ready = [_PREPARE[signal.hold](*_known(signal, start, end, delay), start, end, alpha, top)
             for signal, delay in zip(signals, delays, strict=True)]
    found: list[Array] = [np.empty(0)] * len(ready)
    groups: dict[bytes, list[int]] = {}
    for i, samples in enumerate(ready):
        groups.setdefault(samples.x.tobytes(), []).append(i)
    for group in groups.values():
        sums = project(nmax, ready[group[0]].x, np.vstack([ready[i].weights for i in group]))
        rows = np.cumsum([len(ready[i].weights) for i in group])[:-1]
        for i, part in zip(group, np.split(sums, rows), strict=True):
            found[i] = ready[i].finish(part)
    return found


def _known(signal: Signal, start: float, end: float, delay: float) -> tuple[Array, Array]:
    """Return stamps shifted by the dead time and values (m, N), with one sample beyond."""
    t = signal.time + delay if delay else signal.time
    reach = 1 if signal.hold != 'smooth' else 3
    first = max(int(np.searchsorted(t, start, side='right')) - reach, 0)
    last = int(np.searchsorted(t, end, side='left')) + reach
    return t[first:last], signal.values[first:last].T


def integrate(g: Array, c0: Array) -> Array:
    """Return coefficients of f (m, nc) from g = <h_n, df/dx> (m, nc) and c0 = <h_0, f> (m,)."""
    step, free = free_motion(g.shape[1])
    c = np.empty_like(g)
    c[:, 0] = c0
    np.multiply(step, g[:, :-1], out=c[:, 1:])
    c /= free
    for parity in (0, 1):
        np.cumsum(c[:, parity::2], axis=1, out=c[:, parity::2])
    c *= free
    return c


@lru_cache(maxsize=64)
def free_motion(nc: int) -> tuple[Array, Array]:
    """Return sqrt(2 / n) for n >= 1, and what c_n is where g vanishes, from c_0 = c_1 = 1."""
    n = np.arange(nc, dtype=float)
    free = np.ones(nc)
    ratio = np.sqrt((n[2:] - 1.0) / n[2:])
    for parity in (0, 1):
        free[parity + 2::2] = np.cumprod(ratio[parity::2])
    return np.sqrt(2.0 / n[1:]), free


def _held(t: Array, values: Array, start: float, end: float, alpha: float, top: float) -> Samples:
    nodes = _with_ends(t, start, end)
    at = np.clip(np.searchsorted(t, nodes[:-1], side='right') - 1, 0, None)
    level = values[:, at]                                  # on [node k, node k + 1)
    jumps = np.diff(level, axis=1, prepend=0.0, append=0.0)
    x = _dimensionless(nodes, start, end, alpha)
    c0 = -jumps @ integral_of_first(x)
    return Samples(x, jumps, lambda g: integrate(g, c0))


def _lines(t: Array, values: Array, start: float, end: float, alpha: float, top: float) -> Samples:
    nodes = _with_ends(t, start, end)
    inside = (t >= start) & (t <= end)
    level = values[:, inside] if len(nodes) == np.count_nonzero(inside) else \
        np.array([np.interp(nodes, t, row) for row in values])
    x = _dimensionless(nodes, start, end, alpha)
    step, rise = np.diff(x), np.diff(level, axis=1)
    steep = step * top < _STEEP
    slope = np.where(steep, 0.0, rise) / np.where(steep, 1.0, step)
    kinks = np.diff(slope, axis=1, prepend=0.0, append=0.0)
    half = np.pad(0.5 * np.where(steep, rise, 0.0), ((0, 0), (1, 1)))
    jumps = half[:, 1:] + half[:, :-1]                     # half of each at either end
    jumps[:, 0] += level[:, 0]
    jumps[:, -1] -= level[:, -1]
    first = integral_of_first(x)
    twice = x * first + np.pi ** -0.25 * np.exp(-0.5 * x * x)  # integral of I_0
    slope0 = -kinks @ first
    c0 = kinks @ twice - jumps @ first

    def finish(sums: Array) -> Array:
        m = len(level)
        return integrate(integrate(sums[:m], slope0) + sums[m:], c0)

    return Samples(x, np.vstack((kinks, jumps)), finish)


def _smooth(t: Array, values: Array, start: float, end: float, alpha: float,
            top: float) -> Samples:
    step = np.diff(t)
    if len(t) < _SPLINED:
        return _lines(t, values, start, end, alpha, top)
    if np.ptp(step) <= _UNIFORM * step.mean():
        return _trapezoid(t, values, start, end, alpha)
    degree = spline_degree(t, values)
    if degree == 1:
        return _lines(t, values, start, end, alpha, top)
    nodes = divided(_with_ends(t, start, end), _PHASE * alpha / top)
    middle, half = 0.5 * (nodes[1:] + nodes[:-1]), 0.5 * np.diff(nodes)
    point, weight = np.polynomial.legendre.leggauss(2)
    at = (middle[:, np.newaxis] + half[:, np.newaxis] * point).ravel()
    weights = (half[:, np.newaxis] * weight / alpha).ravel()
    return Samples(_dimensionless(at, start, end, alpha),
                   smooth_values(t, values, at, degree) * weights, lambda sums: sums)


def divided(nodes: Array, longest: float) -> Array:
    """Divide intervals into equal parts so that none is longer than a given length."""
    parts = np.maximum(np.ceil(np.diff(nodes) / longest), 1.0).astype(int)
    if parts.max() == 1:
        return nodes
    place = np.concatenate(([0], np.cumsum(parts)))
    return np.interp(np.arange(place[-1] + 1), place, nodes)


def spline_degree(t: Array, values: Array) -> int:
    """
    Return the degree of the spline that predicts every second sample from the others best.

    1, 3 or 5 for stamps (N,) and values (m, N); 3 where there are too few samples to tell.
    """
    if len(t) < 32:
        return 3
    size = np.var(values, axis=1, keepdims=True) + 1e-300
    error = [np.mean((smooth_values(t[::2], values[:, ::2], t[1:-1:2], degree)
                      - values[:, 1:-1:2]) ** 2 / size) for degree in _DEGREES]
    return _DEGREES[int(np.argmin(error))]


def _trapezoid(t: Array, values: Array, start: float, end: float, alpha: float) -> Samples:
    inside = slice(*np.searchsorted(t, (start, np.nextafter(end, np.inf))))
    nodes, level = t[inside], values[:, inside]
    if not len(nodes) or nodes[0] > start:
        nodes, level = np.append(start, nodes), np.hstack((_near(t, values, start), level))
    if nodes[-1] < end:
        nodes, level = np.append(nodes, end), np.hstack((level, _near(t, values, end)))
    half = np.pad(np.diff(nodes) * (0.5 / alpha), 1)
    return Samples(_dimensionless(nodes, start, end, alpha), level * (half[1:] + half[:-1]),
                   lambda sums: sums)


def _near(t: Array, values: Array, node: float) -> Array:
    """Interpolate at one point from the samples about it: (m, 1)."""
    here = slice(*np.clip(np.searchsorted(t, node) + np.array((-4, 4)), 0, len(t)))
    return smooth_values(t[here], values[:, here], np.array([node]))


def smooth_values(t: Array, values: Array, at: Array, degree: int = 3) -> Array:
    """
    Interpolate by splines between gaps, on straight lines across them, constant beyond the ends.

    From stamps t (N,) and values (m, N) to sorted times `at` (M,): shape (m, M). The degree is
    odd.
    """
    out = np.array([np.interp(at, t, row) for row in values]).reshape(len(values), len(at))
    step = np.diff(t)
    gaps = np.flatnonzero(step > GAP_PERIODS * np.median(step)) if len(step) else step.astype(int)
    bounds = np.concatenate(([0], gaps + 1, [len(t)]))
    for first, last in zip(bounds[:-1], bounds[1:], strict=True):
        here = slice(*np.searchsorted(at, (t[first], t[last - 1])))
        if degree > 1 and last - first > degree and here.stop > here.start:
            spline = make_interp_spline(t[first:last], values[:, first:last].T, k=degree)
            out[:, here] = spline(at[here]).T
    return out


_PREPARE = {'zoh': _held, 'linear': _lines, 'smooth': _smooth}


def _with_ends(t: Array, start: float, end: float) -> Array:
    """Return the stamps inside of [start, end] joined by its two ends."""
    return np.concatenate(([start], t[(t > start) & (t < end)], [end]))


def _dimensionless(t: Array, start: float, end: float, alpha: float) -> Array:
    return (t - 0.5 * (start + end)) / alpha
