# SPDX-License-Identifier: Apache-2.0
"""
Fourier sums of samples with any stamps, at uniform frequencies.

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

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from scipy.fft import next_fast_len, rfft
from scipy.sparse import csc_array
from scipy.special import jv

from ctsid_core.linear.types import Array, ComplexArray

_TERMS = 12             # of the series
_FINENESS = 2           # highest frequency of the grid over that of the sums
_BLOCK = 8192           # samples at a time, to stay in the cache


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
