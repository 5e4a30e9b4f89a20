# SPDX-License-Identifier: Apache-2.0
"""Laguerre coefficients, against quadrature and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import eval_laguerre

from ctsid_core.model import simulation
from ctsid_core.signals.record import Signal
from ctsid_core.subspace.ct_pbsid import coefficients, reach

A = 3.0


def laguerre_functions(count, a, t):
    k = np.arange(count).reshape(-1, *(1,) * np.ndim(t))
    return np.sqrt(2.0 * a) * np.exp(-a * t) * eval_laguerre(k, 2.0 * a * t)


def test_functions_have_decayed_where_said():
    for count in (1, 5, 12, 52):
        t = np.linspace(reach(count), 10 * reach(count), 500)
        assert np.abs(laguerre_functions(count, 1.0, t)).max() < 2e-10


def direct(f, at, span, count, kinks):
    """Integrate l_k(r) f(t + r) panel by panel between the kinks of f."""
    x, w = np.polynomial.legendre.leggauss(24)
    found = []
    for t in at:
        end = span[1]
        edges = np.unique(np.concatenate(([t, end], kinks[(kinks - t) * (kinks - end) < 0])))
        half = 0.5 * np.diff(edges)[:, np.newaxis]
        points = (edges[:-1, np.newaxis] + half * (x + 1.0)).ravel()
        r = np.abs(points - t)
        found.append(laguerre_functions(count, A, r) @ (f(points) * (half * w).ravel()[:, None]))
    return np.stack(found, axis=-1)


@pytest.mark.parametrize('hold', ['zoh', 'linear'])
@pytest.mark.parametrize('uniform', [True, False])
def test_held_and_linear_signals_are_exact(hold, uniform):
    rng = np.random.default_rng(1)
    t = np.linspace(0.0, 6.0, 121) if uniform else np.sort(rng.uniform(0.0, 6.0, 121))
    values = rng.standard_normal((121, 2))
    span, at = (0.5, 5.5), np.sort(rng.uniform(0.5, 5.5, 7))

    def f(x):
        if hold == 'zoh':
            return values[np.searchsorted(t, x, side='right') - 1]
        return np.stack([np.interp(x, t, row) for row in values.T], axis=1)

    found = coefficients([Signal(t, values, hold)], at, span, A, 14, [0.0, 0.0])
    wanted = direct(f, at, span, 14, t)
    np.testing.assert_allclose(found, wanted, atol=1e-11)


def test_smooth_signals_at_irregular_stamps():
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.004, 0.012, 800))
    span, at = (0.5, 5.0), np.linspace(1.0, 4.5, 5)

    def f(x):
        return np.stack((np.sin(3.0 * x), np.cos(7.0 * x + 1.0)), axis=1)

    found = coefficients([Signal(t, f(t))], at, span, A, 12, [0.0, 0.0])
    wanted = direct(f, at, span, 12, np.linspace(0.5, 5.0, 40))
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_signals_of_other_stamps_and_dead_times_stand_below_each_other():
    t, s = np.linspace(0.0, 6.0, 301), np.linspace(0.0, 6.0, 251)
    at = np.array([1.0, 2.0])
    one, two = Signal(t, np.sin(t)[:, None], 'linear'), Signal(s, np.cos(2 * s)[:, None])
    both = coefficients([one, two], at, (0.5, 6.0), A, 5, [0.1, 0.0])
    late = Signal(t + 0.1, np.sin(t)[:, None], 'linear')
    for i, alone in enumerate((late, two)):
        np.testing.assert_allclose(
            both[:, i:i + 1], coefficients([alone], at, (0.5, 6.0), A, 5, [0.0]),
            atol=1e-12)


def test_a_long_sweep_in_chunks_is_exact(monkeypatch):
    """10,000 intervals: the transform of a sine seen from anywhere is that of the all-pass."""
    monkeypatch.setattr(simulation, '_CHUNK', 700)
    t = np.linspace(0.0, 50.0, 10001)
    at = np.linspace(0.0, 30.0, 13)
    found = coefficients([Signal(t, np.sin(2.0 * t)[:, None])], at, (0.0, 50.0), A, 8, [0.0])[:, 0]
    s = -2.0j
    wanted = np.sqrt(2 * A) / (s + A) * ((s - A) / (s + A)) ** np.arange(8)
    np.testing.assert_allclose(found, (wanted[:, None] * np.exp(2j * at)).imag, atol=1e-8)
