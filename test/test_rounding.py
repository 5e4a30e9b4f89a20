# SPDX-License-Identifier: Apache-2.0
"""Outputs of few values: what a model follows of their rounding it does not know of the plant."""

from marks import slow
import numpy as np
import pytest
from scipy.signal import lfilter

from ctsid_core import Grade, Record, Settings, identify
from ctsid_ros.studies.robots.linear import Held, Linear

DELAY = 0.02


def coarse(seed, levels, noise=0.0):
    """Return a pair of poles moved to and fro, rounded to steps of a share of its deviation."""
    rng = np.random.default_rng([seed, 99])
    pole = 8.0 * np.exp(0.6j * np.pi)
    plant = Linear.of_roots(1.0, (pole, pole.conjugate()), DELAY)
    held, times = np.arange(-1.0, 20.0, 0.02), np.arange(0.003, 20.0, 0.02)
    u = np.repeat(rng.choice([-1.0, 1.0], 70), 12 * rng.integers(1, 5, 70))[:len(held), np.newaxis]
    u[held < 0.0] = 0.0
    y = plant.move(Held(held, u), times)[:, 0]
    step = float(y.std()) / levels
    y = step * np.round(y / step + noise * rng.standard_normal(len(y)))
    return Record.from_arrays(held, u, times, y, input_hold='zoh'), plant, step


@pytest.mark.parametrize(('levels', 'seeds'), [(2.0, 2), *slow((1.2, 4), (2.0, 4))])
def test_gains_and_dead_times_are_unsure_as_rounding_makes_them(levels, seeds):
    """
    Of two-level inputs rounding repeats, and states follow it.

    Responses 6 % off were told to 0.7 %, a dead time of 0.078 s for 0.02 to 2 ms.
    """
    omega, off, late = np.array([2.0, 4.0, 8.0]), [], []
    for seed in range(seeds):
        record, plant, step = coarse(seed, levels)
        found = identify(record, Settings(feedthrough=False))
        model = found.model or found.rejected_model
        response = plant.response(omega)[:, 0, 0]
        unsure = found.frequency_response_std(omega).magnitude[:, 0, 0]
        off.append((np.abs(model.frequency_response(omega)[:, 0, 0] / response) - 1.0) / unsure)
        late.append((model.delay[0] - DELAY) / found.delay_std[0])
        notes = [note for note in found.notes if 'is measured in steps of' in note]
        assert notes
        assert f'steps of {step:.3g}, and the model follows these steps' in notes[0]
        assert 3.0 < float(notes[0].split('known to ')[1].split(' %')[0]) < 30.0
        assert found.dc_gain_std[0, 0] > 0.02
    assert np.sqrt(np.mean(np.square(off))) < 1.3
    assert np.sqrt(np.mean(np.square(late))) < 3.0


def test_a_fine_output_is_as_well_known_beside_a_coarse_one():
    """The dead time of an input that moves only the fine one was as unsure as the other's."""
    record, _, _ = coarse(1, 2.0)
    fine, _, _ = coarse(2, 1e4)
    noise = 0.01 * np.random.default_rng(3).standard_normal(len(fine.outputs[0].values))
    both = Record.from_arrays(
        record.inputs[0].time,
        np.column_stack([r.inputs[0].values for r in (record, fine)]), record.outputs[0].time,
        np.column_stack((1000.0 * record.outputs[0].values, fine.outputs[0].values
                         + noise[:, np.newaxis])), input_hold='zoh', output_names=('a', 'b'))
    found = identify(both, Settings(feedthrough=False))
    coarse_note, = [note for note in found.notes if 'is measured in steps' in note]
    assert coarse_note.startswith('output a is measured')
    late = [max(abs(rival.model.delay[k] - found.model.delay[k])
                for rival in found.covariance.rivals[-2:]) for k in range(2)]
    assert late[1] < 0.2 * late[0]
    model = found.model or found.rejected_model
    given = identify(both, Settings(feedthrough=False, delay=model.delay))
    assert not given.delay_std.any()


def test_a_model_that_follows_rounding_to_five_values_is_not_good():
    found = identify(coarse(1, 1.2)[0], Settings(feedthrough=False))
    assert found.verdict.grade is not Grade.GOOD
    assert 'for models that may be as right are' in found.verdict.reason


@pytest.mark.parametrize('seeds', [3, *slow(8)])
def test_rounding_of_what_does_not_repeat_is_noise(seeds):
    """Of 12 such records 8 were told to follow steps, by chance."""
    told = 0
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 98])
        held, times = np.arange(-1.0, 20.0, 0.02), np.arange(0.003, 20.0, 0.02)
        u = lfilter([1.0], [1.0, -0.9], rng.standard_normal(len(held)))[:, np.newaxis]
        u[held < 0.0] = 0.0
        y = Linear.of_roots(1.0, (-4.0,), DELAY).move(Held(held, u), times)[:, 0]
        step = float(y.std()) / 3.0
        found = identify(Record.from_arrays(held, u, times, step * np.round(y / step),
                                            input_hold='zoh'),
                         Settings(feedthrough=False, delay=DELAY))
        told += any('is measured in steps' in note for note in found.notes)
    assert told <= seeds // 8


@pytest.mark.parametrize(('levels', 'noise'), [(4.0, 1.0), *slow((40.0, 0.0))])
def test_rounding_below_noise_is_noise(levels, noise):
    found = identify(coarse(1, levels, noise=noise)[0], Settings(feedthrough=False))
    assert found.verdict.grade is Grade.GOOD
    assert not any('is measured in steps' in note for note in found.notes)
