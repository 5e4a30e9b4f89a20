# SPDX-License-Identifier: Apache-2.0
"""Dead times that explain too little: a number that a model may do without."""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.output_error import Free, climb_roughly, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import entry_changes
from ctsid_core.search.tried import Tried, criterion, tried

_SURE = 6.0           # standard deviations from which on a dead time is not asked by itself
_MATTERS = 0.003      # of the motion: what a dead time that stays may gain at least


def without_needless(samples: Samples, best: Tried, free: Free, least: float,
                     each: bool = True) -> tuple[Tried, Free]:
    """
    Return the model without dead times that explain too little, and what is free in it.

    They are asked all at once. If `each` may go, then, if that is too many, one by one, and those
    that are sure are not asked. Rms errors below `least`, over the motion, are no evidence. Noise
    that is stronger the faster it is, as of differences of counts, tells more of dead times than
    its power does: in noise of any colour they may not be likelier either.
    """
    found = best.fit.model.delay
    asked = np.array(free.delays) & (found > 0.0)
    if each and asked.any() and np.any(best.power >= least ** 2):
        deviation = np.linalg.norm(entry_changes(samples, best.fit, free).delay, axis=0)
        asked &= found < _SURE * deviation
    late = np.flatnonzero(asked)
    free = free.without(np.flatnonzero(free.delays & (found == 0.0)).tolist())
    count = samples.counts.sum()
    # What one costs at most, in samples that are not independent; below `least` nothing counts.
    price = float(np.log(count) * np.max(samples.counts.sum(axis=0) / best.independent))
    nothing = 2.0 * float(count) * float(np.log(least)) if least else -np.inf
    for places in [late, *(late[k:k + 1] for k in range(len(late)) if each and len(late) > 1)]:
        if samples.effort.over or not np.any(np.array(free.delays)[places]):
            continue
        fewer, delay = free.without(places.tolist()), best.fit.model.delay.copy()
        delay[places] = 0.0
        start = fit_at(samples, best.fit.model.poles, delay, fewer)
        other = tried(samples, climb_roughly(
            samples, start, fewer, max(best.fit.cost + len(places) * price, nothing)), fewer)
        if np.all(other.power < least ** 2) or (
                criterion(other, best) <= 0.0 and other.rms - best.rms < _MATTERS
                and float(np.sum((other.coloured - best.coloured)[other.power >= least ** 2]))
                <= len(places) * float(np.log(count))):
            best, free = other, fewer
    return best, free
