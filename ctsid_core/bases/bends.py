# SPDX-License-Identifier: Apache-2.0
"""
Outputs between their samples, as responses to the inputs have it.

A held input puts corners and jumps of curvature into the outputs at its stamps, where no
interpolation of samples sees them. But the responses of a span of modes to the held input are
known at all times, and least squares on the samples say which sum of them, y_m, is nearest. With
S the interpolation, y_m + S (y - y_m) is right between the samples up to what the span lacks
there: nothing, if the poles of the plant are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.hermite_sums import project
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.simulation import knots_between, respond
from ctsid_core.signals.record import Record, Signal, channel_slices

_POINTS = (3, 4, 5)   # of Gauss-Legendre, for each interval between the stamps of inputs
_PHASES = (0.2, 0.7, 1.5)  # top frequency times interval [rad] up to which they are enough
SPARE = 8             # poles at the end of a list that come in all together
_FLOOR = 1e-14        # of the power, that differences of squares do not tell from nothing
_RANK = 1e-10         # of the responses that least squares tell apart


@dataclass(frozen=True, eq=False)
class Bends:
    """
    A response to the inputs of a record that is near to the samples of its smooth outputs.

    Parameters
    ----------
    A, B : ndarray, shapes (n, n), (n, nu)
        Of a model; or of a span: all modes for every input, and all of them free.
    drift : ndarray, shape (n,)
        What drives the states beside the inputs.
    inputs : tuple of Signal
        Of the whole record.
    delay : tuple of float, length nu
        [s]
    x0 : ndarray, shape (n,)
        State at `start`.
    weights : ndarray, shape (ny, n + nu + 1)
        Of states, inputs and 1 in each output; zero for outputs that are not smooth.
    start, end : float
        First and last sample of the outputs [s]; beyond them the responses are held.
    rough : bool
        Whether four digits of the projection are enough.
    """

    A: Array
    B: Array
    drift: Array
    inputs: tuple[Signal, ...]
    delay: tuple[float, ...]
    x0: Array
    weights: Array
    start: float
    end: float
    rough: bool = False

    def at(self, times: Array) -> Array:
        """Return the outputs at increasing times, (ny, M)."""
        y: Array = self.weights @ self.regressors(times)
        return y

    def regressors(self, times: Array) -> Array:
        """Return states, inputs and 1 at increasing times, (n + nu + 1, M)."""
        every = np.concatenate(([self.start], np.clip(times, self.start, self.end)))
        x, u = respond(self.A, self.B, self.drift, self.inputs, self.delay, every, self.x0)
        return np.vstack((x[1:].T, u[1:].T, np.ones((1, len(times)))))

    def left_of(self, outputs: Sequence[Signal]) -> list[Signal]:
        """Return what the responses leave of output signals."""
        return [signal if not self.weights[own].any() else replace(
            signal, values=signal.values - self.at(signal.time)[own].T)
            for signal, own in zip(outputs, channel_slices(outputs), strict=True)]

    def coefficients(self, start: float, end: float, alpha: float, nmax: int) -> Array:
        """
        Project the responses on h_0 .. h_nmax.

        Parameters
        ----------
        start, end, alpha, nmax
            As for `quadrature.coefficients`.

        Returns
        -------
        ndarray, shape (ny, nmax + 1)
        """
        knots = knots_between(self.inputs, self.delay, np.array([start, end]))
        phase = np.diff(knots) * np.sqrt(2.0 * nmax + 1.0) / alpha
        parts = np.maximum(np.ceil(phase / _PHASES[-1]), 1.0).astype(int)
        place = np.concatenate(([0], np.cumsum(parts)))
        knots = np.interp(np.arange(place[-1] + 1), place, knots)
        level = int(np.searchsorted(_PHASES[:-1], np.max(phase / parts)))
        points = 2 if self.rough else _POINTS[level]
        point, weight = np.polynomial.legendre.leggauss(points)
        middle, half = 0.5 * (knots[1:] + knots[:-1]), 0.5 * np.diff(knots)
        at = (middle[:, np.newaxis] + half[:, np.newaxis] * point).ravel()
        x = (at - 0.5 * (start + end)) / alpha
        found: Array = project(nmax, x, self.at(at) * (
            half[:, np.newaxis] * weight / alpha).ravel())
        return found


def nearest_bends(record: Record, poles: ComplexArray, delay: tuple[float, ...],
                  corrupt: Sequence[NDArray[np.bool_]], *, trim: bool,
                  feedthrough: bool) -> Bends:
    """
    Return the responses of modes that are nearest to the samples of a record.

    Parameters
    ----------
    record : Record
    poles : ndarray
        Of the modes that may be needed, the surest ones first, one of each pair; they may not
        grow by much over the record [rad/s]. Of these, Schwarz's criterion on the samples takes
        the first ones, as many as they need.
    delay : tuple of float, length nu
        Dead time of each input [s].
    corrupt : sequence of ndarray, shapes (N, channels)
        Samples of each output signal that do not count.
    trim : bool
        Whether outputs have a constant.
    feedthrough : bool
        Whether inputs may act on outputs at once: what is tried after the poles before the last
        `SPARE` ones.
    """
    inside = [(s.time >= record.start) & (s.time <= record.end) & ~mask.any(axis=1)
              for s, mask in zip(record.outputs, corrupt, strict=True)]
    own = [s.time[rows] for s, rows in zip(record.outputs, inside, strict=True)]
    A, b = _modal(poles)
    nu, n = record.nu, len(A)
    every = np.asarray(np.kron(np.eye(nu + 1), A), dtype=np.float64)
    drive = np.asarray(np.kron(np.eye(nu + 1, nu), b[:, np.newaxis]), dtype=np.float64)
    found = Bends(
        A=every, B=drive, drift=np.zeros(len(every)), inputs=record.inputs, delay=delay,
        x0=np.concatenate((np.zeros(n * nu), b)),
        weights=np.zeros((record.ny, n * (nu + 1) + nu + 1)),
        start=min(float(t[0]) for t in own), end=max(float(t[-1]) for t in own))
    groups = _groups(poles, nu, trim=trim, feedthrough=feedthrough)
    for signal, places, rows, times in zip(
            record.outputs, channel_slices(record.outputs), inside, own, strict=True):
        if signal.hold == 'smooth':
            columns, y = found.regressors(times).T, signal.values[rows]
            wanted = _needed(columns, y, groups)
            columns = columns[:, wanted]
            size = np.linalg.norm(columns, axis=0) + 1e-300
            theta = np.linalg.lstsq(columns / size, y, rcond=_RANK)[0]
            found.weights[places, wanted] = theta.T / size
    return _pruned(found, n)


def _pruned(found: Bends, n: int) -> Bends:
    """Return the same without the modes, of n states in all, that no output needs."""
    copies = len(found.A) // n
    used = found.weights[:, :len(found.A)].reshape(-1, n).any(axis=0)
    # The two states of a pair go together.
    used |= (np.abs(found.A[:n, :n]) @ used) > 0.0
    kept = np.flatnonzero(np.tile(used, copies))
    rest = np.arange(len(found.A), found.weights.shape[1])
    return replace(found, A=found.A[np.ix_(kept, kept)], B=found.B[kept],
                   drift=found.drift[kept], x0=found.x0[kept],
                   weights=found.weights[:, np.concatenate((kept, rest))])


def _groups(poles: ComplexArray, nu: int, *, trim: bool,
            feedthrough: bool) -> list[NDArray[np.intp]]:
    """Return the regressors that come in together, those that are surest first."""
    sizes = np.where(poles.imag != 0.0, 2, 1)
    n, ends = int(sizes.sum()), np.cumsum(sizes)
    states = [(np.arange(nu + 1)[:, np.newaxis] * n + np.arange(end - size, end)).ravel()
              for size, end in zip(sizes, ends, strict=True)]
    direct = n * (nu + 1) + np.arange(nu)
    own = states[:len(states) - SPARE]
    return [np.full(int(trim), n * (nu + 1) + nu), *own, *([direct] if feedthrough else []),
            np.concatenate(states[len(own):])]


def _needed(columns: Array, y: Array, groups: list[NDArray[np.intp]]) -> NDArray[np.intp]:
    """Return the regressors that Schwarz's criterion takes, the first of the groups."""
    order = np.concatenate(groups)
    size = np.linalg.norm(columns[:, order], axis=0) + 1e-300
    q = np.linalg.qr(columns[:, order] / size)[0]
    explained = np.cumsum((q.T @ y) ** 2, axis=0)
    power = np.sum(y ** 2, axis=0)
    ends = np.cumsum([len(g) for g in groups])
    left = np.maximum(power - np.vstack((0.0 * power, explained))[ends], 0.0)
    # What is left of the largest group is what differences of squares can tell.
    cost = len(y) * np.log(left + _FLOOR * power + 1e-300).sum(axis=1) \
        + ends * y.shape[1] * np.log(len(y))
    return order[:ends[int(np.argmin(cost))]]


def _modal(poles: ComplexArray) -> tuple[Array, Array]:
    """Return A, (n, n), of modes in real form, and what drives them, (n,)."""
    sizes = np.where(poles.imag != 0.0, 2, 1)
    A, b = np.zeros((sizes.sum(), sizes.sum())), np.zeros(sizes.sum())
    for p, k, size in zip(poles, np.cumsum(sizes) - sizes, sizes, strict=True):
        A[k:k + size, k:k + size] = np.array([[p.real, -p.imag], [p.imag, p.real]])[:size, :size]
        b[k] = 1.0
    return A, b
