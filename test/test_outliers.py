# SPDX-License-Identifier: Apache-2.0
"""A few corrupt samples do not move the estimate; honest ones are not touched."""

from __future__ import annotations

from dataclasses import replace

from marks import slow
import numpy as np
from plants import (
    PLANTS,
    asynchronous,
    held,
    held_lag,
    held_response,
    match,
    noisy,
    paper,
    plant,
    random_plant,
)
import pytest
from scipy.linalg import expm

from ctsid_core import Record, Settings, identify
from ctsid_core.bases.preparation import usable, without_corrupt
from ctsid_core.model.validation import simulation
from ctsid_core.signals.spikes import spikes, within_range


def uneven(rng, count: int, rate: float = 200.0):
    return (np.arange(count) + 0.45 * rng.uniform(-1, 1, count)) / rate


def calm(t):
    return np.column_stack((np.sin(9.0 * t) + 0.4 * np.sin(21.0 * t), np.cos(3.0 * t)))


def spoilt(rng, record: Record, sigma, share: float, length: int) -> tuple[Record, list]:
    """Put bursts of equal errors of 10 to 1000 sigma into every output."""
    outputs, truth = [], []
    for signal, own in zip(record.outputs, sigma, strict=True):
        values, count = signal.values.copy(), len(signal.time)
        for j in range(signal.width):
            for _ in range(max(round(share * count / length), 1)):
                first = rng.integers(20, count - 30)
                values[first:first + length, j] += \
                    own[j] * 10.0 ** rng.uniform(1.0, 3.0) * rng.choice([-1, 1])
        outputs.append(replace(signal, values=values))
        truth.append(values != signal.values)
    return replace(record, outputs=tuple(outputs)), truth


def test_noise_is_not_corrupt():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        assert not spikes(uneven(rng, 10000), rng.standard_normal((10000, 3)), closely=True).any


HONEST = {
    'steps': lambda rng, t: np.repeat(rng.choice([-1.0, 0.0, 1.0], len(t) // 25 + 1),
                                      25)[:len(t)],
    'kinks': lambda rng, t: np.abs((3.0 * t) % 2.0 - 1.0),
    'counts': lambda rng, t: np.round(4.0 * np.sin(9.0 * t)),
    'fine counts': lambda rng, t: 0.01 * np.round(100.0 * np.sin(9.0 * t)),
    'held samples': lambda rng, t: np.sin(9.0 * t[(np.arange(len(t)) // 5) * 5]),
    'a burst of motion': lambda rng, t: np.exp(-(5.0 * (t - 3.0)) ** 2) * np.sin(60.0 * t)
    + 1e-3 * rng.standard_normal(len(t)),
    'noise that grows': lambda rng, t: rng.standard_normal(len(t)) * np.where(t > 5, 10.0, 1.0),
    'no noise': lambda rng, t: np.sin(20.0 * t),
    'at rest': lambda rng, t: np.where(np.abs(t - 4.0) < 0.5, np.sin(6.0 * t), 0.0),
}


@pytest.mark.parametrize('name', HONEST)
@pytest.mark.parametrize('closely', [False, True])
@pytest.mark.parametrize('seeds', [1, *slow(10)])
def test_honest_motions_are_not_corrupt(name, closely, seeds):
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        t = uneven(rng, 2000)
        assert not spikes(t, HONEST[name](rng, t)[:, np.newaxis], closely=closely).any


@pytest.mark.parametrize('length', [1, 5])
@pytest.mark.parametrize('size', [30.0, 1000.0])
def test_spikes_and_bursts_are_found_and_bridged(size, length):
    rng = np.random.default_rng(length)
    t = uneven(rng, 2000)
    clean = calm(t) + 0.01 * rng.standard_normal((2000, 2))
    values, where = clean.copy(), np.zeros((2000, 2), dtype=bool)
    for first in range(40, 1900, 100):
        where[first:first + length, 0] = True
    values[where] += 0.01 * size * np.repeat(rng.choice([-1, 1], 19), length)
    found = spikes(t, values)
    np.testing.assert_array_equal(found.mask, where)
    np.testing.assert_array_equal(found.instead[~where], clean[~where])
    assert np.std((found.instead - calm(t))[where]) < 0.02


@pytest.mark.slow
def test_an_output_that_follows_pulses_is_honest():
    """With feedthrough, a held pulse is a burst of the output; a spike beside it is not."""
    rng = np.random.default_rng(0)
    t_u, u = np.arange(-8.0, 10.0, 0.02), np.zeros((900, 1))
    u[rng.choice(900, 60, replace=False)] = rng.uniform(-10, 10, (60, 1))
    t = np.arange(0.005, 9.9, 0.005)
    y = noisy(rng, held_response(PLANTS['hd52'], t_u, u, t), 30)[:, 3:]
    kept = t_u > -0.5
    clean = identify(Record.from_arrays(t_u[kept], u[kept], t, y, input_hold='zoh'))
    assert clean.statistics['corrupt_samples'] == 0
    assert not any('far from their neighbours' in note for note in clean.notes)
    y[700] += 5.0 * np.std(y)
    found = identify(Record.from_arrays(t_u[kept], u[kept], t, y, input_hold='zoh'))
    assert found.statistics['corrupt_samples'] == 1
    assert f'at {t[700] - t[0]:.4g} s' in next(n for n in found.notes if 'corrupt' in n)
    assert found.model.n == clean.model.n
    assert found.model.D == pytest.approx(clean.model.D, rel=1e-3)


@pytest.mark.parametrize('feedthrough', [True, *slow(False)])
def test_what_a_model_explains_is_not_corrupt(feedthrough):
    """A rate bends where the torque jumps, by more than its noise."""
    rng, step = np.random.default_rng(1), expm(0.01 * np.array(
        [[0.0, 1.0, 0.0], [-20.0, -1.5, 40.0], [0.0, 0.0, 0.0]]))
    t, u, x = 0.01 * np.arange(6000), np.repeat(rng.standard_normal(300), 20), np.zeros((6001, 2))
    for k, value in enumerate(u):
        x[k + 1] = step[:2, :2] @ x[k] + step[:2, 2] * value
    y = x[:-1] + rng.standard_normal((6000, 2)) * [0.01, 0.03]
    record = Record.from_arrays(t, u[:, np.newaxis], t, y, input_hold='zoh')
    settings = Settings(feedthrough=feedthrough)
    looked = usable(record, settings)
    assert feedthrough or looked.corrupt_y[0].any         # its neighbours say so
    found = identify(record, settings)
    assert found.statistics['corrupt_samples'] == 0
    assert not any('corrupt' in note for note in found.notes)
    assert not any(c.value == 'disturbed' for c in found.choices)      # by nothing that matters
    spoiled = y.copy()
    spoiled[[500, 1000], [0, 1]] += [0.3, 3.0]
    found = identify(replace(record, outputs=(replace(record.outputs[0], values=spoiled),)),
                     settings)
    assert found.statistics['corrupt_samples.y1'] == found.statistics['corrupt_samples.y2'] == 1
    again = looked.with_honest([looked.corrupt_y[0].mask])
    assert not again.corrupt_y[0].any                     # as it was measured
    assert again.record.outputs[0].values == pytest.approx(
        record.outputs[0].values - looked.y_level, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize('seed', [1, 2])
def test_spikes_in_gusts_are_not_given_back(seed):
    """Errors that are large and smooth hide no spike that is smaller than six of them."""
    rng, step = np.random.default_rng(seed), expm(0.02 * np.array(
        [[0.0, 1.0, 0.0], [-9.0, -1.2, 9.0], [0.0, 0.0, 0.0]]))
    t, u, x = 0.02 * np.arange(3000), np.repeat(rng.standard_normal(150), 20), np.zeros((3001, 2))
    gust = 0.0
    for k, value in enumerate(u):
        gust = 0.98 * gust + 0.2 * rng.standard_normal()
        x[k + 1] = step[:2, :2] @ x[k] + step[:2, 2] * (value + 0.7 * gust)
    y = x[:-1, 0] + 0.01 * rng.standard_normal(3000)
    y[rng.choice(np.arange(30, 2970), 30, replace=False)] += 1.5 * np.std(y) * rng.choice(
        [-1, 1], 30)
    for settings in (Settings(), Settings(refine=False)):
        found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'), settings)
        assert found.statistics['corrupt_samples'] == 30


@pytest.mark.slow
def test_samples_are_not_given_back_where_a_budget_would_not_last_for_it():
    """A second search on what is left would be worse than the first."""
    record = held(np.random.default_rng(3), PLANTS['hd52'], 50.0, 200.0, snr=30)
    once = identify(record, Settings(feedthrough=False, budget=0.05))
    looked = usable(record, Settings(feedthrough=False))
    assert looked.corrupt_y[0].any
    assert once.statistics['corrupt_samples'] >= np.count_nonzero(looked.corrupt_y[0].mask)


@pytest.mark.parametrize(('pole', 'seeds'), [(-120.0, 1), *slow((-120.0, 3), (-400.0, 3))])
def test_jumps_of_a_fast_pole_are_told_from_spikes(pole, seeds):
    """The current of a motor jumps with the voltage, within one sample."""
    for seed in range(seeds):
        rng, t = np.random.default_rng(seed), np.arange(0.0, 15.0, 0.005)
        u = 3.0 * np.repeat(rng.integers(-2, 4, 30), 100)
        x, y = np.zeros(2), np.empty(len(t))
        decay = np.exp(np.array([-3.0, pole]) * 0.005)
        gains = np.array([0.3, 0.5])
        for k, value in enumerate(u):
            y[k] = gains @ x
            x = decay * x + (1.0 - decay) * value
        y += 0.02 * rng.standard_normal(len(t))
        spikes_at = np.sort(rng.choice(len(t), 5, replace=False))
        y[spikes_at] += rng.choice([-1, 1], 5) * rng.uniform(0.4, 1.5, 5)
        found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'),
                         Settings(feedthrough=False))
        assert found.statistics['corrupt_samples'] == 5
        told = next(note for note in found.notes if 'corrupt' in note)
        seen = told.partition(' not used: at ')[2].removesuffix(' s').split(', ')
        assert len(seen) >= 4                             # the other one by the model alone
        assert set(seen) <= {f'{v:.4g}' for v in t[spikes_at]}
        assert found.model.n == 2
        off = np.abs(np.sort(found.model.poles.real) - [pole, -3.0])
        assert (off < 4.0 * np.sort(found.pole_std)[::-1]).all()


EXPERIMENTS = {
    'from rest': lambda rng: paper(rng, 'hd51', 20),
    'little noise': lambda rng: paper(rng, 'hd51', 40),
    'asynchronous': lambda rng: asynchronous(rng, PLANTS['hd51'], 100.0, 150.0, snr=20),
    'several inputs': lambda rng: held(
        rng, random_plant(np.random.default_rng(5), 5, 2, 3), 50.0, 200.0, snr=20),
}
SNR = {'little noise': 40}


@pytest.mark.parametrize(('name', 'length'), [
    ('asynchronous', 1), *slow(
        ('from rest', 5), ('from rest', 1), ('little noise', 1), ('little noise', 5),
        ('asynchronous', 5), ('several inputs', 1), ('several inputs', 5))])
def test_corrupt_samples_do_not_move_the_estimate(name, length):
    rng = np.random.default_rng(3)
    record = EXPERIMENTS[name](rng)
    sigma = [np.std(s.values, axis=0) * 10 ** (-SNR.get(name, 20) / 20) for s in record.outputs]
    dirty, truth = spoilt(rng, record, sigma, 0.005, length)
    before, after = identify(record), identify(dirty)
    assert before.statistics['corrupt_samples'] == 0
    assert after.ok
    assert after.model.n == before.model.n
    moved = np.abs(match(after.model.poles, before.model.poles) - before.model.poles)
    assert (moved < before.pole_std).all()
    there = sum(mask.sum() for mask in truth)
    assert after.statistics['corrupt_samples'] == pytest.approx(there, abs=0.05 * there + 1)
    for output in record.output_names:
        assert any(f'output {output}: ' in note and 'corrupt' in note for note in after.notes)
        assert after.statistics[f'corrupt_samples.{output}'] >= 1


def test_a_clean_record_is_used_as_it_is():
    clean = paper(np.random.default_rng(1), 'hd51', 30)
    part = usable(clean, Settings(trim=False))
    assert part.record.outputs[0] is clean.outputs[0]


def test_many_far_samples_are_not_a_few_corrupt_ones():
    rng = np.random.default_rng(0)
    record = paper(rng, 'hd51', 30)
    signal = record.outputs[0]
    values = signal.values.copy()
    values[rng.choice(2001, 200, replace=False), 0] += 3.0 * np.std(values)
    spoiled = replace(record, outputs=(replace(signal, values=values),))
    estimate = identify(spoiled)
    assert any('not a few corrupt ones' in note for note in estimate.notes)
    np.testing.assert_array_equal(usable(spoiled, Settings(trim=False)).record.outputs[0].values,
                                  values)


@pytest.mark.parametrize(('hold', 'count'), [('smooth', 1), ('zoh', 0), ('linear', 0)])
def test_only_a_smooth_input_can_be_corrupt(hold, count):
    record = paper(np.random.default_rng(0), 'hd51', 30)
    signal = record.inputs[0]
    values = signal.values.copy()
    values[300] += 5.0
    part = usable(replace(record, inputs=(replace(signal, values=values, hold=hold),)),
                  Settings())
    assert np.count_nonzero(part.corrupt_u[0].mask) == count


@pytest.mark.parametrize('budget', [0.0, *slow(0.8)])
def test_pulses_that_an_output_follows_at_once_are_no_spikes(budget):
    """Within a budget no second search gives them back: D was 0, and 58 samples corrupt."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 20.0, 0.01)
    u, at = np.zeros(2000), rng.integers(5, 1990, 30)
    u[at] = 3.0 * rng.standard_normal(30)
    u[at + 1] = u[at]
    y = held_response(plant([[-20.0]], [[6.0]], [[1.0]], [[1.0]]), t, u[:, np.newaxis], t)[:, 0]
    found = identify(Record.from_arrays(t, u, t, y + 0.02 * rng.standard_normal(2000),
                                        input_hold='zoh'), Settings(budget=budget))
    assert found.statistics['corrupt_samples'] == 0.0
    assert found.model.D[0, 0] == pytest.approx(1.0, abs=0.01)


def test_what_only_the_model_tells_joins_what_neighbours_have_told():
    """One sample is 300 deviations off, another one 15: held jumps of the input hide that."""
    rng, t = np.random.default_rng(2), np.arange(0.0, 20.0, 0.02)
    u = np.repeat(rng.standard_normal(200), 5)
    y = held_response(plant([[-6.0]], [[6.0]], [[1.0]]), t, u[:, np.newaxis], t)[:, 0]
    y += 0.01 * rng.standard_normal(1000)
    y[[300, 700]] += 3.0, 0.15
    record = Record.from_arrays(t, u, t, y, input_hold='zoh')
    first = usable(record, Settings(feedthrough=False)).corrupt_y[0].mask
    assert np.flatnonzero(first).tolist() == [300]
    found = identify(record, Settings(feedthrough=False))
    assert found.statistics['corrupt_samples.y1'] == 2.0
    assert any(n.endswith('were not used: at 6, 14 s') for n in found.notes)


def test_pulses_that_a_model_explains_are_not_told_to_be_too_many_spikes():
    """A fast lag, 60 pulses of 2 samples: 6 % of the samples lie far from their neighbours."""
    rng, t = np.random.default_rng(1), np.arange(0.0, 20.0, 0.01)
    u, at = np.zeros(2000), rng.choice(np.arange(5, 1990, 3), 60, replace=False)
    u[at] = 3.0 * rng.standard_normal(60)
    u[at + 1] = u[at]
    y = held_response(plant([[-150.0]], [[150.0]], [[1.0]]), t, u[:, np.newaxis], t + 0.004)[:, 0]
    record = Record.from_arrays(t, u, t + 0.004, y + 0.02 * rng.standard_normal(2000),
                                input_hold='zoh')
    settings = Settings(feedthrough=False)
    assert usable(record, settings).corrupt_y[0].too_many == (0,)
    found = identify(record, settings)
    assert found.statistics['corrupt_samples'] == 0.0
    assert not any('lie far from their neighbours' in note for note in found.notes)


def jabs(rng, count: int, corrupt: float = 0.0):
    """Return a record of a lag of 0.4 s whose smooth input is jabbed, or has corrupt samples."""
    t, fine = np.arange(-1.0, 20.0, 0.05), np.arange(-1.0, 20.0, 0.0025)
    u = np.zeros(len(t))
    if count:
        u[rng.choice(np.arange(25, len(t) - 8), count, replace=False)] = rng.choice([-1, 1], count)
    else:
        u = np.convolve(rng.standard_normal(len(t)), np.ones(9) / 3.0, 'same')
    exact = np.interp(fine, t, u)[:, np.newaxis]
    ty = np.arange(0.0, 20.0, 0.02)
    y = held_response(plant([[-2.5]], [[2.5]], [[1.0]]), fine, exact, ty)[:, 0]
    y += 0.02 * np.std(y) * rng.standard_normal(len(y))
    u += 0.01 * rng.standard_normal(len(t))
    if corrupt:
        u[rng.choice(np.arange(25, len(t) - 8, 9), 8, replace=False)] += corrupt * rng.choice(
            [-1, 1], 8)
    return Record.from_arrays(t, u, ty, y, input_hold='smooth')


@pytest.mark.parametrize('budget', [0.5, *slow(0.0)])
@pytest.mark.parametrize('seed', [0, *slow(1, 2)])
def test_jabs_of_an_input_that_outputs_answer_are_no_spikes(seed, budget):
    """Without them an output moves for no reason: records like this were rejected."""
    record = jabs(np.random.default_rng(seed), 12)
    assert usable(record, Settings()).corrupt_u[0].any
    found = identify(record, Settings(budget=budget))
    assert found.statistics['corrupt_samples'] == 0.0
    assert found.model.frequency_response([1.0])[0, 0, 0] == pytest.approx(
        2.5 / (2.5 + 1.0j), rel=0.05)


@pytest.mark.parametrize('seed', [0, *slow(1, 2)])
def test_spikes_of_an_input_that_no_output_answers_are_bridged(seed):
    found = identify(jabs(np.random.default_rng(seed), 0, corrupt=12.0))
    assert found.statistics['corrupt_samples.u1'] == 8.0
    assert found.model.frequency_response([1.0])[0, 0, 0] == pytest.approx(
        2.5 / (2.5 + 1.0j), rel=0.05)


@pytest.mark.slow
def test_jabs_are_told_from_spikes_channel_by_channel():
    """Two axes of a stick in one message: one is jabbed, the other one has spikes."""
    rng = np.random.default_rng(5)
    stick, spiky = jabs(rng, 12), jabs(rng, 0, corrupt=12.0)
    u, other = (r.inputs[0] for r in (stick, spiky))
    y, more = (r.outputs[0] for r in (stick, spiky))
    found = identify(Record.from_arrays(
        u.time, np.hstack((u.values, other.values)), y.time, y.values + more.values,
        input_hold='smooth'))
    assert {name: count for name, count in found.statistics.items() if 'corrupt' in name} == {
        'corrupt_samples': 8.0, 'corrupt_samples.u2': 8.0}
    assert found.good


@pytest.mark.parametrize('places', [
    (0,), (0, 1), (1, 2), (3, 4), (499,), (498, 499), (497, 498), (495, 496)])
def test_samples_at_the_ends_have_neighbours_on_one_side(places):
    t, _, y = held_lag(np.random.default_rng(0), 0.002)
    y = y[:, np.newaxis]
    assert not spikes(t, y).any
    spiky = y.copy()
    spiky[list(places)] += 3.0
    found = spikes(t, spiky)
    assert np.flatnonzero(found.mask).tolist() == list(places)
    assert np.abs(found.instead - y).max() < 0.01 * 3.0


def test_a_step_before_the_end_is_none():
    """From the fourth last sample on it is a motion, as far as one side tells."""
    rng, t = np.random.default_rng(1), 0.02 * np.arange(500)
    for last in (4, 5, 6):
        y = np.cumsum(0.01 * rng.standard_normal(500)) + 2.0 * (t >= t[-last])
        assert not spikes(t, y[:, np.newaxis]).any


@pytest.mark.parametrize('shift', [0, 7, *slow(2)])
def test_a_kink_or_a_jump_at_the_ends_is_one_as_elsewhere(shift):
    t = uneven(np.random.default_rng(2), 2000)
    for name in ('kinks', 'steps'):
        y = HONEST[name](np.random.default_rng(2), t - t[0] + 0.001 * shift)
        assert not spikes(t, y[:, np.newaxis], closely=True).any


def test_a_last_sample_that_is_corrupt_does_not_spoil_a_model():
    t, u, y = held_lag(np.random.default_rng(0), 0.02)
    y[-1] = 30.0
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'), Settings())
    assert found.good
    assert found.model.poles == pytest.approx([-2.0], abs=0.05)
    assert any('1 of 500 samples stand out' in note for note in found.notes)


def under_levels(seed, span=20.0, turns=0.02):
    """Return instants, a command of two levels, and what a pair of poles makes of it."""
    rng = np.random.default_rng(seed)
    t, t_u = np.arange(0.0, span, 0.01), np.arange(0.0, span, 0.02)
    u = np.empty(len(t_u))
    now = 1.0
    for k in range(len(u)):
        now = -now if rng.uniform() < turns else now
        u[k] = now
    step = expm(0.01 * np.array([[0.0, 1.0, 0.0], [-36.0, -6.0, 36.0], [0.0, 0.0, 0.0]]))
    x = np.zeros((len(t), 2))
    for k in range(len(t) - 1):
        x[k + 1] = (step @ np.append(x[k], u[k // 2]))[:2]
    return rng, t, t_u, u, x[:, 0]


@pytest.mark.parametrize(('seed', 'noise'), [(0, 0.01), *slow(
    (1, 0.05), (3, 0.01), (4, 0.03), (6, 0.002))])
def test_a_sensor_that_is_clipped_is_read_within_its_range(seed, noise):
    """States imitated what was cut off, GOOD, with 66 % of another flight."""
    rng, t, t_u, u, y = under_levels(seed)
    measured = np.clip(y + noise * rng.standard_normal(len(t)), -0.8, 0.8)
    found = identify(Record.from_arrays(t_u, u, t, measured, input_hold='zoh'),
                     Settings(feedthrough=False))
    assert found.good, found.verdict.reason
    assert any('are at the end of its range' in note for note in found.notes)
    _, t, t_u, u, y = under_levels(seed + 100)
    other = Record.from_arrays(t_u, u, t, y, input_hold='zoh')
    assert simulation(found.model, other, trim='refit').fit[0] > 95.0


@pytest.mark.slow
def test_a_clipped_sensor_is_no_other_plant_on_data_kept_apart():
    """Samples at the end of the range count neither there: fits were 45 % for 96."""
    rng, t, t_u, u, y = under_levels(3, 60.0)
    y = np.clip(y + 0.02 * rng.standard_normal(len(t)), -0.8, 0.8)
    whole = Record.from_arrays(t_u, u, t, y, input_hold='zoh')
    found = identify(whole.between(0.0, 40.0))
    rest, notes = without_corrupt(whole.between(40.0, 59.9), Settings(), found.model)
    assert any('are at the end of its range' in note for note in notes)
    assert simulation(found.model, rest, trim='refit').fit[0] > 90.0


def ends(y):
    """Return how many samples are left out."""
    t = 0.01 * np.arange(len(y))
    kept, _ = within_range(Record.from_arrays(t, np.sin(t), t, y))
    return len(y) - len(kept.outputs[0].time)


def test_what_rests_or_switches_is_at_no_end_of_a_range():
    rng, t, _, _, y = under_levels(0)
    clipped = np.clip(y, -0.8, 0.8)
    assert ends(clipped) == np.count_nonzero(np.abs(y) >= 0.8)
    # At rest at 0, as a motor that only turns forward: that is where things rest.
    assert ends(np.maximum(clipped, 0.0)) == np.count_nonzero(y >= 0.8)
    # Of a valve hardly anything is between its ends.
    valve = np.repeat(np.tile([1.0, 2.0], 60), 50)
    valve[50::100], valve[51::100] = 1.4, 1.45
    assert ends(valve) == 0
    assert ends(np.concatenate((valve, 1.5 + 0.4 * np.sin(t)))) > 5000
    # What comes to rest does so by what the sensor resolves, to be left at once or not; once.
    resting = np.round(np.tile(1.0 - np.exp(-t[:400]), 5), 1)
    for values in (np.round(y, 2), np.round(np.sin(t), 1), resting, resting[::-1],
                   np.minimum(0.1 * t, 1.0), np.sin(t)):
        assert ends(values) == 0
    # A burst is shorter.
    burst = np.sin(t)
    burst[100:108] = 2.0
    assert ends(burst) == 0


@pytest.mark.parametrize(('seed', 'largest'), [
    (0, 3), *slow(*((seed, Settings().max_order) for seed in range(3)))])
def test_a_plant_that_strikes_a_stop_is_identified_with_that(seed, largest):
    """A cylinder's position: the model of the other samples explains these hardly better."""
    _, t, t_u, u, rate = under_levels(seed)
    y, now = np.empty(len(t)), 0.15
    for k, v in enumerate(rate):
        y[k] = now
        now = np.clip(now + 0.005 * v, 0.01, 0.3)
    assert ends(y) > 100
    found = identify(Record.from_arrays(t_u, u, t, y, input_hold='zoh'),
                     Settings(feedthrough=False, max_order=largest))
    assert not any('range' in note for note in found.notes)


@pytest.mark.parametrize(('seed', 'step'), [(1, 0.01), *slow((0, 0.0), (2, 0.0), (3, 0.05))])
def test_what_rests_is_not_at_the_end_of_its_range(seed, step):
    """A plant that comes to rest at the largest value, exactly or by what a sensor resolves."""
    _, t, t_u, u, y = under_levels(seed, turns=0.006)
    y = np.round(y / step) * step if step else y
    found = identify(Record.from_arrays(t_u, u, t, y, input_hold='zoh'),
                     Settings(feedthrough=False))
    assert found.good, found.verdict.reason
    assert not any('range' in note for note in found.notes)
