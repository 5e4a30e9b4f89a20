# SPDX-License-Identifier: Apache-2.0
"""Which parts of a large bag are looked at, so that the work is bounded."""

from __future__ import annotations

import numpy as np

from ctsid_ros.recordings.bag import Bag

MOST_BYTES = 2 << 30  # of files that are read at once: some seconds
_EXCERPT = 20.0  # s: shorter ones would show little of slow dynamics
_MOST_EXCERPTS = 24


def portions(bag: Bag, share: float = 1.0) -> list[tuple[float, float]]:
    """
    Return which parts of a bag to read [s after its start], evenly spread.

    Parameters
    ----------
    bag : Bag
    share : float, optional
        Of the bag: no more is wanted.
    """
    duration = (bag.end_ns - bag.start_ns) * 1e-9
    share = min(share, MOST_BYTES / max(bag.size, 1))
    if share >= 1 or duration < 2 * _EXCERPT:
        return [(0.0, duration)]
    count = int(np.clip(share * duration / _EXCERPT, 3, _MOST_EXCERPTS))
    length = min(max(share * duration / count, 1.0), duration / count)
    return [(float(start), float(start + length))
            for start in (np.arange(count) + 0.5) * duration / count - length / 2]
