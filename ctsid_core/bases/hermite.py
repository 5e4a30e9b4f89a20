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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag
from scipy.special import roots_hermite

from ctsid_core.bases.hermite_functions import KEPT, hermite_functions
from ctsid_core.bases.quadrature import coefficients, free_motion
from ctsid_core.linear.types import Array, Lines
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal, placed


@dataclass(frozen=True)
class Projection:
    """
    A record in a basis in which the derivative is diagonal.

    All rows are spectral lines f_k, one complex number per line with frequency >= 0. Real and
    imaginary parts of all lines together are an orthonormal image of the basis coefficients (lines
    of positive frequency carry the factor sqrt(2) of their conjugates), so that sums of squares
    over them are those over the coefficients.
    """

    s: Lines      # (L,): the derivative, line by line [rad/s]: purely imaginary
    u: Lines      # (nu, L)
    y: Lines      # (ny, L)
    # (0 or parts, L): virtual inputs that stand for the truncated part of the state's derivative,
    # one for each part of a divided record, one record after the other
    tail: Lines
    ones: Lines   # (0 or records, L): the constant 1 over each record: trim of states and outputs
    # Time that a coordinate unit stands for [s]: white noise of intensity R has variance R / unit
    # in every real and imaginary part
    unit: float
    length: float  # of the record, or of one of its parts; of several records the longest [s]


@dataclass(frozen=True)
class HermiteLines:
    """What depends on nmax alone."""

    w: Array      # (L,): non-negative Gauss-Hermite nodes: dimensionless frequencies, increasing
    real: Array   # (nc, L): from coefficients to lines, without the factors (-i)^n

    def of(self, c: Array) -> Lines:
        """Return the lines of coefficients (m, nc), the rest of them conjugates, (m, L)."""
        # Even orders have real lines, odd ones imaginary ones.
        signed = c * np.array([1.0, -1.0, -1.0, 1.0])[np.arange(c.shape[1]) % 4]
        return np.asarray(signed[:, 0::2] @ self.real[0::2]
                          + 1j * (signed[:, 1::2] @ self.real[1::2]))

    @cached_property
    def ones(self) -> Lines:
        """The lines of the constant 1 on the whole real line, (1, L)."""
        # <h_n, 1>: odd ones vanish
        c = np.zeros((1, len(self.real)))
        c[0, 0::2] = np.sqrt(2.0) * np.pi ** 0.25 * free_motion(c.size)[1][0::2]
        return self.of(c)

    @cached_property
    def last(self) -> Lines:
        """The lines of e_last = [0 ... 0 1], (1, L)."""
        nc = len(self.real)
        return self.of(np.eye(1, nc, nc - 1))


@lru_cache(maxsize=KEPT)
def hermite_lines(nmax: int) -> HermiteLines:
    """Return the diagonal form of the derivative for orders 0 .. nmax, nmax at least 1."""
    w = roots_hermite(nmax + 1)[0][(nmax + 1) // 2:]
    h = hermite_functions(nmax, w)
    q = h / np.linalg.norm(h, axis=0)
    q *= np.where(w > 0.0, np.sqrt(2.0), 1.0)               # the line at -w is the conjugate
    return HermiteLines(w, q)


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
    lines = basis.of(np.vstack(found))
    nothing = np.empty((0, len(basis.w)), dtype=complex)
    exact, one = settings.edges == 'exact', Signal(np.array([start]), np.ones((1, 1)), 'zoh')
    return Projection(
        s=(1j * basis.w / alpha).astype(np.complex128),
        u=lines[:nu], y=lines[nu:],
        tail=basis.last if exact else nothing,
        ones=nothing if not settings.trim else basis.ones if exact else basis.of(
            coefficients([one], start, end, alpha, nmax, [0.0])[0]),
        unit=alpha, length=end - start)


def _by_delay(record: Record, delays: tuple[float, ...]) -> tuple[list[Signal], list[float]]:
    """Split input signals into single channels where their dead times differ."""
    signals: list[Signal] = []
    shifts: list[float] = []
    for signal, channels in placed(record.inputs):
        own = delays[channels]
        alike = len(set(own)) == 1
        signals += [signal] if alike else [signal.columns([j]) for j in range(len(own))]
        shifts += own[:1] if alike else own
    return signals, shifts


def joined(records: Sequence[Projection]) -> Projection:
    """Return lines of records, each with its own `ones`, side by side."""
    unit = max(p.unit for p in records)
    sized = [(float(np.sqrt(p.unit / unit)), p) for p in records]
    return Projection(
        s=np.concatenate([p.s for p in records]), u=np.hstack([size * p.u for size, p in sized]),
        y=np.hstack([size * p.y for size, p in sized]),
        tail=block_diag(*(size * p.tail for size, p in sized)),
        ones=block_diag(*(size * p.ones for size, p in sized)),
        unit=unit, length=max(p.length for p in records))


def as_real(lines: Lines) -> Array:
    """Return real and imaginary parts as columns: (m, L) complex to (m, 2 L) real."""
    return np.ascontiguousarray(lines).view(np.float64)
