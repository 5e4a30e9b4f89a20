# SPDX-License-Identifier: Apache-2.0
"""
Does an input do between its samples what its hold says? The likelihood of the outputs tells.

A command that is smooth and was recorded at a low rate is no staircase. Taken for one it is half
an interval late, and has edges; dead times, poles and further states stand in for that, and the
fit of the record shows nothing of it. Models of the same number of states or fewer, with the input
on straight lines and on curves, have as many numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array
from ctsid_core.search.tried import SEARCH, Tried, price, roughly
from ctsid_core.settings import Hold
from ctsid_core.signals.record import Signal, channel_slices

_OTHERS: dict[Hold, tuple[Hold, ...]] = {
    'zoh': ('linear', 'smooth'), 'linear': ('zoh',), 'smooth': ('zoh',)}
_SURELY = 10.0        # -2 log likelihood by which another hold must be better: 150 to 1
_SLOW = 0.1           # of 1: fastest pole times interval, below which holds are alike
_MOVES = 0.5          # of its samples differ from those before: else an input is held
_ASKED = 'what inputs do between their samples'


def other_hold(samples: Samples, found: dict[int, Tried], best: Tried, free: Free
               ) -> tuple[int, Hold] | None:
    """Return the first input signal with another hold that explains more, and that; if any."""
    fastest, inputs = float(np.max(np.abs(best.fit.model.poles))), samples.records[0].inputs
    own: Tried | None = None
    smaller = [one for n, one in found.items() if n <= best.fit.model.n]
    for place, (signal, channels) in enumerate(zip(inputs, channel_slices(inputs), strict=True)):
        steps = np.any(np.diff(signal.values, axis=0), axis=1)
        if len(steps) < 3 or fastest * signal.period < _SLOW or np.mean(steps) < _MOVES:
            continue
        if samples.effort.leaves_out(_ASKED, SEARCH):
            return None
        model = best.fit.model
        own = own or roughly(samples, model.poles, model.delay, free, best.fit)
        late = np.zeros(samples.nu)
        late[channels] = 0.5 * signal.period * (1.0 if signal.hold == 'zoh' else -1.0)
        without = replace(free, feedthrough=False)
        least = _SURELY + max((0.0, *_gains(samples, own, smaller, 0.0 * late, without)))
        others = [_with_input(samples, place, [replace(r.inputs[place], hold=hold)
                                               for r in samples.records])
                  for hold in _OTHERS[signal.hold]]
        gains = [max(_gains(other, own, smaller, late, without), default=-np.inf)
                 for other in others]
        if min(gains) > least:
            return place, _OTHERS[signal.hold][int(np.argmax(gains))]
    return None


def _gains(samples: Samples, own: Tried, smaller: list[Tried], late: Array,
           free: Free) -> Iterator[float]:
    """Yield by how much models of other samples are likelier, at the price of their numbers."""
    for one in smaller:
        model = one.fit.model
        with suppress(np.linalg.LinAlgError):
            other = roughly(samples, model.poles, np.where(
                free.delays, np.maximum(model.delay + late, 0.0), model.delay), free, one.fit)
            n_eff = np.maximum(np.minimum(own.independent, other.independent), 2.0)
            ratio = np.log(np.maximum(own.power, 1e-24) / np.maximum(other.power, 1e-24))
            each = min(float(np.log(n_eff.max())), price(samples))
            yield float(n_eff @ ratio) + each * (own.parameters - other.parameters)


def _with_input(samples: Samples, place: int, signals: Sequence[Signal]) -> Samples:
    """Return the samples with another signal for one of the inputs, of each record."""
    return replace(samples, records=tuple(
        replace(r, inputs=(*r.inputs[:place], s, *r.inputs[place + 1:]))
        for r, s in zip(samples.records, signals, strict=True)))
