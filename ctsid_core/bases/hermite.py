# SPDX-License-Identifier: Apache-2.0
"""
The Hermite domain, in diagonal form.

A window [t_c - tau, t_c + tau] is mapped to x = (t - t_c) / alpha ([HD] eq. 31). With rows of
coefficients f, the derivative df/dx has the coefficients f D, D skew-symmetric tridiagonal
(eq. 25). Then

    D = V diag(i w_k) V^H,        V = diag((-i)^n) Q,

w_k the Gauss-Hermite nodes of order nc = nmax + 1 and Q real orthogonal, because
Q diag(w) Q^T is the Jacobi matrix of the Hermite functions. The lines f V come in conjugate
pairs; those of w >= 0 are kept. Even orders give their real parts, odd ones the imaginary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from scipy.special import roots_hermite

from ctsid_core.bases.hermite_functions import hermite_functions
from ctsid_core.bases.projection import Projection, joined
from ctsid_core.bases.quadrature import coefficients
from ctsid_core.linear.types import Array, Lines
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal, channel_slices


@dataclass(frozen=True)
class HermiteLines:
    """What depends on nmax alone."""

    w: Array      # (L,): non-negative Gauss-Hermite nodes: dimensionless frequencies, increasing
    V: Lines      # (nc, L): from coefficients to lines, the rest of them conjugates

    @cached_property
    def ones(self) -> Lines:
        """The lines of the constant 1 on the whole real line, (1, L)."""
        # <h_n, 1>: odd ones vanish, c_(n+2) = c_n ratio
        nc = len(self.V)
        c, n = np.zeros((1, nc)), np.arange(2, nc, 2)
        c[0, 0::2] = np.sqrt(2.0) * np.pi ** 0.25 * np.cumprod(
            np.concatenate(([1.0], np.sqrt((n - 1.0) / n))))
        return np.asarray(c @ self.V)


@lru_cache(maxsize=8)
def hermite_lines(nmax: int) -> HermiteLines:
    """Return the diagonal form of the derivative for orders 0 .. nmax, nmax at least 1."""
    w = roots_hermite(nmax + 1)[0][(nmax + 1) // 2:]
    h = hermite_functions(nmax, w)
    q = h / np.linalg.norm(h, axis=0)
    q *= np.where(w > 0.0, np.sqrt(2.0), 1.0)               # the line at -w is the conjugate
    power = np.array([1, -1j, -1, 1j], dtype=complex)[np.arange(nmax + 1) % 4]      # (-i)^n
    return HermiteLines(w, np.asarray(power[:, np.newaxis] * q, dtype=complex))


def time_scale(nmax: int, tau: float, settings: Settings) -> float:
    """
    Return alpha [s].

    In the paper's form the turning point R = sqrt(2 nmax + 1) of h_nmax lies on the edge of the
    window ([HD] eq. 31); in the exact form it lies inside by `edge_margin` widths R^(-1/3) of the
    Airy tail of h_nmax, so that all functions have decayed at the edge.
    """
    turning = np.sqrt(2.0 * nmax + 1.0)
    if settings.edges == 'paper':
        return float(tau / turning)
    return float(tau / (turning + settings.edge_margin * turning ** (-1.0 / 3.0)))


def project_record(record: Record, settings: Settings, nmax: int,
                   check: Callable[[], None] = lambda: None) -> Projection:
    """
    Project a record on Hermite functions, each signal from its own stamps ([HD] eq. 27, 33, 34).

    Up to order nmax in each of `settings.parts` parts of equal length, whose lines stand beside
    each other; only the tail is each part's own. `check` is called before each part; what it
    raises ends the projection.
    """
    bounds = np.linspace(record.start, record.end, max(settings.parts, 1) + 1)
    parts = []
    hermite_lines(nmax)         # made once for each size, which takes as long as a projection
    for start, end in pairwise(bounds.tolist()):
        check()
        parts.append(_project_part(record, settings, nmax, start, end))
    whole = joined(parts)
    return replace(whole, ones=np.hstack([p.ones for p in parts]),
                   length=record.duration / max(len(whole.tail), 1))


def _project_part(record: Record, settings: Settings, nmax: int, start: float,
                  end: float) -> Projection:
    basis = hermite_lines(nmax)
    alpha = time_scale(nmax, 0.5 * (end - start), settings)
    inputs, delays = _by_delay(record, settings.delays(record.nu))
    found = coefficients((*inputs, *record.outputs), start, end, alpha, nmax,
                         (*delays, *(0.0,) * len(record.outputs)))
    nu = sum(map(len, found[:len(inputs)]))
    lines = np.vstack(found) @ basis.V
    nothing = np.empty((0, len(basis.w)), dtype=complex)
    exact = settings.edges == 'exact'
    return Projection(
        s=(1j * basis.w / alpha).astype(np.complex128),
        u=lines[:nu], y=lines[nu:],
        tail=basis.V[-1:] if exact else nothing,     # the lines of e_last = [0 ... 0 1]
        ones=_ones(basis, start, end, alpha, nmax, exact) if settings.trim else nothing,
        unit=alpha, length=end - start)


def _ones(basis: HermiteLines, start: float, end: float, alpha: float, nmax: int,
          exact: bool) -> Lines:
    if exact:
        return basis.ones
    held = Signal(np.array([start]), np.ones((1, 1)), 'zoh')
    return np.asarray(coefficients([held], start, end, alpha, nmax, [0.0])[0] @ basis.V)


def _by_delay(record: Record,
              delays: tuple[float, ...]) -> tuple[list[Signal], list[float]]:
    """Split input signals into single channels where their dead times differ."""
    signals: list[Signal] = []
    shifts: list[float] = []
    for signal, channels in zip(record.inputs, channel_slices(record.inputs), strict=True):
        own = delays[channels]
        alike = len(set(own)) == 1
        signals += [signal] if alike else [
            Signal(signal.time, signal.values[:, j:j + 1], signal.hold) for j in range(len(own))]
        shifts += own[:1] if alike else own
    return signals, shifts
