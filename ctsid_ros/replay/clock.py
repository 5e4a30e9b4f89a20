# SPDX-License-Identifier: Apache-2.0
"""One clock on one page: what a verdict says of instants, after the start of the bag."""

from __future__ import annotations

from dataclasses import replace

from ctsid_core.model.estimate import Estimate
from ctsid_core.signals.gaps import by_clock
from ctsid_ros.recordings.bag import Bag

_DAY = 86_400 * 10**9   # [ns]: stamps further away are of another clock than the recording


def zero_ns(bag: Bag, stamp_ns: int) -> int:
    """Return what times are shown after: the start of the bag, or the stamp of another clock."""
    return bag.start_ns if abs(stamp_ns - bag.start_ns) < _DAY else stamp_ns


def by_bag_clock(estimate: Estimate, zero_ns: int) -> Estimate:
    """
    Return an estimate whose reason and notes count seconds as tables and axes do.

    Parameters
    ----------
    estimate : Estimate
        Its reason and notes count from the start of its own window.
    zero_ns : int
        What tables and axes count from [ns].
    """
    start = (estimate.start_ns - zero_ns) * 1e-9

    def told(text: str) -> str:
        return by_clock(text, start, 'the bag')

    return replace(estimate, notes=tuple(map(told, estimate.notes)), verdict=replace(
        estimate.verdict, reason=told(estimate.verdict.reason)))
