# SPDX-License-Identifier: Apache-2.0
"""
The Hermite domain seen in time.

Hermite functions are their own Fourier transforms but for the factor (-i)^n. The orthogonal matrix
that takes coefficients to lines (`hermite.py`), without that factor, therefore takes them to
instants: the Gauss-Hermite nodes, now in time, each with the root of its weight. White noise stays
white, and what happened early stands before what happened late.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ctsid_core.bases.hermite import hermite_lines
from ctsid_core.bases.projection import Projection
from ctsid_core.linear.types import Array


@lru_cache(maxsize=8)
def _turn(nmax: int) -> tuple[Array, Array, Array]:
    """Return the nodes w >= 0; what takes (real, imaginary) lines to (even, odd) in time."""
    basis = hermite_lines(nmax)
    to_even, to_odd = basis.even.dense(), basis.odd.dense()
    even_sign, odd_sign = (1.0 - 2.0 * (np.arange(part.shape[1]) % 2)
                           for part in (to_even, to_odd))
    even = (to_even * even_sign) @ to_even.T
    odd = -(to_odd * odd_sign) @ to_odd.T
    return basis.w, even, odd


def at_instants(rows: Array, nmax: int) -> Array:
    """
    Return what lines are in time, at the instants of `instants`.

    Parameters
    ----------
    rows : ndarray, shape (m, 2 L)
        Real and imaginary parts of lines (`as_real`), of all parts of a divided record.
    nmax : int
        Highest order of the Hermite functions in each part.

    Returns
    -------
    ndarray, shape (m, parts (nmax + 1))
        In the order of time; sums of squares are those over the lines.
    """
    w, even, odd = _turn(nmax)
    parts = rows.reshape(len(rows), -1, 2 * len(w))
    a, b = (np.ascontiguousarray(parts[:, :, first::2]).reshape(-1, len(w)) @ turn
            for first, turn in ((0, even), (1, odd)))
    middle = _middle(nmax)
    late, early = ((a + sign * b)[:, middle:] / np.sqrt(2.0) for sign in (1.0, -1.0))
    seen: Array = np.concatenate((early[:, ::-1], a[:, :middle], late), axis=1)
    return seen.reshape(len(rows), -1)


def _middle(nmax: int) -> int:
    """Return how many nodes are zero: an even number of functions has none there."""
    return (nmax + 1) % 2


def instants(projection: Projection, nmax: int) -> Array:
    """
    Return the instants at which `at_instants` sees a projection [s].

    Parameters
    ----------
    projection : Projection
    nmax : int

    Returns
    -------
    ndarray, shape (parts (nmax + 1),)
        Increasing.
    """
    w = _turn(nmax)[0]
    x = projection.unit * np.concatenate((-w[_middle(nmax):][::-1], w))
    bounds = np.linspace(projection.start, projection.end, len(projection.s) // len(w) + 1)
    centres = 0.5 * (bounds[:-1] + bounds[1:])
    found: Array = (centres[:, np.newaxis] + x).ravel()
    return found
