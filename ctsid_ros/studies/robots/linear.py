# SPDX-License-Identifier: Apache-2.0
"""Exact motion of linear plants under held inputs, by their modes; nothing of ctsid's own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray


@dataclass(frozen=True, eq=False)
class Held:
    """
    Inputs that are held from stamp to stamp; zero before the first.

    Parameters
    ----------
    time : ndarray, shape (J,)
    values : ndarray, shape (J, nu)
    """

    time: Array
    values: Array

    def at(self, time: Array) -> Array:
        """Return the values that hold at some instants."""
        place = np.searchsorted(self.time, time, side='right') - 1
        return np.asarray(np.where(place[:, np.newaxis] >= 0, self.values[place], 0.0))

    def shifted(self, late: float) -> Held:
        """Return the same inputs, later."""
        return Held(self.time + late, self.values)


def growth(poles: ComplexArray, step: Array) -> ComplexArray:
    """Return the integral of exp(p s) over s in [0, step], for all steps and poles."""
    small = np.abs(poles) < 1e-12
    safe = np.where(small, 1.0, poles)
    whole = np.expm1(step[:, np.newaxis] * safe) / safe
    return np.asarray(np.where(small, step[:, np.newaxis], whole))


def mode_responses(poles: ComplexArray, held: Held, times: Array) -> ComplexArray:
    """
    Return the response of each mode dz/dt = p z + u to each input, from rest.

    Parameters
    ----------
    poles : ndarray, shape (n,)
    held : Held
    times : ndarray, shape (N,)

    Returns
    -------
    ndarray, shape (N, n, nu)
    """
    u, step = held.values, np.diff(held.time)
    keep, gain = np.exp(step[:, np.newaxis] * poles), growth(poles, step)
    z = np.zeros((len(u), len(poles), u.shape[1]), dtype=complex)
    driven = gain[:, :, np.newaxis] * u[:-1, np.newaxis, :]
    for k in range(len(step)):
        z[k + 1] = keep[k][:, np.newaxis] * z[k] + driven[k]
    place = np.searchsorted(held.time, times, side='right') - 1
    since = np.where(place >= 0, times - held.time[place], 0.0)
    found = np.exp(since[:, np.newaxis] * poles)[:, :, np.newaxis] * z[place] \
        + growth(poles, since)[:, :, np.newaxis] * u[place][:, np.newaxis, :]
    found[place < 0] = 0.0
    return np.asarray(found)


@dataclass(frozen=True, eq=False)
class Linear:
    """
    A linear plant with poles that do not coincide.

    Parameters
    ----------
    A, B, C : ndarray, shapes (n, n), (n, nu), (ny, n)
    delay : float
        Dead time of all inputs [s].
    """

    A: Array
    B: Array
    C: Array
    delay: float = 0.0

    @classmethod
    def of_roots(cls, gain: float, poles: tuple[complex, ...], delay: float = 0.0) -> Linear:
        """Return gain / prod(1 - s / pole); a pole at 0 is a factor 1 / s."""
        whole, A = np.poly(poles).real, np.zeros((len(poles), len(poles)))
        scale = float(np.prod([-p for p in poles if p != 0.0]).real)
        A[0] = -whole[1:]
        A[1:, :-1] = np.eye(len(poles) - 1)
        B, C = np.eye(len(poles))[:, :1], gain * scale * np.eye(len(poles))[-1:]
        return cls(A, B, C, delay)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    def move(self, held: Held, times: Array) -> Array:
        """Return the outputs (N, ny) from rest, before the inputs' first stamp."""
        poles, vectors = np.linalg.eig(self.A.astype(complex))
        b, c = np.linalg.solve(vectors, self.B), self.C @ vectors
        z = mode_responses(poles, held, times - self.delay)
        return np.asarray(np.einsum('im,tmj,mj->ti', c, z, b).real)

    def response(self, omega: Array) -> ComplexArray:
        """Return G(j omega), shape (M, ny, nu)."""
        s = 1j * omega[:, np.newaxis, np.newaxis]
        states = np.linalg.solve(s * np.eye(len(self.A)) - self.A,
                                 np.broadcast_to(self.B, (len(omega), *self.B.shape)))
        return np.asarray(self.C @ states * np.exp(-s * self.delay))
