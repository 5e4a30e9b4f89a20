# SPDX-License-Identifier: Apache-2.0
"""The one list of a model's free entries."""

from __future__ import annotations

import numpy as np
import pytest

from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.matrices import Matrices

NAMES = ('A', 'B', 'tail', 'x_trim', 'C', 'D', 'y_trim', 'K')


def model(n=3, nu=2, ny=2, tails=2, ones=1) -> Matrices:
    rng = np.random.default_rng(0)
    return Matrices(*(rng.standard_normal(shape) for shape in (
        (n, n), (n, nu), (ny, n), (ny, nu), (n, ny), (n, tails), (n, ones), (ny, ones))))


@pytest.mark.parametrize('noise', [False, True])
@pytest.mark.parametrize('feedthrough', [False, True])
def test_every_entry_has_one_place_and_moves_there(feedthrough, noise):
    m = model()
    entries = FreeEntries.of(m, feedthrough, noise=noise)
    step = np.arange(1.0, entries.count + 1.0)
    moved = entries.moved(m, step)
    fixed = [*(['D'] if not feedthrough else []), *(['K'] if not noise else [])]
    seen = []
    for name in NAMES:
        change = getattr(moved, name) - getattr(m, name)
        if name in fixed:
            assert not change.any()
            continue
        np.testing.assert_allclose(change, entries.part(step, name), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(step[entries.mask(name)], entries.part(step, name).ravel())
        seen += entries.part(step, name).ravel().tolist()
    assert sorted(seen) == step.tolist()


def test_rows_are_split_like_one():
    entries = FreeEntries.of(model(), True, noise=True)
    rows = np.random.default_rng(1).standard_normal((4, entries.count))
    for k, row in enumerate(rows):
        for name in NAMES:
            np.testing.assert_array_equal(entries.part(rows, name)[k], entries.part(row, name))


def test_places_of_a_record_are_the_entries_it_moves():
    """Records of one plant share all but the states at their ends and their trim."""
    entries = FreeEntries.of(model(tails=3, ones=2), True, noise=True)
    places = entries.places([1, 2], [1])
    own = FreeEntries(3, 2, 2, 2, 1, True, True)
    index = np.arange(entries.count)
    assert len(places) == own.count == len(set(places.tolist()))
    np.testing.assert_array_equal(own.part(places, 'tail'), entries.part(index, 'tail')[:, 1:])
    np.testing.assert_array_equal(own.part(places, 'y_trim'), entries.part(index, 'y_trim')[:, 1:])
    for name in ('A', 'B', 'C', 'D', 'K'):
        np.testing.assert_array_equal(own.part(places, name), entries.part(index, name))
