# SPDX-License-Identifier: Apache-2.0
"""Gains of models: of what settles, of what integrates, and of what has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.model.covariance import Covariance, Entries
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.gains import gains, grows
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import UNJUDGED, Grade
from ctsid_ros.replay.along import Windows
from ctsid_ros.report.document import to_text
from ctsid_ros.report.explorer import facts
from ctsid_ros.report.sections import choice_section, gain_section
from ctsid_ros.report.window_figures import gain_figures

RATE = 3.0


def known(model: StateSpace, pole_std: float, seed: int = 0, size: float = 1e-3) -> Covariance:
    """A covariance of all entries, that of the first pole in A by itself."""
    rng = np.random.default_rng(seed)
    rows = [size * rng.standard_normal((6, *part.shape)) for part in (
        model.A, model.B, model.C, model.D)]
    rows[0][:, 0, 0] += pole_std / np.sqrt(6.0)
    return Covariance.of_entries(Entries(*rows, np.zeros((6, model.nu))), model)


@pytest.mark.parametrize('pole', [-0.02, 0.0, 0.02])
def test_the_rate_of_what_integrates_has_the_deviation_of_its_derivative(pole):
    """On either side of 0 alike, against differences of the residue at the pole."""
    model = StateSpace(np.array([[pole, 1.0], [0.0, -4.0]]), np.array([[0.5], [8.0]]),
                       np.array([[1.0, 0.2], [0.0, 1.0]]))
    covariance = known(model, 0.1)
    found = gains(model, covariance)
    assert found.rate.tolist() == [[True], [False]]
    assert found.pole == pytest.approx(pole, abs=1e-12)
    assert found.value[1, 0] == pytest.approx(2.0)
    assert not grows(model, covariance)

    def rate(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> float:
        values, right = np.linalg.eig(A)
        k = np.argmin(np.abs(values))
        return float((C[0] @ right[:, k] * (np.linalg.inv(right)[k] @ B[:, 0])).real)

    e, h = covariance.entries, 1e-5
    sides = [[rate(model.A + s * e.A[k], model.B + s * e.B[k], model.C + s * e.C[k])
              for s in (h, -h)] for k in range(len(e.A))]
    slopes = [(a - b) / (2.0 * h) for a, b in sides]
    assert found.value[0, 0] == pytest.approx(rate(model.A, model.B, model.C))
    assert found.std[0, 0] == pytest.approx(np.linalg.norm(slopes), rel=1e-4)


def test_poles_that_are_known_less_than_the_gain_they_make_integrate_not():
    """Two poles near each other, and an input that hardly moves the output."""
    model = StateSpace(np.diag([-1.9, -2.1]), np.array([[1.0, 0.05], [1.0, -0.05]]),
                       np.array([[1.0, 1.0]]))
    A = np.zeros((1, 2, 2))
    A[0] = np.diag([0.8, -0.8 * (2.1 / 1.9) ** 2])
    none = [np.zeros((1, *part.shape)) for part in (model.B, model.C, model.D)]
    found = gains(model, Covariance.of_entries(Entries(A, *none, np.zeros((1, 2))), model))
    assert not found.rate.any()
    assert found.value == pytest.approx(model.dc_gain)
    assert found.std[0, 0] < 0.01
    assert found.std[0, 1] > 3.0 * abs(found.value[0, 1])


def test_what_grows_or_integrates_twice_has_no_gain():
    grown = StateSpace(np.diag([0.5, -4.0]), np.ones((2, 1)), np.ones((1, 2)))
    assert gains(grown, known(grown, 0.01)) is None
    assert gains(grown) is None
    assert grows(grown, known(grown, 0.01))
    twice = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]])
    assert gains(twice) is None
    assert not grows(twice)
    once = replace(twice, A=[[0.0, 1.0], [0.0, -2.0]])
    assert gains(once).value == pytest.approx(0.5)
    assert gains(StateSpace([[-2.0]], [[1.0]], [[1.0]])).value == pytest.approx(0.5)


def test_gains_along_a_bag_are_those_that_are_known():
    """The DC gain of two windows is 1e3 and -1e3 with deviations as large; the rate is 3."""
    found = []
    for k, pole in enumerate((-0.003, 0.003, -0.002)):
        model = StateSpace([[pole]], [[RATE]], [[1.0]], input_names=('u',), output_names=('y',))
        own = Estimate(status=Status.OK, settings=Settings(), model=model, verdict=replace(
            UNJUDGED, grade=Grade.GOOD), covariance=known(model, 0.05), start_ns=k, end_ns=k + 1)
        found.append(own)
        assert facts(own, {})['gain'].startswith('3.000 ± ')
        assert facts(own, {})['gain'].endswith(' /s')
    times = np.arange(3.0)
    (drawn,) = gain_figures(Windows(found, times, times + 1.0, np.full((3, 1), np.nan)))
    (panel,) = drawn.drawing.panels
    assert panel.title == 'gain per second'
    assert panel.curves[0].y.tolist() == [RATE] * 3


def held_in_wind(seed: int) -> Record:
    """A speed from what drives it, dy/dt = 3 u + wind, held by a controller of gain 2."""
    rng, h, n = np.random.default_rng(seed), 0.01, 3000
    points, y, now = rng.choice([-0.5, 0.5], 30), np.empty(n), 0.0
    u = np.empty(n)
    for k in range(n):
        y[k] = now + 0.005 * rng.standard_normal()
        u[k] = 2.0 * (points[k // 100] - y[k])
        now += h * RATE * u[k] + 0.3 * np.sqrt(h) * rng.standard_normal()
    t = h * np.arange(n)
    return Record.from_arrays(t + 1e-4, u, t, y, input_hold='zoh')


def test_an_integrator_that_predictions_find_is_told_by_its_rate():
    """It "grows by itself" was said of it, and no gain."""
    for seed in (1, 5):
        found = identify(held_in_wind(seed), Settings(feedthrough=False))
        model, covariance = found.model or found.rejected_model, found.covariance
        assert any(c.value == 'predictions' for c in found.choices)
        own = gains(model, covariance)
        assert own.rate.all()
        assert abs(own.value[0, 0] - RATE) < 3.0 * own.std[0, 0] < 0.5
        said = ' '.join(to_text([choice_section(found, brief=True),
                                 gain_section(model, covariance)]).split())
        assert 'its plant integrates' in said
        assert 'grows' not in said
        assert f'{own.value[0, 0]:.3f} ± ' in said
        assert '/s' in said
