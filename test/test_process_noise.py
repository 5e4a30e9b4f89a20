# SPDX-License-Identifier: Apache-2.0
"""Gusts, and what is claimed of the poles in them."""

from dataclasses import replace

from marks import slow
import numpy as np
from plants import PLANTS, asynchronous, held_response, match, plant
import pytest
from scipy.linalg import block_diag, expm
from scipy.signal import butter, lfilter

from ctsid_core import Grade, Record, Settings, Status, identify
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.model.validation import simulation
from ctsid_core.search import solve
from ctsid_core.search.by_order import search_orders
from ctsid_core.signals.loop import in_loop
from ctsid_ros.examples.flight import Command, Conditions, Flight
from ctsid_ros.examples.quadrotor_roll import Plant
from ctsid_ros.studies.experiments import flown
from ctsid_ros.studies.robots.families import experiment
from ctsid_ros.studies.robots.regression import prediction_errors, prediction_reach
from ctsid_ros.studies.robots.trials import simulated

QUICK = Settings(feedthrough=False, held_out=0.0)
S = 10**9


def gusty(seed: int, start: float, *, payload=0.5, duration=8.0) -> Record:
    """Return a window of the quadrotor's roll loop in gusts: poles -1.1, -20, -0.97 +- 22.5j."""
    sent = Flight(Conditions(), seed, Plant(payload)).sent(int((start + duration + 0.1) * S))
    commands = [(m.stamp_ns / S, m.torque) for m in sent if isinstance(m, Command)]
    rates = [(m.stamp_ns / S, m.rates[0]) for m in sent if not isinstance(m, Command)]
    record = Record.from_arrays(*np.array(commands).T, *np.array(rates).T, input_hold='zoh')
    return record.between(start, start + duration)


# Windows in which output error used to be taken though process noise was 130 units likelier (301),
# in which simulations ended in a mode that is none (308), and in which claims were too small.
WINDOWS = [(301, 8.0, 4), *((seed, start, order) for order in (4, 0) for seed, start in (
    (301, 12.0), (308, 12.0), (310, 4.0), (303, 12.0), (304, 12.0)))]


@pytest.mark.parametrize(('seed', 'start', 'order'), [WINDOWS[0], *slow(*WINDOWS[1:4])])
def test_a_controller_is_heard_in_gusts(seed, start, order):
    """Few large commands outweighed what it makes of the sensor's noise."""
    assert in_loop([gusty(seed, start)])


@pytest.mark.parametrize(('seed', 'start', 'order'), [WINDOWS[0], *slow(*WINDOWS[1:])])
def test_gusts_are_told_from_dynamics(seed, start, order):
    estimate = identify(gusty(seed, start), QUICK.replace(order=order))
    assert estimate.ok
    model = estimate.model
    assert model.n == 4
    truth = Plant(0.5).true_model().poles
    found = match(model.poles, truth)
    claim = [estimate.pole_std[np.argmin(np.abs(model.poles - p))] for p in found]
    assert (np.abs(found - truth) < 3.5 * np.array(claim)).all()


@pytest.mark.slow
@pytest.mark.parametrize('seed', [1, *slow(0, 2, 3)])
def test_model_errors_are_no_process_noise(seed):
    """
    Straight lines through a curved input: coloured residuals that the plant has not made.

    A K that is estimated with the plant makes the poles twice to twenty times worse.
    """
    record = asynchronous(np.random.default_rng(seed), PLANTS['hd52'], 100.0, 60.0, hold='linear')
    estimate = identify(record, Settings(order=3, held_out=0.0))
    truth, model = PLANTS['hd52'].poles, estimate.model
    assert np.abs(match(model.poles, truth) - truth).max() < 0.046


@pytest.mark.slow
@pytest.mark.parametrize('payload', [
    pytest.param(0.0, marks=pytest.mark.xfail(reason='3 deviations are left in 4 of 100')), 0.5])
def test_claims_hold_in_gusts(payload):
    """100 windows: 3 deviations are left in 3 % at most, 6 never."""
    truth = Plant(payload).true_model().poles
    worst = []
    for seed in range(1000, 1050):
        for start in (4.0, 12.0):
            estimate = identify(gusty(seed, start, payload=payload), QUICK.replace(order=4))
            model = estimate.model or estimate.rejected_model
            found = match(model.poles, truth)
            claim = [estimate.pole_std[np.argmin(np.abs(model.poles - p))] for p in found]
            worst.append(np.max(np.abs(found - truth) / claim))
    print(f'payload {payload}: beyond 3 {np.mean(np.array(worst) > 3.0):.3f}, worst {max(worst)}')
    assert np.mean(np.array(worst) > 3.0) <= 0.03
    assert max(worst) < 6.0


@pytest.mark.slow
def test_unstable_plant_with_process_noise():
    """
    Nothing set but that there is no feedthrough; over many runs: test_studies.py.

    Its error is within three of the Cramer-Rao bounds of docs/accuracy.md.
    """
    found = identify(flown(0, 0.2).record, Settings(feedthrough=False))
    assert found.ok
    assert found.model.n == 2
    error = np.sort(found.model.poles.real)[::-1] - [2.0, -3.0]
    assert (np.abs(error) < 3.0 * np.array([0.068, 0.082])).all()


@pytest.mark.parametrize(('family', 'number', 'budget', 'measure'), [
    ('cart-pole', 3, 0.5, 1.02), *slow(
        ('cart-pole', 3, 0.0, 1.02), ('cart-pole', 0, 0.5, 1.02), ('rates-4x3', 4, 0.0, 1.5))])
def test_robots_under_their_controllers_are_predicted_as_by_the_true_filter(
        family, number, budget, measure):
    """
    Two integrators and a pole that grows by e^60, and modes that seem to grow and do not.

    Seed 7 of the exam: predictions 1, 10 and 50 samples ahead of another flight had 272 and 456
    times the errors of the filter that knows the robot.
    """
    given = experiment(family, 7, number)
    estimate = identify(given.record, given.settings.replace(budget=budget))
    model = estimate.model or estimate.rejected_model
    own, best = (np.array(prediction_errors(m, given.test)) for m in (model, given.truth))
    assert (own < measure * best).all()


@pytest.mark.parametrize(('family', 'number', 'share', 'before'), [
    ('cart-pole', 6, 0.14, 0), *slow(
        ('rates-1x1', 3, 0.01, 1), ('rates-1x1', 0, 0.07, 1), ('cart-pole', 1, 0.5, 1))])
def test_plants_by_predictions_have_rivals_with_dead_times_to_either_side(
        family, number, share, before):
    """One was compared with the model in the end, and may not be likelier than it."""
    given = experiment(family, 11, number)
    found = identify(given.record, given.settings)
    other, *beside = found.covariance.rivals
    moved = np.array([m.delay[0] for _, m in beside]) - found.model.delay[0]
    assert other.share == pytest.approx(share, abs=0.01)
    assert (np.sum(moved < 0.0), np.sum(moved > 0.0)) == (before, 1)
    assert {s for s, _ in beside} == {0.25 / len(beside)}
    # Both sides vary it by half of what they are away, beside what the curvature says.
    assert found.delay_std[0] > 0.5 * np.sqrt(np.mean(moved ** 2))


@pytest.mark.slow
def test_rivals_of_a_plant_that_does_not_grow_do_not_either():
    """By their predictors alone all eight would, with 0.1 to 0.2 rad/s."""
    given = experiment('rates-4x3', 125, 1)
    found = identify(given.record, given.settings)
    assert found.verdict.grade is Grade.GOOD
    assert len(found.covariance.rivals) == 8
    assert max(m.poles.real.max() for _, m in (*found.covariance.rivals, (1.0, found.model))) \
        < 1e-9


@pytest.mark.slow
def test_a_sample_is_not_put_before_its_record():
    """In closed loop samples go to the input just before them: that may lie before the start."""
    given = experiment('rates-1x1', 8, 5)
    estimate = identify(given.record, given.settings)
    own, best = (np.array(prediction_errors(m, given.test))
                 for m in (estimate.model or estimate.rejected_model, given.truth))
    assert (own < 1.1 * best).all()          # responses of order 2 and more were not numbers


def test_a_pole_put_on_the_axis_is_as_unsure_as_it_was_found():
    """A slow pole under its controller in gusts: on the axis it had a deviation of 0."""
    rng, h, p = np.random.default_rng(6), 0.02, 0.05
    t = h * np.arange(2000)
    wanted = np.repeat(rng.choice([-1.0, 1.0], len(t) // 40 + 1), 40)[:len(t)]
    x, u, y = 0.0, np.empty(len(t)), np.empty(len(t))
    for k in range(len(t)):
        y[k] = x + 0.01 * rng.standard_normal()
        u[k] = 3.0 * (wanted[k] - y[k])
        x = np.exp(p * h) * x + h * u[k] + 0.3 * np.sqrt(h) * rng.standard_normal()
    record = Record.from_arrays(t, u, t, y, input_hold='zoh')
    found = identify(record, Settings(feedthrough=False, delay=0.0, order=1))
    model = found.model or found.rejected_model
    assert abs(model.poles[0]) < 1e-9
    assert 0.5 * p < found.pole_std[0] < 3.0 * p
    assert found.verdict.grade is not Grade.GOOD


def test_the_order_of_records_does_not_matter_to_predictions():
    """An unstable plant, flown twice at other trims: the model has that of the later flight."""
    h, t = 0.02, 0.02 * np.arange(1000)

    def flight(seed, offset):
        rng = np.random.default_rng(seed)
        wanted = np.repeat(rng.standard_normal(len(t) // 25), 25)
        x, u, y = 0.0, np.empty(len(t)), np.empty(len(t))
        for k in range(len(t)):
            y[k] = x + offset + 0.02 * rng.standard_normal()
            u[k] = -4.0 * (y[k] - offset - wanted[k])
            x = np.exp(h) * x + np.expm1(h) * u[k]
        return Record.from_arrays(t, u, t, y, input_hold='zoh', epoch_ns=10 ** 12 * seed)

    both = [flight(0, 0.0), flight(1, 5.0)]
    one, other = (identify(records, Settings(feedthrough=False, delay=0.0, order=1))
                  for records in (both, both[::-1]))
    assert any(c.value == 'predictions' for c in one.choices)
    np.testing.assert_allclose(one.model.poles, [1.0], rtol=1e-3)
    np.testing.assert_allclose(one.model.y_trim + one.model.C @ one.model.x_trim, 5.0, atol=0.02)
    np.testing.assert_allclose(other.fit, one.fit, rtol=1e-9)
    np.testing.assert_allclose(other.model.y_trim, one.model.y_trim, rtol=1e-9)


@pytest.mark.parametrize('order', [6, *slow(0)])
def test_a_controlled_plant_has_as_many_states_as_it_has(order):
    """One unstable mode, two that swing and a lag, by a regression that finds any order."""
    rng, h = np.random.default_rng(0), 0.01
    A = block_diag(1.0, [[-0.5, 8.0], [-8.0, -0.5]], [[-0.8, 20.0], [-20.0, -0.8]], -15.0)
    B, C = np.array([1.0, 1.0, 0.0, 1.0, 0.0, 1.0]), np.array([1.5, 0.2, 1.0, 0.6, 1.2, -0.3])
    joined = expm(h * np.block([[A, B[:, np.newaxis]], [np.zeros((1, 7))]]))
    wanted, x = np.repeat(rng.standard_normal(151), 20)[:3000], np.zeros(6)
    u, y = np.empty(3000), np.empty(3000)
    for k in range(3000):
        y[k] = C @ x + 0.02 * rng.standard_normal()
        u[k] = wanted[k] - 1.5 * y[k]
        x = joined[:6, :6] @ x + joined[:6, 6] * u[k]
    record = Record.from_arrays(h * np.arange(3000), u, h * np.arange(3000), y, input_hold='zoh')
    found = identify(record, Settings(feedthrough=False, delay=0.0, order=order))
    assert found.verdict.grade is Grade.GOOD
    assert found.model.n == 6
    true, own = np.linalg.eigvals(A), found.model.poles
    assert max(np.min(np.abs(own - p)) / abs(p) for p in true) < 0.05


def test_one_sample_of_an_output_has_no_interval():
    """A short record beside a long one is thinned to one sample by a budget."""
    records = [Record.from_arrays(t, np.sin(t), t, np.cos(t)) for t in map(np.arange, (1000, 4))]
    thin = samples_of(records, [[None]] * 2).thinned(8)
    assert len(thin.records[1].streams[0].times) == 1
    assert thin.interval == 36.0


@pytest.mark.parametrize('feedthrough', [True, *slow(False)])
def test_an_output_that_rests_but_for_spikes_is_an_output_that_rests(feedthrough):
    """An event flag beside a plant in gusts: its spikes are hidden, and nothing is left."""
    record = experiment('turbulence-strong', 4, 3).record
    y = record.outputs[0]
    flag = np.zeros(len(y.time))
    flag[[len(flag) // 2, 2 * len(flag) // 3]] = 5.0, -5.0
    both = replace(y, values=np.column_stack((y.values, flag)))
    found = identify(replace(record, outputs=(both,)), Settings(feedthrough=feedthrough))
    assert found.verdict.grade is Grade.REJECT
    alone = replace(record, outputs=(replace(y, values=flag[:, np.newaxis]),))
    assert not identify(alone, Settings(feedthrough=feedthrough)).good


@pytest.mark.slow
@pytest.mark.xfail(strict=False, reason='four or six states at the fastest pole and a dead time '
                   'by which jumps come before both spikes: WEAK; without D on some processors')
@pytest.mark.parametrize('feedthrough', [True, False])
def test_spikes_alone_are_no_output(feedthrough):
    record = experiment('turbulence-strong', 4, 3).record
    y = record.outputs[0]
    flag = np.zeros((len(y.time), 1))
    flag[[len(flag) // 2, 2 * len(flag) // 3]] = [[5.0], [-5.0]]
    found = identify(replace(record, outputs=(replace(y, values=flag),)),
                     Settings(feedthrough=feedthrough))
    assert found.verdict.grade is Grade.REJECT


@pytest.mark.slow
@pytest.mark.parametrize(('family', 'seed', 'number', 'measure'), [
    ('cart-pole', 19, 1, 1.0), *slow(('cart-pole', 128, 4, 1.0), ('cart-pole', 128, 6, 1.0),
                                     ('cart-pole', 129, 6, 1.0), ('rates-4x3', 18, 5, 1.0))])
def test_slow_states_and_too_many_free_numbers_do_not_predict(family, seed, number, measure):
    """
    Errors at three horizons over those of regression or the true filter, on a second flight.

    Up to 1.16 with climbs as slow as they like, up to 1.06 without the regression as it is, and
    up to 1.5 with slow filters of plants that grow.
    """
    given = experiment(family, seed, number)
    reach = np.array(prediction_reach(given)).reshape(2, -1).max(axis=0)
    found = identify(given.record, given.settings)
    model = found.model or found.rejected_model
    ratios = np.array(prediction_errors(model, given.test)) / reach
    print(family, ratios)
    assert ratios.max() < measure


@pytest.mark.parametrize(('family', 'seed', 'number'), [
    ('rates-4x3', 145, 4), ('rates-1x1', 134, 2), *slow(('rates-1x1', 144, 2))])
def test_where_nothing_simulates_predictions_find_the_plant(family, seed, number):
    """
    None grows: of one no controller was heard, of the others a drift stood for what gusts do.

    Ten samples ahead errors were 2.5, 2.2 and 1.6 times those of regression or the true filter.
    """
    given = experiment(family, seed, number)
    reach = np.array(prediction_reach(given)).reshape(2, -1).max(axis=0)
    found = identify(given.record, given.settings)
    assert found.model is not None, found.verdict.reason
    ratios = np.array(prediction_errors(found.model, given.test)) / reach
    print(family, ratios)
    assert ratios[:2].max() < 1.2


@pytest.mark.parametrize(('seed', 'least'), [(1, 25.0), *slow((10, 40.0))])
def test_what_is_held_out_of_a_disturbed_plant_is_simulated_by_the_rest(seed, least):
    """Output error of the rest follows what disturbs it: -2 and 23 %. Poles are -1 +- 2.83i."""
    rng, h = np.random.default_rng(seed), 0.02
    t = h * np.arange(800)
    u = np.sign(np.sin(0.5 * t ** 1.4))
    joined = expm(h * np.array([[0.0, 1.0, 0.0], [-9.0, -2.0, 1.0], [0.0, 0.0, 0.0]]))
    stays, gust, x, y = np.exp(-h / 3.0), 0.0, np.zeros(2), np.empty(800)
    for k in range(800):
        y[k] = x[0]
        gust = stays * gust + 0.7 * np.sqrt(1.0 - stays ** 2) * rng.standard_normal()
        x = joined[:2, :2] @ x + joined[:2, 2] * (u[k] + gust)
    y += 0.01 * np.std(y) * rng.standard_normal(800)
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'))
    assert any(c.value == 'disturbed' for c in found.choices)
    assert found.held_out_fit[0] > least


def gusty_lag(seed: int, every: int, gusts: float = 0.15) -> Record:
    """Return a lag of 1 s under ramps of 1.5 s, in gusts as slow; outputs at 500 Hz / every."""
    rng, n, stays = np.random.default_rng(seed), 15000, np.exp(-0.002)
    t, knots = 0.002 * np.arange(n), 1.5 * np.arange(20)
    u = np.interp(t, knots, np.repeat(rng.uniform(-1.0, 1.0, 10), 2))[::10].repeat(10)
    gust = lfilter([np.sqrt(1.0 - stays ** 2)], [1.0, -stays], rng.standard_normal(n))
    y = lfilter([0.0, 1.0 - stays], [1.0, -stays], u + gusts * gust)
    y += 0.02 * rng.standard_normal(n) * np.sign(gusts)
    return Record.from_arrays(t[::10], u[::10], t[::every], y[::every], input_hold='zoh')


@pytest.mark.parametrize(('seed', 'rates'), [(3, (10, 2)), *slow(
    *((seed, (10, 2, 1)) for seed in (3, 4, 8, 9)))])
def test_a_verdict_does_not_hinge_on_how_fast_outputs_are_sampled(seed, rates):
    """
    Within 50 samples of 2 ms responses had deviations of 15 to 32 %, and were WEAK.

    Models at 50, 250 and 500 Hz simulate 81 to 97 % of another run without gusts.
    """
    unsure = []
    for every in rates:
        found = identify(gusty_lag(seed, every))
        assert found.verdict.grade is Grade.GOOD
        other = gusty_lag(seed + 100, 10, gusts=0.0)
        assert simulation(found.model, other, trim='refit').fit[0] > 80.0
        unsure.append(found.verdict.excitation[0].uncertainty)
    assert max(unsure) < 1.25 * min(unsure)


def counted(seed: int, every: float, pushed: bool = True) -> Record:
    """Return the speed of a motor by counts of its encoder, with three pushes; pole -6.7."""
    rng, h, n = np.random.default_rng(seed), 0.001, 20000
    t = h * np.arange(n)
    u = rng.uniform(-1.0, 1.0, n)[(t / every).astype(int)]
    load = np.zeros(n)
    for start in rng.uniform(1.0, 19.0, 3) * pushed:
        load[(t > start) & (t < start + rng.uniform(0.05, 0.15))] = rng.choice([-1.0, 1.0])
    load *= 0.12 / max(np.std(load), 1.0 - pushed)
    stays = np.exp(-h / 0.15)
    speed = 10.0 * lfilter([0.0, 1.0 - stays], [1.0, -stays], u + load)
    counts = np.cumsum(speed)[::10] * h * 320.0
    y = np.diff(np.floor(counts) if pushed else counts) / 3.2
    y += 0.02 * np.std(y) * rng.standard_normal(len(y)) * pushed
    return Record.from_arrays(t[::10], u[::10], t[10::10], y, input_hold='zoh')


@pytest.mark.slow
@pytest.mark.parametrize(('seed', 'every'), [(2, 0.1), *slow((1, 0.1), (15, 0.1), (15, 0.4))])
def test_what_is_held_out_is_simulated_without_a_filter(seed, every):
    """
    The filter of the rest was not stable, or its fastest mode alternated: seven of 40 untested.

    All are GOOD, and simulate 91 to 98 % of another run without noise.
    """
    found = identify(counted(seed, every))
    assert found.verdict.grade is Grade.GOOD
    assert np.isfinite(found.held_out_fit).all()
    other = counted(seed + 100, every, pushed=False)
    assert simulation(found.model, other, trim='refit').fit[0] > 90.0


@pytest.mark.parametrize(('family', 'seed', 'number', 'least'), [
    ('turbulence-weak', 3, 5, 90.0), *slow(
        ('second-input', 39, 1, 92.0), ('turbulence-weak', 3, 6, 95.0)),
    pytest.param('turbulence-strong', 38, 4, 92.0, marks=[pytest.mark.slow, pytest.mark.xfail(
        strict=True, reason='89.6 %, WEAK: its dead time is known to 0.1 s')])])
def test_a_disturbed_plant_has_as_a_rule_one_verdict(family, seed, number, least):
    """
    Whether D may be or not: found by predictions, judged by simulation.

    Output error alone simulates a second flight to 86.7, 83.7, 93.4 and 87.5 % instead of 94.9,
    96.8, 97.4 and 89.6.
    """
    given = experiment(family, seed, number)
    with_D, without = (identify(given.record, Settings(feedthrough=f)) for f in (True, False))
    assert any(c.value == 'disturbed' for c in with_D.choices)
    assert with_D.choices == without.choices
    assert with_D.verdict.grade is without.verdict.grade
    np.testing.assert_allclose(without.model.poles, with_D.model.poles, rtol=1e-9)
    np.testing.assert_allclose(without.fit, with_D.fit, rtol=1e-9)
    found = np.mean(simulated(with_D.model, given.test))
    print(family, found)
    assert found > least


@pytest.mark.parametrize(('family', 'seed', 'number'), [
    ('sliding-mass', 38, 5), *slow(('motor-position', 37, 0)),
    pytest.param('sliding-mass', 37, 4, marks=[pytest.mark.slow, pytest.mark.xfail(
        reason='10 dB: a dead time of 0.57 s is not kept, the response known to 13 %: WEAK')])])
def test_an_integrator_is_simulated_whatever_is_known_of_its_loop(family, seed, number):
    """
    With `feedthrough: false` all were predicted, WEAK, one without its second state.

    A simulation was asked to predict from the first tenth of the samples, not from its start.
    """
    given = experiment(family, seed, number)
    found = identify(given.record, Settings(feedthrough=False))
    assert found.verdict.grade is Grade.GOOD
    assert not any(c.name == 'domain' for c in found.choices)
    assert np.mean(simulated(found.model, given.test)) > 96.0


def test_a_drift_is_no_change_to_predictions_either():
    """Two predictors are likelier than one; one that drifts explains as much."""
    given = experiment('gain-drift', 37, 6)
    found = identify(given.record, Settings(feedthrough=False))
    assert found.verdict.grade is Grade.GOOD
    assert np.mean(simulated(found.model, given.test)) > 97.0


@pytest.mark.parametrize(('seed', 'reachable', 'grade'), [
    *slow((42, 94.8, Grade.GOOD), (41, 95.2, Grade.WEAK))])
def test_a_gain_that_drifts_does_not_grow(seed, reachable, grade):
    """
    A sweep: modes that grow by 2.1 and 2.5 rad/s predict it to 99 and 97.5 %, up to 0.5 s ahead.

    One second ahead, where they have grown by e^2, a simulation predicts it better. One lag with
    a dead time of 33 ms explains that of seed 41 as well as a slower one with none: a response
    that is known to 13 %.
    """
    given = experiment('gain-drift', seed, 4)
    found = identify(given.record, Settings(feedthrough=False))
    model = found.model or found.rejected_model
    assert np.max(model.poles.real) <= 0.0
    assert np.mean(simulated(model, given.test)) > reachable - 2.0
    assert found.verdict.grade is grade


@pytest.mark.parametrize(('grows', 'noise'), [(0.15, 0.001), *slow(
    (0.3, 0.03), (0.3, 0.001), (0.6, 0.03))])
def test_a_plant_that_grows_slowly_is_told_by_predictions(grows, noise):
    """With little noise free modes and poles on the axis simulate 10 s to 97 %, and are wrong."""
    rng, h = np.random.default_rng(1), 0.02
    joined = expm(h * np.array([[0.0, 1.0, 0.0], [20.0 * grows, grows - 20.0, 80.0], [0.0] * 3]))
    wanted, x = np.repeat(np.sign(rng.standard_normal(10)), 50), np.zeros(2)
    u, y = np.empty(500), np.empty(500)
    for k in range(500):
        y[k] = x[0] + noise * rng.standard_normal()
        u[k] = wanted[k] - y[k]
        x = joined[:2, :2] @ x + joined[:2, 2] * u[k]
    t = h * np.arange(500)
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'), Settings(feedthrough=False))
    assert found.verdict.grade is Grade.GOOD
    assert found.model.n == 2
    assert np.max(found.model.poles.real) == pytest.approx(grows, abs=0.003)


def flown_again(given) -> Record:
    """Return the other flight of an experiment, with noise of its own."""
    signal, rng = given.test.outputs[0], np.random.default_rng(given.number)
    noise = 0.05 * signal.values.std(axis=0) * rng.standard_normal(signal.values.shape)
    return replace(given.test, outputs=(replace(signal, values=signal.values + noise),))


@pytest.mark.parametrize(('family', 'number'), [
    ('quadratic-drag', 2), *slow(('saturation-30', 4), ('quadratic-drag', 4))])
def test_a_plant_that_is_not_linear_is_one_plant(family, number):
    """Drag is told by curves of both records, whatever their noise is, not by another plant."""
    given = experiment(family, 2, number)
    found = identify([given.record, given.test])
    assert 'does not hold' not in found.verdict.reason


@pytest.mark.parametrize(('family', 'number', 'calm'), [
    ('clock-drift', 1, False),
    *slow(('turbulence-weak', 2, False), ('dead-zone', 4, True), ('jittering-delay', 2, False),
          ('turbulence-strong', 2, False))])
def test_what_disturbs_a_record_is_no_change_of_the_plant(family, number, calm):
    """
    Each record has a predictor of its own, and one in calm air is simulated.

    "The plant changed" was said of the first three; the gusty ones were
    compared by predictions of the gusty record alone, and called changed or not linear.
    """
    given = experiment(family, 2 if number == 2 else 1, number)
    found = identify([given.record, given.test if calm else flown_again(given)],
                     Settings(feedthrough=False))
    assert found.status is Status.OK
    assert 'change' not in found.verdict.reason
    assert found.good


@pytest.mark.slow
def test_an_output_without_noise_does_not_hide_a_disturbed_plant():
    """Of errors of less than 1e-4 of the motion the likelihood of any colour is not asked."""
    rng, h = np.random.default_rng(2), 0.02
    t = h * np.arange(800)
    u = np.sign(np.sin(0.5 * t ** 1.4))
    joined = expm(h * np.array([[0.0, 1.0, 0.0], [-9.0, -2.0, 1.0], [0.0, 0.0, 0.0]]))
    stays, gust, x, y = np.exp(-h / 3.0), 0.0, np.zeros(3), np.empty((800, 2))
    for k in range(800):
        y[k] = x[0], x[2]
        gust = stays * gust + 0.7 * np.sqrt(1.0 - stays ** 2) * rng.standard_normal()
        x[:2] = joined[:2, :2] @ x[:2] + joined[:2, 2] * (u[k] + gust)
        x[2] = np.exp(-1.5 * h) * x[2] + (1.0 - np.exp(-1.5 * h)) * u[k]
    y[:, 0] += 0.01 * np.std(y[:, 0]) * rng.standard_normal(800)
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'))
    assert any(c.value == 'disturbed' for c in found.choices)
    assert np.min(np.abs(found.model.poles - (-1.0 + 2.83j))) < 0.4


@pytest.mark.slow
def test_a_plant_that_hardly_grows_is_simulated():
    """The place of a cart, its pole not measured: an integrator, and no mode of 0.042 rad/s."""
    record = experiment('cart-pole', 3, 3).record
    place = replace(record.outputs[0], values=record.outputs[0].values[:, :1])
    found = identify(replace(record, outputs=(place,)), Settings(feedthrough=False))
    assert found.good
    assert not any(c.value == 'predictions' for c in found.choices)
    assert np.max(found.model.poles.real) < 1e-3


@pytest.mark.parametrize('feedthrough', [False, pytest.param(True, marks=[
    pytest.mark.slow, pytest.mark.xfail(
        reason='a simulation with an integrator leaves 47 %, less than half: WEAK, and the '
               'reason says to set `feedthrough: false`')])])
def test_an_unstable_plant_under_its_controller_is_told_to_be_one(feedthrough):
    """With D free it was simulated with a mode on the axis: REJECT, 411 % of the motion left."""
    rng, h = np.random.default_rng(1), 0.01
    joined = expm(h * np.array([[0.0, 1.0, 0.0], [9.0, -0.5, 4.0], [0.0, 0.0, 0.0]]))
    wanted, x = np.repeat(rng.standard_normal(120), 50), np.zeros(2)
    u, y = np.empty(6000), np.empty(6000)
    for k in range(6000):
        y[k] = x[0] + 0.01 * rng.standard_normal()
        u[k] = 6.0 * (wanted[k] - y[k]) - 1.5 * x[1]
        x = joined[:2, :2] @ x + joined[:2, 2] * (u[k] + 0.3 * rng.standard_normal())
    record = Record.from_arrays(h * np.arange(6000), u, h * np.arange(6000), y, input_hold='zoh')
    found = identify(record, Settings(feedthrough=feedthrough))
    assert found.verdict.grade is Grade.GOOD
    assert np.min(np.abs(found.model.poles - 2.76)) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize(('seed', 'number', 'least'), [
    (44, 6, 82.0), pytest.param(45, 5, 90.0, marks=[pytest.mark.slow, pytest.mark.xfail(
        reason='89.9 % of another flight')])])
def test_states_do_not_imitate_what_nobody_measured(seed, number, least):
    """
    A second input of ten seconds has fewer independent samples than eight states have numbers.

    Models of nine and seven left errors of 2 %, nearly white, and simulated another flight to 72.5
    and 80.3 %.
    """
    given = experiment('second-input', seed, number)
    found = identify(given.record, Settings(feedthrough=True))
    assert np.mean(simulated(found.model or found.rejected_model, given.test)) > least


@pytest.mark.parametrize(('edge', 'seed'), [(5.0, 1), *slow((5.0, 0), (10.0, 3)), pytest.param(
    10.0, 1, marks=[pytest.mark.slow, pytest.mark.xfail(
        strict=False, reason='simulates 97.9 % with eight states, WEAK: of the parts that '
        'are learnt a mode grows')])])
@pytest.mark.parametrize('feedthrough', [True, *slow(False)])
def test_noise_that_a_filter_has_passed_does_not_cost_the_plant(feedthrough, edge, seed):
    """
    Of a driver that filters what it sends hardly anything is left at high frequencies.

    There a plant that predicts a little better was worth 44 % of the motion: 59 % on another run.
    """
    p = plant([[0.0, 1.0], [-20.0, -3.0]], [[0.0], [20.0]], [[1.0, 0.0]])

    def run(seed, noise):
        rng = np.random.default_rng(seed)
        t_u, t_y = np.arange(0.0, 20.0, 0.02), np.arange(0.0, 20.0, 0.01)
        u = rng.choice([-1.0, 1.0], 67)[(t_u / 0.3).astype(int), np.newaxis]
        y = held_response(p, t_u, u, t_y)
        y = y + noise * y.std() * rng.standard_normal(y.shape)
        return Record.from_arrays(t_u, u, t_y, lfilter(*butter(2, edge / 50.0), y, axis=0),
                                  input_hold='zoh')

    found = identify(run(seed, 0.3), Settings(feedthrough=feedthrough))
    assert found.verdict.grade is Grade.GOOD
    assert simulation(found.model, run(seed + 100, 0.0), trim='refit').fit.min() > 95.0


@pytest.mark.slow
@pytest.mark.parametrize(('family', 'seed', 'number'), [
    ('turbulence-weak', 3, 5), ('second-input', 39, 1),
    *slow(('turbulence-strong', 38, 4))])
def test_an_order_that_is_given_as_it_was_found_makes_no_model_worse(family, seed, number):
    """Without predictions a second flight is simulated to 86.7, 89.8 and 87.5 %, not 95 to 97."""
    given = experiment(family, seed, number)
    found = identify(given.record)
    named = identify(given.record, Settings(order=found.model.n))
    fits = [np.mean(simulated(one.model, given.test)) for one in (found, named)]
    print(family, fits)
    assert found.choices
    assert fits[1] > fits[0] - 0.5


@pytest.mark.parametrize(('family', 'seed', 'number', 'settings', 'searched'), [
    ('rates-1x1', 300, 3, {}, False), ('rates-1x1', 300, 3, {'order': 2}, True),
    *slow(
        ('saturation-30', 105, 0, {}, True),
        ('rates-1x1', 300, 4, {}, True),            # it decays
        ('set-points', 300, 2, {}, True),
        ('rates-4x3', 300, 0, {}, False), ('sliding-mass', 105, 0, {}, True),
        ('gain-drift', 105, 6, {}, True))])
def test_simulations_are_searched_for_unless_predictions_leave_clearly_less(
        monkeypatch, family, seed, number, settings, searched):
    """Of loops only the one near the plant is compared; others may be better elsewhere."""
    made = []
    monkeypatch.setattr(solve, 'search_orders', lambda *args, max_order, **kwargs: made.append(
        max_order) or search_orders(*args, max_order=max_order, **kwargs))
    record = experiment(family, seed, number).record
    found = identify(record, Settings(feedthrough=False, **settings))
    assert (max(made, default=0) > 2) is searched
    assert (found.model or found.rejected_model) is not None
