# SPDX-License-Identifier: Apache-2.0
"""
Hermite functions h_n, orthonormal on the real line ([HD] eq. 13 to 18).

    h_n(x) = exp(-x^2/2) H_n(x) / sqrt(2^n sqrt(pi) n!)

The three-term recursion (eq. 16) is stable, but its start, exp(-x^2/2), underflows to zero at
|x| > 38.6 although h_n(x) is large there for n > 745. Beyond that argument the recursion
therefore runs on mantissas, and the power of two of every argument is carried apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from ctsid_core.linear.types import Array

_PLAIN_LIMIT = 37.0     # exp(-37^2/2) = 1e-297 is still a normal number
_EXPONENT_STEP = 512    # mantissas are brought back by 2^-512 when they exceed 2^512
BLOCK = 8192            # samples and
_ORDERS = 32            # orders evaluated at a time, to stay in the cache
_CHECK_EVERY = 16       # steps between two such checks: growth stays below (2 x)^16
_LN2_HIGH = 0.693145751953125           # 16 bits: times any exponent here is exact
_LN2_LOW = 1.42860682030941723212e-6
_NOTHING = 1e-18        # of the largest entry of a table: far below rounding
_ROWS = 48              # of a block of it
_FEW = 4                # vectors that are taken one after the other


def hermite_functions(nmax: int, x: Array) -> Array:
    """Return h_0 .. h_nmax at dimensionless times x (N,): (nmax + 1, N) ([HD] eq. 16 to 18)."""
    x = np.asarray(x, dtype=float)
    if x.size and np.abs(x).max() >= _PLAIN_LIMIT:
        # Outside of |x| = R + 40 every h_n is below 1e-300: moving x there changes nothing.
        edge = np.sqrt(2.0 * nmax + 1.0) + 40.0
        return _scaled_recursion(nmax, np.clip(x, -edge, edge))
    (r, s), g = _balanced_coefficients(nmax), np.empty((nmax + 1, x.size))
    g[0] = np.pi ** -0.25 * np.exp(-0.5 * x * x)
    if nmax > 0:
        np.multiply(x, np.sqrt(2.0) * g[0], out=g[1])
    for n in range(1, nmax):                                                 # eq. 16
        np.multiply(x, r[n], out=g[n + 1])
        np.multiply(g[n + 1], g[n], out=g[n + 1])
        np.subtract(g[n + 1], g[n - 1], out=g[n + 1])
    g /= s[:, np.newaxis]
    return g


def _coefficients(nmax: int) -> tuple[Array, Array]:
    n = np.arange(nmax, dtype=float)
    return np.sqrt(2.0 / (n + 1.0)), np.sqrt(n / (n + 1.0))


@lru_cache(maxsize=64)
def _balanced_coefficients(nmax: int) -> tuple[Array, Array]:
    """
    Return r (nmax,) and s (nmax + 1,) so that g_n = s_n h_n obeys g_(n+1) = r_n x g_n - g_(n-1).

    One multiplication per value less than eq. 16; s grows as n^(1/4) only.
    """
    a, b = _coefficients(nmax)
    s = np.ones(nmax + 1)
    s[2::2] = np.cumprod(1.0 / b[1::2])
    s[3::2] = np.cumprod(1.0 / b[2::2])
    return a * s[1:] / s[:-1], s


def project_directly(nmax: int, x: Array, weights: Array) -> Array:
    """
    Return the sums over the samples of h_n(x_k) weights_k, shape (m, nmax + 1).

    Of x (N,) and weights (m, N), without keeping the h_n.
    """
    if x.size == 0 or np.abs(x).max() >= _PLAIN_LIMIT:
        return _project_by_parts(nmax, x, weights)
    total = np.zeros((nmax + 1, len(weights)))
    for first in range(0, len(x), BLOCK):
        part = slice(first, first + BLOCK)
        _add_products(x[part], weights[:, part].T, total)
    return (total / _balanced_coefficients(nmax)[1][:, np.newaxis]).T


def _add_products(x: Array, weights: Array, total: Array) -> None:
    """Add g_n(x) @ weights to row n of total; a few orders at a time, which stay in the cache."""
    r, _ = _balanced_coefficients(len(total) - 1)
    g = np.zeros((_ORDERS + 2, len(x)))                 # rows 0 and 1: the two orders before
    for start in range(0, len(total), _ORDERS):
        count = min(_ORDERS, len(total) - start)
        for n in range(start, start + count):                                # eq. 16
            row = g[n - start + 2]
            if n < 2:
                row[:] = np.pi ** -0.25 * np.exp(-0.5 * x * x) if n == 0 else \
                    np.sqrt(2.0) * x * g[2]
                continue
            np.multiply(x, r[n - 1], out=row)
            np.multiply(row, g[n - start + 1], out=row)
            np.subtract(row, g[n - start], out=row)
        total[start:start + count] += g[2:count + 2] @ weights
        g[:2] = g[count:count + 2]


def _project_by_parts(nmax: int, x: Array, weights: Array) -> Array:
    total = np.zeros((len(weights), nmax + 1))
    for first in range(0, len(x), BLOCK):
        part = slice(first, first + BLOCK)
        total += weights[:, part] @ hermite_functions(nmax, x[part]).T
    return total


def _gauss_split(x: Array) -> tuple[Array, NDArray[np.int64]]:
    """
    Return m, j with exp(-x^2/2) = m 2^j and m near 1, without rounding error of large x^2.

    The square of the leading 24 bits of x is exact; the rest is small.
    """
    lead = x.astype(np.float32).astype(np.float64)
    large = 0.5 * lead * lead
    small = 0.5 * (x - lead) * (x + lead)
    j = np.rint(large / np.log(2.0))
    mantissa = np.exp(-((large - j * _LN2_HIGH) - j * _LN2_LOW + small))
    return mantissa, -j.astype(np.int64)


def _scaled_recursion(nmax: int, x: Array) -> Array:
    mantissa, exponent = _gauss_split(x)
    a, b = _coefficients(max(nmax, 1))
    h = np.empty((nmax + 1, len(x)))
    previous, current = np.zeros_like(x), np.pi ** -0.25 * mantissa
    for n in range(nmax + 1):
        np.ldexp(current, exponent, out=h[n])
        if n == nmax:
            break
        previous, current = current, a[n] * x * current - b[n] * previous    # eq. 16
        if n % _CHECK_EVERY == 0:
            big = np.abs(current) > 2.0 ** _EXPONENT_STEP
            if big.any():
                shift = np.where(big, -_EXPONENT_STEP, 0)
                previous, current = np.ldexp(previous, shift), np.ldexp(current, shift)
                exponent -= shift
    return h


def integral_of_first(x: Array) -> Array:
    """Return I_0(x), the integral of h_0 from minus infinity to x."""
    return np.asarray(np.pi ** 0.25 / np.sqrt(2.0) * (1.0 + erf(x / np.sqrt(2.0))))


@dataclass(frozen=True, eq=False)
class Blocks:
    """
    A large table of which much is zero, in blocks of rows, for products with few vectors.

    A Hermite function is nothing beyond its reach, so that a fourth of a table of them is zero, on
    one side of each row. Such products take the time to read the table from memory: without its
    zeros, each block is read once and serves all vectors.
    """

    shape: tuple[int, int]                      # rows and columns
    blocks: tuple[tuple[int, int, Array], ...]  # of each: first row, first column, entries

    @classmethod
    def of(cls, matrix: Array) -> Blocks:
        """Return the blocks of a matrix (r, c)."""
        least = _NOTHING * float(np.abs(matrix).max(initial=0.0))
        found = []
        for row in range(0, len(matrix), _ROWS):
            part = matrix[row:row + _ROWS]
            there = np.flatnonzero((np.abs(part) > least).any(axis=0))
            if len(there):
                found.append((row, int(there[0]), np.ascontiguousarray(
                    part[:, there[0]:there[-1] + 1])))
        return cls((matrix.shape[0], matrix.shape[1]), tuple(found))

    def times(self, vectors: Array) -> Array:
        """Return the products of the matrix (r, c) with vectors (m, c): (m, r)."""
        found = np.zeros((len(vectors), self.shape[0]))
        vectors = np.ascontiguousarray(vectors)
        for row, column, entries in self.blocks:
            rows, columns = (slice(first, first + n) for first, n in
                             zip((row, column), entries.shape, strict=True))
            if len(vectors) > _FEW:
                np.matmul(vectors[:, columns], entries.T, out=found[:, rows])
                continue
            for vector, out in zip(vectors, found, strict=True):
                np.dot(entries, vector[columns], out=out[rows])
        return found
