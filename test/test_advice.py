# SPDX-License-Identifier: Apache-2.0
"""Advice against truth: experiments as advised, and what they really make of the deviations."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from plants import PLANTS, Multisine, _stationary, match
import pytest

from ctsid_core import Estimate, Record, Settings, Signal, StateSpace, identify
from ctsid_core.advice.advice import Advice, Band, PoleAdvice, advise
from ctsid_core.errors import DataError
from ctsid_core.model.storage import load_estimate
from ctsid_ros.cli import main
from ctsid_ros.report.experiment import band_section

ROOT = Path(__file__).resolve().parent.parent
LENGTH = 10.0
FAST = 2 * np.pi * np.array([1.0, 5.0])  # rad/s: the band of the first experiment


def excitation(seed: int, band, t: np.ndarray) -> np.ndarray:
    """Return as much as there can be of a flat spectrum in a band, with rms 1 over the times."""
    rng = np.random.default_rng(seed)
    omega = np.linspace(*band, 40)
    u = Multisine(omega, np.exp(2j * np.pi * rng.uniform(size=(1, 40)))).at(t)
    return u / u.std()


def experiment(seed: int, parts, *, name: str, gusts: float, noise: float) -> Record:
    """
    Return a record of parts (size, band) of 10 s each, output at 200 Hz.

    The input is held at 1 kHz, so that its steps leave no kinks in the output worth mentioning.
    """
    p, rng = PLANTS[name], np.random.default_rng(1000 + seed)
    lead = 4000  # samples: so that it does not begin at rest
    rows = [size * excitation(17 * seed + i, band, np.arange(10000) / 1000)
            for i, (size, band) in enumerate(parts)]
    u = np.concatenate((rows[0][-lead:], *rows))
    t_u = (np.arange(len(u)) - lead) / 1000
    t_y = t_u[lead::5]
    truth = StateSpace(A=p.A, B=p.B, C=p.C, D=p.D)
    y = truth.simulate((Signal(t_u, u, 'zoh'),), np.concatenate((t_u[:1], t_y)))[1:]
    y = y + _stationary(rng, p.A, gusts ** 2 * p.B @ p.B.T + 1e-12 * np.eye(len(p.A)), 1 / 200,
                        len(t_y)) @ p.C.T
    y += noise * rng.standard_normal(y.shape)
    kept = t_u > -0.3
    return Record.from_arrays(t_u[kept], u[kept], t_y, y, input_hold='zoh')


CASES = {'measurement noise': {'name': 'hd51', 'gusts': 0.0, 'noise': 0.01},
         'process noise': {'name': 'shaken', 'gusts': 0.02, 'noise': 0.01}}


def settings(case) -> Settings:
    return Settings(order=len(PLANTS[case['name']].A), feedthrough=False, held_out=0.0)


@cache
def measured_fast() -> tuple[Record, Estimate]:
    """Return a record in the fast band, without gusts, and its estimate; nobody changes them."""
    case = CASES['measurement noise']
    record = experiment(0, [(1.0, FAST)], **case)
    return record, identify(record, settings(case))


def scatter(case, parts, seeds: int, pole: complex) -> float:
    """Return the root mean square error of a pole over runs."""
    truth, errors = PLANTS[case['name']].poles, []
    at = np.argmin(np.abs(truth - pole))
    for seed in range(seeds):
        found = identify(experiment(seed, parts, **case), settings(case))
        errors.append(match((found.model or found.rejected_model).poles, truth)[at] - truth[at])
    return float(np.sqrt(np.mean(np.abs(errors) ** 2)))


def forecast_of(case, seeds: int):
    """Return the median of what the first experiment of several runs forecasts of its first pole.

    The pole, the most helpful band, what that leaves of the deviation, and what twice the
    amplitude leaves.
    """
    found = []
    for seed in range(seeds):
        record = experiment(seed, [(1.0, FAST)], **case)
        estimate = identify(record, settings(case))
        one = advise(estimate, record).poles[0]
        found.append((one, advise(estimate, record, 0.5 * one.std / abs(one.pole)).poles[0]))
    band = found[0][0].bands[0]
    ratio = [next(b for b in p.bands if abs(b.low / band.low - 1) < 0.3).ratio for p, _ in found]
    return (np.median([p.pole for p, _ in found]), band, np.median(ratio),
            np.median([half.larger for _, half in found]))


def test_a_forecast_of_nothing_new_is_the_deviation_itself():
    case = CASES['process noise']
    record = experiment(0, [(1.0, FAST)], **case)
    estimate = identify(record, settings(case))
    advice = advise(estimate, record)
    poles = (estimate.model or estimate.rejected_model).poles
    for one in advice.poles:
        at = np.argmin(np.abs(poles - one.pole))
        assert one.std == pytest.approx(estimate.pole_std[at], rel=0.02)
        # What is not to first order, 0.16 % here, apart
        assert one.longer == pytest.approx(max((one.std / one.wanted) ** 2, 1.0), rel=2e-3)
        assert one.longer == pytest.approx(one.larger ** 2)
        assert [b.ratio for b in one.bands] == sorted(b.ratio for b in one.bands)
        assert all(0.0 < b.ratio <= 1.001 for b in one.bands)
        assert 0.2 < sum(b.share for b in one.bands) < 1.0  # beyond: faster than any pole
    little = advise(estimate, record, seconds=1e-6)
    assert all(b.ratio == pytest.approx(1.0, abs=1e-4) for p in little.poles for b in p.bands)


@pytest.mark.slow
@pytest.mark.parametrize('case', CASES.values(), ids=CASES)
def test_more_of_the_same_is_as_good_as_longer(case):
    """Excited in one band only, further excitation of that band doubles the information."""
    band = 2.8, 5.0
    for _ in range(3):  # the edges depend on the model found a little
        record = experiment(3, [(1.0, band)], **case)
        one = advise(identify(record, settings(case)), record).poles[0]
        near = min(one.bands, key=lambda b: abs(np.log(b.low * b.high / (band[0] * band[1]))))
        band = near.low, near.high
    assert near.share > 0.7
    assert near.ratio == pytest.approx(np.sqrt(0.5), rel=0.12)


def test_what_is_enough_gives_what_is_wanted():
    record, estimate = measured_fast()
    one = advise(estimate, record, wanted=0.01).poles[0]
    assert one.std > one.wanted
    assert one.larger == pytest.approx(one.std / one.wanted, rel=0.02)  # noise of measurement
    again = advise(estimate, record, wanted=0.01, seconds=one.enough).poles[0]
    best = next(b for b in again.bands if b.low == one.bands[0].low)
    assert best.ratio * one.std == pytest.approx(one.wanted, rel=0.02)
    words = advise(estimate, record, wanted=0.01).sentences
    assert f'Pole {one.pole.real:.3g}' in words[0]
    assert 'would divide it by' in words[0]
    assert 'no further data are needed' in advise(estimate, record, wanted=0.9).sentences[0]


def test_rejected_models_are_good_enough_for_advice_and_none_gets_a_word():
    rng = np.random.default_rng(1)
    record = experiment(0, [(1.0, FAST)], name='hd51', gusts=0.0, noise=20.0)
    estimate = identify(record, Settings(order=2, feedthrough=False))
    assert estimate.model is None
    assert len(advise(estimate, record).poles) >= 1
    t = np.arange(0.0, 10.0, 0.01)
    still = Record.from_arrays(t, np.ones(len(t)), t, rng.standard_normal(len(t)))
    advice = advise(identify(still), still)
    assert advice.poles == ()
    assert 'in which they move' in advice.sentences[0]
    assert 'move the inputs between 0.2 and 10 Hz' in advice.sentences[1]


def test_numbers_and_channels_have_to_fit():
    record, estimate = measured_fast()
    for wrong in ({'wanted': 0.0}, {'wanted': np.nan}, {'seconds': -1.0}):
        with pytest.raises(DataError, match='a positive number is wanted'):
            advise(estimate, record, **wrong)
    other = experiment(0, [(1.0, FAST)], **CASES['process noise'])
    wider = Record.from_signals(record.inputs * 2, other.outputs)
    with pytest.raises(DataError, match='2 input channels given'):
        advise(estimate, wider)


@pytest.mark.slow
def test_the_deviation_of_the_experiment_that_was_advised_is_as_foretold():
    """What the longer experiment itself says of its first pole; over many runs: below."""
    case, parts = CASES['measurement noise'], [(1.0, FAST)]
    record = experiment(0, parts, **case)
    one = advise(identify(record, settings(case)), record).poles[0]
    best = one.bands[0]
    found = identify(experiment(0, [*parts, (1.0, (best.low, best.high))], **case),
                     settings(case))
    now = found.pole_std[np.argmin(np.abs(found.model.poles - one.pole))]
    assert best.ratio < 0.6
    assert now / one.std == pytest.approx(best.ratio, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(('case', 'seeds'), [
    pytest.param(CASES['measurement noise'], 80, id='measurement noise'),
    pytest.param(CASES['process noise'], 80, id='process noise', marks=pytest.mark.xfail(
        reason='with more amplitude a simulation explains all but 5 %, and is taken instead of '
        'predictions, which scatter less: 0.75 of the deviation, 0.5 foretold'))])
def test_deviations_fall_as_foretold(case, seeds):
    """What is forecast of further excitation in a band, and of more amplitude, is what comes."""
    pole, band, ratio, larger = forecast_of(case, 10)
    now = scatter(case, [(1.0, FAST)], seeds, pole)
    chance = np.exp(2.6 * np.sqrt(1.0 / seeds))   # of a ratio of two deviations, 1 in 100 beyond
    allowed = max(1.3, chance)
    for what, parts, expected in (
            ('10 s in the best band', [(1.0, FAST), (1.0, (band.low, band.high))], ratio),
            ('twice as long', [(1.0, FAST), (1.0, FAST)], np.sqrt(0.5)),
            (f'{larger:.3g} times as large', [(larger, FAST)], 0.5)):
        measured = scatter(case, parts, seeds, pole) / now
        print(f'{what}: forecast {expected:.3f}, measured {measured:.3f}')
        least = 0.5 if what == 'twice as long' else 1.0 / allowed  # forecast as of two windows
        assert expected * least < measured < expected * allowed
    assert ratio < 0.6


@pytest.mark.slow
def test_an_order_that_is_far_too_large_ends_with_advice(tmp_path):
    """No root was found between 1 and how much more the input would have to move, 1e20 times."""
    bag, params = ROOT / 'bags/quadrotor_roll', ROOT / 'config/quadrotor_roll.yaml'
    (tmp_path / 'p.yaml').write_text(params.read_text().replace('order: 0', 'order: 12'))
    assert main(['identify', str(bag), '--params', str(tmp_path / 'p.yaml'),
                 '--out', str(tmp_path / 'out')]) == 0
    assert load_estimate(tmp_path / 'out/model.json').settings.order == 12


def test_poles_that_no_data_would_tell_get_the_advice_to_take_fewer():
    record, found = measured_fast()
    told = advise(replace(found, covariance=replace(
        found.covariance, root=1e8 * found.covariance.root)), record)
    assert any(np.isinf(p.longer) and np.isinf(p.larger) for p in told.poles)
    assert any('fewer states may do (`order`)' in sentence for sentence in told.sentences)


def test_more_data_never_make_a_pole_less_certain_in_the_table():
    """A covariance scaled by independent samples may say so, where states are too many."""
    bands = tuple(Band('u', low, 2.0 * low, 1.0, 0.5, ratio) for low, ratio in (
        (1.0, 0.5), (2.0, 1.27)))
    advice = Advice((PoleAdvice(-1.0 + 0j, 0.1, 0.05, 4.0, 2.0, bands, 1.0),), 10.0, ())
    table = band_section(advice).parts[1]
    assert [row[-1] for row in table.rows] == ['/ 2.00', '-']
