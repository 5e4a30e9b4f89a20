# SPDX-License-Identifier: Apache-2.0
"""Sums over uniform stamps term by term; tables in blocks."""

from __future__ import annotations

import numpy as np
import pytest

from ctsid_core.bases.blocks import Blocks
from ctsid_core.bases.chirp_sums import chirp_sums, uniform
from ctsid_core.bases.hermite_functions import hermite_functions


@pytest.mark.parametrize('n', [256, 257, 3000])
@pytest.mark.parametrize('count', [1, 2, 150])
@pytest.mark.parametrize('start', [-20.0, 3.7])
def test_sums_are_those_of_the_terms(n, count, start):
    x = start + np.linspace(0.0, 40.0, n)
    weights, step = np.random.default_rng(n).standard_normal((3, n)), 30.0 / count
    phase = np.outer(x.astype(np.longdouble), step * np.arange(count))
    wanted = weights @ np.cos(phase) - 1j * (weights @ np.sin(phase))
    found = chirp_sums(x, weights, step, count)
    limit = 1e-13 * np.abs(weights).sum(axis=1)[:, np.newaxis]
    assert (np.abs(found - wanted) < limit).all()


def test_what_is_uniform():
    x = np.linspace(-20.0, 20.0, 4000)
    assert uniform(x, 50.0)
    assert uniform((0.1 + np.arange(4000) / 200.0) / 0.7, 50.0)
    for place in (0, 17, 2000, 3999):
        moved = x.copy()
        moved[place] += 1e-9
        assert not uniform(moved, 50.0)
    assert not uniform(np.zeros(4000), 50.0)
    assert not uniform(x[::-1], 50.0)
    assert not uniform(x[:255], 50.0)
    assert not uniform(np.where(x == x[5], np.nan, x), 50.0)


@pytest.mark.parametrize('vectors', [0, 1, 4, 5, 20])
def test_products_of_blocks_are_those_of_the_matrix(vectors):
    rng = np.random.default_rng(5)
    matrix = hermite_functions(300, np.linspace(-3.0, 31.0, 400))
    blocks, x = Blocks.of(matrix), rng.standard_normal((vectors, 2 * 400))[:, ::2]
    np.testing.assert_allclose(blocks.times(x), x @ matrix.T, rtol=0, atol=1e-13)
    np.testing.assert_allclose(blocks.times(np.eye(400)).T, matrix, rtol=0, atol=1e-18)
    assert sum(entries.size for _, _, entries in blocks.blocks) < 0.9 * matrix.size
    nothing = Blocks.of(np.zeros((5, 7)))
    np.testing.assert_array_equal(nothing.times(np.ones((2, 7))), np.zeros((2, 5)))
