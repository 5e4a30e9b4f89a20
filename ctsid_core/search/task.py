# SPDX-License-Identifier: Apache-2.0
"""What is to be identified: records, what is set of their model, and how much a budget allows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples, samples_of
from ctsid_core.linear.types import Mask
from ctsid_core.settings import Settings, longest_sought, slowest_sought

FASTEST = 0.95       # of the outputs' Nyquist frequency: the fastest pole


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
