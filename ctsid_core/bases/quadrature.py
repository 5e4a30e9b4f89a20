# SPDX-License-Identifier: Apache-2.0
"""
Hermite coefficients of sampled signals, exact for what is known of them between the samples.

All is done in the dimensionless time x = (t - t_c) / alpha ([HD] eq. 31). A signal f is zero
outside of [start, end]. Integrating by parts moves the integral to the signal's jumps:

    c_(n+1) = sqrt(n / (n+1)) c_(n-1) + sqrt(2 / (n+1)) g_n,       g_n = <h_n, df/dx>     (eq. 19)

A held signal's derivative is a sum of impulses at its stamps, so that g is one sum over the
samples and c is exact. A signal of straight lines has a held derivative: the same step twice. A
smooth signal is its cubic spline, integrated by the trapezoid rule where stamps are uniform
(spectrally accurate, the basis having decayed at the ends) and else by two Gauss-Legendre points
per interval.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ctsid_core.bases.hermite_functions import integral_of_first, project
from ctsid_core.signals import Signal

Array = NDArray[np.float64]

UNIFORM = 1e-6        # stamps whose intervals agree to this fraction count as uniform
GAP_PERIODS = 5.0     # longer intervals, in median periods, are gaps: not splined over
_GAUSS = 0.5 / np.sqrt(3.0)


@dataclass(frozen=True)
class Samples:
    """
    A signal made ready for projection: weights at nodes, and the steps to its coefficients.

    Parameters
    ----------
    x : ndarray, shape (N,)
        Nodes, dimensionless.
    weights : ndarray, shape (m, N)
        What is summed with h_n at the nodes; several blocks of rows if `finish` needs them.
    finish : callable
        Takes the sums (m, nmax + 1) to the coefficients (channels, nmax + 1).
    """

    x: Array
    weights: Array
    finish: Callable[[Array], Array]


def coefficients(signals: Sequence[Signal], start: float, end: float, alpha: float, nmax: int,
                 delays: Sequence[float]) -> list[Array]:
    """
    Project signals on h_0 .. h_nmax; nodes that signals share are evaluated once.

    Parameters
    ----------
    signals : sequence of Signal
    start, end : float
        Interval outside of which the signals are taken as zero [s].
    alpha : float
        Time scale [s]; the interval's centre is x = 0.
    nmax : int
        Highest order.
    delays : sequence of float
        Dead time of each signal: it is projected as f(t - delay) [s].

    Returns
    -------
    list of ndarray, each of shape (channels, nmax + 1)

    References
    ----------
    [HD] eq. 33, 34.
    """
    ready = [_PREPARE[signal.hold](*_known(signal, start, end, delay), start, end, alpha)
             for signal, delay in zip(signals, delays, strict=True)]
    found: list[Array] = [np.empty(0)] * len(ready)
    for group in _same_nodes(ready):
        sums = project(nmax, ready[group[0]].x, np.vstack([ready[i].weights for i in group]))
        rows = np.cumsum([len(ready[i].weights) for i in group])[:-1]
        for i, part in zip(group, np.split(sums, rows), strict=True):
            found[i] = ready[i].finish(part)
    return found


def _same_nodes(ready: Sequence[Samples]) -> list[list[int]]:
    groups: list[list[int]] = []
    for i, samples in enumerate(ready):
        for group in groups:
            if np.array_equal(ready[group[0]].x, samples.x):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def _known(signal: Signal, start: float, end: float, delay: float) -> tuple[Array, Array]:
    """Return stamps shifted by the dead time and values (m, N), with one sample beyond."""
    t = signal.time + delay if delay else signal.time
    reach = 1 if signal.hold != 'smooth' else 3
    first = max(int(np.searchsorted(t, start, side='right')) - reach, 0)
    last = int(np.searchsorted(t, end, side='left')) + reach
    return t[first:last], signal.values[first:last].T


def integrate(g: Array, c0: Array) -> Array:
    """
    Return the coefficients of a signal from those of its derivative.

    Parameters
    ----------
    g : ndarray, shape (m, nc)
        <h_n, df/dx>.
    c0 : ndarray, shape (m,)
        <h_0, f>.

    Returns
    -------
    ndarray, shape (m, nc)
    """
    nc = g.shape[1]
    n = np.arange(nc, dtype=float)
    c = np.zeros_like(g)
    c[:, 0] = c0
    c[:, 1:] = np.sqrt(2.0 / n[1:]) * g[:, :-1]
    ratio = np.sqrt((n[2:] - 1.0) / n[2:])                 # c_n / c_(n-2) where g is zero
    for parity in (0, 1):
        free = np.concatenate(([1.0], np.cumprod(ratio[parity::2])))[:c[:, parity::2].shape[1]]
        c[:, parity::2] = free * np.cumsum(c[:, parity::2] / free, axis=1)
    return c


def _held(t: Array, values: Array, start: float, end: float, alpha: float) -> Samples:
    nodes, inside = _with_ends(t, start, end)
    at = np.clip(np.searchsorted(t, nodes[:-1], side='right') - 1, 0, None)
    level = values[:, at]                                  # on [node k, node k + 1)
    jumps = np.diff(level, axis=1, prepend=0.0, append=0.0)
    x = _dimensionless(nodes, start, end, alpha)
    c0 = -jumps @ integral_of_first(x)
    return Samples(x, jumps, lambda g: integrate(g, c0))


def _lines(t: Array, values: Array, start: float, end: float, alpha: float) -> Samples:
    nodes, inside = _with_ends(t, start, end)
    level = _interpolate(t, values, nodes, inside)
    x = _dimensionless(nodes, start, end, alpha)
    slope = np.diff(level, axis=1) / np.diff(x)
    kinks = np.diff(slope, axis=1, prepend=0.0, append=0.0)
    jumps = np.zeros_like(level)
    jumps[:, 0], jumps[:, -1] = level[:, 0], -level[:, -1]
    first = integral_of_first(x)
    twice = x * first + np.pi ** -0.25 * np.exp(-0.5 * x * x)  # integral of I_0
    slope0 = -kinks @ first
    c0 = kinks @ twice - jumps @ first

    def finish(sums: Array) -> Array:
        m = len(level)
        return integrate(integrate(sums[:m], slope0) + sums[m:], c0)

    return Samples(x, np.vstack((kinks, jumps)), finish)


def _smooth(t: Array, values: Array, start: float, end: float, alpha: float) -> Samples:
    step = np.diff(t)
    if len(t) < 4:
        return _lines(t, values, start, end, alpha)
    if np.ptp(step) <= UNIFORM * step.mean():
        return _trapezoid(t, values, start, end, alpha)
    nodes, _ = _with_ends(t, start, end)
    middle, width = 0.5 * (nodes[1:] + nodes[:-1]), np.diff(nodes)
    points = np.stack((middle - _GAUSS * width, middle + _GAUSS * width), axis=1).ravel()
    weights = np.repeat(0.5 * width / alpha, 2)
    return Samples(_dimensionless(points, start, end, alpha),
                   smooth_values(t, values, points) * weights, lambda sums: sums)


def _trapezoid(t: Array, values: Array, start: float, end: float, alpha: float) -> Samples:
    nodes, inside = _with_ends(t, start, end)
    level = values[:, inside] if len(nodes) == np.count_nonzero(inside) else \
        CubicSpline(t, values, axis=1)(nodes)
    width = np.diff(nodes) / alpha
    weights = 0.5 * (np.append(width, 0.0) + np.append(0.0, width))
    return Samples(_dimensionless(nodes, start, end, alpha), level * weights, lambda sums: sums)


def smooth_values(t: Array, values: Array, at: Array) -> Array:
    """
    Interpolate by cubic splines between gaps, on straight lines across them.

    Parameters
    ----------
    t : ndarray, shape (N,)
    values : ndarray, shape (m, N)
    at : ndarray, shape (M,)
        Sorted times within [t_0, t_(N-1)] or slightly beyond.

    Returns
    -------
    ndarray, shape (m, M)
    """
    step = np.diff(t)
    gaps = np.flatnonzero(step > GAP_PERIODS * np.median(step))
    if len(gaps) == 0:
        return np.asarray(CubicSpline(t, values, axis=1)(at))
    out = np.array([np.interp(at, t, row) for row in values])
    bounds = np.concatenate(([0], gaps + 1, [len(t)]))
    for first, last in zip(bounds[:-1], bounds[1:], strict=True):
        here = (at >= t[first]) & (at <= t[last - 1])
        if last - first >= 4 and here.any():
            out[:, here] = CubicSpline(t[first:last], values[:, first:last], axis=1)(at[here])
    return out


def gap_time(signal: Signal, start: float, end: float) -> float:
    """Return the time within [start, end] that lies in gaps of a signal [s]; 0 if it is held."""
    if signal.hold == 'zoh' or len(signal.time) < 3:
        return 0.0
    step = np.diff(signal.time)
    covered = np.diff(np.clip(signal.time, start, end))
    return float(covered[step > GAP_PERIODS * np.median(step)].sum())


_PREPARE = {'zoh': _held, 'linear': _lines, 'smooth': _smooth}


def _with_ends(t: Array, start: float, end: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the stamps inside of [start, end] joined by its two ends, and which they are."""
    inside = (t >= start) & (t <= end)
    kept = t[inside]
    before = [start] if len(kept) == 0 or kept[0] > start else []
    after = [end] if len(kept) == 0 or kept[-1] < end else []
    return np.concatenate((before, kept, after)), inside


def _interpolate(t: Array, values: Array, nodes: Array, inside: NDArray[np.bool_]) -> Array:
    if len(nodes) == np.count_nonzero(inside):
        return values[:, inside]
    return np.array([np.interp(nodes, t, row) for row in values])


def _dimensionless(t: Array, start: float, end: float, alpha: float) -> Array:
    x: Array = (t - 0.5 * (start + end)) / alpha
    return x
