# SPDX-License-Identifier: Apache-2.0
"""Poles matched with poles, and their rows."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from ctsid_core.model.realisation import pole_order
from ctsid_core.sequence.alignment import NEAR, Rows, follow, paired


def in_order(*poles: complex) -> np.ndarray:
    """Poles as models give them, with the other half of each pair."""
    values = np.array([p for pole in poles for p in sorted(
        {complex(pole), complex(pole).conjugate()}, key=lambda p: p.imag)])
    return values[pole_order(values)]


def followed(*models: np.ndarray, floor: float = 0.0) -> list[Rows]:
    found, first = [Rows()], 1
    for poles in models:
        found.append(follow(found[-1], poles, floor, first))
        first = max((first, *(1 + i for i in found[-1].identities)))
    return found[1:]


def test_pairs_are_the_best_of_all():
    rng = np.random.default_rng(1)
    for _ in range(20):
        old = -rng.uniform(1, 10, 4) + 1j * rng.uniform(0, 10, 4)
        new = old[rng.permutation(4)] * rng.uniform(0.6, 1.6, 4)

        def cost(order, old=old, new=new):
            away = np.abs(old - new[list(order)])
            return np.minimum(away / np.maximum(abs(old), abs(new[list(order)])), NEAR).sum()
        best = min(map(cost, permutations(range(4))))
        pairs = paired(old, new)
        lost = NEAR * (4 - len(pairs))
        assert sum(abs(old[i] - new[j]) / max(abs(old[i]), abs(new[j]))
                   for i, j in pairs.items()) + lost == pytest.approx(best)


def test_what_is_far_is_another_mode():
    assert paired([-1, -10], [-10.5, -2.1]) == {1: 0}
    assert paired([-1, -10], [-10.5, -1.9]) == {0: 1, 1: 0}
    assert paired([-1.5, -3.6], [1.5, -3.6]) == {1: 1}  # though the least sum is another
    assert paired([], [-1]) == paired([-1], []) == {}


def test_poles_below_the_resolution_are_alike():
    assert paired([0.01], [-0.02]) == {}
    assert paired([0.01], [-0.02], floor=0.1) == {0: 0}


def test_rows_stay_while_poles_overtake_each_other():
    first, second, third = followed(in_order(-1, -2 + 3j, -5), in_order(-1.1, -3 + 4j, -4.6),
                                    in_order(-1.2, -3.5 + 4.5j, -4.2))
    assert first.identities == second.identities == third.identities == (1, 2, 3, 4)
    np.testing.assert_allclose(second.eigenvalues, [-1.1, -3 - 4j, -3 + 4j, -4.6])
    np.testing.assert_allclose(third.eigenvalues, [-1.2, -3.5 - 4.5j, -3.5 + 4.5j, -4.2])
    assert third.order == (0, 2, 3, 1)  # -4.2 is the slower one by now


def test_a_pair_that_meets_on_the_real_axis_keeps_its_rows():
    path = [in_order(-9, *np.roots([1, 2 * z, 1])) for z in (0.8, 0.95, 1.05, 1.2, 1.02, 0.9)]
    found = followed(*[np.unique(p)[pole_order(np.unique(p))] for p in path])
    assert {rows.identities for rows in found} == {(1, 2, 3)}
    for rows in found:  # slower real one, or negative imaginary part, first
        assert rows.eigenvalues[2] == pytest.approx(-9)
        assert rows.eigenvalues[0].imag <= 0 <= rows.eigenvalues[1].imag
        assert abs(rows.eigenvalues[0]) <= abs(rows.eigenvalues[1]) + 1e-12


def test_the_slower_of_two_real_poles_takes_the_first_row_of_their_pair():
    first, second = followed(in_order(-1.1 + 0.01j), np.array([-0.8 + 0j, -1.15 + 0j]))
    assert second.identities == first.identities
    np.testing.assert_array_equal(second.eigenvalues, [-0.8, -1.15])


def test_pairs_continue_as_pairs_though_others_are_nearer():
    first, second = followed(in_order(-1 + 0.1j, -1.4), in_order(-1.25 + 0.05j, -1.0))
    np.testing.assert_array_equal(first.eigenvalues, [-1 - 0.1j, -1 + 0.1j, -1.4])
    assert second.identities == (1, 2, 3)
    np.testing.assert_array_equal(second.eigenvalues, [-1.25 - 0.05j, -1.25 + 0.05j, -1.0])


def test_conjugates_stay_together():
    rng = np.random.default_rng(3)
    for _ in range(50):
        models = [in_order(*(-rng.uniform(2, 3, 3) + 1j * rng.uniform(2, 3, 3)), -2.5)
                  for _ in range(3)]
        for rows in followed(*models):
            halves = {}
            for identity, pole in zip(rows.identities, rows.eigenvalues, strict=True):
                halves.setdefault((pole.real, abs(pole.imag)), set()).add(identity)
            assert sorted(map(len, halves.values())) == [1, 2, 2, 2]
        before, after = followed(*models[:2])
        pairs = [{frozenset(i for i, p in zip(rows.identities, rows.eigenvalues, strict=True)
                            if abs(p.imag) == abs(q.imag) and p.real == q.real)
                  for q in rows.eigenvalues} for rows in (before, after)]
        kept = {p for p in pairs[1] if max(p) <= 7}
        assert kept <= pairs[0]


def test_equal_pairs_are_told_apart_by_their_rows():
    twins = in_order(-1 + 2j, -1 + 2j)
    twins = np.array([-1 - 2j, -1 - 2j, -1 + 2j, -1 + 2j])
    first, second = followed(twins, twins)
    assert first.identities == second.identities
    np.testing.assert_array_equal(first.eigenvalues, second.eigenvalues)


def test_new_modes_take_free_rows_and_new_identities():
    found = followed(in_order(-1, -5), in_order(-1, -30), in_order(-1, -5, -30), in_order(-30),
                     in_order(-1, -30))
    assert [rows.identities for rows in found] == [(1, 2), (1, 3), (1, 3, 4), (3,), (3, 5)]
    np.testing.assert_allclose(found[2].eigenvalues, [-1, -30, -5])
    np.testing.assert_allclose(found[4].eigenvalues, [-30, -1])
    found = followed(in_order(-1, -5, -30), in_order(-0.2, -5, -30))
    assert found[1].identities == (4, 2, 3)
    np.testing.assert_allclose(found[1].eigenvalues, [-0.2, -5, -30])
