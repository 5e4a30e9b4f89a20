# SPDX-License-Identifier: Apache-2.0
"""
The covariance of a model, and of what follows from it.

Whatever a model says (a pole, a gain, a point of its frequency response) is a function f of its
entries; to first order its covariance is that of the entries seen through the derivatives of f.
All of it is in one matrix, the root of the covariance of the entries.

    d lambda_i = l_i dA r_i,    l_i, r_i the left and right eigenvectors, l_i r_i = 1           (1)
    dG = L dA X + L dB + dC X + dD - j omega G d delay,                                         (2)
    L = C (j omega I - A)^-1,  X = (j omega I - A)^-1 B  (before the dead time)

Which model it should be is not known either. Rivals, of another order or with other dead times,
are as likely as their share of the Akaike weights says, and the response varies by them, too:

    var G = var(G | model) + sum_i w_i |G_i - G|^2.                                             (3)

Sources: G. H. Golub, C. F. Van Loan, "Matrix Computations", 4th edition, section 7.2.2, for (1);
L. Ljung, "System Identification", 2nd edition, section 9.4 and appendix 9A, for (2);
S. T. Buckland, K. P. Burnham, N. H. Augustin 1997, Biometrics 53, for (3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model import realisation
from ctsid_core.model.statespace import StateSpace

_KNOWN = 1e-10        # of the largest singular value of the scaled root: below it is rounding
_EQUAL = 1e-6         # of the largest pole, and of its largest change: more is a difference
_STATIC = 0.1         # of the slowest pole: the DC gain but for 0.5 %, and 0.1 rad, which count
                      # as modes do that outlast a record


class Entries(NamedTuple):
    """Rows of changes of a model's entries."""

    A: Array      # (r, n, n)
    B: Array      # (r, n, nu)
    C: Array      # (r, ny, n)
    D: Array      # (r, ny, nu)
    delay: Array  # (r, nu)

    def rows(self) -> Array:
        """Return them as rows of a root, (r, p)."""
        return np.hstack([part.reshape(len(part), -1) for part in self])


class ResponseDeviation(NamedTuple):
    """How well a frequency response is known."""

    magnitude: Array  # (M, ny, nu): of |G| over |G|; times 8.686 it is in dB
    phase: Array      # (M, ny, nu) [rad]


class Rival(NamedTuple):
    """A model of the same channels that might have been chosen instead."""

    share: float  # of the Akaike weights of all that were tried, the chosen one among them
    model: StateSpace


@dataclass(frozen=True, eq=False)
class Covariance:
    """
    The covariance of a model's entries; equal (==) if all numbers are.

    root^T root is that of the entries of A, B, C and D, row by row, and of one dead time per
    input: p = n n + n nu + ny n + ny nu + nu. Zero columns belong to entries that were not
    estimated (constant channels, D or dead times that are given). The data say nothing of the
    states, so directions that change nothing but these are of no length: single entries are known
    as well as those of models in the nearest states.

    Raises `DataError` if the shape of the root does not fit, an entry is not finite, or a rival is
    of other inputs and outputs.
    """

    root: Array  # (r, p)
    n: int       # number of states, inputs and outputs
    nu: int
    ny: int
    # Models that gains, responses and dead times may be those of; none: no other was tried
    rivals: tuple[Rival, ...] = ()

    def __post_init__(self) -> None:
        root = np.array(self.root, dtype=float)
        count = self.entry_count(self.n, self.nu, self.ny)
        if root.ndim != 2 or root.shape[1] != count or not np.isfinite(root).all():
            raise DataError(f'`root` has shape {root.shape}; for {self.n} states, {self.nu} '
                            f'inputs and {self.ny} outputs wanted are rows of {count} finite '
                            'numbers')
        if any((m.nu, m.ny) != (self.nu, self.ny) or not 0.0 < share <= 1.0
               for share, m in self.rivals):
            raise DataError(f'`rivals` need a share of more than 0 and at most 1, {self.nu} '
                            f'inputs and {self.ny} outputs')
        root.setflags(write=False)
        object.__setattr__(self, 'root', root)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Covariance):
            return NotImplemented
        return (self.n, self.nu, self.ny, self.rivals) == (
            other.n, other.nu, other.ny, other.rivals) and np.array_equal(self.root, other.root)

    def __hash__(self) -> int:
        return hash((self.n, self.nu, self.ny, (self.root + 0.0).tobytes(), self.rivals))

    @staticmethod
    def entry_count(n: int, nu: int, ny: int) -> int:
        """Return how many entries a model has: the length p of a row."""
        return n * n + n * nu + ny * n + ny * nu + nu

    @property
    def entries(self) -> Entries:
        """The rows of the root, as changes of the matrices."""
        n, nu, ny = self.n, self.nu, self.ny
        shapes: tuple[tuple[int, ...], ...] = (n, n), (n, nu), (ny, n), (ny, nu), (nu,)
        parts = np.split(self.root, np.cumsum([prod(shape) for shape in shapes])[:-1], axis=1)
        return Entries(*(part.reshape(len(self.root), *shape)
                         for part, shape in zip(parts, shapes, strict=True)))

    @classmethod
    def of_entries(cls, entries: Entries, model: StateSpace,
                   rivals: tuple[Rival, ...] = ()) -> Covariance:
        """
        Return the covariance for rows of changes, as few rows as tell it.

        What changes the states of the model only is taken out.
        """
        rows = entries.rows()
        size = np.max(np.abs(rows), axis=0, initial=0.0)
        size[size == 0.0] = 1.0
        scaled = rows / size
        free = np.vstack(realisation.state_changes(model.A, model.B, model.C))
        basis = np.linalg.qr(free / size[:len(free), np.newaxis])[0]
        scaled[:, :len(free)] -= (scaled[:, :len(free)] @ basis) @ basis.T
        _, s, right = np.linalg.svd(np.linalg.qr(scaled, mode='r'), full_matrices=False)
        kept = (s > _KNOWN * s[:1]) & (np.arange(len(s)) < max(rows.shape[1] - model.n ** 2, 0))
        root = s[kept, np.newaxis] * right[kept] * size
        root[:, ~np.any(rows, axis=0) & (np.max(np.abs(root), axis=0, initial=0.0) < _KNOWN)] = 0.0
        return cls(root, model.n, model.nu, model.ny, rivals)

    def transform(self, T: ArrayLike) -> Covariance:
        """Return the same for the states z = T x (`StateSpace.transform`)."""
        T, e = np.asarray(T, dtype=float), self.entries
        inverse = np.linalg.inv(T)
        moved = e._replace(A=T @ e.A @ inverse, B=T @ e.B, C=e.C @ inverse)
        return replace(self, root=moved.rows())

    def pole_changes(self, model: StateSpace) -> ComplexArray:
        """Return what the rows of the root change of the poles of the model (1), (r, n)."""
        values, right = modes(model.A)
        order = realisation.pole_order(values.astype(complex))
        left, right = np.linalg.inv(right)[order], right[:, order]
        found = np.einsum('ia,rab,bi->ri', left, self.entries.A, right, optimize=True)
        return np.asarray(np.where(model.poles.imag == 0.0, found.real, found).astype(complex))

    def response_changes(self, model: StateSpace, omega: ArrayLike) -> ComplexArray:
        """Return what they change of G(s) (2), over exp(-s delay), at j omega: (r, M, ny, nu)."""
        s = 1j * np.asarray(omega, dtype=float)[:, np.newaxis, np.newaxis]
        e = self.entries
        system = s * np.eye(self.n) - model.A
        L = np.swapaxes(np.linalg.solve(np.swapaxes(system, 1, 2), model.C.T + 0 * s), 1, 2)
        X = np.linalg.solve(system, model.B + 0 * s)
        dA, dB, dC, dD = (part[:, np.newaxis] for part in e[:4])
        G = model.C @ X + model.D
        return L @ (dA @ X + dB) + dC @ X + dD - (s * G) * e.delay[:, np.newaxis, np.newaxis]

    def response_differences(self, model: StateSpace, omega: ArrayLike) -> ComplexArray:
        """Return the same with a row for each rival: sum of |rows|^2 is the variance (3)."""
        return np.concatenate(
            (self.response_changes(model, omega), self.rival_differences(model, omega)))

    def rival_differences(self, model: StateSpace, omega: ArrayLike) -> ComplexArray:
        """
        Return the rows of rivals alone; one without a finite response does not count.

        Times exp(s delay), as `response_changes`.
        """
        omega = np.asarray(omega, dtype=float)
        late = np.exp(1j * np.outer(omega, model.delay))[:, np.newaxis]
        own = model.frequency_response(omega)
        found = np.zeros((len(self.rivals), *own.shape), dtype=complex)
        with np.errstate(invalid='ignore'):
            for row, (share, other) in zip(found, self.rivals, strict=True):
                row[:] = np.sqrt(share) * (other.frequency_response(omega) - own) * late
        return np.where(np.isfinite(found), found, 0.0)


def pole_covariance(covariance: Covariance, model: StateSpace) -> Array:
    """
    Return the covariance of (real part, imaginary part) of each pole, (n, 2, 2) [rad^2/s^2].

    Its shape is that of changes to first order, its size that of `pole_deviation`.
    """
    change = covariance.pole_changes(model)
    parts = np.stack((change.real, change.imag), axis=-1)
    found = np.einsum('rik,ril->ikl', parts, parts)
    total = np.trace(found, axis1=1, axis2=2)
    size = scatter_of_poles(model.poles, change) ** 2 / np.where(total > 0.0, total, 1.0)
    return np.asarray(found * size[:, np.newaxis, np.newaxis])


def modes(A: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return poles and modes; equal poles whose modes are any of a plane have some far apart."""
    values, right = np.linalg.eig(A)
    same = np.abs(values - values[:, np.newaxis]) <= _EQUAL * np.abs(values)
    for own in {tuple(np.flatnonzero(row).tolist()) for row in same if np.sum(row) > 1}:
        _, s, axes = np.linalg.svd(A - np.mean(values[list(own)]) * np.eye(len(A)))
        if s[-len(own)] <= _KNOWN * s[0]:
            right = right.astype(complex)
            right[:, list(own)] = axes[-len(own):].conj().T
    return values, right


def pole_deviation(covariance: Covariance, model: StateSpace) -> Array:
    """Return the square root of the expected squared distance of each pole, (n,) [rad/s]."""
    return scatter_of_poles(model.poles, covariance.pole_changes(model))


def scatter_of_poles(poles: ComplexArray, changes: ComplexArray) -> Array:
    """
    Return the square root of the expected squared distance of each pole, (n,) [rad/s].

    Given are the poles' changes d to first order along independent directions, (r, n). Where poles
    meet derivatives are infinite, and the poles move less: to those of diag(p) + 1 d', whose
    characteristic polynomial moves as it does to first order. One deviation to either side along
    the principal directions of all changes. Which pole has moved where is told in units of their
    deviations to first order: one that is hardly known passes others, which stay where they are.
    Equal poles of equal changes are one, that moves as a whole.
    """
    n, deviation = len(poles), _deviation(changes)
    if n < 2 or not changes.any() or not np.isfinite(changes).all():
        return deviation
    rows = np.concatenate((poles[np.newaxis], changes)).T
    alike = np.abs(rows[:, np.newaxis] - rows) <= _EQUAL * np.max(np.abs(rows), axis=0)
    first, place = np.unique(np.argmax(np.all(alike, axis=2), axis=1), return_inverse=True)
    if len(first) < n:
        return scatter_of_poles(poles[first], changes[:, first])[place]
    _, sizes, axes = np.linalg.svd(np.hstack((changes.real, changes.imag)), full_matrices=False)
    main = sizes[:, np.newaxis] * axes
    ahead = main[:, :n] + 1j * main[:, n:]
    moved = np.linalg.eigvals(np.diag(poles) + np.vstack((ahead, -ahead))[:, np.newaxis])
    away = np.abs(moved[:, np.newaxis] - poles[:, np.newaxis]) ** 2
    unit = (deviation[:, np.newaxis] + _KNOWN * np.max(deviation)) ** 2
    power = 0.5 * np.sum([one[linear_sum_assignment(one / unit)] for one in away], axis=0)
    # Poles nearer to each other than they are known are known alike.
    near = np.abs(poles[:, np.newaxis] - poles) < np.minimum(deviation[:, np.newaxis], deviation)
    np.fill_diagonal(near, True)
    power = near @ power / near.sum(axis=1)
    # Of a pair both are known alike.
    twin = np.where(poles.imag == 0.0, np.arange(n), np.argmin(
        np.abs(poles[:, np.newaxis] - poles.conj()), axis=1))
    return np.asarray(np.sqrt(0.5 * (power + power[twin])))


def natural_frequency_deviation(covariance: Covariance, model: StateSpace) -> Array:
    """Return the standard deviation of the magnitude of each pole, (n,) [rad/s]."""
    found, real = _deviation(_radial(covariance, model).real), model.poles.imag == 0.0
    found[real] = pole_deviation(covariance, model)[real]
    return found


def damping_deviation(covariance: Covariance, model: StateSpace) -> Array:
    """Return the standard deviation of each damping ratio, (n,); 0 for real poles, NaN at 0."""
    radial, size = _radial(covariance, model), model.natural_frequency
    across = np.abs(model.poles.imag) / np.where(size > 0.0, size, np.nan)
    # The ratio is minus the cosine of the pole's angle: it changes by the sine times that.
    return _deviation(radial.imag) * across / np.where(size > 0.0, size, np.nan)


def _radial(covariance: Covariance, model: StateSpace) -> ComplexArray:
    """Return the changes of the poles along (real) and across (imaginary) their radius."""
    poles, size = model.poles, model.natural_frequency
    turn = np.where(size > 0.0, poles.conj(), 1.0) / np.where(size > 0.0, size, 1.0)
    return covariance.pole_changes(model) * turn


def gain_deviation(covariance: Covariance, model: StateSpace) -> Array:
    """
    Return the standard deviation of the DC gain, (ny, nu); infinite as the gain at a pole at 0.

    Rivals differ from it where the response is hardly another yet, by a part of the slowest pole:
    nearer to 0 Hz they may have modes that outlast all records, and gains that none knows.
    """
    try:
        own = covariance.response_changes(model, np.zeros(1))[:, 0].real
        slow = _STATIC * np.min(np.abs(model.poles)) if model.n else 0.0
        apart = covariance.rival_differences(model, [slow])[:, 0]
        return np.where(np.isfinite(model.dc_gain), _deviation(np.concatenate((own, apart))),
                        np.inf)
    except np.linalg.LinAlgError:
        return np.full((model.ny, model.nu), np.inf)


def delay_deviation(covariance: Covariance, model: StateSpace) -> Array:
    """Return the standard deviation of each dead time of a model, rivals among it, (nu,) [s]."""
    apart = [np.sqrt(share) * (np.array(other.delay) - model.delay)
             for share, other in covariance.rivals]
    return _deviation(np.vstack((covariance.entries.delay, *apart)))


def response_deviation(covariance: Covariance, model: StateSpace,
                       omega: ArrayLike) -> ResponseDeviation:
    """
    Return the standard deviations of magnitude and phase at frequencies omega (M,) [rad/s].

    NaN where G is zero, or omega is an undamped pole. Both are of first order: where the deviation
    of the magnitude is not small against 1, G itself is normal, not its logarithm.
    """
    omega = np.asarray(omega, dtype=float)
    late = np.exp(1j * np.outer(omega, model.delay))[:, np.newaxis]
    response = model.frequency_response(omega)
    known = np.isfinite(response) & (response != 0.0)
    seen = known.any(axis=(1, 2))
    ratio = np.full((len(covariance.root) + len(covariance.rivals), *response.shape), np.nan,
                    dtype=complex)
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio[:, seen] = covariance.response_differences(model, omega[seen]) \
            / np.where(known, response * late, np.nan)[seen]
    return ResponseDeviation(_deviation(ratio.real), _deviation(ratio.imag))


def _deviation(changes: NDArray[np.inexact]) -> Array:
    return np.sqrt(np.sum(np.abs(changes) ** 2, axis=0))


def spread(entries: Entries, u: Sequence[int], y: Sequence[int], nu: int, ny: int) -> Entries:
    """Return changes of a model of inputs u and outputs y as those of nu inputs, ny outputs."""
    r, n = entries.A.shape[:2]
    columns, rows = list(u), list(y)
    B, C = np.zeros((r, n, nu)), np.zeros((r, ny, n))
    D, delay = np.zeros((r, ny, nu)), np.zeros((r, nu))
    B[:, :, columns], C[:, rows], delay[:, columns] = entries.B, entries.C, entries.delay
    D[np.ix_(range(r), rows, columns)] = entries.D
    return Entries(entries.A, B, C, D, delay)
