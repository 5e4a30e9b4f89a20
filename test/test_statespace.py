# SPDX-License-Identifier: Apache-2.0
"""StateSpace against ODE solvers, closed forms, scipy.signal, mpmath and its own laws."""

from dataclasses import replace
import time

from marks import slow
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
import scipy.linalg
import scipy.signal

from ctsid_core.errors import DataError
from ctsid_core.linear import matrix_functions
from ctsid_core.model import realisation, simulation, validation
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Actuator
from ctsid_core.signals.record import Record, Signal


def random_model(n, nu, ny, seed, *, shift=0.0, **more):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.3 - shift) * np.eye(n)
    return StateSpace(A, rng.standard_normal((n, nu)), rng.standard_normal((ny, n)),
                      rng.standard_normal((ny, nu)), K=rng.standard_normal((n, ny)), **more)


def stamps(rng, count, start, end):
    return np.sort(rng.uniform(start, end, count))


def evaluate(signal, late, t):
    """Inputs by independent means: numpy.interp, searchsorted and a SciPy spline."""
    s, x = signal.time, signal.values
    held = np.clip(t - late, s[0], s[-1])
    if signal.hold == 'zoh':
        return x[np.searchsorted(s, held, side='right') - 1]
    if signal.hold == 'linear':
        return np.array([np.interp(held, s, column) for column in x.T]).T
    return CubicSpline(s, x)(held)


def integrate(model, inputs, late, times, x0):
    """Solve the differential equation numerically between all jumps and kinks."""
    kinks = np.unique(np.concatenate([times] + [s.time + late for s in inputs]))
    kinks = kinks[(kinks >= times[0]) & (kinks <= times[-1])]

    def slope(t, x, inner):
        u = np.concatenate([evaluate(s, late, np.array([np.clip(t, *inner)]))[0] for s in inputs])
        return model.A @ x + model.B @ u + model.x_trim

    states, x = {kinks[0]: x0}, x0
    for a, b in zip(kinks[:-1], kinks[1:], strict=True):
        inner = (a + 1e-9 * (b - a), b - 1e-9 * (b - a))
        x = solve_ivp(slope, (a, b), x, 'DOP853', rtol=1e-12, atol=1e-13, args=(inner,)).y[:, -1]
        states[b] = x
    u = np.hstack([evaluate(s, late, times) for s in inputs])
    return np.array([states[t] for t in times]) @ model.C.T + u @ model.D.T + model.y_trim


@pytest.mark.parametrize(('holds', 'shift'), [
    (('zoh', 'zoh'), 0.0), (('linear', 'zoh'), 0.8), (('smooth', 'linear'), 0.8), *slow(
        (('zoh', 'zoh'), 0.8), (('linear', 'zoh'), 0.0), (('smooth', 'linear'), 0.0))])
def test_simulation_agrees_with_an_ode_solver(holds, shift):
    rng = np.random.default_rng(5)
    late = 0.0371
    model = random_model(4, 3, 2, 1, shift=shift, delay=(late,) * 3,
                         x_trim=rng.standard_normal(4), y_trim=rng.standard_normal(2))
    inputs = (Signal(stamps(rng, 25, -0.2, 3.5), rng.standard_normal((25, 1)), holds[0]),
              Signal(stamps(rng, 11, 0.4, 2.5), rng.standard_normal((11, 2)), holds[1]))
    times = stamps(rng, 60, 0.0, 4.0)
    x0 = rng.standard_normal(4)
    wanted = integrate(model, inputs, late, times, x0)
    found = model.simulate(inputs, times, x0)
    assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_both_ways_of_simulation_agree(monkeypatch):
    rng = np.random.default_rng(2)
    model = random_model(5, 2, 2, 3, shift=0.6, delay=(0.0, 0.13), x_trim=np.arange(5.0))
    inputs = (Signal(stamps(rng, 200, 0, 9), rng.standard_normal((200, 2)), 'smooth'),)
    times = np.concatenate([stamps(rng, 300, 0, 5), [9.0]])  # with one long interval
    by_modes = model.simulate(inputs, times)
    for module in (simulation, matrix_functions):
        monkeypatch.setattr(module, 'modes', lambda A: None)
    by_matrices = model.simulate(inputs, times)
    assert np.abs(by_modes - by_matrices).max() < 1e-11 * np.abs(by_modes).max()


def test_the_response_at_poles_that_are_known_to_half_of_the_digits_is_infinite():
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    A = np.block([[turn, np.eye(2)], [np.zeros((2, 2)), turn]])       # exactly singular at 1 rad/s
    model = StateSpace(A, np.eye(4)[:, 2:3], np.eye(4)[:1])
    assert np.isinf(model.frequency_response([1.0]).real).all()
    assert np.isfinite(model.frequency_response([0.5, 2.0])).all()


def balanced(model):
    return model.transform(realisation.balancing(model.A, model.B, model.C))


def test_simulation_agrees_with_lsim():
    model = random_model(6, 2, 3, 4)
    t = np.linspace(0, 10, 501)
    u = np.random.default_rng(1).standard_normal((501, 2))
    x0 = np.arange(6.0)
    _, wanted, _ = scipy.signal.lsim((model.A, model.B, model.C, model.D), u, t, x0)
    found = model.simulate((Signal(t, u, 'linear'),), t, x0)
    assert np.abs(found - wanted).max() < 1e-10 * np.abs(wanted).max()


def test_an_unstable_plant_without_eigenvectors_stays_bounded():
    # Two integrators behind a pole that grows by e^70: started at zero, no digit would be left.
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 3.5]])
    model = StateSpace(A, [[0], [0], [1]], [[1, 0, 0], [0, 0, 1]])
    assert matrix_functions.modes(A) is None
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 20.0, 401)
    signal = Signal(t, rng.standard_normal((401, 1)), 'zoh')
    x, u = simulation.respond(A, model.B, np.zeros(3), (signal,), (0.0,), t, None)
    assert np.abs(x[:, 2]).max() < 3.0
    step, integral = matrix_functions.exponentials(A, np.diff(t), 1)
    moved = np.einsum('kij,kj->ki', step, x[:-1])
    moved += np.einsum('kij,kj->ki', integral, u[:-1] @ model.B.T)
    assert np.abs(moved - x[1:]).max() < 1e-12 * np.abs(x).max()
    basis, states = simulation.free_response(A, model.C, t)
    assert 0.1 < np.linalg.norm(basis, axis=(0, 1)).min() < np.abs(basis).max() < 1e3
    assert np.allclose(basis[0], model.C @ states, atol=1e-12)
    found = validation.simulation(model, Record.from_arrays(
        t, signal.values, t, x @ model.C.T + basis @ [1.0, -2.0, 0.5], input_hold='zoh'))
    assert found.fit.min() > 100.0 - 1e-8


def test_modes_that_grow_alike_are_not_parted():
    turn = np.linalg.qr(np.random.default_rng(9).standard_normal((3, 3)))[0]
    A = turn @ (np.diag(np.full(3, 0.1)) + np.diag(np.ones(2), 1)) @ turn.T
    assert matrix_functions.modes(A) is None
    t = np.linspace(0.0, 10.0, 401)
    signal = Signal(t, np.sign(np.sin(7.0 * t))[:, np.newaxis], 'zoh')
    x, u = simulation.respond(A, np.ones((3, 1)), np.zeros(3), (signal,), (0.0,), t, None)
    step, integral = matrix_functions.exponentials(A, np.diff(t), 1)
    moved = np.einsum('kij,kj->ki', step, x[:-1])
    moved += np.einsum('kij,kj->ki', integral, u[:-1] @ np.ones((1, 3)))
    assert np.abs(moved - x[1:]).max() < 1e-11 * np.abs(x).max()


def test_a_defective_plant_is_simulated_exactly():
    # y = t^2/2 for a step, t^3/6 for a ramp, plus x0
    model = StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    assert matrix_functions.modes(model.A) is None
    t = np.sort(np.random.default_rng(0).uniform(0, 50, 200))
    t[0] = 0.0
    step = Signal(np.array([0.0]), np.ones((1, 1)), 'zoh')
    ramp = Signal(np.array([0.0, 60.0]), np.array([[0.0], [60.0]]), 'linear')
    assert np.allclose(model.simulate((step,), t)[:, 0], t ** 2 / 2, rtol=1e-12)
    assert np.allclose(model.simulate((ramp,), t, [3.0, -2.0])[:, 0], 3 - 2 * t + t ** 3 / 6,
                       rtol=1e-11)


def test_units_of_the_states_do_not_decide_which_way_is_taken():
    model = random_model(4, 1, 1, 3).transform(np.diag([1e-8, 1, 1e8, 1e4]))
    assert matrix_functions.modes(model.A) is not None


def test_a_critically_damped_stiff_plant_is_simulated_exactly():
    w = 1e4  # double pole: y = 1 - (1 + w t) e^(-w t)
    model = StateSpace([[0, 1], [-w * w, -2 * w]], [[0], [w * w]], [[1, 0]])
    t = np.concatenate([np.linspace(0, 1e-3, 50), [0.5, 3.0]])
    step = Signal(np.array([0.0]), np.ones((1, 1)), 'zoh')
    found = model.simulate((step,), t)[:, 0]
    assert np.abs(found - (1 - (1 + w * t) * np.exp(-w * t))).max() < 1e-9


def test_integrators_and_tiny_steps_keep_their_digits():
    model = StateSpace([[0, 0], [0, -1e-9]], [[1], [1]], np.eye(2))
    t = np.arange(0, 1, 1e-4)
    u = Signal(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]), 'linear')
    found = model.simulate((u,), t)
    assert np.allclose(found[:, 0], t ** 2 / 2, rtol=1e-12, atol=1e-16)
    assert np.allclose(found[:, 1], t ** 2 / 2 * (1 - 1e-9 * t / 3), rtol=1e-12, atol=1e-16)


def test_phi_functions_agree_with_mpmath():
    z = np.concatenate([np.logspace(-12, 2, 29), -np.logspace(-12, 2, 29)]).astype(complex)
    z = np.concatenate([z, 1j * z, (1 - 2j) * z / 3, [0]])
    found = matrix_functions.phi(z, 4)
    with mpmath.workdps(120):
        for j in range(1, 5):
            for value, x in zip(found[j], z, strict=True):
                x = mpmath.mpc(x)
                known = sum(x ** k / mpmath.factorial(k) for k in range(j))
                truth = (mpmath.exp(x) - known) / x ** j if x else 1 / mpmath.factorial(j)
                assert abs(mpmath.mpc(value) - truth) < 2e-14 * abs(truth) + 1e-300


def test_dead_time_is_a_shift_of_the_input():
    model = random_model(3, 2, 1, 7)
    late = replace(model, delay=(0.25, 0.0))
    rng = np.random.default_rng(3)
    t, u = stamps(rng, 30, 0, 5), rng.standard_normal((30, 2))
    shifted = (Signal(t + 0.25, u[:, :1], 'zoh'), Signal(t, u[:, 1:], 'zoh'))
    times = stamps(rng, 80, 1, 6)
    assert np.array_equal(late.simulate((Signal(t, u, 'zoh'),), times),
                          model.simulate(shifted, times))


def test_trim_is_a_constant_input():
    model = random_model(3, 1, 2, 8)
    trimmed = replace(model, x_trim=np.array([1.0, 2, 3]), y_trim=np.array([4.0, 5]))
    augmented = StateSpace(model.A, np.column_stack([model.B, [1, 2, 3]]), model.C,
                           np.column_stack([model.D, [4, 5]]))
    t = np.linspace(0, 4, 50)
    u = np.sin(t)[:, np.newaxis]
    one = Signal(np.array([0.0]), np.ones((1, 1)), 'zoh')
    assert np.allclose(trimmed.simulate((Signal(t, u),), t),
                       augmented.simulate((Signal(t, u), one), t), rtol=1e-12)


def test_inputs_are_held_before_their_first_and_after_their_last_stamp():
    model = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    for hold in ('zoh', 'linear', 'smooth'):
        u = Signal(np.array([1.0, 1.5, 1.7, 2.0]), np.array([[2.0], [5], [1], [3]]), hold)
        y = model.simulate((u,), np.array([0.0, 1.0, 2.0, 60.0]))[:, 0]
        assert y[1] == pytest.approx(2 * (1 - np.exp(-1)), rel=1e-14)
        assert y[3] == pytest.approx(3.0, rel=1e-14)


def test_a_model_without_inputs_and_one_without_states():
    free = StateSpace([[-2.0]], np.zeros((1, 0)), [[3.0]])
    assert np.allclose(free.simulate((), [0, 1.0], [1.0])[:, 0], [3, 3 * np.exp(-2)])
    gain = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[5.0]],
                      delay=(1.0,))
    t = np.array([0.0, 1.0, 2.0])
    u = Signal(t, t[:, np.newaxis] + 1, 'zoh')
    assert gain.simulate((u,), t)[:, 0].tolist() == [5.0, 5.0, 10.0]
    assert gain.frequency_response([np.pi])[0, 0, 0] == pytest.approx(-5)
    assert gain.poles.shape == (0,)
    assert gain.dc_gain[0, 0] == 5


def test_wanted_times_may_be_none_or_repeated_but_not_decrease():
    model = random_model(2, 1, 1, 0)
    u = Signal(np.array([0.0]), np.ones((1, 1)), 'zoh')
    assert model.simulate((u,), []).shape == (0, 1)
    y = model.simulate((u,), [0.0, 1.0, 1.0])
    assert y[1, 0] == y[2, 0] != y[0, 0]
    with pytest.raises(DataError, match='sort them'):
        model.simulate((u,), [1.0, 0.0])


def test_wrong_inputs_are_refused():
    model = random_model(2, 2, 1, 0)
    u = Signal(np.array([0.0]), np.ones((1, 1)), 'zoh')
    with pytest.raises(DataError, match='1 input channels given, but the model has 2'):
        model.simulate((u,), [0.0])
    with pytest.raises(DataError, match='no sample'):
        model.simulate((Signal(np.empty(0), np.empty((0, 2))),), [0.0])
    with pytest.raises(DataError, match=r'`x0` has shape \(3,\), wanted is \(2,\)'):
        model.simulate((u, u), [0.0], [1, 2, 3])


def test_simulation_is_fast():
    rng = np.random.default_rng(0)
    model = random_model(10, 3, 2, 0)
    u = Signal(stamps(rng, 20000, 0, 100), rng.standard_normal((20000, 3)), 'smooth')
    times, best = stamps(rng, 20000, 0, 100), np.inf
    for _ in range(3):
        begin = time.thread_time()
        model.simulate((u,), times)
        best = min(best, time.thread_time() - begin)
    assert best < 0.6  # 0.06 s on an idle core


def test_frequency_response_agrees_with_direct_solution_up_to_large_n():
    for n in (1, 4, 60):
        model = random_model(n, 2, 3, n, delay=(0.0, 0.2))
        omega = np.concatenate([[-3.0, 0.0], np.logspace(-3, 4, 40)])
        found = model.frequency_response(omega)
        assert found.shape == (42, 3, 2)
        for w, G in zip(omega, found, strict=True):
            wanted = (model.C @ np.linalg.solve(1j * w * np.eye(n) - model.A, model.B) + model.D)
            wanted = wanted * np.exp(-1j * w * np.array([0, 0.2]))
            assert np.abs(G - wanted).max() < 1e-11 * np.abs(wanted).max()


def test_frequency_response_does_not_depend_on_the_units_of_the_states():
    model = random_model(6, 1, 1, 2)
    scaled = model.transform(np.diag([1e-9, 1e6, 1, 1e9, 1e-6, 1e3]))
    omega = np.logspace(-2, 2, 30)
    assert np.allclose(scaled.frequency_response(omega), model.frequency_response(omega),
                       rtol=1e-10)


def test_at_a_pole_only_the_entries_that_see_it_are_infinite():
    # u1 drives an integrator chain read by y1 (position), y2 (speed); u2 a lag read by y3
    A = scipy.linalg.block_diag([[0, 1], [0, 0]], [[-2]], [[0, 3], [-3, 0]])
    B = np.array([[0, 0], [1, 0], [0, 4], [0, 0], [0, 1]])
    C = np.array([[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0]])
    model = StateSpace(A, B, C)
    gain = model.dc_gain
    assert np.isinf(gain[:2, 0]).all()
    assert gain[2, 0] == pytest.approx(0, abs=1e-12)
    assert gain[:, 1] == pytest.approx([0, 0, 2, 1 / 3], abs=1e-12)
    at_mode = model.frequency_response([3.0])[0]
    assert np.isinf(np.abs(at_mode[3, 1]))
    assert np.isnan(at_mode[3, 1].imag)
    assert at_mode[2, 1] == pytest.approx(4 / (2 + 3j))
    assert at_mode[0, 0] == pytest.approx(-1 / 9)
    assert at_mode[1, 0] == pytest.approx(1 / 3j)


def test_a_pole_at_zero_is_found_in_any_coordinates():
    model = StateSpace(np.diag([0.0, -2.0, -3.0]), [[1, 0], [0, 4], [1, 1]],
                       [[1, 0, 0], [0, 1, 0]])
    T = np.random.default_rng(4).standard_normal((3, 3))
    gain = model.transform(T).dc_gain
    assert np.isinf(gain[0, 0])
    assert [gain[0, 1], *gain[1]] == pytest.approx([0, 0, 2], abs=1e-9)


def test_poles_are_sorted_with_pairs_together():
    A = scipy.linalg.block_diag([[3.0]], [[0, 5], [-5, 0]], [[-3.0]], [[-4, 3], [-3, -4]], [[0]])
    model = StateSpace(A, np.ones((7, 1)), np.ones((1, 7)))
    assert np.allclose(model.poles, [0, -3, 3, -4 - 3j, -4 + 3j, -5j, 5j])
    assert model.natural_frequency == pytest.approx([0, 3, 3, 5, 5, 5, 5])
    assert model.damping[1:] == pytest.approx([1, -1, 0.8, 0.8, 0, 0])
    assert np.isnan(model.damping[0])


def same_system(a, b, tolerance=1e-9):
    omega = np.array([0.0, 0.1, 1.0, 3.0, 30.0])
    G, H = a.frequency_response(omega), b.frequency_response(omega)
    markov = [c.C @ np.linalg.matrix_power(c.A, 2) @ c.K for c in (a, b)]
    trim = [c.C @ c.A @ c.x_trim for c in (a, b)]
    return all(np.abs(x - y).max() < tolerance * np.abs(x).max()
               for x, y in ((G, H), markov, trim)) and np.array_equal(a.y_trim, b.y_trim)


def test_realisations_are_the_same_system():
    for shift in (0.0, 1.0):
        model = random_model(6, 2, 3, 11, shift=shift, x_trim=np.arange(6.0),
                             y_trim=np.ones(3))
        T = np.random.default_rng(0).standard_normal((6, 6))
        for other in (model.transform(T), *([] if shift else [balanced(model)])):
            assert same_system(model, other)
            assert not np.allclose(other.A, model.A)


def test_balanced_gramians_are_equal_and_diagonal():
    model = random_model(5, 2, 2, 17)
    found = balanced(model)
    reach = scipy.linalg.solve_continuous_lyapunov(found.A, -found.B @ found.B.T)
    see = scipy.linalg.solve_continuous_lyapunov(found.A.T, -found.C.T @ found.C)
    sigma = np.diag(reach)
    assert (np.diff(sigma) < 0).all()
    assert np.allclose(reach, np.diag(sigma), atol=1e-10 * sigma[0])
    assert np.allclose(see, reach, atol=1e-10 * sigma[0])
    assert (found.C.T @ [1, 1 / np.sqrt(2)] > 0).all()


def test_impossible_realisations_say_why():
    double = StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    deaf = StateSpace([[-1, 0], [0, -2]], [[1], [0]], [[1, 1]])
    with pytest.raises(DataError, match='not controllable'):
        balanced(deaf)
    with pytest.raises(DataError, match='singular'):
        double.transform([[1, 1], [1, 1]])


def test_pade_replaces_dead_time():
    model = random_model(3, 2, 2, 19, delay=(0.3, 0.0), x_trim=np.arange(3.0))
    omega = np.linspace(0, 8, 20)
    exact = model.frequency_response(omega)
    errors = np.array([np.abs(model.pade(order).frequency_response(omega) - exact).max()
                       for order in (1, 2, 3, 4, 5, 9)])
    assert (np.diff(errors) < 0).all()
    assert errors[2] < 0.1 * errors[0]
    assert errors[-1] < 1e-9
    assert model.pade(0) == replace(model, delay=(0.0, 0.0))
    assert model.pade(2).n == 5
    assert not any(model.pade(2).delay)
    with pytest.raises(DataError, match='choose 0 to 10'):
        model.pade(11)


@pytest.mark.parametrize(('change', 'message'), [
    ({'A': np.zeros((2, 3))}, r'`A` has shape \(2, 3\), wanted is \(2, 2\)'),
    ({'B': np.zeros(2)}, r'B has shape \(2,\)'),
    ({'B': np.zeros((3, 1))}, r'`B` has shape \(3, 1\), wanted is \(2, 1\)'),
    ({'C': np.zeros((1, 3))}, r'`C` has shape \(1, 3\), wanted is \(1, 2\)'),
    ({'D': np.zeros((2, 1))}, r'`D` has shape \(2, 1\), wanted is \(1, 1\)'),
    ({'K': np.zeros((1, 2))}, r'`K` has shape \(1, 2\), wanted is \(2, 1\)'),
    ({'x_trim': np.zeros(1)}, '`x_trim`'), ({'y_trim': np.zeros((1, 1))}, '`y_trim`'),
    ({'noise': np.zeros((2, 2))}, '`noise`'), ({'delay': (0.1, 0.2)}, '1 dead times'),
    ({'actuators': (Actuator(0.1), Actuator(0.2))}, 'wanted are 1, one per input'),
    ({'actuators': (Actuator(limit=-0.1),)}, 'no negative number'),
    ({'delay': (-0.1,)}, 'none negative'), ({'delay': (float('nan'),)}, 'none negative'),
    ({'A': [[np.nan, 0], [0, 1]]}, 'NaN or infinity'), ({'A': 'x'}, 'not an array of numbers'),
    ({'input_names': ('a', 'b')}, 'wanted are 1'), ({'output_units': 'rad'}, 'one per channel'),
])
def test_wrong_shapes_are_named(change, message):
    good = {'A': np.eye(2), 'B': np.ones((2, 1)), 'C': np.ones((1, 2))}
    with pytest.raises(DataError, match=message):
        StateSpace(**{**good, **change})


def test_what_is_not_given_is_zero_and_nothing_can_be_changed():
    A = np.eye(2)
    model = StateSpace(A, np.ones((2, 1)), np.ones((3, 2)))
    A[0, 0] = 7
    assert model.A[0, 0] == 1
    assert model.n == 2
    assert model.nu == 1
    assert model.ny == 3
    assert model.D.shape == (3, 1)
    assert model.K.shape == (2, 3)
    assert not model.K.any()
    assert model.delay == (0.0,)
    assert model.output_names == ('',) * 3
    assert model.noise is None
    with pytest.raises(ValueError, match='read-only'):
        model.A[0, 0] = 0
    with pytest.raises(ValueError, match='read-only'):
        model.poles[0] = 0


def test_models_are_equal_if_all_entries_are():
    model = random_model(3, 1, 1, 0, noise=np.eye(1))
    same = replace(model)
    assert model == same
    assert hash(model) == hash(same)
    assert model != 'model'
    for change in ({'A': model.A + 1e-15}, {'delay': (0.1,)}, {'noise': None},
                   {'input_names': ('u',)}):
        assert replace(model, **change) != model
