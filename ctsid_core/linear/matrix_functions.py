# SPDX-License-Identifier: Apache-2.0
"""
The matrix exponential and its integrals, for very many intervals at once.

    phi_0(z) = e^z,     phi_(j+1)(z) = (phi_j(z) - 1/j!) / z                                 (1)

(M. Hochbruck, A. Ostermann, "Exponential integrators", Acta Numerica 19, 2010, section 2). Where
the eigenvectors of A are well-conditioned they are functions of its eigenvalues; elsewhere
(multiple poles) power series, summed on a short interval and doubled. `chain` takes modes from
interval to interval.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import factorial

import numpy as np
from scipy.linalg.lapack import dgebal, dtbtrs, ztbtrs

from ctsid_core.linear.types import Array, ComplexArray

CONDITION_LIMIT = 1e4  # of the eigenvectors: scalar recursions lose that factor of 2e-16
SOUND = 1e10           # the same where six digits are enough
_SAME = 1e-6           # distance of eigenvalues over the largest, with which they are one
_APART = 1e-8          # of a matrix: a change that sets modes apart which are parallel


@dataclass(frozen=True)
class Modes:
    """
    Eigenvalues and eigenvectors of a real matrix, one of each conjugate pair.

    With z = left x, every mode obeys dz/dt = value z, and x = Re(right z).
    """

    values: ComplexArray  # (m,): with imaginary part >= 0 [rad/s]
    right: ComplexArray   # (n, m): eigenvectors, those of a pair doubled for the half left out
    left: ComplexArray    # (m, n)


def modes(A: Array, condition_limit: float = CONDITION_LIMIT) -> Modes | None:
    """Return the modes of A, or None if its eigenvectors are worse conditioned than the limit."""
    if not A.size:
        none = np.empty((0, 0), dtype=complex)
        return Modes(none.reshape(-1), none, none)
    same, scale = balanced(A)
    values, vectors = np.linalg.eig(same)
    sizes = np.linalg.svd(vectors, compute_uv=False)
    if not sizes[0] < condition_limit * sizes[-1]:
        return None
    keep = values.imag >= 0
    doubled = np.where(values.imag > 0, 2.0, 1.0)
    right = (scale[:, np.newaxis] * vectors * doubled)[:, keep]
    left = (np.linalg.inv(vectors) / scale)[keep]
    return Modes(values[keep].astype(complex), right.astype(complex), left.astype(complex))


def balanced(A: Array) -> tuple[Array, Array]:
    """Return A with states in other units, and these units (n,): theirs must not decide."""
    found, _, _, scale, _ = dgebal(A, scale=1, permute=0)
    return found, scale


def phi(z: Array | ComplexArray, count: int) -> list[ComplexArray]:
    """Return phi_0 ... phi_count of (1), elementwise, to rounding for any z with Re z < 700."""
    # Recursion (1) loses all digits for small z; there the last one comes from its power series
    # and the others from (1) read backwards, phi_j = z phi_(j+1) + 1/j!. All are real if z is.
    small = np.abs(z) < 1
    if count and z.size and small.all():
        found = [_phi_series(z, count)]
        for j in range(count, 0, -1):
            found.insert(0, z * found[0] + 1 / factorial(j - 1))
        return found
    with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
        found = [np.exp(z)]
        for j in range(count):
            found.append((found[-1] - 1 / factorial(j)) / z)
    if count and small.any():
        x = z[small]
        value = _phi_series(x, count)
        for j in range(count, 0, -1):
            found[j][small] = value
            value = x * value + 1 / factorial(j - 1)
    return found


def _phi_series(x: Array | ComplexArray, j: int) -> ComplexArray:
    # sum_k x^k / (k + j)!, as many terms as the largest |x| < 1 needs
    largest, terms = float(np.abs(x).max()), 2
    while largest ** terms * factorial(j) / factorial(terms + j) > 1e-17:
        terms += 1
    value: ComplexArray = np.full_like(x, 1 / factorial(terms + j))
    for k in range(terms - 1, -1, -1):
        value *= x
        value += 1 / factorial(k + j)
    return value


def chain(factor: Array | ComplexArray, push: Array | ComplexArray) -> ComplexArray:
    """
    Return z of z_0 = 0, z_(k+1) = factor_k z_k + push_k, (m, w, K + 1); real if both are.

    Of factors (m, K), or (m, 1) if they are the same at every step, and pushes (m, w, K): by
    LAPACK's solver for band matrices.
    """
    m, width, count = push.shape
    kind = np.result_type(factor, push)
    solver = ztbtrs if kind.kind == 'c' else dtbtrs
    z: ComplexArray = np.zeros((m, width, count + 1), dtype=kind)
    if count:
        band = np.ones((2, count), dtype=kind, order='F')
        for own, factors, pushes in zip(z, factor, push, strict=True):
            band[1, :-1] = -factors[1:] if len(factors) > 1 else -factors[0]
            solved, _ = solver(band, pushes.T, uplo='L', diag='U')
            own[:, 1:] = solved.T
    return z


def led_through(moves: Array, pushes: Array, start: Array) -> Array:
    """Return x of x_(k+1) = moves_k x_k + pushes_k, (N, n, w), of the first one, (n, w)."""
    # In as many blocks as each is long, all of them at a time: what each makes of its start first.
    count, n, width = pushes.shape
    long = max(int(np.sqrt(count)), 1)
    blocks = -(-count // long)
    spare = ((0, blocks * long - count), (0, 0), (0, 0))
    M, d = (np.pad(x, spare).reshape(blocks, long, n, -1).swapaxes(0, 1) for x in (moves, pushes))
    x = np.zeros((blocks, n, width + n)) + np.eye(n, width + n, k=width)
    for move, push in zip(M, d, strict=True):
        x = move @ x
        x[:, :, :width] += push
    starts = np.empty((blocks, n, width))
    for own, made in zip(starts, x, strict=True):
        own[:] = start
        start = made[:, :width] + made[:, width:] @ start
    found = np.empty((long, blocks, n, width))
    for own, move, push in zip(found, M, d, strict=True):
        own[:] = starts
        starts = move @ starts + push
    return found.swapaxes(0, 1).reshape(-1, n, width)[:count]


def exponentials(A: Array, h: Array, count: int) -> list[Array]:
    """
    Return h^j phi_j(A h) for j = 0 ... count: e^(A h) and its repeated integrals, each (K, n, n).

    Of A (n, n) and intervals h (K,) [s].
    """
    found = modes(A)
    if found is None:
        return _doubled_series(A, h, count)
    functions = phi(h[:, np.newaxis] * found.values, count)
    return [((found.right * (f * h[:, np.newaxis] ** j)[:, np.newaxis]) @ found.left).real
            for j, f in enumerate(functions)]


def change_of(A: Array, changes: Array, function: Callable[[ComplexArray], ComplexArray],
              slope: Callable[[ComplexArray], ComplexArray]) -> Array:
    """
    Return by how much a function of A moves, (r, n, n), to first order in changes of A.

    Given are the function and its derivative of complex numbers (N. J. Higham, "Functions of
    Matrices", 2008, theorem 3.11: Daleckii and Krein).
    """
    A, scale = balanced(A)
    changes = changes * scale / scale[:, np.newaxis]
    values, right = np.linalg.eig(A)
    if np.linalg.cond(right) > CONDITION_LIMIT:     # as of two integrators: they are set apart
        A = A + _APART * np.linalg.norm(A) * np.cos(np.arange(A.size)).reshape(A.shape)
        values, right = np.linalg.eig(A)
    values, left = values.astype(complex), np.linalg.inv(right)
    found, gap = function(values), values[:, np.newaxis] - values
    same = np.abs(gap) <= _SAME * np.max(np.abs(values), initial=0.0)
    ratio = np.where(same, slope(0.5 * (values[:, np.newaxis] + values)),
                     (found[:, np.newaxis] - found) / np.where(same, 1.0, gap))
    moved = (right @ (ratio * (left @ changes @ right)) @ left).real
    return np.asarray(moved * scale[:, np.newaxis] / scale)


def _doubled_series(A: Array, h: Array, count: int) -> list[Array]:
    # Power series on h / 2^s, where |A| h / 2^s <= 1/2, then s times
    #   F_j(2h) = F_0(h) F_j(h) + sum_(i=1..j) h^(j-i)/(j-i)! F_i(h),   F_j(h) = h^j phi_j(A h).
    n, terms = len(A), 16
    scaled, scale = balanced(A)
    size = np.abs(h) * np.max(np.abs(scaled).sum(axis=0), initial=0.0)
    doublings = np.maximum(np.ceil(np.log2(np.maximum(2 * size, 1e-300))), 0).astype(int)
    step = h / 2.0 ** doublings
    powers = [np.eye(n)]
    for _ in range(terms - 1):
        powers.append(powers[-1] @ scaled)
    flat = np.array(powers).reshape(terms, n * n)
    functions = []
    for j in range(count + 1):
        weights = [step ** (k + j) / factorial(k + j) for k in range(terms)]
        functions.append((np.array(weights).T @ flat).reshape(len(h), n, n))
    for level in range(int(doublings.max(initial=0))):
        rows = np.flatnonzero(doublings > level)
        old = [f[rows] for f in functions]  # copies: every new one needs all of the old ones
        h = step[rows, np.newaxis, np.newaxis]
        for j, f in enumerate(functions):
            f[rows] = old[0] @ old[j] + sum(
                (h ** (j - i) / factorial(j - i) * old[i] for i in range(1, j + 1)), np.zeros(()))
        step[rows] *= 2
    return [f * scale[:, np.newaxis] / scale for f in functions]
