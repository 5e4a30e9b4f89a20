# SPDX-License-Identifier: Apache-2.0
"""Triangles and bases of tall matrices, against NumPy's and what they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from ctsid_core.linear.least_squares import basis_of, triangle

SIZES = [(1, 1), (10, 3), (3, 10), (5000, 1), (2000, 40), (1025, 64), (30000, 12), (4097, 100)]


def alike(found, wanted) -> float:
    """Return how far triangles are apart but for the signs of their rows, over their size."""
    return float(np.abs(np.abs(found) - np.abs(wanted)).max() / np.abs(wanted).max())


@pytest.mark.parametrize(('m', 'n'), SIZES)
@pytest.mark.parametrize('order', ['C', 'F'])
def test_it_is_that_of_numpy(m, n, order):
    columns = np.asarray(np.random.default_rng(0).standard_normal((m, n)), order=order)
    before = columns.copy()
    found = triangle(columns)
    assert found.shape == (min(m, n), n)
    assert np.array_equal(found, np.triu(found))
    assert alike(found, np.linalg.qr(columns, mode='r')) < 1e-14
    np.testing.assert_array_equal(columns, before)


@pytest.mark.parametrize('condition', [1e4, 1e8, 1e12, 1e16, np.inf])
def test_it_is_as_exact_as_that_of_numpy_whatever_the_condition(condition):
    """Backward error: singular values are right to rounding of the largest, not of their own."""
    rng, n = np.random.default_rng(1), 30
    left, right = (np.linalg.qr(rng.standard_normal((m, n)))[0] for m in (20000, n))
    size = np.geomspace(1.0, 1.0 / min(condition, 1e16), n)
    size[-5:] *= np.isfinite(condition)
    columns = (left * size) @ right.T
    found = np.linalg.svd(triangle(columns), compute_uv=False)
    assert np.abs(found - size).max() < 1e-14
    scaled = columns * np.geomspace(1e-8, 1e8, n)             # columns of any size: each its own
    norm = np.linalg.norm(scaled, axis=0)
    np.testing.assert_allclose(np.linalg.norm(triangle(scaled), axis=0), norm, rtol=1e-13)


def test_zeros_and_what_is_not_a_number():
    np.testing.assert_array_equal(triangle(np.zeros((20000, 8))), 0.0)
    columns = np.random.default_rng(3).standard_normal((20000, 8))
    columns[12345, 3] = np.nan
    assert np.isnan(triangle(columns)).any()


def test_equal_bits_for_equal_columns():
    columns = np.random.default_rng(4).standard_normal((20000, 20))
    np.testing.assert_array_equal(triangle(columns), triangle(columns.copy()))
    np.testing.assert_array_equal(triangle(np.asfortranarray(columns)), triangle(columns))


def test_no_rows_have_an_empty_triangle():
    assert triangle(np.zeros((0, 3))).shape == (0, 3)


def test_a_basis_spans_what_columns_tell_beside_those_before():
    """Copies, sums, what is before and nothing are left out, whatever the units."""
    rng = np.random.default_rng(2)
    columns = rng.standard_normal((2000, 6)) * 10.0 ** rng.uniform(-6, 6, 6)
    before = basis_of(columns[:, :2])
    more = np.column_stack((columns, columns[:, 2:4] @ [1.0, 2.0], np.zeros(2000)))
    found = np.hstack((before, basis_of(more, before)))
    assert found.shape == (2000, 6)
    assert np.abs(found.T @ found - np.eye(6)).max() < 1e-12
    left = columns - found @ (found.T @ columns)
    assert np.all(np.linalg.norm(left, axis=0) < 1e-12 * np.linalg.norm(columns, axis=0))
    assert basis_of(more[:, -1:]).shape == (2000, 0)
    assert basis_of(more[:, :0], before).shape == (2000, 0)
