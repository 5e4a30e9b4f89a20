# SPDX-License-Identifier: Apache-2.0
"""The Takenaka-Malmquist basis against its definition."""

from __future__ import annotations

from marks import slow
import numpy as np
import pytest
from scipy.integrate import quad_vec, solve_ivp

from ctsid_core.bases.takenaka_malmquist import chain, legendre, respond
from ctsid_core.errors import SettingsError
from ctsid_core.linear.matrix_functions import exponentials
from ctsid_core.model.simulation import input_polynomials, knots_between
from ctsid_core.signals.record import Signal
from ctsid_ros.studies.filtered_inputs import commuting

SEQUENCES = {
    'spread': np.linspace(4.0, 60.0, 8),
    'laguerre': np.full(8, 7.0),
    'legendre': 3.0 * (np.arange(8) + 0.5),
    'pairs': np.array([1 + 2j, 1 - 2j, 3.0, 0.5 + 5j, 0.5 - 5j, 0.5 + 5j, 0.5 - 5j, 2.0]),
    'single': np.array([2.0]),
}


def printed(poles, s):
    """[TM] eq. 2, with the conjugates that it lacks."""
    found, before = [], np.ones_like(s)
    for pole in poles:
        found.append(before * np.sqrt(2 * pole.real) / (s + pole))
        before = before * (s - np.conj(pole)) / (s + pole)
    return np.array(found).T


def response(basis, omega):
    """The functions at i omega, (len(omega), N)."""
    return np.array([np.linalg.solve(1j * w * np.eye(basis.size) - basis.L, basis.b)
                     for w in omega])


@pytest.mark.parametrize('name', SEQUENCES)
def test_orthonormal_by_quadrature(name):
    basis = chain(SEQUENCES[name])

    def products(t):
        w = exponentials(basis.L, np.array([t]), 0)[0][0] @ basis.b
        return np.outer(w, w)

    slowest = np.min(np.linalg.eigvals(-basis.L).real)
    gram, _ = quad_vec(products, 0.0, 60.0 / slowest, epsabs=1e-11, epsrel=1e-11, limit=2000)
    np.testing.assert_allclose(gram, np.eye(basis.size), atol=1e-9)


@pytest.mark.parametrize('name', SEQUENCES)
def test_is_the_definition(name):
    basis, omega = chain(SEQUENCES[name]), np.geomspace(0.01, 1e3, 60)
    own = response(basis, omega) @ basis.turn.T
    np.testing.assert_allclose(own, printed(SEQUENCES[name].astype(complex), 1j * omega),
                               rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(basis.turn @ basis.turn.conj().T, np.eye(basis.size), atol=1e-15)


def test_printed_definition_is_not_orthonormal_for_pairs():
    """Why the conjugates are there."""
    poles, omega = np.array([1 + 2j, 1 - 2j]), np.linspace(-2e4, 2e4, 800001)
    s = 1j * omega
    wrong = np.sqrt(2 * poles[1]) / (s + poles[1]) * (s - poles[0]) / (s + poles[0])
    right = printed(poles, s)
    first = np.sqrt(2 * poles[0]) / (s + poles[0])
    step = omega[1] - omega[0]
    assert abs(np.sum(wrong * first.conj()) * step / (2 * np.pi)) > 0.1
    assert abs(np.sum(right[:, 1] * right[:, 0].conj()) * step / (2 * np.pi)) < 1e-3


def test_special_sequences():
    omega = np.geomspace(0.1, 100.0, 20)
    s = 1j * omega
    own = response(chain(np.full(4, 5.0)), omega)
    textbook = [np.sqrt(10.0) * (s - 5.0) ** k / (s + 5.0) ** (k + 1) for k in range(4)]
    np.testing.assert_allclose(own, np.array(textbook).T, rtol=1e-10)
    np.testing.assert_allclose(legendre(8.0, 3).poles, [4.0, 12.0, 20.0])


@pytest.mark.parametrize('name', SEQUENCES)
def test_commuting_matrices(name):
    basis = chain(SEQUENCES[name])
    Z = commuting(basis)
    for k in range(basis.size):
        s = 0.3 + 2.0j
        w = np.linalg.solve(s * np.eye(basis.size) - basis.L, basis.b)
        e = np.linalg.solve(s * np.eye(basis.size) - basis.L, np.eye(basis.size)[k])
        np.testing.assert_allclose(Z[k] @ w, e, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize('hold', ['zoh', 'linear', 'smooth'])
@pytest.mark.parametrize('name', ['pairs', *slow('spread', 'laguerre')])
def test_response_is_that_of_the_differential_equation(name, hold):
    rng = np.random.default_rng(3)
    basis = chain(SEQUENCES[name])
    signals = [Signal(np.sort(rng.uniform(0.0, 1.5, 12)), rng.standard_normal((12, 1)), hold),
               Signal(np.sort(rng.uniform(0.0, 1.5, 9)), rng.standard_normal((9, 1)), hold)]
    times = np.linspace(0.0, 1.5, 7)
    knots = knots_between(signals, (0.0, 0.0), times)
    u = input_polynomials(signals, (0.0, 0.0), knots)
    w = respond(basis, u, knots)
    state = np.zeros(2 * basis.size)
    for k, h in enumerate(np.diff(knots)):
        def slope(t, x, k=k):
            now = sum(u[j, k] * t ** j / max(1, np.prod(np.arange(1, j + 1)))
                      for j in range(len(u)))
            return (basis.L @ x.reshape(-1, 2) + np.outer(basis.b, now)).ravel()
        state = solve_ivp(slope, (0.0, h), state, method='DOP853', rtol=1e-10,
                          atol=1e-11).y[:, -1]
        np.testing.assert_allclose(w[k + 1].ravel(), state, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(('poles', 'words'), [
    ([], 'no pole'), ([1.0, -2.0], 'positive real part'), ([1 + 2j, 3.0], 'conjugate'),
    ([np.nan], 'positive')])
def test_wrong_poles(poles, words):
    with pytest.raises(SettingsError, match=words):
        chain(poles)
