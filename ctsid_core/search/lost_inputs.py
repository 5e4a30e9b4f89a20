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
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctsid_core.likelihood.residuals import residuals
from ctsid_core.model.estimate import Choice
from ctsid_core.search.held import times_out
from ctsid_core.search.solution import TIMEOUT, Doubt, Solution
from ctsid_core.search.tried import beats, tried
from ctsid_core.settings import Settings
from ctsid_core.signals.gaps import FEWEST, silences
from ctsid_core.signals.record import channel_slices
from ctsid_core.signals.timeouts import in_words

_MORE = 1.5           # times the error elsewhere: what was sent last did not go on
_ROUNDS = 6           # as often timeouts are looked for, unless they stay as they are ...
_ALIKE = 0.005        # ... to this part of them
_APART = 0.1          # of a timeout: nearer to what is given is no doubt


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
    known = timed.settings.timeouts(timed.part.parts[0].whole.nu)
    found = again(settings, True) or solution if lost_inputs(timed) else timed
    doubts = (_doubt(name, seconds) for channels, name, seconds in stops
              if found is timed or timed is solution
              if abs(seconds - known[channels.start]) > _APART * seconds)
    return replace(found, doubt=next(doubts, found.doubt))


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
        seen, each = _stops(solution, best, most), list(settings.timeouts(nu))
        found = [one for one in seen if unknown[one.channels.start]]
        for channels, _, seconds in found:
            each[channels] = [seconds] * len(each[channels])
        if best is solution:
            stops = seen
        if np.allclose(each, best.settings.timeouts(nu), rtol=_ALIKE, atol=0.0):
            if len(seen) < most or most == len(whole.inputs):
                break
            most += 1
            continue
        other = again(settings.replace(timeout=tuple(each)), False)
        if other is None or not _explains_more(other, best):
            break
        stops, best = seen, replace(
            other, notes=(*other.notes, *in_words(whole.input_names, each)), choices=(
                *other.choices, *(Choice('timeout', round(seconds, 4), f'of input {name}: so long '
                                         'after a message it counts as 0, which explains more')
                                  for _, name, seconds in found)))
    return best, stops


class _Stop(NamedTuple):
    """An input that acts as if it were 0 while it is silent."""

    channels: slice
    name: str
    seconds: float      # after a message


def _stops(solution: Solution, model: Solution, most: int) -> list[_Stop]:
    """Return what seems to stop inputs, given the records as they are and a model of them."""
    if solution.simulated is None or solution.refit or model.simulated is None:
        return []
    parts = solution.part.parts
    own, whole = channel_slices(parts[0].record.inputs), parts[0].whole
    found = times_out(solution.simulated[0], *model.simulated[1:], [p.u_level for p in parts],
                      most)
    return [_Stop(channels, ', '.join(whole.input_names[channels]), seconds)
            for place, seconds in found.items() for channels in channel_slices(whole.inputs)
            if parts[0].u[own[place].start] in range(channels.start, channels.stop)]


def _doubt(name: str, seconds: float) -> Doubt:
    return (f'input {name} acts as if it were 0 from about {seconds:.2g} s after a message on, '
            'while it is silent: a timeout seems to stop the robot, or messages were lost',
            f'{name.partition(",")[0].partition("[")[0]}{TIMEOUT}{seconds:.2g}')


def _explains_more(one: Solution, other: Solution) -> bool:
    return one.simulated is not None and other.simulated is not None and beats(
        tried(*one.simulated), tried(*other.simulated))
