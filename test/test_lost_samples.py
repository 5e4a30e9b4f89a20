# SPDX-License-Identifier: Apache-2.0
"""Samples that were lost, where outputs are predicted from their own past."""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from ctsid_core import Record, Settings, Signal, StateSpace, identify
from ctsid_core.likelihood.noise_gain import continuous_gain
from ctsid_core.likelihood.output_error import Free, climb, fit_at
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.linear.types import plain_matrices
from ctsid_core.search.by_prediction import Compared, prediction_errors
from ctsid_core.search.own_past import carried_on, foretold, lost_of, with_own_past
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
    first = np.array([0.0, 0.3, 0.4, 0.5, 0.6])         # nothing tells what is after the first one
    assert carried_on(first, first[:, np.newaxis])[0] is first
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


def lossy(keep):
    """Return a record of two topics without noise, and the same with some samples lost."""
    rng = np.random.default_rng(4)
    t = 0.02 * np.arange(500)
    u = np.repeat(rng.standard_normal((50, 1)), 10, axis=0)
    held = Signal(np.append(-1.0, t[:-1] + 0.013), np.vstack((u[:1] * 0.0, u[:-1])), 'zoh')
    model = StateSpace(np.diag([-1.5, -6.0]), [[1.0], [5.0]], [[1.0, 0.2], [0.5, -1.0]])
    stamps = (t, t + 0.007)
    y = [model.simulate((held,), own)[:, i:i + 1] for i, own in enumerate(stamps)]
    return [Record((held,), tuple(
        Signal(own[kept], values[kept], 'smooth')
        for own, values, kept in zip(stamps, y, rows, strict=True)), 0.0, t[-1])
        for rows in ((slice(None),) * 2, keep)], y


def test_what_was_lost_is_told_exactly_by_a_predictor_that_errs_nowhere():
    """At once, however much was lost before: each value that is told moves all later ones."""
    rng = np.random.default_rng(1)
    keep = [rng.uniform(size=500) > 0.4, np.ones(500, dtype=bool)]
    keep[1][100:140] = keep[1][300:304] = False
    for kept in keep:
        kept[:4] = kept[-1] = True
    records, y = lossy(keep)
    whole, some = (samples_of([r], [(None, None)]) for r in records)
    size = whole.size                       # of the predictor
    some = with_own_past(replace(some, size=size, records=tuple(replace(r, streams=tuple(
        replace(s, y=s.y * some.size[i] / size[i]) for i, s in enumerate(r.streams)))
        for r in some.records)))
    whole = with_own_past(whole)
    free = Free(False, True, (False,) * 3, 0.0, -0.1, 100.0)
    fit = fit_at(whole, np.array([-3.0, -20.0], dtype=complex), np.zeros(3), free)
    fit = climb(whole, fit, free, steps=100)
    assert np.max(fit.power) < 1e-10
    lost, = lost_of(some)
    told, = foretold(some, fit, [lost]).records
    for i, (past, gone) in enumerate(zip(told.inputs[1:], lost, strict=True)):
        assert gone.sum() > 40
        truth = np.interp(past.time[gone], (0.0, 0.007)[i] + 0.02 * np.arange(500),
                          y[i][:, 0] / size[i])
        np.testing.assert_allclose(past.values[gone, 0], truth, atol=1e-4)


def test_predictions_go_on_where_samples_were_lost():
    """Corrected by lines through the last two they erred by 1.2 times as much as without gaps."""
    rng, h = np.random.default_rng(2), 0.02
    A, C = np.array([[0.0, 1.0], [-9.0, -2.0]]), np.array([[1.0, 0.0]])
    K = np.array([[20.0], [60.0]])
    F, G = expm(h * A), np.linalg.solve(A, expm(h * A) - np.eye(2))
    x, y = np.zeros(2), np.empty((3000, 1))
    for k in range(3000):
        e = 0.01 * rng.standard_normal(1)
        y[k] = C @ x + e
        x = F @ x + G @ K @ e
    t, keep = h * np.arange(3000), rng.uniform(size=3000) > 0.3
    still = Signal(np.array([-1.0, 0.0]), np.zeros((2, 1)), 'zoh')
    gain = continuous_gain(A, C, G @ K, h)
    m = replace(plain_matrices(A, np.zeros((2, 1)), C, np.zeros((1, 1))), K=gain)
    best, found = (prediction_errors(m, np.zeros(1), Compared(0, Record(
        (still,), (Signal(t[rows], y[rows], 'smooth'),), 0.0, t[-1]), (None,)))
        for rows in (slice(None), keep))
    assert found[0, 0] < 1.12 * best[0, 0]
