# SPDX-License-Identifier: Apache-2.0
"""
Tests for a change of the plant within a record, or between records.

Within: the test of `change_score.py` on each record alone. Between: the same score test, each
record on one side and all others on the other. Records have nothing in common but the plant, so
that their sides need no instants: lines will do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.projection import Projection, of_records
from ctsid_core.bases.records import Layout
from ctsid_core.judge.change_score import (
    GROWS,
    Change,
    Side,
    compared,
    most_likely_change,
    orthonormal,
    response_to_inputs,
    weighed,
)
from ctsid_core.likelihood.refine import affordable, growth, whitener
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array
from ctsid_core.settings import Settings


@dataclass(frozen=True)
class ChangedRecord:
    """
    The record with the strongest evidence for a change of the plant.

    Parameters
    ----------
    place : int
        Of the record.
    within : bool
        Whether the plant changed within it, or differs from that of the others.
    change : Change
        Its p-value is that of all records together (Bonferroni).
    """

    place: int = 0
    within: bool = True
    change: Change = Change()


def most_likely_changed_record(projection: Projection, m: Matrices, settings: Settings,
                               layout: Layout) -> ChangedRecord:
    """
    Return the strongest evidence for a change of the plant, within or between records.

    Parameters
    ----------
    projection : Projection
        That the model was made from.
    m : Matrices
        At the maximum of the likelihood, or near it.
    settings : Settings
        As used; `feedthrough` matters here.
    layout : Layout
        Of the projection.
    """
    count, sizes = len(layout.sizes), layout.sizes
    if count == 1:
        return ChangedRecord(0, True, most_likely_change(projection, m, settings))
    within = [ChangedRecord(i, True, most_likely_change(record, own, settings.replace(nmax=nmax)))
              for i, (record, own, (nmax, _)) in enumerate(zip(
                  projection.records, of_records(m, projection), sizes, strict=True))]
    between = [ChangedRecord(i, False, change) for i, change in enumerate(
        _differences(projection, m, settings, layout))]
    # A record of another plant is a change of all: that it is, and which, goes first.
    both = [[replace(f, change=replace(f.change, p_value=min(count * f.change.p_value, 1.0)))
             for f in found] for found in (between, within)]
    for found in both:
        mattering = [f for f in found if f.change.matters]
        if mattering:
            return max(mattering, key=lambda f: (f.change.gain, f.change.size))
    return min(both[0] + both[1], key=lambda f: (f.change.p_value, -f.change.size))


def _differences(projection: Projection, m: Matrices, settings: Settings,
                 layout: Layout) -> list[Change]:
    """
    Return, for each record, how much its plant differs from that of the others.

    Errors that another plant has made larger must not make a record count less: records are
    compared as if noise was the same in all, and the level that it really has is found on the way.
    """
    stable = np.max(np.linalg.eigvals(m.A - m.K @ m.C).real) < 0.0 and \
        growth(m) * projection.length < GROWS
    if not (stable and affordable(projection, len(m.A))):
        return []
    each = list(zip(projection.records, of_records(m, projection), layout.sizes, strict=True))
    level = np.array([_level(record, own) for record, own, _ in each]) / layout.weights
    level /= np.exp(np.mean(np.log(level)))
    rows = [_without_nuisances(record, own, settings, nmax, factor)
            for (record, own, (nmax, _)), factor in zip(each, level, strict=True)]
    size = np.sqrt(sum(np.sum(moving ** 2, axis=0) for moving, _, _ in rows))
    size[size == 0.0] = np.inf
    turn = orthonormal(np.vstack([np.linalg.qr(moving / size, mode='r')
                                  for moving, _, _ in rows]))[1]
    sides = [_side(moving / size @ turn, error, free) for moving, error, free in rows]
    response = float(np.linalg.norm([factor * response_to_inputs(record, own, nmax)
                                     for (record, own, (nmax, _)), factor
                                     in zip(each, level, strict=True)]))
    total = sum(len(error) for _, error, _ in rows)
    return [compared(len(rows[i][1]) / total, side, _all(sides[:i] + sides[i + 1:]), response,
                     alone=True)
            for i, side in enumerate(sides)]


def _level(record: Projection, m: Matrices) -> float:
    """Return the amplitude of the errors of a record: the geometric mean over the outputs."""
    whiten = whitener(record, m)[0]
    return float(np.exp(-np.mean(np.log(np.abs(np.diag(whiten))))))     # triangular


def _without_nuisances(record: Projection, m: Matrices, settings: Settings, nmax: int,
                       factor: float) -> tuple[Array, Array, int]:
    """Return derivatives by the plant and errors, nuisances projected out, and their number."""
    flat, error, plant = weighed(record, m, settings, nmax)
    norm = np.linalg.norm(flat, axis=0)
    other = ~plant & (norm > 0.0)
    nuisances = orthonormal(flat[:, other] / norm[other])[0]
    moving, error = factor * flat[:, plant], factor * error
    return (moving - nuisances @ (nuisances.T @ moving),
            error - nuisances @ (nuisances.T @ error), nuisances.shape[1])


def _side(directions: Array, error: Array, free: int) -> Side:
    return Side(directions.T @ directions, directions.T @ error, float(error @ error),
                len(error) - free)


def _all(sides: list[Side]) -> Side:
    return Side(sum((s.information for s in sides[1:]), sides[0].information),
                sum((s.pull for s in sides[1:]), sides[0].pull),
                sum(s.power for s in sides), sum(s.spare for s in sides))
