# SPDX-License-Identifier: Apache-2.0
"""
HD-PBSID: predictor-based subspace identification on Hermite lines ([HD] section 4).

The equations are those of `pbsid_equations.py`. Here is what the papers leave open: a grid of the
shift beta and of the past window p, from the length and the band of the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np

from ctsid_core.bases.projection import Projection
from ctsid_core.bases.records import Joint
from ctsid_core.settings import Settings
from ctsid_core.subspace.interface import SLOWEST, MethodModel
from ctsid_core.subspace.pbsid_equations import Subspace, Tuning, realise, regress, stack_levels

_PASTS = (2, 3, 4, 6, 8, 12)
_LENGTHS = 4                  # values of p tried: the shortest that can hold the order
_SHIFTS = 5                   # values of beta tried
_GAMMA = 4.0                  # gamma over beta: the region reaches well beyond the shift


class Subspaces:
    """
    The regressions of one projection, computed when asked for.

    Settings other than 0 of beta, gamma, past and future are kept as they are.
    """

    def __init__(self, projection: Projection, settings: Settings) -> None:
        self.projection = projection
        self.settings = settings
        self.of = lru_cache(maxsize=None)(self._regress)
        self._levels = lru_cache(maxsize=None)(partial(stack_levels, projection))

    def tunings(self, n: int) -> list[Tuning]:
        """Return the tunings that the data are long enough for and that can hold order n."""
        top, settings = float(np.abs(self.projection.s).max()), self.settings
        slow = SLOWEST / self.projection.length
        shifts = [settings.beta] if settings.beta else \
            list(np.geomspace(slow, max(0.7 * top, 2.0 * slow), _SHIFTS))
        pasts = [settings.past] if settings.past else \
            [p for p in self._pasts(n) if self._holds(p, n)][:_LENGTHS]
        return [Tuning(b, settings.gamma or _GAMMA * b, p, settings.future or p)
                for b in shifts for p in pasts]

    def some_tunings(self, n: int) -> list[Tuning]:
        """Return a part of the grid: one value of p."""
        tunings = self.tunings(n)
        pasts = sorted({t.past for t in tunings})
        return [t for t in tunings if t.past == pasts[len(pasts) // 2]]

    def _pasts(self, n: int) -> tuple[int, ...]:
        needed = n // len(self.projection.y) + 2
        return _PASTS if needed <= _PASTS[-1] else (needed, needed + 4)

    def _holds(self, p: int, n: int) -> bool:
        ny = len(self.projection.y)
        rows = (p + 1) * (ny + len(self.projection.u) + len(self.projection.tail)
                          + max(len(self.projection.ones), 1))
        return p * ny > n and len(self.projection.s) >= rows

    def _regress(self, tuning: Tuning) -> Subspace:
        # One factorisation serves the past windows up to 6, which most searches stay within.
        top = max(tuning.past, 0 if self.settings.past else 6) + 1
        return regress(self._levels(tuning.beta, tuning.gamma, top), tuning,
                       feedthrough=self.settings.feedthrough,
                       rank_tolerance=self.settings.rank_tolerance)


def by_lines(part: Joint, settings: Settings, orders: Sequence[int]) -> list[MethodModel]:
    """Return models of all orders that the lines can hold, for every tuning left open."""
    subspaces = Subspaces(part.project(settings), settings)
    found = []
    for n in orders:
        for tuning in subspaces.tunings(n):
            subspace = subspaces.of(tuning)
            if n < len(subspace.singular_values):
                found.append(MethodModel(
                    realise(subspace, n), settings.replace(
                        order=n, beta=tuning.beta, gamma=tuning.gamma, past=tuning.past,
                        future=tuning.future),
                    subspace.singular_values, subspace.condition))
    return found
