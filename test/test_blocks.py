# SPDX-License-Identifier: Apache-2.0
"""Products with tables in blocks."""

from __future__ import annotations

import numpy as np
import pytest

from ctsid_core.bases.hermite_functions import Blocks, hermite_functions


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
