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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.tall_qr import triangle
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.modal import steps_of

_OVERHEAD = 3e6       # operations that an evaluation of no samples takes, and each output
_PER_RESPONSE = 700.0  # operations for each sample and response


@dataclass(frozen=True, eq=False)
class Triangle:
    """
    The columns of one stream of one record, turned so that few rows are left.

    Parameters
    ----------
    z, dz : ndarray, shape (r, m, nu + 1)
        Responses of each mode to the inputs and to its initial state, and their derivatives by
        the pole.
    u, rates : ndarray, shape (r, nu)
        Inputs after their dead time, and their derivatives (0 unless D is free).
    one : ndarray, shape (r,)
        The constant 1.
    y : ndarray, shape (r, channels)
        The outputs.
    channels : ndarray of int
        Places of these among all outputs.
    count : int
        Number of samples of each.
    """

    z: ComplexArray
    dz: ComplexArray
    u: Array
    rates: Array
    one: Array
    y: Array
    channels: Array
    count: int


@dataclass(frozen=True, eq=False)
class Columns:
    """
    The triangles of all streams of one record.

    Parameters
    ----------
    triangles : tuple of Triangle
    first : ndarray, shape (nu,)
        Inputs at its start, after their dead time.
    """

    triangles: tuple[Triangle, ...]
    first: Array


def columns_of(samples: Samples, poles: ComplexArray, delay: Array | Sequence[float], *,
               direct: bool, turned: bool = True) -> tuple[Columns, ...]:
    """
    Return the columns of given poles and dead times, of each record.

    Parameters
    ----------
    samples : Samples
    poles : ndarray, shape (m,)
        Real ones first, then one of each pair, that with positive imaginary part [rad/s].
    delay : sequence of float, length nu
        [s]
    direct : bool
        Whether D is free: else what dead times do to it is left out.
    turned : bool
        Whether few rows are wanted; else there is one for each sample.
    """
    samples.effort.spend(evaluation_work(samples, len(poles)))
    return tuple(_of_record(r, poles, delay, direct, turned) for r in samples.records)


def evaluation_work(samples: Samples, modes: int) -> float:
    """
    Return the work of one evaluation and the step after it, in operations (`effort.py`).

    Measured, within 40 %.
    """
    count = sum(float(len(s.times)) for r in samples.records for s in r.streams)
    stamps = sum(float(len(s.time)) for r in samples.records for s in r.inputs)
    columns = 4.0 * modes * (samples.nu + 1) + samples.nu + samples.ny + 1
    responses = modes * (count * (samples.nu + 1) + stamps)
    return _OVERHEAD * (samples.ny + 1) + _PER_RESPONSE * responses + 2.0 * count * columns ** 2


def _of_record(record: RecordSamples, poles: ComplexArray, delay: Array | Sequence[float],
               direct: bool, turned: bool) -> Columns:
    times = record.streams[0].times if len(record.streams) == 1 else \
        np.concatenate([s.times for s in record.streams])
    rows, shape, first = _rows(record, poles, delay, direct, times)
    size, triangles, place = len(rows) - record.streams[0].y.shape[1], [], 0
    for s in record.streams:
        both = rows[:, place:place + len(s.times)]
        if len(record.streams) > 1:
            both = np.concatenate((both[:size], s.y.T))
        place += len(s.times)
        both = triangle(both.T) if turned and len(s.times) > len(both) else both.T
        triangles.append(_triangle(both[:, :size], both[:, size:], shape,
                                   np.arange(s.channels.start, s.channels.stop), len(s.times)))
    return Columns(tuple(triangles), first)


def _rows(record: RecordSamples, poles: ComplexArray, delay: Array | Sequence[float],
          direct: bool, times: Array) -> tuple[Array, tuple[int, int, int, bool], Array]:
    """
    Return the columns as rows, those of the output below, their shape, and the first inputs.

    All are written into one table, for records of millions of samples; the output's only where
    there is one stream.
    """
    steps = steps_of(record.drives, delay, record.start, times)
    since, first, wide = times - record.start, int(np.sum(poles.imag == 0.0)), len(delay) + 1
    y = record.streams[0].y.T
    inputs = [steps.inputs, steps.rates] if direct else [steps.inputs]
    rows = np.empty((2 * wide * (2 * len(poles) - first) + len(inputs) * (wide - 1) + 1 + len(y),
                     len(times)))
    place = 0
    for kind in (poles[:first].real, poles[first:]):
        if not len(kind):
            continue
        free = np.exp(kind[:, np.newaxis] * since)
        responses, slopes = steps.responses(kind)
        for driven, own in ((responses, free), (slopes, since * free)):
            for part in (np.real, np.imag)[:1 + np.iscomplexobj(own)]:
                table = rows[place:place + wide * len(kind)].reshape(len(kind), wide, -1)
                table[:, :-1], table[:, -1] = part(driven), part(own)
                place += wide * len(kind)
    for one in inputs:
        rows[place:place + wide - 1] = one
        place += wide - 1
    rows[place] = 1.0
    if len(record.streams) == 1:
        rows[place + 1:] = y
    return rows, (first, len(poles) - first, wide, direct), steps.first


def _triangle(columns: Array, y: Array, shape: tuple[int, int, int, bool], channels: Array,
              count: int) -> Triangle:
    """Return the columns by what they are."""
    real, pairs, wide, direct = shape
    at, blocks = 0, []
    for m in (real, real, pairs, pairs, pairs, pairs):      # Z, dZ; Re Z, Im Z, Re dZ, Im dZ
        blocks.append(columns[:, at:at + m * wide].reshape(len(columns), m, wide))
        at += m * wide
    z = np.concatenate((blocks[0], blocks[2] + 1j * blocks[3]), axis=1)
    dz = np.concatenate((blocks[1], blocks[4] + 1j * blocks[5]), axis=1)
    u = columns[:, at:at + wide - 1]
    rates = columns[:, at + wide - 1:-1] if direct else np.zeros_like(u)
    return Triangle(z, dz, u, rates, columns[:, -1], y, channels, count)
