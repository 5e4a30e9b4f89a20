# SPDX-License-Identifier: Apache-2.0
"""
How well simulations with given poles can explain the outputs, and the poles that do it best.

With measurement noise alone (output error) the residuals of a simulation are white over the
lines. What enters linearly (inputs' effects, tail, trim) is solved for, so that the likelihood
depends on the poles only (variable projection), and a few Gauss-Newton steps take them to its
maximum from almost anywhere.

References
----------
Golub and Pereyra 1973, SIAM J. Numer. Anal. 10; Kaufman 1975, BIT 15, for the Jacobian.
"""

from __future__ import annotations

from cmath import sqrt as csqrt
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.likelihood.prediction_errors import ROUNDING
from ctsid_core.linear.tall_qr import factors, triangle
from ctsid_core.linear.types import Array, Lines

_HALVINGS = 6
_SLOW = 0.1           # |pole| times window below which a pole is slow
_AXIS = 1e-12         # stands for s - p on a line that a pole lies on
_LEAST_GAIN = 1e-3    # -2 log likelihood


@dataclass(frozen=True)
class OutputErrorFit:
    """
    Poles and how well simulations with them can explain the outputs.

    Parameters
    ----------
    cost : float
        -2 log likelihood, up to a constant.
    poles : ndarray, shape (n,)
        [rad/s].
    parameters : int
        Number of free parameters.
    residual : float
        Largest part of an output's power, its level apart, that stays unexplained.
    """

    cost: float
    poles: NDArray[np.complex128]
    parameters: int
    residual: float


@dataclass(frozen=True)
class JointStep:
    """
    A step of poles and dead times.

    Parameters
    ----------
    poles : callable
        From a part of the step, 0 to 1, to the poles there [rad/s].
    delays : ndarray, shape (nu,)
        By how much dead times grow in the whole step [s].
    gain : float
        By how much the cost would fall if all were linear.
    """

    poles: Callable[[float], NDArray[np.complex128]]
    delays: Array
    gain: float


class OutputError:
    """
    The output-error likelihood of one projection as a function of the poles.

    Parameters
    ----------
    projection : Projection
    feedthrough : bool

    Notes
    -----
    Poles are grouped in quadratic factors s^2 + a s + b (and one s + c if n is odd), which take
    real poles and conjugate pairs alike. Frequencies are scaled to the top of the band.

    The derivative of the constant is a multiple of the tail. Through a pole it therefore acts as
    it does directly, and is a regressor once only, except where a pole is so slow that the window
    cannot tell its response to a constant from a ramp.
    """

    def __init__(self, projection: Projection, feedthrough: bool) -> None:
        self.projection, self.feedthrough = projection, feedthrough
        self._top = max(float(np.abs(p.s[-1])) for p in projection.records)
        self._drives = len(projection.u) + len(projection.tail)  # ones: the same as y's trim
        self._s = projection.s / self._top
        self._slow = _SLOW / projection.length / self._top
        self._ones = _unit_rows(projection.ones)
        # Real numbers that the lines stand for: the one at frequency zero has no imaginary part.
        self._count = 2 * len(projection.s) - int(np.count_nonzero(projection.s == 0.0))
        self._through_states = len(projection.tail) == 0
        driving = (projection.u, projection.tail) if len(projection.tail) else \
            (projection.u, projection.ones)
        self._z = _unit_rows(np.vstack(driving))
        direct = (projection.u, projection.ones) if feedthrough else (projection.ones,)
        self._direct = _unit_rows(np.vstack(direct))
        y = as_real(projection.y)
        self._power = np.maximum(np.sum(y ** 2, axis=1), 1e-300)
        self._y = y / np.sqrt(self._power)[:, np.newaxis]
        self._outputs = self._y.view(np.complex128)
        level = self._y @ as_real(self._ones).T @ as_real(self._ones)
        self._moving = np.maximum(np.sum((self._y - level) ** 2, axis=1), ROUNDING)

    def fit(self, poles: NDArray[np.complex128], steps: int = 0,
            limit: float = np.inf) -> OutputErrorFit:
        """
        Evaluate the likelihood at given poles, or after some Gauss-Newton steps from there.

        Parameters
        ----------
        poles : ndarray, shape (n,)
            Real, or in conjugate pairs [rad/s].
        steps : int
            Gauss-Newton steps (0: at the poles themselves).
        limit : float
            Steps may not take the real part of a pole beyond this [rad/s].
        """
        factors = _factors(poles / self._top)
        if steps:
            factors = self._climb(factors, steps, limit)
        cost, squares = self._cost(self._regressors(factors))
        n, ny, lines = len(poles), len(self._y), self._count
        count = ny * (n * self._drives + len(self._direct)) + n
        offset = lines * float(np.log(self._power).sum())
        return OutputErrorFit(cost + offset, _roots(factors) * self._top, count,
                              float(np.max(squares / self._moving)))

    def costs(self, poles: Sequence[NDArray[np.complex128]]) -> Array:
        """
        Return what `fit` gives as cost at many sets of poles, all of the same order (k,).

        Parameters
        ----------
        poles : sequence of ndarray, shape (n,)
            Each as in `fit`.
        """
        stack = np.array([_factors(p / self._top) for p in poles]).reshape(len(poles), -1, 3)
        costs = np.empty(len(poles))
        plain = np.array([self._slowest(factors) is None for factors in stack])
        if plain.any():
            costs[plain] = self._costs(stack[plain])
        for i in np.flatnonzero(~plain):
            costs[i] = self._cost(self._regressors(stack[i]))[0]
        return costs + self._count * float(np.log(self._power).sum())

    def _costs(self, stack: Array) -> Array:
        """Return the cost of each of many factors (k, f, 3), none of them slow."""
        k, ny, lines = len(stack), len(self._y), len(self._s)
        a, b = stack[..., 0, np.newaxis], stack[..., 1, np.newaxis]
        quadratic = stack[0, :, 2] > 0.0                    # the order says which are
        power = np.where(quadratic[:, np.newaxis], self._s * (self._s + a), self._s)
        denominator = power + b
        denominator[denominator == 0.0] = _AXIS
        first = self._z / denominator[:, :, np.newaxis]
        second = first[:, quadratic] * self._s
        direct = np.concatenate((self._direct, self._outputs))
        rows = np.concatenate((first.reshape(k, -1, lines), second.reshape(k, -1, lines),
                               np.broadcast_to(direct, (k, *direct.shape))), axis=1)
        found = rows.view(np.float64)
        norm = np.sqrt(np.einsum('kij,kij->ki', found, found))
        norm[:, -ny:] = 1.0
        norm[norm == 0.0] = 1.0
        found /= norm[:, :, np.newaxis]
        left = np.array([triangle(one.T)[-ny:, -ny:] for one in found])
        squares = np.einsum('kij,kij->kj', left, left)
        return np.asarray(self._count * np.log(
            np.maximum(squares, ROUNDING) / self._count).sum(axis=1))

    def _climb(self, factors: Array, steps: int, limit: float) -> Array:
        regressors = self._regressors(factors)
        cost = self._cost(regressors)[0]
        for _ in range(steps):
            step = self._step(factors, *self._weights(regressors))
            new = self._search(factors, step, cost, limit)
            if new is None:
                break
            factors, regressors, gain = new[0], new[1], cost - new[2]
            cost = new[2]
            if gain < _LEAST_GAIN:
                break
        return factors

    def _search(self, factors: Array, step: Array, cost: float, limit: float,
                ) -> tuple[Array, Array, float] | None:
        """Return the first better factors on the way back from a step, regressors and cost."""
        for halving in range(_HALVINGS):
            trial = factors + step * 0.5 ** halving
            if np.isfinite(limit) and np.max(_roots(trial).real) * self._top > limit:
                continue
            regressors = self._regressors(trial)
            new = self._cost(regressors)[0]
            if new < cost:
                return trial, regressors, new
        return None

    def _regressors(self, factors: Array) -> Array:
        """Return the rows that explain the outputs, of unit norm or zero, the outputs below."""
        rows = [*self._states(factors), self._direct]
        slow = self._slowest(factors)
        if slow is not None:
            rows.append(self._ones * self._filter(factors[slow]))
        found = as_real(np.concatenate((*rows, self._outputs)))
        norm = _norms(found)
        norm[-len(self._y):] = 1.0
        found /= norm[:, np.newaxis]
        return found

    def _cost(self, regressors: Array) -> tuple[float, Array]:
        """Return the cost, and the sum of squares that each output keeps."""
        ny, lines = len(self._y), self._count
        left = triangle(regressors.T)[-ny:, -ny:]
        squares = np.einsum('ij,ij->j', left, left)
        return lines * float(np.log(np.maximum(squares, ROUNDING) / lines).sum()), squares

    def _weights(self, regressors: Array) -> tuple[Array, Array, Array, Array]:
        """Return regressors, weights theta, an orthonormal basis q of them, and the residual."""
        rows = regressors[:-len(self._y)]
        q, r = factors(rows.T)
        weights = self._y @ q
        theta = np.linalg.lstsq(r, weights.T, rcond=1e-12)[0].T
        return rows, theta, q, self._y - weights @ q.T

    def _states(self, factors: Array) -> list[Lines]:
        """Return the rows z q and z s q of each factor, q = 1 / (s^2 + a s + b)."""
        blocks = []
        for factor in factors:
            rows = self._z * self._filter(factor)
            blocks += [rows, rows * self._s] if factor[2] else [rows]
        return blocks

    def _filter(self, factor: Array) -> Lines:
        a, b, quadratic = factor
        s: Lines = self._s
        denominator = s * (s + float(a)) + float(b) if quadratic else s + float(b)
        safe = np.where(denominator == 0.0, complex(_AXIS), denominator)
        return np.asarray(1.0 / safe, dtype=np.complex128)

    def _slowest(self, factors: Array) -> int | None:
        """Return the factor of a pole too slow for the window, if there is one."""
        if not len(factors) or not len(self._ones) or self._through_states:
            return None
        sizes = [np.abs(_roots(factor[np.newaxis])).min() for factor in factors]
        return int(np.argmin(sizes)) if min(sizes) < self._slow else None

    def _step(self, factors: Array, rows: Array, theta: Array, q: Array,
              residual: Array) -> Array:
        """Return the Gauss-Newton step of the factors (Kaufman's variable projection)."""
        changes, places = self._changes(factors, rows, theta)
        found = _solved(_columns(changes, q, residual), residual)[0]
        return _placed(found, places, factors)

    def _changes(self, factors: Array, rows: Array,
                 theta: Array) -> tuple[list[Array], list[tuple[int, int]]]:
        """Return the derivatives of what is explained by the entries of the factors; which."""
        changes: list[Array] = []
        places: list[tuple[int, int]] = []
        width, first, slow = len(self._z), 0, self._slowest(factors)
        for i, factor in enumerate(factors):
            count = 2 * width if factor[2] else width
            part = theta[:, first:first + count] @ rows[first:first + count]
            first += count
            if i == slow:
                levels = len(self._ones)
                part = part + theta[:, -levels:] @ rows[-levels:]
            # What a factor explains, filtered once more, is its derivative.
            once = -part.view(np.complex128) * self._filter(factor)
            moves = [(1, once)] + [(0, once * self._s)] * bool(factor[2])
            changes += [as_real(change) for _, change in moves]
            places += [(i, k) for k, _ in moves]
        return changes, places

    def joint_step(self, poles: NDArray[np.complex128], late: NDArray[np.bool_]) -> JointStep:
        """
        Return the Gauss-Newton step of poles and dead times from given poles.

        Parameters
        ----------
        poles : ndarray, shape (n,)
            Real, or in conjugate pairs [rad/s].
        late : ndarray, shape (nu,)
            Which inputs' dead times move.

        Notes
        -----
        What an input explains, times -s, is the derivative by its dead time: but for a multiple
        of the tail, which is a regressor in any case unless the input acts at once.
        """
        factors = _factors(poles / self._top)
        rows, theta, q, residual = self._weights(self._regressors(factors))
        changes, places = self._changes(factors, rows, theta)
        width = len(self._z)
        blocks = sum(2 if quadratic else 1 for quadratic in (factors[:, 2] != 0.0).tolist())
        for j in np.flatnonzero(late).tolist():
            own = [j + width * block for block in range(blocks)]
            own += [width * blocks + j] * self.feedthrough
            part = (theta[:, own] @ rows[own]).view(np.complex128)
            changes.append(as_real(-self._s * part))
        found, left = _solved(_columns(changes, q, residual), residual)
        before, after = (np.maximum(np.sum(r ** 2, axis=1), ROUNDING) for r in (residual, left))
        delays = np.zeros(len(late))
        delays[late] = found[len(places):] / self._top
        step = _placed(found[:len(places)], places, factors)
        return JointStep(lambda part: _roots(factors + part * step) * self._top, delays,
                         self._count * float(np.log(before / after).sum()))


def _columns(changes: list[Array], q: Array, residual: Array) -> Array:
    """Return the columns of a Jacobian, each output in units of its residual."""
    size = _sizes(residual)
    columns: Array = np.stack(
        [((real - (real @ q) @ q.T) / size).ravel() for real in changes], axis=1)
    return columns


def _sizes(residual: Array) -> Array:
    size: Array = np.sqrt(np.maximum(np.sum(residual ** 2, axis=1), ROUNDING))[:, np.newaxis]
    return size


def _solved(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """Return the step that a Jacobian and residuals ask for, and what it would leave of them."""
    norm, size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300), _sizes(residual)
    found: Array = np.linalg.lstsq(
        jacobian / norm, (residual / size).ravel(), rcond=1e-8)[0] / norm
    left: Array = residual - size * (jacobian @ found).reshape(residual.shape)
    return found, left


def _placed(found: Array, places: list[tuple[int, int]], factors: Array) -> Array:
    step = np.zeros_like(factors)
    for (i, k), value in zip(places, found, strict=True):
        step[i, k] = value
    return step


def _norms(rows: Array) -> Array:
    norm: Array = np.sqrt(np.einsum('ij,ij->i', rows, rows))
    norm[norm == 0.0] = 1.0
    return norm


def _unit_rows(rows: Lines) -> Lines:
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(norm > 0.0, norm, 1.0)


def _factors(poles: NDArray[np.complex128]) -> Array:
    """Group poles in rows (a, b, 1) of s^2 + a s + b, and one (0, b, 0) of s + b."""
    complex_ones = poles[poles.imag > 0.0]
    real = np.sort(poles[poles.imag == 0.0].real)
    rows = [(-2.0 * p.real, abs(p) ** 2, 1.0) for p in complex_ones]
    rows += [(-(p + q), p * q, 1.0) for p, q in zip(real[0::2], real[1::2], strict=False)]
    if len(real) % 2:
        rows.append((0.0, -real[-1], 0.0))
    return np.array(rows).reshape(-1, 3)


def _roots(factors: Array) -> NDArray[np.complex128]:
    roots: list[complex] = []
    for a, b, quadratic in factors.tolist():
        if not quadratic:
            roots.append(complex(-b))
            continue
        root = csqrt(a * a - 4.0 * b)
        roots += [(-a + root) / 2.0, (-a - root) / 2.0]
    return np.array(roots, dtype=complex)
