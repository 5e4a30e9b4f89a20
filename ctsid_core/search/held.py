# SPDX-License-Identifier: Apache-2.0
"""
Does an input do between its samples what its hold says? The likelihood of the outputs tells.

A command that is smooth and was recorded at a low rate is no staircase. Taken for one it is half
an interval late, and has edges; dead times, poles and further states stand in for that, and the
fit of the record shows nothing of it. Models of the same number of states or fewer, with the input
on straight lines and on curves, have as many numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from ctsid_core.likelihood.output_error import Fit, Free, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array
from ctsid_core.search.by_order import SEARCHED
from ctsid_core.search.tried import SEARCH, Tried, price, roughly, tried
from ctsid_core.settings import Hold
from ctsid_core.signals.gaps import silent_between
from ctsid_core.signals.record import Signal, channel_slices
from ctsid_core.signals.timeouts import stopped

_OTHERS: dict[Hold, tuple[Hold, ...]] = {
    'zoh': ('linear', 'smooth'), 'linear': ('zoh',), 'smooth': ('zoh',)}
_SURELY = 10.0        # -2 log likelihood by which another hold must be better: 150 to 1
_SLOW = 0.1           # of 1: fastest pole times interval, below which holds are alike
_MOVES = 0.5          # of its samples differ from those before: else an input is held
_TIMEOUTS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0)      # after which they do [s]
_BETWEEN = 1.3        # times one of these, at most, is what is nearest to it
_CLOSELY = 0.003      # of a timeout: it is looked for no more closely
_STARTS = 3           # poles that it is looked for with, too: from so many over the length ...
_SLOWEST, _LESS = 10.0, 0.25    # ... to this part of the fastest
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


def times_out(samples: Samples, fit: Fit, free: Free, levels: Sequence[Array],
              most: int) -> dict[int, float]:
    """
    Return the input signals that act as if they were 0 while they are silent, and from when on.

    So many seconds after a message, as where a timeout stops a robot that hears no more; `most` of
    them at most. `levels` are what was taken off the inputs of each record, (nu,).
    """
    rests = [[-level[channels] for channels in channel_slices(r.inputs)]
             for r, level in zip(samples.records, levels, strict=True)]
    silent = [place for place in range(len(rests[0])) if any(
        np.any(silent_between(r.inputs[place], *r.span, rest[place]))
        for r, rest in zip(samples.records, rests, strict=True))]
    if not silent or samples.effort.leaves_out(_ASKED, SEARCH):
        return {}
    thin = samples.thinned(SEARCHED)
    own = roughly(thin, fit.model.poles, fit.model.delay, free, fit)
    # The poles of what was held may be far from those of what acts.
    starts = [own, *(tried(thin, fit_at(thin, np.array([-p + 0j]), fit.model.delay, free), free)
                     for p in np.geomspace(_SLOWEST / thin.length, _LESS * free.fastest, _STARTS))]

    def gain(timeouts: dict[int, float]) -> float:
        other = thin
        for place, timeout in timeouts.items():
            other = _with_input(other, place, [
                stopped(r.inputs[place], timeout, rest[place])
                for r, rest in zip(thin.records, rests, strict=True)])
        return max(_gains(other, own, starts, np.zeros(samples.nu), free), default=-np.inf)

    return _likeliest(gain, silent, most)


def _likeliest(gain: Callable[[dict[int, float]], float], silent: Sequence[int],
               most: int) -> dict[int, float]:
    """Return timeouts of some inputs that gain most, each enough to be sure of it."""
    found, least = dict[int, float](), _SURELY + max(gain({}), 0.0)
    for _ in range(min(most, len(silent))):
        more = [found | {k: t} for k in silent if k not in found for t in _TIMEOUTS]
        gains = [gain(one) for one in more]
        if max(gains) < least:
            break
        found, least = more[int(np.argmax(gains))], max(gains) + _SURELY
    for place in list(found) * min(len(found), 2):
        near = found[place]
        best = minimize_scalar(
            lambda t, place=place: -gain(found | {place: t}), method='bounded',
            bounds=(near / _BETWEEN, near * _BETWEEN), options={'xatol': _CLOSELY * near})
        found[place] = float(best.x) if -best.fun > gain(found) else near
    return found


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
