# SPDX-License-Identifier: Apache-2.0
"""
Held inputs that fall silent: whether what they were sent last went on.

A stick, keys and goals are sent when they change, or while they do, and robots hold what was sent
last. Where a recorder has lost a topic the model errs while it is silent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ctsid_core.likelihood.residuals import residuals
from ctsid_core.search.solution import TIMEOUT, Solution
from ctsid_core.search.tried import tried
from ctsid_core.settings import Settings
from ctsid_core.signals.gaps import FEWEST, silences

_MORE = 1.5           # times the error elsewhere: what was sent last did not go on


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


def of_lost_inputs(solution: Solution, settings: Settings,
                   again: Callable[[Settings, bool], Solution | None]) -> Solution:
    """
    Return the model of records that are divided where commands are lost, if it is the better one.

    `again` identifies the records with other settings, and divided. What was sent last went on, as
    far as what acts of it says, unless the model errs clearly more there.
    """
    if not lost_inputs(solution):
        return solution
    given = settings.with_actuators(solution.settings.actuators(
        solution.part.parts[0].whole.nu))
    divided = [again(each, True) for each in dict.fromkeys((settings, given))]
    found = min((one for one in divided if one and one.simulated), key=_unexplained,
                default=solution)
    doubt = solution.doubt if solution.doubt and TIMEOUT in solution.doubt[1] else found.doubt
    return replace(found, doubt=doubt, deviations=solution.deviations)


def _unexplained(one: Solution) -> float:
    return np.inf if one.simulated is None else tried(*one.simulated).unexplained
