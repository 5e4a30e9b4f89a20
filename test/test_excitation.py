# SPDX-License-Identifier: Apache-2.0
"""Where responses are looked at: a mean over a width, modes that grow into the past."""

from __future__ import annotations

import numpy as np
import pytest

from ctsid_core.judge.excitation import _further

rng = np.random.default_rng(0)
TURNED = rng.standard_normal((4, 4))


@pytest.mark.parametrize(('poles', 'moved'), [
    ([-1.0, -3.0], [-1.5, -3.5]), ([-1.0, 2.0], [-1.5, 2.5]), ([0.3, -1.0], [-0.5, -1.8]),
    ([0.3, 2.0, -1.0], [-0.5, 2.5, -1.8])])
def test_modes_go_away_from_the_axis(poles, moved):
    """Those that grow by e within one over the width to the right, all others to the left."""
    T = TURNED[:len(poles), :len(poles)]
    A = T @ np.diag(poles) @ np.linalg.inv(T)
    found = _further(A, 0.5)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(found)), np.sort(moved), rtol=1e-9)
    np.testing.assert_allclose(found @ A, A @ found, atol=1e-9)     # its modes are the same


def test_two_integrators_beside_what_grows_stay_joined():
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(
        _further(A, 0.1), [[-0.1, 1.0, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, 1.1]], atol=1e-12)


@pytest.mark.parametrize('poles', [[-1.0, -3.0, -0.5, -2.0], [-1.0, 2.0, -0.1, 3.0]])
def test_changes_of_a_plant_change_it_as_differences_say(poles):
    A = TURNED @ np.diag(poles) @ np.linalg.inv(TURNED)
    changes, step = rng.standard_normal((3, 4, 4)), 1e-6
    wanted = [(_further(A + step * one, 0.5) - _further(A - step * one, 0.5)) / (2.0 * step)
              for one in changes]
    np.testing.assert_allclose(_further(A, 0.5, changes), wanted, rtol=1e-5, atol=1e-6)
