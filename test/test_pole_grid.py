# SPDX-License-Identifier: Apache-2.0
"""Where searches begin: poles ranked on a few samples, and orders that HD-PBSID points to."""

from dataclasses import replace

from marks import slow
import numpy as np
from plants import Multisine, held, match, noisy, plant
import pytest

from ctsid_core import Record, Settings, Signal, StateSpace, identify
from ctsid_core.likelihood.output_error import Free, climb_roughly, fit_at
from ctsid_core.likelihood.samples import samples_of
from ctsid_core.search.by_order import _by_correlation, nearest, shifted
from ctsid_core.search.pole_grid import Correlations, PoleGrid

# A slow and a fast pair, 3 inputs, 2 outputs; inputs are held for 0.4 s, which the fast one sees.
A = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, -1.5, 0.0, 0.0],
              [0.0, 0.0, 0.0, 12.0], [0.0, 0.0, -12.0, -12.0]])
B = np.array([[0.0, 0.0, 0.0], [0.6, -0.9, 1.1], [0.0, 0.0, 0.0], [9.0, 7.0, -6.0]])
C = np.array([[1.0, 0.3, 0.8, -0.5], [-0.4, 0.9, 1.2, 0.6]])
POLES = np.linalg.eigvals(A)[np.linalg.eigvals(A).imag > 0.0]


def long(seed: int):
    return held(np.random.default_rng(seed), plant(A, B, C), 2.5, 50.0, snr=20, duration=150.0)


def test_a_long_record_is_ranked_by_all_that_its_inputs_do():
    """One of 25 samples is read; what an input does between them counts all the same."""
    record = long(0)
    few = samples_of([record], [[None]]).thinned(300)
    grid = PoleGrid(few, feedthrough=False, trim=True, longest=1.0, fastest=100.0, finest=0.02)
    free = Free(False, True, (False,) * 3, 1.0, -1e-6, 100.0)
    none, count = np.zeros(3), float(few.counts.sum())
    for poles in (POLES, POLES * (0.7 + 0.1j)):
        # Residues of any rank explain a little more than the model's own.
        ranked, exact = grid.score(poles, none), fit_at(few, poles, none, free).cost
        assert -0.3 * count < ranked - exact < 0.1 * count
    assert grid.score(POLES, none) < grid.score(POLES * (0.7 + 0.1j), none) - count


def test_what_is_known_of_poles_is_known_for_their_dead_times_alone():
    few = samples_of([long(0)], [[None]]).thinned(300)

    def best(*delays):
        grid = PoleGrid(few, feedthrough=False, trim=True, longest=1.0, fastest=100.0, finest=0.02)
        return [grid.best(POLES[:1], np.full(3, d), True) for d in delays][-1]

    assert best(0.0, 0.8) == best(0.8) != best(0.0)


@pytest.mark.parametrize('damping', [0.002, *slow(0.02)])
def test_errors_point_at_a_resonance_of_any_frequency(damping):
    """Two records of two inputs, one sample of six read: nearer than its width or 1 / length."""
    size = 38.0
    pole = size * complex(-damping, np.sqrt(1.0 - damping ** 2))
    p = plant([[0.0, size], [-size, -2.0 * damping * size]], [[0.0, 0.0], [9.0, -5.0]],
              [[1.0, 0.2]])
    records = [held(np.random.default_rng(seed), p, 50.0, 100.0, delay=0.3, snr=0,
                    duration=seconds) for seed, seconds in ((0, 60.0), (1, 30.0))]
    few = samples_of(records, [[None]] * 2).thinned(1500)
    correlations = PoleGrid(few, feedthrough=False, trim=True, longest=1.0, fastest=250.0,
                            finest=0.01).correlations
    for delay in (0.0, 0.3):
        found = correlations.resonance(correlations.outputs, np.full(2, delay))
        assert abs(found.imag - pole.imag) < max(-pole.real, 2.0 * np.pi / 60.0)
        assert max(-pole.real, 1.0 / 60.0) / 3.0 < -found.real < 3.0 * max(-pole.real, 1.0 / 60.0)


def test_a_dead_time_of_periods_is_no_part_of_a_resonance_s_decay():
    """What comes later than it decays is not seen, unless its dead time is allowed for."""
    size, damping, late = 38.0, 0.08, 1.2
    p = plant([[0.0, size], [-size, -2.0 * damping * size]], [[0.0], [9.0]], [[1.0, 0.2]])
    record = held(np.random.default_rng(2), p, 50.0, 100.0, delay=late, snr=20, duration=60.0)
    correlations = PoleGrid(samples_of([record], [[None]]), feedthrough=False, trim=True,
                            longest=2.0, fastest=250.0, finest=0.01).correlations
    found = correlations.resonance(correlations.outputs, np.array([late]))
    assert abs(found.imag - size) < damping * size
    assert damping * size / 3.0 < -found.real < 3.0 * damping * size     # rates are 4 apart


def lagging(pole: complex, late: tuple[float, ...], seed: int, seconds: float = 60.0) -> Record:
    """Return a record of one mode that each input moves later, 50 samples a second."""
    rng, size, gains = np.random.default_rng(seed), abs(pole), np.array([[9.0, -5.0]])
    A = [[0.0, size], [-size, 2.0 * pole.real]] if pole.imag else [[pole.real]]
    B = np.vstack([np.zeros((len(A) - 1, len(late))), gains[:, :len(late)]])
    t = np.arange(-5.0, seconds, 0.02)
    u = Signal(t, np.repeat(rng.standard_normal((len(t) // 5 + 1, len(late))), 5, 0)[:len(t)],
               'zoh')
    t_y = t[t >= 0.0][:-1] + 0.01
    y = StateSpace(A, B, np.ones((1, len(A))), delay=late).simulate([u], t_y)
    y = y + 0.1 * y.std() * rng.standard_normal(y.shape)
    return Record((u,), (Signal(t_y, y),), 0.0, t[-1])


@pytest.mark.parametrize('pole', [-3.0 + 0j, complex(-3.0, 20.0), complex(-15.0, 15.0)])
def test_inputs_and_outputs_correlate_most_at_the_dead_times(pole):
    """Of each input its own, nearer than what is left of them within an interval of the input."""
    grid = PoleGrid(samples_of([lagging(pole, (0.7, 1.9), 0), lagging(pole, (0.7, 1.9), 1, 30.0)],
                               [[None]] * 2).thinned(1000, scattered=True),
                    feedthrough=False, trim=True, longest=4.0, fastest=150.0, finest=0.02)
    assert grid.dead_times[pole.imag == 0.0] == pytest.approx((0.7, 1.9), abs=0.05)
    # A lag in place of a pair explains most elsewhere; a pair that is overdamped is a lag.
    assert np.any(grid.dead_times[True] != grid.dead_times[False]) == (pole.imag > 0.0)


@pytest.mark.parametrize('poles', [[complex(-2.5, 18.0)], [-15.0 + 0j],
                                   [-60.0 + 0j, complex(-2.5, 18.0)]])
@pytest.mark.parametrize('size', [1.0, 1e-6])
def test_what_poles_explain_by_correlation_is_what_a_fit_explains(poles, size):
    """Squares over those of the outputs, of a pair that begins later, whatever the units."""
    record, poles = lagging(complex(-3.0, 20.0), (1.2,), 3), np.array(poles)
    record = replace(record, inputs=(replace(record.inputs[0], values=size
                                             * record.inputs[0].values),))
    samples = samples_of([record], [[None]])
    correlations = PoleGrid(samples, feedthrough=False, trim=True, longest=2.0, fastest=150.0,
                            finest=0.02).correlations
    every, *each = explained = correlations.explained(
        0, poles, correlations.outputs)
    assert len(every) in (100, 101)             # up to the longest that is looked for
    for pole, one in zip(poles, each, strict=True):
        assert one == pytest.approx(correlations.explained(
            0, np.array([pole]), correlations.outputs)[0])
    for late in (0.3, 1.2, 1.6):
        free = Free(False, True, (False,), 2.0, -1e-6, 150.0)
        fit = fit_at(samples, poles, np.array([late]), free)
        exact = 1.0 - samples.mean(fit.power)[0] / np.var(samples.records[0].streams[0].y)
        # The power of a response is that of all inputs, those of 2 s before the record, too.
        assert 62.0 / 60.0 * every[round(late / 0.02)] == pytest.approx(exact, abs=0.02)
    assert correlations.dead_time(explained) == pytest.approx(1.2, abs=0.05)


def test_an_output_that_rests_hides_no_dead_time():
    """Noise, and then what a pole moves: all outputs count alike."""
    record = lagging(-3.0 + 0j, (0.7,), 5)
    y = record.outputs[0]
    noise = np.random.default_rng(6).standard_normal(y.values.shape)
    both = replace(record, outputs=(replace(y, values=np.hstack((noise, y.values))),))
    grid = PoleGrid(samples_of([both], [[None]]), feedthrough=False, trim=True, longest=4.0,
                    fastest=150.0, finest=0.02)
    assert grid.dead_times[True] == pytest.approx([0.7], abs=0.05)


@pytest.mark.parametrize(('late', 'pole'), [(1.9, complex(-19.0, 45.0)), (1.4, -40.0 + 0j),
                                            *slow((3.3, complex(-5.0, 30.0)))])
def test_a_dead_time_of_many_time_constants_is_found(late, pole):
    """What is a time constant beside it explains nothing: a grid of ten passed it by."""
    found = identify(lagging(pole, (late,), 4, 20.0))
    assert found.good
    assert found.model.delay == pytest.approx([late], abs=0.01)


@pytest.mark.parametrize(('late', 'at_once'), [(0.83, 0.6), (1.23, 0.6), (1.23, -0.6)])
def test_a_climb_that_ends_steps_beside_a_dead_time_goes_on(late, at_once):
    """An input held for 0.1 s, a resonance that answers at once after 1.03 s: maxima beside it."""
    rng, poles = np.random.default_rng(2), np.array([complex(-1.0, 9.7)])
    t_u, t = np.arange(-5.0, 20.0, 0.1), np.arange(0.007, 20.0, 0.02)
    u = Signal(t_u, rng.choice((-1.0, 1.0), (len(t_u), 1)), 'zoh')
    y = StateSpace([[0.0, 9.75], [-9.75, -2.0]], [[0.0], [9.0]], [[0.3, at_once]],
                   delay=(1.03,)).simulate([u], t)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    samples = samples_of([Record((u,), (Signal(t, y),), 0.0, 20.0)], [[None]])
    free = Free(False, True, (True,), 5.0, -1e-6, 100.0)
    ended = climb_roughly(samples, fit_at(samples, poles, np.array([late]), free), free)
    assert abs(ended.model.delay[0] - 1.03) > 0.1
    # Correlations that do not reach so far are no help.
    correlations = Correlations(samples, 0.1, 100.0, 0.02)
    assert shifted(samples, ended, free, correlations).model.delay == pytest.approx(
        [1.03], abs=0.002)
    assert shifted(samples, ended, replace(free, delays=(False,)), correlations) is ended


PLANT_OF_TWO = (np.array([[0.0, 25.0, 0.0, 0.0], [-25.0, -36.0, 0.0, 0.0],
                          [0.0, 0.0, -70.0, 0.0], [0.0, 0.0, 0.0, -0.7]]),
                np.array([[0.0, 0.0], [25.0, -10.0], [70.0, 50.0], [0.7, -0.4]]),
                np.array([[1.0, 0.3, -0.5, 1.0], [-0.4, 0.5, 1.0, 0.8]]))


def sines_of(rng, slowest: float, t) -> np.ndarray:
    """Return 25 sines of the slowest frequency and its multiples [rad/s], of power 1, (N, 1)."""
    phases = rng.uniform(-0.5 * np.pi, 1.5 * np.pi, (1, 25))
    return Multisine(slowest * np.arange(1, 26), np.exp(1j * phases) / np.sqrt(12.5)).at(t)


def sines_and_steps(seed: int) -> tuple[Record, tuple[float, float]]:
    """Two inputs, each late by its own: quick steps, and slow sines."""
    rng = np.random.default_rng(seed)
    A = PLANT_OF_TWO[0]
    late = (0.34, float(rng.uniform(0.05, 1.0)))
    t_u, t_y = np.arange(-5.0, 20.0, 0.01), np.arange(0.003, 20.0, 0.01)
    sines = sines_of(rng, 0.1 * np.pi, t_u)
    steps = np.repeat(rng.choice((-1.0, 1.0), 251), 10)[:len(t_u)]
    u = Signal(t_u, np.hstack((steps[:, np.newaxis], sines)), 'zoh')
    B = np.array([[0.0], [25.0 - 36.0], [-70.0], [-0.7]]) * rng.standard_normal((4, 2))
    y = StateSpace(A, B, rng.standard_normal((2, 4)), delay=late).simulate([u], t_y)
    return Record((u,), (Signal(t_y, noisy(rng, y, 30.0)),), 0.0, 20.0), late


@pytest.mark.parametrize('direct', [0.0, 0.4])
def test_what_the_other_inputs_leave_tells_the_dead_time_of_one(direct):
    """Of a weak one, of two records and two outputs that have their own stamps."""
    records, late = [], (0.34, 0.9)
    for seed in (0, 1):
        record, _ = sines_and_steps(seed)
        (u,), (y,) = record.inputs, record.outputs
        u = replace(u, values=u.values * [1.0, 0.1])
        truth = StateSpace(*PLANT_OF_TWO, [[direct, direct], [0.0, 0.0]], delay=late)
        slow_t = y.time[::3] + 0.002
        records.append(Record((u,), (Signal(y.time, truth.simulate([u], y.time)[:, :1]),
                                     Signal(slow_t, truth.simulate([u], slow_t)[:, 1:])),
                              0.0, 20.0))
    samples = samples_of(records, [[None] * 2] * 2)
    free = Free(bool(direct), True, (True, True), 2.0, -1e-6, 100.0)
    poles = np.linalg.eigvals(PLANT_OF_TWO[0])
    fit = fit_at(samples, poles[poles.imag >= 0.0], np.array([0.34, 0.2]), free)
    inputs, found = zip(*_by_correlation(samples, fit.model, free,
                                         Correlations(samples, 2.0, 100.0, 0.01)), strict=True)
    assert set(inputs) == {1}                   # the other one is where it has to be
    assert np.min(np.abs(np.array(found) - 0.9)) < 0.05         # from where a climb gets there


@pytest.mark.parametrize('seed', [59, *slow(*range(8))])
def test_each_input_has_its_own_dead_time_whichever_explains_more(seed):
    """Of the one that explains less order 1 saw a false one, which no later order left."""
    record, late = sines_and_steps(seed)
    found = identify(record)
    assert found.good
    assert found.model.delay == pytest.approx(late, abs=0.02)


@pytest.mark.parametrize('seed', [47, *slow(10, 0, 12, 13, 50)])
def test_inputs_of_the_same_frequencies_have_their_own_dead_times(seed):
    """What a single mode explains most of is not where all modes together do."""
    rng = np.random.default_rng(seed)
    t_u, t = np.arange(-5.0, 12.0, 0.01), np.arange(0.0, 12.0, 0.01)
    late = tuple(rng.uniform(0.01, 0.3, 3))
    first, last = (sines_of(rng, np.pi / 6.0, t_u) for _ in range(2))
    steps = np.repeat(rng.choice((-1.0, 1.0), 86), 20)[:len(t_u), np.newaxis]
    u = Signal(t_u, np.hstack((first, steps, last)), 'zoh')
    B = np.array([[90.0], [1.2]]) * rng.standard_normal((2, 3))
    y = StateSpace(np.diag([-90.0, -1.2]), B, [[1.0, 1.0]], delay=late).simulate([u], t)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    found = identify(Record((u,), (Signal(t, y),), 0.0, 12.0))
    assert found.good
    assert found.model.delay == pytest.approx(late, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize('budget', [0.0, 1.0])
def test_a_long_record_of_several_inputs_has_its_order_and_no_dead_time(budget):
    found = identify(long(1), Settings(budget=budget))
    assert found.good
    assert found.model.n == 4
    assert np.max(found.model.delay) < 0.02
    both = np.linalg.eigvals(A)
    assert match(found.model.poles, both) == pytest.approx(both, rel=0.02)


def test_of_two_orders_as_near_the_larger_one_is_tried_first():
    """What HD-PBSID points at may have too few states, and time may end."""
    assert [nearest(range(1, 9), looked, 4) for looked in (
        {4}, {4, 5}, {3, 4, 5}, {3, 4, 5, 6}, {2, 3, 4, 5, 6})] == [5, 3, 6, 2, 0]


@pytest.mark.slow
def test_without_noise_no_larger_order_is_taken():
    given = held(np.random.default_rng(0), plant(A, B[:, :2], C), 5.0, 50.0, duration=30.0)
    assert identify(given).model.n == 4


@pytest.mark.parametrize('seed', [1, *slow(0, 2, 3, 4)])
def test_dead_times_of_several_inputs_are_no_states(seed):
    """Small models have others: the search goes on with those of the nearest order."""
    given = held(np.random.default_rng(seed), plant(A, B[:, :2], C), 5.0, 50.0, snr=30, delay=0.4,
                 duration=30.0)
    found = identify(given)
    assert found.good
    assert found.model.n in (4, 5)
    assert found.model.delay == pytest.approx((0.4, 0.4), abs=0.005)
    assert found.fit.min() > 96.0                    # the noise leaves 96.8 %


def test_an_order_that_is_given_is_tried_whatever_the_budget_or_the_noise():
    long = held(np.random.default_rng(0), plant(A, B[:, :2], C), 5.0, 50.0, snr=20, duration=60.0)
    found = identify(long, Settings(order=10, budget=0.5))
    assert (found.model or found.rejected_model).n == 10
    t = np.arange(0.0, 10.0, 0.02)
    u = np.repeat(np.random.default_rng(0).standard_normal(50), 10)
    y = np.zeros(len(t))
    for k in range(len(t) - 1):
        y[k + 1] = np.exp(-0.02) * y[k] + (1.0 - np.exp(-0.02)) * u[k]
    clean = Record.from_arrays(t, u[:, None], t, y[:, None], input_hold='zoh')
    assert identify(clean, Settings(order=2)).ok
