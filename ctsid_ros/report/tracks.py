# SPDX-License-Identifier: Apache-2.0
"""Poles for people: pairs as one, beside their like in another model, along many windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.sequence.alignment import paired
from ctsid_core.settings import slowest_sought

_SLOW = 10.0  # times the slowest that is looked for: slower ones are shown as integrators


@dataclass(frozen=True)
class Mode:
    """
    A real pole, or a conjugate pair given by its upper one.

    Parameters
    ----------
    pole : complex
        [rad/s]
    std : float
        Standard deviation of |estimate - truth| [rad/s]; NaN if not known.
    frequency_std : float
        Of the natural frequency [rad/s]; NaN if not known.
    damping_std : float
        Of the damping ratio; NaN if not known.
    """

    pole: complex
    std: float = math.nan
    frequency_std: float = math.nan
    damping_std: float = math.nan

    @property
    def frequency(self) -> float:
        """Natural frequency [rad/s]."""
        return abs(self.pole)

    @property
    def damping(self) -> float:
        """Damping ratio; NaN for a pole at 0."""
        return -self.pole.real / abs(self.pole) if self.pole else math.nan


def modes(model: StateSpace | None, std: Array | None = None) -> list[Mode]:
    """Return the modes of a model, slowest first."""
    if model is None:
        return []
    known = std if std is not None and len(std) == model.n else np.full(model.n, math.nan)
    return [Mode(complex(pole), float(s)) for pole, s in zip(model.poles, known, strict=True)
            if pole.imag >= 0]


def told(pole: complex, estimate: Estimate) -> complex:
    """Return a pole of an estimate as people are told of it: at its bound beside 0 it is at 0."""
    spans = [r.end_ns - r.start_ns for r in estimate.records] or [
        estimate.end_ns - estimate.start_ns]
    length = max(spans) * 1e-9
    least = _SLOW * slowest_sought(length) if length > 0.0 else 0.0
    return complex(*(0.0 if abs(part) <= least else part for part in (pole.real, pole.imag)))


def modes_of(estimate: Estimate) -> list[Mode]:
    """Return the modes of an estimate's model, accepted or not."""
    found = [replace(m, pole=told(m.pole, estimate)) for m in modes(
        estimate.model or estimate.rejected_model, estimate.pole_std)]
    if estimate.covariance is None:
        return found
    model = estimate.model or estimate.rejected_model
    upper = [] if model is None else np.flatnonzero(model.poles.imag >= 0).tolist()
    radial, damping = estimate.natural_frequency_std, estimate.damping_std
    return [replace(m, frequency_std=float(radial[k]), damping_std=float(damping[k]))
            for m, k in zip(found, upper, strict=True)]


def match(left: Sequence[complex], right: Sequence[complex]) -> dict[int, int]:
    """
    Pair poles with poles, each at most once, the most alike first.

    Returns
    -------
    dict
        Index on the left to index on the right.
    """
    distances = sorted((abs(a - b) / max(math.sqrt(abs(a) * abs(b)), 1e-300), i, j)
                       for i, a in enumerate(left) for j, b in enumerate(right))
    pairs: dict[int, int] = {}
    for _, i, j in distances:
        if i not in pairs and j not in pairs.values():
            pairs[i] = j
    return dict(sorted(pairs.items()))


@dataclass(frozen=True)
class Track:
    """
    One mode along the windows.

    Parameters
    ----------
    windows : tuple of int
        Where it was found.
    modes : tuple of Mode
        What was found there.
    """

    windows: tuple[int, ...]
    modes: tuple[Mode, ...]


def tracks(estimates: Sequence[Estimate]) -> list[Track]:
    """Join the modes of accepted models along the windows; the longest track first."""
    open_tracks: list[Track] = []
    done: list[Track] = []
    for number, estimate in enumerate(estimates):
        found = modes_of(estimate) if estimate.ok else []
        pairs = paired([t.modes[-1].pole for t in open_tracks], [m.pole for m in found])
        following: list[Track] = []
        for i, track in enumerate(open_tracks):
            if i in pairs:
                following.append(Track((*track.windows, number), (*track.modes, found[pairs[i]])))
            elif found:  # lost, for this window has a model without it
                done.append(track)
            else:
                following.append(track)
        continued = {id(t.modes[-1]) for t in following}
        following += [Track((number,), (m,)) for m in found if id(m) not in continued]
        open_tracks = following
    return sorted([*done, *open_tracks], key=lambda t: -len(t.windows))
