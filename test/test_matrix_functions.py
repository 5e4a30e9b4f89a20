# SPDX-License-Identifier: Apache-2.0
"""The singular value decomposition that does not give up."""

from pathlib import Path

import numpy as np

from ctsid_core.linear.least_squares import svd

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
