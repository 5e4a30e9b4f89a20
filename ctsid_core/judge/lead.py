# SPDX-License-Identifier: Apache-2.0
"""
Whether outputs answer before an input moves: a dead time below zero.

No plant does, but clocks that differ and stamps that come after an input acts look like that. As
dead times below zero are not looked for, D, a zero, or poles as fast as any stand in for them: the
model fits, and its phase leads where that of the plant does not. So it is asked whether a lead and
fewer of these explain the samples better, by the criterion that orders are chosen by, and leave
nothing but noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ctsid_core.likelihood.output_error import Fit, Free, climb_roughly, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.by_order import SEARCHED, search_orders
from ctsid_core.search.solution import NEARLY
from ctsid_core.search.tried import (
    Tried,
    beats,
    choose,
    criterion,
    parameters,
    price,
    roughly,
    tried,
)
from ctsid_core.signals.gaps import FEWEST

_REACH = 0.1          # of the longest record: leads that are looked for
WITHIN = 2.0          # intervals of an input: half a one is of a wrong hold, and one is too little
STATES = 3            # that are looked for with leads, at most, and ...
_MOST = 0.8           # ... rms error over motion with which they tell: chance leaves more
_NOISE = 0.5          # of the samples have errors that are independent with a lead, at least: else
                      # it explains a part of what it is not, as of gusts in a loop (0.1 at most)
                      # or of plants that change or are not linear (0.3)


def lead_of_outputs(samples: Samples, fit: Fit, free: Free, sought: tuple[bool, ...]) -> Array:
    """
    Return by how much outputs answer before each input, (nu,) [s]; 0 if that explains no more.

    Asked of inputs whose dead time is sought, (nu,), and was found to be none. Those of the others
    that are sought are found anew beside a lead, for which they may have stood in.
    """
    model, reach, found = fit.model, _REACH * samples.length, np.zeros(samples.nu)
    asked = np.array(sought) & (model.delay == 0.0)
    if not asked.any():
        return found
    # The same samples and models, told with all stamps of inputs earlier and dead times longer
    early, delay = _earlier(samples.thinned(SEARCHED), reach), model.delay + reach
    known = replace(free, longest=free.longest + reach, delays=(False,) * samples.nu)
    if np.min(early.counts.sum(axis=0)) <= parameters(samples, fit, free):
        return found
    own: Tried | None = None
    with suppress(np.linalg.LinAlgError):
        start = fit_at(early, model.poles, delay, known)
        for poles, direct in _with_fewer(model.poles, free.feedthrough):
            leading = replace(known, feedthrough=direct, delays=sought)
            one = fit_at(early, poles, delay, leading)
            rival = start.cost + price(early) * (
                parameters(early, start, known) - parameters(early, one, leading))
            one = climb_roughly(early, one, leading, rival)
            if one.cost > rival or not (one.model.delay < delay)[asked].any():
                continue
            led = tried(early, one, leading)
            if not _explains(led):
                continue
            own = own or roughly(early, model.poles, delay, known)
            # It is the lead that explains more, not that there are fewer poles; and where noise
            # hides a zero of the plant, with fewer numbers it explains as much.
            alone = roughly(early, one.model.poles, delay, replace(known, feedthrough=direct))
            if one.cost < own.fit.cost and beats(led, own) and beats(led, alone):
                found = np.where(asked, np.maximum(delay - one.model.delay, 0.0), 0.0)
    return found


def lead_by_search(samples: Samples, free: Free, given: Array) -> Array:
    """
    Return by how much outputs answer before each input, (nu,) [s], whatever model was found.

    A few states are looked for anew, with leads: where these are long, no model without one is
    near. Dead times that are not free are `given`, (nu,) [s].
    """
    reach, late = _REACH * samples.length, np.array(free.delays)
    early = _earlier(samples.thinned(SEARCHED), reach)
    if np.min(early.counts) < FEWEST:
        return np.zeros(samples.nu)
    leading = replace(free, feedthrough=False, longest=free.longest + reach)
    _, tries = search_orders(
        early, leading, lambda n, delay: iter(()), order=0, max_order=STATES,
        known_delay=np.where(late, 0.0, given + reach))
    if not tries:
        return np.zeros(samples.nu)
    led = tries[choose(tries)]
    found = np.where(late, np.maximum(reach - led.fit.model.delay, 0.0), 0.0)
    # At the bound it stands in for what is not known before the window.
    if not 0.0 < np.max(found) < NEARLY * reach or led.rms >= _MOST or not _explains(led):
        return np.zeros(samples.nu)
    with suppress(np.linalg.LinAlgError):
        alone = roughly(early, led.fit.model.poles, np.maximum(led.fit.model.delay, reach),
                        replace(leading, delays=(False,) * samples.nu))
        if beats(led, alone):
            return found
    return np.zeros(samples.nu)


def _explains(one: Tried) -> bool:
    """Return whether a model explains more than chance does, and leaves nothing but noise."""
    nothing = replace(one, power=np.ones_like(one.power), parameters=0)
    return criterion(nothing, one) > 0.0 and bool(np.all(
        one.independent >= _NOISE * one.samples.counts.sum(axis=0)))


def _with_fewer(poles: ComplexArray, direct: bool) -> Iterator[tuple[ComplexArray, bool]]:
    """Yield poles, and whether there is D: as they are, without D, and without the fastest."""
    if direct:
        yield poles, True
    left = poles[np.argsort(np.abs(poles))]
    while len(left):
        yield left, False
        # One state less: a pair becomes a real pole, and that goes.
        left = left[:-1] if left[-1].imag == 0.0 else np.append(left[:-1], -np.abs(left[-1]))


def _earlier(samples: Samples, by: float) -> Samples:
    """Return samples with all stamps of the inputs earlier, as long as inputs are known."""
    return replace(samples, records=tuple(
        replace(r, inputs=tuple(replace(s, time=s.time - by) for s in r.inputs))
        for r in samples.records)).between([(r.start, r.end - by) for r in samples.records])
