# SPDX-License-Identifier: Apache-2.0
"""
A model in modal form, and coordinates of its poles that stay regular where two of them meet.

Two neighbouring real poles, or a pair, are the roots of s^2 + a s + b: where two real ones meet
and become a pair, a and b move on. A real pole left over moves by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate, pairwise
import math

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array, ComplexArray, Places

_APART = 1e-4         # relative distance at which two equal poles are kept
_NEAR = 4.0           # ratio of two real poles up to which they share a factor


@dataclass(frozen=True, eq=False)
class ModalModel:
    """
    y_i = sum_l Re(c_il z_l) + D_i u + y0_i,   dz_l/dt = p_l z_l + b_l u(t - delay).

    Outputs are over their size. What belongs to a real pole is real.
    """

    # (m,): real ones first, then one of each pair, that with positive imaginary part [rad/s]
    poles: ComplexArray
    b: ComplexArray   # (m, nu)
    c: ComplexArray   # (ny, m)
    x0: ComplexArray  # (records, m): modes at the start of each record
    D: Array          # (ny, nu)
    y0: Array         # (records, ny): trim
    delay: Array      # (nu,) [s]

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.poles) + int(np.count_nonzero(self.poles.imag > 0.0))

    @property
    def nonlinear(self) -> tuple[ComplexArray, Array]:
        """Poles and dead times: all else is linear, and follows from them and the samples."""
        return self.poles, self.delay


@dataclass(frozen=True)
class PoleSteps:
    """How poles move."""

    poles: ComplexArray  # (k,): real ones and one of each pair, each once
    ranks: tuple[int, ...]  # how often each is there
    # Places of the poles of each factor, the second one -1 if it is a pair or a single pole
    factors: tuple[tuple[int, int], ...]
    scale: Array         # (k,): of the step of each pole [rad/s]

    @classmethod
    def of(cls, poles: ComplexArray, slowest: float, rank: int = 1) -> PoleSteps:
        """
        Group poles; steps are relative to their size, or to the slowest that is seen.

        Equal ones move together. `rank` is the largest of a residue: real poles that are there
        less often pass each other, for their residues are different ones.
        """
        every = canonical(poles, rank).tolist()
        p = list(dict.fromkeys(every))
        ranks = tuple(every.count(x) for x in p)
        scale = [max(abs(x), slowest, 1e-300) for x in p]
        real = sorted((k for k, x in enumerate(p) if x.imag == 0.0), key=lambda k: p[k].real)
        factors, i = [(k, -1) for k, x in enumerate(p) if x.imag > 0.0], 0
        gaps = [abs(p[b].real - p[a].real) / min(scale[a], scale[b])
                if min(ranks[a], ranks[b]) == rank else np.inf for a, b in pairwise(real)]
        while i < len(real):
            joins = i < len(gaps) and gaps[i] < _NEAR and not (
                i + 1 < len(gaps) and gaps[i + 1] < gaps[i])
            factors.append((real[i], real[i + 1] if joins else -1))
            i += 2 if joins else 1
        return cls(np.array(p, dtype=complex), ranks, tuple(factors), np.array(scale))

    def _each(self) -> Iterator[tuple[int, int, int, complex | None, float]]:
        """Yield first coordinate and places of each factor, its second root if any, and scale."""
        poles, scale, at = self.poles.tolist(), self.scale.tolist(), 0
        for one, other in self.factors:
            p = poles[one]
            if other < 0:
                root = p.conjugate() if p.imag else None
                yield at, one, other, root, scale[one]
            else:
                root = poles[other]
                yield at, one, other, root, math.sqrt(scale[one] * scale[other])
            at += 1 if root is None else 2

    def single(self) -> list[tuple[int, int]]:
        """Return the coordinate and the place of each real pole that moves by itself."""
        return [(at, one) for at, one, _, root, _ in self._each() if root is None]

    def derivatives(self) -> ComplexArray:
        """Return d poles / d coordinates, (n, m), of poles as often as they are there."""
        poles = self.poles.tolist()
        found = np.zeros((len(poles) + sum(p.imag > 0.0 for p in poles), len(poles)),
                         dtype=complex)
        for at, one, other, q, size in self._each():
            if q is None:
                found[at, one] = size
                continue
            p = poles[one]
            for place, of_a, of_b in ((at, size, 0.0), (at + 1, 0.0, size * size)):
                found[place, one] = -(p * of_a + of_b) / (p - q)
                if other >= 0:
                    found[place, other] = -(q * of_a + of_b) / (q - p)
        return np.repeat(found, self.ranks, axis=1)

    def moved(self, step: Array, limit: float,
              fastest: float) -> tuple[ComplexArray, NDArray[np.intp]]:
        """
        Return the poles after a step (n,), with bounds as of `bounded`, and which each has been.

        Poles are in order of their sizes, so that one that passes another changes places with it.
        Where two real ones become a pair, or part, there are fewer or more than before.
        """
        found, poles, by = list[tuple[complex, int]](), self.poles.tolist(), step.tolist()
        for at, one, other, q, size in self._each():
            p = poles[one]
            if q is None:
                found.append((p + size * by[at], one))
                continue
            a = -(p + q).real + size * by[at]
            b = (p * q).real + size * size * by[at + 1]
            middle, turn = -0.5 * a, 0.25 * a * a - b
            if turn < 0.0:
                found.append((complex(middle, math.sqrt(-turn)), one))
            else:
                far = middle + math.copysign(math.sqrt(turn), middle)
                found += [(complex(far), one),
                          (complex(b / far if far else -far), other if other >= 0 else one)]
        bound = bounded(np.array([p for p, _ in found]), limit, fastest)
        order = [found[k][1] for k in in_order(bound)]
        ends = list(accumulate(self.ranks))
        return np.array([p for p, k in zip(canonical(bound).tolist(), order, strict=True)
                         for _ in range(self.ranks[k])], dtype=complex), np.array(
            [m for k in order for m in range(ends[k] - self.ranks[k], ends[k])], dtype=np.intp)

    def size_of(self, poles: ComplexArray) -> float:
        """Return the largest relative change of a pole's magnitude, as a logarithm."""
        least = 0.1 * min(self.scale.tolist())

        def sizes(p: ComplexArray) -> list[float]:
            return sorted(math.log(max(abs(x), least)) for x in p.tolist()
                          for _ in range(1 + (x.imag > 0.0)))
        before = sizes(np.repeat(self.poles, self.ranks))
        return max((abs(a - b) for a, b in zip(sizes(poles), before, strict=True)), default=0.0)


def bounded(poles: ComplexArray, limit: float, fastest: float) -> ComplexArray:
    """Return poles of at most so large a magnitude, and then of so large a real part [rad/s]."""
    found = []
    for p in poles.tolist():
        less = min(1.0, fastest / max(abs(p), 1e-300))
        found.append(complex(min(p.real * less, limit), p.imag * less))
    return np.array(found, dtype=complex)


def canonical(poles: ComplexArray, rank: int = 1) -> ComplexArray:
    """Return real poles and one of each pair; more equal ones than `rank` are kept apart."""
    found = sorted((p for p in np.asarray(poles, dtype=complex).tolist() if p.imag >= 0.0),
                   key=_place)
    for i, p in enumerate(found):
        if 0.0 < p.imag < _APART * abs(p):
            found[i] = complex(p.real, _APART * abs(p))
        for other in found[:i]:
            if found[i] == other and found[:i].count(other) < rank:
                continue
            # A pair stays one, beside whatever real pole.
            if abs(found[i] - other) < _APART * abs(found[i]) and (p.imag > 0.0) == (
                    other.imag > 0.0):
                found[i] = other - _APART * max(abs(other), 1e-300)
    return np.array(found, dtype=complex)


def in_order(poles: ComplexArray) -> list[int]:
    """Return the places of poles in the order of `canonical`."""
    values = poles.tolist()
    return sorted(range(len(values)), key=lambda k: _place(values[k]))


def _place(pole: complex) -> tuple[bool, float, float]:
    """Return what poles are sorted by."""
    return pole.imag > 0.0, abs(pole), pole.real


def ranks_of(poles: ComplexArray) -> tuple[Places, Places]:
    """Return which pole each mode has, equal ones counted once, and which of its ranks it is."""
    values = poles.tolist()
    once = list(dict.fromkeys(values))
    return (np.array([once.index(p) for p in values], dtype=np.intp),
            np.array([values[:k].count(p) for k, p in enumerate(values)], dtype=np.intp))
