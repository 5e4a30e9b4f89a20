# SPDX-License-Identifier: Apache-2.0
"""Simulated time between the messages of /clock."""

from __future__ import annotations


class SimClock:
    """
    Turn times of arrival into simulated time.

    /clock comes at some tens of hertz, much more rarely than samples: between its messages time
    goes on as fast as between the last two, but stops where the next is due, since the player may
    have been paused.
    """

    def __init__(self) -> None:
        self._arrival = self._time = 0
        self._rate, self._period = 0.0, 0

    def tick(self, arrival_ns: int, time_ns: int) -> None:
        """Take a message of /clock: when it arrived and what it says [ns]."""
        passed, elapsed = time_ns - self._time, arrival_ns - self._arrival
        known = self._arrival > 0 and passed > 0 and elapsed > 0
        self._rate, self._period = (passed / elapsed, passed) if known else (0.0, 0)
        self._arrival, self._time = arrival_ns, time_ns

    def at(self, arrival_ns: int) -> int:
        """Return the simulated time at a time of arrival [ns]; 0 before the first tick."""
        ahead = (arrival_ns - self._arrival) * self._rate
        return max(self._time + min(round(ahead), self._period), 0)
