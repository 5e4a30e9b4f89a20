# SPDX-License-Identifier: Apache-2.0
"""Lost messages by sequence number, against publishers of which every message is known."""

import numpy as np
import pytest

from ctsid_ros.ingest.sequence_numbers import SequenceNumbers


def lost(numbers, publishers=1):
    counter = SequenceNumbers(lambda: publishers)
    for number in numbers:
        counter.take(number)
    return counter.lost


@pytest.mark.parametrize(('numbers', 'expected'), [
    ([], 0), ([1], 0), ([1, 2, 3], 0), ([7, 8, 9], 0),  # heard from the seventh on
    ([1, 2, 4, 5], 1), ([1, 2, 100], 97), ([1, 3, 5, 7], 3)])
def test_one_publisher(numbers, expected):
    assert lost(numbers) == expected


def test_a_publisher_that_starts_again():
    assert lost([1, 2, 3, 1, 2, 3, 4, 5]) == 0
    assert lost([1, 2, 3, 4, 5, 1, 2, 4, 5, 6, 7]) == 1
    assert lost([50, 51, 52, 1, 2, 3, 5]) == 1


def test_many_restarts_take_no_memory():
    counter = SequenceNumbers(lambda: 1)
    for _ in range(1000):
        for number in range(1, 4):
            counter.take(number)
    assert counter.lost == 0
    assert len(counter._next) <= 16


def test_a_series_is_told_for_each_message():
    counter = SequenceNumbers(lambda: 1)
    assert [counter.take(n) for n in (50, 51, 52, 1, 53, 2, 3, 54)] == [1, 1, 1, 2, 1, 2, 2, 1]


@pytest.mark.parametrize('seed', range(5))
def test_many_numbers_at_once_are_those_one_after_another(seed):
    rng = np.random.default_rng(seed)
    numbers = np.concatenate([np.arange(first, first + rng.integers(1, 9)) for first in
                              rng.integers(1, 30, 40)])
    at_once, single = SequenceNumbers(lambda: 1), SequenceNumbers(lambda: 1)
    parts = np.split(numbers, np.sort(rng.integers(0, len(numbers), 30)))
    assert np.concatenate([at_once.take_all(part) for part in parts]).tolist() == [
        single.take(number) for number in numbers.tolist()]
    assert at_once.lost == single.lost


@pytest.mark.parametrize('seed', range(5))
def test_two_publishers_in_any_order(seed):
    rng = np.random.default_rng(seed)
    counters, numbers = [0, 1000], []
    for who in rng.integers(0, 2, 500):
        counters[who] += 1
        numbers.append(counters[who])
    assert lost(numbers, publishers=2) == 0
    # While one of them has not been heard of, a jump may be the other's first message.
    kept = numbers[:20] + [n for n in numbers[20:] if rng.uniform() > 0.1]
    # The ends of both series cannot be known to be missing.
    inner = sum(1 for n in numbers if n not in kept
                and any(k < n for k in kept if (k > 1000) == (n > 1000))
                and any(k > n for k in kept if (k > 1000) == (n > 1000)))
    assert inner > 20
    assert lost(kept, publishers=2) == inner


def test_a_second_publisher_that_has_run_for_long():
    assert lost([1, 2, 3, 5000, 4, 5001, 5, 5002], publishers=2) == 0
