# SPDX-License-Identifier: Apache-2.0
"""
Held inputs that fall silent: whether what they were sent last went on.

A stick, keys and goals are sent when they change, or while they do, and robots hold what was sent
last. A recorder that loses a topic, and a watchdog that stops the robot, look alike, but the model
errs there. Samples tell: the model of what is held is asked first, then that of inputs that are 0
from some time after a message on.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctsid_core.likelihood.output_error import Fitted, fit_at
from ctsid_core.likelihood.residuals import residuals
from ctsid_core.model.estimate import Choice
from ctsid_core.search.held import times_out
from ctsid_core.search.solution import DISTURBED, TIMEOUT, Doubt, Solution
from ctsid_core.search.task import free_of, own_delays, samples_of_part
from ctsid_core.search.tried import beats, tried
from ctsid_core.settings import Settings
from ctsid_core.signals.gaps import FEWEST, silences
from ctsid_core.signals.record import channel_slices
from ctsid_core.signals.timeouts import in_words

_MORE = 1.5           # times the error elsewhere: what was sent last did not go on
_ROUNDS = 6           # as often timeouts are looked for, unless they stay as they are ...
_ALIKE = 0.005        # ... to this part of them
APART = 0.1           # of a timeout: nearer to what is given is no doubt


def lost_inputs(solution: Solution) -> bool:
    """Return whether the model errs clearly more where held inputs are silent than elsewhere."""
    silent = [silences(own.whole) for own in solution.part.parts]
    if not any(silent):
        return False
    samples, fit, _ = solution.simulated or solution.source
    inside, elsewhere = np.zeros(2), np.zeros(2)
    for spans, record, own in zip(silent, samples.records, residuals(samples, fit), strict=True):
        for s, errors in zip(record.streams, own, strict=True):
            within = np.any([(a < s.times) & (s.times < b) for a, b in spans], axis=0) \
                if spans else np.zeros(len(s.times), dtype=bool)
            for rows, found in ((within, inside), (~within, elsewhere)):
                found += np.sum(errors[rows] ** 2), np.sum(rows) * errors.shape[1]
    if min(inside[1], elsewhere[1]) < FEWEST:
        return False
    return bool(inside[0] / inside[1] > _MORE ** 2 * elsewhere[0] / elsewhere[1])


def of_silent_inputs(solution: Solution, settings: Settings,
                     again: Callable[[Settings, bool], Solution | None]) -> Solution:
    """
    Return the model of inputs as they act while they are silent, where that explains more.

    A timeout stops them, or what was sent is lost. `again` identifies the records with other
    settings, and divided where commands are lost. A timeout that was given and is another one, or
    that no model confirms, is a doubt.
    """
    timed, stops = _with_timeouts(solution, settings, again)
    whole, lost = solution.part.parts[0].whole, lost_inputs(timed)
    known, unknown = timed.settings.timeouts(whole.nu), settings.unknown_timeouts(whole.nu)
    divided = [again(each, True) for each in dict.fromkeys((
        settings, settings.replace(timeout=known))) if lost]
    found = min((one for one in divided if one and one.simulated), key=_unexplained, default=timed)
    known = found.settings.timeouts(whole.nu)
    doubts = (_doubt(name, seconds) for channels, name, seconds in stops
              if not lost or timed is solution
              if abs(seconds - known[channels.start]) > APART * seconds)
    choices = (Choice('timeout', round(known[k.start], 4), f'of input {", ".join(names)}: so long '
                      'after a message it counts as 0, which explains more')
               for k in channel_slices(whole.inputs) for names in [whole.input_names[k]]
               if unknown[k.start] and known[k.start])
    return replace(
        found, doubt=next(doubts, found.doubt), choices=(*found.choices, *choices),
        notes=(*found.notes, *in_words(whole.input_names, np.where(unknown, known, 0.0).tolist())))


def _with_timeouts(solution: Solution, settings: Settings,
                   again: Callable[[Settings, bool], Solution | None]
                   ) -> tuple[Solution, list[_Stop]]:
    """
    Return the model with timeouts that explains most, and all that seem to stop an input.

    They are looked for again with the model that they make: of what was held it was another one.
    """
    whole, best, stops, most = solution.part.parts[0].whole, solution, list[_Stop](), 1
    nu, unknown = whole.nu, settings.unknown_timeouts(whole.nu)
    for _ in range(_ROUNDS):
        seen, each = _stops(solution, best, settings, most), list(settings.timeouts(nu))
        for channels, _, seconds in seen:
            if unknown[channels.start]:
                each[channels] = [seconds] * len(each[channels])
        if best is solution:
            stops = seen
        if np.allclose(each, best.settings.timeouts(nu), rtol=_ALIKE, atol=0.0):
            if len(seen) < most or most == len(whole.inputs):
                break
            most += 1
            continue
        other = again(settings.replace(timeout=tuple(each)), False) if seen else None
        if other is None or not _explains_more(other, best):
            break
        stops, best = seen, other
        if best.part.parts[0].u != solution.part.parts[0].u:    # one that acts as it is silent
            break
    return best, stops


class _Stop(NamedTuple):
    """An input that acts as if it were 0 while it is silent."""

    channels: slice
    name: str
    seconds: float      # after a message


def _stops(solution: Solution, model: Solution, settings: Settings, most: int) -> list[_Stop]:
    """Return what seems to stop inputs, given the records as they are and a model of them."""
    parts, found = solution.part.parts, dict[int, float]()
    own, whole = channel_slices(parts[0].record.inputs), parts[0].whole
    with suppress(np.linalg.LinAlgError):
        if not solution.refit:
            samples, fit, free = _simulation(solution, settings)
            _, fit, free = model.simulated or (samples, fit, free)
            found = times_out(samples, fit, free, [p.u_level for p in parts], most)
    return [_Stop(channels, ', '.join(whole.input_names[channels]), seconds)
            for place, seconds in found.items() for channels in channel_slices(whole.inputs)
            if parts[0].u[own[place].start] in range(channels.start, channels.stop)]


def _doubt(name: str, seconds: float) -> Doubt:
    return (f'input {name} acts as if it were 0 from about {seconds:.2g} s after a message on, '
            'while it is silent: a timeout seems to stop the robot, or messages were lost',
            f'{name.partition(",")[0].partition("[")[0]}{TIMEOUT}{seconds:.2g}')


def _simulation(solution: Solution, settings: Settings) -> Fitted:
    """Return what simulates; of a plant that only predicts, which a timeout may feign, a lag."""
    if solution.simulated is not None:
        return solution.simulated
    samples = samples_of_part(solution.part, solution.samples.effort)
    free = replace(free_of(samples, own_delays(solution.part, settings)), feedthrough=False)
    return samples, fit_at(samples, np.array([-free.fastest ** 0.5 + 0j]), solution.delay,
                           free, slopes=False), free


def _unexplained(one: Solution) -> float:
    return np.inf if one.simulated is None else tried(*one.simulated).unexplained


def _explains_more(one: Solution, other: Solution) -> bool:
    if one.simulated is None or other.simulated is None:
        return _unexplained(one) < DISTURBED
    return beats(tried(*one.simulated), tried(*other.simulated))
