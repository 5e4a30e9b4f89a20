# SPDX-License-Identifier: Apache-2.0
"""
Which mode would explain most of what a model leaves: a grid of poles, ranked.

For ranking alone: the responses of all poles of the grid are computed once, on a uniform grid of
time by averages of the inputs over its cells, and read at the outputs' stamps less a dead time by
straight lines, so that a grid of dead times costs little.

References
----------
Pati, Rezaiifar and Krishnaprasad 1993, Asilomar 27 (orthogonal matching pursuit).
"""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.mode_columns import columns_of, cost_of, least_cost
from ctsid_core.likelihood.pole_steps import canonical
from ctsid_core.likelihood.samples import RecordSamples, Samples, Stream
from ctsid_core.linear.matrix_functions import chain
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.signals.record import Signal

_REAL = 12            # real poles on the grid
_PAIRS = 12           # natural frequencies of pairs at each damping
_DAMPING = (0.02, 0.1, 0.4, 0.8)
_CELLS = 4000         # of time, at most
_RIDGE = 1e-9         # of the inner products of a candidate's columns
_PER_CELL = 150.0     # work: of each pole, input and cell of time
_LOOK, _PER_POLE = 1e6, 80.0            # work: of any look, and for each pole, input and sample


class PoleGrid:
    """
    A grid of poles up to the fastest [rad/s] for samples: few, thinned ones will do.

    Dead times are at most `longest` [s], and inputs are looked at with the interval `finest` [s].
    """

    def __init__(self, samples: Samples, *, feedthrough: bool, trim: bool, longest: float,
                 fastest: float, finest: float) -> None:
        self.samples, self._feedthrough, self._trim = samples, feedthrough, trim
        slow = 1.0 / samples.length
        sizes = np.geomspace(2.0 * np.pi * slow, fastest, _PAIRS)
        pairs = [sizes * complex(-z, np.sqrt(1.0 - z * z)) for z in _DAMPING]
        self.poles: ComplexArray = np.concatenate(
            (-np.geomspace(slow, fastest, _REAL) + 0j, *pairs))
        self._ranked: dict[tuple[bytes, bytes], list[tuple[float, complex]]] = {}
        self._cells = [_Cells(r, longest, finest) for r in samples.records]
        self._kinds = (self.poles.imag == 0.0, self.poles.imag > 0.0)
        samples.effort.spend(_PER_CELL * len(self.poles) * samples.nu * float(
            sum(cells.count for cells in self._cells)))
        self._shapes = [[_Shape(cells, self.poles[kind]) for kind in self._kinds]
                        for cells in self._cells]

    def ranked(self, poles: ComplexArray, delay: Array) -> list[tuple[float, complex]]:
        """
        Return every pole of the grid beside given ones, at given dead times, best first.

        Before it -2 log likelihood of what it would leave, everything linear at its best. Given
        are the poles (m,) [rad/s] of the model that is to be extended, and delay (nu,) [s].
        """
        key = (poles.tobytes(), delay.tobytes())
        if key not in self._ranked:
            score = self._scores(poles, delay)
            self._ranked[key] = [(float(score[i]), complex(self.poles[i]))
                                 for i in np.argsort(score, kind='stable')]
        return self._ranked[key]

    def score(self, poles: ComplexArray, delay: Array) -> float:
        """Return -2 log likelihood with these poles and no more."""
        columns = columns_of(self.samples, canonical(poles), delay, direct=self._feedthrough,
                             slopes=False)
        return least_cost(columns, self._trim)

    def _scores(self, poles: ComplexArray, delay: Array) -> Array:
        self.samples.effort.spend(_LOOK + _PER_POLE * len(self.poles) * (
            self.samples.nu + 1) * float(np.max(self.samples.counts.sum(axis=0))))
        squares = np.zeros((len(self.poles), self.samples.ny))
        columns = columns_of(self.samples, poles, delay, direct=self._feedthrough, turned=False,
                             slopes=False)
        for cells, shapes, own in zip(self._cells, self._shapes, columns.tables, strict=True):
            for stream, (known, y) in zip(cells.record.streams, own, strict=True):
                known = known if self._trim else known[:, :-1]
                size = np.linalg.norm(known, axis=0)
                basis = np.linalg.qr(known / np.where(size > 0.0, size, 1.0))[0]
                left = y - basis @ (basis.T @ y)
                squares[:, stream.channels] += np.sum(left ** 2, axis=0) - self._explained(
                    cells, shapes, stream, delay, basis, left)
        return cost_of(squares, self.samples.counts.sum(axis=0))

    def _explained(self, cells: _Cells, shapes: list[_Shape], stream: Stream, delay: Array,
                   basis: Array, left: Array) -> Array:
        found = np.zeros((len(self.poles), left.shape[1]))
        for kind, shape in zip(self._kinds, shapes, strict=True):
            own = cells.candidates(shape, stream, delay)                           # (G, q, N)
            flat = own.reshape(-1, len(basis))              # one product is quicker than many
            flat -= (flat @ basis) @ basis.T
            gram = own @ own.swapaxes(1, 2)
            scale = np.sqrt(np.einsum('gii->gi', gram)) + 1e-150
            gram = gram / (scale[:, :, np.newaxis] * scale[:, np.newaxis]) \
                + _RIDGE * np.eye(gram.shape[1])
            pull = (flat @ left).reshape(*own.shape[:2], -1) / scale[:, :, np.newaxis]
            found[kind] = np.sum(pull * np.linalg.solve(gram, pull), axis=1)
        return found


class _Cells:
    """The inputs of a record, averaged over the cells of a uniform grid of time."""

    def __init__(self, record: RecordSamples, longest: float, finest: float) -> None:
        self.record = record
        first = record.start - longest
        count = int(np.clip((record.end - first) / finest, 16, _CELLS))
        self.count = count
        self._edges = np.linspace(first, record.end, count + 1)
        self._step = float(self._edges[1] - self._edges[0])
        self._means = np.vstack([_cell_means(s, self._edges) for s in record.inputs])

    def responses(self, poles: Array | ComplexArray) -> ComplexArray:
        """Return the responses of poles at the edges, (m, nu, cells + 1); real if they are."""
        turn = poles * self._step
        small = np.abs(turn) < 1e-8
        gain = self._step * np.where(small, 1.0, np.expm1(turn) / np.where(small, 1.0, turn))
        return chain(np.exp(turn)[:, np.newaxis], gain[:, np.newaxis, np.newaxis] * self._means)

    def candidates(self, shape: _Shape, stream: Stream, delay: Array) -> Array:
        """Return the columns of each pole: responses to the inputs and free, (m, q, N)."""
        times = stream.times
        found = np.empty((*shape.size, len(delay) + 1, len(times)))
        for d in np.unique(delay):
            at = np.clip((times - d - self._edges[0]) / self._step, 0.0,
                         len(self._edges) - 1.001)
            place = at.astype(int)
            part = (at - place)[:, np.newaxis]
            for j in np.flatnonzero(delay == d):
                read = shape.driven[j][place]
                read += part * (shape.driven[j][place + 1] - read)
                found[:, :, j] = read.T.reshape(*shape.size, -1)
        found[:, :, -1] = shape.free(stream, self.record.start)
        return found.reshape(len(found), -1, len(times))


class _Shape:
    """The responses of poles of one kind, all real or all of pairs, to the inputs over cells."""

    def __init__(self, cells: _Cells, poles: ComplexArray) -> None:
        self._poles = poles if len(poles) and poles[0].imag > 0.0 else poles.real
        self._free: dict[int, Array] = {}
        driven = _parts(cells.responses(self._poles))
        self.size = driven.shape[:2]
        # (nu, cells + 1, m parts): all at one instant are neighbours, for they are read together.
        self.driven = driven.transpose(2, 3, 0, 1).reshape(*driven.shape[2:], -1).copy()

    def free(self, stream: Stream, start: float) -> Array:
        """Return the free responses, (m, parts, N); kept, for dead times do not matter."""
        if stream.channels.start not in self._free:
            self._free[stream.channels.start] = _parts(
                np.exp(self._poles[:, np.newaxis] * (stream.times - start)))
        return self._free[stream.channels.start]


def _parts(responses: ComplexArray) -> Array:
    """Return real and, of pairs, imaginary parts."""
    if responses.dtype == float:
        return responses[:, np.newaxis].real
    return np.stack((responses.real, responses.imag), axis=1)


def _cell_means(signal: Signal, edges: Array) -> Array:
    """Return the mean of each channel over each cell, (w, cells): held before and after."""
    t, x = signal.time, signal.values
    steps = np.diff(t)[:, np.newaxis]
    areas = steps * (x[:-1] if signal.hold == 'zoh' else 0.5 * (x[1:] + x[:-1]))
    total = np.concatenate((np.zeros((1, signal.width)), np.cumsum(areas, axis=0)))
    t = np.concatenate(([t[0] - 1.0], t, [t[-1] + 1.0]))
    total = np.concatenate((total[:1] - x[:1], total, total[-1:] + x[-1:]))
    found = []
    for j in range(signal.width):
        area = np.interp(edges, t, total[:, j])
        area += np.minimum(edges - t[0], 0.0) * x[0, j] + np.maximum(edges - t[-1], 0.0) * x[-1, j]
        found.append(np.diff(area) / np.diff(edges))
    return np.array(found)
