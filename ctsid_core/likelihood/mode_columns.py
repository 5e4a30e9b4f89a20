# SPDX-License-Identifier: Apache-2.0
"""
All that a model with given poles and dead times can do at the samples, as a triangle.

Whatever its residues, initial states and trim, and however its poles and dead times move, to first
order a simulation is a sum of a few columns: responses of the modes to inputs and to the initial
state, their derivatives by the pole, the inputs, their derivatives and 1. A QR factorisation of
these columns beside the outputs keeps all inner products, so that residuals, linear fits and
Gauss-Newton steps are products of small matrices, however many samples there are.

A mode's part of an output is Re(g Z) = Re g Re Z - Im g Im Z with a complex coefficient g, so that
a sum of columns is a vector of real weights (`weights`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.tall_qr import triangle
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.modal import mode_responses


@dataclass(frozen=True, eq=False)
class Triangle:
    """
    The columns of one stream of one record, turned so that few rows are left.

    Parameters
    ----------
    columns : ndarray, shape (r, k)
        What a model can do: `weights` says in which order.
    y : ndarray, shape (r, channels)
        The outputs.
    channels : ndarray of int
        Places of these among all outputs.
    count : int
        Number of samples of each.
    """

    columns: Array
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
               turned: bool = True) -> tuple[Columns, ...]:
    """
    Return the columns of given poles and dead times, of each record.

    Parameters
    ----------
    samples : Samples
    poles : ndarray, shape (m,)
        Real ones, and one of each pair, that with positive imaginary part [rad/s].
    delay : sequence of float, length nu
        [s]
    turned : bool
        Whether few rows are wanted; else there is one for each sample.
    """
    return tuple(_of_record(r, poles, delay, turned) for r in samples.records)


def _of_record(record: RecordSamples, poles: ComplexArray, delay: Array | Sequence[float],
               turned: bool) -> Columns:
    times = record.streams[0].times if len(record.streams) == 1 else \
        np.concatenate([s.times for s in record.streams])
    found = mode_responses(poles, record.inputs, delay, record.start, times)
    since = times - record.start
    free = np.exp(poles[:, np.newaxis] * since)[:, np.newaxis]
    Z = np.concatenate((found.responses, free), axis=1)
    dZ = np.concatenate((found.slopes, since * free), axis=1)
    pairs, length = poles.imag > 0.0, len(times)
    rows = np.concatenate((
        Z.real.reshape(-1, length), Z[pairs].imag.reshape(-1, length),
        dZ.real.reshape(-1, length), dZ[pairs].imag.reshape(-1, length),
        found.inputs, found.rates, np.ones((1, length))))
    triangles, place = [], 0
    for s in record.streams:
        own = slice(place, place + len(s.times))
        place = own.stop
        both = np.vstack((rows[:, own], s.y.T))
        both = triangle(both.T) if turned and len(s.times) > len(both) else both.T
        triangles.append(Triangle(both[:, :len(rows)], both[:, len(rows):],
                                  np.arange(s.channels.start, s.channels.stop), len(s.times)))
    return Columns(tuple(triangles), found.first)


def weights(poles: ComplexArray, of_z: ComplexArray, of_dz: ComplexArray | None = None,
            of_u: Array | None = None, of_one: Array | None = None,
            of_rates: Array | None = None) -> Array:
    """
    Return sums of columns as weights.

    Parameters
    ----------
    poles : ndarray, shape (m,)
    of_z, of_dz : ndarray, shape (..., m, nu + 1)
        Coefficients of the responses to the inputs and to the initial state, and of their
        derivatives by the pole; of_dz None: zero.
    of_u, of_rates : ndarray, shape (..., nu)
        Of the inputs and of their derivatives.
    of_one : ndarray, shape (...)

    Returns
    -------
    ndarray, shape (..., k)
    """
    lead, pairs, wide = of_z.shape[:-2], poles.imag > 0.0, of_z.shape[-1]
    half = (len(poles) + int(np.count_nonzero(pairs))) * wide
    out = np.zeros((*lead, 2 * half + 2 * wide - 1))
    for place, given in ((0, of_z), (half, of_dz)):
        if given is not None:
            real = len(poles) * wide
            out[..., place:place + real] = given.real.reshape(*lead, real)
            out[..., place + real:place + half] = -given[..., pairs, :].imag.reshape(
                *lead, half - real)
    if of_u is not None:
        out[..., 2 * half:2 * half + wide - 1] = of_u
    if of_rates is not None:
        out[..., 2 * half + wide - 1:-1] = of_rates
    if of_one is not None:
        out[..., -1] = of_one
    return out
