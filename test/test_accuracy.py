# SPDX-License-Identifier: Apache-2.0
"""
Accuracy over Monte Carlo runs, with the figures that the project promises.

Some run with one seed or a few always, all with 100 if marked slow; `-s` prints the figures.
"""

from __future__ import annotations

from marks import slow
import numpy as np
from plants import PLANTS, asynchronous, flown, held, match, paper, running
import pytest

from ctsid_core import Settings, identify

HD52 = PLANTS['hd52'].poles                    # -1 - i, -1 + i, -5, but for rounding of A
SEEDS = [pytest.param(5, id='few'), pytest.param(100, id='100', marks=pytest.mark.slow)]
ONE = [pytest.param(1, id='one'), pytest.param(100, id='100', marks=pytest.mark.slow)]
PLAIN = Settings(order=3, refine=False)


def errors(experiment, truth, seeds, settings=None) -> np.ndarray:
    """Return the errors of the poles, one row per seed."""
    found = []
    for seed in range(seeds):
        estimate = identify(experiment(np.random.default_rng(seed)), settings)
        model = estimate.model or estimate.rejected_model
        assert model is not None, (seed, estimate.status)
        found.append(match(model.poles, truth) - truth)
        assert np.isfinite(found[-1]).all(), f'seed {seed}: too few poles, {model.poles}'
    return np.array(found)


def rmse(e) -> np.ndarray:
    return np.sqrt(np.mean(np.abs(e) ** 2, axis=0))


def show(what, e) -> None:
    deviation = np.std(e, axis=0, ddof=min(1, len(e) - 1))
    print(f'\n{what}, {len(e)} runs: RMSE {rmse(e).round(6)}, standard deviation '
          f'{deviation.round(6)}, bias {np.abs(e.mean(axis=0)).round(6)}, '
          f'worst {np.abs(e).max():.2g}')


# Table 1 of [HD], eigenvalues -5 and -1 +- i: plain subspace estimates. The paper's standard
# deviations are 0.0216 and 0.0063 (50 dB), 0.120 and 0.062 (20 dB), 0.375 and 0.212 (10 dB).


@pytest.mark.parametrize('seeds', SEEDS)
@pytest.mark.parametrize('settings', [
    pytest.param(PLAIN, id='automatic'),
    pytest.param(PLAIN.replace(nmax=300, beta=3.0, gamma=30.0), id='as in the paper')])
@pytest.mark.parametrize(('snr', 'fast', 'slow'), [
    (20, 0.065, 0.018), *slow((50, 0.0026, 0.0008), (10, 0.21, 0.06))])
def test_table_1_of_the_paper(snr, fast, slow, settings, seeds):
    e = errors(lambda rng: paper(rng, 'hd52', snr), HD52, seeds, settings)
    show(f'[HD] 5.2, {snr} dB, nmax {settings.nmax}', e)
    deviation, real = np.std(e, axis=0, ddof=1), np.abs(HD52.imag) < 0.5
    assert deviation[real].max() <= fast
    assert deviation[~real].max() <= slow


@pytest.mark.slow
@pytest.mark.parametrize(('snr', 'limit'), [(20, 0.05), (80, 0.0005), (50, 0.002)])
def test_windows_that_are_not_at_rest(snr, limit):
    """Straight lines between inputs, nothing set; smooth inputs: test_studies.py."""
    e = errors(lambda rng: running(rng, PLANTS['hd52'], snr, hold='linear'), HD52, 100)
    show(f'window not at rest, {snr} dB', e)
    assert rmse(e).max() < limit


@pytest.mark.parametrize('seeds', ONE)
@pytest.mark.parametrize(('experiment', 'limit'), [
    pytest.param(lambda rng: asynchronous(rng, PLANTS['hd52'], 500.0, 200.0), 1e-3,
                 id='u 500 Hz, y 200 Hz', marks=pytest.mark.slow),
    # Straight lines are not what happened between these samples: of 8 Hz they lose 0.05 %.
    pytest.param(lambda rng: asynchronous(rng, PLANTS['hd52'], 500.0, 200.0, hold='linear'), 2e-3,
                 id='u 500 Hz linear, y 200 Hz', marks=pytest.mark.slow),
    pytest.param(lambda rng: asynchronous(rng, PLANTS['hd52'], 100.0, 60.0), 5e-3,
                 id='u 100 Hz, y 60 Hz'),
    pytest.param(lambda rng: held(rng, PLANTS['hd52'], 50.0, 200.0), 5e-3,
                 id='u held 50 Hz, y 200 Hz', marks=pytest.mark.slow)])
def test_own_stamps_without_noise(experiment, limit, seeds):
    """90 % jitter on every stamp."""
    e = errors(experiment, HD52, seeds, Settings(order=3))
    show(f'own stamps, limit {limit:g}', e)
    assert rmse(e).max() < limit


@pytest.mark.slow
def test_an_unstable_plant_under_its_controller():
    """One run is in test_identify.py."""
    truth = np.array([2.0, -3.0])
    e = errors(flown, truth, 100, Settings(feedthrough=False))
    show('unstable plant, no process noise', e)
    assert np.abs(e).max() < 0.02


@pytest.mark.slow
def test_accuracy_of_a_lightly_damped_structure():
    """Close to what maximum likelihood reached, 20 dB; over many runs: test_studies.py."""
    p = PLANTS['flexible']
    e = errors(lambda rng: running(rng, p, 20, rate=200.0, band=15.0), p.poles, 1)
    show('flexible structure, 20 dB', e)
    assert rmse(e).max() < 0.015
