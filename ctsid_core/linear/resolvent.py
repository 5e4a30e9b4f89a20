# SPDX-License-Identifier: Apache-2.0
"""
(s I - A)^-1 on all lines at once.

Where the eigenvectors are sound it is diagonal in their coordinates, one number per pole and
line; where poles coincide it is inverted line by line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array, Lines

_ON_LINE = 1e-9       # stands for s - p on a line that a pole lies on [rad/s]
SOUND = 1e10         # condition number of the eigenvectors that is still good for 6 digits


@dataclass(frozen=True)
class Resolvent:
    """
    (s I - A)^-1 on L lines.

    Parameters
    ----------
    poles : ndarray, shape (n,)
        Eigenvalues of A [rad/s].
    modes, inverse : ndarray, shape (n, n), or None
        Eigenvectors and their inverse; None if they are not sound.
    table : ndarray
        1 / (s - p), shape (n, L), by modes; else (s I - A)^-1 itself, shape (L, n, n).
    """

    poles: NDArray[np.complex128]
    modes: Lines | None
    inverse: Lines | None
    table: Lines

    def on(self, lines: slice) -> Resolvent:
        """Return the same on some of the lines."""
        table = self.table[lines] if self.modes is None else self.table[:, lines]
        return Resolvent(self.poles, self.modes, self.inverse, table)

    def states(self, drive: Lines) -> Lines:
        """Return (s I - A)^-1 drive, of shape (n, L) like the drive."""
        if self.modes is None or self.inverse is None:
            return np.asarray((self.table @ drive.T[:, :, np.newaxis])[:, :, 0].T)
        found: Lines = self.modes @ ((self.inverse @ drive) * self.table)
        return found

    def outputs(self, C: Array) -> Lines:
        """Return C (s I - A)^-1, of shape (n, ny, L): states first."""
        if self.modes is None or self.inverse is None:
            return np.ascontiguousarray((C @ self.table).transpose(2, 1, 0))
        weights = self.inverse.T[:, np.newaxis, :] * (C @ self.modes)
        shape = (*weights.shape[:2], self.table.shape[1])
        found: Lines = weights.reshape(C.size, len(C.T)) @ self.table
        return found.reshape(shape)

    def sum(self, weights: Array) -> Array:
        """Return the real part of the sum over lines of weights times (s I - A)^-1, (n, n)."""
        if self.modes is None or self.inverse is None:
            return np.asarray(np.tensordot(weights, self.table, axes=1).real)
        total: Array = ((self.modes * (self.table @ weights)) @ self.inverse).real
        return total


def away(distance: Lines) -> Lines:
    """Return 1 / (s - p), finite even on a line that the pole lies on."""
    safe = np.where(distance == 0.0, complex(_ON_LINE), distance)
    return np.asarray(1.0 / safe, dtype=np.complex128)


def resolvent(A: Array, s: Lines) -> Resolvent:
    """
    Compute the resolvent of A on the lines s.

    Raises
    ------
    numpy.linalg.LinAlgError
        If A is not finite.
    """
    poles, modes = np.linalg.eig(A)
    try:
        inverse = np.linalg.inv(modes)
    except np.linalg.LinAlgError:
        inverse = np.full_like(modes, np.inf)
    if np.linalg.norm(modes) * np.linalg.norm(inverse) < SOUND:
        return Resolvent(poles, modes, inverse, away(s - poles[:, np.newaxis]))
    systems = s[:, np.newaxis, np.newaxis] * np.eye(len(A)) - A
    return Resolvent(poles, None, None, np.linalg.inv(systems))
