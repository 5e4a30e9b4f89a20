# SPDX-License-Identifier: Apache-2.0
"""Whether the headers of a topic are of a clock that is faster or slower than that of the log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctsid_core.signals.record import Record

_APART_NS = 10**9  # between the messages that are compared: the jitter of one is little beside it
_DRIFT = 1e-3  # clocks drift by less: 100 ppm are many
_SURE, _FEWEST = 5.0, 5  # standard deviations, intervals: jitter is no drift


class HeaderClock:
    """Remember the times of a message a second of one topic."""

    def __init__(self) -> None:
        self._pairs: list[tuple[int, int]] = []  # log and header [ns]

    def take(self, log_ns: int, header_ns: int) -> None:
        """Take the times of a message; a header of zero is none."""
        if self._pairs and log_ns < self._pairs[-1][0]:
            self._pairs.clear()
        if header_ns and (not self._pairs or log_ns >= self._pairs[-1][0] + _APART_NS):
            self._pairs.append((log_ns, header_ns))

    def take_rows(self, log_ns: NDArray[np.int64], header_ns: NDArray[np.int64]) -> None:
        """Take many messages in order of log time: the same as `take` of one after another."""
        log_ns, header_ns = log_ns[header_ns != 0], header_ns[header_ns != 0]
        at = 0
        while at < len(log_ns):
            self.take(int(log_ns[at]), int(header_ns[at]))
            at = max(at + 1, int(np.searchsorted(log_ns, self._pairs[-1][0] + _APART_NS)))

    def forget(self, before_ns: int) -> None:
        """Forget what no window from a time on [ns] needs."""
        self._pairs = [pair for pair in self._pairs if pair[0] >= before_ns]

    def rate(self, record: Record) -> float:
        """Return how fast the headers run within a record; 1 where they may be as fast."""
        start, end = (record.epoch_ns + round(t * 1e9) for t in (record.start, record.end))
        steps = np.diff([pair for pair in self._pairs if start <= pair[0] <= end], axis=0)
        if len(steps) < _FEWEST:
            return 1.0
        rates = steps[:, 1] / steps[:, 0]
        rate = float(np.median(rates))
        # 1.48: of a normal distribution; 1.25: a median scatters more than a mean
        std = 1.48 * 1.25 * float(np.median(np.abs(rates - rate))) / np.sqrt(len(rates))
        return rate if abs(rate - 1.0) > _DRIFT + _SURE * std else 1.0
