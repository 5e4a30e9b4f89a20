# SPDX-License-Identifier: Apache-2.0
"""
Did the plant change? What one model costs, compared with two, in points of fit.

A record is divided at a few instants; each side gets a model of its own, of the same order. One
model loses little against two where the plant is the same; where it has changed it loses as much
as the change matters to who simulates. The states and the trim at the start of a side are free in
both, so that disturbances are no change of the plant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.effort import Effort
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Fit, Free, climb, fit_at, fit_states
from ctsid_core.likelihood.residuals import Residuals, residuals
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array

_INSTANTS = (0.2, 0.35, 0.5, 0.65, 0.8)     # parts of a record at which it is divided
_CLOSER = (-0.1, -0.05, 0.05, 0.1)          # from the best of them
_SEARCHED = 600                             # samples of a side that are looked at
_STEPS = 5
_LEAST_GAIN = 0.3                           # -2 log likelihood that another step has to promise
_FEWEST = 3                                 # samples of a side for each number of a model
_QUIET = 0.03         # error over motion below which no change can matter
_WHITE = 0.6          # share of independent errors above which nothing is left to explain


@dataclass(frozen=True)
class Change:
    """
    The division of a record at which two models gain most.

    Parameters
    ----------
    record : int
        Place of the record; -1 if none was divided.
    share : float
        Where, as a part of it.
    cost : float
        Points of fit that one model loses on the side where it loses more [%].
    gain : float
        By how much two models are more likely, in independent samples, beyond their price.
    one, two : tuple of float
        Fit of one model and of two, before and after [%].
    """

    record: int = -1
    share: float = 0.5
    cost: float = 0.0
    gain: float = 0.0
    one: tuple[float, float] = (float('nan'), float('nan'))
    two: tuple[float, float] = (float('nan'), float('nan'))


def most_likely_change(samples: Samples, fit: Fit, free: Free, independent: Array,
                       effort: Effort) -> Change:
    """
    Return where two models gain most.

    Parameters
    ----------
    samples : Samples
    fit : Fit
        Of all samples.
    free : Free
    independent : ndarray, shape (ny,)
        Number of independent errors of each output.
    effort : Effort
    """
    quiet = np.sqrt(fit.power.max(axis=0)) < _QUIET
    white = independent > _WHITE * samples.counts.sum(axis=0)
    if (quiet | white).all() or effort.over:
        return Change()
    best = Change()
    for place in range(len(samples.records)):
        one = replace(samples, records=samples.records[place:place + 1])
        own = replace(fit.model, x0=fit.model.x0[place:place + 1],
                      y0=fit.model.y0[place:place + 1])
        for share in _INSTANTS:
            if effort.over:
                return best
            best = max(best, _divided(one, own, free, place, share, independent, effort),
                       key=_gain)
        if best.record == place:
            for more in _CLOSER:
                share = best.share + more
                best = max(best, _divided(one, own, free, place, share, independent, effort)
                           if 0.1 <= share <= 0.9 else best, key=_gain)
    return best


def _gain(change: Change) -> float:
    return change.gain


def _divided(samples: Samples, model: ModalModel, free: Free, place: int, share: float,
             n_eff: Array, effort: Effort) -> Change:
    record = samples.records[0]
    at = record.start + share * (record.end - record.start)
    one, two = [], []
    for start, end in ((record.start, at), (at, record.end)):
        side = samples.between([(start, end)]).thinned(_SEARCHED)
        if np.min(side.counts) < _FEWEST * (3 * model.n + 2):
            return Change()
        effort.check()
        try:
            same = fit_states(side, model, free)
            other = climb(side, fit_at(side, model.poles, model.delay, free), free,
                          effort, steps=_STEPS, least=_LEAST_GAIN)
        except np.linalg.LinAlgError:
            return Change()
        one.append(_rms(residuals(side, same)))
        two.append(np.minimum(_rms(residuals(side, other)), one[-1]))
    parts = np.array([share, 1.0 - share])
    powers = [parts @ np.array(side) ** 2 for side in (one, two)]
    count = model.n * (samples.nu + samples.ny) + sum(free.delays) + 1
    gain = float(n_eff @ np.log(powers[0] / powers[1])) - count * float(
        np.log(max(float(np.max(n_eff)), 2.0)))
    if gain <= 0.0:
        return Change()
    cost = [float(np.max(a - b)) for a, b in zip(one, two, strict=True)]
    return Change(place, share, 100.0 * max(cost), gain, *(
        (100.0 * (1.0 - float(np.max(side[0]))), 100.0 * (1.0 - float(np.max(side[1]))))
        for side in (one, two)))


def _rms(errors: Residuals) -> Array:
    found: Array = np.sqrt(np.concatenate([
        np.mean(e ** 2, axis=0) for own in errors for e in own])) + 1e-300
    return found
