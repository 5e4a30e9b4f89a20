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
from numpy.lib.stride_tricks import sliding_window_view

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
_PAST = 24            # samples of an input that tell its next: 8 miss 18 to 33 % of 1.5 Hz at 5 Hz
_SAME = 1e-9          # relative singular value below which they tell the same
_JUMP = 1e-6          # of an interval, in which it goes to what it is
_ASKED = 'what inputs do between their samples'


def other_hold(samples: Samples, found: dict[int, Tried], best: Tried, free: Free,
               in_loop: bool) -> tuple[int, Hold] | None:
    """
    Return the first input signal with another hold that explains more, and that; if any.

    In a loop lines to the next command know the noise that its controller made it of: there they
    have to explain more as well if they go to what the commands before tell of it.
    """
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
        known, holds = [r.inputs[place] for r in samples.records], _OTHERS[signal.hold]
        others = [[replace(s, hold=hold) for s in known] for hold in holds]
        if in_loop and signal.hold == 'zoh':
            others.append([_foretold(s) for s in known])
        gains = [max(_gains(_with_input(samples, place, other), own, smaller, late, without),
                     default=-np.inf) for other in others]
        if min(gains) > least:
            return place, holds[int(np.argmax(gains[:len(holds)]))]
    return None


def _foretold(signal: Signal) -> Signal:
    """Return straight lines from each sample to what those before it tell of the next."""
    t, v = signal.time, signal.values
    told = v[1:].copy()
    if len(v) > 2 * _PAST:
        for j, own in enumerate(v.T - v.mean(axis=0)[:, np.newaxis]):
            past = sliding_window_view(own, _PAST)[:-1]
            told[_PAST - 1:, j] = v[:, j].mean() + past @ np.linalg.lstsq(
                past, own[_PAST:], rcond=_SAME)[0]
    times = np.column_stack((t[:-1], t[1:] - _JUMP * np.diff(t))).ravel()
    values = np.stack((v[:-1], told), axis=1).reshape(len(times), v.shape[1])
    return replace(signal, time=np.append(times, t[-1]), values=np.vstack((values, v[-1])),
                   hold='linear')


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
