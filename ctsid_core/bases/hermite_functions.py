# SPDX-License-Identifier: Apache-2.0
"""
Hermite functions h_n, orthonormal on the real line ([HD] eq. 13 to 18), and sums over samples.

    h_n(x) = exp(-x^2/2) H_n(x) / sqrt(2^n sqrt(pi) n!)

The three-term recursion (eq. 16) is stable, but its start, exp(-x^2/2), underflows to zero at
|x| > 38.6 although h_n(x) is large there for n > 745. The recursion therefore runs on mantissas,
and the power of two of every argument is carried apart.

Sums over samples go by way of their frequencies, because a Hermite function is its own Fourier
transform but for a factor. With F_j the Fourier sums of the samples at uniform frequencies w_j,
the trapezoid rule gives

    sum_k weights_k h_n(x_k) = i^n / sqrt(2 pi)  integral h_n(w) F(w) dw
                             = i^n / sqrt(2 pi)  step sum_j h_n(w_j) F_j

exactly, but for what h_n leaves beyond its reach, in time and in frequency alike. The functions
are then wanted at frequencies that depend on nmax alone, however many the samples are.

A stamp lies at most half a step h of a grid from its nearest point: x_k = (g_k + z_k / 2) h with
|z_k| <= 1. One short series serves all stamps and frequencies (Jacobi and Anger, DLMF 10.12):

    exp(-i w x_k) = exp(-i w g_k h) sum_d b_d(w) T_d(z_k),   b_d = (2 - [d=0]) (-i)^d J_d(w h / 2)

with Chebyshev's polynomials T_d. The sums are thereby Fourier transforms of moments on the grid.
Where it resolves twice the highest frequency, w h / 2 <= pi / 4, the first term left out is at
most 6e-14, and falls as w^12 below.

Source: Ruiz-Antolin and Townsend, A nonuniform fast Fourier transform based on low rank
approximation, SIAM J. Sci. Comput. 40 (2018); the grid is finer here, and the series shorter.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft
from scipy.sparse import csc_array
from scipy.special import erf, jv

from ctsid_core.linear.types import Array, ComplexArray

_TERMS = 12             # of the series
_FINENESS = 2           # highest frequency of the grid over that of the sums
_BLOCK = 8192           # samples at a time, to stay in the cache
_EXPONENT_STEP = 512    # mantissas are brought back by 2^-512 when they exceed 2^512
_CHECK_EVERY = 16       # steps between two such checks: growth stays below (2 x)^16
_LN2_HIGH = 0.693145751953125           # 16 bits: times any exponent here is exact
_LN2_LOW = 1.42860682030941723212e-6
KEPT = 6                # sizes of bases, of up to 20 MB each; windows of one robot have several
_DECAY = 36.0               # beyond its reach h_nmax is below exp(-36) = 2e-16


@dataclass(frozen=True)
class Grid:
    """Uniform instants, and the frequencies that belong to them."""

    step: float           # between instants
    size: int             # how many instants: sums repeat after all of them
    w: Array              # (J,): frequencies from zero on, 2 pi / (size step) apart
    series: ComplexArray  # (J, terms): b_d(w_j)


def fourier_grid(reach: float, top: float) -> Grid:
    """
    Return the coarsest grid for stamps |x| <= reach and frequencies from 0 to `top` [rad].

    Sums are then periodic in x with 2 `reach`.
    """
    count = int(np.ceil(top * reach / np.pi)) + 1
    size = int(next_fast_len(2 * _FINENESS * (count - 1), real=True))
    step = 2.0 * reach / size
    j, d = np.arange(count), np.arange(_TERMS)
    w: Array = j * np.float64(np.pi / reach)
    bessel = jv(d, (np.pi / size * j)[:, np.newaxis])
    return Grid(step, size, w, np.where(d == 0, 1.0, 2.0) * (-1j) ** d * bessel)


def fourier_sums(x: Array, weights: Array, grid: Grid) -> ComplexArray:
    """
    Return the sums over the samples of weights_k exp(-i w_j x_k), shape (m, J).

    Of stamps x (N,) in any order, whose phase is rounded in proportion to them, and weights (m,
    N). Right to 1e-13 of the sum of the weights' magnitudes, for stamps the grid was made for.
    """
    moments = np.zeros((grid.size * _TERMS, len(weights)))
    for first in range(0, len(x), _BLOCK):
        part = slice(first, first + _BLOCK)
        moments += _scatter(x[part], grid) @ weights[:, part].T
    spectra = rfft(moments.reshape(grid.size, -1), axis=0)[:len(grid.w)]
    spectra = spectra.reshape(len(grid.w), _TERMS, -1)
    return np.asarray((spectra * grid.series[:, :, np.newaxis]).sum(axis=1).T)


def _scatter(x: Array, grid: Grid) -> csc_array:
    """Return what takes samples to their moments, T_d(z_k) in row (g_k, d) of column k."""
    nearest = np.rint(x / grid.step)
    z = (x - nearest * grid.step) * (2.0 / grid.step)      # near stamps keep their distance
    first = (nearest.astype(np.int64) % grid.size * _TERMS).astype(np.int32)
    rows = first[:, np.newaxis] + np.arange(_TERMS, dtype=np.int32)
    ends = np.arange(0, rows.size + 1, _TERMS, dtype=np.int32)
    return csc_array((chebvander(z, _TERMS - 1).ravel(), rows.ravel(), ends),
                     shape=(grid.size * _TERMS, len(x)))


def hermite_functions(nmax: int, x: Array) -> Array:
    """Return h_0 .. h_nmax at dimensionless times x (N,): (nmax + 1, N) ([HD] eq. 16 to 18)."""
    # Outside of |x| = R + 40 every h_n is below 1e-300: moving x there changes nothing.
    edge = np.sqrt(2.0 * nmax + 1.0) + 40.0
    x = np.clip(np.asarray(x, dtype=float), -edge, edge)
    mantissa, exponent = _gauss_split(x)
    n = np.arange(nmax + 1, dtype=float)
    a, b = np.sqrt(2.0 / (n + 1.0)), np.sqrt(n / (n + 1.0))
    h = np.empty((nmax + 1, len(x)))
    previous, current = np.zeros_like(x), np.pi ** -0.25 * mantissa
    for k in range(nmax + 1):
        np.ldexp(current, exponent, out=h[k])
        previous, current = current, a[k] * x * current - b[k] * previous    # eq. 16
        if k % _CHECK_EVERY == 0:
            big = np.abs(current) > 2.0 ** _EXPONENT_STEP
            if big.any():
                shift = np.where(big, -_EXPONENT_STEP, 0)
                previous, current = np.ldexp(previous, shift), np.ldexp(current, shift)
                exponent -= shift
    return h


def _gauss_split(x: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return m, j with exp(-x^2/2) = m 2^j and m near 1, without rounding error of large x^2."""
    # The square of the leading 24 bits of x is exact; the rest is small.
    lead = x.astype(np.float32).astype(np.float64)
    large = 0.5 * lead * lead
    small = 0.5 * (x - lead) * (x + lead)
    j = np.rint(large / np.log(2.0))
    mantissa = np.exp(-((large - j * _LN2_HIGH) - j * _LN2_LOW + small))
    return mantissa, -j.astype(np.int64)


def integral_of_first(x: Array) -> Array:
    """Return I_0(x), the integral of h_0 from minus infinity to x."""
    return np.asarray(np.pi ** 0.25 / np.sqrt(2.0) * (1.0 + erf(x / np.sqrt(2.0))))


def project(nmax: int, x: Array, weights: Array) -> Array:
    """Return sum_k h_n(x_k) weights_k, (m, nmax + 1), of x (N,) in any order, weights (m, N)."""
    grid, h = frequency_grid(nmax), frequency_table(nmax)
    inside = np.abs(x) <= 0.5 * grid.size * grid.step          # the reach
    spectrum = fourier_sums(x[inside], weights[:, inside], grid)
    spectrum *= grid.w[1] * np.sqrt(2.0 / np.pi)               # for both signs of w
    spectrum[:, 0] *= 0.5
    c = np.empty((len(weights), nmax + 1))
    c[:, 0::2], c[:, 1::2] = spectrum.real @ h[0::2].T, spectrum.imag @ h[1::2].T
    c[:, 1::4] *= -1.0                                         # i^n, or i times imaginary
    c[:, 2::4] *= -1.0
    return c


@lru_cache(maxsize=16)
def frequency_grid(nmax: int) -> Grid:
    """Return the grid for h_0 .. h_nmax, in time and in frequency up to their reach."""
    # Beyond its turning point R, h_n falls faster than exp(-2/3 sqrt(2 R) (x - R)^(3/2)). Sums are
    # periodic with twice the reach: what is repeated meets no sample within it.
    turning = np.sqrt(2.0 * nmax + 1.0)
    reach = turning + (1.5 * _DECAY / np.sqrt(2.0 * turning)) ** (2.0 / 3.0)
    return fourier_grid(float(reach), float(reach))


@lru_cache(maxsize=KEPT)
def frequency_table(nmax: int) -> Array:
    """Return h_n(w_j), (nmax + 1, J)."""
    return hermite_functions(nmax, frequency_grid(nmax).w)
