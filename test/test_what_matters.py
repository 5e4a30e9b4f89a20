# SPDX-License-Identifier: Apache-2.0
"""What decides on robots of the exam and plants like them: what matters to who simulates."""

from __future__ import annotations

from dataclasses import replace

from marks import slow
import numpy as np
from plants import LINEAR, held_response, noisy, plant
import pytest
from scipy.linalg import block_diag, expm
from scipy.signal import lfilter

from ctsid_core import Grade, Record, Settings, Signal, Status, identify
from ctsid_core.judge import changed, conclusion, rules
from ctsid_core.judge.curve import curves_of
from ctsid_core.judge.excitation import _input_spectra, _uncorrelated, rivals_apart
from ctsid_core.judge.feedback import distance_to_controller
from ctsid_core.judge.slopes import SEARCHED, slopes_of
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Free, climb, fit_at
from ctsid_core.likelihood.residuals import coloured_power, independent, white_part
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.model import validation
from ctsid_core.search.task import free_of
from ctsid_core.settings import LONGEST_DELAY
from ctsid_ros.studies.robots.families import experiment
from ctsid_ros.studies.robots.reachable import models, outputs
from ctsid_ros.studies.robots.scoring import score
from ctsid_ros.studies.robots.sitting import Reach
from ctsid_ros.studies.robots.trials import response_off, simulated


def test_a_state_for_which_a_dead_time_stands_in_is_found():
    """One state and 0.34 s simulate a step as well as the right two, nearly; nothing else."""
    given = experiment('motor-position', 2, 7)
    found = identify(given.record, given.settings)
    assert found.verdict.grade is Grade.GOOD
    assert found.model.n == 2
    assert found.model.delay[0] < 0.05
    order, = (c for c in found.choices if c.name == 'order')
    assert 'and one more, because neighbouring errors are alike' in order.why


@pytest.mark.slow
@pytest.mark.parametrize(('family', 'number', 'order'), [
    ('gain-drift', 0, 1), ('dead-zone', 1, 1), ('saturation-30', 0, 2), *slow(
        ('rate-limit', 4, 2), ('backlash', 1, 1), ('backlash', 4, 2),
        ('quadratic-drag', 0, 2), ('pendulum', 3, 1))])
def test_an_order_that_is_given_is_fitted_as_well_as_by_brute_force(family, number, order):
    """
    With its dead time given, too; what too few states leave is no disturbance to be predicted.

    Few samples are independent here: a dead time stays if it gains three tenths of a point.
    """
    record = experiment(family, 31, number).record
    best = models(outputs(record)[0])[order - 1]
    reached = 100.0 * (1.0 - np.sqrt(best.cost) / np.std(outputs(record)[0].y))
    given = [Settings(order=order), Settings(order=order, delay=max(best.at[-1], 0.0))]
    if family in ('dead-zone', 'saturation-30'):
        given.append(Settings(order=order, feedthrough=False))
    for settings in given:
        found = identify(record, settings)
        fit = simulated(found.model or found.rejected_model, record)[0]
        print(f'{family}, order {order}: {fit:.2f} %, brute force {reached:.2f} %')
        assert fit > reached - 0.3


def test_an_order_that_is_given_may_be_that_of_a_plant_that_is_disturbed():
    """Predictions want no more states than two, so that what these leave are gusts."""
    given = experiment('turbulence-strong', 33, 6)
    found = identify(given.record, Settings(order=2))
    assert [c.value for c in found.choices if c.name == 'domain'] == ['disturbed']
    assert simulated(found.model, given.test)[0] > 90.0                 # 81 % by output error


@pytest.mark.parametrize(('family', 'seed', 'number', 'counted', 'order', 'rivals'), [
    *slow(('backlash', 22, 4, 3, 4, set())), ('gain-drift', 16, 3, 1, 2, {3})])
def test_the_colour_of_the_errors_chooses_among_neighbouring_orders(family, seed, number, counted,
                                                                    order, rivals):
    """A state is not bought for a disturbance, nor missed for a plant's curve that is coloured."""
    given = experiment(family, seed, number)
    found, other = (identify(given.record, LINEAR.replace(order=n)) for n in (0, counted))
    assert found.settings.order == order
    fits = [np.mean(simulated(e.model or e.rejected_model, given.test)) for e in (found, other)]
    assert fits[0] > fits[1] + 1.0
    chosen, = (c for c in found.choices if c.name == 'order')
    assert 'because neighbouring errors are alike' in chosen.why
    # What the colour refused might not be right instead, however many samples seem independent.
    assert {rival.model.n for rival in found.covariance.rivals} == rivals


def vibrating(seed, share=0.0):
    """
    Return a roll rate, dy/dt = 15 u - 5 y, moved by 3-2-1-1 for 10 s.

    A vibration has this share of its motion, and a frequency that wanders around 24 Hz.
    """
    rng, h = np.random.default_rng(seed), 0.01
    t = h * np.arange(1000)
    moves = np.repeat([0.0, 1.0, -1.0, 1.0, -1.0, 0.0], [10, 30, 20, 10, 10, 20])
    u = moves[np.arange(1000) // 4 % 100] * rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.2)
    y = held_response(plant([[-5.0]], [[15.0]], [[1.0]]), t, u[:, np.newaxis], t)[:, 0]
    wandering = 0.06 * np.sin(0.5 * np.pi * t + rng.uniform(0.0, 6.0)) \
        + 0.002 * np.cumsum(rng.standard_normal(1000))
    vibration = np.sqrt(2.0) * np.sin(h * np.cumsum(150.0 * np.exp(wandering)))
    noise = share * vibration + (share > 0.0) * 0.05 * rng.standard_normal(1000)
    return Record.from_arrays(t, u, t, y + np.std(y) * noise, input_hold='zoh')


# A dead time of 0, known to 4 to 7 ms where samples are 10 apart: the response at the vibration,
# where the model has a mode, is known to 12 to 26 %. (Of 4 ms none is found, and 0.2 were told.)
VAGUE = {(23, 0.3), (26, 0.3), (28, 0.15), (33, 0.15), (36, 0.3)}


@pytest.mark.parametrize(('seed', 'share'), [
    (10, 0.3), *(pytest.param(*one, marks=[pytest.mark.slow] + [pytest.mark.xfail(
        strict=False, reason='WEAK: the response is known to 12 to 26 %')] * (one in VAGUE))
        for one in ((4, 0.15), (19, 0.3), *((s, share) for s in range(20, 40)
                                            for share in (0.15, 0.3))))])
def test_a_vibration_buys_no_states(seed, share):
    """Its autocorrelation soon changes its sign: up to nine states, 86 % and WEAK for it."""
    found = identify(vibrating(seed, share))
    assert found.verdict.grade is Grade.GOOD
    assert found.model.n <= 5
    assert simulated(found.model, vibrating(seed + 100))[0] > 97.0


def test_errors_of_a_narrow_band_are_few_independent_samples():
    """
    Of white noise all are, of a pole rho (1 - rho) / (1 + rho) of them.

    Of a pair with rho_k = 0.99^k cos k half of 1 + 2 sum rho_k^2 is 25; estimates of rho_k add to
    it. Their sum changes its sign after two samples, as if every other one were independent.
    """
    rng, count = np.random.default_rng(0), 4000
    pair = 0.99 * np.exp(1j * np.array([1.0, -1.0]))
    for poles, least, most in (([], 0.99, 1.0), ([0.9], 0.04, 0.07), (pair, 0.015, 0.045)):
        x = lfilter([1.0], np.poly(poles).real, rng.standard_normal(count))
        assert least * count < independent(((x[:, np.newaxis],),))[0] <= most * count


@pytest.mark.slow
def test_what_is_left_of_an_output_that_is_all_explained_buys_no_state():
    """One output is curved by two millionths of its motion, the other one is noisy."""
    for seed in range(4):
        rng, t = np.random.default_rng(seed), np.arange(0.0, 10.0, 0.02)
        u, x = np.repeat(rng.choice([-1.0, 1.0], 50), 10), np.zeros(500)
        for k in range(499):
            x[k + 1] = np.exp(-0.04) * x[k] + (1.0 - np.exp(-0.04)) * u[k]
        noise = 0.1 * np.std(x) * rng.standard_normal(500)
        record = Record.from_arrays(t, u, t, np.column_stack((x + 1e-5 * x ** 3, x + noise)),
                                    input_hold='zoh')
        assert identify(record).settings.order == 1


@pytest.mark.slow
@pytest.mark.parametrize('which', [('no-gain-jump', 3, 4), ('no-pole-jump', 12, 2)])
def test_states_that_imitate_a_jump_are_not_called_good(which):
    """
    Several of them leave so little that two models are hardly better: the response is unsure.

    Eight of a gain that jumps, six of a pole, on sweeps; two models explain 4 and 2 % more.
    """
    given = experiment(*which)
    assert identify(given.record, given.settings).verdict.grade is not Grade.GOOD


@pytest.mark.parametrize(('seed', 'number'), [(2, 7), *slow((5, 1))])
def test_noise_does_not_make_a_jump_cost_less(seed, number):
    """A pole jumps in noise of a quarter of the motion: one model fits 76 %, two fit 77 %."""
    given = experiment('no-pole-jump', seed, number)
    found = identify(given.record, given.settings)
    assert found.status is Status.CHANGED
    assert 6.0 < found.verdict.change_cost < 9.0         # the root of 0.24^2 - 0.23^2


@pytest.mark.slow
@pytest.mark.parametrize(('family', 'seed', 'number'), [
    ('no-pole-jump', 19, 2), *slow(
        ('no-pole-jump', 10, 2), ('no-pole-jump', 11, 4), ('no-gain-jump', 9, 6),
        ('no-gain-jump', 5, 4), ('no-gain-jump', 16, 1))])
def test_states_that_imitate_a_jump_are_seen_through(family, seed, number):
    """A lag that jumps, simulated by up to ten states: two small models have fewer numbers."""
    given = experiment(family, seed, number)
    assert identify(given.record, given.settings).status is Status.CHANGED


@pytest.mark.parametrize(('family', 'seed', 'number'), [
    ('gain-drift', 15, 6), *slow(
        ('saturation-30', 16, 3), ('saturation-30', 17, 3), ('saturation-60', 15, 6))])
def test_what_a_drift_or_a_curve_explains_is_no_change(family, seed, number):
    """Two models explain most of it as well, and one simulates another flight to 85 to 99 %."""
    given = experiment(family, seed, number)
    assert identify(given.record, given.settings).verdict.grade is Grade.GOOD


@pytest.mark.parametrize(('family', 'seed', 'number'), [
    *slow(('rate-limit', 59, 4)), ('saturation-30', 59, 2), pytest.param(
        'turbulence-weak', 67, 4, marks=[pytest.mark.slow, pytest.mark.xfail(
            strict=False, reason='WEAK for its held-out error, 5.8 % where 1.6 % are learnt')])])
def test_what_other_orders_tell_otherwise_is_not_known(family, seed, number):
    """
    They were GOOD, with 56 to 70 % of another flight, of 77 to 92 that are reachable.

    Their own deviations were 1 to 6 % of the response; other orders, as likely, were 14 to 34 %
    away from them.
    """
    given = experiment(family, seed, number)
    found = identify(given.record, LINEAR)
    assert np.mean(simulated(found.model or found.rejected_model, given.test)) < 75.0
    assert found.verdict.grade is not Grade.GOOD
    assert 'models that may be as right' in found.verdict.reason


@pytest.mark.slow
@pytest.mark.parametrize(('family', 'seed', 'number', 'fit'), [
    ('sliding-mass', 70, 2, 98.0), *slow(
        ('sliding-mass', 67, 3, 98.0), ('sliding-mass', 70, 5, 96.0))])
def test_how_others_tell_a_drift_apart_from_the_start_is_no_doubt(family, seed, number, fit):
    """Rivals of an integrator have slow poles: trim and initial state make up for those."""
    given = experiment(family, seed, number)
    found = identify(given.record, given.settings)
    assert found.covariance.rivals
    assert found.verdict.grade is Grade.GOOD
    assert np.mean(simulated(found.model, given.test)) > fit


def test_a_lag_that_a_window_does_not_tell_from_a_dead_time_weakens():
    """An integrator under one step: it simulates another flight, and its response is 49 % off."""
    given = experiment('motor-position', 68, 0)
    found = identify(given.record, given.settings)
    assert np.mean(simulated(found.model, given.test)) > 98.0
    assert response_off(given, found.model, found)[0] > 40.0
    assert found.verdict.grade is Grade.WEAK
    assert found.verdict.reason.startswith('The response to input u1 has a standard deviation of')


@pytest.mark.parametrize('pole', [-2.0, 0.0])
def test_rivals_are_as_far_apart_as_what_they_simulate(pole):
    """One gain of two is a quarter more, with a share of a quarter: its lines and decays apart."""
    t = np.arange(0.0, 10.0, 0.02)
    u = np.random.default_rng(1).standard_normal((500, 2)).repeat(10, axis=0)[:500]
    record = Record.from_arrays(t, u, t, t + 1.0, input_hold='zoh')
    samples = samples_of([record], [[None]])
    own = ModalModel(np.array([pole + 0j]), np.array([[1.0, 2.0]]) + 0j, np.ones((1, 1)) + 0j,
                     np.zeros((1, 1)) + 0j, np.zeros((1, 2)), np.zeros((1, 1)), np.zeros(2))
    more = replace(own, b=own.b * [[1.25, 1.0]])
    moved, line = np.zeros(500), np.column_stack((np.vander(t, 2), np.exp(pole * t)))
    for k in range(499):
        moved[k + 1] = np.exp(0.02 * pole) * moved[k] + (u[k, 0] - u[0, 0]) * (
            np.expm1(0.02 * pole) / pole if pole else 0.02)
    left = 0.25 * (moved - line @ np.linalg.lstsq(line, moved, None)[0])
    assert rivals_apart(samples, own, [(0.25, more), (0.5, own)]) == pytest.approx(
        [0.5 * np.sqrt(np.mean(left ** 2)) / np.std(moved), 0.0], abs=1e-9)


def test_outputs_tell_rivals_apart_alike_however_often_they_are_sampled():
    """Two outputs of one lag, the gain of one in doubt: of 50 or of 500 samples."""
    u, found = np.random.default_rng(3).standard_normal((500, 1)), []
    t = np.arange(0.0, 10.0, 0.02)
    for step in (1, 10):
        times = (t, t[::step])
        record = Record((Signal(t, u, 'zoh'),), tuple(
            Signal(k, np.sin(k)[:, np.newaxis]) for k in times), 0.0, t[-1])
        own = ModalModel(np.array([-1.0 + 0j]), np.ones((1, 1)) + 0j, np.ones((2, 1)) + 0j,
                         np.zeros((1, 1)) + 0j, np.zeros((2, 1)), np.zeros((1, 2)), np.zeros(1))
        other = replace(own, c=own.c * [[1.0], [1.5]])
        found.append(rivals_apart(samples_of([record], [[None] * 2]), own, [(1.0, other)])[0])
    assert found[1] == pytest.approx(found[0], rel=0.1)


def test_what_an_input_moves_at_once_tells_rivals_apart_too():
    """D alone, of 1 and of 1.3."""
    t = np.arange(0.0, 10.0, 0.02)
    u = np.random.default_rng(2).standard_normal(500)
    samples = samples_of([Record.from_arrays(t, u, t, np.cos(t), input_hold='zoh')], [[None]])
    own = ModalModel(np.array([-1.0 + 0j]), np.zeros((1, 1)) + 0j, np.ones((1, 1)) + 0j,
                     np.zeros((1, 1)) + 0j, np.ones((1, 1)), np.zeros((1, 1)), np.zeros(1))
    apart = rivals_apart(samples, own, [(1.0, replace(own, D=own.D * 1.3))])
    assert apart[0] == pytest.approx(0.3, abs=0.003)


def test_a_jump_just_before_a_record_is_the_same_to_all_rivals():
    """It is within the dead time of one, and before that of the other: 100 % apart it was."""
    t_u = np.array([-1.0, -0.0005, 4.0])
    t, u = np.arange(0.0, 10.0, 0.02), np.array([[0.0], [1.0], [0.0]])
    record = Record((Signal(t_u, u, 'zoh'),), (Signal(t, np.cos(t)[:, np.newaxis]),), 0.0, t[-1])
    own = ModalModel(np.array([-1.0 + 3j]), np.ones((1, 1)) + 0j, np.ones((1, 1)) + 0j,
                     np.zeros((1, 1)) + 0j, np.zeros((1, 1)), np.zeros((1, 1)), np.zeros(1))
    later = replace(own, delay=np.array([0.001]))
    assert rivals_apart(samples_of([record], [[None]]), own, [(1.0, later)])[0] < 0.01


def test_a_small_jump_is_noted_and_does_not_reject():
    """The gain of a lag grows by 4 % in the middle: a model of both is 2 % off on each side."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 20.0, 0.02)
    u, x, kept = np.repeat(rng.standard_normal(50), 20), np.zeros(1000), np.exp(-0.08)
    for k in range(999):
        x[k + 1] = kept * x[k] + (1.0 - kept) * (1.0 + 0.04 * (t[k] > 10.0)) * u[k]
    y = x + 0.003 * np.std(x) * rng.standard_normal(1000)
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'), Settings(order=1))
    assert found.status is Status.OK
    assert 1.5 < found.verdict.change_cost < 2.5
    told, = (n for n in found.notes if n.startswith('perhaps the plant changed a little about '))
    assert f'{found.verdict.change_cost:.1f} % of the motion that two do not (up to 3' in told
    assert 0.45 < found.statistics['change_share'] < 0.55


@pytest.mark.slow
def test_a_change_is_seen_in_outputs_of_different_rates():
    """The gain grows by half, in the middle; one output comes twenty times as often."""
    rng, step = np.random.default_rng(0), 0.005
    t = step * np.arange(6000)
    u, y, decay = np.repeat(rng.standard_normal(300), 20), np.zeros(6000), np.exp(-2.0 * step)
    for k in range(len(t) - 1):
        y[k + 1] = decay * y[k] + (1.0 - decay) * (1.0 + 0.5 * (t[k] > 15.0)) * u[k]
    seen = [Signal(t[::every], (y[::every] + 0.01 * rng.standard_normal(len(y[::every])))[:, None])
            for every in (1, 20)]
    found = identify(Record((Signal(t, u[:, None], 'zoh'),), tuple(seen), 0.0, t[-1]))
    assert found.status is Status.CHANGED
    assert abs(found.statistics['change_share'] - 0.5) < 0.03


def test_inputs_that_are_the_same_are_never_good():
    """Only their sum is measured, and any share of it fits as well."""
    given = experiment('motor-speed', 2, 0).record
    one, = given.inputs
    twice = replace(one, values=np.repeat(one.values, 2, axis=1))
    record = replace(given, inputs=(twice,))
    found = identify(record)
    assert found.verdict.grade is Grade.WEAK
    assert 'move it independently of the other inputs' in found.verdict.reason


def stepped(at: float) -> Record:
    """A lag of 0.1 s that steps once in 9 s, with 1 % of noise."""
    t = np.arange(0.0, 9.0, 0.01)
    u, y = (t >= at) * 1.0, np.where(t >= at, 1.0 - np.exp(-10.0 * (t - at)), 0.0)
    return Record.from_arrays(
        t, u, t, y + 0.01 * np.random.default_rng(0).standard_normal(len(t)), input_hold='zoh')


@pytest.mark.parametrize(('at', 'told'), [(2.2, False), (4.0, True)])
def test_a_part_held_out_that_the_rest_cannot_tell_is_no_test(at, told):
    """The only step begins where the end of the first third is held out, or where it is not."""
    found = identify(stepped(at), Settings(delay=0.0))
    assert found.verdict.grade is Grade.GOOD, found.verdict.reason
    assert bool(np.isfinite(found.held_out_fit).all()) is told
    assert ('the part held out to' in found.verdict.reason) is told
    assert ('On the part held out a test could tell nothing' in found.verdict.reason) is not told


@pytest.mark.parametrize(('times', 'longest'), [(1.0, 2.25), (400.0, LONGEST_DELAY)])
def test_no_longer_dead_time_is_looked_for_than_may_be_given(times, longest):
    """A quarter of the window; of an hour that would be more than `delay` may be."""
    quick = stepped(4.0)
    record = Record(*(tuple(replace(s, time=times * s.time) for s in own)
                      for own in (quick.inputs, quick.outputs)), 0.0, times * quick.end)
    free = free_of(samples_of([record], [[None]]), Settings())
    assert free.longest == pytest.approx(longest, rel=2e-3)


@pytest.mark.parametrize(('family', 'seed', 'number'), [
    ('no-pole-jump', 5, 0), *slow(
        *((family, 12, k) for family in ('no-pole-jump', 'no-gain-jump') for k in range(12)
          if (family, k) != ('no-pole-jump', 2)))])
def test_a_jump_is_seen_in_noise(family, seed, number):
    """Gain or pole jumps by 40 %; with 12 dB of noise it was not certain how little is left."""
    assert identify(experiment(family, seed, number).record).status is Status.CHANGED


@pytest.mark.parametrize(('family', 'number'), [pytest.param(
    'turbulence-weak', 5, marks=[pytest.mark.slow, pytest.mark.xfail(
        reason='five states, that imitate nothing: 92.6 % of another flight')]), pytest.param(
    'rates-1x1', 5, marks=[pytest.mark.slow, pytest.mark.xfail(
        reason='two states, that imitate nothing, are GOOD and right')])])
def test_states_that_imitate_disturbances_are_not_called_good(family, number):
    """Nine and eight of them simulated 97 % of the window, and of another flight much less."""
    given = experiment(family, 6, number)
    assert identify(given.record, given.settings).verdict.grade is not Grade.GOOD


@pytest.mark.slow
def test_what_imitated_disturbances_is_not_wrong():
    given = experiment('rates-1x1', 6, 5)
    row = score(given, identify(given.record, given.settings), Reach(None).of(given), 0.0)
    assert row.order < 4
    assert not row.wrong


def test_a_dead_time_does_not_stand_in_for_a_state_that_is_certain():
    """The fit gains 0.07 points only; the response was off by 16 % at the end of its band."""
    given = experiment('motor-speed', 6, 0)
    estimate = identify(given.record)
    assert estimate.model.n == 2
    assert response_off(given, estimate.model, estimate)[0] < 5.0


@pytest.mark.parametrize('seed', [3, *slow(9)])
def test_a_search_with_feedthrough_keeps_what_called_for_it(seed):
    """
    Two resonances, and a third mode beyond what samples show, in which D of 0.1 stands.

    With D the poles that were found left 1 % instead of 14; a search anew missed them.
    """
    rng, t = np.random.default_rng(seed), np.arange(0.0, 5.12, 0.01)
    w, zeta, gain = np.array([36.5, 79.6, 600.0]), [0.006, 0.005, 0.5], [1.0, -0.5, 0.1]
    shown = w * [np.sqrt(0.012), 0.1, 1.0]                      # resonances are as high as gains
    A = block_diag(*([[0.0, 1.0], [-a * a, -2.0 * z * a]] for a, z in zip(w, zeta, strict=True)))
    p = plant(A, np.kron(gain * w, [0.0, 1.0])[:, np.newaxis], np.kron(shown, [[1.0, 0.0]]))
    phases = rng.uniform(0.0, 6.28, (59, 1))
    u = np.sum(np.cos(0.8 * np.pi * np.arange(1, 60)[:, np.newaxis] * t + phases), axis=0)
    lost = rng.uniform(size=len(t)) < 0.25
    t_y = t[~lost] + rng.uniform(-5e-4, 5e-4, np.sum(~lost))
    t_y = t_y[t_y > 0.0]
    y = noisy(rng, held_response(p, t, u[:, np.newaxis], t_y), 40)
    found = identify(Record.from_arrays(t, u, t_y, y, input_hold='zoh'), Settings(order=4))
    assert found.fit[0] > 98.5
    assert found.model.D[0, 0] == pytest.approx(0.1, abs=0.01)


def test_a_dead_time_that_ends_at_zero_leaves_the_poles_at_their_best():
    """As good as a climb that has no dead time: a bound must not spoil the other directions."""
    record = experiment('no-pole-jump', 2, 7).record
    samples = samples_of([record], [[None]])
    free = Free(False, True, (True,), 0.1, -1e-7, 100.0)
    none = replace(free, delays=(False,))
    late, held = (climb(samples, fit_at(samples, np.array([-8.67 + 0j]), np.array([delay]), one),
                        one) for one, delay in ((free, 0.038), (none, 0.0)))
    assert late.model.delay[0] == 0.0
    assert late.cost < held.cost + 0.01


def test_two_small_models_are_no_change_of_a_plant_that_many_states_explain():
    """Three pairs under a chirp: two models of order 2 were taken, for they have fewer numbers."""
    rng, h = np.random.default_rng(114), 1.0 / 12.0
    t = h * np.arange(120)
    u = np.sin(2.0 * np.pi * (0.1 * t + 0.115 * t * t))
    pairs = [(0.645, 0.446, 0.412), (5.799, 0.333, -0.307), (1.934, 0.630, 0.417)]
    A = block_diag(*([[0.0, 1.0], [-w * w, -2.0 * z * w]] for w, z, _ in pairs))
    B = np.concatenate([(0.0, w * w) for w, _, _ in pairs])
    C = np.concatenate([(gain, 0.0) for _, _, gain in pairs])
    joined = expm(h * np.block([[A, B[:, np.newaxis]], [np.zeros((1, 7))]]))
    x, y = np.zeros(6), np.empty(len(t))
    for k in range(len(t)):
        y[k] = C @ x
        x = joined[:6, :6] @ x + joined[:6, 6] * u[k]
    y += 0.01 * np.std(y) * rng.standard_normal(len(t))
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'))
    assert found.verdict.change_cost < 1.0
    assert found.fit[0] > 98.0


@pytest.mark.parametrize(('family', 'seed', 'number', 'least'), [
    ('turbulence-weak', 4, 1, 95.0),
    *slow(('turbulence-strong', 4, 3, 86.0), ('second-input', 3, 5, 94.0),
          ('second-input', 3, 3, 96.0))])
def test_what_disturbs_a_plant_for_long_is_told_by_its_own_past(family, seed, number, least):
    """Output error alone simulates a second experiment to 85, 95, 78 and 67 %."""
    given = experiment(family, seed, number)
    found = identify(given.record)
    assert any(c.name == 'domain' and c.value == 'disturbed' for c in found.choices)
    fit = float(np.mean(simulated(found.model, given.test)))
    print(f'{family}: {fit:.1f} %')
    assert fit > least
    assert not response_off(given, found.model, found)[1]
    # Judged by how it simulates, on all samples, as a model of output error is.
    assert found.fit[0] == pytest.approx(100.0 - 100.0 * rms_error(found, given.record), abs=0.1)


def rms_error(found, record):
    """Return the error of a simulation over the motion, by a way of its own."""
    y = record.outputs[0].values[:, 0]
    e = validation.simulation(found.model, record).y_hat[:, 0] - y
    return np.sqrt(np.mean(e ** 2)) / np.std(y)


@pytest.mark.parametrize(('seed', 'number', 'count'), [(12, 0, 2), (12, 3, 2), (106, 1, 1)])
def test_what_two_models_leave_is_what_they_do_to_first_order(seed, number, count):
    """At the instants that leave least, beside least squares on each side; states are free."""
    record = experiment('no-gain-jump', seed, number).record
    samples = samples_of([record], [[None]])
    free = Free(False, True, (True,), 1.0, -1e-6, 100.0)
    fit = climb(samples, fit_at(samples, np.array([-4.0 + 0j]), np.array([0.01]), free), free)
    thin, own = samples.thinned(SEARCHED), (fit.model, free)
    slopes = slopes_of(thin, own)
    rows, error, states, shares = slopes.rows, slopes.error, slopes.states, slopes.shares

    def left(side, columns):
        found = np.linalg.lstsq(columns[side], error[side], rcond=1e-9)[0]
        return np.sum((error[side] - columns[side] @ found) ** 2)

    instants = np.array(changed._INSTANTS)
    promise, rest = np.transpose([np.sum([
        (side.sum() * np.log(left(side, rows[:, states]) / left(side, rows)), left(side, rows))
        for side in (shares <= at, shares > at)], axis=0) for at in instants])
    best, most = instants[np.argsort(rest)[:2]], instants[np.argsort(promise)[-2:]]
    print(best, most)
    # Where they leave too much for a change is not looked at, nor where they promise most.
    assert changed._likely(thin, own, own) == pytest.approx(best[:count])
    assert seed == 12 or best[0] not in most


def test_what_curves_of_each_output_leave_is_what_least_squares_leave():
    """Each output's of both records, beside what all share and what one side has alone."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 10.0, 0.02)
    u = np.repeat(rng.standard_normal((50, 2)), 10, axis=0)
    y = np.transpose([lfilter([0.0, 0.1], [1.0, -0.9], u @ own)
                      for own in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))])
    y = y + 0.3 * y ** 2 + 0.05 * rng.standard_normal(y.shape)
    samples = samples_of([Record.from_arrays(t[k], u[k], t[k], y[k], input_hold='zoh')
                          for k in (slice(300), slice(250, None))], [[None]] * 2)
    free = Free(False, True, (True,) * 2, 1.0, -1e-6, 100.0)
    fit = fit_at(samples, np.array([-5.0 + 0j]), np.zeros(2), free)
    slopes = slopes_of(samples, (fit.model, free))
    curves = curves_of(samples, slopes.fit)
    more = slopes.rest * (slopes.shares > 0.5)[:, np.newaxis]
    left = slopes.beside(more, curves)
    # Rows are those of each output of the first record, then of each of the second.
    counts = slopes.samples.counts.ravel().astype(int)[::3]
    whole = np.hstack((slopes.rows, np.vstack([block_diag(*part) for part in zip(*(
        np.split(one, counts[:1]) for one in curves), strict=True)]), more))
    whole /= np.maximum(np.linalg.norm(whole, axis=0), 1e-300)
    rest = slopes.error - whole @ np.linalg.lstsq(whole, slopes.error, rcond=1e-4)[0]
    assert [len(one) for one in curves] == [550] * 3
    np.testing.assert_allclose(left.errors, rest, atol=1e-3)
    assert left.numbers == np.linalg.matrix_rank(whole, 1e-4)       # some curves are alike
    assert slopes.beside(more).cost > left.cost


def test_sides_too_short_for_a_model_are_not_looked_at():
    """A lag that halves after a sixth of 120 samples; each side needs three for each number."""
    rng, t, x = np.random.default_rng(0), np.arange(0.0, 12.0, 0.1), np.zeros(120)
    u = np.repeat(np.sign(rng.standard_normal(24)), 5)
    for k, now in enumerate(t[:-1]):
        keep = np.exp(-0.1 * (3.0 if now < 2.0 else 1.5))
        x[k + 1] = keep * x[k] + (1.0 - keep) * u[k]
    samples = samples_of([Record.from_arrays(
        t, u, t, x + 0.01 * rng.standard_normal(120), input_hold='zoh')], [[None]])
    free = Free(False, True, (True,), 1.0, -1e-6, 30.0)

    def looked_at(poles):
        fit = climb(samples, fit_at(samples, np.array(poles), np.array([0.01]), free), free)
        return changed._likely(samples, (fit.model, free), (fit.model, free))
    assert min(looked_at([-1.0 + 0j])) < 0.2
    for at in looked_at([-1.0 + 0j, -3.0, -9.0]):
        assert min(at, 1.0 - at) * 120 >= 3 * (3 * 3 + 2)


def test_two_smaller_models_are_tried_where_they_may_leave_less():
    """Two lags do not explain what two masses do, so it is no change of a lag."""
    samples = samples_of([experiment('two-masses', 12, 0).record], [[None]])
    free = Free(False, True, (True,), 1.0, -1e-6, 100.0)
    lag, masses = ((climb(samples, fit_at(
        samples, np.array(poles), np.array([0.01]), free), free).model, free)
        for poles in ([-4.0 + 0j], [-1.0 + 4.0j, -2.0 + 10.0j]))
    assert changed._likely(samples, lag, lag)
    assert not changed._likely(samples, lag, masses)


def test_a_pole_that_jumps_is_no_small_change():
    """To first order two models of two states leave 1.2 times what six states do."""
    found = identify(experiment('no-pole-jump', 62, 4).record)
    assert found.status is Status.CHANGED


def test_where_the_past_of_an_input_tells_more_no_controller_is_seen():
    """A fast plant in open loop: what follows an input looks like its inverse, too."""
    given = experiment('fast-pole', 1, 2)
    found = identify(given.record, given.settings)
    assert found.good
    assert distance_to_controller([given.record], found.model, found.verdict.excitation) == np.inf


@pytest.mark.slow
def test_states_are_not_misled_by_the_dead_times_of_fewer():
    """One state of three inputs had dead times that fit nothing: nine states, -331 %."""
    found = identify(experiment('random-3x3', 45, 3).record, Settings(feedthrough=False))
    assert found.verdict.grade is Grade.GOOD
    assert found.model.n == 4


@pytest.mark.slow
def test_what_a_controller_makes_of_gusts_is_no_lead():
    """An input that is computed from outputs follows them: a lead explains a little of that."""
    given = experiment('rates-1x1', 1, 2)
    assert 'utputs answer' not in identify(given.record, given.settings).verdict.reason


@pytest.mark.parametrize(('blue', 'lasting'), [(0.0, 0.6), (1.0, 0.0), (1.0, 0.6)])
def test_noise_of_differences_hides_nothing_slow(blue, lasting):
    """A seventh of its power more passes for white, not 2.7 times it as by second differences."""
    rng = np.random.default_rng(0)
    white = rng.standard_normal(20001)
    noise = np.diff(white) / np.sqrt(2.0) if blue else white[1:]
    error = noise + lasting * np.sqrt(2.0) * np.sin(0.01 * np.arange(20000))
    found = float(np.sqrt(coloured_power(((error[:, np.newaxis],),))[0]))
    assert found == pytest.approx(lasting, abs=0.12 if lasting else 0.05)


def test_short_loud_records_are_as_white_as_long_quiet_ones():
    rng = np.random.default_rng(0)
    parts = [rng.standard_normal(800), *(10.0 * rng.standard_normal(15) for _ in range(29))]
    whole = white_part(tuple((e[:, np.newaxis],) for e in parts))[0]
    assert whole == pytest.approx(np.std(np.concatenate(parts)), rel=0.1)


@pytest.mark.slow
def test_a_resonance_in_a_long_record_is_looked_at_where_it_is():
    """Of 100 s at 200 Hz nearly all of the motion is at 30 Hz: so are band and deviation."""
    rng, t = np.random.default_rng(0), 0.005 * np.arange(20000)
    w, z = 2.0 * np.pi * 30.0, 0.02
    lag_and_pair = block_diag([[-2.0]], [[0.0, 1.0], [-w * w, -2.0 * z * w]])
    truth = plant(lag_and_pair, [[2.0], [0.0], [w * w]], [[1.0, 0.5, 0.0]])
    u = rng.standard_normal((len(t), 1))
    found = identify(Record.from_arrays(
        t, u, t, noisy(rng, held_response(truth, t, u, t), 10), input_hold='zoh'))
    assert found.good
    one = found.verdict.excitation[0]
    assert 20.0 < one.low / (2.0 * np.pi) < 30.0 < one.high / (2.0 * np.pi) < 45.0
    model, = np.abs(found.model.frequency_response(np.array([w]))).ravel()
    true, = np.abs(truth.C @ np.linalg.solve(1j * w * np.eye(3) - truth.A, truth.B)).ravel()
    assert model == pytest.approx(true, rel=3.0 * one.uncertainty)


@pytest.mark.parametrize(('second', 'advice'), [
    (0.0, 'move input u2, if y2 is to follow it (it does not move within the window).'),
    (1.0, 'move input u1 independently of the others, if y2 is to follow it (only 0 % of its '
          'power is not correlated with theirs).')])
def test_an_output_that_follows_nothing_has_inputs_that_tell_nothing(second, advice):
    """A robot that drives straight on: its yaw rate is noise, and that is no wrong signal."""
    rng, t = np.random.default_rng(2), 0.02 * np.arange(1000)
    u = np.repeat(rng.standard_normal(50), 20)[:, np.newaxis]
    speed = held_response(plant([[-4.0]], [[4.0]], [[1.0]]), t, u, t)
    noise = 0.02 * rng.standard_normal((len(t), 2))
    found = identify(Record.from_arrays(
        t, np.hstack((u, second * u)), t, np.hstack((speed, 0.0 * speed)) + noise,
        input_hold='zoh'), Settings(feedthrough=False))
    assert found.status is Status.UNEXPLAINED
    assert found.verdict.reason.endswith(advice)


def test_an_order_that_a_record_is_too_short_for_is_named():
    rng, t = np.random.default_rng(0), np.linspace(0.0, 6.0, 60)
    u = np.repeat(rng.standard_normal(12), 5)
    found = identify(Record.from_arrays(t, u, t, rng.standard_normal(60), input_hold='zoh'),
                     Settings(order=20))
    assert found.status is Status.TOO_SHORT
    assert found.verdict.reason == ('The window is too short for a model of order 20; set '
                                    '`order: 0`, or take a longer window.')


@pytest.mark.slow
def test_what_predictions_have_not_seen_is_compared_one_sample_ahead(monkeypatch):
    """As it is computed: ten samples ahead anything does worse than three times that."""
    seen = []
    monkeypatch.setattr(conclusion, 'judge', lambda e: seen.append(e) or rules.judge(e))
    given = experiment('rates-1x1', 33, 1)
    found = identify(given.record, given.settings)
    assert found.by_predictions
    evidence, = seen
    assert np.all(evidence.fitted < 0.7 * evidence.numbers.error)
    far = replace(evidence, numbers=replace(
        evidence.numbers, held_out_error=np.maximum(3.1 * evidence.fitted, 0.051),
        excitation=tuple(replace(x, uncertainty=0.1) for x in evidence.numbers.excitation)))
    assert 'that was held out' in rules.judge(far)[1].reason


def test_records_weigh_as_long_as_they_move():
    """Twice the same motion in one record has twice the weight, at any rate of the outputs."""
    u = np.repeat(np.random.default_rng(0).standard_normal(10), 4)[:, np.newaxis]
    records = []
    for times, rate in ((1, 20.0), (2, 20.0), (1, 40.0)):
        t_u, t_y = 0.05 * np.arange(40 * times), np.arange(0.0, 2.0 * times, 1.0 / rate)
        records.append(Record.from_arrays(t_u, np.tile(u, (times, 1)), t_y, np.sin(t_y),
                                          input_hold='zoh'))
    whole = samples_of(records, [[None]] * 3)
    weights = [float(np.sum(np.abs(_input_spectra(
        replace(whole, records=whole.records[k:k + 1]), np.zeros(1))[1]) ** 2))
        for k in range(3)]
    assert weights[1] == pytest.approx(2.0 * weights[0], rel=0.2)
    assert weights[2] == pytest.approx(weights[0], rel=0.3)


def test_inputs_move_together_for_as_long_as_they_do():
    """For 60 s at 10 Hz, not for 6 s at 100 Hz: the samples are as many, the time is not."""
    rng, records = np.random.default_rng(0), []
    for k, (rate, same) in enumerate(((10.0, True), (100.0, False))):
        t = np.arange(600) / rate
        u = np.repeat(rng.standard_normal((60, 2)), 10, axis=0)
        u[:, 1] = u[:, 0] if same else u[:, 1]
        records.append(Record.from_arrays(t + 100.0 * k, u, t + 100.0 * k, np.sin(t),
                                          input_hold='zoh'))
    own = _uncorrelated(_input_spectra(samples_of(records, [[None]] * 2), np.zeros(2))[2])
    # Of u1 - u2 60 / 66, the best by time, is left 0.17 of the power; by samples 0.75 would be.
    np.testing.assert_allclose(own, 0.17, rtol=0.2)
