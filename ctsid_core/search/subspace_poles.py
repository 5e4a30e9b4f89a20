# SPDX-License-Identifier: Apache-2.0
"""The poles of HD-PBSID's models, as starts for climbs of the likelihood."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.task import Task
from ctsid_core.search.tried import POINT
from ctsid_core.subspace.hd_pbsid import Subspaces, Tuning, realise

_FEWEST = 3           # states: fewer are found by a grid of poles
_PROJECTION, _PER_SAMPLE, _REGRESSION = 1e7, 2e4, 3e6       # work


class Subspace:
    """Poles of HD-PBSID's models, on lines projected when they are first asked for."""

    def __init__(self, task: Task) -> None:
        self._part, self._own, self._effort = task.part, task.own, task.effort
        self._made: dict[bool, Subspaces | None] = {}
        self._realised = lru_cache(maxsize=None)(self._realise)

    def shown(self, n: int) -> tuple[Array, float]:
        """Return singular values and condition of the middle one of the tunings for order n."""
        made = next((m for m in self._made.values() if m), None) or self._projected(
            np.array(self._own.delays(len(self._part.parts[0].u))))
        tunings = made.some_tunings(n) if made is not None else []
        if made is None or not tunings:
            return np.empty(0), float('nan')
        found = made.of(tunings[len(tunings) // 2])
        return found.singular_values, found.condition

    def poles(self, n: int, delay: Array) -> Iterator[ComplexArray]:
        """Yield the poles of models of order n, with given dead times, for every tuning."""
        if n >= _FEWEST and (subspaces := self._projected(delay)) is not None:
            for tuning in subspaces.some_tunings(n):
                yield from self._realised(n, tuning, subspaces)

    def _realise(self, n: int, tuning: Tuning, subspaces: Subspaces) -> list[ComplexArray]:
        self._effort.spend(_REGRESSION)
        subspace = subspaces.of(tuning)
        if n >= len(subspace.singular_values):
            return []
        A = realise(subspace, n).A
        if not np.isfinite(A).all():
            return []
        p = np.linalg.eigvals(A).astype(complex)
        p = np.where(p.real > 0.0, -p.conj(), p)
        return [p[p.imag >= 0.0]]

    def _projected(self, delay: Array) -> Subspaces | None:
        """
        Return the regressions, with dead times as they are given or as first found.

        Small models of several inputs have any dead times: those given are a start, too, and where
        a budget is short the first that are asked for are all; none, if they take most of it.
        """
        given = bool(np.array_equal(delay, self._own.delays(len(delay))))
        work = _PROJECTION + _PER_SAMPLE * sum(
            float(len(s.time)) for p in self._part.parts for s in p.record.outputs)
        short = self._effort.beyond(POINT) if self._made else \
            0.0 < POINT * self._effort.worth(self._effort.budget) < work
        if given in self._made or short:
            return self._made.get(given)
        self._made[given], own = None, self._own.replace(delay=tuple(delay.tolist()))
        self._effort.spend(work)
        with suppress(np.linalg.LinAlgError):
            self._made[given] = Subspaces(self._part.project(own, self._effort.check), own)
        return self._made[given]
