# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

from marks import slow
import numpy as np
from plants import PLANTS, asynchronous, match, noisy, random_plant, random_signal, running
import pytest

from ctsid_core import Record, Settings
from ctsid_core.bases.hermite import project_record, time_scale
from ctsid_core.bases.quadrature import coefficients
from ctsid_core.linear.least_squares import solve
from ctsid_core.subspace.hd_pbsid import Tuning, realise, regress, stack_levels

TUNING = Tuning(beta=5.0, gamma=20.0, past=4, future=3)
OMEGA = np.array([0.0, 0.3, 2.0, 9.0, 40.0])


def regression(projection, tuning=TUNING, *, feedthrough=True, longer=0):
    levels = stack_levels(projection, tuning.beta, tuning.gamma, tuning.past + 1 + longer)
    return regress(levels, tuning, feedthrough=feedthrough, rank_tolerance=1e-10)


def model(projection, n, tuning=TUNING, **options):
    return realise(regression(projection, tuning, **options), n)


def transfer(A, B, C, D, omega=OMEGA):
    return np.array([C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B) + D for w in omega])


def response(m):
    return transfer(m.A, m.B, m.C, m.D)


def by_matrices(record, settings, nmax, n, tuning, *, feedthrough):
    """
    [HD] eq. 33 to 54 with plain matrices on rows of Hermite coefficients.

    As documented: eq. 54 multiplied by the inverse operator, C and D of eq. 52 together, outputs
    of unit norm (it matters in eq. 50), and in the exact form the virtual input e_last.
    """
    alpha, nc = time_scale(nmax, 0.5 * record.duration, settings), nmax + 1
    u, y = (np.vstack(coefficients(signals, record.start, record.end, alpha, nmax,
                                   [0.0] * len(signals)))                      # eq. 33, 34
            for signals in (record.inputs, record.outputs))
    tail = np.eye(nc)[-1:] if settings.edges == 'exact' else np.empty((0, nc))
    size = np.linalg.norm(y, axis=1, keepdims=True)
    y, z = y / size, np.vstack((u, tail, y / size))
    nz, ny, nu, p = len(z), len(y), len(u), tuning.past
    n_sub = np.sqrt(np.arange(1, nc) / 2.0)
    derivative = np.diag(n_sub, -1) - np.diag(n_sub, 1)                        # eq. 25
    operator = (derivative / alpha + tuning.beta * np.eye(nc)) / tuning.gamma  # eq. 37
    inverse = np.linalg.inv(operator)
    past = np.vstack([z @ np.linalg.matrix_power(inverse, m) for m in range(p, 0, -1)])
    direct = u if feedthrough else u[:0]
    theta = np.linalg.lstsq(np.vstack((past, direct)).T, y.T, rcond=None)[0].T  # eq. 46
    gamma_k = np.zeros((tuning.future * ny, p * nz))
    for i in range(tuning.future):                                             # eq. 48
        gamma_k[i * ny:(i + 1) * ny, i * nz:] = theta[:, :(p - i) * nz]
    left, s, _ = np.linalg.svd(gamma_k @ past, full_matrices=False)            # eq. 50
    x = np.diag(s[:n] ** -0.5) @ left[:, :n].T @ gamma_k @ past                # eq. 51
    output = np.linalg.lstsq(np.vstack((x, direct)).T, y.T, rcond=None)[0].T   # eq. 52
    e = y - output @ np.vstack((x, direct))                                    # eq. 53
    rows = np.vstack((x, z[:nz - ny], e))
    state = np.linalg.lstsq((rows @ inverse).T,
                            (tuning.gamma * x - tuning.beta * x @ inverse).T,
                            rcond=None)[0].T                                   # eq. 54
    C = size * output[:, :n]
    D = size * output[:, n:] if feedthrough else np.zeros((ny, nu))
    return state[:, :n], state[:, n:n + nu], C, D, state[:, nz - ny + n:] / size.T, s


@pytest.mark.parametrize('edges', ['paper', 'exact'])
@pytest.mark.parametrize('feedthrough', [True, False])
@pytest.mark.parametrize('name', ['flexible', *slow('hd51', 'hd52')])
def test_the_diagonal_form_equals_the_matrix_form(name, feedthrough, edges):
    rng = np.random.default_rng(0)
    p = PLANTS[name]
    record = asynchronous(rng, p, 120.0, 90.0, snr=20, band=4.0)
    settings = Settings(edges=edges, trim=False)
    tuning = replace(TUNING, beta=12.0, gamma=50.0)
    n, nmax = len(p.A), 151 if edges == 'paper' else 150
    A, B, C, D, K, s = by_matrices(record, settings, nmax, n, tuning, feedthrough=feedthrough)
    subspace = regression(project_record(record, settings, nmax), tuning, feedthrough=feedthrough)
    m = realise(subspace, n)
    poles = np.linalg.eigvals(A)
    np.testing.assert_allclose(match(np.linalg.eigvals(m.A), poles), poles,
                               rtol=1e-9, atol=1e-9 * np.abs(poles).max())
    wanted = transfer(A, B, C, D)
    np.testing.assert_allclose(response(m), wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    noise = transfer(A, K, C, np.zeros((len(C), len(C))))
    np.testing.assert_allclose(transfer(m.A, m.K, m.C, np.zeros((len(C), len(C)))), noise,
                               rtol=0, atol=1e-9 * np.abs(noise).max())
    np.testing.assert_allclose(subspace.singular_values[:n], s[:n], rtol=1e-9)


SHAPES = ((1, 1), (1, 3), (2, 1), (2, 2))


@pytest.mark.parametrize('n', [1, 4, *slow(2, 3, 5, 6)])
@pytest.mark.parametrize(('nu', 'ny'), SHAPES)
def test_noise_free_data_give_the_plant(n, nu, ny):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        p = random_plant(rng, n, nu, ny, feedthrough=seed == 1)
        record = running(rng, p, rate=200.0, band=5.0)
        past = max(n // ny + 1, 3)
        # With the usual margin the basis has decayed to 1e-5 at the edges, with this one to 1e-13.
        for margin, error in ((5.0, 2e-3), (10.0, 1e-8)):
            projection = project_record(record, Settings(edge_margin=margin), 200)
            m = model(projection, n, Tuning(10.0, 40.0, past, past))
            np.testing.assert_allclose(match(np.linalg.eigvals(m.A), p.poles), p.poles,
                                       atol=error)
            wanted = transfer(p.A, p.B, p.C, p.D)
            np.testing.assert_allclose(response(m), wanted, atol=error * np.abs(wanted).max())


@pytest.mark.parametrize('past', [2, 3, 6, 12, 20])
def test_a_long_past_does_no_harm_to_noise_free_data(past):
    rng = np.random.default_rng(1)
    p = PLANTS['hd52']
    record = running(rng, p)
    for margin, error in ((5.0, 1e-4), (10.0, 1e-8)):
        projection = project_record(record, Settings(edge_margin=margin), 300)
        m = model(projection, 3, Tuning(10.0, 40.0, past, past))
        np.testing.assert_allclose(match(np.linalg.eigvals(m.A), p.poles), p.poles, atol=error)


def test_noise_free_data_need_no_noise_model():
    rng = np.random.default_rng(2)
    p = PLANTS['hd51']
    m = model(project_record(running(rng, p), Settings(edge_margin=10.0), 300), 2)
    assert not m.K.any()
    noisy_one = model(project_record(running(rng, p, 60), Settings(), 300), 2)
    assert noisy_one.K.all()


@pytest.fixture(scope='module')
def projection():
    """A noisy window of a plant with two inputs and three outputs."""
    rng = np.random.default_rng(3)
    p = random_plant(rng, 3, 2, 3, feedthrough=True)
    return project_record(running(rng, p, 20, rate=200.0), Settings(), 200)


@pytest.mark.parametrize('size', [1e-6, 1e6])
def test_units_of_the_channels_do_not_matter(projection, size):
    plain = model(projection, 3)
    scaled = model(replace(projection, u=projection.u * np.array([[1.0], [size]]),
                           y=projection.y * np.array([[size], [1.0], [1.0 / size]])), 3)
    poles = np.linalg.eigvals(plain.A)
    np.testing.assert_allclose(match(np.linalg.eigvals(scaled.A), poles), poles, rtol=1e-9)
    wanted = response(plain) * np.array([[size], [1.0], [1.0 / size]]) / np.array([1.0, size])
    np.testing.assert_allclose(response(scaled), wanted, rtol=1e-7)
    closed = np.linalg.eigvals(plain.A - plain.K @ plain.C)
    np.testing.assert_allclose(match(np.linalg.eigvals(scaled.A - scaled.K @ scaled.C), closed),
                               closed, rtol=1e-8)


@pytest.mark.parametrize('c', [1e-3, 60.0])
def test_the_unit_of_time_does_not_matter(projection, c):
    plain = model(projection, 3)
    slower = model(replace(projection, s=projection.s / c), 3,
                   replace(TUNING, beta=TUNING.beta / c, gamma=TUNING.gamma / c))
    poles = np.linalg.eigvals(plain.A)
    np.testing.assert_allclose(match(c * np.linalg.eigvals(slower.A), poles), poles, rtol=1e-9)
    wanted = response(plain)
    got = transfer(slower.A, slower.B, slower.C, slower.D, OMEGA / c)
    np.testing.assert_allclose(got, wanted, atol=1e-9 * np.abs(wanted).max())


def test_mixing_the_inputs_mixes_the_model(projection):
    plain, mix = model(projection, 3), np.array([[1.0, 2.0], [-0.5, 3.0]])
    mixed = model(replace(projection, u=mix @ projection.u), 3)
    poles = np.linalg.eigvals(plain.A)
    np.testing.assert_allclose(match(np.linalg.eigvals(mixed.A), poles), poles, rtol=1e-9)
    wanted = response(plain)
    np.testing.assert_allclose(response(mixed) @ mix, wanted, atol=1e-9 * np.abs(wanted).max())


def test_the_order_of_the_channels_does_not_matter(projection):
    plain = model(projection, 3)
    turned = model(replace(projection, u=projection.u[::-1], y=projection.y[[2, 0, 1]]), 3)
    wanted = response(plain)[:, [2, 0, 1]][:, :, ::-1]
    np.testing.assert_allclose(response(turned), wanted, atol=1e-9 * np.abs(wanted).max())


def test_the_order_of_the_lines_does_not_matter(projection):
    plain, mixed = model(projection, 3), np.random.default_rng(0).permutation(len(projection.s))
    turned = model(replace(projection, **{name: getattr(projection, name)[..., mixed]
                                          for name in ('s', 'u', 'y', 'tail', 'ones')}), 3)
    np.testing.assert_allclose(response(turned), response(plain), rtol=1e-9)


def test_levels_beyond_those_needed_change_nothing(projection):
    wanted = response(model(projection, 3))
    np.testing.assert_allclose(response(model(projection, 3, longer=8)), wanted, rtol=1e-9)


def test_without_feedthrough_d_is_zero(projection):
    m = model(projection, 3, feedthrough=False)
    assert not m.D.any()
    assert model(projection, 3).D.all()


def test_shapes_without_tail_and_trim(projection):
    bare = replace(projection, tail=projection.tail[:0], ones=projection.ones[:0])
    m = model(bare, 3)
    assert (m.B.shape, m.D.shape, m.K.shape) == ((3, 2), (3, 2), (3, 3))


@pytest.mark.parametrize(('u', 'y'), [((0, 0, 1), (0, 1, 2)), ((0, 1), (0, 1, 1, 2)),
                                      ((0, 0), (1, 1))])
@pytest.mark.parametrize('snr', [None, 20])
def test_doubled_channels_give_finite_models(u, y, snr):
    rng = np.random.default_rng(4)
    p = random_plant(rng, 3, 2, 3)
    plain = project_record(running(rng, p, snr, rate=200.0), Settings(), 200)
    doubled = replace(plain, u=plain.u[list(u)], y=plain.y[list(y)])
    m = model(doubled, 3)
    for M in (m.A, m.B, m.C, m.D, m.K):
        assert np.isfinite(M).all()
    if snr is None and set(u) == {0, 1}:
        np.testing.assert_allclose(match(np.linalg.eigvals(m.A), p.poles), p.poles, atol=1e-4)


def test_silent_channels_give_finite_models(projection):
    for name in ('u', 'y'):
        rows = getattr(projection, name).copy()
        rows[0] = 0.0
        m = model(replace(projection, **{name: rows}), 3)
        assert np.isfinite(np.concatenate([M.ravel() for M in (m.A, m.B, m.C, m.D, m.K)])).all()


def test_trim_and_tail_take_their_share():
    """Offsets of any size, and a window not at rest, do not move the poles."""
    rng = np.random.default_rng(5)
    p = replace(PLANTS['hd51'], D=np.array([[0.1], [-0.2]]))
    still = running(rng, p)
    signal = still.outputs[0]
    moved = Record(tuple(replace(s, values=s.values + 30.0) for s in still.inputs),
                   (replace(signal, values=signal.values + [[5.0, -7.0]]),), 0.0, 10.0)
    m = model(project_record(moved, Settings(), 300), 2)
    np.testing.assert_allclose(match(np.linalg.eigvals(m.A), p.poles), p.poles, atol=1e-4)
    naive = model(project_record(moved, Settings(trim=False), 300), 2)
    assert np.abs(match(np.linalg.eigvals(naive.A), p.poles) - p.poles).max() > 1e-2


def test_solve_against_plain_least_squares():
    rng = np.random.default_rng(6)
    X, Y = rng.standard_normal((5, 40)), rng.standard_normal((2, 40))
    scale = 10.0 ** np.array([-9.0, -3.0, 0.0, 4.0, 8.0])[:, np.newaxis]
    theta, condition = solve(X * scale, Y, 1e-10)
    wanted = np.linalg.lstsq(X.T, Y.T, rcond=None)[0].T
    np.testing.assert_allclose(theta * scale.T, wanted, rtol=1e-11)
    unit = X / np.linalg.norm(X, axis=1, keepdims=True)
    assert condition == pytest.approx(np.linalg.cond(unit))


def test_solve_shares_dependent_regressors_out_evenly():
    rng = np.random.default_rng(7)
    X = rng.standard_normal((2, 30))
    twice = np.vstack((X, X[:1], np.zeros((1, 30))))
    theta, _ = solve(twice, 3.0 * X[:1], 1e-10)
    np.testing.assert_allclose(theta, [[1.5, 0.0, 1.5, 0.0]], atol=1e-12)
    assert solve(np.empty((0, 30)), X, 1e-10)[0].shape == (2, 0)


def test_condition_is_that_of_the_scaled_regression(projection):
    longer = regression(projection, replace(TUNING, past=8))
    assert 1.0 < regression(projection).condition < longer.condition


def test_the_singular_values_show_the_order():
    rng = np.random.default_rng(8)
    for n in (1, 3, 5):
        p = random_plant(rng, n, 1, 2)
        projection = project_record(running(rng, p, rate=200.0), Settings(), 200)
        s = regression(projection, Tuning(10.0, 40.0, 6, 6)).singular_values
        assert (np.diff(s) <= 0.0).all()
        assert s[n] < 1e-2 * s[n - 1]


def test_noise_does_not_touch_the_arguments(projection):
    before = [getattr(projection, name).copy() for name in ('s', 'u', 'y', 'tail', 'ones')]
    model(projection, 3)
    for name, kept in zip(('s', 'u', 'y', 'tail', 'ones'), before, strict=True):
        np.testing.assert_array_equal(getattr(projection, name), kept)


def test_estimates_close_in_on_the_truth_as_the_noise_falls():
    p, errors = PLANTS['hd51'], []
    for snr in (20, 40, 60, 80):
        found = []
        for seed in range(4):
            rng = np.random.default_rng(seed)
            u = random_signal(rng)
            t = np.arange(2001) / 200.0
            record = Record.from_arrays(t, u.on_grid(2001, 0.005), t, noisy(
                rng, u.output(p).on_grid(2001, 0.005), snr), input_hold='smooth')
            m = model(project_record(record, Settings(), 250), 2)
            found.append(match(np.linalg.eigvals(m.A), p.poles))
        errors.append(np.sqrt(np.mean(np.abs(np.array(found) - p.poles) ** 2)))
    assert errors[0] < 0.3
    for more, less in zip(errors[:-1], errors[1:], strict=True):
        assert less < 0.25 * more                       # 20 dB less noise: a tenth of the error
