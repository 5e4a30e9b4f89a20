# SPDX-License-Identifier: Apache-2.0
"""
Coordinates of poles that stay regular where two of them meet.

Two neighbouring real poles, or a pair, are the roots of s^2 + a s + b: where two real ones meet
and become a pair, a and b move on. A real pole left over moves by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray

_APART = 1e-4         # relative distance at which two equal poles are kept
_NEAR = 4.0           # ratio of two real poles up to which they share a factor


@dataclass(frozen=True)
class PoleSteps:
    """
    How poles move.

    Parameters
    ----------
    poles : ndarray, shape (m,)
        Real ones and one of each pair; those of a factor are neighbours [rad/s].
    factors : tuple of (int, int)
        Places of the poles of each factor, the second one -1 if it is a pair or a single pole.
    scale : ndarray, shape (m,)
        Of the step of each pole [rad/s].
    """

    poles: ComplexArray
    factors: tuple[tuple[int, int], ...]
    scale: Array

    @classmethod
    def of(cls, poles: ComplexArray, slowest: float, several: bool = False) -> PoleSteps:
        """
        Group poles; steps are relative to their size, or to the slowest that is seen.

        With several inputs and several outputs equal poles are of different residues, and pass
        each other.
        """
        poles = canonical(poles)
        scale = np.maximum(np.abs(poles), slowest)
        real = [int(i) for i in np.flatnonzero(poles.imag == 0.0)]
        real.sort(key=lambda i: poles[i].real)
        factors, i = [(int(k), -1) for k in np.flatnonzero(poles.imag > 0.0)], 0
        gaps = [abs(poles[b].real - poles[a].real) / min(scale[a], scale[b])
                for a, b in zip(real[:-1], real[1:], strict=True)]
        while i < len(real):
            joins = not several and i < len(gaps) and gaps[i] < _NEAR and not (
                i + 1 < len(gaps) and gaps[i + 1] < gaps[i])
            factors.append((real[i], real[i + 1] if joins else -1))
            i += 2 if joins else 1
        return cls(poles, tuple(factors), scale)

    def single(self) -> list[tuple[int, int]]:
        """Return the coordinate and the place of each real pole that moves by itself."""
        found, at = [], 0
        for one, other in self.factors:
            if alone := other < 0 and self.poles[one].imag == 0.0:
                found.append((at, one))
            at += 1 if alone else 2
        return found

    def derivatives(self) -> ComplexArray:
        """Return d poles / d coordinates, (n, m)."""
        rows = []
        for one, other in self.factors:
            p = self.poles[one]
            if p.imag == 0.0 and other < 0:
                row = np.zeros(len(self.poles), dtype=complex)
                row[one] = self.scale[one]
                rows.append(row)
                continue
            q = p.conjugate() if other < 0 else self.poles[other]
            size = self.scale[one] if other < 0 else np.sqrt(self.scale[one] * self.scale[other])
            for of_a, of_b in ((size, 0.0), (0.0, size * size)):
                row = np.zeros(len(self.poles), dtype=complex)
                row[one] = -(p * of_a + of_b) / (p - q)
                if other >= 0:
                    row[other] = -(q * of_a + of_b) / (q - p)
                rows.append(row)
        return np.array(rows).reshape(-1, len(self.poles))

    def moved(self, step: Array, limit: float, fastest: float) -> ComplexArray:
        """
        Return the poles after a step, within bounds.

        Parameters
        ----------
        step : ndarray, shape (n,)
        limit : float
            Largest real part [rad/s].
        fastest : float
            Largest magnitude [rad/s].
        """
        found, place = [], 0
        for one, other in self.factors:
            p = self.poles[one]
            if p.imag == 0.0 and other < 0:
                found.append(p + self.scale[one] * step[place])
                place += 1
                continue
            q = p.conjugate() if other < 0 else self.poles[other]
            size = self.scale[one] if other < 0 else np.sqrt(self.scale[one] * self.scale[other])
            a = -(p + q).real + size * step[place]
            b = (p * q).real + size * size * step[place + 1]
            place += 2
            middle, turn = -0.5 * a, 0.25 * a * a - b
            if turn < 0.0:
                found.append(complex(middle, np.sqrt(-turn)))
            else:
                far = middle + np.copysign(np.sqrt(turn), middle)
                found += [complex(far), complex(b / far if far else -far)]
        poles = np.array(found)
        return canonical(bounded(poles, limit, fastest))

    def size_of(self, poles: ComplexArray) -> float:
        """Return the largest relative change of a pole's magnitude, as a logarithm."""
        def sizes(p: ComplexArray) -> Array:
            every = np.concatenate((p, p[p.imag > 0.0]))
            return np.sort(np.log(np.maximum(np.abs(every), np.min(self.scale) * 0.1)))
        return float(np.max(np.abs(sizes(poles) - sizes(self.poles)), initial=0.0))


def bounded(poles: ComplexArray, limit: float, fastest: float) -> ComplexArray:
    """Return poles of at most so large a magnitude, and then of so large a real part [rad/s]."""
    less = np.fmin(1.0, fastest / np.maximum(np.abs(poles), 1e-300))
    found: ComplexArray = np.minimum(poles.real * less, limit) + 1j * (poles.imag * less)
    return found


def canonical(poles: ComplexArray) -> ComplexArray:
    """Return real poles and one of each pair, kept apart where they are equal."""
    poles = np.asarray(poles, dtype=complex)
    poles = poles[poles.imag >= 0.0]
    order = np.lexsort((poles.real, np.abs(poles), poles.imag > 0.0))
    poles = poles[order].copy()
    for i in range(len(poles)):
        p = poles[i]
        if 0.0 < p.imag < _APART * abs(p):
            poles[i] = complex(p.real, _APART * abs(p))
        for k in range(i):
            # A pair stays one, beside whatever real pole.
            if abs(poles[i] - poles[k]) < _APART * abs(poles[i]) and (p.imag > 0.0) == (
                    poles[k].imag > 0.0):
                poles[i] = poles[k] - _APART * max(abs(poles[k]), 1e-300)
    return poles
