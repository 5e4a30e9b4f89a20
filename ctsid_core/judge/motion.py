# SPDX-License-Identifier: Apache-2.0
"""
How much outputs move in the time that an error is about.

One large step makes most of the standard deviation of a window, and errors of all that moves
besides look small over it; a prediction of the next hundredth of a second is right to 90 % for
what hardly moves in so short a time.
"""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.output_error import Residuals
from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.types import Array

PARTS = 10            # of each record, within which motion counts


def motion_within(samples: Samples, errors: Residuals) -> Array:
    """Return the rms of what a model moves around its mean in a tenth of a record, (ny,)."""
    squares = np.zeros(samples.ny)
    for record, own in zip(samples.records, errors, strict=True):
        edges = np.linspace(*record.span, PARTS + 1)[1:-1]
        for s, e in zip(record.streams, own, strict=True):
            for y in np.split(s.y - e, np.searchsorted(s.times, edges)):
                if len(y):
                    squares[s.channels] += len(y) * np.var(y, axis=0)
    return np.asarray(np.sqrt(squares / samples.counts.sum(axis=0)))


def motion_ahead(record: RecordSamples, errors: tuple[Array, ...], seconds: float) -> Array:
    """
    Return the rms of what a model moves by in so much time, over the motion, (ny,).

    Infinite where that cannot be told: in a shorter record, or of an output that does not move.
    """
    found = []
    for s, e in zip(record.streams, errors, strict=True):
        now = s.times <= record.end - seconds
        for y, measured in zip((s.y - e).T, s.y.T, strict=True):
            if not now.any() or not np.ptp(measured) > 0.0:
                found.append(np.inf)
                continue
            moved = np.interp(s.times[now] + seconds, s.times, y) - y[now]
            found.append(max(float(np.sqrt(np.mean(moved ** 2)) / np.std(measured)), 1e-300))
    return np.array(found)
