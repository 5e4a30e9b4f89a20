# SPDX-License-Identifier: Apache-2.0
"""Validation against simulated truth, exact laws and hand-made filters."""

from dataclasses import replace

from marks import slow
import numpy as np
from plants import moved_before
import pytest
import scipy.linalg

from ctsid_core.errors import DataError
from ctsid_core.linear import matrix_functions
from ctsid_core.model import simulation as simulation_module
from ctsid_core.model.predictor import MEMORY, predictor_gain
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import cell, fit, prediction, residual_tests, simulation, vaf
from ctsid_core.signals.record import Record, Signal

STABLE = StateSpace([[0, 1, 0], [-4, -0.8, 1], [0, 0, -5]], [[0, 0], [1, 0], [0, 3]],
                    [[1, 0, 0], [0, 1, 1]], [[0, 0], [0, 0.5]], K=[[3, 0], [2, 1], [0, 1]],
                    delay=(0.0, 0.07), x_trim=[0.1, -0.2, 0.3], y_trim=[5.0, -1.0])
LAG_1 = StateSpace([[-1.0]], [[1.0]], [[1.0]])
UNSTABLE = StateSpace([[0, 1], [6, -1]], [[0], [1]], [[1, 0]], K=[[9], [22]])  # +2 and -3


def stamps(rng, count, end):
    return np.sort(rng.uniform(0, end, count))


def lowpass(rng, time, width, tau=0.2):
    x = np.zeros((len(time), width))
    for k, h in enumerate(np.diff(time), start=1):
        a = np.exp(-h / tau)
        x[k] = a * x[k - 1] + np.sqrt(1 - a * a) * rng.standard_normal(width)
    return x


def record_of(model, seed, *, end=10.0, noise=0.0, counts=(400, 300), x0=None, split=False):
    """Noise-free or noisy outputs; with `split`, every channel is sampled at its own stamps."""
    rng = np.random.default_rng(seed)
    t_u = stamps(rng, 200, end)
    inputs = (Signal(t_u, lowpass(rng, t_u, model.nu), 'zoh'),)
    x0 = rng.standard_normal(model.n) if x0 is None else x0
    own = [np.concatenate([[0.1], 0.1 + stamps(rng, c, end - 0.2)])
           for c in (counts if split else counts[:1])]
    times = np.unique(np.concatenate(own))
    clean = model.simulate(inputs, times, x0)
    values = [clean[np.searchsorted(times, t)] for t in own]
    values = [v + noise * clean.std(axis=0) * rng.standard_normal(v.shape) for v in values]
    outputs = tuple(Signal(t, v[:, [i]] if split else v)
                    for i, (t, v) in enumerate(zip(own, values, strict=True)))
    return Record.from_signals(inputs, outputs)


@pytest.mark.parametrize('value', [0.123, 0.0, 1e6 / 3.0])
def test_an_output_that_repeats_a_value_has_no_fit(value):
    """The mean of equal values is rounded: a fit of -1e18 %."""
    y = np.full((50, 1), value)
    assert np.isnan(fit(y, y + 1.0)).all()
    assert np.isnan(vaf(y, y + 1.0)).all()


@pytest.mark.parametrize('delay', [0.06, 0.6, 3.0])
def test_what_acted_before_the_record_is_not_missed(delay):
    """A robot that moved before: for its dead time outputs follow what nobody recorded."""
    record = moved_before(np.random.default_rng(3), 30.0, delay)
    right = StateSpace([[-2.0]], [[2.0]], [[1.0]], delay=(delay,), K=[[0.0]])
    known = record.outputs[0].time >= record.start + delay - 1e-9
    for found in (simulation(right, record), prediction(right, record, 10)):
        assert np.count_nonzero(known) == len(found.times)
        rest = (found.y - found.y_hat)[np.isfinite(found.y_hat)]
        assert np.std(rest) == pytest.approx(0.02, rel=0.1)
    assert simulation(right, record).fit == pytest.approx(
        100 * (1 - 0.02 / record.outputs[0].values[known].std()), abs=0.3)


def test_without_a_gain_predictions_are_simulations_from_the_samples_so_far():
    """Of modes that outlast the record, too: a tenth of it tells their states poorly."""
    model = StateSpace([[0, 1, 0], [-0.1, -0.02, 1], [0, 0, -0.05]], STABLE.B, [[1, 0, 0]],
                       [[0, 0.5]], delay=STABLE.delay)
    record = record_of(model, 5, noise=0.3)
    found = prediction(model, record, 1)
    for count in (60, 200, len(found.times) - 1):
        until = replace(record, end=float(found.times[count - 1]))
        so_far = model.simulate(record.inputs, found.times, simulation(model, until).x0)
        assert found.y_hat[count, 0] == pytest.approx(so_far[count, 0], rel=1e-6)


def test_an_output_in_other_units_starts_a_filter_no_more_than_others():
    """Two measurements of one slow state, each with its own noise: both tell of it alike."""
    model = StateSpace([[-0.02]], [[1.0]], [[1.0], [1.0]], noise=np.diag([0.01, 0.01]))
    record = record_of(model, 4, noise=0.2)
    scale = np.array([1.0, 1e6])
    y = record.outputs[0]
    other = replace(model, C=scale[:, np.newaxis] * model.C, noise=np.diag(0.01 * scale ** 2))
    found = prediction(other, replace(record, outputs=(replace(y, values=y.values * scale),)), 5)
    np.testing.assert_allclose(found.y_hat / scale, prediction(model, record, 5).y_hat, rtol=1e-9)


@pytest.mark.parametrize('pole', [60.0, 80.0, 300.0])
def test_a_filter_that_explodes_has_no_fit(pole):
    rng, t = np.random.default_rng(0), 0.02 * np.arange(2000)
    record = Record.from_arrays(t, rng.standard_normal(2000), t, rng.standard_normal(2000))
    assert prediction(StateSpace([[pole]], [[1.0]], [[1.0]]), record, 1).fit[0] < -1e3


def test_the_latest_of_several_inputs_says_from_when_all_is_known():
    model = StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0]], delay=(0.1, 2.0), noise=[[1.0]])
    record = record_of(model, 2)
    assert simulation(model, record).times[0] >= record.inputs[0].time[0] + 2.0
    later = record.between(5.0, 9.0, lead=4.0)           # what acted before is known there
    found = prediction(model, later, 3)
    assert 5.0 <= simulation(model, later).times[0] == found.times[0] < 5.1
    assert found.times[-1] <= 9.0
    # The state at the first stamp is the record's, of which nothing is noise.
    np.testing.assert_allclose(found.x0, simulation(model, later).x0, atol=1e-6)


def test_where_nothing_is_known_nothing_is_compared():
    record = record_of(LAG_1, 3)
    late = replace(LAG_1, delay=(20.0,))
    for found in (simulation(late, record), prediction(late, record, 1)):
        assert found.times.shape == (0,)
        assert np.isnan(found.fit).all()
    rng, t = np.random.default_rng(0), np.arange(0.0, 20.0, 0.02)
    t = t[(t < 1.0) | (t > 7.0)]                        # a second, which is too short, and a pause
    u = (Signal(t, rng.standard_normal((len(t), 1)), 'zoh'),)
    late = replace(LAG_1, delay=(2.0,))
    record = Record.from_signals(u, (Signal(t, late.simulate(u, t, np.array([3.0]))),))
    found = simulation(late, record)
    assert found.times[0] >= 9.0
    assert found.x0 == pytest.approx(found.y[0], abs=1e-9)


def test_fit_and_vaf_of_known_numbers():
    y = np.array([[1.0, 2], [3, 2], [1, 2], [3, 2]])
    shifted = y + np.array([1.0, 0])
    assert fit(y, y)[0] == 100
    assert fit(y, np.full_like(y, 2.0))[0] == pytest.approx(0)
    assert fit(y, shifted)[0] == pytest.approx(0)
    assert vaf(y, shifted)[0] == pytest.approx(100)
    assert vaf(y, 2 + (y - 2) / 2)[0] == pytest.approx(75)
    assert fit(y, 2 + (y - 2) / 2)[0] == pytest.approx(50)
    assert np.isnan(fit(y, y)[1])
    assert np.isnan(vaf(y, y)[1])


def test_rows_without_a_sample_do_not_count_but_infinity_does():
    y = np.array([[1.0], [3], [np.nan], [5], [8]])
    y_hat = np.array([[1.0], [3], [9], [np.nan], [8]])
    assert fit(y, y_hat)[0] == 100
    y_hat[4] = np.inf
    assert fit(y, y_hat)[0] == -np.inf
    assert vaf(y, y_hat)[0] == -np.inf
    assert np.isnan(fit(y[:1], y_hat[:1])[0])
    with pytest.raises(DataError, match='same shape'):
        fit(y, y_hat[:3])


@pytest.mark.parametrize('split', [False, True])
def test_simulation_of_the_truth_is_perfect_and_finds_the_initial_state(split):
    x0 = np.array([3.0, -2.0, 1.0])
    found = simulation(STABLE, record_of(STABLE, 0, x0=x0, split=split))
    assert (found.fit > 100 - 1e-9).all()
    assert (found.vaf > 100 - 1e-9).all()
    assert found.x0 == pytest.approx(x0, abs=1e-9)
    assert np.isnan(found.y).any() == split
    assert not np.isnan(found.y_hat).any()


def test_estimated_initial_state_is_the_least_squares_one():
    record = record_of(STABLE, 1, noise=0.3)
    found = simulation(STABLE, record)
    size = found.y.std(axis=0)

    def cost(x0):
        y_hat = STABLE.simulate(record.inputs, found.times, x0)
        return np.sum(((found.y - y_hat) / size) ** 2)

    best = cost(found.x0)
    assert np.allclose(STABLE.simulate(record.inputs, found.times, found.x0), found.y_hat)
    for step in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(found.x0 + step) > best


def test_trim_can_be_refitted():
    record = record_of(STABLE, 2)
    lower = replace(record.outputs[0], values=record.outputs[0].values - [4.0, 0.0])
    moved = replace(record, outputs=(lower,))
    assert simulation(STABLE, moved).fit[0] < 50
    found = simulation(STABLE, moved, trim='refit')
    assert (found.fit > 100 - 1e-9).all()


def test_an_unstable_model_is_simulated_over_any_length():
    # e^(2 T) = e^80: forward simulation has no digit left, and a record can only exist under
    # control. Here: an input that cancels the unstable mode's growth, y = C x of a closed loop.
    gain = np.array([[14.0, 4.0]])
    loop = StateSpace(UNSTABLE.A - UNSTABLE.B @ gain, UNSTABLE.B,
                      np.vstack([UNSTABLE.C, -gain]), [[0], [1]])
    rng = np.random.default_rng(0)
    t = np.linspace(0, 40, 8001)
    both = loop.simulate((Signal(t, lowpass(rng, t, 1), 'linear'),), t, [0.5, 0.0])
    record = Record.from_arrays(t, both[:, 1], t, both[:, 0], input_hold='smooth')
    found = simulation(UNSTABLE, record)
    assert found.fit[0] > 99
    assert found.x0 == pytest.approx([0.5, 0.0], abs=2e-3)
    assert fit(found.y, UNSTABLE.simulate(record.inputs, found.times))[0] < -1e20


def test_a_simulation_that_leaves_floating_point_has_no_fit():
    wild = StateSpace([[150, 50], [-50, 150]], [[1], [1]], [[1, 1]])
    record = record_of(LAG_1, 0)
    found = simulation(wild, record)
    assert not np.isnan(found.y_hat).any()
    diverged = np.nan_to_num(wild.simulate(record.inputs, found.times), nan=np.inf)
    assert fit(found.y, diverged)[0] == -np.inf


def test_stiff_models_and_unobservable_states_do_no_harm():
    A = scipy.linalg.block_diag(STABLE.A, [[-1e6]], [[-1.0]])
    stiff = StateSpace(A, np.vstack([STABLE.B, [[1e6, 0], [1, 1]]]),
                       np.hstack([STABLE.C, [[1, 0], [0, 0]]]))
    found = simulation(stiff, record_of(stiff, 3))
    assert (found.fit > 100 - 1e-6).all()
    assert np.isfinite(found.x0).all()


def test_a_double_integrator_is_validated_too():
    model = StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], K=[[2], [1]])
    record = record_of(model, 4, x0=np.array([1.0, -1.0]))
    found = simulation(model, record)
    assert found.fit[0] > 100 - 1e-8
    assert found.x0 == pytest.approx([1, -1], abs=1e-8)
    assert prediction(model, record, 5).fit[0] > 100 - 1e-6


def test_an_unknown_option_and_other_channels_are_refused():
    record = record_of(STABLE, 0)
    with pytest.raises(DataError, match="`trim` is 'free'"):
        simulation(STABLE, record, trim='free')
    with pytest.raises(DataError, match='2 input channels given, but the model has 1'):
        simulation(UNSTABLE, record)
    with pytest.raises(DataError, match='`residuals`'):
        residual_tests(STABLE, record, residuals='all')
    for horizon in (0, 1.5, -1):
        with pytest.raises(DataError, match='`horizon_steps`'):
            prediction(STABLE, record, horizon)


@pytest.mark.parametrize('split', [False, *slow(True)])
@pytest.mark.parametrize('gain', [0.0, 1.0, 1e4], ids=['K=0', 'K', 'K large'])
def test_prediction_of_noise_free_data_is_perfect_at_any_gain(gain, split):
    model = replace(STABLE, K=gain * STABLE.K)
    record = record_of(STABLE, 5, split=split)
    for horizon in (1, 7):
        found = prediction(model, record, horizon)
        assert (found.fit > 100 - 1e-6).all()
        assert found.notes == ()


@pytest.mark.parametrize('split', [False, True])
def test_prediction_does_not_look_ahead(split):
    record = record_of(STABLE, 6, noise=0.2, split=split)
    horizon, when = 4, 6.0
    before = prediction(STABLE, record, horizon)
    changed = tuple(replace(s, values=s.values + 50.0 * (s.time > when)[:, np.newaxis])
                    for s in record.outputs)
    after = prediction(STABLE, replace(record, outputs=changed), horizon)
    for i in range(STABLE.ny):
        own = np.flatnonzero(~np.isnan(before.y[:, i]))
        unaware = before.times[own[:-horizon]] <= when
        goals = own[horizon:]
        assert np.isfinite(before.y_hat[goals[unaware], i]).sum() > 100
        assert np.array_equal(before.y_hat[goals[unaware], i], after.y_hat[goals[unaware], i],
                              equal_nan=True)
        assert not np.isclose(before.y_hat[goals[~unaware], i],
                              after.y_hat[goals[~unaware], i]).any()


def kalman(model, Q, R, dt, u, y):
    """One-step predictions of a textbook discrete Kalman filter."""
    n = model.n
    big = scipy.linalg.expm(dt * np.block([[model.A, model.B], [np.zeros((1, n + 1))]]))
    F, G = big[:n, :n], big[:n, n:]
    P = scipy.linalg.solve_discrete_are(F.T, model.C.T, Q, R)
    L = F @ P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + R)
    x, found = np.zeros(n), []
    for u_k, y_k in zip(u, y, strict=True):
        found.append(model.C @ x)
        x = F @ x + G @ u_k + L @ (y_k - model.C @ x)
    return np.array(found)


def noisy_plant(plant, seed, intensity, sigma, dt=0.01, count=4000):
    """Return a record with process noise on the states, exact in its second moments."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(count)
    u = lowpass(rng, t, 1)
    n = plant.n
    big = scipy.linalg.expm(dt * np.block([[-plant.A, intensity], [np.zeros((n, n)), plant.A.T]]))
    F = big[n:, n:].T
    Q = F @ big[:n, n:]
    root = np.linalg.cholesky((Q + Q.T) / 2)
    G = np.linalg.solve(plant.A, F - np.eye(n)) @ plant.B
    x, y = np.zeros(n), []
    for u_k in u:
        y.append(plant.C @ x)
        x = F @ x + G @ u_k + root @ rng.standard_normal(n)
    clean = np.array(y)
    y = clean + sigma * rng.standard_normal((count, 1))
    return Record.from_arrays(t, u, t, y, input_hold='zoh'), Q, u, y, clean[:, 0]


@pytest.mark.parametrize('sigma', [0.05, 0.002], ids=['low gain', 'high gain'])
def test_predictions_are_as_good_as_a_discrete_kalman_filters(sigma):
    plant = StateSpace([[0, 1], [-4, -0.8]], [[0], [1]], [[1, 0]])
    intensity, dt = np.diag([0.01, 0.2]), 0.01
    R = np.array([[sigma ** 2 * dt]])  # intensity of the measurement noise
    P = scipy.linalg.solve_continuous_are(plant.A.T, plant.C.T, intensity, R)
    model = replace(plant, K=P @ plant.C.T / R[0, 0], noise=R)
    record, Q, u, y, _ = noisy_plant(plant, 7, intensity, sigma, dt)
    rival = kalman(plant, Q, np.array([[sigma ** 2]]), dt, u, y)
    found = prediction(model, record, 1)
    rows = np.isfinite(found.y_hat[:, 0])
    ours = np.std(y[rows] - found.y_hat[rows])
    best = np.std(y[rows] - rival[rows])
    assert ours < 1.03 * best
    assert found.fit[0] > simulation(model, record).fit[0] + 10


def test_a_filter_fed_by_two_sensors_of_different_stamps_beats_either_alone():
    plant = StateSpace([[0, 1], [-4, -0.8]], [[0], [1]], [[1, 0]])
    intensity, sigma, dt = np.diag([0.01, 0.2]), 0.05, 0.01
    first, _, _, _, clean = noisy_plant(plant, 8, intensity, sigma, dt)
    t, rng = first.outputs[0].time, np.random.default_rng(9)
    t2 = t[:-1:2] + 0.004
    second = np.interp(t2, t, clean) + sigma * rng.standard_normal(len(t2))
    record = Record.from_signals(first.inputs, (first.outputs[0],
                                                Signal(t2, second[:, np.newaxis])))
    errors = {}
    for ears in ((1, 1), (1, 0), (0, 1)):
        C = np.array([[1.0, 0], [1, 0]])
        R = dt * sigma ** 2 * np.diag([1.0, 2.0]) / np.maximum(ears, 1e-6)
        P = scipy.linalg.solve_continuous_are(plant.A.T, C.T, intensity, R)
        model = StateSpace(plant.A, plant.B, C, K=np.linalg.solve(R, C @ P).T, noise=R)
        found = prediction(model, record, 1)
        rows = np.searchsorted(found.times, t[:-1])
        error = found.y_hat[rows, 0] - clean[:-1]
        errors[ears] = np.sqrt(np.nanmean(error ** 2))
    assert errors[1, 1] < 0.95 * errors[1, 0]
    assert errors[1, 1] < 0.95 * errors[0, 1]


def test_longer_horizons_predict_worse_and_approach_the_simulation():
    plant = StateSpace([[0, 1], [-4, -0.8]], [[0], [1]], [[1, 0]])
    intensity, sigma, dt = np.diag([0.01, 0.2]), 0.02, 0.01
    R = np.array([[sigma ** 2 * dt]])
    P = scipy.linalg.solve_continuous_are(plant.A.T, plant.C.T, intensity, R)
    model = replace(plant, K=P @ plant.C.T / R[0, 0], noise=R)
    record, *_ = noisy_plant(plant, 10, intensity, sigma, dt)
    fits = [prediction(model, record, h).fit[0] for h in (1, 20, 100, 1500)]
    assert fits[0] > fits[1] > fits[2]
    assert fits[3] == pytest.approx(simulation(model, record).fit[0], abs=8)


def test_horizons_count_the_samples_of_each_output():
    found = prediction(STABLE, record_of(STABLE, 11, split=True, counts=(400, 40)), 3)
    for i in range(2):
        own = np.flatnonzero(~np.isnan(found.y[:, i]))
        predicted = np.isfinite(found.y_hat[own, i])
        first = int(np.argmax(predicted))
        assert predicted[first:].all()
        assert found.times[own[first - 3]] > found.times[0] + 0.09 * np.ptp(found.times)
        assert found.times[own[first - 4]] < found.times[0] + 0.1 * np.ptp(found.times)
        assert np.isfinite(found.y_hat[:, i]).sum() == predicted.sum()


def test_a_model_that_explodes_explains_nothing_and_breaks_nothing():
    """Poles that coincide, and more than e^700 within the record: what is bounded is next to 0."""
    wild = StateSpace([[1e3, 1], [0, 1e3]], [[0], [1]], [[1, 0]])
    t = np.linspace(0, 5, 200)
    record = Record.from_arrays(t, np.sin(t), t, np.cos(t))
    for trim in ('model', 'refit'):
        found = simulation(wild, record, trim=trim)
        assert found.fit[0] < 1.0
        assert not np.isnan(found.y_hat).any()


def test_an_unstable_model_without_noise_model_gets_a_filter_and_says_so():
    rng = np.random.default_rng(1)
    gain = np.array([[14.0, 4.0]])
    loop = StateSpace(UNSTABLE.A - UNSTABLE.B @ gain, UNSTABLE.B,
                      np.vstack([UNSTABLE.C, -gain]), [[0], [1]])
    t = np.linspace(0, 40, 8001)
    both = loop.simulate((Signal(t, lowpass(rng, t, 1), 'linear'),), t)
    noisy = both[:, 0] + 0.05 * both[:, 0].std() * rng.standard_normal(len(t))
    record = Record.from_arrays(t, both[:, 1], t, noisy, input_hold='smooth')
    own = prediction(UNSTABLE, record, 10)
    found = prediction(replace(UNSTABLE, K=np.zeros((2, 1))), record, 10)
    assert own.notes == ()
    assert 'Kalman filter' in found.notes[0]
    assert found.fit[0] > 90  # of 95, the limit that the noise sets
    assert found.fit[0] > own.fit[0]


def test_the_substitute_filter_mirrors_unstable_predictor_poles():
    # about the line that also moves integrators, MEMORY / duration left of the imaginary axis
    line = MEMORY / 50.0
    for K in ([[0.0], [0.0]], [[-1.0], [3.0]]):
        model = replace(UNSTABLE, K=K)
        before = np.linalg.eigvals(model.A - model.K @ model.C)
        gain, note = predictor_gain(model, np.eye(1), 50.0)
        after = np.linalg.eigvals(model.A - gain @ model.C)
        wanted = -line - np.abs(before.real + line) + 1j * before.imag
        assert np.allclose(np.sort_complex(after), np.sort_complex(wanted))
        assert note
    assert predictor_gain(UNSTABLE, np.eye(1), 50.0)[0] is UNSTABLE.K


def test_an_integrator_without_noise_model_is_predicted():
    integrator = StateSpace([[0.0]], [[1.0]], [[1.0]])
    record = record_of(integrator, 17, noise=0.05)
    found = prediction(integrator, record, 1)
    assert 'Kalman filter' in found.notes[0]
    assert found.fit[0] > 90


def test_an_unseen_unstable_mode_cannot_be_predicted_and_that_is_said():
    model = StateSpace(np.diag([2.0, -1.0]), [[1], [1]], [[0, 1]])
    record = record_of(model, 12, end=5.0)
    found = prediction(model, record, 1)
    assert np.isnan(found.fit).all()
    assert 'seen by no output' in found.notes[0]


def test_records_too_short_to_judge_give_nan_not_an_error():
    t = np.array([0.0, 1.0])
    record = Record.from_arrays(t, np.zeros((2, 2)), t, np.ones((2, 2)))
    inner = record.between(0.4, 0.6)
    for model_record in (record, inner):
        assert np.isnan(prediction(STABLE, model_record, 3).fit).all()
        assert np.isnan(simulation(STABLE, model_record).fit).all()
        assert np.isnan(residual_tests(STABLE, model_record).whiteness).all()
    assert len(simulation(STABLE, inner).times) == 0


def test_a_pure_gain_is_validated():
    gain = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]])
    record = record_of(gain, 13)
    assert simulation(gain, record).fit[0] > 100 - 1e-9
    assert prediction(gain, record, 2).fit[0] > 100 - 1e-9


def test_ill_conditioned_eigenvectors_change_nothing(monkeypatch):
    record = record_of(STABLE, 14, noise=0.1)
    wanted = simulation(STABLE, record), prediction(STABLE, record, 5)
    for module in (simulation_module, matrix_functions):
        monkeypatch.setattr(module, 'modes', lambda A: None)
    found = simulation(STABLE, record), prediction(STABLE, record, 5)
    for a, b in zip(wanted, found, strict=True):
        assert np.allclose(a.y_hat, b.y_hat, rtol=1e-9, atol=1e-9, equal_nan=True)
        assert np.allclose(a.x0, b.x0, rtol=1e-7, atol=1e-7)


LAG = StateSpace([[-2.0]], [[2.0, 0.0]], [[1.0]])


def coloured_record(seed, tau, model=LAG, count=600, end=60.0):
    """Outputs with noise of correlation time tau at random stamps; two independent inputs."""
    rng = np.random.default_rng(seed)
    t_u, t_y = np.arange(0, end, 0.1), stamps(rng, count, end)
    inputs = (Signal(t_u, lowpass(rng, t_u, 2, 0.5), 'zoh'),)
    noise = lowpass(rng, t_y, 1, tau) if tau else rng.standard_normal((count, 1))
    y = model.simulate(inputs, t_y) + 0.3 * noise
    return Record.from_signals(inputs, (Signal(t_y, y),))


@pytest.mark.slow
@pytest.mark.parametrize('tau', [0.0, 0.3], ids=['white', 'coloured'])
def test_input_independence_holds_its_level_also_for_coloured_residuals(tau):
    p = np.concatenate([residual_tests(LAG, coloured_record(seed, tau)).independence.ravel()
                        for seed in range(100)])
    assert len(p) == 200
    assert 0.01 < np.mean(p < 0.05) < 0.1
    assert 0.4 < np.mean(p < 0.5) < 0.6


@pytest.mark.slow
def test_whiteness_holds_its_level_at_uneven_stamps():
    p = np.array([residual_tests(LAG, coloured_record(seed, 0.0)).whiteness[0]
                  for seed in range(120)])
    assert 0.01 < np.mean(p < 0.05) < 0.1
    assert 0.4 < np.mean(p < 0.5) < 0.6


def test_whiteness_sees_colour_at_uneven_stamps():
    assert residual_tests(LAG, coloured_record(0, 0.0)).whiteness[0] > 0.01
    found = residual_tests(LAG, coloured_record(0, 0.3))
    assert found.whiteness[0] < 1e-6
    assert found.independence.min() > 0.01


def test_dynamics_that_are_missed_show_in_the_right_input():
    truth = replace(LAG, A=[[-1.0]], B=[[2.0, 0.0]])
    both = [residual_tests(LAG, coloured_record(seed, 0.0, truth)).independence[0]
            for seed in range(5)]
    assert max(p[0] for p in both) < 0.01
    assert min(p[1] for p in both) > 0.01
    late = replace(LAG, delay=(0.4, 0.0))
    assert residual_tests(LAG, coloured_record(3, 0.0, late)).independence[0, 0] < 0.01
    assert residual_tests(late, coloured_record(3, 0.0, late)).independence[0, 0] > 0.05


def test_dead_time_and_offsets_of_residuals_do_not_hide_missed_dynamics():
    late = replace(LAG, delay=(5.0, 0.0))
    record = coloured_record(3, 0.0, replace(late, B=2 * LAG.B, y_trim=[100.0]))
    found = residual_tests(late, record).independence[0]
    assert found[0] < 0.01
    assert found[1] > 0.01


def test_one_step_residuals_are_white_where_k_describes_the_noise():
    plant = StateSpace([[0, 1], [-4, -0.8]], [[0], [1]], [[1, 0]])
    intensity, sigma, dt = np.diag([0.01, 0.2]), 0.05, 0.01
    R = np.array([[sigma ** 2 * dt]])
    P = scipy.linalg.solve_continuous_are(plant.A.T, plant.C.T, intensity, R)
    model = replace(plant, K=P @ plant.C.T / R[0, 0], noise=R)
    record, *_ = noisy_plant(plant, 7, intensity, sigma, dt)
    assert residual_tests(model, record).whiteness[0] < 1e-6
    assert residual_tests(model, record, residuals='prediction').whiteness[0] > 0.01


def test_nothing_is_tested_where_nothing_can_be():
    record = record_of(STABLE, 15)  # noise-free: residuals are rounding
    assert np.isnan(residual_tests(STABLE, record).whiteness).all()
    assert np.isnan(residual_tests(STABLE, record).independence).all()
    noisy = coloured_record(0, 0.0)
    still = replace(noisy.inputs[0], values=noisy.inputs[0].values * [1.0, 0.0])
    found = residual_tests(LAG, replace(noisy, inputs=(still,))).independence
    assert np.isnan(found[0]).tolist() == [False, True]


def test_cells_of_bursts_are_not_as_many_as_could_lie_between():
    """60 samples in 0.3 ms each second: 12 million cells."""
    times = (np.arange(60.0)[:, np.newaxis] + 5e-6 * np.arange(60.0)).ravel()
    assert np.ptp(times) / cell(times) <= 10.0 * len(times)
    assert cell(times[::60]) == 1.0
