# SPDX-License-Identifier: Apache-2.0
"""Whether the samples of a signal come from several publishers in turns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctsid_core.signals.record import Record, Signal


class Mixing:
    """
    Remember where samples of one publisher have those of another between them.

    A publisher that takes over from another, as after a restart, mixes nothing.
    """

    def __init__(self) -> None:
        self._publisher = self._stamp_ns = 0  # of the last sample
        self._last_ns: dict[int, int] = {}  # last stamp of each other publisher
        # Stamps of samples of one publisher, another, and the first again.
        self._turns: list[tuple[int, int, int]] = []

    def take(self, publisher: int, stamp_ns: int) -> None:
        """Take the stamp [ns] of a sample, and the number of its publisher."""
        if publisher != self._publisher:
            if publisher in self._last_ns:
                self._turns.append((self._last_ns[publisher], self._stamp_ns, stamp_ns))
            self._last_ns[self._publisher] = self._stamp_ns
            self._publisher = publisher
        self._stamp_ns = stamp_ns

    def take_rows(self, publishers: NDArray[np.int64], stamps_ns: NDArray[np.int64]) -> None:
        """Take many samples: the same as `take` of one after another."""
        ends = 1 + np.flatnonzero(np.diff(publishers, append=0))  # numbers begin at 1
        for first, end in pairwise((0, *ends.tolist())):
            self.take(int(publishers[first]), int(stamps_ns[first]))
            self._stamp_ns = int(stamps_ns[end - 1])

    def forget(self, before_ns: int) -> None:
        """Forget what no window from a time on [ns] needs."""
        if self._turns:
            self._turns = [turn for turn in self._turns if turn[0] >= before_ns]

    def since(self, start_ns: int) -> bool:
        """Whether publishers have taken turns since a time [ns]."""
        return any(turn[0] >= start_ns for turn in self._turns)

    def within(self, signal: Signal, record: Record) -> bool:
        """Whether samples of a signal are mixed within its record, those that were kept."""
        if not self._turns:
            return False
        inside = signal.time[signal.rows(record.start, record.end)]
        stamps = np.round(inside * 1e9).astype(np.int64) + record.epoch_ns
        return bool(np.isin(self._turns, stamps).all(axis=1).any())
