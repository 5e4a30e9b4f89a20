# SPDX-License-Identifier: Apache-2.0
"""Simulated time between the messages of /clock."""

from __future__ import annotations

from bisect import bisect_right

STEP_NS = 10**9  # times that step by more are of a clock that was set
_NOISE_NS = 10**7  # messages of /clock may be handed out in another order than they arrived
_MUCH = 10  # times as much as real time that passed, and as between the messages before
_KEPT = 4096  # messages of /clock that are remembered


class SimClock:
    """
    Turn times of arrival into simulated time.

    /clock comes at some tens of hertz, much more rarely than samples: between two of its messages
    time goes on evenly. What is held up on the way comes in a burst, /clock and samples alike:
    there the order of arrival tells the time, to within a message of /clock. After the last of
    them time goes on as fast as between the last two, but stops where the next is due, since the
    player may have been paused; so it does where the next goes back or leaps ahead. When the
    computer's clock is set back, all that was known of the time before is forgotten.
    """

    def __init__(self) -> None:
        self._arrivals: list[int] = []
        self._times: list[int] = []

    def tick(self, arrival_ns: int, time_ns: int) -> None:
        """Take a message of /clock: when it arrived and what it says [ns]."""
        newest_ns = self._arrivals[-1] if self._arrivals else 0
        if arrival_ns < newest_ns - _NOISE_NS:  # the computer's clock was set back
            self._arrivals, self._times = [], []
            newest_ns = 0
        self._arrivals.append(max(arrival_ns, newest_ns))
        self._times.append(time_ns)
        if len(self._arrivals) > 2 * _KEPT:
            del self._arrivals[:-_KEPT], self._times[:-_KEPT]

    def at(self, arrival_ns: int) -> int:
        """Return the simulated time at a time of arrival [ns]; 0 before the first tick."""
        last = bisect_right(self._arrivals, arrival_ns) - 1
        if last < 0:
            return 0
        if last + 1 < len(self._times) and not self._jumps(last):
            return self._between(last, arrival_ns)
        if last == 0 or self._jumps(last - 1):  # the rate is not known
            return self._times[last]
        return min(self._between(last - 1, arrival_ns),
                   2 * self._times[last] - self._times[last - 1])

    def _jumps(self, first: int) -> bool:
        """Return whether simulated time does not go on evenly from a message to the next."""
        passed = self._times[first + 1] - self._times[first]
        elapsed = self._arrivals[first + 1] - self._arrivals[first]
        before = self._times[first] - self._times[first - 1] if first else 0
        # A simulation may be a hundred times as fast as real time, but then it is so all along.
        return passed < 0 or passed > max(STEP_NS, _MUCH * elapsed, _MUCH * before)

    def _between(self, first: int, arrival_ns: int) -> int:
        """Return the time on the line through a message and the next."""
        elapsed = self._arrivals[first + 1] - self._arrivals[first]
        passed = self._times[first + 1] - self._times[first]
        # Those that came at the same nanosecond: the last of them counts.
        since = arrival_ns - self._arrivals[first]
        return self._times[first] + (since * passed // elapsed if elapsed else passed)
