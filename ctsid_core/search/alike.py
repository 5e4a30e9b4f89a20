# SPDX-License-Identifier: Apache-2.0
"""
Starts for plants whose axes are alike: few poles, each there as often as its residue has ranks.

A model of many states that are alike is far from any model of one state less, and a subspace
scatters what is one pole. With residues of any rank the same plant has one to four different
poles, which a grid finds as it finds those of a plant with one input and one output; what ranks
their residues have, the samples tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np

from ctsid_core.likelihood.output_error import (
    Fit,
    Free,
    Guess,
    climb_roughly,
    fit_at,
    free_start,
    reach_of,
)
from ctsid_core.linear.types import Array
from ctsid_core.search.pole_grid import PoleGrid

POINT = 0.4           # of a budget that a look at where to begin may take
_MOST = 4             # different poles, a pair counts as two
_EACH = 2             # starts of each kind that climb
_ALLOTTED = 4         # ways to allot ranks to poles that are looked at


class Alike:
    """
    Starts of any order, from models of few poles whose residues have any rank.

    These look at the samples of a grid of poles; `delays` are dead times to begin with.
    """

    def __init__(self, grid: PoleGrid, free: Free, delays: Sequence[Array]) -> None:
        self._grid, self._samples, self._free, self._delays = grid, grid.samples, free, delays
        self._starts: dict[int, Fit | None] = {1: None}     # of one state a grid does as well

    @cached_property
    def _models(self) -> list[Fit]:
        """Models of few poles, the ranks of each residue by their strength."""
        return [replace(fit, model=free_start(self._samples, fit.model.poles, fit.model.delay,
                                              fit.columns, self._free))
                for fit in _searched(self._grid, self._free, self._delays)]

    def start(self, n: int) -> Fit | None:
        """Return the best start of n states, on few samples; None if there is none."""
        if n not in self._starts:
            found = [fit for model in self._models for fit in self._allotted(model, n)]
            self._starts[n] = min(found, key=lambda fit: fit.cost, default=None)
        return self._starts[n]

    def _allotted(self, fit: Fit, n: int) -> Iterator[Fit]:
        """Yield models of n states, of the ranks of residues that explain most."""
        m, rank = fit.model, self._samples.rank
        noise = np.sqrt(self._samples.mean(fit.power))[:, np.newaxis]
        strength = (1 + (m.poles.imag > 0.0)) * np.sum(
            np.abs(m.b * reach_of(fit.columns)) ** 2, axis=1) * np.sum(
            np.abs(m.c / noise) ** 2, axis=0)
        wide = [1 + int(p.imag > 0.0) for p in m.poles[::rank]]
        kept = [[k * rank + j for k, own in enumerate(ranks) for j in range(own)]
                for ranks in _allotments(wide, n, rank)]
        for own in sorted(kept, key=lambda own: -float(np.sum(strength[own])))[:_ALLOTTED]:
            start = replace(m, poles=m.poles[own], b=m.b[own], c=m.c[:, own], x0=m.x0[:, own])
            with suppress(np.linalg.LinAlgError):
                yield fit_at(self._samples, start.poles, m.delay, self._free,
                             Guess(start, fit.power), slopes=False)


def _searched(grid: PoleGrid, free: Free, delays: Sequence[Array]) -> list[Fit]:
    """Return the best models of one to four poles, a pair counting as two."""
    none, found, samples = np.empty(0, dtype=complex), list[Fit | None]([None]), grid.samples
    for n in range(1, _MOST + 1):
        ends = []
        for real in (True, False)[:n]:
            before = found[n - 2 + real]
            options = [(none, d) for d in delays] if before is None else [
                (before.model.poles[::samples.rank], before.model.delay)]
            starts = []
            for poles, delay in options:
                score, pole = grid.best(poles, delay, real)
                starts.append((score, np.append(poles, pole), delay))
            for _, poles, delay in sorted(starts, key=lambda s: s[0])[:_EACH]:
                with suppress(np.linalg.LinAlgError):
                    start = fit_at(samples, np.repeat(poles, samples.rank), delay, free)
                    ends.append(climb_roughly(samples, start, free))
        if not ends:
            break
        found.append(min(ends, key=lambda fit: fit.cost))
        if samples.effort.beyond(POINT):
            break
    return [fit for fit in found if fit is not None]


def _allotments(wide: Sequence[int], n: int, most: int) -> Iterator[tuple[int, ...]]:
    """Yield ranks of poles, of so many states each, that make n states."""
    if not wide:
        if n == 0:
            yield ()
        return
    for rank in range(min(most, n // wide[0]) + 1):
        for others in _allotments(wide[1:], n - rank * wide[0], most):
            yield (rank, *others)
