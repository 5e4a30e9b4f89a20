# SPDX-License-Identifier: Apache-2.0
"""Slow sensors that are sent again and again, and samples that arrive several at a time."""

from __future__ import annotations

from dataclasses import replace

from marks import slow
import numpy as np
from plants import held_response, plant
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.bases.preparation import without_corrupt
from ctsid_core.model.validation import simulation
from ctsid_core.signals.as_measured import as_measured
from ctsid_ros.studies.robots import families

PLANT = plant([[0.0, 1.0], [-36.0, -6.0]], [[0.0], [36.0]], [[1.0, 0.0]])
SETTINGS = Settings(feedthrough=False)


def moved(seed: int, rate: float = 100.0, noise: float = 0.02):
    """Return stamps and samples of random levels, and of an answer to them."""
    rng = np.random.default_rng(seed)
    t_u, t = np.arange(0.0, 12.0, 0.02), np.arange(0.0, 12.0, 1.0 / rate)
    u = np.repeat(rng.standard_normal(len(t_u)), 12)[:len(t_u), np.newaxis]
    y = held_response(PLANT, t_u, u, t)
    return t_u, u, t, y + noise * y.std() * rng.standard_normal(y.shape)


def record_of(t_u, u, t, y):
    return Record.from_arrays(t_u, u, t, y, input_hold='zoh')


def fit_elsewhere(found) -> float:
    """Return the fit of an estimate of another experiment without noise [%]."""
    return float(simulation(found.model, record_of(*moved(99, noise=0.0))).fit[0])


@pytest.mark.parametrize('seed', [1, *slow(2, 3)])
@pytest.mark.parametrize(('slow_rate', 'rate', 'least'), [
    (10.0, 100.0, 98.5), *slow((20.0, 200.0, 98.5), (5.0, 50.0, 98.5),
                               (33.0, 100.0, 96.5))])       # half a message late
def test_a_value_that_is_sent_again_counts_once(slow_rate, rate, least, seed):
    """They were GOOD with fits elsewhere of 60 to 95 %: samples held are not what a plant does."""
    t_u, u, t, y = moved(seed, slow_rate)
    often = np.arange(0.0, t[-1], 1.0 / rate)
    places = np.searchsorted(t, often + 1e-9, side='right') - 1
    first = np.append(True, np.diff(places) > 0)
    found = identify(record_of(t_u, u, often, y[places]), SETTINGS)
    once = identify(record_of(t_u, u, often[first], y[places][first]), SETTINGS)
    assert found.good
    np.testing.assert_allclose(found.model.A, once.model.A, rtol=1e-3)   # it ends a little later
    assert fit_elsewhere(found) > least
    assert any('times in a row' in note for note in found.notes)
    assert not any('times in a row' in note for note in once.notes)


def test_a_slow_column_beside_a_fast_one_is_a_signal_of_its_own():
    t_u, u, t, y = moved(1)
    slowly = y[np.arange(len(t)) // 10 * 10]
    record, notes = as_measured(record_of(t_u, u, t, np.hstack((slowly, y, 2.0 * slowly))))
    assert [len(s.time) for s in record.outputs] == [120, 1200, 120]
    np.testing.assert_array_equal(record.outputs[2].values, 2.0 * y[::10])
    assert record.output_names == ('y1', 'y2', 'y3')
    assert ['y1' in notes[0], 'y3' in notes[1]] == [True, True]
    assert as_measured(record) == (record, ())
    tested, told = without_corrupt(record_of(t_u, u, t, slowly), SETTINGS)
    assert len(tested.outputs[0].time) == 120
    assert told == (notes[0],)


def test_rest_is_kept_at_the_slower_rate():
    t_u, u, t, y = moved(1)
    slowly = y[np.arange(len(t)) // 10 * 10]
    slowly[300:700] = slowly[300]
    times = as_measured(record_of(t_u, u, t, slowly))[0].outputs[0].time
    assert len(times) == 120
    assert np.diff(times).max() < 0.11


T = np.arange(0.0, 12.0, 0.01)


@pytest.mark.parametrize('y', [
    np.floor(20.0 * T),                                     # an encoder at constant speed
    np.round(20.0 * np.sin(T)),                             # one that turns
    np.sign(np.sin(2.0 * np.pi * T)),                       # a switch
    np.round(8.0 * np.sin(3.0 * T) + 0.2 * np.random.default_rng(0).standard_normal(len(T))),
    np.repeat(np.random.default_rng(0).standard_normal(400), np.random.default_rng(1).integers(
        1, 6, 400))[:len(T)],                               # as it comes
    np.random.default_rng(0).standard_normal(len(T)), np.zeros(len(T))])
def test_what_is_coarse_is_not_slow(y):
    record = Record.from_arrays(T, np.cos(T), T, y, input_hold='zoh')
    assert as_measured(record) == (record, ())


def test_records_of_the_exam_are_as_they_were_measured():
    for family in families.FAMILIES:
        record = families.experiment(family, 3, 0).record
        assert as_measured(record)[0] is record, family


@pytest.mark.parametrize('seed', [1, *slow(2, 3)])
@pytest.mark.parametrize('size', [5, *slow(3, 10)])
def test_samples_that_arrive_together_are_put_back(size, seed):
    """They were GOOD with up to ten states, and fits elsewhere of 83 to 97 %."""
    t_u, u, t, y = moved(seed)
    last = np.minimum(np.arange(len(t)) // size * size + size - 1, len(t) - 1)
    arrived = t[last] + 0.0006 * (np.arange(len(t)) % size) + 0.004
    record, notes = as_measured(record_of(t_u, u, arrived, y))
    np.testing.assert_allclose(record.outputs[0].time[size:-size], t[size:-size] + 0.004,
                               atol=1e-9)
    assert f'about {size} at a time' in notes[0]
    assert as_measured(record) == (record, ())
    found = identify(record_of(t_u, u, arrived, y), SETTINGS)
    assert found.good
    assert found.model.n == 2
    assert fit_elsewhere(found) > 96.5


def test_a_burst_that_is_lost_is_not_spread_over():
    t_u, u, t, y = moved(1)
    kept = (np.arange(len(t)) // 5) % 40 != 7
    arrived = t[np.arange(len(t)) // 5 * 5 + 4] + 0.0006 * (np.arange(len(t)) % 5)
    record, _ = as_measured(record_of(t_u, u, arrived[kept], y[kept]))
    assert np.max(np.abs(record.outputs[0].time - t[kept])[5:]) < 0.021


@pytest.mark.parametrize('noise', [0.0, 0.2, 0.5])
def test_noise_does_not_make_an_arrival_of_what_is_measured_in_bursts(noise):
    """Five readings every 10 s were spread over these: 92 % of the truth, not 98."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        t = np.concatenate([k + 0.1 * np.arange(5) for k in np.arange(0.0, 2000.0, 10.0)])
        t_u, u = np.arange(0.0, 2000.0, 50.0), rng.standard_normal((40, 1))
        y = held_response(plant([[-0.01]], [[0.01]], [[1.0]]), t_u, u, t)
        record = record_of(t_u, u, t, y + noise * y.std() * rng.standard_normal(y.shape))
        assert as_measured(record) == (record, ())


@pytest.mark.parametrize('apart', [0.04, 0.001])
def test_pulses_and_corner_points_stay(apart):
    """Both were torn apart: seven states for one, and a false pair."""
    rng, at = np.random.default_rng(0), np.arange(0.5, 40.0, 1.0)
    t = np.sort(np.concatenate((at, at + apart)))
    pulses = np.where(np.arange(len(t)) % 2, 0.0, np.repeat(rng.uniform(1.0, 2.0, len(at)), 2))
    levels = np.repeat(rng.standard_normal(len(at) + 1), 2)[1:-1]
    for u in (pulses, levels):
        record = Record.from_arrays(t, u, T, np.cos(3.0 * T), input_hold='linear')
        assert as_measured(record) == (record, ())


def test_coarse_noise_is_not_twice_in_a_row():
    for seed in range(10):
        rng, t = np.random.default_rng(seed), np.arange(0.0, 20.0, 0.01)
        y = np.round(14.0 * np.sin(0.7 * t) + 0.3 * rng.standard_normal(len(t)))
        record = Record.from_arrays(t, np.cos(t), t, y, input_hold='zoh')
        assert as_measured(record) == (record, ())


def test_what_is_measured_in_bursts_stays():
    """The signal moves in the pauses; and what is sent as it changes comes in no regular ones."""
    t = np.concatenate([k + 0.001 * np.arange(6) for k in np.arange(0.0, 12.0, 0.3)])
    record = Record.from_arrays(t, np.sin(t), t, np.cos(3.0 * t), input_hold='zoh')
    assert as_measured(record) == (record, ())
    rng = np.random.default_rng(0)
    t = np.concatenate([k + 0.001 * np.arange(rng.integers(2, 12)) for k in np.arange(0, 12, 0.3)])
    noisy = Record.from_arrays(t, np.sin(t), t, rng.standard_normal(len(t)))
    assert as_measured(noisy) == (noisy, ())
    assert as_measured(replace(noisy, outputs=noisy.outputs[:0]))[1] == ()
