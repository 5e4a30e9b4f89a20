# SPDX-License-Identifier: Apache-2.0
"""Whether the headers of a topic are of a clock that is faster or slower than that of the log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctsid_core.signals.record import Record

_SECOND_NS = 10**9  # of each the first message is looked at: more of them tell little more
DRIFT = 1e-3  # clocks of computers drift by less: 100 ppm are many
REAL_TIME = 0.05  # cheap ones by less: a simulation that is not in real time is far from it
_KEPT = 4096  # seconds, at most
_FEWEST = 6  # messages: of fewer a line tells no jitter
AHEAD = 0.02  # s, of headers before their messages come: clocks that are set by a network's
# differ by less
ON_THE_WAY = 0.2  # s: of one clock, messages of one topic take longer than of another by less
_NEWEST = 5  # messages that tell it


class HeaderClock:
    """Remember the times of the first message of each second, of one topic."""

    def __init__(self) -> None:
        self._pairs: list[tuple[int, int]] = []  # log and header [ns]

    @property
    def _next_ns(self) -> int:
        return (self._pairs[-1][0] // _SECOND_NS + 1) * _SECOND_NS

    def take(self, log_ns: int, header_ns: int) -> None:
        """Take the times of a message; a header of zero is none."""
        if header_ns and self._pairs and log_ns < self._pairs[-1][0]:
            self._pairs.clear()
        if header_ns and (not self._pairs or log_ns >= self._next_ns):
            self._pairs.append((log_ns, header_ns))

    def take_rows(self, log_ns: NDArray[np.int64], header_ns: NDArray[np.int64]) -> None:
        """Take many messages in order of log time: the same as `take` of one after another."""
        log_ns, header_ns = log_ns[header_ns != 0], header_ns[header_ns != 0]
        at = 0
        while at < len(log_ns):
            self.take(int(log_ns[at]), int(header_ns[at]))
            at = max(at + 1, int(np.searchsorted(log_ns, self._next_ns)))

    def forget(self, before_ns: int) -> None:
        """Forget what no window from a time on [ns] needs."""
        needed = sum(pair[0] >= before_ns for pair in self._pairs)
        self._pairs = self._pairs[-min(needed + _NEWEST, _KEPT):]

    def ahead(self, record: Record) -> float:
        """Return by how much the newest headers up to the end are ahead of the log, median [s]."""
        end = record.epoch_ns + round(record.end * 1e9)
        ahead = [header - log for log, header in self._pairs if log <= end][-_NEWEST:]
        return float(np.median(ahead)) * 1e-9 if ahead else 0.0

    def rate(self, record: Record, drift: float) -> float:
        """Return how fast the headers run within a record; 1 where it may be by a drift only."""
        start, end = (record.epoch_ns + round(t * 1e9) for t in (record.start, record.end))
        pairs = np.array([pair for pair in self._pairs if start <= pair[0] <= end])
        if len(pairs) < _FEWEST:
            return 1.0
        log, header = ((pairs - pairs[0]) * 1e-9).T
        line = np.polyfit(log, header, 1)
        # Whatever jitter does, or a jump, or headers of whole seconds: if they are never farther
        # from a line than so much, they turn it by no more than three times that, over its length.
        turned = 3.0 * np.max(np.abs(header - np.polyval(line, log))) / log[-1]
        return float(line[0]) if abs(line[0] - 1.0) > drift + turned else 1.0
