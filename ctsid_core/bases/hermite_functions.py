# SPDX-License-Identifier: Apache-2.0
"""
Hermite functions h_n, orthonormal on the real line ([HD] eq. 13 to 18).

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
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from ctsid_core.bases.fourier_sums import Grid, fourier_grid, fourier_sums
from ctsid_core.linear.types import Array

_EXPONENT_STEP = 512    # mantissas are brought back by 2^-512 when they exceed 2^512
_CHECK_EVERY = 16       # steps between two such checks: growth stays below (2 x)^16
_LN2_HIGH = 0.693145751953125           # 16 bits: times any exponent here is exact
_LN2_LOW = 1.42860682030941723212e-6
KEPT = 6                # sizes of bases, of up to 20 MB each; windows of one robot have several
_DECAY = 36.0               # beyond its reach h_nmax is below exp(-36) = 2e-16


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


def integral_of_first(x: Array) -> Array:
    """Return I_0(x), the integral of h_0 from minus infinity to x."""
    return np.asarray(np.pi ** 0.25 / np.sqrt(2.0) * (1.0 + erf(x / np.sqrt(2.0))))


def project(nmax: int, x: Array, weights: Array) -> Array:
    """
    Return the sums over the samples of h_n(x_k) weights_k, shape (m, nmax + 1).

    Of x (N,) in any order and weights (m, N).
    """
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
    """
    Return the grid for h_0 .. h_nmax, in time and in frequency up to their reach.

    Beyond its turning point R, h_n falls faster than exp(-2/3 sqrt(2 R) (x - R)^(3/2)). Sums are
    periodic with twice the reach: what is repeated meets no sample within it.
    """
    turning = np.sqrt(2.0 * nmax + 1.0)
    reach = turning + (1.5 * _DECAY / np.sqrt(2.0 * turning)) ** (2.0 / 3.0)
    return fourier_grid(float(reach), float(reach))


@lru_cache(maxsize=KEPT)
def frequency_table(nmax: int) -> Array:
    """Return h_n(w_j), (nmax + 1, J)."""
    return hermite_functions(nmax, frequency_grid(nmax).w)
