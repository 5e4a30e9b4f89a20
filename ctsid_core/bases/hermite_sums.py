# SPDX-License-Identifier: Apache-2.0
"""
Sums of Hermite functions over samples, by way of their frequencies.

A Hermite function is its own Fourier transform but for a factor. With F_j the Fourier sums of the
samples at uniform frequencies w_j, the trapezoid rule gives

    sum_k weights_k h_n(x_k) = i^n / sqrt(2 pi)  integral h_n(w) F(w) dw
                             = i^n / sqrt(2 pi)  step sum_j h_n(w_j) F_j

exactly, but for what h_n leaves beyond its reach, in time and in frequency alike. The functions
are then wanted at frequencies that depend on nmax alone, however many the samples are.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ctsid_core.bases.fourier_sums import Grid, fourier_grid, fourier_sums
from ctsid_core.bases.hermite_functions import hermite_functions
from ctsid_core.linear.types import Array

_DECAY = 36.0               # beyond its reach h_nmax is below exp(-36) = 2e-16


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


@lru_cache(maxsize=8)
def frequency_table(nmax: int) -> Array:
    """Return h_n(w_j), (nmax + 1, J)."""
    return hermite_functions(nmax, frequency_grid(nmax).w)
