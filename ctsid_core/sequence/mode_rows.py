# SPDX-License-Identifier: Apache-2.0
"""The same mode in the same row: poles of one model matched with those of the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from ctsid_core.linear.types import ComplexArray

NEAR = 0.5  # poles of neighbouring windows are the same if not further apart than this, over size


def paired(old: ArrayLike, new: ArrayLike, floor: float = 0.0) -> dict[int, int]:
    """
    Pair poles that may be the same one in two models: index of the old one to that of the new.

    In the order of the old ones. Poles smaller than `floor`, the resolution of the data [rad/s],
    count as that large when their distance is judged. None is further off than NEAR times the
    larger of the two. Of all such pairings the one with the least sum of distances over size,
    where a pole without partner costs NEAR.
    """
    a, b = np.asarray(old, dtype=complex)[:, np.newaxis], np.asarray(new, dtype=complex)
    size = np.maximum(np.maximum(np.abs(a), np.abs(b)), max(floor, 1e-300))
    distance = np.abs(a - b) / size
    # What is too far costs the same however far it is, so that it does not bend the others.
    cost = np.minimum(distance, NEAR)
    rows, columns = linear_sum_assignment(cost)
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if distance[i, j] <= NEAR}


@dataclass(frozen=True, eq=False)
class Rows:
    """The modes of a model, each in its row; conjugates have two rows and two identities."""

    # of two models' rows, those with the same identity are the same mode
    identities: tuple[int, ...] = ()
    eigenvalues: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=complex))
    order: tuple[int, ...] = ()  # which of the model's `poles` stands in each row


def follow(rows: Rows, poles: ComplexArray, floor: float, first: int) -> Rows:
    """
    Return the rows of the next model.

    A mode keeps its identity and, unless rows above it vanish, its row. New modes take the rows of
    those that are gone, then further rows at the end; `first` is the first identity that is free.
    """
    same = _same(rows.eigenvalues, poles, floor)
    fresh = [k for k in range(len(poles)) if k not in same.values()]
    free = count(first)
    entries: list[tuple[int, int]] = []  # identity, index of the pole
    for row, identity in enumerate(rows.identities):
        if row in same:
            entries.append((identity, same[row]))
        elif fresh:
            entries.append((next(free), fresh.pop(0)))
    entries += [(next(free), k) for k in fresh]
    order = [k for _, k in entries]
    return Rows(tuple(identity for identity, _ in entries), poles[order], tuple(order))


def _same(old: ComplexArray, new: ComplexArray, floor: float) -> dict[int, int]:
    """
    Return which new pole continues each old one, by index.

    First pairs continue as pairs and real poles as real poles, so that conjugates stay together.
    What then remains is matched one by one: a pair that has become two real poles, or the reverse.
    """
    before, after = _modes(old), _modes(new)
    same: dict[int, int] = {}
    for width in (1, 2):
        left, right = ([m for m in modes if len(m) == width] for modes in (before, after))
        for i, j in paired(_upper(old, left), _upper(new, right), floor).items():
            same |= zip(left[i], right[j], strict=True)
    left = [[k] for m in before for k in m if k not in same]
    right = [[k] for m in after for k in m if k not in same.values()]
    rest = paired(_upper(old, left), _upper(new, right), floor)
    changed = {left[i][0]: right[j][0] for i, j in rest.items()}
    # Which half of a pair is which: earlier rows continue in earlier poles.
    for mode in before:
        _sort(changed, [row for row in mode if row in changed])
    for mode in after:
        _sort(changed, [row for row, k in changed.items() if k in mode])
    return same | changed


def _modes(values: ComplexArray) -> list[list[int]]:
    """Return the indices of each mode: one of a real pole, two of a pair (negative part first)."""
    found = [[k] for k in np.flatnonzero(values.imag == 0).tolist()]
    upper = np.flatnonzero(values.imag > 0).tolist()
    for lower in np.flatnonzero(values.imag < 0).tolist():
        partner = min(upper, key=lambda k: abs(values[k] - values[lower].conj()))
        upper.remove(partner)
        found.append([lower, partner])
    return found


def _upper(values: ComplexArray, modes: Sequence[Sequence[int]]) -> ComplexArray:
    # both halves of a pair at its upper pole: they are equally far from any real one
    chosen = values[[m[0] for m in modes]]
    return np.asarray(chosen.real + 1j * np.abs(chosen.imag))


def _sort(changed: dict[int, int], rows: Sequence[int]) -> None:
    changed |= zip(sorted(rows), sorted(changed[row] for row in rows), strict=True)
