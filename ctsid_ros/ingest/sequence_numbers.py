# SPDX-License-Identifier: Apache-2.0
"""Lost messages, counted by the sequence numbers that publishers give them."""

from __future__ import annotations

from collections.abc import Callable

_KEPT = 16  # publishers of one topic that are told apart


class SequenceNumbers:
    """
    Count the messages of one topic that were published but never arrived.

    Each publisher numbers its messages 1, 2, 3, ..., and the middleware hands the numbers on
    without saying whose they are. A number that continues a series belongs to it; one that is
    lower than all expected begins a new series (a publisher that started, or started again); one
    that is higher continues the nearest series, and what lies between was lost, unless there are
    more publishers than series: then it is the first that is heard of one of them. Of publishers
    that have gone the series remain; as many as there are publishers, those used last, count.

    Parameters
    ----------
    publishers : callable
        Returns the number of publishers of the topic now; asked at jumps only.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        self._publishers = publishers
        self._next: list[int] = []  # what each series continues with, the one used last first
        self.lost = 0

    def take(self, number: int) -> None:
        """Take the number of a message that arrived."""
        expected = self._next
        if expected and expected[0] == number:  # the ordinary case
            expected[0] = number + 1
            return
        if number in expected:
            expected.remove(number)
        elif any(first < number for first in expected):
            alive = max(self._publishers(), 1)
            nearest = max((first for first in expected[:alive] if first < number), default=0)
            if nearest and len(expected) >= alive:
                self.lost += number - nearest
                expected.remove(nearest)
        expected.insert(0, number + 1)
        del expected[_KEPT:]
