# SPDX-License-Identifier: Apache-2.0
"""Advice against truth: experiments as advised, and what they really make of the deviations."""

import numpy as np
from plants import PLANTS, Multisine, _stationary, held_response, match
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.advice import advise

LENGTH = 10.0
FAST = 2 * np.pi * np.array([1.5, 6.0])  # rad/s: the band of the first experiment


def excitation(seed: int, band, t: np.ndarray) -> np.ndarray:
    """Return as much as there can be of a flat spectrum in a band, with rms 1 over the times."""
    rng = np.random.default_rng(seed)
    omega = np.linspace(*band, 40)
    u = Multisine(omega, np.exp(2j * np.pi * rng.uniform(size=(1, 40)))).at(t)
    return u / u.std()


def experiment(seed: int, parts, *, name: str, gusts: float, noise: float) -> Record:
    """Return a record of parts (size, band) of 10 s each, input held at 100 Hz, output 200 Hz."""
    p, rng = PLANTS[name], np.random.default_rng(1000 + seed)
    lead = 400  # samples: so that it does not begin at rest
    rows = [size * excitation(17 * seed + i, band, np.arange(1000) / 100)
            for i, (size, band) in enumerate(parts)]
    u = np.concatenate((rows[0][-lead:], *rows))
    t_u = (np.arange(len(u)) - lead) / 100
    t_y = np.arange(200 * LENGTH * len(parts) + 1) / 200
    y = held_response(p, t_u, u, t_y)
    y = y + _stationary(rng, p.A, gusts ** 2 * p.B @ p.B.T + 1e-12 * np.eye(len(p.A)), 1 / 200,
                        len(t_y)) @ p.C.T
    y += noise * rng.standard_normal(y.shape)
    kept = t_u > -0.3
    return Record.from_arrays(t_u[kept], u[kept], t_y, y, input_hold='zoh')


CASES = {'measurement noise': {'name': 'hd51', 'gusts': 0.0, 'noise': 0.05},
         'process noise': {'name': 'shaken', 'gusts': 0.05, 'noise': 0.01}}


def settings(case) -> Settings:
    return Settings(order=len(PLANTS[case['name']].A), feedthrough=False, held_out=0.0)


def scatter(case, parts, seeds: int) -> np.ndarray:
    """Return the root mean square errors of the poles over runs, in the order of the truth."""
    truth, errors = PLANTS[case['name']].poles, []
    for seed in range(seeds):
        found = identify(experiment(seed, parts, **case), settings(case))
        errors.append(match((found.model or found.rejected_model).poles, truth) - truth)
    return np.sqrt(np.mean(np.abs(errors) ** 2, axis=0))


def advised(case, seeds: int, wanted: float = 1e-3):
    """Return the advice of several runs of the first experiment."""
    for seed in range(seeds):
        record = experiment(seed, [(1.0, FAST)], **case)
        yield advise(identify(record, settings(case)), record, wanted)


@pytest.mark.parametrize('seeds', [
    pytest.param(30, id='few'), pytest.param(200, id='200', marks=pytest.mark.slow)])
@pytest.mark.parametrize('case', CASES.values(), ids=CASES)
def test_deviations_fall_as_foretold(case, seeds):
    """What is foretold of further excitation in a band, and of more amplitude, is what comes."""
    truth = PLANTS[case['name']].poles
    advice = list(advised(case, min(seeds, 30)))
    first = [a.poles[0] for a in advice]
    band = min(first[0].bands, key=lambda b: b.ratio)
    foretold = np.median([next(b for b in p.bands if abs(b.low / band.low - 1) < 0.3).ratio
                          for p in first])
    at = np.argmin(np.abs(truth - np.median([p.pole for p in first])))
    now = scatter(case, [(1.0, FAST)], seeds)[at]
    print(f'slowest pole {truth[at]:.3g}: foretold {np.median([p.std for p in first]):.3g}, '
          f'measured {now:.3g}; band {band.low:.3g} to {band.high:.3g} rad/s')
    measured = scatter(case, [(1.0, FAST), (1.0, (band.low, band.high))], seeds)[at] / now
    print(f'10 s in this band: foretold {foretold:.3f}, measured {measured:.3f}')
    assert foretold < 0.6
    assert 0.7 < measured / foretold < 1.3
    measured = scatter(case, [(1.0, FAST), (1.0, FAST)], seeds)[at] / now
    print(f'twice as long: foretold {np.sqrt(0.5):.3f}, measured {measured:.3f}')
    assert 0.7 < measured * np.sqrt(2) < 1.3
