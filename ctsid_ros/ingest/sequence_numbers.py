# SPDX-License-Identifier: Apache-2.0
"""Lost messages, counted by the sequence numbers that publishers give them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

_KEPT = 16  # publishers of one topic that are told apart


class SequenceNumbers:
    """
    Count the messages of one topic that were published but never arrived.

    Each publisher numbers its messages 1, 2, 3, ..., and the middleware hands the numbers on
    without saying whose they are. A number that continues a series belongs to it; one that is
    lower than all expected begins a new series (a publisher that started, or started again); one
    that is higher continues the nearest series, and what lies between was lost, unless there are
    more publishers than series: then it is the first that is heard of one of them. Of publishers
    that have gone the series remain; as many as there are publishers, those used last, count. So
    a series is what is known of a publisher.

    Parameters
    ----------
    publishers : callable
        Returns the number of publishers of the topic now; asked at jumps only.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        self._publishers = publishers
        self._next: list[int] = []  # what each series continues with, the one used last first
        self._series: list[int] = []  # its number
        self._begun = 0
        self.lost = 0

    def take(self, number: int) -> int:
        """Take the number of a message that arrived; return that of its series."""
        expected = self._next
        if expected and expected[0] == number:  # the ordinary case
            expected[0] = number + 1
            return self._series[0]
        place = self._place(number)
        if place is None:
            self._begun += 1
            series = self._begun
        else:
            series = self._series.pop(place)
            del expected[place]
        expected.insert(0, number + 1)
        self._series.insert(0, series)
        del expected[_KEPT:], self._series[_KEPT:]
        return series

    def take_all(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Take many numbers: the same as `take` of one after another."""
        if self._next and len(numbers) and (
                np.diff(numbers, prepend=self._next[0] - 1) == 1).all():
            self._next[0] = int(numbers[-1]) + 1
            return np.full(len(numbers), self._series[0])
        return np.array([self.take(number) for number in numbers.tolist()], np.int64)

    def _place(self, number: int) -> int | None:
        """Return the place of the series that a number continues; None if it begins one."""
        expected = self._next
        if number in expected:
            return expected.index(number)
        if any(first < number for first in expected):
            alive = max(self._publishers(), 1)
            nearest = max((first for first in expected[:alive] if first < number), default=0)
            if nearest and len(expected) >= alive:
                self.lost += number - nearest
                return expected.index(nearest)
        return None
