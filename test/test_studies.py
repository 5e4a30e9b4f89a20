# SPDX-License-Identifier: Apache-2.0
"""The studies at a few seeds; with all of them if slow. Figures: docs/accuracy.md."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from ctsid_core import Settings
from ctsid_ros.studies import closed_loop, table1, windows
from ctsid_ros.studies.experiments import flexible, flown, from_rest, quadrotor, running
from ctsid_ros.studies.monte_carlo import Outcome, of_poles, runs, summary


def chance(count: int) -> float:
    """Return a ratio that the RMSE of so many efficient estimates exceeds hardly ever."""
    return 1.0 + 3.0 / np.sqrt(2.0 * count)


def test_runs_start_from_the_state_they_say():
    """The bound needs it: the simulation from there is the measured output but for its noise."""
    for run in (from_rest(0, 50), running(1, 50, quadrotor()), running(2, 50, flexible(0.01))):
        y = run.model.simulate(run.record.inputs, run.y.time, run.x0)
        error = (run.y.values - y) / run.noise
        np.testing.assert_allclose(np.std(error, axis=0), 1.0, atol=0.1)


def test_the_reference_of_a_loop_does_not_depend_on_its_noise():
    a, b, c = flown(3, 0.2), flown(3, 0.2, noise_seed=1), flown(4, 0.2)
    ref = [run.u.values[:, 0] + 20.0 * run.y.values[:, 0] for run in (a, b, c)]
    same, other = (np.corrcoef(ref[0], x)[0, 1] for x in ref[1:])
    assert same > 0.9 > other


def test_published_figures_stand_beside_ours():
    done = [table1.one(seed, 20, Settings(order=3)) for seed in range(4)]
    rows = table1.lines(summary(done), 20)
    assert [row[1] for row in rows] == [name for name, _ in of_poles(quadrotor())]
    assert all(float(row[11]) < chance(4) for row in rows)
    assert rows[0][3:5] == ('0.00686', '0.00639')


def test_wrong_orders_are_counted_and_left_out():
    nothing = np.full(2, np.nan + 0j)
    right = Outcome(np.array([0.1, 0.2j]), np.ones(2), 2, 'OK')
    found = summary([right, right, Outcome(nothing, nothing.real, 3, 'UNEXPLAINED'), right])
    assert (found.right, found.ok) == (0.75, 0.75)
    np.testing.assert_allclose(found.rmse, [0.1, 0.2])


def test_several_processes_find_what_one_finds():
    task = partial(windows.one, name='quadrotor', snr=20)
    one, two = (runs(task, 2, 'test', jobs) for jobs in (1, 2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a.error, b.error, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize('snr', table1.SNRS)
def test_table_1(snr):
    found = summary(runs(partial(table1.one, snr=snr, settings=Settings(order=3)), 100, 'table 1'))
    assert found.right == 1.0
    assert (found.rmse <= 1.15 * table1.bound(snr)).all()
    assert max(table1.worst_ratio(found, snr, i) for _, i in of_poles(quadrotor())) <= 0.8


@pytest.mark.slow
@pytest.mark.parametrize(('name', 'snr'), windows.EXPERIMENTS)
def test_windows(name, snr):
    found = summary(runs(partial(windows.one, name=name, snr=snr), 100, name))
    limit = 1.2 if snr == 50 or 'flexible' in name else 1.1
    assert found.right >= 0.9
    assert (found.rmse <= limit * windows.bound(name, snr)).all()


@pytest.mark.slow
@pytest.mark.parametrize('q', closed_loop.LEVELS[1:])
def test_closed_loop(q):
    found = summary(runs(partial(closed_loop.one, q=q), 100, f'q = {q}'))
    assert found.right >= 0.95
    assert (found.bias < found.std).all()
    assert (found.rmse <= 1.3 * closed_loop.bound(q)).all()
