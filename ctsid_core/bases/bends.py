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
from ctsid_core.signals import Record, Signal
from ctsid_core.simulation import knots_between, respond

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_POINTS = 5           # of Gauss-Legendre, for each interval between the stamps of inputs
_PHASE = 1.5          # top frequency times interval [rad] up to which they are enough
_RANK = 1e-10         # of the responses that least squares tell apart


@dataclass(frozen=True, eq=False)
class Bends:
    """
    Responses to the inputs of a record that are nearest to the samples of its smooth outputs.

    Parameters
    ----------
    A, B : ndarray, shapes (n, n), (n, nu)
        Of the span: all modes for every input, and all of them free.
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
    """

    A: Array
    B: Array
    inputs: tuple[Signal, ...]
    delay: tuple[float, ...]
    x0: Array
    weights: Array
    start: float
    end: float

    def at(self, times: Array) -> Array:
        """Return the outputs at increasing times, (ny, M)."""
        y: Array = self.weights @ self.regressors(times)
        return y

    def regressors(self, times: Array) -> Array:
        """Return states, inputs and 1 at increasing times, (n + nu + 1, M)."""
        every = np.concatenate(([self.start], np.clip(times, self.start, self.end)))
        x, u = respond(self.A, self.B, np.zeros(len(self.A)), self.inputs, self.delay, every,
                       self.x0)
        return np.vstack((x[1:].T, u[1:].T, np.ones((1, len(times)))))

    def left_of(self, outputs: Sequence[Signal]) -> list[Signal]:
        """Return what the responses leave of output signals."""
        found, first = [], 0
        for signal in outputs:
            channels = slice(first, first + signal.width)
            first += signal.width
            found.append(signal if not self.weights[channels].any() else replace(
                signal, values=signal.values - self.at(signal.time)[channels].T))
        return found

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
        top = np.sqrt(2.0 * nmax + 1.0) / alpha
        parts = np.maximum(np.ceil(np.diff(knots) * top / _PHASE), 1.0).astype(int)
        place = np.concatenate(([0], np.cumsum(parts)))
        knots = np.interp(np.arange(place[-1] + 1), place, knots)
        point, weight = np.polynomial.legendre.leggauss(_POINTS)
        middle, half = 0.5 * (knots[1:] + knots[:-1]), 0.5 * np.diff(knots)
        at = (middle[:, np.newaxis] + half[:, np.newaxis] * point).ravel()
        x = (at - 0.5 * (start + end)) / alpha
        found: Array = project(nmax, x, self.at(at) * (
            half[:, np.newaxis] * weight / alpha).ravel())
        return found


def bends(record: Record, poles: ComplexArray, delay: tuple[float, ...], *, trim: bool,
          feedthrough: bool) -> Bends:
    """
    Return the responses of a span of modes that are nearest to the samples of a record.

    Parameters
    ----------
    record : Record
    poles : ndarray
        Of the modes, one of each pair; they may not grow by much over the record [rad/s].
    delay : tuple of float, length nu
        Dead time of each input [s].
    trim : bool
        Whether outputs have a constant.
    feedthrough : bool
        Whether inputs act on outputs at once.
    """
    inside = [(s.time >= record.start) & (s.time <= record.end) for s in record.outputs]
    own = [s.time[rows] for s, rows in zip(record.outputs, inside, strict=True)]
    A, b = _modal(poles)
    nu, n = record.nu, len(A)
    found = Bends(
        A=np.kron(np.eye(nu + 1), A), B=np.kron(np.eye(nu + 1, nu), b[:, np.newaxis]),
        inputs=record.inputs, delay=delay, x0=np.concatenate((np.zeros(n * nu), b)),
        weights=np.zeros((record.ny, n * (nu + 1) + nu + 1)),
        start=min(float(t[0]) for t in own), end=max(float(t[-1]) for t in own))
    wanted = np.concatenate((np.ones(n * (nu + 1)), np.full(nu, feedthrough), [trim])) > 0.0
    weights, first = found.weights, 0
    for signal, rows, times in zip(record.outputs, inside, own, strict=True):
        channels = slice(first, first + signal.width)
        first += signal.width
        if signal.hold == 'smooth':
            columns = found.regressors(times)[wanted].T
            size = np.linalg.norm(columns, axis=0) + 1e-300
            theta = np.linalg.lstsq(columns / size, signal.values[rows], rcond=_RANK)[0]
            weights[channels, wanted] = theta.T / size
    return found


def _modal(poles: ComplexArray) -> tuple[Array, Array]:
    """Return A, (n, n), of modes in real form, and what drives them, (n,)."""
    sizes = np.where(poles.imag != 0.0, 2, 1)
    A, b = np.zeros((sizes.sum(), sizes.sum())), np.zeros(sizes.sum())
    for p, k, size in zip(poles, np.cumsum(sizes) - sizes, sizes, strict=True):
        A[k:k + size, k:k + size] = np.array([[p.real, -p.imag], [p.imag, p.real]])[:size, :size]
        b[k] = 1.0
    return A, b
