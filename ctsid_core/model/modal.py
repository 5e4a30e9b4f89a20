# SPDX-License-Identifier: Apache-2.0
"""
Responses of modes to sampled inputs at any stamps, and their derivatives by the pole, exactly.

Between the stamps of an input (later by its dead time) it is a polynomial, so that a mode
dz/dt = p z + u goes from stamp to stamp, and on to any time in between, a distance h later, by

    z+ = phi_0(p h) z + sum_j h^(j+1) phi_(j+1)(p h) u^(j)                                   (1)

and its derivative by p, with phi_j' = phi_j - j phi_(j+1), by

    s+ = phi_0(p h) (s + h z) + sum_j h^(j+2) phi_(j+1)'(p h) u^(j).                         (2)

The functions phi are those of `linear/matrix_functions.py`. In an input's own time a dead time
only shifts where its responses begin and where they are read: the steps between its stamps are
the same for all dead times, and are taken once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctsid_core.linear.matrix_functions import chain, phi
from ctsid_core.linear.types import Array, ComplexArray, Places
from ctsid_core.model.simulation import input_polynomials, shifted
from ctsid_core.signals.record import Signal

_CACHED = 2 ** 14      # steps of modes taken at a time: what is between stays in the cache


@dataclass(frozen=True, eq=False)
class Drive:
    """An input signal as polynomials from stamp to stamp."""

    stamps: Array  # (K,) [s]
    pieces: Array  # (degree + 1, w, K + 1): derivatives before the first stamp, and after each one

    @classmethod
    def of(cls, signal: Signal) -> Drive:
        """Return a signal's polynomials."""
        after = input_polynomials((signal,), (0.0,) * signal.width, signal.time)
        before = np.concatenate((after[:1, :1], np.zeros_like(after[1:, :1])))
        return cls(signal.time, np.concatenate((before, after), axis=1).swapaxes(1, 2).copy())

    @property
    def width(self) -> int:
        """Number of channels."""
        return int(self.pieces.shape[1])

    @cached_property
    def paces(self) -> tuple[Array, Array]:
        """
        Times halfway from stamp to stamp, (K - 1,) [s], and rates of a held input, (w, K).

        Of one that goes from value to value at an even pace, from halfway before a stamp on.
        """
        between = 0.5 * (self.stamps[1:] + self.stamps[:-1])
        if not len(between):
            return between, np.zeros((self.width, len(self.stamps)))
        edges = np.concatenate((self.stamps[:1], between, self.stamps[-1:]))
        return between, np.diff(self.pieces[0], axis=1) / np.diff(edges)


class Steps:
    """The steps in which modes go from the start to where they are read, made by `steps_of`."""

    def __init__(self, parts: list[_Part]) -> None:
        self._parts = parts
        # (nu, N): the inputs after their dead time, at a jump the new value; their derivatives,
        # see `Drive.paces`; (nu,): the inputs at the start
        self.inputs = np.concatenate([p.inputs for p in parts])
        self.rates = np.concatenate([p.rates for p in parts])
        self.first = np.concatenate([p.first for p in parts])

    def responses(self, poles: Array | ComplexArray, *,
                  slopes: bool = True) -> tuple[ComplexArray, ComplexArray]:
        """
        Return responses of modes at rest at the start, and their derivatives by the pole.

        Of poles (m,) [rad/s]: (m, nu, N), real if all poles are; derivatives are empty unless
        wanted.
        """
        found = []
        for part in self._parts:
            few = max(_CACHED // max(part.force[0].size, 1), 1)
            found.append(_joined([_read(poles[i:i + few], part, slopes)
                                  for i in range(0, max(len(poles), 1), few)], 0))
        return _joined(found, 1)


class _Part(NamedTuple):
    """The steps of one input signal: S from stamp to stamp, and N to where responses are read."""

    # (L,): from the start to the first stamp, for each of its D dead times; between stamps; from
    # stamps to where each dead time reads [s]
    lengths: Array
    which: Places | None  # (w, S + N): of the lengths, that of each step; None: one after another
    steps: int            # S
    late: int             # D
    slot: Places          # (w, N): after how many steps each reading step begins
    force: Array          # (degree + 1, w, S + N): h^(j+1) u^(j) of each step
    inputs: Array         # (w, N)
    rates: Array
    first: Array          # (w,)


def steps_of(inputs: Sequence[Signal] | Sequence[Drive], delay: Array | Sequence[float],
             start: float, times: Array) -> Steps:
    """
    Return the steps of inputs of nu channels, later by their delays [s].

    They are read at times (N,) in any order, none before the start [s].
    """
    parts, place = [], 0
    for one in inputs:
        drive = one if isinstance(one, Drive) else Drive.of(one)
        own = np.asarray(delay[place:place + drive.width], dtype=float)
        parts.append(_part(drive, own, start, times))
        place += drive.width
    return Steps(parts)


def _part(drive: Drive, delay: Array, start: float, times: Array) -> _Part:
    late, of = np.unique(delay, return_inverse=True) if len(delay) > 1 else (delay, np.zeros(
        1, dtype=np.intp))
    begin, wanted = start - late, times - late[:, np.newaxis]                    # (D,), (D, N)
    first = np.searchsorted(drive.stamps, begin, side='right')
    place = np.searchsorted(drive.stamps, wanted, side='right')
    low = int(np.min(first))
    high = int(np.max(place, initial=low))
    S, D = high - low, len(late)
    stamps = drive.stamps[low:high]
    before = np.concatenate(([-np.inf], stamps))[place - low]
    begins = np.minimum(first - low, S)                 # the step of each that leaves the start
    lead = np.append(stamps, np.inf)[begins] - begin
    lead = np.where(begins < S, lead, 0.0)[:D if S else 0]
    to = wanted - np.maximum(before, begin[:, np.newaxis])
    lengths = np.concatenate((lead, np.diff(stamps), to.ravel()))
    h, which = lengths[np.newaxis], None
    if D > 1:
        which = np.empty((D, S + len(times)), dtype=np.intp)
        which[:, :S] = D - 1 + np.arange(S)
        own = np.flatnonzero(begins < S)
        which[own, begins[own]] = own
        which[:, S:] = len(lengths) - to.size + np.arange(to.size).reshape(D, -1)
        which = which[of]
        h = lengths[which]
    v = drive.pieces[:, :, low:high + 1].copy()
    for c, d in enumerate(of):
        if first[d] and len(v) > 1:
            v[:, c, begins[d]] = shifted(v[:, c, begins[d]], begin[d] - drive.stamps[first[d] - 1])
        v[:, c, :begins[d]] = 0.0
    slot = (place - low)[of]
    now = np.take_along_axis(v, slot[np.newaxis], axis=2)
    force = np.concatenate((v[:, :, :S], now), axis=2)
    far = to[of]
    if len(v) > 1:
        u, rate = shifted(now, far)[:2]
    else:
        between, rates = drive.paces
        u, rate = now[0], np.take_along_axis(rates, np.searchsorted(between, wanted)[of], axis=1)
    for j in range(len(v)):
        force[j] *= h ** (j + 1)
    return _Part(lengths, which, S, D, slot, force, u, rate, v[0, np.arange(len(of)), begins[of]])


def _joined(found: list[tuple[ComplexArray, ComplexArray]],
            axis: int) -> tuple[ComplexArray, ComplexArray]:
    """Return responses and slopes of several modes, or inputs, as one."""
    if len(found) == 1:
        return found[0]
    z, dz = zip(*found, strict=True)
    return np.concatenate(z, axis=axis), np.concatenate(dz, axis=axis)


def _read(poles: Array | ComplexArray, part: _Part,
          slopes: bool) -> tuple[ComplexArray, ComplexArray]:
    """Return the responses to one signal, and their derivatives by the pole, (m, w, N)."""
    S, force = part.steps, part.force
    f = phi(part.lengths * poles[:, np.newaxis], len(force) + slopes)
    factor = f[0][:, part.late - 1:part.late - 1 + S]
    if part.which is None:
        f, h = [one[:, np.newaxis] for one in f], part.lengths
    else:
        f, h = [one[:, part.which] for one in f], part.lengths[part.which]
    push = f[1] * force[0]
    for j in range(1, len(force)):
        push += f[j + 1] * force[j]
    z = chain(factor, push[:, :, :S])
    read = _at(z, part.slot)
    out: ComplexArray = f[0][:, :, S:] * read
    out += push[:, :, S:]
    if not slopes:
        return out, out[:, :0]
    turn = (f[1] - f[2]) * (h * force[0])
    for j in range(1, len(force)):
        turn += (f[j + 1] - (j + 1) * f[j + 2]) * (h * force[j])
    lag = h * f[0]
    s = chain(factor, lag[:, :, :S] * z[:, :, :-1] + turn[:, :, :S])
    bent: ComplexArray = f[0][:, :, S:] * _at(s, part.slot)
    read *= lag[:, :, S:]
    bent += read
    bent += turn[:, :, S:]
    return out, bent


def _at(z: ComplexArray, slot: Places) -> ComplexArray:
    found: ComplexArray = np.take(z, slot[0], axis=2) if len(slot) == 1 else \
        np.take_along_axis(z, slot[np.newaxis], axis=2)
    return found
