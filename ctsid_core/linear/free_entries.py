# SPDX-License-Identifier: Apache-2.0
"""
The entries of a model that a likelihood may move: their names, order, places and count.

The one order, of derivatives and of steps: A, [B tail x_trim], C, [D y_trim], K, each row by row;
D and K only if they are free. What changes the realisation only is not left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array, Mask

GAUGE = 1e-7          # relative singular value of derivatives by all entries, below which a
                      # direction changes the realisation only


@dataclass(frozen=True)
class FreeEntries:
    """
    Which entries of a model are free.

    Parameters
    ----------
    n, nu, ny : int
        States, inputs, outputs.
    tails, ones : int
        Columns of `tail`, and of `x_trim` and `y_trim`.
    feedthrough : bool
        Whether those of D are.
    noise : bool
        Whether those of K are.
    """

    n: int
    nu: int
    ny: int
    tails: int
    ones: int
    feedthrough: bool
    noise: bool

    @classmethod
    def of(cls, m: Matrices, feedthrough: bool, *, noise: bool = False) -> FreeEntries:
        """Return the free entries of a model."""
        return cls(len(m.A), m.B.shape[1], len(m.C), m.tail.shape[1], m.x_trim.shape[1],
                   feedthrough, noise)

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of A, [B tail x_trim], C, [D y_trim], K."""
        n, ny = self.n, self.ny
        return ((n, n), (n, self.nu + self.tails + self.ones), (ny, n),
                (ny, self.nu * self.feedthrough + self.ones), (n, ny * self.noise))

    @property
    def count(self) -> int:
        """How many there are."""
        return sum(rows * columns for rows, columns in self.shapes)

    @cached_property
    def columns(self) -> dict[str, tuple[int, slice]]:
        """Place of each matrix by its name: of the block, and of the columns in it."""
        nu, own, to = self.nu, self.nu + self.tails, self.nu + self.tails + self.ones
        feed = nu * self.feedthrough
        return {'A': (0, slice(None)), 'B': (1, slice(0, nu)), 'tail': (1, slice(nu, own)),
                'x_trim': (1, slice(own, to)), 'C': (2, slice(None)), 'D': (3, slice(0, feed)),
                'y_trim': (3, slice(feed, feed + self.ones)), 'K': (4, slice(None))}

    def split(self, rows: NDArray[Any]) -> list[NDArray[Any]]:
        """
        Return the blocks of rows of entries.

        Parameters
        ----------
        rows : ndarray, shape (..., count)

        Returns
        -------
        list of ndarray
            Of the `shapes`, after the leading axes of `rows`.
        """
        ends = np.cumsum([a * b for a, b in self.shapes])
        parts = np.split(rows[..., :ends[-1]], ends[:-1], axis=-1)
        return [part.reshape(*rows.shape[:-1], *shape)
                for part, shape in zip(parts, self.shapes, strict=True)]

    def part(self, rows: NDArray[Any], name: str) -> NDArray[Any]:
        """Return of rows of entries (..., count) those of one matrix (..., rows, columns)."""
        block, columns = self.columns[name]
        return self.split(rows)[block][..., columns]

    def mask(self, *names: str) -> Mask:
        """Return which entries (count,) are those of the named matrices."""
        mask = np.zeros(self.count, dtype=bool)
        for name in names:
            self.part(mask, name)[...] = True       # a view
        return mask

    def places(self, tails: Sequence[int], ones: Sequence[int]) -> NDArray[np.intp]:
        """Return the places of the entries of a model with only these of its tails and trims."""
        A, B, C, D, K = self.split(np.arange(self.count))
        nu, feed = self.nu, self.nu * self.feedthrough
        driven = np.r_[:nu, nu + np.array(tails, int), nu + self.tails + np.array(ones, int)]
        direct = np.r_[:feed, feed + np.array(ones, int)]
        return np.concatenate([part.ravel() for part in (
            A, B[:, driven.astype(int)], C, D[:, direct.astype(int)], K)])

    def moved(self, m: Matrices, step: Array) -> Matrices:
        """Return a model with a step (count,) added to its entries."""
        def new(name: str) -> Array:
            return np.asarray(getattr(m, name) + self.part(step, name))

        names = ['A', 'B', 'tail', 'x_trim', 'C', 'y_trim']
        names += ['D'] * self.feedthrough + ['K'] * self.noise
        return replace(m, **{name: new(name) for name in names})
