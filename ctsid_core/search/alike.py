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
from functools import cached_property

import numpy as np

from ctsid_core.likelihood.free_residues import FreeFit, climb_free, free_fit
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Fit, Free, Guess, fit_at, reach_of
from ctsid_core.linear.types import Array
from ctsid_core.search.pole_grid import PoleGrid

POINT = 0.4           # of a budget that a look at where to begin may take
_MOST = 4             # different poles, a pair counts as two
_EACH = 2             # starts of each kind that climb
_ALLOTTED = 4         # ways to allot ranks to poles that are looked at
_APART = 0.01         # of a pole to the next one that is alike, over the pole


class Alike:
    """
    Starts of any order, from models of few poles whose residues have any rank.

    These look at the samples of a grid of poles; `delays` are dead times to begin with.
    """

    def __init__(self, grid: PoleGrid, free: Free, delays: Sequence[Array]) -> None:
        self._grid, self._samples, self._free, self._delays = grid, grid.samples, free, delays
        self._starts: dict[int, Fit | None] = {1: None}     # of one state a grid does as well

    @cached_property
    def _models(self) -> list[FreeFit]:
        return _searched(self._grid, self._free, self._delays)

    def start(self, n: int) -> Fit | None:
        """Return the best start of n states, on few samples; None if there is none."""
        if n not in self._starts:
            found = [fit for model in self._models for fit in self._allotted(model, n)]
            self._starts[n] = min(found, key=lambda fit: fit.cost, default=None)
        return self._starts[n]

    def _allotted(self, model: FreeFit, n: int) -> Iterator[Fit]:
        """Yield models of n states, of the parts of residues that explain most."""
        parts = _parts(model)
        power = np.tile(model.power, (len(self._samples.records), 1))

        def strength(ranks: tuple[int, ...]) -> float:
            return sum(part[0] for own, r in zip(parts, ranks, strict=True) for part in own[:r])
        wide = [1 + int(p.imag > 0.0) for p in model.poles]
        for ranks in sorted(_allotments(wide, n, len(parts[0])), key=strength)[:-_ALLOTTED - 1:-1]:
            chosen = [(p * (1.0 + _APART * k), *part[1:])
                      for p, own, r in zip(model.poles, parts, ranks, strict=True)
                      for k, part in enumerate(own[:r])]
            chosen.sort(key=lambda x: (x[0].imag > 0.0, abs(x[0])))
            poles, c, b, x0 = (np.array(x, dtype=complex) for x in zip(*chosen, strict=True))
            start = ModalModel(poles, b, c.T, x0.T, np.zeros((len(model.power), len(model.delay))),
                               np.zeros_like(power), model.delay)
            with suppress(np.linalg.LinAlgError):
                yield fit_at(self._samples, poles, model.delay, self._free, Guess(start, power),
                             slopes=False)


def _searched(grid: PoleGrid, free: Free, delays: Sequence[Array]) -> list[FreeFit]:
    """Return the best models of one to four poles, a pair counting as two."""
    none, found, samples = np.empty(0, dtype=complex), list[FreeFit | None]([None]), grid.samples
    for n in range(1, _MOST + 1):
        ends = []
        for real in (True, False)[:n]:
            before = found[n - 2 + real]
            options = [(none, d) for d in delays] if before is None else [
                (before.poles, before.delay)]
            starts = []
            for poles, delay in options:
                score, pole = grid.best(poles, delay, real)
                starts.append((score, np.append(poles, pole), delay))
            for _, poles, delay in sorted(starts, key=lambda s: s[0])[:_EACH]:
                with suppress(np.linalg.LinAlgError):
                    ends.append(climb_free(samples, free_fit(samples, poles, delay, free), free))
        if not ends:
            break
        found.append(min(ends, key=lambda fit: fit.cost))
        if samples.effort.beyond(POINT):
            break
    return [fit for fit in found if fit is not None]


def _parts(model: FreeFit) -> list[list[tuple[float, Array, Array, Array]]]:
    """Return parts of rank one of each pole's residue, the strongest first: power, c, b, x0."""
    reach, size, found = reach_of(model.columns), np.sqrt(model.power), []
    for k, pole in enumerate(model.poles):
        left, s, right = np.linalg.svd(model.residues[:, k] * reach[k] / size[:, np.newaxis],
                                       full_matrices=False)
        own = []
        for strength, c, b in zip(s, left.T, right, strict=True):
            x0 = c.conj() @ (model.starts[:, :, k] / size[:, np.newaxis])
            own.append((float(strength) ** 2 * (1 + (pole.imag > 0.0)), c * size,
                        strength * b / reach[k], x0))
        found.append(own)
    return found


def _allotments(wide: Sequence[int], n: int, most: int) -> Iterator[tuple[int, ...]]:
    """Yield ranks of poles, of so many states each, that make n states."""
    if not wide:
        if n == 0:
            yield ()
        return
    for rank in range(min(most, n // wide[0]) + 1):
        for others in _allotments(wide[1:], n - rank * wide[0], most):
            yield (rank, *others)
