# SPDX-License-Identifier: Apache-2.0
"""Simulated time at a time of arrival: in step, after stalls, over jumps and pauses."""

import numpy as np
import pytest

from ctsid_ros.ingest.sim_clock import SimClock

S, MS = 10**9, 10**6
EPOCH = 1_700_000_000 * S
TICK = 4  # every so manyth event is a tick of /clock


def arrivals(stalls: list[tuple[int, int]], *, lost: bool) -> np.ndarray:
    """
    When the events of a simulation arrive [ns]: one each millisecond of it, at twice real time.

    At the events that stalls name nothing arrives for so many milliseconds. What is held up comes
    in a burst after it, whether sender or receiver slept; or, if `lost`, simulated time stood
    still meanwhile.
    """
    at = np.arange(4000) * MS // 2
    for event, length in stalls:
        at[event:] += length * MS
        if not lost:
            due = at[event:] - length * MS
            at[event:] = np.maximum(due, at[event] + 20_000 * np.arange(len(due)))
    return EPOCH + at + np.random.default_rng(0).integers(0, 10_000, len(at))


def stamped(at: np.ndarray, turn: int = 10 * MS, late: int = MS // 2) -> np.ndarray:
    """Return the stamps that the events have when ticks and messages are taken in turns."""
    clock, ticks, k = SimClock(), 0, 0
    stamps = np.zeros(len(at), dtype=np.int64)
    for now in range(int(at[0]), int(at[-1]) + 2 * turn, turn):
        while ticks < len(at) and at[ticks] <= now:
            clock.tick(int(at[ticks]), S + ticks * MS)
            ticks += TICK
        while k < len(at) and at[k] <= now - late:
            stamps[k] = clock.at(int(at[k]))
            k += 1
    return stamps


@pytest.mark.parametrize('lost', [False, True])
def test_stamps_after_stalls_are_those_of_the_ticks_around(lost):
    rng = np.random.default_rng(1)
    stalls = [(int(k) + int(rng.integers(0, 99)), int(rng.integers(20, 61)))
              for k in range(200, 3800, 200)]
    at = arrivals(stalls, lost=lost)
    truth = S + np.arange(len(at)) * MS
    error = abs(stamped(at) - truth)[2 * TICK:]
    assert error.max() <= TICK * MS
    assert error.mean() < 0.3 * MS


def test_stamps_without_stalls_are_exact_but_for_the_way():
    at = arrivals([], lost=False)
    error = abs(stamped(at) - (S + np.arange(len(at)) * MS))[2 * TICK:]
    assert error.max() < 0.1 * MS


def test_simulated_time_goes_on_between_ticks_and_stops_with_them():
    clock = SimClock()
    assert clock.at(EPOCH) == 0
    clock.tick(EPOCH, 10 * S)
    assert clock.at(EPOCH + 5 * MS) == 10 * S  # the rate is not known yet
    clock.tick(EPOCH + 20 * MS, 10 * S + 40 * MS)  # twice as fast
    assert clock.at(EPOCH + 25 * MS) == 10 * S + 50 * MS
    assert clock.at(EPOCH + 15 * MS) == 10 * S + 30 * MS
    assert clock.at(EPOCH + 900 * MS) == 10 * S + 80 * MS  # paused
    clock.tick(EPOCH + 1000 * MS, 2 * S)  # started again
    assert clock.at(EPOCH + 1001 * MS) == 2 * S


def test_what_arrived_before_a_jump_back_belongs_to_the_time_before():
    clock = SimClock()
    for k in range(3):
        clock.tick(EPOCH + k * 10 * MS, 10 * S + k * 10 * MS)
    clock.tick(EPOCH + 100 * MS, S)
    clock.tick(EPOCH + 110 * MS, S + 10 * MS)
    assert clock.at(EPOCH + 15 * MS) == 10 * S + 15 * MS
    assert clock.at(EPOCH + 25 * MS) == 10 * S + 25 * MS
    assert clock.at(EPOCH + 99 * MS) == 10 * S + 30 * MS  # where the next was due
    assert clock.at(EPOCH + 105 * MS) == S + 5 * MS


def test_what_arrived_before_a_jump_ahead_belongs_to_the_time_before():
    clock = SimClock()
    for k in range(2):
        clock.tick(EPOCH + k * 10 * MS, S + k * 10 * MS)
    for k in range(2, 4):
        clock.tick(EPOCH + k * 10 * MS, 500 * S + k * 10 * MS)
        assert clock.at(EPOCH + 15 * MS) == S + 15 * MS
        assert clock.at(EPOCH + 20 * MS) == 500 * S + 20 * MS
        assert clock.at(EPOCH + 25 * MS) == 500 * S + (20 if k == 2 else 25) * MS


def test_simulated_time_that_is_always_fast_does_not_jump():
    clock = SimClock()
    for k in range(4):
        clock.tick(EPOCH + k * 10 * MS, S + k * 5 * S)
    assert clock.at(EPOCH + 15 * MS) == S + 15 * S // 2
    assert clock.at(EPOCH + 35 * MS) == S + 35 * S // 2


def test_messages_of_clock_that_were_lost_are_no_jump():
    clock = SimClock()
    for at in (0, 10 * MS, 3 * S):
        clock.tick(EPOCH + at, S + at)
    assert clock.at(EPOCH + 2 * S) == 3 * S


def test_simulated_time_before_the_first_tick_is_not_known():
    clock = SimClock()
    clock.tick(EPOCH, 1)
    clock.tick(EPOCH + 10 * MS, 10 * MS)
    assert clock.at(EPOCH - 1) == clock.at(EPOCH - 50 * MS) == 0


def test_ticks_that_arrive_at_once_and_time_that_stands_still():
    clock = SimClock()
    for k in range(3):
        clock.tick(EPOCH, S + k * MS)
    assert clock.at(EPOCH) == clock.at(EPOCH + MS) == S + 2 * MS
    clock.tick(EPOCH + 2 * MS, S + 2 * MS)
    assert clock.at(EPOCH + MS) == clock.at(EPOCH + S) == S + 2 * MS


def test_a_clock_of_the_computer_set_back_begins_anew():
    clock = SimClock()
    for k in range(3):
        clock.tick(EPOCH + k * 10 * MS, 10 * S + k * 10 * MS)
    for k in range(3, 5):
        clock.tick(EPOCH - 3600 * S + k * 10 * MS, 10 * S + k * 10 * MS)
    assert clock.at(EPOCH - 3600 * S + 35 * MS) == 10 * S + 35 * MS
    assert clock.at(EPOCH - 3600 * S + 20 * MS) == 0
    clock.tick(EPOCH - 3600 * S + 39 * MS, 10 * S + 50 * MS)  # of another publisher
    assert clock.at(EPOCH - 3600 * S + 35 * MS) == 10 * S + 35 * MS


@pytest.mark.parametrize('back', [30 * MS, 500 * MS])
def test_a_clock_of_the_computer_set_back_by_little_begins_anew(back):
    clock = SimClock()
    for k in range(30):
        shift = back if k >= 25 else 0
        clock.tick(EPOCH - shift + k * 10 * MS, S + k * 10 * MS)
        if k > 25:
            assert clock.at(EPOCH - shift + k * 10 * MS - 5 * MS) == S + k * 10 * MS - 5 * MS
        if k not in (0, 25):  # where the rate is not known
            assert clock.at(EPOCH - shift + k * 10 * MS + 5 * MS) == S + k * 10 * MS + 5 * MS
    assert clock.at(EPOCH - back + 240 * MS) == 0


def test_only_so_many_ticks_are_kept():
    clock = SimClock()
    for k in range(20_000):
        clock.tick(EPOCH + k * MS, S + k * MS)
    assert clock.at(EPOCH + 19_000 * MS + 1) == 20 * S + 1
    assert clock.at(EPOCH + 1000 * MS) == 0
