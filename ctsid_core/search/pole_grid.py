# SPDX-License-Identifier: Apache-2.0
"""
What would explain most of what a model leaves: poles of a grid, resonances, and dead times.

For ranking alone: the responses of all poles of the grid are computed once, on a uniform grid of
time by averages of the inputs over its cells, and read at the outputs' stamps less a dead time by
straight lines. Resonances and dead times are narrower than what a grid is apart, and the
correlation of errors with inputs points at them.

References
----------
Pati, Rezaiifar and Krishnaprasad 1993, Asilomar 27 (orthogonal matching pursuit).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from ctsid_core.effort import Effort
from ctsid_core.likelihood.modal_model import canonical
from ctsid_core.likelihood.mode_columns import columns_of, cost_of, least_cost
from ctsid_core.likelihood.samples import RecordSamples, Residuals, Samples, Stream
from ctsid_core.linear.matrix_functions import chain
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.signals.record import Signal

_REAL = 12            # real poles on the grid
_PAIRS = 12           # natural frequencies of pairs at each damping
_DAMPING = (0.1, 0.4, 0.8)
_RANKED = 300         # samples of a stream that the grid is ranked on
_CELLS, _FEWEST = 4000, 16              # of time, at most and at least
_RATES = 6            # decay rates of resonances, damped no more than pairs of the grid
_LINES = 64000        # cells of time for correlations, at most
_SHARE = 0.05         # of a budget, that either grid of cells takes at most
_RIDGE = 1e-9         # of the inner products of candidates' columns: less is rounding
_PER_CELL = 150.0     # work: of each pole, input and cell of time
_PER_LINE = 60.0      # work: of each line, decay rate or part of a pole, input and output
_LOOK, _PER_COLUMN = 5e5, 40.0          # work: of any look, and for each column and sample


class PoleGrid:
    """
    A grid of poles up to the fastest [rad/s] for samples, ranked on few of them.

    Dead times are at most `longest` [s], and inputs are looked at with the interval `finest` [s].
    """

    def __init__(self, samples: Samples, *, feedthrough: bool, trim: bool, longest: float,
                 fastest: float, finest: float) -> None:
        self._feedthrough, self._trim = feedthrough, trim
        self.correlations = Correlations(samples, longest, fastest, finest)
        self.samples = samples = samples.thinned(_RANKED)
        slow = 1.0 / samples.length
        sizes = np.geomspace(2.0 * np.pi * slow, fastest, _PAIRS)
        pairs = [sizes * complex(-z, np.sqrt(1.0 - z * z)) for z in _DAMPING]
        self.poles: ComplexArray = np.concatenate(
            (-np.geomspace(slow, fastest, _REAL) + 0j, *pairs))
        self._beside: dict[tuple[bytes, bytes], list[list[tuple[Array, Array]]]] = {}
        cells = _cells_of(samples, longest, finest, _CELLS, _PER_CELL * len(self.poles))
        self._shapes = {real: [_Shape(c, self.poles[(self.poles.imag == 0.0) == real],
                                      samples.effort) for c in cells] for real in (True, False)}

    def best(self, poles: ComplexArray, delay: Array, real: bool) -> tuple[float, complex]:
        """
        Return the pole of the grid, a real one or one of a pair, that explains most.

        Beside given ones, the poles (m,) [rad/s] of the model that is to be extended, at given
        dead times (nu,) [s]. Before it -2 log likelihood of what it would leave, everything
        linear at its best.
        """
        score = self._scores(poles, delay, real)
        place = int(np.argmin(score))
        return float(score[place]), complex(self._shapes[real][0].poles[place])

    @cached_property
    def dead_times(self) -> dict[bool, Array]:
        """Dead times (nu,) [s] with which one pole explains most: a real one, or a pair's."""
        # Every other one of the grid: dead times ask less of a pole than a start does.
        poles, outputs = self.poles[::2], self.correlations.outputs
        explained = [self.correlations.explained(j, poles, outputs)[1:]
                     for j in range(self.samples.nu)]
        return {real: np.array([self.correlations.dead_time(one[(poles.imag == 0.0) == real])
                                for one in explained]) for real in (True, False)}

    def score(self, poles: ComplexArray, delay: Array) -> float:
        """Return -2 log likelihood with these poles and no more."""
        columns = columns_of(self.samples, canonical(poles), delay, direct=self._feedthrough,
                             slopes=False)
        return least_cost(columns, self._trim)

    def _scores(self, poles: ComplexArray, delay: Array, real: bool) -> Array:
        shapes, samples = self._shapes[real], self.samples
        count, parts = shapes[0].size
        samples.effort.spend(_LOOK + _PER_COLUMN * count * parts * (samples.nu + 1) * float(
            np.max(samples.counts.sum(axis=0))))
        squares = np.zeros((count, samples.ny))
        for shape, record, own in zip(shapes, samples.records, self._known(poles, delay),
                                      strict=True):
            for stream, (basis, left) in zip(record.streams, own, strict=True):
                squares[:, stream.channels] += np.sum(left ** 2, axis=0) - _explained(
                    shape.candidates(stream, delay), basis, left)
        return cost_of(squares, samples.counts.sum(axis=0))

    def _known(self, poles: ComplexArray, delay: Array) -> list[list[tuple[Array, Array]]]:
        """Return an orthonormal basis of what is known of each stream, and what that leaves."""
        key = poles.tobytes(), delay.tobytes() if len(poles) or self._feedthrough else b''
        if key not in self._beside:
            columns = columns_of(self.samples, poles, delay, direct=self._feedthrough,
                                 turned=False, slopes=False)
            self._beside[key] = [[self._basis(*table) for table in own] for own in columns.tables]
        return self._beside[key]

    def _basis(self, known: Array, y: Array) -> tuple[Array, Array]:
        known = known if self._trim else known[:, :-1]
        size = np.linalg.norm(known, axis=0)
        basis = np.linalg.qr(known / np.where(size > 0.0, size, 1.0))[0]
        return basis, y - basis @ (basis.T @ y)


def _explained(own: Array, basis: Array, left: Array) -> Array:
    """Return the squares that columns, (m, q, N), explain of errors beside a basis."""
    count, width, rows = own.shape
    flat = own.reshape(count * width, rows)         # one product is quicker than many
    flat -= (flat @ basis) @ basis.T
    gram = own @ own.swapaxes(1, 2)
    scale = np.sqrt(np.einsum('gii->gi', gram)) + 1e-150
    gram = gram / (scale[:, :, np.newaxis] * scale[:, np.newaxis]) + _RIDGE * np.eye(gram.shape[1])
    pull = (flat @ left).reshape(count, width, left.shape[1]) / scale[:, :, np.newaxis]
    return np.asarray(np.sum(pull * np.linalg.solve(gram, pull), axis=1))


class Correlations:
    """
    What the correlation of errors with inputs tells of the poles and dead times that are missing.

    The inner product of errors e with the response z of a pole p to an input u, d later, is

        sum_t e(t) z(t - d) = sum_lag exp(p lag) c(d + lag),    c(lag) = sum_t e(t) u(t - lag):

    for one decay rate and all frequencies of poles a Fourier transform of a correlation that
    decays; for one pole and all dead times a correlation of c with the pole's decay. The same sum
    S of an input with itself, r(lag), is the power of z, and the sum of its squares:

        P = sum |z|^2 = (2 Re S - r(0)) / (1 - exp(2 Re p h)),
        Q = sum z^2 = (2 S - r(0)) / (1 - exp(2 p h)),        h the distance of lags.

    With g = sum e z a pair that is hardly damped explains about 2 |g|^2 / P. Sums of products of
    the responses of two poles a and b are the same with S_a + S_b and a + b in place of 2 S and
    2 p, and of one with the other's conjugate with that of S_b and b. With them G, of real and
    imaginary parts, and their g all poles together explain g' G^-1 g.
    """

    def __init__(self, samples: Samples, longest: float, fastest: float, finest: float) -> None:
        self._samples = samples
        self._cells = _cells_of(samples, longest, finest, _LINES,
                                _PER_LINE * (_REAL + _PAIRS * len(_DAMPING)) * samples.ny)
        self.step, lags = self._cells[0].step, max(c.count for c in self._cells)
        self._size = next_fast_len(2 * lags, real=True)
        self._lines = 2.0 * np.pi / self.step * np.fft.rfftfreq(self._size)
        self._omega = self._lines[self._lines <= fastest]
        self._rates = np.geomspace(1.0 / samples.length, _DAMPING[0] * fastest, _RATES)
        self._lags = self.step * np.arange(lags)
        self._dead_times = int(np.sum(self._lags <= longest))
        self._decays = np.exp(-self._rates[:, np.newaxis] * self._lags)
        self._inputs = [np.fft.rfft(c.means - c.means.mean(axis=1, keepdims=True), self._size)
                        for c in self._cells]
        own = self._own = self._lagged(np.sum([np.abs(u) ** 2 for u in self._inputs], axis=0))
        power = 2.0 * self._at(self._decays[:, np.newaxis] * own).real - own[:, :1]
        power /= -np.expm1(-2.0 * self._rates * self.step)[:, np.newaxis, np.newaxis]
        self._power = np.maximum(power, _RIDGE * power.max(axis=-1, keepdims=True)) + 1e-300

    @property
    def outputs(self) -> Residuals:
        """What no model leaves: the outputs about their means."""
        return tuple(tuple(s.y - s.y.mean(axis=0) for s in r.streams)
                     for r in self._samples.records)

    def resonance(self, errors: Residuals, delay: Array) -> complex:
        """
        Return the pole [rad/s], one of a pair, that errors at the samples correlate with most.

        Beside given dead times (nu,) [s], which hardly matter, and as if inputs were independent.
        One that decays with the rate r [rad/s] is seen no further than about r from its frequency;
        a few rates do, for the response of one that decays twice as fast correlates by 94 %.
        """
        self._samples.effort.spend(
            _PER_LINE * self._size * self._samples.ny * self._samples.nu * _RATES)
        late, found = np.exp(1j * self._lines * delay[:, np.newaxis]), []
        lagged, squares = self._correlated(errors, [u.conj() * late for u in self._inputs])
        for rate, decay, power in zip(self._rates, self._decays, self._power, strict=True):
            shares = np.sum(np.abs(self._at(decay * lagged)) ** 2 / power, axis=1)
            gain = np.sum(shares / squares, axis=0)
            gain[self._omega * _DAMPING[0] < rate] = 0.0
            k = int(np.argmax(gain))
            found.append((float(gain[k]), complex(-rate, max(self._omega[k], rate))))
        return max(found, key=lambda one: one[0])[1]

    def dead_time(self, explained: Array) -> float:
        """Return the dead time [s] at which one of some models, (m, dead times), explains most."""
        return float(self._lags[np.argmax(np.max(explained, axis=0))])

    def explained(self, j: int, poles: ComplexArray, errors: Residuals) -> Array:
        """
        Return what stable poles, one of each pair, and the input j explain of errors.

        All together, and each by itself: (1 + m, dead times). Squares over those of each output,
        summed, as if there were a sample in every cell, and inputs were independent. Trim, free
        responses and the end of the record are left out.
        """
        lagged, squares = self._correlated(errors, [u[j:j + 1].conj() for u in self._inputs])
        pairs = poles.imag > 0.0
        pole = np.concatenate((np.arange(len(poles)), np.flatnonzero(pairs)))    # of each part
        self._samples.effort.spend(
            _PER_LINE * (self._size + len(self._lags) * len(pole)) * (len(lagged) + 1))
        # Sums over lags from each on, of c and r: from the last one to the first
        rows, pulls, sums = np.vstack((lagged[:, 0], self._own[j]))[:, ::-1], [], []
        for factor in np.exp(self.step * (poles if np.any(pairs) else poles.real)):
            late = chain(factor.reshape(1, 1), rows[np.newaxis])[0, :, :0:-1]
            pulls.append(late[:-1, :self._dead_times].copy())
            sums.append(late[-1, 0])
        kept = np.concatenate((np.ones_like(pairs), pairs))     # real, imaginary parts
        gram = self._gram(poles, np.array(sums), self._own[j, 0])[np.ix_(kept, kept)]
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        gram = gram / np.outer(size, size) + _RIDGE * np.eye(len(size))
        parts = np.concatenate((np.real(pulls), np.imag(pulls)[pairs])).swapaxes(0, 1)
        parts = parts / size[:, np.newaxis]
        every, each = (
            np.sum(parts * np.linalg.solve(one, parts) / squares[:, np.newaxis], axis=0)
            for one in (gram, gram * (pole[:, np.newaxis] == pole)))
        of_pole = np.arange(len(poles))[:, np.newaxis] == pole
        return np.vstack((every.sum(axis=0), of_pole @ each))

    def _gram(self, poles: ComplexArray, sums: Array | ComplexArray, power: float) -> Array:
        """Return the inner products of the real and the imaginary parts of responses, (2m, 2m)."""
        p, q = ((sums[:, np.newaxis] + s - power) / -np.expm1(
            self.step * (poles[:, np.newaxis] + other))
            for s, other in ((sums.conj(), poles.conj()), (sums, poles)))
        return 0.5 * np.block([[(p + q).real, (q - p).imag], [(q - p).imag.T, (p - q).real]])

    def _correlated(self, errors: Residuals,
                    spectra: Sequence[ComplexArray]) -> tuple[Array, Array]:
        """Return c of each output, (ny, inputs, lags), and squares of errors, (ny, 1)."""
        # Given are the conjugate spectra of inputs of each record, (inputs, lines).
        both = np.zeros((self._samples.ny, *spectra[0].shape), dtype=complex)
        squares = np.zeros((self._samples.ny, 1))
        for cells, u, own in zip(self._cells, spectra, errors, strict=True):
            for stream, e in zip(cells.record.streams, own, strict=True):
                place = cells.places(stream.times)[0]
                for i, x in zip(range(self._samples.ny)[stream.channels], e.T, strict=True):
                    both[i] += np.fft.rfft(np.bincount(place, x, self._size)) * u
                squares[stream.channels, 0] += np.sum(e ** 2, axis=0)
        return self._lagged(both), np.maximum(squares, 1e-300)

    def _lagged(self, spectra: Array | ComplexArray) -> Array:
        """Return correlations at lags of 0, 1, .. cells."""
        return np.asarray(np.fft.irfft(spectra, self._size)[..., :len(self._lags)], float)

    def _at(self, lagged: Array) -> ComplexArray:
        """Return the transforms of sequences at the frequencies that are looked at."""
        return np.fft.rfft(lagged, self._size)[..., :len(self._omega)]


def _cells_of(samples: Samples, longest: float, finest: float, most: int,
              work: float) -> list[_Cells]:
    """Return the cells of all records, of one size; `work` is what each takes, and each input."""
    length, effort = samples.length + longest, samples.effort
    if effort.budget:
        most = min(most, max(_FEWEST, int(_SHARE * effort.worth(effort.budget) / (
            work * samples.nu))))
    step = float(length / np.clip(length // finest, _FEWEST, most))
    return [_Cells(r, longest, step) for r in samples.records]


class _Cells:
    """The inputs of a record, averaged over the cells of a uniform grid of time."""

    def __init__(self, record: RecordSamples, longest: float, step: float) -> None:
        self.record, self.step = record, step
        first = record.start - longest
        self.count = max(int(np.ceil((record.end - first) / step)), 1)
        self._edges = np.asarray(first + step * np.arange(self.count + 1), float)
        self.means = np.vstack([_cell_means(s, self._edges) for s in record.inputs])

    def responses(self, poles: Array | ComplexArray) -> ComplexArray:
        """Return the responses of poles at the edges, (m, nu, cells + 1); real if they are."""
        turn = poles * self.step
        small = np.abs(turn) < 1e-8
        gain = self.step * np.where(small, 1.0, np.expm1(turn) / np.where(small, 1.0, turn))
        return chain(np.exp(turn)[:, np.newaxis], gain[:, np.newaxis, np.newaxis] * self.means)

    def places(self, times: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the edges before times (N,), and how far it is to the next ones, (N, 1)."""
        at = np.minimum(np.maximum((times - self._edges[0]) / self.step, 0.0),
                        len(self._edges) - 1.001)
        place = at.astype(int)
        return place, (at - place)[:, np.newaxis]


class _Shape:
    """The responses of poles of one kind, all real or all of pairs, to the inputs over cells."""

    def __init__(self, cells: _Cells, poles: ComplexArray, effort: Effort) -> None:
        self.poles, self._cells = poles if poles[0].imag > 0.0 else poles.real, cells
        self._free: dict[int, Array] = {}
        self.size = len(poles), 1 + int(poles[0].imag > 0.0)
        # (nu, cells + 1, m parts): all at one instant are neighbours, for they are read together.
        driven = np.empty((len(cells.means), cells.count + 1, *self.size))
        for some in np.split(np.arange(len(poles)), len(poles) // _PAIRS):
            effort.spend(_PER_CELL * len(some) * len(cells.means) * cells.count)
            driven[:, :, some] = _parts(cells.responses(self.poles[some])).transpose(2, 3, 0, 1)
        self.driven = driven.reshape(*driven.shape[:2], -1)

    def candidates(self, stream: Stream, delay: Array) -> Array:
        """Return the columns of each pole: responses to the inputs and free, (m, q, N)."""
        times, cells = stream.times, self._cells
        found = np.empty((*self.size, len(delay) + 1, len(times)))
        places = {d: cells.places(times - d) for d in set(delay.tolist())}
        for j, (place, part) in enumerate(places[d] for d in delay.tolist()):
            read = self.driven[j][place]
            read += part * (self.driven[j][place + 1] - read)
            found[:, :, j] = read.T.reshape(*self.size, len(times))      # perhaps none
        found[:, :, -1] = self.free(stream, cells.record.start)
        return found.reshape(len(found), self.size[1] * (len(delay) + 1), len(times))

    def free(self, stream: Stream, start: float) -> Array:
        """Return the free responses, (m, parts, N); kept, for dead times do not matter."""
        if stream.channels.start not in self._free:
            self._free[stream.channels.start] = _parts(
                np.exp(self.poles[:, np.newaxis] * (stream.times - start)))
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
