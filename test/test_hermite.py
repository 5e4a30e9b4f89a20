# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

from marks import slow
import numpy as np
from plants import PLANTS, jittered, random_plant, random_signal
import pytest

from ctsid_core import Record, Settings, Signal
from ctsid_core.bases.hermite import as_real, hermite_lines, project_record, time_scale
from ctsid_core.bases.hermite_functions import hermite_functions
from ctsid_core.bases.quadrature import coefficients

ORDERS = (1, 2, 3, 8, 9, 250, 301, 744, 745)


def derivative(nmax: int) -> np.ndarray:
    """Eq. 25 of [HD], entry by entry."""
    D = np.zeros((nmax + 1, nmax + 1))
    for n in range(1, nmax + 1):
        D[n, n - 1], D[n - 1, n] = np.sqrt(n / 2.0), -np.sqrt(n / 2.0)
    return D


def all_lines(nmax: int) -> np.ndarray:
    """Return the matrix that takes coefficients to lines."""
    return hermite_lines(nmax).of(np.eye(nmax + 1))


@pytest.mark.parametrize('nmax', ORDERS)
def test_the_lines_are_an_orthonormal_image_of_the_coefficients(nmax):
    basis = hermite_lines(nmax)
    assert len(basis.w) == nmax // 2 + 1
    assert (np.diff(basis.w) > 0.0).all()
    assert basis.w[0] == 0.0 if nmax % 2 == 0 else basis.w[0] > 0.0
    M = as_real(all_lines(nmax))
    np.testing.assert_allclose(M @ M.T, np.eye(nmax + 1), atol=2e-12)


@pytest.mark.parametrize('nmax', ORDERS)
def test_the_derivative_is_diagonal(nmax):
    """Eq. 25 = V diag(i w) V^H, both built: the lines f V of f D are i w times those of f."""
    D, lines, w = derivative(nmax), all_lines(nmax), hermite_lines(nmax).w
    top = np.sqrt(2.0 * nmax + 1.0)
    # Lines of w > 0 stand for their conjugates too and carry sqrt(2): V diag V^H is a real part.
    np.testing.assert_allclose(((lines * (1j * w)) @ lines.conj().T).real, D, atol=2e-12 * top)
    f = np.random.default_rng(0).standard_normal((3, nmax + 1))
    np.testing.assert_allclose(f @ D @ lines, 1j * w * (f @ lines),
                               atol=1e-11 * top)


@pytest.mark.parametrize('nmax', [8, 9, 40])
def test_the_frequencies_are_those_of_the_matrix(nmax):
    values = np.linalg.eigvals(derivative(nmax))
    np.testing.assert_allclose(values.real, 0.0, atol=1e-13)
    positive = np.sort(values.imag[values.imag > -1e-12])
    np.testing.assert_allclose(hermite_lines(nmax).w, positive, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize('nmax', [1999, 2000])
def test_high_orders(nmax):
    test_the_lines_are_an_orthonormal_image_of_the_coefficients(nmax)
    D, lines, w = derivative(nmax), all_lines(nmax), hermite_lines(nmax).w
    f = np.random.default_rng(0).standard_normal((2, nmax + 1))
    error = f @ D @ lines - 1j * w * (f @ lines)
    assert np.abs(error).max() < 1e-10 * np.sqrt(2.0 * nmax + 1.0)


@pytest.mark.parametrize('nmax', ORDERS)
def test_the_constant(nmax):
    basis = hermite_lines(nmax)
    reach = np.sqrt(2.0 * nmax + 1.0) + 9.0
    x, step = np.linspace(-reach, reach, 4001, retstep=True)
    ones = step * hermite_functions(nmax, x).sum(axis=1)[np.newaxis]
    np.testing.assert_allclose(basis.ones, ones @ all_lines(nmax), atol=1e-11)


@pytest.mark.parametrize(('edges', 'margin'), [('paper', 0.0), ('exact', 5.0), ('exact', 8.0)])
def test_time_scale(edges, margin):
    settings = Settings(edges=edges, edge_margin=margin or 5.0)
    alpha = time_scale(300, 4.0, settings)
    turning = np.sqrt(601.0)
    assert 4.0 / alpha == pytest.approx(turning + margin * turning ** (-1.0 / 3.0))
    # In the exact form even the highest function, and the next, are small at the edges.
    edge = np.abs(hermite_functions(301, np.array([4.0 / alpha])))[300:].max()
    assert edge > 0.2 if edges == 'paper' else edge < np.exp(-0.85 * margin ** 1.5)


def generic(p, rng, *, nmax=120, rate=200.0, settings=None, uniform=True):
    """Return projection, and the coefficients of states and inputs, of a window not at rest."""
    t = np.arange(2001) / rate if uniform else jittered(rng, rate, 2000 / rate)
    u = random_signal(rng, p.B.shape[1], band=2.0)
    signals = [Signal(t, f.at(t)) for f in (u, u.output(p), u.states(p))]
    record = Record.from_signals(signals[:1], signals[1:2])
    settings = settings or Settings(edge_margin=10.0, trim=False)
    alpha = time_scale(nmax, 0.5 * record.duration, settings)
    rows = coefficients(signals, record.start, record.end, alpha, nmax + 1, [0.0] * 3)
    return project_record(record, settings, nmax), alpha, *rows


@pytest.mark.parametrize('uniform', [True, False])
@pytest.mark.parametrize('nmax', [119, *slow(120)])
def test_the_tail_identity(uniform, nmax):
    """x D / alpha - A x - B u is zero but for its last column, which is known."""
    rng = np.random.default_rng(1)
    for p in (PLANTS['hd52'], random_plant(rng, 4, 2, 3)):
        _, alpha, u, _, x = generic(p, rng, nmax=nmax, uniform=uniform)
        nc = nmax + 1
        error = x[:, :nc] @ derivative(nmax) / alpha - p.A @ x[:, :nc] - p.B @ u[:, :nc]
        size = np.abs(x[:, :nc] @ derivative(nmax) / alpha).max()
        assert np.abs(error[:, :-1]).max() < (1e-9 if uniform else 3e-5) * size
        tail = -np.sqrt(nc / 2.0) / alpha * x[:, nc]
        np.testing.assert_allclose(error[:, -1], tail, atol=(1e-9 if uniform else 3e-5) * size)
        assert np.abs(error[:, -1]).max() > 1e-4 * size           # it is not zero by itself


def test_the_lines_obey_the_model_with_its_tail():
    rng = np.random.default_rng(2)
    p = random_plant(rng, 4, 2, 3, feedthrough=True)
    projection, alpha, u, _, x = generic(p, rng)
    tail = -np.sqrt(121 / 2.0) / alpha * x[:, 121:]
    lines = x[:, :121] @ all_lines(120)
    wanted = lines * projection.s
    got = p.A @ lines + p.B @ projection.u + tail @ projection.tail
    np.testing.assert_allclose(got, wanted, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(p.C @ lines + p.D @ projection.u, projection.y,
                               atol=1e-9 * np.abs(projection.y).max())


def test_energy_is_kept():
    """Parseval: the lines of a signal well inside of the disc have its energy."""
    t = np.linspace(-5.0, 5.0, 2001)
    f = np.exp(-3.0 * t ** 2) * np.cos(8.0 * t + 0.3)
    record = Record.from_arrays(t, f, t, 2.0 * f)
    settings = Settings()
    projection = project_record(record, settings, 150)
    alpha = time_scale(150, 5.0, settings)
    energy = np.sum(f ** 2) * (t[1] - t[0]) / alpha
    assert np.sum(as_real(projection.y) ** 2) == pytest.approx(4.0 * energy, rel=1e-10)


def test_the_projection_describes_its_record():
    rng = np.random.default_rng(3)
    t = jittered(rng, 100.0)
    u, y = rng.standard_normal((len(t), 2)), rng.standard_normal((len(t), 3))
    record = Record.from_arrays(t, u, t, y)
    full = project_record(record, Settings(), 90)
    assert (full.u.shape, full.y.shape) == ((2, 46), (3, 46))
    assert (full.tail.shape, full.ones.shape) == ((1, 46), (1, 46))
    assert full.length == record.duration
    alpha = time_scale(90, 0.5 * record.duration, Settings())
    np.testing.assert_allclose(full.s, 1j * hermite_lines(90).w / alpha, rtol=1e-15)
    bare = project_record(record, Settings(trim=False, edges='paper'), 90)
    assert (bare.tail.shape, bare.ones.shape) == ((0, 46), (0, 46))


@pytest.mark.parametrize('edges', ['exact', 'paper'])
def test_white_noise_is_white_over_the_lines(edges):
    """Noise of variance r at rate f has intensity r / f, and r / f / unit in every part."""
    rng = np.random.default_rng(5)
    t, settings = np.linspace(0.0, 10.0, 2001), Settings(edges=edges)
    y = 3.0 * rng.standard_normal((2001, 400))
    found = project_record(Record.from_arrays(t, t, t, y), settings, 60)
    assert found.unit == pytest.approx(time_scale(60, 5.0, settings))
    rows = as_real(found.y)[:, 2:]                     # the line at w = 0 has no imaginary part
    np.testing.assert_allclose(rows.var(axis=0), 9.0 / 200.0 / found.unit, rtol=0.3)
    assert rows.var() == pytest.approx(9.0 / 200.0 / found.unit, rel=0.03)
    correlation = np.corrcoef(rows.T) - np.eye(rows.shape[1])
    assert np.abs(correlation).max() < 0.25


def test_the_constant_is_that_of_the_window():
    """The lines of a constant output are the ones, in both treatments of the edges."""
    t = np.linspace(3.0, 13.0, 500)
    record = Record.from_arrays(t, np.sin(t), t, np.full(500, 7.0), output_hold='zoh')
    record = replace(record, end=13.0)
    for edges, tolerance in (('paper', 1e-12), ('exact', 1e-4)):
        projection = project_record(record, Settings(edges=edges), 60)
        np.testing.assert_allclose(projection.y, 7.0 * projection.ones, atol=tolerance)


def test_dead_times_shift_single_channels():
    rng = np.random.default_rng(4)
    t = jittered(rng, 100.0, 12.0) - 1.0
    f = random_signal(rng, 3, band=2.0)
    y = Signal(t, np.sin(t)[:, np.newaxis])
    joined = Record((Signal(t, f.at(t), 'linear'),), (y,), 0.5, 10.5)
    alone = Record(tuple(Signal(t + d, f.at(t)[:, [j]], 'linear')
                         for j, d in enumerate((0.0, 0.3, 0.1))), (y,), 0.5, 10.5)
    late = project_record(joined, Settings(delay=(0.0, 0.3, 0.1)), 80)
    np.testing.assert_allclose(late.u, project_record(alone, Settings(), 80).u, atol=1e-12)
    same = project_record(joined, Settings(delay=0.3), 80)
    np.testing.assert_allclose(same.u[1], late.u[1], atol=1e-12)
    assert np.abs(same.u[0] - late.u[0]).max() > 0.1


def test_a_divided_record_is_its_parts_side_by_side():
    rng = np.random.default_rng(6)
    t = jittered(rng, 100.0, 12.0)
    record = Record.from_arrays(t, rng.standard_normal((len(t), 2)), t,
                                rng.standard_normal((len(t), 3)))
    whole = project_record(record, Settings(parts=3), 60)
    lines = len(hermite_lines(60).w)
    assert (whole.u.shape, whole.tail.shape) == ((2, 3 * lines), (3, 3 * lines))
    assert whole.length == record.duration / 3
    bounds = np.linspace(record.start, record.end, 4)
    for i in range(3):
        part = project_record(replace(record, start=bounds[i], end=bounds[i + 1]), Settings(), 60)
        own = slice(i * lines, (i + 1) * lines)
        for name in ('s', 'u', 'y', 'ones'):
            np.testing.assert_allclose(getattr(whole, name)[..., own], getattr(part, name),
                                       atol=1e-12, err_msg=name)
        np.testing.assert_allclose(whole.tail[i, own], part.tail[0], atol=1e-15)
        assert whole.unit == pytest.approx(part.unit)
    assert np.count_nonzero(whole.tail) <= 3 * lines
    bare = project_record(record, Settings(parts=3, edges='paper', trim=False), 60)
    assert (bare.tail.shape, bare.ones.shape) == ((0, 3 * lines), (0, 3 * lines))


def test_an_output_alone_can_be_projected():
    t = np.linspace(0.0, 10.0, 500)
    record = Record.from_signals((), (Signal(t, np.sin(t)[:, np.newaxis]),))
    projection = project_record(record, Settings(), 60)
    assert projection.u.shape == (0, 31)
