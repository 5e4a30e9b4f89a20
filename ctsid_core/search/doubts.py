# SPDX-License-Identifier: Apache-2.0
"""What a model looks like if something that is given is not so: a hold, an order, dead times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array
from ctsid_core.search.by_order import SEARCHED, search_orders
from ctsid_core.search.plants import predicted
from ctsid_core.search.solution import ANY_DELAY, ANY_ORDER, OTHER_HOLD, Doubt, Solution
from ctsid_core.search.task import Subspace, Task
from ctsid_core.search.tried import (
    SEARCH,
    UNEXPLAINED,
    Tried,
    beats,
    choose,
    climbed,
    fitted,
    likelihood_gain,
    price,
    roughly,
    tried,
)
from ctsid_core.settings import Hold
from ctsid_core.signals.record import Signal, placed

_OTHERS: dict[Hold, tuple[Hold, ...]] = {
    'zoh': ('linear', 'smooth'), 'linear': ('zoh',), 'smooth': ('zoh',)}
_SURELY = 10.0        # -2 log likelihood by which another hold must be better: 150 to 1
_SLOW = 0.1           # of 1: fastest pole times interval, below which holds are alike
_MOVES = 0.5          # of its samples differ from those before: else an input is held
_PAST = 24            # samples of an input that tell its next: 8 miss 18 to 33 % of 1.5 Hz at 5 Hz
_SAME = 1e-9          # relative singular value below which they tell the same
_JUMP = 1e-6          # of an interval, in which it goes to what it is


def doubt_of_hold(task: Task, samples: Samples, found: dict[int, Tried], best: Tried,
                  free: Free) -> Doubt | None:
    """Return that an input does not do what its hold says between its samples, and what to set."""
    # A command that is smooth and was recorded at a low rate is no staircase. Taken for one it is
    # half an interval late, and has edges; dead times, poles and further states stand in for that,
    # and the fit of the record shows nothing of it. Models of the same number of states or fewer,
    # with the input on straight lines and on curves, have as many numbers. In a loop lines to the
    # next command know the noise that its controller made it of: there they have to explain more
    # as well if they go to what the commands before tell of it.
    fastest, inputs = float(np.max(np.abs(best.fit.model.poles))), samples.records[0].inputs
    own: Tried | None = None
    smaller = [one for n, one in found.items() if n <= best.fit.model.n]
    for place, (signal, channels) in enumerate(placed(inputs)):
        steps = np.any(np.diff(signal.values, axis=0), axis=1)
        if len(steps) < 3 or fastest * signal.period < _SLOW or np.mean(steps) < _MOVES:
            continue
        if samples.effort.leaves_out('what inputs do between their samples', SEARCH):
            return None
        model = best.fit.model
        own = own or roughly(samples, *model.nonlinear, free, best.fit)
        late = np.zeros(samples.nu)
        late[channels] = 0.5 * signal.period * (1.0 if signal.hold == 'zoh' else -1.0)
        without = replace(free, feedthrough=False)
        least = _SURELY + max((0.0, *_gains(samples, own, smaller, 0.0 * late, without)))
        known, holds = [r.inputs[place] for r in samples.records], _OTHERS[signal.hold]
        others = [[replace(s, hold=hold) for s in known] for hold in holds]
        if not task.settings.feedthrough and signal.hold == 'zoh':
            others.append([_foretold(s) for s in known])
        gains = [max(_gains(_with_input(samples, place, other), own, smaller, late, without),
                     default=-np.inf) for other in others]
        if min(gains) > least:
            hold = holds[int(np.argmax(gains[:len(holds)]))]
            name = task.input_names[channels.start].partition('[')[0]
            seems = 'it is held between its samples' if hold == 'zoh' else \
                'it moves between its samples, or outputs are averages over some time'
            return (f'input {name} seems as if {seems}: that explains more, with no more states, '
                    f'than `hold: {signal.hold}` does',
                    f'{name}{OTHER_HOLD}{hold}')
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
            yield likelihood_gain(other, own, both=True, most=price(samples))


def _with_input(samples: Samples, place: int, signals: Sequence[Signal]) -> Samples:
    """Return the samples with another signal for one of the inputs, of each record."""
    return replace(samples, records=tuple(
        replace(r, inputs=(*r.inputs[:place], s, *r.inputs[place + 1:]))
        for r, s in zip(samples.records, signals, strict=True)))


def doubt_of_order(task: Task, samples: Samples, free: Free) -> Doubt | None:
    """Return that an order is given which is too small, as predictions say, and the setting."""
    # What missing states leave is no noise, and predictions would take it for that.
    settings = task.settings
    sought = 0 < settings.order < settings.max_order and not samples.effort.leaves_out(
        'whether more states predict better', SEARCH)
    found = predicted(replace(task, settings=settings.replace(order=0)), samples,
                      free) if sought else None
    return None if found is None or len(found.matrices.A) <= settings.order else (
        f'more states than the {settings.order} that are given predict better, as when the order '
        'is too small', ANY_ORDER)


def doubt_of_size(task: Task, found: dict[int, Tried]) -> Doubt | None:
    """Return that fewer states than are given explain as much, and the setting."""
    given = task.settings.order
    fewer = choose(found) if given else 0
    return None if fewer == given else (
        f'{fewer} state{"s explain" if fewer > 1 else " explains"} as much as the {given} that '
        'are given', ANY_ORDER)


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
