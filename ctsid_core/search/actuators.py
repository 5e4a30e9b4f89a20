# SPDX-License-Identifier: Apache-2.0
"""
Actuators that stop, ignore, limit or drag a command: a number for which no linear states stand in.

Drivers stop a robot that hears no more, clip and ramp what they are sent; small commands do not
overcome friction; gears have play. A linear model takes that for other poles and gains, which hold
for motions of one size. With the command as it acts the plant behind may be linear, with fewer
states, and the likelihood tells which it is, and of what size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from ctsid_core.bases.records import Joint
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Fit, Fitted, Free, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Choice
from ctsid_core.search.by_order import SEARCHED
from ctsid_core.search.commands import Acting, Commands, Start, commands_of, with_number
from ctsid_core.search.solution import DISTURBED, Doubt, Solution
from ctsid_core.search.task import free_of, own_delays, samples_of_part
from ctsid_core.search.tried import ENOUGH, SEARCH, Tried, likelihood_gain, tried
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.actuators import in_words
from ctsid_core.signals.record import placed

APART = 0.1           # of a number: nearer to what is given is no doubt
SURELY = 10.0         # -2 log likelihood by which what acts must be likelier: 150 to 1
_MOST = 0.7           # times the error that is not noise, that what acts may leave, ...
_LEFT = 0.06          # ... and of the motion: a sensor that is clipped leaves more
_NEAR = 1.8           # times one of these, at most, is what is nearest to it
_CLOSELY = 0.001      # it is looked for no more closely
_STARTS = 2           # pairs of poles that it is looked for with, too
_SOONER = 0.5         # times the dead time: of what is sent it may stand for what drags
_SCREENED = 400       # samples of a stream that all numbers are compared on, ...
_BEST = 2             # ... and of the best ones of each kind so many are made the most of
_FARTHER = (0.01, 0.03, 0.1, 0.3, 0.9)      # of it, that others are away that may be right
_EACH = 10            # evaluations that one takes, about
_PASSES = 4           # in which numbers are found, one after the other
_ROUNDS = 6           # as often it is looked for, unless it is hardly likelier then
_CHANCE = 1.0         # -2 log likelihood that another number gains by chance
_ASKED = 'whether actuators stop, limit or drag what inputs are sent'


def of_actuators(solution: Solution, sent: Joint, settings: Settings,
                 again: Callable[[Settings, bool], Solution | None], *, loop: bool) -> Solution:
    """
    Return the model of inputs as they act, where that explains clearly more.

    `again` identifies the records, which `sent` has as they were sent, with other settings. In a
    `loop` timeouts alone are looked for: simulations of what a controller holds seem to tell of
    any of the others. What was given and is another number is a doubt, and a timeout that no model
    confirms.
    """
    part = sent.parts[0]
    whole, u = part.whole, solution.part.parts[0].u
    if solution.refit or part.u != u:
        return solution
    given = settings.actuators(whole.nu)
    unknown = {kind: settings.unknown_actuators(kind, whole.nu) for kind in Actuator._fields}
    together = [range(k.start, k.stop) for _, k in placed(whole.inputs)]
    best, acting, first = solution, {k: given[j] for k, j in enumerate(u)}, Acting()
    for _ in range(_ROUNDS):
        try:
            seen, sure = _likeliest(solution, best, sent, settings, acting, loop)
        except np.linalg.LinAlgError:
            break
        first = first or (seen if sure else acting)
        if seen == acting:
            break
        before = best.settings.actuators(whole.nu)
        each = list(given)
        for k, j in enumerate(u):
            for kind, value in seen[k]._asdict().items():
                # Messages stop together, also with channels that are constant in them.
                of = next(c for c in together if j in c) if kind == 'timeout' else [j]
                for i in of:
                    each[i] = each[i]._replace(**{kind: value} if unknown[kind][i] else {})
        if tuple(each) == before:           # it is all given
            break
        other = again(settings.with_actuators(each), False)
        if other is None or not _explains_more(other, best, _count(seen) - _count(acting),
                                               any(any(own[1:]) for own in seen.values())):
            solution.samples.effort.leaves_out(_ASKED, SEARCH)      # or it was broken off
            break
        best, acting = other, {k: each[j] for k, j in enumerate(u)}
        if other.part.parts[0].u != u:      # one that acts as it is silent
            break
    doubts = (_doubt(whole.input_names[j], kind, known, value) for k, j in enumerate(u)
              if k in first for kind, known, value in zip(
                  Actuator._fields, acting[k], first[k], strict=True)
              if value and (kind == 'timeout' or not unknown[kind][j])
              and abs(value - known) > APART * value)
    beside, deviations = list(_beside(best, settings)), [Actuator()] * whole.nu
    for j, kind, deviation, _ in beside:        # of a larger and of a smaller number
        deviations[j] = deviations[j]._replace(
            **{kind: getattr(deviations[j], kind) + 0.5 * deviation})
    return replace(best, doubt=next(doubts, best.doubt), deviations=tuple(deviations), rivals=(
        *best.rivals, *((0.5, model) for *_, model in beside)))


def with_choices(solution: Solution, settings: Settings) -> Solution:
    """Return the solution with what was found to lie before inputs told."""
    whole = solution.part.parts[0].whole
    told = [Actuator(*(0.0 if known else value for known, value in zip(given, own, strict=True)))
            for given, own in zip(settings.actuators(whole.nu),
                                  solution.settings.actuators(whole.nu), strict=True)]
    known = solution.deviations or (Actuator(),) * whole.nu
    return replace(
        solution,
        notes=(*solution.notes, *in_words(whole.input_names, told, whole.input_units, known)),
        choices=(*solution.choices, *(
            Choice(kind, float(f'{value:.4g}'), f'of input {name}: what so acts of it explains '
                   'more', off or float('nan'))
            for name, own, deviations in zip(whole.input_names, told, known, strict=True)
            for kind, value, off in zip(Actuator._fields, own, deviations, strict=True) if value)))


def _doubt(name: str, kind: str, given: float, value: float) -> Doubt:
    """Return that what is said to act of an input is not so, and what to set."""
    setting = f'{name.partition("[")[0]}.{kind}: '
    if kind == 'timeout':
        return (f'input {name} acts as if it were 0 from about {value:.2g} s after a message on, '
                'while it is silent: a timeout seems to stop the robot, or messages were lost',
                f'{setting}{value:.2g}')
    words, = in_words((name,), [Actuator(**{kind: given})])
    return f'it is given that {words}, but another number explains more', f'{setting}auto'


def _explains_more(one: Solution, other: Solution, numbers: int, bends: bool) -> bool:
    """Return whether a model of inputs that act with so many more numbers is to be taken."""
    # Where what acts is right its errors are as independent as they seem. A timeout may leave what
    # commands do that were lost, and which look alike: there both models' errors count, and it has
    # to gain twice as much. What `bends` inputs has to explain most.
    if one.simulated is None:
        return False
    own = tried(*one.simulated)
    if other.simulated is None:
        return own.unexplained < DISTURBED
    if not numbers:
        return likelihood_gain(own, tried(*other.simulated)) > 0.0
    rival = tried(*other.simulated)
    return _surely(own, rival, numbers) if bends else \
        likelihood_gain(own, rival, numbers, both=True) > 2.0 * SURELY


def _surely(one: Tried, other: Tried, numbers: int) -> bool:
    """Return whether a model of what acts is surely likelier, and leaves little, or is smaller."""
    fewer = one.fit.model.n < other.fit.model.n
    return one.unexplained < _LEFT and likelihood_gain(one, other, numbers) > SURELY and (
        fewer or one.unexplained < _MOST * other.unexplained)


def _count(acting: Acting) -> int:
    return sum(value > 0.0 for own in acting.values() for value in own)


def _likeliest(solution: Solution, model: Solution, sent: Joint, settings: Settings,
               acting: Acting, loop: bool) -> tuple[Acting, bool]:
    """Return what most likely lies before inputs, and whether that is sure."""
    # Given the records as they were sent, a model, and what is known of them.
    effort = solution.samples.effort
    samples, fit, free = _simulation(solution, sent, settings)
    _, fit, free = model.simulated or (samples, fit, free)
    commands = commands_of(samples.thinned(SEARCHED, scattered=True), sent, free)
    silent = {k for k in acting if commands.silent(k)}
    errs = model.simulated is not None and tried(*model.simulated).unexplained > ENOUGH
    sought = [(channels, kind) for channels, kind in _sought(sent, settings, loop)
              if (silent.intersection(channels) if kind == 'timeout' else errs)]
    if not sought or effort.leaves_out(_ASKED, SEARCH):
        return acting, False
    smaller = sorted((one for one, _ in model.smaller), key=lambda one: one.n)[-1:]
    starts = [*(one.nonlinear for one in (fit.model, *smaller)),
              *_starts(commands.samples, free, fit.model.delay)]
    screen = replace(commands, samples=commands.samples.thinned(_SCREENED))
    known, begun = acting, starts[0]
    own = commands.reached(acting, [begun])
    while own is not None:
        # With a timeout that is new the model is another one: what else there is, that tells.
        stops = [one for one in sought if one[1] == 'timeout']
        best = _next(commands, screen, acting, stops if _set(stops, acting) != _set(
            stops, known) else sought, starts)
        if best is None or effort.leaves_out(_ASKED, SEARCH):
            break
        # Another start may be what is better of it.
        starts[0] = best[0].fit.model.nonlinear
        same = commands.reached(acting, starts[:1]) or own
        new = [one for one in sought if one not in _set(sought, acting)]
        (channels, kind), = _set(new, best[1])
        rival = min(own, same, key=lambda one: one.fit.cost)
        needed = SURELY * (1 + sum(map(bool, acting[channels[0]])))
        if likelihood_gain(best[0], rival, 1, both=kind == 'timeout') < needed:
            break
        own, acting = _nearer(commands, *best, _PASSES * _set(new, best[1]))
    numbers = _PASSES * _set(sought, acting)
    if own is None or not numbers:
        return known, False
    whole = commands_of(samples, sent, free)        # they are as sure as all samples tell
    if effort.beyond(SEARCH, _EACH * len(numbers) * whole.work(own.fit)):
        whole, numbers = commands, []               # another search has to follow
    own = whole.reached(acting, [own.fit.model.nonlinear])
    given = whole.reached(known, [begun])
    if own is None or given is None:
        return known, False
    own, acting = _nearer(whole, own, acting, numbers)
    part = sent.parts[0]
    for channels, kind in _set(sought, known):      # what is given stays, unless it surely is not
        if settings.unknown_actuators(kind, part.whole.nu)[part.u[channels[0]]]:
            continue
        value = getattr(known[channels[0]], kind)
        stays = with_number(acting, channels, kind, value)
        near = whole.reached(stays, [own.fit.model.nonlinear])
        if near is not None and likelihood_gain(own, near) < SURELY:
            own, acting = near, stays
    if likelihood_gain(own, given) < _CHANCE:
        return known, False
    return acting, _surely(own, given, _count(acting) - _count(known))


def _beside(solution: Solution,
            settings: Settings) -> Iterator[tuple[int, str, float, ModalModel]]:
    """Yield inputs, kinds of what acts, deviations of its numbers, and models a deviation away."""
    # For a smaller and a larger number each. What a limit is, and the gain behind it, a command of
    # two sizes does not tell apart.
    nu = solution.part.parts[0].whole.nu
    actuators, u = solution.settings.actuators(nu), solution.part.parts[0].u
    acting = {k: actuators[j] for k, j in enumerate(u)}
    told = [(k, kind) for k, j in enumerate(u) for kind, value in acting[k]._asdict().items()
            if value and settings.unknown_actuators(kind, nu)[j]]
    if not told or solution.simulated is None:
        return
    samples, fit, free = solution.simulated
    commands = commands_of(samples, solution.part, free)
    own = commands.reached(acting, [fit.model.nonlinear])
    if own is None:
        return
    worth = float(own.independent.sum() / own.samples.counts.sum())
    start = own.fit.model.nonlinear
    for channel, kind in told:
        value = getattr(acting[channel], kind)

        def beside(part: float, channel: int = channel, kind: str = kind,
                   value: float = value) -> Fit | None:
            other = with_number(acting, [channel], kind, (1.0 + part) * value)
            return None if (one := commands.reached(other, [start])) is None else one.fit
        for sign in (-1.0, 1.0):
            for step in _FARTHER:
                one = beside(sign * step)
                rise = np.inf if one is None else worth * (one.cost - own.fit.cost)
                if rise >= 4.0:         # two deviations away: nearer it may rise and fall again
                    break
            part = step / max(rise, 1e-3) ** 0.5
            if (one := beside(sign * min(part, step))) is not None:
                yield u[channel], kind, part * value, one.model


def _sought(sent: Joint, settings: Settings, loop: bool) -> Iterator[tuple[tuple[int, ...], str]]:
    """Yield inputs that are held, those of the same messages together, and what may be theirs."""
    part = sent.parts[0]
    nu, inputs = part.whole.nu, part.record.inputs
    given = settings.actuators(nu)
    for signal, channels in placed(inputs):
        places = range(channels.start, channels.stop)
        if signal.hold != 'zoh' or len(signal.time) < 3:
            continue
        yield tuple(places), 'timeout'
        for kind in () if loop else Actuator._fields[1:]:
            unknown = settings.unknown_actuators(kind, nu)
            yield from (((k,), kind) for k in places
                        if unknown[part.u[k]] or getattr(given[part.u[k]], kind))


def _next(commands: Commands, screen: Commands, acting: Acting,
          sought: Sequence[tuple[tuple[int, ...], str]],
          starts: Sequence[Start]) -> tuple[Tried, Acting] | None:
    """Return what most likely lies before an input, too, and the model with it."""
    # Each kind with the number that is likeliest: those that are tried are far apart.
    likely = list[tuple[float, Acting, Fit, tuple[tuple[int, ...], str]]]()
    for channels, kind in sought:
        if getattr(acting[channels[0]], kind):
            continue
        near = []
        for value in screen.values(channels[0], kind, acting[channels[0]]):
            other = with_number(acting, channels, kind, value)
            if (one := screen.climbed(other, starts)) is not None:
                near.append((one.cost, other, one, (channels, kind)))
        likely += sorted(near, key=lambda n: n[0])[:1]
    found = [_nearer(commands, best, other, [new]) for _, other, one, new in sorted(
        likely, key=lambda n: n[0])[:_BEST]
        if (best := commands.reached(other, [one.model.nonlinear, *starts])) is not None]
    return min(found, key=lambda one: one[0].fit.cost, default=None)


def _set(sought: Sequence[tuple[tuple[int, ...], str]],
         acting: Acting) -> list[tuple[tuple[int, ...], str]]:
    """Return those that lie before inputs."""
    return [(channels, kind) for channels, kind in sought if getattr(acting[channels[0]], kind)]


def _nearer(commands: Commands, own: Tried, acting: Acting,
            numbers: Sequence[tuple[tuple[int, ...], str]]) -> tuple[Tried, Acting]:
    """Return the same with numbers that are likeliest, one after the other, and the model."""
    same = 0
    for channels, kind in numbers:
        if same == len(set(numbers)):       # none is nearer
            break
        near, value = own.fit, getattr(acting[channels[0]], kind)

        def cost(value: float, channels: Sequence[int] = channels, kind: str = kind,
                 near: Fit = near, acting: Acting = acting) -> float:
            one = commands.at(commands.acting(with_number(acting, channels, kind, value)),
                              near.model.nonlinear, near)
            return np.inf if one is None else one.cost
        least, most = commands.bounds(channels[0], kind, acting[channels[0]])
        best = minimize_scalar(
            cost, method='bounded', options={'xatol': _CLOSELY * value}, bounds=(
                max(value / _NEAR, min(value, least)), min(value * _NEAR, max(value, most))))
        same += 1
        if not best.fun < near.cost or abs(best.x - value) < _CLOSELY * value:
            continue
        other = with_number(acting, channels, kind, float(best.x))
        one = commands.reached(other, [near.model.nonlinear])
        if one is not None:
            own, acting, same = one, other, 0
    return own, acting


def _starts(samples: Samples, free: Free, delay: Array) -> Iterator[Start]:
    """Yield what to begin with: poles of what is sent may be far from those of what acts."""
    soon = np.where(free.delays, _SOONER * delay, delay)
    for size in np.geomspace(20.0 / samples.length, 0.1 * free.fastest, _STARTS):
        yield np.array([size * (-0.6 + 0.8j)]), soon


def _simulation(solution: Solution, sent: Joint, settings: Settings) -> Fitted:
    """Return what simulates; of a plant that only predicts, which a timeout may feign, a lag."""
    samples = samples_of_part(sent, solution.samples.effort)
    if solution.simulated is not None:
        return samples, *solution.simulated[1:]
    free = replace(free_of(samples, own_delays(solution.part, settings)), feedthrough=False)
    return samples, fit_at(samples, np.array([-free.fastest ** 0.5 + 0j]), solution.delay,
                           free, slopes=False), free
