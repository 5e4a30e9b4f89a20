# SPDX-License-Identifier: Apache-2.0
"""The experiment, the clock and the tables that the benchmarks share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import os
from pathlib import Path
import platform
import time

import numpy as np
from numpy.typing import NDArray
import scipy
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]

DURATION = 10.0                 # s
TOP = 8.0                       # Hz, where the sweep ends
POLES = np.array([-2.0, -4.0])  # rad/s
A = np.array([[-2.0, 1.0], [0.0, -4.0]])
B = np.array([0.5, 1.0])
C = np.array([[1.0, 4.0], [2.0, 1.0]])


def sweep(t: Array | float, duration: float = DURATION) -> Array:
    """Return the linear sine sweep from 0 Hz to `TOP` at times t ([HD] eq. 58)."""
    u: Array = np.sin(np.pi * TOP / duration * np.square(t))
    return u


def experiment(t: Array, duration: float = DURATION) -> Array:
    """
    Return the noise-free outputs of the plant of [HD] 5.1, from rest, driven by the sweep.

    The input is the sweep itself, not its samples held: the differential equation is integrated
    to 1e-10 by a code that no contender uses.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Times within [0, duration] [s].
    duration : float
        Of the sweep [s].

    Returns
    -------
    ndarray, shape (N, 2)
    """
    solved = solve_ivp(lambda at, x: A @ x + B * sweep(at, duration), (0.0, duration),
                       np.zeros(2), t_eval=t, method='DOP853', rtol=1e-10, atol=1e-12)
    y: Array = (C @ solved.y).T
    return y


def noisy(y: Array, snr: float, seed: int) -> Array:
    """Add white noise of its own level to every output: its power to the noise's is snr [dB]."""
    size = y.std(axis=0) * 10.0 ** (-snr / 20.0)
    measured: Array = y + size * np.random.default_rng(seed).standard_normal(y.shape)
    return measured


def least_deviation(t: Array, snr: float) -> Array:
    """
    Return the Cramer-Rao bound of the poles: the least deviation of unbiased estimates.

    In modal form output i is the sum over the modes j of r_ij s_j, s_j the response of
    1 / (s - p_j) from rest. Poles p and residues r are unknown, all else is known, so that the
    bound holds for every contender; with feedthrough and offsets unknown it is a tenth higher.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Stamps [s].
    snr : float
        Of white noise in each output [dB].

    Returns
    -------
    ndarray, shape (2,)
        Standard deviations in the order of `POLES` [rad/s].
    """
    modes = np.array([[1.0, 1.0], [0.0, -2.0]])                 # eigenvectors of A as columns
    residues = (C @ modes) * np.linalg.solve(modes, B)

    def responses(at: float, x: Array) -> Array:
        """Return the derivatives of s_j and of ds_j / dp_j."""
        return np.concatenate((POLES * x[:2] + sweep(at), POLES * x[2:] + x[:2]))

    x = solve_ivp(responses, (0.0, DURATION), np.zeros(4), t_eval=t, rtol=1e-8, atol=1e-10).y
    noise = experiment(t).std(axis=0) * 10.0 ** (-snr / 20.0)
    slopes = [np.hstack((r * x[2:].T, np.kron(np.eye(2)[i], x[:2].T))) / noise[i]
              for i, r in enumerate(residues)]                  # of output i by p, r
    triangle = np.linalg.qr(np.vstack(slopes), mode='r')
    deviation: Array = np.linalg.norm(np.linalg.inv(triangle), axis=1)[:2]
    return deviation


def interleaved(cases: Mapping[str, Callable[[], object]], rounds: int,
                summed_up: Callable[[Sequence[float]], object] = np.median) -> dict[str, float]:
    """
    Return the median seconds of processor time of every case, on one thread.

    All cases take their turn in every round: what else the machine does meets all of them alike.
    Time in which other programs had the processor does not count, for it would meet long cases
    more than short ones. One round before the first fills caches and is not counted either.
    `summed_up` is what becomes of the rounds, instead of the median.
    """
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds + 1):
        for name, run in cases.items():
            begin = time.process_time()
            run()
            seconds[name].append(time.process_time() - begin)
    return {name: float(summed_up(taken[1:])) for name, taken in seconds.items()}


def machine() -> str:
    """Return what figures depend on: processor, threads, load, versions."""
    load = f'{os.getloadavg()[0]:.1f}' if hasattr(os, 'getloadavg') else 'unknown'
    return (f'{_processor()}, {os.cpu_count()} cores; '
            f'BLAS threads: {os.environ.get("OPENBLAS_NUM_THREADS", "not set")}; load {load}\n'
            f'Python {platform.python_version()}, NumPy {np.__version__}, '
            f'SciPy {scipy.__version__}')


def _processor() -> str:
    info = Path('/proc/cpuinfo')
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.processor() or platform.machine()


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out rows of text in columns: the first to the left, the others to the right."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    lines = ['  '.join(cell.ljust(width) if i == 0 else cell.rjust(width)
                       for i, (cell, width) in enumerate(zip(row, widths, strict=True)))
             for row in (head, ['-' * width for width in widths], *rows)]
    return '\n'.join(lines)
