# SPDX-License-Identifier: Apache-2.0
from functools import lru_cache

from marks import slow
import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from ctsid_core.bases.hermite_functions import hermite_functions, integral_of_first

# The start of the plain recursion underflows at |x| = 38.6.
ARGUMENTS = (0.0, 1e-300, 0.7, 5.3, 36.999, 37.0, 37.001, 38.0, 38.55, 38.65, 39.0, 45.0, 70.3,
             99.0, 200.0, 1e6)


@lru_cache
def ratios(nmax: int) -> list[tuple]:
    with mpmath.workdps(50):
        one = mpmath.mpf(1)
        return [(mpmath.sqrt(2 * one / (n + 1)), mpmath.sqrt(one * n / (n + 1)))
                for n in range(nmax)]


def truth(nmax: int, x: float) -> np.ndarray:
    """Eq. 16 to 18 of [HD] with 50 digits."""
    with mpmath.workdps(50):
        x = mpmath.mpf(x)
        first = mpmath.pi ** mpmath.mpf('-0.25') * mpmath.exp(-x * x / 2)
        h = [first, mpmath.sqrt(2) * x * first]
        for n, (a, b) in enumerate(ratios(nmax)[1:], start=1):
            h.append(a * x * h[n] - b * h[n - 1])
        return np.array([float(value) for value in h])


def explicit(n: int, x: float) -> float:
    """Eq. 13 of [HD]: no recursion at all."""
    with mpmath.workdps(60):
        x = mpmath.mpf(x)
        size = mpmath.sqrt(mpmath.mpf(2) ** n * mpmath.sqrt(mpmath.pi) * mpmath.factorial(n))
        return float(mpmath.exp(-x * x / 2) * mpmath.hermite(n, x) / size)


@lru_cache
def largest(nmax: int) -> np.ndarray:
    """Largest value of each function: it is taken just inside of the turning point."""
    n = np.arange(nmax + 1)
    airy = 2.0 ** 0.25 * 0.535657 * np.maximum(n, 1) ** (-1.0 / 12.0)
    return np.where(n < 5, 0.5, airy)


def test_largest_values_are_those_of_the_airy_limit():
    n, nmax = np.arange(50, 401), 400
    values = np.abs(hermite_functions(nmax, np.linspace(0.0, 32.0, 20001)))[n].max(axis=1)
    np.testing.assert_allclose(values, largest(nmax)[n], rtol=5e-3)


@pytest.mark.parametrize('x', [*ARGUMENTS[::4], *slow(*(
    x for k, x in enumerate(ARGUMENTS) if k % 4))])
def test_values_are_those_of_mpmath_up_to_order_5000(x):
    error = np.abs(hermite_functions(5000, np.array([x]))[:, 0] - truth(5000, x))
    assert (error / largest(5000)).max() < 1e-12


@pytest.mark.parametrize('nmax', [1, 2, 744, 746, *slow(5000)])
def test_values_about_the_turning_point(nmax):
    turning = np.sqrt(2.0 * nmax + 1.0)
    for x in turning + np.array([-3.0, -0.5, 0.0, 0.2, 4.0]):
        error = np.abs(hermite_functions(nmax, np.array([x]))[:, 0] - truth(nmax, x))
        assert (error / largest(nmax)).max() < 1e-12


@pytest.mark.parametrize('n', [0, 1, 2, 3, 10, 57, 300])
def test_values_are_those_of_the_definition(n):
    x = np.array([-4.1, 0.3, 2.0, 7.7, 24.0])
    wanted = [explicit(n, v) for v in x]
    np.testing.assert_allclose(hermite_functions(n, x)[n], wanted, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize('reach', [20.0, 60.0, 1e4])
def test_even_and_odd(reach):
    x = np.random.default_rng(0).uniform(0.0, reach, 50)
    sign = (-1.0) ** np.arange(901)
    np.testing.assert_array_equal(hermite_functions(900, -x),
                                  sign[:, np.newaxis] * hermite_functions(900, x))


def test_a_value_does_not_depend_on_its_neighbours_nor_on_the_highest_order():
    x = np.array([0.5, 12.0, 30.0])
    alone = hermite_functions(800, x)
    np.testing.assert_allclose(hermite_functions(300, x), alone[:301], rtol=1e-13, atol=1e-300)
    joined = hermite_functions(800, np.append(x, 50.0))[:, :3]
    np.testing.assert_allclose(joined, alone, atol=2e-13)


@pytest.mark.parametrize('nmax', [0, 1, 40, 300, 1200])
def test_the_functions_are_orthonormal(nmax):
    turning = np.sqrt(2.0 * nmax + 1.0)
    reach = turning + 8.0
    # The trapezoid rule is exact once its nodes resolve the products, up to 2 turning rad.
    x, step = np.linspace(-reach, reach, 2 * int(reach * (turning + 8.0) / np.pi) + 50,
                          retstep=True)
    h = hermite_functions(nmax, x)
    np.testing.assert_allclose(step * h @ h.T, np.eye(nmax + 1), atol=2e-12)


def test_arguments_are_left_alone():
    given = np.linspace(-500.0, 500.0, 9)
    before = given.copy()
    hermite_functions(100, given)
    np.testing.assert_array_equal(given, before)


@pytest.mark.parametrize('x', [-40.0, -3.0, 0.0, 0.9, 40.0])
def test_integral_of_the_first_function(x):
    wanted = quad(lambda t: np.pi ** -0.25 * np.exp(-t * t / 2), -30.0, x, limit=200,
                  points=[0.0] if -30.0 < x and x > 0 else None, epsabs=1e-13)[0]
    assert integral_of_first(np.array([x]))[0] == pytest.approx(max(wanted, 0.0), abs=1e-12)
