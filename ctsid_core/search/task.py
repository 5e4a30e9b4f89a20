# SPDX-License-Identifier: Apache-2.0
"""
What is to be identified: records, what is set of their model, and how much a budget allows.

And the poles of HD-PBSID's models of these records, as starts for climbs of the likelihood.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples, samples_of
from ctsid_core.linear.types import Array, ComplexArray, Mask
from ctsid_core.search.tried import POINT
from ctsid_core.settings import Settings, longest_sought, slowest_sought
from ctsid_core.subspace.hd_pbsid import Subspaces, Tuning, realise

FASTEST = 0.95       # of the outputs' Nyquist frequency: the fastest pole
_FEWEST = 3           # states: fewer are found by a grid of poles
_PROJECTION, _PER_SAMPLE, _REGRESSION = 1e7, 2e4, 3e6       # work


@dataclass(frozen=True, eq=False)
class Task:
    """Records of one plant, and what is known of its model."""

    part: Joint
    settings: Settings
    effort: Effort
    most: int               # samples of a stream that a budget suffices for

    @property
    def own(self) -> Settings:
        """The settings with the dead times of the moving inputs only."""
        return own_delays(self.part, self.settings)

    @property
    def input_names(self) -> list[str]:
        """Names of the moving inputs."""
        names = self.part.parts[0].whole.input_names
        return [names[j] for j in self.part.parts[0].u]

    @cached_property
    def finest(self) -> float:
        """Median interval of the finest output before a budget leaves any samples out [s]."""
        return samples_of_part(self.part, self.effort).finest

    def free(self, samples: Samples) -> Free:
        """Return what is free, and modes as fast as all samples tell: inputs are known between."""
        return replace(free_of(samples, self.own), fastest=FASTEST * np.pi / self.finest)

    def seen(self, ahead: float = 0.0) -> Samples:
        """Return the samples, outputs left out for so long after the start [s]."""
        return samples_of_part(self.part, self.effort, ahead).thinned(self.most)


def own_delays(part: Joint, settings: Settings) -> Settings:
    """Return the settings with the dead times of the moving inputs only."""
    if not isinstance(settings.delay, tuple):
        return settings
    return settings.replace(delay=tuple(settings.delay[j] for j in part.parts[0].u))


def corrupt_rows(part: Usable) -> tuple[Mask | None, ...]:
    """Return which rows of each output signal of a record have a corrupt sample."""
    return tuple(f.mask.any(axis=1) if f.any else None for f in part.corrupt_y)


def samples_of_part(part: Joint, effort: Effort, ahead: float = 0.0) -> Samples:
    """Return the samples of records but corrupt ones; `ahead` is as for `samples_of` [s]."""
    return samples_of([p.record for p in part.parts], list(map(corrupt_rows, part.parts)), ahead,
                      effort)


def free_of(samples: Samples, own: Settings) -> Free:
    """Return what is free, and within which bounds."""
    return Free(own.feedthrough, own.trim, own.unknown_delays(samples.nu),
                longest_sought(samples.length), -slowest_sought(samples.length),
                FASTEST * np.pi / samples.finest)


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
        """Return the regressions, with dead times as they are given or as first found."""
        # Small models of several inputs have any dead times: those given are a start, too, and
        # where a budget is short the first that are asked for are all; none, if they take most of
        # it.
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
