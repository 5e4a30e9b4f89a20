# SPDX-License-Identifier: Apache-2.0
"""
Brute-force output error: modes and a dead time, everything linear by least squares inside.

One output, any inputs. Nothing of ctsid is used: this is what its models are held against.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_ros.studies.robots.linear import Held, growth

REAL, PAIR = 1, 2       # parameters of a mode: log of the pole; logs of frequency and damping
SLOWEST = 3e-3          # of a mode, times 1 / duration: an integrator cannot be told from it


@dataclass(frozen=True, eq=False)
class Samples:
    """
    One output of a record.

    Parameters
    ----------
    held : Held
    time, y : ndarray, shape (N,)
    """

    held: Held
    time: Array
    y: Array

    @cached_property
    def steps(self) -> Array:
        """Between the inputs' stamps [s]."""
        return np.diff(self.held.time)

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.time[-1] - self.time[0])

    def thinned(self, most: int) -> Samples:
        """Return every k-th sample, at most so many."""
        each = -(-len(self.time) // most)
        return Samples(self.held, self.time[::each], self.y[::each])


def states(pole: complex, data: Samples) -> ComplexArray:
    """Return the mode's response to each input at the inputs' stamps (J, nu)."""
    step = data.steps
    keep = np.exp(pole * step).tolist()
    gain = growth(np.array([pole]), step)[:, 0]
    found = np.zeros(data.held.values.shape, dtype=complex)
    for j in range(found.shape[1]):
        z, row = 0j, [0j]
        for k, kick in zip(keep, (gain * data.held.values[:-1, j]).tolist(), strict=True):
            z = k * z + kick
            row.append(z)
        found[:, j] = row
    return found


def read(pole: complex, z: ComplexArray, data: Samples, delay: float) -> ComplexArray:
    """Return the mode's response (N, nu) at the outputs' stamps after a dead time."""
    at = data.time - delay
    place = np.searchsorted(data.held.time, at, side='right') - 1
    since = np.where(place >= 0, at - data.held.time[place], 0.0)
    found = np.exp(pole * since)[:, np.newaxis] * z[place] \
        + growth(np.array([pole]), since) * data.held.values[place]
    found[place < 0] = 0.0
    return found


def poles_of(kinds: tuple[int, ...], at: Array) -> list[complex]:
    """Return one pole of each mode, that with the positive imaginary part."""
    found, i = [], 0
    for kind in kinds:
        if kind == REAL:
            found.append(complex(-np.exp(at[i])))
        else:
            w, damping = np.exp(at[i]), min(np.exp(at[i + 1]), 0.9999)
            found.append(w * complex(-damping, np.sqrt(1.0 - damping ** 2)))
        i += kind
    return found


def mode_columns(kind: int, pole: complex, data: Samples, delay: float) -> Array:
    """Return the columns of a mode: driven, by input, then free; of pairs both parts."""
    driven = read(pole, states(pole, data), data, delay)
    free = np.exp(pole * (data.time - data.time[0]))[:, np.newaxis]
    both = np.hstack((driven, free))
    return both.real if kind == REAL else np.hstack((both.real, both.imag))


def columns(kinds: tuple[int, ...], at: Array, data: Samples) -> list[Array]:
    """Return the columns of each mode, and at last that of the offset; `at` ends with d [s]."""
    found = [mode_columns(kind, pole, data, float(at[-1]))
             for kind, pole in zip(kinds, poles_of(kinds, at), strict=True)]
    return [*found, np.ones((len(data.time), 1))]


def solved(matrix: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return coefficients, an orthonormal basis and the residuals of a least-squares problem."""
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0.0] = 1.0
    left, s, right = np.linalg.svd(matrix / size, full_matrices=False)
    kept = s > 1e-9 * s[0]
    left = left[:, kept]
    along = left.T @ y
    return right[kept].T @ (along / s[kept]) / size, left, y - left @ along


@dataclass(frozen=True, eq=False)
class OutputError:
    """
    A model of one output.

    Parameters
    ----------
    kinds : tuple of int
        `REAL` or `PAIR`, of each mode.
    at : ndarray
        Parameters of the modes, then the dead time.
    weights : ndarray
        Of the columns.
    cost : float
        Mean square of the residuals.
    """

    kinds: tuple[int, ...]
    at: Array
    weights: Array
    cost: float

    @property
    def order(self) -> int:
        """Number of states."""
        return sum(self.kinds)

    def fit(self, data: Samples) -> float:
        """Return the fit of a simulation [%]; initial state and trim are refitted."""
        parts = columns(self.kinds, self.at, data)
        nu, first, known, free = data.held.values.shape[1], 0, np.zeros(len(data.y)), parts[-1:]
        for kind, part in zip(self.kinds, parts[:-1], strict=True):
            is_free = np.arange(part.shape[1]) % (nu + 1) == nu
            own = self.weights[first:first + part.shape[1]]
            known += part[:, ~is_free] @ own[~is_free]
            free = [*free, part[:, is_free]]
            first += (nu + 1) * kind
        _, _, rest = solved(np.hstack(free), data.y - known)
        spread = np.linalg.norm(data.y - data.y.mean())
        return 100.0 * (1.0 - float(np.linalg.norm(rest) / (spread or 1.0)))


class Climb:
    """
    Variable projection from one start: residuals and Kaufman's Jacobian.

    Parameters
    ----------
    kinds : tuple of int
    data : Samples
    """

    def __init__(self, kinds: tuple[int, ...], data: Samples) -> None:
        self._kinds, self._data = kinds, data
        self._at: Array | None = None

    def residuals(self, at: Array) -> Array:
        """Return the residuals of the best coefficients."""
        if self._at is None or not np.array_equal(at, self._at):
            self._at, self._parts = at.copy(), columns(self._kinds, at, self._data)
            self.weights, self._basis, self._rest = solved(np.hstack(self._parts), self._data.y)
        return self._rest

    def jacobian(self, at: Array) -> Array:
        """Return their derivatives by all parameters, the coefficients following."""
        self.residuals(at)
        slopes, first, i = np.zeros((len(self._rest), len(at))), 0, 0
        for kind, part in zip(self._kinds, self._parts[:-1], strict=True):
            own = self.weights[first:first + part.shape[1]]
            for j in range(kind):
                slopes[:, i + j] = self._moved(kind, at, i, i + j, part) @ own
            slopes[:, -1] += self._moved(kind, at, i, len(at) - 1, part) @ own
            first, i = first + part.shape[1], i + kind
        return self._basis @ (self._basis.T @ slopes) - slopes

    def _moved(self, kind: int, at: Array, first: int, which: int, part: Array) -> Array:
        """Return the derivative of a mode's columns by one of the parameters."""
        step = 1e-5
        other = at.copy()
        other[which] += step
        pole = poles_of((kind,), other[first:first + kind])[0]
        return (mode_columns(kind, pole, self._data, float(other[-1])) - part) / step


def climbed(kinds: tuple[int, ...], start: Array, data: Samples, most: float,
            steps: int = 25) -> OutputError:
    """Return the model that a climb from a start ends at; dead times are at most `most` [s]."""
    low, high, i = np.empty(len(start)), np.empty(len(start)), 0
    slow, fast = np.log(SLOWEST / data.duration), np.log(400.0)
    for kind in kinds:
        low[i:i + kind], high[i:i + kind] = (slow, np.log(1e-3))[:kind], (fast, 0.0)[:kind]
        i += kind
    low[-1], high[-1] = -1e-9, most
    inside = np.clip(start, low + 1e-6, high - 1e-6)
    way = Climb(kinds, data)
    end = least_squares(way.residuals, inside, way.jacobian, (low, high), x_scale='jac',
                        max_nfev=steps, xtol=1e-7, ftol=1e-8)
    rest = way.residuals(end.x)
    return OutputError(kinds, end.x, way.weights, float(np.mean(rest ** 2)))
