# SPDX-License-Identifier: Apache-2.0
"""
Fourier sums of uniform samples at uniform frequencies of another spacing: the chirp transform.

With j k = (j^2 + k^2 - (j - k)^2) / 2 the sums sum_k f_k exp(-i theta j k) are a convolution with
the chirp exp(i theta m^2 / 2), done by fast Fourier transforms (Bluestein 1970, IEEE Transactions
on Audio and Electroacoustics 18).
"""

from __future__ import annotations

import numpy as np
from scipy.fft import fft, ifft, next_fast_len

from ctsid_core.linear.types import Array, ComplexArray

_FEWEST = 256           # samples: below, sums by other means are as quick
_SAME = 3e-11           # phase [rad] by which stamps may be off uniform ones: their rounding


def uniform(x: Array, top: float) -> bool:
    """Return whether stamps (N,) are uniform to their rounding, for frequencies to `top` [rad]."""
    n = len(x)
    if n < _FEWEST:
        return False
    step = (x[-1] - x[0]) / (n - 1)
    # A look at few stamps spares most of those that are not uniform a look at all.
    for every in (n // 16, 1):
        off = x[::every] - (x[0] + step * np.arange(0, n, every))
        if not np.abs(off).max() * top <= _SAME:
            return False
    return bool(step > 0.0)


def chirp_sums(x: Array, weights: Array, step: float, count: int) -> ComplexArray:
    """
    Return the sums over the samples of weights_k exp(-i w_j x_k), shape (m, count).

    Of uniform stamps x (N,) and weights (m, N), at the frequencies w_j = j step.
    """
    n = len(x)
    before = (n - 1) // 2                              # phases are least about the middle
    size = int(next_fast_len(n + count - 1))
    chirp = _chirp(step * (x[-1] - x[0]) / (n - 1), max(n - before, count + before))
    own = np.concatenate((chirp[before:0:-1], chirp[:n - before]))
    kernel = np.zeros(size, dtype=complex)
    kernel[:count + before] = chirp[:count + before].conj()
    kernel[size - (n - 1 - before):] = chirp[n - 1 - before:0:-1].conj()
    spectrum = fft(weights * own, size, axis=1)
    spectrum *= fft(kernel)
    middle = 0.5 * (x[0] + x[-1]) - (0.5 * (n - 1) - before) * (x[-1] - x[0]) / (n - 1)
    turn = np.exp(-1j * (step * middle) * np.arange(count)) * chirp[:count]
    return np.asarray(ifft(spectrum, axis=1, overwrite_x=True)[:, before:before + count] * turn)


def _chirp(theta: float, count: int) -> ComplexArray:
    """
    Return exp(-i theta m^2 / 2) for m = 0 .. count - 1.

    Whole turns are taken off before they cost digits: 24 bits of theta times m^2 are exact.
    """
    rate = theta / (4.0 * np.pi)
    lead = float(np.float32(rate))
    m = np.arange(count, dtype=float)
    square = m * m
    turns = lead * square
    turns -= np.rint(turns)
    turns += (rate - lead) * square
    turns *= -2.0 * np.pi
    found = np.empty(count, dtype=complex)
    np.cos(turns, out=found.real)
    np.sin(turns, out=found.imag)
    return found
