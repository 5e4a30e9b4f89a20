# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
from plants import PLANTS, random_plant, random_signal, running
import pytest

from ctsid_core import Record, Settings, Signal
from ctsid_core.bases.hermite import project_record, time_scale
from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.bases.quadrature import coefficients
from ctsid_core.likelihood.many_models import innovation_costs
from ctsid_core.likelihood.prediction_errors import (
    innovation_cost,
    jacobian,
    line_fit,
    line_weights,
    output_error_cost,
    prediction_errors,
    simulate_lines,
    spread_gradient,
    unseen_fit,
)
from ctsid_core.likelihood.window_ends import ends_cost
from ctsid_core.linear.matrices import Matrices

PARTS = ('A', 'B', 'tail', 'x_trim', 'C', 'D', 'y_trim', 'K')


def noise(rng, *shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def random_lines(rng, nu=2, ny=3, count=25, *, tail=1, ones=1, zero=True) -> Projection:
    """Lines of nothing in particular: the algebra has to hold for any."""
    w = np.arange(count) + np.sort(rng.uniform(0.0, 5.0, count))
    w[:2] = 0.4, 1.2
    u, y, e, c = (noise(rng, m, count) for m in (nu, ny, tail, ones))
    if zero:
        w[0] = 0.0
        for rows in (u, y, e, c):
            rows[:, 0] = rows[:, 0].real
    return Projection(s=1j * w, u=u, y=y, tail=e, ones=c, unit=1.0, start=0.0, end=10.0)


def random_model(rng, n=3, nu=2, ny=3, *, tail=1, ones=1, gain=1.0) -> Matrices:
    p = random_plant(rng, n, nu, ny, feedthrough=True)
    return Matrices(A=p.A, B=p.B, C=p.C, D=p.D, K=gain * 0.3 * rng.standard_normal((n, ny)),
                    tail=rng.standard_normal((n, tail)), x_trim=rng.standard_normal((n, ones)),
                    y_trim=rng.standard_normal((ny, ones)))


def stable_model(rng, **options) -> Matrices:
    """A model whose predictor is well damped."""
    while True:
        m = random_model(rng, **options)
        if np.linalg.eigvals(m.A - m.K @ m.C).real.max() < -1.5:
            return m


def parameters(m, feedthrough, with_noise):
    """Return the names and places of the entries in the order that `jacobian` promises."""
    n, nu, ny = len(m.A), m.B.shape[1], len(m.C)
    found = [('A', i, j) for i in range(n) for j in range(n)]
    for i in range(n):
        found += [(name, i, j) for name in ('B', 'tail', 'x_trim')
                  for j in range(getattr(m, name).shape[1])]
    found += [('C', i, j) for i in range(ny) for j in range(n)]
    for i in range(ny):
        found += [('D', i, j) for j in range(nu * feedthrough)]
        found += [('y_trim', i, j) for j in range(m.y_trim.shape[1])]
    return found + [('K', i, j) for i in range(n) for j in range(ny) if with_noise]


def moved(m, name, i, j, step):
    matrix = getattr(m, name).copy()
    matrix[i, j] += step
    return replace(m, **{name: matrix})


@pytest.mark.parametrize('feedthrough', [True, False])
@pytest.mark.parametrize('with_noise', [True, False])
@pytest.mark.parametrize(('tail', 'ones'), [(1, 1), (0, 0)])
def test_the_jacobian_against_central_differences(feedthrough, with_noise, tail, ones):
    rng = np.random.default_rng(0)
    lines = random_lines(rng, tail=tail, ones=ones)
    m = random_model(rng, tail=tail, ones=ones, gain=with_noise)
    J = jacobian(lines, m, feedthrough, with_noise=with_noise)
    entries = parameters(m, feedthrough, with_noise)
    assert J.shape == (3, 2 * len(lines.s), len(entries))
    step = 1e-5
    for k, (name, i, j) in enumerate(entries):
        ahead, behind = (as_real(prediction_errors(lines, moved(m, name, i, j, d)))
                         for d in (step, -step))
        wanted = -(ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(J[:, :, k], wanted, atol=1e-7 * max(np.abs(wanted).max(), 1.0),
                                   err_msg=f'{name}[{i}, {j}]')


def spread(lines, m) -> float:
    """-2 sum log|det H|, H built line by line; a line is two real numbers, but one at zero."""
    closed, total = m.A - m.K @ m.C, 0.0
    for s in lines.s:
        H = np.eye(len(m.C)) - m.C @ np.linalg.solve(s * np.eye(len(m.A)) - closed, m.K)
        total -= 2.0 * (1.0 if s == 0.0 else 2.0) * np.log(np.abs(np.linalg.det(H)))
    return total


def ends(lines, m) -> float:
    predictor, plant = (np.linalg.eigvals(A).astype(complex) for A in (m.A - m.K @ m.C, m.A))
    return ends_cost(lines, predictor, plant)


@pytest.mark.parametrize('feedthrough', [True, False])
@pytest.mark.parametrize('zero', [True, False])
def test_the_spread_gradient_against_central_differences(feedthrough, zero):
    rng = np.random.default_rng(1)
    lines, m = random_lines(rng, zero=zero), stable_model(rng)
    gradient, step = spread_gradient(lines, m, feedthrough), 1e-5
    entries = parameters(m, feedthrough, True)
    assert gradient.shape == (len(entries),)
    values = [[spread(lines, other) + ends(lines, other) for other in (
        moved(m, *entry, step), moved(m, *entry, -step))] for entry in entries]
    wanted = [(ahead - behind) / (2.0 * step) for ahead, behind in values]
    np.testing.assert_allclose(gradient, wanted, atol=1e-6 * np.abs(wanted).max())


def by_lines(lines, m, K) -> np.ndarray:
    """Prediction errors, line by line from the equations of [HD] 35."""
    closed, out = m.A - K @ m.C, []
    for k, s in enumerate(lines.s):
        u, y, tail, one = (rows[:, k] for rows in (lines.u, lines.y, lines.tail, lines.ones))
        drive = (m.B - K @ m.D) @ u + m.tail @ tail + (m.x_trim - K @ m.y_trim) @ one + K @ y
        x = np.linalg.solve(s * np.eye(len(m.A)) - closed, drive)
        out.append(y - m.C @ x - m.D @ u - m.y_trim @ one)
    return np.array(out).T


@pytest.mark.parametrize('defective', [False, True])
def test_prediction_errors_are_those_of_the_equations(defective):
    rng = np.random.default_rng(2)
    lines, m = random_lines(rng), random_model(rng)
    if defective:
        m = replace(m, A=np.array([[-2.0, 1.0, 0.0], [0.0, -2.0, 1.0], [0.0, 0.0, -2.0]]),
                    K=np.zeros_like(m.K))
    np.testing.assert_allclose(prediction_errors(lines, m), by_lines(lines, m, m.K), atol=1e-11)
    np.testing.assert_allclose(simulate_lines(lines, m),
                               lines.y - by_lines(lines, m, np.zeros_like(m.K)), atol=1e-11)


def test_without_gain_the_prediction_is_the_simulation():
    rng = np.random.default_rng(3)
    lines, m = random_lines(rng), random_model(rng, gain=0.0)
    np.testing.assert_allclose(prediction_errors(lines, m), lines.y - simulate_lines(lines, m),
                               atol=1e-12)


def test_the_errors_are_filtered_simulation_errors():
    """E = H (Y - G U), H = I - C (s I - A bar)^-1 K."""
    rng = np.random.default_rng(4)
    lines, m = random_lines(rng), stable_model(rng)
    error = lines.y - simulate_lines(lines, m)
    for k, s in enumerate(lines.s):
        H = np.eye(3) - m.C @ np.linalg.solve(s * np.eye(3) - m.A + m.K @ m.C, m.K)
        np.testing.assert_allclose(prediction_errors(lines, m)[:, k], H @ error[:, k], atol=1e-10)


def test_output_error_cost():
    rng = np.random.default_rng(5)
    lines, m = random_lines(rng), random_model(rng)
    count = line_weights(lines).sum()
    power = np.sum(as_real(lines.y - simulate_lines(lines, m)) ** 2, axis=1) / count
    assert output_error_cost(lines, m) == pytest.approx(count * np.log(power).sum())
    perfect = replace(lines, y=simulate_lines(lines, m))
    assert np.isfinite(output_error_cost(perfect, m))


@pytest.mark.parametrize('zero', [True, False])
def test_innovation_cost(zero):
    rng = np.random.default_rng(6)
    lines, m = random_lines(rng, zero=zero), stable_model(rng)
    e = as_real(by_lines(lines, m, m.K))
    count = 2 * len(lines.s) - zero
    assert line_weights(lines).sum() == count
    wanted = count * np.linalg.slogdet(e @ e.T / count)[1] + spread(lines, m) + ends(lines, m)
    assert innovation_cost(lines, m) == pytest.approx(wanted, rel=1e-10)
    assert np.isfinite(innovation_cost(replace(lines, y=simulate_lines(lines, m)), m))


def test_errors_that_all_outputs_share_do_not_make_a_model_likely():
    """Without noise a missing state leaves them; rounding made det of their covariance zero."""
    p = PLANTS['hd52']
    modes = np.linalg.eig(p.A)[1]
    lost = [np.outer(modes[:, i], np.linalg.inv(modes)[i]).real @ p.B for i in range(3)]
    for seed in range(12):
        record = running(np.random.default_rng(seed), p, rate=200.0, duration=6.0)
        lines = project_record(record, Settings(), 200)
        truth = Matrices(A=p.A, B=p.B, C=p.C, D=p.D, K=np.zeros((3, 4)),
                         tail=np.zeros((3, len(lines.tail))), x_trim=np.zeros((3, 1)),
                         y_trim=np.zeros((4, 1)))
        lines = replace(lines, y=simulate_lines(lines, truth))
        lacking = [replace(truth, B=p.B - size * mode) for mode in lost for size in (1, 1e3, 1e6)]
        costs = innovation_costs(lines, [truth, *lacking])
        assert np.isfinite(costs).all()
        assert costs[1:].min() > costs[0]
        assert innovation_cost(lines, lacking[0]) == pytest.approx(costs[1], rel=1e-4)


def test_an_unstable_predictor_is_inadmissible():
    rng = np.random.default_rng(7)
    lines, m = random_lines(rng), random_model(rng, gain=0.0)
    assert innovation_cost(lines, replace(m, A=m.A + 50.0 * np.eye(3))) == np.inf
    close = m.A - (np.linalg.eigvals(m.A).real.max() + 1e-6) * np.eye(3)
    assert innovation_cost(lines, replace(m, A=close)) == np.inf


def test_the_likelihood_is_greatest_at_the_truth_that_made_the_data():
    """With the term log|det H|: without it ever faster predictors would win."""
    rng = np.random.default_rng(8)
    lines, m = random_lines(rng, nu=1, ny=1, count=3000), stable_model(rng, nu=1, ny=1)
    lines = replace(lines, s=1j * np.linspace(0.01, 20.0, 3000))
    e, error = noise(rng, 1, 3000), []
    for k, s in enumerate(lines.s):
        H = 1.0 - m.C @ np.linalg.solve(s * np.eye(3) - m.A + m.K @ m.C, m.K)
        error.append(e[:, k] / H[0, 0])
    lines = replace(lines, y=simulate_lines(lines, m) + np.array(error).T)
    at_truth = innovation_cost(lines, m)
    for name in ('A', 'B', 'C', 'D', 'K'):
        matrix = getattr(m, name)
        for factor in (0.6, 1.5):
            assert innovation_cost(lines, replace(m, **{name: factor * matrix})) > at_truth
    fast = replace(m, K=30.0 * m.K)
    assert innovation_cost(lines, fast) > at_truth


def test_costs_and_errors_do_not_depend_on_the_realisation():
    rng = np.random.default_rng(9)
    lines, m = random_lines(rng), stable_model(rng)
    T = rng.standard_normal((3, 3)) + 3.0 * np.eye(3)
    other = replace(m, A=T @ m.A @ np.linalg.inv(T), C=m.C @ np.linalg.inv(T),
                    **{name: T @ getattr(m, name) for name in ('B', 'K', 'tail', 'x_trim')})
    np.testing.assert_allclose(prediction_errors(lines, other), prediction_errors(lines, m),
                               atol=1e-10)
    assert innovation_cost(lines, other) == pytest.approx(innovation_cost(lines, m), rel=1e-10)
    assert output_error_cost(lines, other) == pytest.approx(output_error_cost(lines, m))


def true_window(rng, p, *, trim=0.0, nmax=150):
    """Return the lines of a noise-free window not at rest, and the true model with its tail."""
    t, u = np.linspace(0.0, 10.0, 2001), random_signal(rng, p.B.shape[1], band=3.0)
    y, x = u.output(p), u.states(p)
    record = Record.from_arrays(t, u.at(t), t, y.at(t) + trim, input_hold='smooth')
    settings = Settings(edge_margin=10.0)
    alpha = time_scale(nmax, 5.0, settings)
    last = coefficients([Signal(t, x.at(t))], 0.0, 10.0, alpha, nmax + 1, [0.0])[0][:, -1:]
    n, ny = len(p.A), len(p.C)
    model = Matrices(A=p.A, B=p.B, C=p.C, D=p.D, K=np.zeros((n, ny)),
                     tail=-np.sqrt((nmax + 1) / 2.0) / alpha * last, x_trim=np.zeros((n, 1)),
                     y_trim=np.full((ny, 1), trim))
    return project_record(record, settings, nmax), model


@pytest.mark.parametrize('name', ['hd51', 'hd52', 'flexible'])
def test_the_lines_of_a_simulation_are_those_of_its_time_course(name):
    lines, model = true_window(np.random.default_rng(10), PLANTS[name])
    error = np.abs(simulate_lines(lines, model) - lines.y).max(axis=1)
    assert (error < 1e-8 * np.abs(lines.y).max(axis=1)).all()


def test_an_unstable_plant_can_be_simulated_in_lines():
    """Unlike in time, nothing grows: the tail holds the state at the ends of the window."""
    p = PLANTS['unstable']
    lines, model = true_window(np.random.default_rng(11), p)
    assert line_fit(lines, model)[0] > 99.9999


def test_fit_of_a_perfect_and_of_a_silent_model():
    lines, model = true_window(np.random.default_rng(12), PLANTS['hd51'], trim=3.0)
    np.testing.assert_allclose(line_fit(lines, model), 100.0, atol=1e-5)
    level = as_real(lines.y) @ np.linalg.pinv(as_real(lines.ones))
    silent = replace(model, C=0.0 * model.C, y_trim=level)
    np.testing.assert_allclose(line_fit(lines, silent), 0.0, atol=1e-9)


def test_fit_is_the_error_over_what_is_not_constant():
    lines, model = true_window(np.random.default_rng(13), PLANTS['hd51'], trim=3.0)
    y, ones = as_real(lines.y), as_real(lines.ones)
    spread = np.linalg.norm(y - y @ np.linalg.pinv(ones) @ ones, axis=1)
    off = replace(model, C=0.9 * model.C)
    error = np.linalg.norm(0.1 * (y - 3.0 * ones), axis=1)
    np.testing.assert_allclose(line_fit(lines, off), 100.0 * (1.0 - error / spread), atol=1e-4)


@pytest.mark.parametrize('name', ['hd51', 'hd52', 'unstable'])
def test_fit_on_data_that_the_model_has_not_seen(name):
    """The state at the ends of another window is not that of the first: it is fitted anew."""
    rng = np.random.default_rng(14)
    p = PLANTS[name]
    (_, model), (other, _) = true_window(rng, p), true_window(rng, p)
    assert unseen_fit(other, model).min() > 99.99
    assert line_fit(other, model).min() < 99.0


def test_what_the_free_response_explains_does_not_count():
    """Inputs without effect explain nothing, however well the fitted states follow."""
    rng = np.random.default_rng(15)
    (lines, model), (other, _) = (true_window(rng, PLANTS['hd51']) for _ in range(2))
    idle = replace(model, B=0.0 * model.B, D=0.0 * model.D)
    assert unseen_fit(other, idle).max() < 1.0
    swapped = replace(other, u=lines.u)
    assert unseen_fit(swapped, model).max() < 10.0


def test_the_unseen_fit_does_not_depend_on_units():
    rng = np.random.default_rng(16)
    (_, model), (other, _) = (true_window(rng, PLANTS['hd52']) for _ in range(2))
    other = replace(other, y=other.y + 0.3 * np.abs(other.y).mean(axis=1, keepdims=True)
                    * noise(rng, *other.y.shape))
    size = np.array([[1e6], [1e-6], [1.0], [1e3]])
    scaled = replace(model, C=size * model.C, D=size * model.D, y_trim=size * model.y_trim)
    np.testing.assert_allclose(unseen_fit(replace(other, y=size * other.y), scaled),
                               unseen_fit(other, model), atol=1e-3)


def test_a_long_ring_down_and_an_offset_are_no_merit_of_the_inputs():
    """Fitted states and levels describe most of these outputs; idle inputs still explain none."""
    rng = np.random.default_rng(20)
    lines, model = true_window(rng, PLANTS['flexible'], trim=50.0)
    idle = replace(model, B=0.0 * model.B, D=0.0 * model.D)
    ringing = simulate_lines(lines, idle)
    hiss = noise(rng, *ringing.shape) * 0.05 * np.abs(ringing[:, 1:]).mean(axis=1, keepdims=True)
    other = replace(lines, y=ringing + hiss)
    assert line_fit(other, idle).min() > 70.0             # its tail is that of the very window
    assert unseen_fit(other, idle).max() < 1.0
    assert unseen_fit(replace(lines, y=lines.y + hiss), model).min() > 70.0


def test_the_unseen_fit_of_parts():
    """Each part of a divided record has its own states at its ends."""
    rng = np.random.default_rng(17)
    (first, model), (second, _) = (true_window(rng, PLANTS['hd52']) for _ in range(2))
    count = len(first.s)
    tail = np.zeros((2, 2 * count), dtype=complex)
    tail[0, :count], tail[1, count:] = first.tail, second.tail
    joined = replace(first, tail=tail, s=np.concatenate((first.s, second.s)), **{
        name: np.hstack((getattr(first, name), getattr(second, name)))
        for name in ('u', 'y', 'ones')})
    assert unseen_fit(joined, model).min() > 99.99


def test_fit_without_tail_and_trim():
    lines, model = true_window(np.random.default_rng(18), PLANTS['hd51'])
    bare = replace(lines, tail=lines.tail[:0], ones=lines.ones[:0])
    model = replace(model, tail=model.tail[:, :0], x_trim=model.x_trim[:, :0],
                    y_trim=model.y_trim[:, :0])
    error = np.linalg.norm(as_real(bare.y - simulate_lines(bare, model)), axis=1)
    wanted = 100.0 * (1.0 - error / np.linalg.norm(as_real(bare.y), axis=1))
    np.testing.assert_allclose(line_fit(bare, model), wanted)
    np.testing.assert_allclose(unseen_fit(bare, model), wanted)


def test_the_fit_of_silent_outputs_is_a_number():
    lines, model = true_window(np.random.default_rng(19), PLANTS['hd51'])
    silent = replace(lines, y=np.zeros_like(lines.y))
    for fit in (line_fit, unseen_fit):
        assert (fit(silent, model) < 0.0).all()


def test_shapes_of_nothing():
    rng = np.random.default_rng(16)
    lines = random_lines(rng, nu=0)
    m = random_model(rng, nu=0)
    assert prediction_errors(lines, m).shape == (3, 25)
    assert jacobian(lines, m, True, with_noise=False).shape == (3, 50, 9 + 6 + 9 + 3)


@pytest.mark.parametrize('unit', [1e-6, 1.0, 1e6])
@pytest.mark.parametrize('zero', [True, False])
def test_without_K_both_noise_models_are_equally_likely(zero, unit):
    """Whatever the unit of y, and whether or not there is a line at frequency zero."""
    rng = np.random.default_rng(21)
    lines, m = random_lines(rng, zero=zero), stable_model(rng)
    one = replace(lines, y=unit * lines.y[:1])
    fast = m.A - 50.0 * np.eye(len(m.A))
    single = replace(m, A=fast, C=unit * m.C[:1], D=unit * m.D[:1], K=0.0 * m.K[:, :1],
                     y_trim=unit * m.y_trim[:1])
    assert innovation_cost(one, single) == pytest.approx(output_error_cost(one, single), abs=1e-2)
