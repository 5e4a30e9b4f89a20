# SPDX-License-Identifier: Apache-2.0
"""What a model looks like if something that is given is not so: a hold, an order, dead times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples
from ctsid_core.search.by_order import SEARCHED, search_orders
from ctsid_core.search.held import other_hold
from ctsid_core.search.plants import predicted
from ctsid_core.search.solution import ANY_DELAY, ANY_ORDER, OTHER_HOLD, Doubt, Solution
from ctsid_core.search.subspace_poles import Subspace
from ctsid_core.search.task import Task
from ctsid_core.search.tried import (
    SEARCH,
    UNEXPLAINED,
    Tried,
    beats,
    choose,
    climbed,
    fitted,
    tried,
)
from ctsid_core.signals.record import channel_slices


def doubt_of_hold(task: Task, samples: Samples, found: dict[int, Tried], best: Tried,
                  free: Free) -> Doubt | None:
    """Return that an input is not held as it is said to be, and what to set, if so."""
    other = other_hold(samples, found, best, free, not task.settings.feedthrough)
    if other is None:
        return None
    place, hold = other
    inputs = samples.records[0].inputs
    name = task.input_names[channel_slices(inputs)[place].start].partition('[')[0]
    moves = 'is held between its samples' if hold == 'zoh' else 'moves between its samples'
    return (f'input {name} seems as if it {moves}: that explains more, with no more states, than '
            f'`hold: {inputs[place].hold}` does', f'{name}{OTHER_HOLD}{hold}')


def doubt_of_order(task: Task, samples: Samples, free: Free) -> Doubt | None:
    """
    Return that an order is given which is too small, as predictions say, and the setting.

    What missing states leave is no noise, and predictions would take it for that.
    """
    settings = task.settings
    sought = 0 < settings.order < settings.max_order and not samples.effort.leaves_out(
        'whether more states predict better', SEARCH)
    found = predicted(replace(task, settings=settings.replace(order=0)), samples,
                      free) if sought else None
    return None if found is None or len(found.matrices.A) <= settings.order else (
        f'more states than the {settings.order} that are given predict better, as when the order '
        'is too small', ANY_ORDER)


def doubt_of_delays(task: Task, found: Solution) -> Doubt | None:
    """Return that dead times are given with which less is explained than with others, if so."""
    task = replace(task, part=found.part)
    own, simulated = task.own, found.simulated
    unknown = np.array(own.unknown_delays(len(found.delay)))
    if unknown.all() or simulated is None:
        return None
    left = [tried(*one).unexplained for one in (simulated, found.drifting) if one]
    if min(left) <= UNEXPLAINED or task.effort.leaves_out('whether other dead times explain more'):
        return None
    samples, (_, fit, given) = simulated[0].thinned(SEARCHED), simulated
    free = replace(given, delays=(True,) * samples.nu)
    order, most = own.order, fit.model.n
    if found.doubt is not None and found.doubt[1] == ANY_ORDER:
        order, most = 0, own.max_order     # or dead times stand for states that are missing
    samples, orders = search_orders(
        samples, free, Subspace(task).poles, order=order, max_order=most,
        known_delay=np.zeros(samples.nu))
    other = orders.get(order or choose(orders)) if orders else None
    if other is None:
        return None
    model = other.fit.model
    near = climbed(samples, fitted(samples, replace(model, delay=np.where(
        unknown, model.delay, own.delays(samples.nu))), given, other.fit), given)
    if not (beats(other, near) and beats(other, fitted(samples, fit.model, given, fit))):
        return None
    return ('dead times of ' + ', '.join(f'{d:.3g}' for d in model.delay)
            + ' s explain more than those that are given', ANY_DELAY)
