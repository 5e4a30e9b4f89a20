# SPDX-License-Identifier: Apache-2.0
"""
Whether an output jumps by itself.

A plant moves on from one sample to the next, and so does its simulation. Where the offset of a
sensor jumps (an estimator is reset, an encoder slips, a position is corrected), or something
strikes the robot, an output does not, and the errors jump as far, by more than anywhere else. A
plant that changes jumps nowhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctsid_core.likelihood.output_error import Fit
from ctsid_core.likelihood.residuals import residuals
from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.likelihood.state_space import input_jumps, mean_around
from ctsid_core.linear.types import Array

_MEAN = 5             # samples before, and after, whose means tell how far errors jump
_FEWEST = 20          # so many times them tell what else there is, at least
_ALONE = 2.2          # times as far as anywhere else (offsets of 0.4 of the motion and more, in
                      # gusts of up to 0.4: 2.4 to 12; where none jumps 2.0 at most), ...
_MATTERS = 0.2        # ... and of the motion
_AT_ONCE = 0.7        # of it from one sample to the next: what is pushed moves on
_SLOWER = 3.0         # times the usual interval, that samples are apart at most
_EDGE = 0.02          # of a record: so soon nobody knows what inputs have done before it


class OutputJump(NamedTuple):
    """Where an output jumps by itself."""

    record: int = -1        # its place; -1 if none does
    output: int = -1
    time: float = 0.0       # [s]
    size: float = 0.0       # over the size of the output


def jump_of_outputs(samples: Samples, fit: Fit) -> OutputJump:
    """Return the largest jump of an output that a model of these records does not explain."""
    found = OutputJump()
    for place, (record, own) in enumerate(zip(samples.records, residuals(samples, fit),
                                              strict=True)):
        for s, each in zip(record.streams, own, strict=True):
            for k, errors in enumerate(each.T):
                at, size = _standing_out(record, s.times, errors)
                if abs(size) > abs(found.size) and not _stepped(
                        record, fit.model.delay, *s.times[[at - _MEAN, at + _MEAN - 1]]):
                    steps = np.diff(errors[at - _MEAN:at + _MEAN]) * np.sign(size)
                    if np.max(steps) > _AT_ONCE * abs(size):
                        time = s.times[at - _MEAN + 1 + int(np.argmax(steps))]
                        found = OutputJump(place, s.channels.start + k, float(time), size)
    return found


def _standing_out(record: RecordSamples, times: Array, errors: Array) -> tuple[int, float]:
    """Return before which sample errors jump furthest, and how far; 0 if as far elsewhere."""
    if len(errors) < _FEWEST * _MEAN:
        return 0, 0.0
    at, mean = np.arange(_MEAN, len(errors) - _MEAN + 1), mean_around(errors, _MEAN // 2)
    far = mean[at + _MEAN // 2] - mean[at - _MEAN // 2 - 1]
    span = times[at + _MEAN - 1] - times[at - _MEAN]
    soon = np.abs(times[at] - 0.5 * (record.start + record.end)) > (
        0.5 - _EDGE) * (record.end - record.start)
    far[soon | (span > _SLOWER * np.median(span))] = 0.0        # or samples were lost
    best = int(np.argmax(np.abs(far)))
    elsewhere = np.max(np.abs(far[np.abs(at - at[best]) > _MEAN]), initial=0.0)
    alone = abs(far[best]) > max(_MATTERS, _ALONE * elsewhere)
    return int(at[best]), float(far[best]) * alone


def _stepped(record: RecordSamples, delay: Array, start: float, end: float) -> bool:
    """Return whether the one large step of an input acts then: an output may jump with it."""
    for j, late in enumerate(delay.tolist()):
        stamps, jumps = input_jumps(record.inputs, j)
        then = (stamps + late > start) & (stamps + late <= end)
        if np.max(np.abs(jumps[then]), initial=0.0) > 2.0 * np.max(
                np.abs(jumps[~then]), initial=0.0):
            return True
    return False
