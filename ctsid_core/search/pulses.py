# SPDX-License-Identifier: Apache-2.0
"""Whether an input has spikes, or moves in pulses: what its outputs answer is no fault of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.search.by_order import SEARCHED, search_orders
from ctsid_core.search.corrupt import corrupt_rows
from ctsid_core.search.solution import own_delays
from ctsid_core.search.solve import free_of
from ctsid_core.settings import Settings


def with_pulses(part: Joint, settings: Settings, effort: Effort) -> Joint:
    """
    Return the records, inputs as they were given if a model of one state explains more by them.

    Of an input that moves in pulses nothing is left without what its neighbours take for corrupt.
    """
    if not any(f.any for p in part.parts for f in p.corrupt_u):
        return part
    given = replace(part, parts=tuple(p.with_inputs_as_given() for p in part.parts))
    return min((part, given), key=lambda one: _cost(one, settings, effort))


def _cost(part: Joint, settings: Settings, effort: Effort) -> float:
    """Return -2 log likelihood of the best model of one state."""
    own = own_delays(part, settings)
    samples = samples_of([p.record for p in part.parts], list(map(corrupt_rows, part.parts)),
                         effort=effort).thinned(SEARCHED)
    _, found = search_orders(
        samples, replace(free_of(samples, own), feedthrough=False), lambda n, delay: iter(()),
        order=1, max_order=1, known_delay=np.array(own.delays(samples.nu)))
    return found[1].fit.cost if found else np.inf
