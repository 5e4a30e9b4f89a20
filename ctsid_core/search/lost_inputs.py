# SPDX-License-Identifier: Apache-2.0
"""
Held inputs that fall silent: whether what they were sent last went on.

A stick, keys and goals are sent when they change, or while they do, and robots hold what was sent
last. A recorder that loses a topic, and a watchdog that stops the robot, look alike, but the model
errs there. Samples tell: the model of what is held is asked first.
"""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.residuals import residuals
from ctsid_core.search.solution import Solution
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
