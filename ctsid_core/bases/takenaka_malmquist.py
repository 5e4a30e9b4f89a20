# SPDX-License-Identifier: Apache-2.0
"""
The Takenaka-Malmquist basis as a chain of filters, for any sequence of poles.

[TM] eq. 2, for poles sigma_k in the right half plane:

    F_k(s) = sqrt(2 Re sigma_k) / (s + sigma_k)  prod_(l<k) (s - conj sigma_l) / (s + sigma_l)

Erratum: the paper prints sigma_l for conj sigma_l and 2 sigma_k for 2 Re sigma_k, though it allows
complex poles; that basis is not orthonormal. All of the F_k are the states of one linear system,

    dw/dt = L w + b v,      L + L^T = -b b^T,

so that orthonormality is in plain sight (the Gramian of (L, b) is 1), and the response to samples
that are held, on straight lines, or on polynomials is exact at any stamps. A pair of conjugate
poles (a + i c, a - i c) is kept real by a rotation of its two functions:

    2 sqrt(a) s / (s^2 + 2 a s + |sigma|^2),    2 sqrt(a) |sigma| / (s^2 + 2 a s + |sigma|^2)

A constant sequence is the Laguerre basis (with this sign: of the paper's section III), the
sequence sigma (k + 1/2) the Legendre basis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.errors import SettingsError
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.simulation import by_matrices

_SAME = 1e-9          # relative distance of a pole's conjugate that is rounding


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain of Takenaka-Malmquist filters."""

    poles: ComplexArray  # (N,): sigma [rad/s]; the filters have -sigma. Conjugates are neighbours
    L: Array             # (N, N): real, lower triangular but for the blocks of pairs [rad/s]
    b: Array             # (N,) [sqrt(rad/s)]
    turn: ComplexArray   # (N, N), unitary: turn w are the F_k themselves (complex where poles are)

    @property
    def size(self) -> int:
        """Number of functions N."""
        return len(self.b)


def chain(poles: Sequence[complex] | ComplexArray | Array) -> Chain:
    """
    Return the chain of a sequence of poles sigma with positive real parts [rad/s].

    Each complex one is directly followed by its conjugate. Raises `SettingsError` if there is
    none, one is not in the right half plane, or a conjugate is missing.
    """
    sigma = np.asarray(poles, dtype=complex).reshape(-1)
    blocks = _blocks(sigma)
    size = len(sigma)
    L, b = np.zeros((size, size)), np.zeros(size)
    turn = np.eye(size, dtype=complex)
    for first, width in blocks:
        pole = sigma[first]
        rows = slice(first, first + width)
        if width == 1:
            L[first, first], b[first] = -pole.real, np.sqrt(2.0 * pole.real)
        else:
            radius, lean = abs(pole), pole.conjugate() / abs(pole)
            L[rows, rows] = [[-2.0 * pole.real, -radius], [radius, 0.0]]
            b[first] = 2.0 * np.sqrt(pole.real)
            turn[rows, rows] = np.array([[1.0, lean], [1.0, -lean]]) / np.sqrt(2.0)
        L[rows, :first] = -np.outer(b[rows], b[:first])
    return Chain(sigma, L, b, turn)


def _blocks(sigma: ComplexArray) -> list[tuple[int, int]]:
    """Return the place and width (1, or 2 for a pair) of each block."""
    if not len(sigma):
        raise SettingsError(['there is no pole for the Takenaka-Malmquist functions; give at '
                             'least one'])
    found, k = [], 0
    while k < len(sigma):
        pole = sigma[k]
        if not (np.isfinite(pole) and pole.real > 0.0):
            raise SettingsError([f'pole {k + 1} of the Takenaka-Malmquist functions is {pole:g}; '
                                 'a positive real part is wanted (the filter decays as '
                                 'exp(-pole t))'])
        width = 1 if abs(pole.imag) <= _SAME * abs(pole) else 2
        if width == 2 and not (k + 1 < len(sigma) and np.isclose(
                sigma[k + 1], pole.conjugate(), rtol=_SAME, atol=0.0)):
            raise SettingsError([f'pole {k + 1} of the Takenaka-Malmquist functions is {pole:g}, '
                                 'but the next one is not its conjugate; signals are real, so '
                                 'complex poles come in pairs'])
        found.append((k, width))
        k += width
    return found


def legendre(sigma: float, size: int) -> Chain:
    """Return the Legendre basis: poles sigma (k + 1/2) ([TM] section III)."""
    return chain([sigma * (k + 0.5) for k in range(size)])


def respond(found: Chain, derivatives: Array, knots: Array,
            check: Callable[[], None] = lambda: None) -> Array:
    """
    Return the response of a chain, at rest at first, to piecewise polynomials: (K, N, m).

    Exactly, for m signals and their derivatives just after each of the increasing knots (K,) [s],
    shape (degree + 1, K, m), valid up to the next one (`simulation.input_polynomials`).
    """
    rest = np.zeros((found.size, derivatives.shape[2]))
    return by_matrices(found.L, found.b[:, np.newaxis], derivatives[:, :, np.newaxis],
                       np.diff(knots), rest, check=check)


def of_one_degree(parts: Sequence[Array]) -> list[Array]:
    """Return derivatives (degree + 1, ...) with zeros up to the highest degree among them."""
    degree = max(map(len, parts))
    return [np.concatenate((p, np.zeros((degree - len(p), *p.shape[1:])))) for p in parts]
