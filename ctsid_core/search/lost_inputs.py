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

import numpy as np

from ctsid_core.likelihood.residuals import residuals
from ctsid_core.model.estimate import Choice
from ctsid_core.search.held import times_out
from ctsid_core.search.solution import TIMEOUT, Solution
from ctsid_core.search.tried import beats, tried
from ctsid_core.settings import Settings
from ctsid_core.signals.gaps import FEWEST, silences
from ctsid_core.signals.record import channel_slices

_MORE = 1.5           # times the error elsewhere: what was sent last did not go on
_TRIES = 4            # timeouts that are looked for: one more for each input, or a better one
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


def with_timeouts(solution: Solution, settings: Settings,
                  again: Callable[[Settings], Solution | None]) -> Solution:
    """
    Return the model of inputs that a timeout stops, where these explain more than what was held.

    `again` identifies the records with other settings. Where the timeout is given, the budget is
    spent, or the model errs where inputs are silent, it is a doubt.
    """
    unknown = settings.unknown_timeouts(solution.part.parts[0].whole.nu)
    found: dict[str, float] = {}
    for _ in range(_TRIES):
        channels, name, seconds = _stop(solution)
        if not name:
            break
        each = np.array(settings.timeouts(len(unknown)))
        apart = abs(seconds - each[channels.start]) > _APART * seconds
        each[channels] = seconds
        changed = settings.replace(timeout=tuple(each.tolist()))
        other = again(changed) if unknown[channels.start] else None
        if other is None or lost_inputs(other) or not _explains_more(other, solution):
            doubt = (f'input {name} acts as if it were 0 from about {seconds:.2g} s after a '
                     'message on, while it is silent: a timeout seems to stop the robot, or '
                     'messages were lost', f'{name.partition("[")[0]}{TIMEOUT}{seconds:.2g}')
            solution = replace(solution, doubt=doubt) if apart else solution
            break
        settings, solution, found[name] = changed, other, seconds
    return replace(solution, choices=(*solution.choices, *(
        Choice('timeout', round(seconds, 4), f'of input {name}: what is 0 so long after a message '
               'explains more than what goes on') for name, seconds in found.items())))


def _stop(solution: Solution) -> tuple[slice, str, float]:
    """Return the channels of an input that acts as if it were 0 while silent, and from when on."""
    parts = solution.part.parts
    found = None if solution.simulated is None or solution.refit else \
        times_out(*solution.simulated, [p.u_level for p in parts])
    if found is None:
        return slice(0), '', 0.0
    first = parts[0].u[channel_slices(parts[0].record.inputs)[found[0]].start]
    channels = next(c for c in channel_slices(parts[0].whole.inputs) if first < c.stop)
    return channels, parts[0].whole.input_names[first], found[1]


def _explains_more(one: Solution, other: Solution) -> bool:
    return one.simulated is not None and other.simulated is not None and beats(
        tried(*one.simulated), tried(*other.simulated))
