# SPDX-License-Identifier: Apache-2.0
"""The benchmark scripts run end to end, and their experiment is what they say. No times."""

from __future__ import annotations

import os
from pathlib import Path
import re
import subprocess
import sys

from marks import slow
import numpy as np
import pytest
from scipy.signal import lsim

from ctsid_core import Record, Settings, identify
from ctsid_core.subspace.ct_pbsid import reach

FOLDER = Path(__file__).resolve().parent.parent / 'benchmarks'


@pytest.fixture(scope='module')
def common():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        import common
        yield common
        for name in ('common', 'plain_laguerre'):
            sys.modules.pop(name, None)


def run(script: str, *options: object) -> str:
    done = subprocess.run(
        [sys.executable, FOLDER / script, *map(str, options)], capture_output=True, text=True,
        timeout=300, check=False, env=os.environ | {'PYTHONPATH': str(FOLDER.parent)})
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_floor_prints_a_row_for_every_size_and_judges_the_aim():
    printed = run('floor.py', '--counts', 200, 2000, '--orders', 40, 250, '--rounds', 1)
    rows = [line.split() for line in printed.splitlines() if line[:1].isdigit()]
    sizes = [(samples, nmax) for samples, nmax, *_ in rows]
    assert ('200', '40') in sizes
    assert ('2000', '250') in sizes
    assert ('200', '250') not in sizes       # beyond the Nyquist frequency
    assert [nmax.endswith('*') for samples, nmax in sizes].count(True) == 2
    assert 'BLAS threads: 1' in printed
    assert 'at 2000 samples, nmax 250' in printed
    assert 'at 10000 samples' not in printed


@pytest.mark.slow
def test_peers_ranks_this_project_and_names_what_is_missing():
    printed = run('peers.py', '--seeds', 1, '--aim-seeds', 2)
    rows = [re.split(r' {2,}', line) for line in printed.splitlines()
            if line.startswith('ctsid, ')]
    assert len(rows) == 4
    assert printed.count('order right in 100 % of 2 runs') == 2
    for name, first, second, *_ in rows:
        assert max(float(first), float(second)) < 0.5, name
    for module, title in (('ctrlsys', 'SLICOT'), ('nfoursid', 'nfoursid, '),
                          ('sippy_unipi', 'SIPPY')):
        skipped = f'Skipped: the module {module} is not installed.' in printed
        assert skipped != (f'\n{title}' in printed)


@pytest.mark.slow
def test_bursty_is_near_the_bound():
    printed = run('bursty.py', '--seeds', 2)
    row = next(line for line in printed.splitlines() if line.startswith('ctsid, order given'))
    assert max(map(float, row.split()[3:6])) < 4.0      # of two runs: not the efficiency
    skipped = 'Skipped: the module ctrlsys is not installed.' in printed
    assert skipped != ('\nSLICOT' in printed)


@pytest.mark.slow
def test_methods_prints_both_tables_and_judges_at_one_length_only():
    printed = run('methods.py', '--durations', 8, 6, '--rounds', 1, '--longest', 6)
    rows = [line for line in printed.splitlines() if re.match(r'(6|8) s ', line)]
    assert [line[0] for line in rows] == ['6', '8', '6', '8']
    assert len(re.split(r' {2,}', rows[0])) == 5
    assert rows[0].count('(') == 3
    assert rows[1].rstrip().endswith('-')            # nothing evaluated anew there
    assert printed.count('exponent') == 2
    assert 'Aim' not in printed
    assert 'BLAS threads: 1' in printed


@pytest.mark.parametrize(('snr', 'apart', 'keep'), [
    (20.0, 5e-3, True), *slow((20.0, 5e-3, False), (80.0, 2e-4, True), (80.0, 2e-4, False))])
def test_plain_laguerre_agrees_with_ct_pbsid(common, snr, apart, keep):
    """Two codes that share nothing, on the same noise, far closer than either is to the truth."""
    import plain_laguerre
    t = np.arange(4001) / 200.0
    u, y = common.sweep(t, 20.0), common.noisy(common.experiment(t, 20.0), snr, 0)
    given = Settings(method='ct-pbsid', order=2, laguerre_pole=10.0, past=4, held_out=0.0)
    estimate = identify(Record.from_arrays(t, u, t, y, input_hold='smooth'), given)
    found = plain_laguerre.poles(t, u[np.newaxis], y.T, order=2, a=10.0, past=4,
                                 length=reach(6) / 10.0, keep=keep)
    np.testing.assert_allclose(np.sort(found.real), np.sort(estimate.model.poles.real), rtol=0,
                               atol=apart)
    np.testing.assert_allclose(np.sort(found.real), [-4.0, -2.0], atol=0.2 if snr < 50 else 2e-3)


@pytest.mark.slow
def test_recordings_reads_every_container_as_rosbags_does():
    printed = run('recordings.py', '--messages', 2000, '--rounds', 1, '--containers', 'mcap lz4',
                  'sqlite3', 'ros1')
    rows = [line for line in printed.splitlines() if re.match('(mcap|sqlite3|ros1)', line)]
    assert len(rows) == 15
    assert not any('nan' in row for row in rows)


@pytest.fixture
def bursty():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        import bursty
        yield bursty
        for name in ('bursty', 'common', 'contenders'):
            sys.modules.pop(name, None)


def test_bursty_experiment_and_its_bound(bursty):
    """Held input, closed forms against a solver; the bound against scattered least squares."""
    t_u, t_y = np.arange(0.0, 2.0, 0.05), np.linspace(0.013, 1.93, 25)
    u = np.random.default_rng(0).standard_normal(len(t_u))
    x, slope = bursty.states(t_u, u, t_y)
    fine = np.arange(0.0, 2.0, 1e-4)
    held = u[np.minimum((fine / 0.05 + 1e-9).astype(int), len(u) - 1)]
    for j, pole in enumerate(bursty.POLES):
        step = np.exp(pole * 1e-4)
        path = np.zeros(len(fine), dtype=complex)
        for k in range(len(fine) - 1):
            path[k + 1] = step * path[k] + (step - 1.0) / pole * held[k]
        at = np.interp(t_y, fine, path.real) + 1j * np.interp(t_y, fine, path.imag)
        np.testing.assert_allclose(x[:, j], at, atol=1e-4)
    poles, moved = bursty.POLES, []
    for sign in (1.0, -1.0):
        bursty.POLES = poles + sign * 1e-5
        moved.append(bursty.states(t_u, u, t_y)[0])
    bursty.POLES = poles
    np.testing.assert_allclose(slope, (moved[0] - moved[1]) / 2e-5, atol=1e-8)


def test_bursts_are_as_they_are_said_to_be(bursty):
    for seed in range(20):
        step = np.diff(bursty.bursts(np.random.default_rng(seed)))
        assert np.count_nonzero(step > 1.0) == 2
        assert 1.0 / (np.sum(step[step < 1.0]) / len(step)) == pytest.approx(20.0, rel=0.25)
        assert np.median(step) == pytest.approx(1.0 / 60.0, rel=0.2)


def test_experiment_solves_its_differential_equation(common):
    t = np.linspace(0.0, common.DURATION, 20001)   # fine enough for straight lines between
    _, expected, _ = lsim((common.A, common.B[:, np.newaxis], common.C, np.zeros((2, 1))),
                          common.sweep(t), t)
    assert np.abs(common.experiment(t[::100]) - expected[::100]).max() < 1e-5


def test_sweep_rises_to_its_top_frequency(common):
    t = np.linspace(0.0, common.DURATION, 20001)
    crossings = t[1:][np.diff(np.sign(common.sweep(t))) != 0]
    assert len(crossings) == pytest.approx(common.TOP * common.DURATION, abs=2)  # mean: half
    assert 0.5 / (crossings[-1] - crossings[-2]) == pytest.approx(common.TOP, rel=0.02)


def test_noise_has_the_level_that_is_asked_for(common):
    y = common.experiment(np.linspace(0.0, common.DURATION, 4000))
    noise = common.noisy(y, 20.0, 3) - y
    np.testing.assert_allclose(y.var(axis=0) / noise.var(axis=0), 100.0, rtol=0.1)
    assert np.array_equal(common.noisy(y, 20.0, 3), common.noisy(y, 20.0, 3))


@pytest.mark.slow
def test_bound_is_reached_by_least_squares_on_the_sampled_responses(common):
    # An efficient estimator that uses no formula of the benchmark: the poles are moved one by
    # one, residues are refitted, and the curvature of the residual gives the information.
    t = np.linspace(0.0, common.DURATION, 500)
    y = common.experiment(t)
    weight = 1.0 / (y.std(axis=0) * 0.1)

    def misfit(poles):
        states = np.stack([lsim(([[p]], [[1.0]], [[1.0]], [[0.0]]), common.sweep(fine), fine)[1]
                           for p in poles], axis=1)[::5]
        return np.sum(((y - states @ np.linalg.lstsq(states, y, rcond=None)[0]) * weight) ** 2)

    fine, step = np.linspace(0.0, common.DURATION, 5 * 499 + 1), 0.02
    moves = step * np.eye(2)
    hessian = np.array([[sum(i * j * misfit(common.POLES + i * a + j * b)
                             for i in (-1, 1) for j in (-1, 1)) / (4 * step ** 2)
                         for a in moves] for b in moves])
    expected = np.sqrt(np.diag(np.linalg.inv(hessian / 2.0)))
    np.testing.assert_allclose(common.least_deviation(t, 20.0), expected, rtol=0.03)
