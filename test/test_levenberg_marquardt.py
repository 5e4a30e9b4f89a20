# SPDX-License-Identifier: Apache-2.0
"""A likelihood with a banana-shaped valley (Rosenbrock's), its parameters in the matrix C."""

from dataclasses import replace

import numpy as np
import pytest

from ctsid_core.likelihood.levenberg_marquardt import LEAST_DAMPING, climb, normal_equations
from ctsid_core.likelihood.prediction_errors import Likelihood
from ctsid_core.linear.matrices import Matrices


def at(x: float, y: float, pole: float = -1.0) -> Matrices:
    none = np.empty((1, 0))
    return Matrices(A=np.array([[pole]]), B=none, C=np.array([[x], [y]]), D=np.empty((2, 0)),
                    K=np.zeros((1, 2)), tail=none, x_trim=none, y_trim=np.empty((2, 0)))


def residual(m: Matrices) -> np.ndarray:
    x, y = m.C[:, 0]
    return np.array([100.0 * (y - x * x), 10.0 * (1.0 - x)])


def likelihood(m: Matrices) -> Likelihood:
    return Likelihood(float(np.sum(residual(m) ** 2)), m, m.A[0].astype(complex))


def curvature(m: Matrices, _prediction):
    """Beside x and y, a direction that moves the pole, and one that does nothing."""
    x = float(m.C[0, 0])
    rows = -np.array([[-200.0 * x, -10.0], [100.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    return normal_equations(rows, residual(m))


def move(m: Matrices, step: np.ndarray) -> Matrices:
    return replace(m, C=m.C + step[:2, np.newaxis], A=m.A - abs(step[0]))


def run(start=None, **options):
    options = {'limit': np.inf, 'steps': 60, 'damping': LEAST_DAMPING} | options
    return climb(start or at(-1.2, 1.0), likelihood, curvature, move, **options)


@pytest.mark.parametrize('damping', [LEAST_DAMPING, 1e-5, 1.0])
def test_the_valley_is_followed_to_its_end(damping):
    model, cost = run(damping=damping)
    assert cost < 1e-2
    np.testing.assert_allclose(model.C[:, 0], [1.0, 1.0], atol=0.03)


def test_no_step_makes_it_worse():
    costs = [run(steps=k)[1] for k in range(12)]
    assert costs[0] == likelihood(at(-1.2, 1.0)).cost
    assert (np.diff(costs) <= 0.0).all()


def test_a_direction_that_does_nothing_does_not_move():
    found = curvature(at(-1.2, 1.0), None)
    assert found.norm[2] == np.inf
    assert found.gram[2].tolist() == [0.0] * 4


def test_poles_stay_within_their_limit():
    def drift(m, step):
        return replace(m, C=m.C + step[:2, np.newaxis], A=m.A + np.abs(step).max())

    model, _ = climb(at(-1.2, 1.0), likelihood, curvature, drift, limit=-0.5, steps=60,
                     damping=LEAST_DAMPING)
    assert model.A[0, 0] <= -0.5


def test_what_cannot_beat_its_rival_is_given_up():
    steps = []

    def counted(m, prediction):
        steps.append(m)
        return curvature(m, prediction)

    for rival in (np.inf, 0.5):
        steps.clear()
        climb(at(1.05, 1.1), lambda m: replace(likelihood(m), cost=likelihood(m).cost + 1.0),
              counted, move, limit=np.inf, steps=60, damping=LEAST_DAMPING, rival=rival)
        assert (len(steps) == 1) == (rival == 0.5)


def test_a_start_that_is_not_admissible_is_returned():
    start = at(0.0, 0.0)
    model, cost = climb(start, lambda m: Likelihood(np.inf, None, m.A[0].astype(complex)),
                        curvature, move, limit=np.inf, steps=5, damping=1e-5)
    assert model is start
    assert cost == np.inf
