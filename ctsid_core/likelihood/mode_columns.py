# SPDX-License-Identifier: Apache-2.0
"""
All that a model with given poles and dead times can do at the samples, as a triangle.

Whatever its residues, initial states and trim, and however its poles and dead times move, to first
order a simulation is a sum of a few columns: responses of the modes to inputs and to the initial
state, their derivatives by the pole, the inputs, their derivatives and 1. A QR factorisation of
these columns beside the outputs keeps all inner products, so that residuals, linear fits and
Gauss-Newton steps are products of small matrices, however many samples there are.

A mode's part of an output is Re(g Z) with a complex coefficient g, so that real and imaginary
part of a response are turned together: the turned ones are complex again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctsid_core.likelihood.kernel import Layout, Shape
from ctsid_core.likelihood.modal_model import ranks_of
from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.least_squares import triangle
from ctsid_core.linear.types import Array, ComplexArray, Places
from ctsid_core.model.modal import steps_of

ROUNDING = 1e-24      # of an output's power: what is left of it is rounding
_OVERHEAD = 4e5       # operations that an evaluation of no samples takes, and each output
_PER_RESPONSE = 100.0  # operations for each sample and response, ...
_PER_PRODUCT = 0.5     # ... and for each sample and product of two columns


@dataclass(frozen=True, eq=False)
class Triangle:
    """The columns of one stream of one record, turned so that few rows are left."""

    z: ComplexArray   # (r, m, nu + 1): responses of modes to inputs and to their initial states
    dz: ComplexArray  # the derivatives of these by the pole
    u: Array          # (r, nu): inputs after their dead time; 0 without D and slopes
    rates: Array      # (r, nu): their derivatives; 0 unless there are both
    one: Array        # (r,): the constant 1
    y: Array          # (r, channels): the outputs
    channels: Places  # of these among all outputs


@dataclass(frozen=True, eq=False)
class Columns:
    """The triangles of all streams of all records."""

    samples: Samples
    layout: Layout
    values: Array  # columns and outputs of all streams in turn, in Fortran's order; then `first`

    @property
    def first(self) -> Array:
        """Inputs at the start of each record, after their dead time, (records, nu)."""
        return self.values[self.layout.size:].reshape(-1, self.samples.nu)

    @cached_property
    def tables(self) -> tuple[tuple[tuple[Array, Array], ...], ...]:
        """Columns and outputs of each stream of each record, a row for each sample or fewer."""
        found, at, number = [], 0, iter(self.layout.rows.tolist())
        width = self.layout.shape.width(self.samples.nu)
        for record in self.samples.records:
            own = []
            for s in record.streams:
                rows, columns = next(number), width + s.y.shape[1]
                table = self.values[at:at + rows * columns].reshape(columns, rows).T
                at += rows * columns
                own.append((table[:, :width], table[:, width:]))
            found.append(tuple(own))
        return tuple(found)

    @cached_property
    def triangles(self) -> tuple[tuple[Triangle, ...], ...]:
        """The same, apart by what the columns are."""
        return tuple(tuple(_triangle(*table, self.samples.nu + 1, self.layout.shape, s.channels)
                           for table, s in zip(own, record.streams, strict=True))
                     for own, record in zip(self.tables, self.samples.records, strict=True))


def columns_of(samples: Samples, poles: ComplexArray, delay: Array, *, direct: bool,
               turned: bool = True, slopes: bool = True) -> Columns:
    """
    Return the columns of poles (m,) [rad/s], in the order of `ModalModel`, and delay (nu,) [s].

    Equal poles share theirs. `direct`: whether there is D; else what is
    its own is left out. `turned`: few rows are wanted; else there is one for each sample.
    `slopes`: so are derivatives by poles and dead times.
    """
    group = tuple(range(len(poles)))
    if len(set(poles.tolist())) < len(poles):
        pole, rank = ranks_of(poles)
        group, poles = tuple(pole.tolist()), poles[rank == 0]
    real = sum(p.imag == 0.0 for p in poles.tolist())
    layout = _layout(samples, Shape(group, real, len(poles) - real, direct, slopes), turned)
    samples.effort.spend(layout.work)
    if samples.kernel is not None:
        return Columns(samples, layout, samples.kernel.columns(layout, poles, delay))
    tables, first, number = [], [], iter(layout.rows.tolist())
    for record in samples.records:
        own, begin = _tables(record, poles, delay, layout.shape, number)
        tables += own
        first.append(begin)
    return Columns(samples, layout, np.concatenate([t.ravel() for t in (*tables, *first)]))


def _layout(samples: Samples, shape: Shape, turned: bool) -> Layout:
    """Return where columns are; it is kept, for there are few."""
    key = (shape, turned)
    if key not in samples.layouts:
        streams = [s for r in samples.records for s in r.streams]
        columns = [shape.width(samples.nu) + s.y.shape[1] for s in streams]
        rows = [min(len(s.times), k) if turned else len(s.times)
                for s, k in zip(streams, columns, strict=True)]
        samples.layouts[key] = Layout(shape, np.array(rows, dtype=np.intc), sum(
            n * k for n, k in zip(rows, columns, strict=True)), evaluation_work(
            samples, shape.real + shape.pairs, slopes=shape.slopes, turned=turned))
    return samples.layouts[key]


def least_cost(columns: Columns, trim: bool) -> float:
    """
    Return -2 log likelihood with residues that are free, for each record by itself.

    Of columns that are turned, without derivatives; without `trim` the last one, the constant,
    does not count.
    """
    squares, number = np.zeros(columns.samples.ny), columns.samples.counts.sum(axis=0)
    for own, record in zip(columns.tables, columns.samples.records, strict=True):
        for (known, y), s in zip(own, record.streams, strict=True):
            if len(y) < len(s.times):                   # else there are as many columns as rows
                squares[s.channels] += np.sum(y[known.shape[1] - (not trim):] ** 2, axis=0)
    return float(cost_of(squares, number))


def cost_of(squares: Array, number: Array) -> Array:
    """Return -2 log likelihood of sums of squares of so many errors of each output."""
    return np.asarray(np.log(np.maximum(squares / np.maximum(number, 1.0), ROUNDING)) @ number)


def evaluation_work(samples: Samples, modes: int, *, slopes: bool = True,
                    turned: bool = True) -> float:
    """Return the work of one evaluation and the step after it, in operations (`effort.py`)."""
    # Without derivatives no step follows. Measured with the kernel, within 40 %.
    count, stamps = samples.size_of_all
    columns = (2.0 + 2.0 * slopes) * modes * (samples.nu + 1) + samples.nu + samples.ny + 1
    responses = modes * (count * (samples.nu + 1) + stamps)
    return (_OVERHEAD * (samples.ny + 1) + _PER_RESPONSE * responses) * (1.0 if slopes else 0.5) \
        + _PER_PRODUCT * count * columns ** 2 * turned


def _tables(record: RecordSamples, poles: ComplexArray, delay: Array, shape: Shape,
            number: Iterator[int]) -> tuple[list[Array], Array]:
    """Return the columns of each stream as rows, outputs below, and the first inputs."""
    times = np.concatenate([s.times for s in record.streams])
    rows, first = _rows(record, poles, delay, shape, times)
    found, place = [], 0
    for s in record.streams:
        both = np.concatenate((rows[:, place:place + len(s.times)], s.y.T))
        place += len(s.times)
        found.append(both if next(number) == len(s.times) else triangle(both.T).T)
    return found, first


def _rows(record: RecordSamples, poles: ComplexArray, delay: Array, shape: Shape,
          times: Array) -> tuple[Array, Array]:
    """Return the columns as rows of one table, and the first inputs."""
    steps = steps_of(record.drives, delay, record.start, times)
    since, first, wide = times - record.start, shape.real, len(delay) + 1
    inputs = (steps.inputs, steps.rates)[:shape.direct + shape.slopes]
    rows = np.empty((shape.width(len(delay)), len(times)))
    place = 0
    for kind in (poles[:first].real, poles[first:]):
        if not len(kind):
            continue
        free = np.exp(kind[:, np.newaxis] * since)
        responses, bent = steps.responses(kind, slopes=shape.slopes)
        for driven, own in ((responses, free), (bent, since * free))[:1 + shape.slopes]:
            for part in (np.real, np.imag)[:1 + np.iscomplexobj(own)]:
                table = rows[place:place + wide * len(kind)].reshape(len(kind), wide, -1)
                table[:, :-1], table[:, -1] = part(driven), part(own)
                place += wide * len(kind)
    for one in inputs:
        rows[place:place + wide - 1] = one
        place += wide - 1
    rows[place] = 1.0
    return rows, steps.first


def _triangle(columns: Array, y: Array, wide: int, shape: Shape, channels: slice) -> Triangle:
    """Return the columns by what they are."""
    group, real, pairs, direct, slopes = shape
    at, blocks = 0, []
    for m, parts in ((real, 1), (pairs, 2)):            # Z, dZ; Re Z, Im Z, Re dZ, Im dZ
        for _ in range(1 + slopes):
            both = [columns[:, at + k * m * wide:at + (k + 1) * m * wide].reshape(
                len(columns), m, wide) for k in range(parts)]
            blocks.append(both[0] if parts == 1 else both[0] + 1j * both[1])
            at += parts * m * wide
    modes = list(group)
    z = np.concatenate((blocks[0], blocks[1 + slopes]), axis=1)[:, modes]
    dz = np.concatenate((blocks[1], blocks[3]), axis=1)[:, modes] if slopes else z[:, :0]
    u, rates = (columns[:, at + k * (wide - 1):at + (k + 1) * (wide - 1)] if k < direct + slopes
                else np.zeros((len(columns), wide - 1)) for k in range(2))
    return Triangle(z, dz, u, rates, columns[:, -1], y, np.arange(channels.start, channels.stop))
