# SPDX-License-Identifier: Apache-2.0
"""The exam: its robots move as they should, and its judgements are right where truth is known."""

from __future__ import annotations

from dataclasses import replace
import time

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov
from scipy.signal import StateSpace as ScipyPlant
from scipy.signal import cont2discrete, dlsim

from ctsid_core import Estimate, Grade, Record, Settings, StateSpace, Status, Verdict
from ctsid_ros.studies.robots import sitting, study
from ctsid_ros.studies.robots.experiment import Robot, as_measured
from ctsid_ros.studies.robots.families import FAMILIES, experiment
from ctsid_ros.studies.robots.filters import GUSTS, NO_NOISE
from ctsid_ros.studies.robots.inputs import KINDS, drive
from ctsid_ros.studies.robots.kept_rows import KeptRows
from ctsid_ros.studies.robots.linear import Held, Linear
from ctsid_ros.studies.robots.linear_families import pair
from ctsid_ros.studies.robots.loops import Stepped
from ctsid_ros.studies.robots.mechanics import accelerated
from ctsid_ros.studies.robots.output_error import Samples
from ctsid_ros.studies.robots.reachable import models, outputs, reachable
from ctsid_ros.studies.robots.regression import HORIZONS, error_of, prediction_errors, regressed
from ctsid_ros.studies.robots.scoring import score
from ctsid_ros.studies.robots.sitting import Reach, TooLate, identified, limited
from ctsid_ros.studies.robots.tables import by_family, by_kind
from ctsid_ros.studies.robots.trials import LEAST, response_off, simulated

GRID = np.arange(0.0, 6.0, 0.02)
LAG = Linear.of_roots(1.2, (-3.0,), 0.1)


def moved(seed: int = 0, width: int = 1, kind: str = 'prbs') -> Held:
    return Held(GRID, drive(kind, np.random.default_rng(seed), GRID, 6.0, 2.0, width))


def model_of(plant: Linear, gain: float = 1.0, **more) -> StateSpace:
    return StateSpace(plant.A, gain * plant.B, plant.C, delay=(plant.delay,) * plant.nu, **more)


def judged(grade: Grade, model: StateSpace) -> Estimate:
    return Estimate(status=Status.OK, settings=Settings(), verdict=Verdict(grade=grade, reason=''),
                    **{'rejected_model' if grade is Grade.REJECT else 'model': model})


def of_lag(noise: float = 0.0, seed: int = 1) -> Record:
    held, times = moved(seed), np.arange(0.0, 6.0, 0.0113)
    y = LAG.move(held, times)
    return Record.from_arrays(held.time, held.values, times, y + noise * np.random.default_rng(
        seed).standard_normal(y.shape), input_hold='zoh')


@pytest.mark.filterwarnings('ignore:Badly conditioned')
@pytest.mark.parametrize('plant', [
    LAG, Linear.of_roots(2.0, (0.0, -4.0), 0.04), Linear.of_roots(1.0, (*pair(20.0, 0.01), -5.0)),
    Linear(np.array([[-2.0, 1.0], [0.0, -5.0]]), np.eye(2), np.array([[1.0, 0.5]]), 0.06)])
def test_linear_plants_move_as_scipy_says(plant):
    held = moved(width=plant.nu)
    exact = cont2discrete((plant.A, plant.B, plant.C, np.zeros((len(plant.C), plant.nu))), 0.02)
    _, y, _ = dlsim(exact, held.values)
    late = round(plant.delay / 0.02)
    ours = plant.move(held, GRID[late:] + 1e-9)
    np.testing.assert_allclose(ours, y[:len(y) - late], atol=1e-7)
    s = ScipyPlant(plant.A, plant.B[:, :1], plant.C, np.zeros((len(plant.C), 1)))
    omega, truth = s.freqresp(np.array([0.5, 3.0]))
    np.testing.assert_allclose(plant.response(omega)[:, 0, 0],
                               truth * np.exp(-1j * omega * plant.delay), rtol=1e-9)


def test_mechanics_agree_with_a_linear_plant():
    spring, held, times = Linear.of_roots(1.0, pair(5.0, 0.2), 0.03), moved(), GRID + 0.007
    place, _ = accelerated(lambda x, v, u: 25.0 * (u - x) - 2.0 * v, held, times, 0.03)
    np.testing.assert_allclose(place, spring.move(held, times)[:, 0], atol=2e-6)


def test_a_loop_steps_as_the_plant_moves():
    held, plant = moved(), Linear.of_roots(1.0, (-3.0, -20.0), 0.05)
    loop, y = Stepped(plant, 0.02), []
    for u in held.values:
        y.append(loop.y[0])
        loop.step(u)
    np.testing.assert_allclose(y, plant.move(held, GRID)[:, 0], atol=1e-12)


@pytest.mark.parametrize('kind', KINDS)
def test_inputs_move_and_are_held_to_their_size(kind):
    u = moved(3, 2, kind).values
    assert (u.std(axis=0) > 0.02).all()
    assert np.abs(u).max() < 4.0
    assert abs(np.corrcoef(u.T)[0, 1]) < 0.95


def test_every_family_has_experiments_with_a_test_of_their_own():
    assert len(FAMILIES) >= 45
    for family in FAMILIES:
        given = experiment(family, 3, 0)
        assert 4.5 < given.record.duration < 20.5, family
        assert len(given.record.outputs[0].time) > 150, family
        assert given.kind in FAMILIES[family].kinds
        assert (given.test is None) == (given.judge == 'none'), family
        assert (given.truth is None) == (given.judge != 'prediction'), family


def test_loops_hold_what_falls_without_them():
    assert np.abs(experiment('cart-pole', 3, 1).record.outputs[0].values[:, 1]).max() < 0.8
    for family in ('rates-1x1', 'rates-4x3'):
        flight = experiment(family, 3, 2)
        assert np.abs(flight.record.outputs[0].values).max() < 10.0
        assert flight.settings.feedthrough is False


def test_filters_are_right_however_small_the_noise_is():
    """Lyapunov's equation of their errors gives the covariance that their gain is made of."""
    truth = experiment('rates-4x3', 17, 5).truth
    drive = NO_NOISE * np.eye(truth.n)
    drive[-truth.ny:, -truth.ny:] += 2.0 * GUSTS * np.eye(truth.ny)
    P = solve_continuous_lyapunov(truth.A - truth.K @ truth.C,
                                  -drive - truth.K @ truth.noise @ truth.K.T)
    assert truth.K @ truth.noise == pytest.approx(P @ truth.C.T, rel=1e-6, abs=1e-9 * P.max())


def test_what_jumps_moves_on_both_sides():
    y = experiment('no-gain-jump', 3, 0).record.outputs[0].values[:, 0]
    half = len(y) // 2
    assert min(np.std(y[:half]), np.std(y[half:])) > 0.05 * np.std(y)


def test_experiments_are_the_same_whenever_they_are_made():
    a, b, c = (experiment('turbulence-weak', 3, n).record.outputs[0].values for n in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a[:50], c[:50])
    kinds = {experiment('roll', 3, n).kind for n in range(7)}
    assert kinds == set(KINDS)


@pytest.mark.slow
def test_brute_force_finds_a_known_plant():
    found = models(outputs(of_lag())[0])
    assert [m.order for m in found] == [1, 2, 3, 4]
    assert -np.exp(found[0].at[0]) == pytest.approx(-3.0, rel=1e-3)
    assert found[0].at[1] == pytest.approx(0.1, abs=1e-3)
    assert reachable(of_lag(0.02), of_lag(seed=2)) > 99.0


@pytest.mark.slow
def test_brute_force_finds_a_weak_mode():
    plant, times = Linear.of_roots(1.0, (*pair(18.0, 0.02), -3.0), 0.05), np.arange(0, 6, 0.01)
    y = plant.move(moved(), times)[:, 0]
    data = Samples(moved(), times, y + 0.05 * np.std(y) * np.random.default_rng(0).standard_normal(
        len(y)))
    other = Samples(moved(5), times, plant.move(moved(5), times)[:, 0])
    assert max(m.fit(other) for m in models(data)) > 97.0


@pytest.mark.parametrize('model', [
    model_of(LAG), model_of(LAG, y_trim=np.array([3.0]), x_trim=np.array([0.5])),
    StateSpace(-3.0 * np.eye(2), [[3.6], [0.0]], [[1.0, 1.0]], delay=(0.1,))])
def test_the_true_model_simulates_what_it_has_not_seen(model):
    assert simulated(model, of_lag())[0] > 99.999


def test_models_with_equal_poles_and_with_feedthrough_are_simulated():
    model = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[1.0, 0.0]],
                       [[0.5, 0.0]], delay=(0.03, 0.2))
    held, times = moved(width=2), np.arange(1.0, 6.0, 0.0137)
    record = Record.from_arrays(held.time, held.values, times, model.simulate(
        [Record.from_arrays(held.time, held.values, times, times, input_hold='zoh').inputs[0]],
        times, [0.3, -0.2]), input_hold='zoh')
    assert simulated(model, record)[0] > 99.99


def test_an_unstable_model_is_simulated_forward():
    runaway = StateSpace([[5.0]], [[1.0]], [[1.0]])
    assert simulated(runaway, of_lag())[0] < -1e3
    assert simulated(StateSpace([[300.0]], [[1.0]], [[1.0]]), of_lag())[0] == LEAST


def test_scores_of_right_and_wrong_models():
    robot = Robot(lambda held, times, rng: LAG.move(held, times), 2.0)
    assert robot.sense is as_measured
    times, rng = of_lag().outputs[0].time, np.random.default_rng(0)
    given = replace(experiment('delayed-lag', 3, 0), record=of_lag(0.02), test=of_lag(seed=2),
                    response=LAG.response, noise_time=times,
                    noise=0.02 * rng.standard_normal((len(times), 1)))
    right = score(given, judged(Grade.GOOD, model_of(LAG)), (99.5,), 0.1)
    assert (right.usable, right.near, right.wrong, right.false_no) == (True, True, False, False)
    assert right.response_off < 1e-6
    shy = score(given, judged(Grade.REJECT, model_of(LAG)), (99.5,), 0.1)
    assert (shy.near, shy.wrong, shy.false_no) == (True, False, True)
    off = score(given, judged(Grade.GOOD, model_of(LAG, 1.3)), (99.5,), 0.1)
    assert (off.near, off.wrong, off.false_no) == (False, True, False)
    assert off.response_off == pytest.approx(30.0, abs=0.1)
    assert score(given, judged(Grade.GOOD, model_of(LAG, 1.05)), (99.5,), 0.1).response_off < 6.0
    assert response_off(given, model_of(LAG, 1.3), judged(Grade.GOOD, model_of(LAG)))[1]
    nothing = replace(given, judge='none', test=None)
    assert score(nothing, judged(Grade.GOOD, model_of(LAG)), (), 0.1).wrong
    runaway = score(given, judged(Grade.WEAK, StateSpace([[5.0]], [[1.0]], [[1.0]])), (99.5,), 0.1)
    assert runaway.divergent
    assert not runaway.wrong


def test_a_regression_predicts_what_follows_from_the_past():
    train, test = of_lag(), of_lag(seed=2)
    assert all(error_of(regressed(train, test, h), test) < 0.02 for h in HORIZONS)
    flight = experiment('rates-1x1', 3, 0)
    bad = error_of(np.roll(flight.test.outputs[0].values, 50, axis=0), flight.test)
    errors = sitting.prediction_reach(flight)
    assert 0.0 < errors[0] < errors[1] < bad
    exact = judged(Grade.GOOD, flight.truth)
    assert not score(flight, exact, errors, 0.1).wrong
    assert score(flight, exact, errors, 0.1).near


def test_a_dead_time_longer_than_what_is_known_before_is_an_error_not_a_fault():
    flight = experiment('rates-1x1', 3, 0)
    own, late = (prediction_errors(m, flight.test) for m in (
        flight.truth, replace(flight.truth, delay=(0.7,))))
    assert late[0] > 1.5 * own[0]


def test_identifications_that_take_too_long_are_given_up(monkeypatch):
    def endless(record, settings):
        while True:
            time.monotonic()

    monkeypatch.setattr(sitting, 'identify', endless)
    given = experiment('delayed-lag', 3, 0)
    estimate, seconds = identified(given, 0.1)
    row = score(given, estimate, (99.0,), seconds)
    assert (row.grade, row.usable, row.near, row.good) == ('LATE', True, False, False)
    with limited(5.0):
        pass
    with pytest.raises(TooLate), limited(0.05):
        endless(None, None)


@pytest.mark.slow
def test_an_exam_is_kept_and_goes_on(tmp_path, monkeypatch, capsys):
    words = ['--families', 'delayed-lag', 'no-white', '--experiments', '1', '--jobs', '1',
             '--out', str(tmp_path)]
    assert study.main(words) == 0
    first = capsys.readouterr().out
    assert 'GOOD of usable' in first
    assert (tmp_path / 'robots_families.csv').read_text().count('\n') == 4
    rows = KeptRows(tmp_path / 'runs.csv').of('seed 1: delayed-lag')
    assert sorted(rows) == [0]
    assert all(row.reachable > 90.0 and row.seconds > 0.0 for row in rows.values())
    assert Reach(tmp_path / 'reachable.txt').of(experiment('delayed-lag', 1, 0)) == (
        rows[0].reachable,)

    def again(*args):
        raise AssertionError('it was kept')

    monkeypatch.setattr(study, 'sat', again)
    assert study.main(words) == 0
    assert capsys.readouterr().out == first


def test_tables_count_what_they_say():
    row = score(experiment('no-white', 3, 0), None, (), 2.0)
    rows = [replace(row, judge='simulation', usable=True, grade=grade, false_no=grade == 'WEAK')
            for grade in ('GOOD', 'GOOD', 'WEAK')]
    assert by_family(rows).rows[-1][1:7] == ('3', '3', '67 %', '1', '0', '2')
    assert by_kind([row, *rows]).rows[-1][1] == '3'
