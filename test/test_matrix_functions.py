# SPDX-License-Identifier: Apache-2.0
"""Functions of matrices, how they move, and a decomposition that does not give up."""

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from ctsid_core.linear.least_squares import svd
from ctsid_core.linear.matrix_functions import change_of

DATA = Path(__file__).parent / 'data'


def test_svd_of_a_sound_matrix_on_which_divide_and_conquer_fails():
    # Met in an identification of a flexible structure: finite, condition 1e9, and yet LAPACK's
    # gesdd of several OpenBLAS builds does not converge.
    matrix = np.load(DATA / 'divide_and_conquer_gives_up.npz')['matrix']
    left, s, right = svd(matrix)
    np.testing.assert_allclose((left * s) @ right, matrix, atol=1e-12 * s[0])
    np.testing.assert_allclose(left.T @ left, np.eye(len(s)), atol=1e-12)
    np.testing.assert_allclose(right @ right.T, np.eye(len(s)), atol=1e-12)
    assert (np.diff(s) <= 0.0).all()


def test_svd_agrees_with_numpy_where_that_works():
    matrix = np.random.default_rng(0).standard_normal((7, 4))
    for ours, theirs in zip(svd(matrix), np.linalg.svd(matrix, full_matrices=False), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_function_moves_as_its_derivative_says():
    """Beside differences of the function itself, of poles apart, in pairs, and that meet."""
    rng = np.random.default_rng(0)
    for A in (rng.standard_normal((5, 5)), np.diag([-1.0, -1.0 - 1e-9, -3.0]),
              np.diag([-1.0, -1.0, 0.0])):
        changes = rng.standard_normal((3, *A.shape))
        found = change_of(A, changes, np.exp, np.exp)
        little = 1e-5
        for own, change in zip(found, changes, strict=True):
            sides = [scipy.linalg.expm(A + h * change) for h in (little, -little)]
            assert own == pytest.approx((sides[0] - sides[1]) / (2.0 * little), abs=1e-8)
