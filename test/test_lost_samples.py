# SPDX-License-Identifier: Apache-2.0
"""Samples that were lost, where outputs are predicted from their own past."""

import numpy as np

from ctsid_core import Settings, identify
from ctsid_core.search.own_past import carried_on
from ctsid_ros.studies.robots.families import experiment


def test_lost_samples_are_carried_on_by_those_before():
    times = np.array([0.0, 0.1, 0.2, 0.5, 0.6, 0.7])
    y = np.array([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0], [9.0, 1.0], [9.0, 1.0], [9.0, 1.0]])
    found, values = carried_on(times, y)
    np.testing.assert_allclose(found, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    # A straight line for as long as the last two are apart, then held; nothing of what comes.
    np.testing.assert_allclose(values[:, 0], [0.0, 1.0, 2.0, 3.0, 3.0, 9.0, 9.0, 9.0])
    np.testing.assert_array_equal(values[:, 1], 1.0)


def test_what_is_before_a_gap_is_all_that_tells():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.choice([0.1, 0.1, 0.1, 0.2, 0.31], 200)) + rng.uniform(0, 0.005, 200)
    y = rng.standard_normal((200, 2))
    found, values = carried_on(times, y)
    assert np.all(np.diff(found) > 0.0)
    assert np.max(np.diff(found[found >= times[1]])) < 0.15     # before two nothing tells
    np.testing.assert_array_equal(values[np.isin(found, times)], y)
    for k in (50, 120):
        other = y.copy()
        other[k:] += 5.0
        np.testing.assert_array_equal(carried_on(times, other)[1][found < times[k]],
                                      values[found < times[k]])


def test_samples_of_which_none_is_lost_stay_as_they_are():
    rng = np.random.default_rng(1)
    for count in (0, 1, 2, 3, 50):
        times = np.arange(count) * 0.1 + rng.uniform(-0.02, 0.02, count)
        y = rng.standard_normal((count, 1))
        found, values = carried_on(times, y)
        assert found is times
        assert values is y


def test_a_pause_is_not_filled():
    times = np.concatenate((np.arange(100) * 0.01, 1e5 + np.arange(100) * 0.01))
    found, values = carried_on(times, np.sin(times)[:, np.newaxis])
    assert len(found) == len(values) == 250
    assert np.max(found[found < 1e5]) < 1.6


def test_two_samples_that_came_just_after_an_input_stay_two():
    """Stamps of receipt: put to that input's instant, both had one stamp, which is an error."""
    found = identify(experiment('receipt-stamps', 1, 0).record, Settings(feedthrough=False))
    assert found.model is not None
