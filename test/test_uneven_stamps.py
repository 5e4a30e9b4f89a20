# SPDX-License-Identifier: Apache-2.0
"""Outputs whose stamps jitter, or are lost, where they are predicted from their own past."""

from dataclasses import replace

from marks import slow
import numpy as np
import pytest
from scipy.signal import lfilter

from ctsid_core import Grade, Record, Settings, Signal, identify
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.search.own_past import after_samples, lost_of, with_own_past
from ctsid_ros.studies.robots.inputs import drive
from ctsid_ros.studies.robots.linear import Held, Linear

POLE = 4.0 * np.exp(0.6j * np.pi)
PLANTS = tuple(Linear.of_roots(1.0, poles, 0.04) for poles in ((POLE, POLE.conjugate()), (-4.0,)))
OMEGA = np.array([1.0, 2.0, 4.0, 8.0])


def in_gusts(seed, plants, rates=(100.0,), jitter=0.0, lost=''):
    """Return a record of 30 s in gusts, stamps off an even grid by up to so many intervals."""
    rng = np.random.default_rng([seed, 31])
    held = np.arange(-1.0, 30.0, 0.02)
    u = drive(('multisine', 'pilot', 'staircase')[seed % 3], rng, held, 30.0, 1.3)
    u[held < 0] = 0.0
    gusts = lfilter([0.24], [1.0, -0.97], rng.standard_normal(u.shape), axis=0)
    outputs = []
    for k, plant in enumerate(plants):
        rate = rates[min(k, len(rates) - 1)]
        times = 0.02 + 0.0034 * k + np.arange(int(29.9 * rate)) / rate
        times += jitter / rate * rng.uniform(-1.0, 1.0, len(times))
        y = plant.move(Held(held, u + 0.25 * u.std() * gusts), times)
        y += 0.01 * y.std() * rng.standard_normal(y.shape)
        came = np.ones(len(times), dtype=bool)
        if lost == 'any':
            came = rng.uniform(size=len(times)) > 0.3
        elif lost == 'bursts':
            for first in np.cumsum(rng.integers(60, 200, 15)):
                came[first:first + rng.integers(5, 25)] = False
        outputs.append(Signal(times[came], y[came], 'smooth'))
    return Record((Signal(held, u.reshape(len(held), 1), 'zoh'),), tuple(outputs), 0.0, 30.0)


@pytest.mark.parametrize(('plants', 'rate', 'seeds'), [
    (PLANTS[:1], 100.0, 3), *slow((PLANTS[:1], 100.0, 6), (PLANTS, 100.0, 6),
                                  (PLANTS[:1], 30.0, 6), (PLANTS[1:], 100.0, 6))])
def test_a_jitter_of_stamps_is_not_taken_for_the_plant(plants, rate, seeds):
    """Responses in the band were 10 to 21 % too large, GOOD, up to six of their deviations off."""
    off, deviations = [], []
    for seed in range(seeds):
        found = responses(in_gusts(seed, plants, (rate,), jitter=0.4), plants)
        off.append(found[0])
        deviations.append(found[1])
    assert np.max(np.abs(np.median(off, axis=0))) < 0.08
    assert np.max(np.abs(deviations)) < 4.0


@pytest.mark.parametrize(('lost', 'seeds'), [('any', 3), *slow(('any', 5), ('bursts', 5))])
def test_samples_that_are_lost_are_not_taken_for_the_plant(lost, seeds):
    """Three in ten, or 5 to 24 at a time: responses were 10 % too large, 2.7 deviations off."""
    found = [responses(in_gusts(seed, PLANTS[:1], lost=lost), PLANTS[:1])
             for seed in range(seeds)]
    off, deviations = np.array(found).swapaxes(0, 1)
    assert np.max(np.abs(np.median(off, axis=0))) < 0.05
    assert np.max(np.abs(deviations)) < 3.5
    assert np.sqrt(np.mean(deviations ** 2)) < 1.3


@pytest.mark.slow
@pytest.mark.parametrize(('rates', 'seeds'), [
    ((100.0, 50.0), range(2)), *slow(((100.0, 50.0), range(12)), ((25.0, 100.0), range(12)))])
def test_outputs_of_several_rates_are_predicted_at_the_slowest(rates, seeds):
    """Five to seven states stood for the two that a predictor of both rates has not: 17 of 24."""
    found = [identify(in_gusts(seed, PLANTS, rates), Settings(feedthrough=False))
             for seed in seeds]
    assert sum(e.good for e in found) >= len(seeds) - (len(seeds) > 2)


@pytest.mark.slow
@pytest.mark.parametrize('rates', [(100.0, 50.0), (50.0, 100.0)])
def test_a_rate_that_changes_within_the_record_is_no_loss(rates):
    """All samples at the slower one come after a gap: without these few were left."""
    deviations = []
    for seed in range(6):
        halves = [in_gusts(seed, PLANTS[:1], (rate,)) for rate in rates]
        (first,), (second,) = (half.outputs for half in halves)
        came = first.time < 15.0, second.time > 15.0
        joined = Signal(*(np.concatenate([getattr(s, name)[rows] for s, rows in zip(
            (first, second), came, strict=True)]) for name in ('time', 'values')), 'smooth')
        found = responses(replace(halves[0], outputs=(joined,)), PLANTS[:1])
        deviations.append(found[1])
    assert np.sqrt(np.mean(np.square(deviations))) < 1.3


def responses(record, plants):
    """Return how far responses are off, over the truth, and over their deviations."""
    estimate = identify(record, Settings(feedthrough=False))
    assert estimate.verdict.grade is not Grade.REJECT
    model, std = estimate.model, estimate.frequency_response_std(OMEGA).magnitude[:, :, 0]
    truth = np.stack([p.response(OMEGA)[:, 0, 0] for p in plants], axis=1)
    off = np.abs(model.frequency_response(OMEGA)[:, :, 0] / truth) - 1.0
    return off, off / std


def evened(stamps, inputs=None):
    """Return stamps of outputs, and of an input, in the time of predictors."""
    stamps = [np.asarray(t) for t in stamps]
    inputs = np.append(stamps[0][0] - 1.0, stamps[0][::5] + 3e-3 if inputs is None else inputs)
    rng = np.random.default_rng(0)
    record = Record((Signal(inputs, rng.standard_normal((len(inputs), 1)), 'zoh'),), tuple(
        Signal(t, rng.standard_normal((len(t), 1)), 'smooth') for t in stamps),
        min(t[0] for t in stamps), max(t[-1] for t in stamps))
    joint = with_own_past(samples_of([record], [(None,) * len(stamps)]))
    found, = joint.records
    return [s.times for s in found.streams], found.inputs[0].time[1:]


def jittering(count=400, by=0.3, seed=0):
    return 0.01 * (np.arange(count) + by * np.random.default_rng(seed).uniform(-1, 1, count))


def test_stamps_are_as_even_as_samples_and_keep_their_order_with_inputs():
    stamps = jittering()
    inputs = np.sort(np.concatenate((stamps[::5] + 1.5e-3, stamps[2::7] - 1.2e-3)))
    (times,), moved = evened([stamps], inputs)
    assert np.std(np.diff(times)) < 0.05 * np.std(np.diff(stamps))
    np.testing.assert_allclose(times, stamps, atol=0.01)
    np.testing.assert_array_equal(np.searchsorted(moved, times, side='right'),
                                  np.searchsorted(inputs, stamps, side='right'))
    np.testing.assert_array_equal(np.argsort(moved), np.arange(len(moved)))


def test_no_sample_comes_before_the_start_by_rounding():
    """Responses to curves there were 1e211, and the identification ended in a traceback."""
    for seed in range(40):
        stamps = [t - t[0] for t in (jittering(seed=seed), jittering(200, seed=50 + seed) * 2.0)]
        for times in evened(stamps)[0]:
            assert times[0] >= 0.0


def test_samples_of_an_input_s_instant_stay_there():
    """In closed loop what is before that input is another sample."""
    stamps = [jittering(seed=1), 0.003 + jittering(seed=2)]
    inputs = np.sort(np.concatenate((stamps[0][9::20], stamps[1][4::20])))
    times, moved = evened(stamps, inputs)
    for even, own in zip(times, stamps, strict=True):
        at = np.isin(own, inputs)
        np.testing.assert_allclose(even[at], moved[np.isin(inputs, own)], atol=1e-12)
        np.testing.assert_array_equal(np.searchsorted(moved, even + 1e-9),
                                      np.searchsorted(inputs, own + 1e-9))


def test_a_sample_just_after_an_input_is_put_to_its_instant():
    stamps = jittering()
    (times,), moved = evened([stamps], stamps[3::10] - 5e-4)
    np.testing.assert_allclose(times[3::10], moved, atol=1e-12)


def test_inputs_go_with_the_slowest_topic():
    stamps = [jittering(500, seed=1), 1.25 * jittering(seed=2)]
    times, moved = evened(stamps, stamps[1][::5] + 1e-3)
    assert np.all((moved - times[1][::5] > 2e-4) & (moved - times[1][::5] < 4e-3))
    times, moved = evened([stamps[0], stamps[0][200:201] + 4e-3], stamps[0][::5] + 1e-3)
    assert np.std(np.diff(times[0])) < 0.2 * np.std(np.diff(stamps[0]))   # one sample is no topic


def test_two_topics_are_both_evened():
    stamps = [jittering(seed=1), 0.003 + jittering(seed=2)]
    inputs = np.arange(0.0, 4.0, 0.4) + 1e-3
    times, moved = evened(stamps, inputs)
    for even, own in zip(times, stamps, strict=True):
        assert np.std(np.diff(even)) < 0.2 * np.std(np.diff(own))
        assert np.all(np.diff(even) > 0.0)
        np.testing.assert_array_equal(np.searchsorted(moved, even, side='right'),
                                      np.searchsorted(inputs, own, side='right'))


@pytest.mark.parametrize('stamps', [
    0.01 * np.arange(300), np.array([0.0, 0.01]), np.array([5.0]),
    # Samples were lost, the rate changes, and there is a pause of a day
    0.01 * np.delete(np.arange(300), [70, 71, 150, 200, 201, 202, 250]),
    np.concatenate((0.01 * np.arange(200), 86400.0 + 0.02 * np.arange(200)))])
def test_even_stamps_stay_where_they_are(stamps):
    (times,), _ = evened([stamps])
    np.testing.assert_array_equal(times, stamps)


def test_a_rate_that_changes_changes_over_as_many_samples_as_predictions_go_ahead():
    stamps = np.concatenate((0.01 * np.arange(300), 3.0 + 0.02 * np.arange(300)))
    (times,), _ = evened([stamps])
    np.testing.assert_allclose(times[:240], stamps[:240], atol=1e-11)
    np.testing.assert_allclose(times[360:], stamps[360:], atol=1e-11)
    assert np.all(np.diff(times) > 0.0099)


def test_what_comes_just_after_a_gap_is_not_compared():
    stamps = 0.01 * np.delete(np.arange(100), [30, 31, 60])
    record = Record((Signal(np.array([-1.0, 0.5]), np.eye(2)[:, :1], 'zoh'),), (
        Signal(stamps, np.sin(stamps)[:, np.newaxis], 'smooth'),), 0.0, 0.99)
    joint = with_own_past(samples_of([record], [(None,)]))
    (lost,), = lost_of(joint)
    assert np.flatnonzero(lost).tolist() == [30, 31, 60]
    (compared,), = (r.streams for r in after_samples(joint).records)
    assert np.setdiff1d(stamps.round(3), compared.times.round(3)).tolist() == [0.32, 0.61]
    whole = with_own_past(samples_of([record.between(0.0, 0.29)], [(None,)]))
    assert not lost_of(whole)
    # Where all come after a gap it is another rate.
    stamps = np.concatenate((0.01 * np.arange(300), 3.0 + 0.02 * np.arange(200)))
    halved = replace(record, end=stamps[-1], outputs=(
        Signal(stamps, np.sin(stamps)[:, np.newaxis], 'smooth'),))
    joint = after_samples(with_own_past(samples_of([halved], [(None,)])))
    assert len(joint.records[0].streams[0].times) > 460
