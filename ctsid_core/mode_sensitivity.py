# SPDX-License-Identifier: Apache-2.0
"""
Derivatives of a simulation at the samples by everything in its model, exactly.

A mode dz/dt = p z + v with v a polynomial between two knots (`simulation.py`) goes from knot to
knot, a distance h apart, by

    z+ = phi_0(p h) z + sum_j h^(j+1) phi_(j+1)(p h) v^(j)

and its derivative by p, with phi_j' = phi_j - j phi_(j+1), by

    s+ = phi_0(p h) (s + h z) + sum_j h^(j+2) phi_(j+1)'(p h) v^(j).

Where no poles coincide, the poles together with all entries of B, C, D, of the trim and of the
first state move a model in every direction there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError
from ctsid_core.matrix_functions import Modes, modes, phi
from ctsid_core.signals import Signal
from ctsid_core.simulation import input_polynomials, knots_between, recursion
from ctsid_core.statespace import StateSpace

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class ModeResponses:
    """
    What inputs do to modes that start at rest.

    Parameters
    ----------
    responses : ndarray, shape (M, m, nu + 1)
        Of every mode to every input; the last one is the constant 1.
    slopes : ndarray, shape (M, m, nu + 1)
        Their derivatives by the pole.
    inputs : ndarray, shape (M, nu + 1)
        The inputs themselves.
    elapsed : ndarray, shape (M,)
        Time since the start [s].
    """

    responses: ComplexArray
    slopes: ComplexArray
    inputs: Array
    elapsed: Array


def mode_responses(poles: ComplexArray, inputs: Sequence[Signal], delay: Sequence[float],
                   times: Array) -> ModeResponses:
    """
    Return what inputs do to modes that are at rest at the first of the wanted times.

    Parameters
    ----------
    poles : ndarray, shape (m,)
        [rad/s]
    inputs : sequence of Signal
        Together nu channels.
    delay : sequence of float, length nu
        [s]
    times : ndarray, shape (M,)
        Not decreasing [s].
    """
    knots = knots_between(inputs, delay, times)
    v = input_polynomials(inputs, delay, knots)
    one = np.zeros((len(v), len(knots), 1))
    one[0] = 1.0
    v = np.concatenate((v, one), axis=2)
    rows = np.searchsorted(knots, times)
    m, width = len(poles), v.shape[2]
    h, place = np.unique(np.diff(knots), return_inverse=True)
    functions = phi(h[:, np.newaxis] * poles, len(v) + 1)
    drive = np.zeros((len(knots) - 1, m, width), dtype=complex)
    slope = np.zeros_like(drive)
    for j in range(len(v)):
        f, power = functions[j + 1], h[:, np.newaxis] ** (j + 1)
        fall = (f - (j + 1) * functions[j + 2]) * power * h[:, np.newaxis]
        drive += (power * f)[place][:, :, np.newaxis] * v[j][:-1, np.newaxis]
        slope += fall[place][:, :, np.newaxis] * v[j][:-1, np.newaxis]
    decay = np.repeat(functions[0][place], width, axis=1)
    rest = np.zeros(m * width, dtype=complex)
    z = recursion(decay, drive.reshape(-1, m * width), rest)
    slope = slope.reshape(-1, m * width) + decay * h[place][:, np.newaxis] * z[:-1]
    s = recursion(decay, slope, rest)
    return ModeResponses(z[rows].reshape(-1, m, width), s[rows].reshape(-1, m, width),
                         v[0][rows], times - times[0])


def output_sensitivities(model: StateSpace, x0: Array, inputs: Sequence[Signal],
                         times: Array) -> tuple[Array, Array, int]:
    """
    Return the outputs of a simulation, and their derivatives by all that it depends on.

    Parameters
    ----------
    model : StateSpace
        Without coinciding poles.
    x0 : ndarray, shape (n,)
        State at the first of the times.
    inputs : sequence of Signal
    times : ndarray, shape (M,)
        [s]

    Returns
    -------
    y : ndarray, shape (M, ny)
    columns : ndarray, shape (M, ny, parameters)
        By the n real numbers that the poles are (of a pair: real part, imaginary part; in the
        order of `modes(model.A)`), then by the entries of x0, [B x_trim], C, [D y_trim]. B and C
        share n directions, that change the states' units only.
    split : int
        Where D begins: the columns from there on.

    Raises
    ------
    DataError
        If poles coincide.
    """
    found = modes(model.A, 1e10)
    if found is None:
        raise DataError('`model` has poles that coincide: there are no derivatives by each of '
                        'them; move one of them a little')
    at = mode_responses(found.values, inputs, model.delay, times)
    gain = model.C @ found.right                                          # (ny, m)
    force = found.left @ np.column_stack((model.B, model.x_trim))         # (m, nu + 1)
    start = found.left @ x0
    free = np.exp(at.elapsed[:, np.newaxis] * found.values)
    z = free * start + np.einsum('kmj,mj->km', at.responses, force)
    s = at.elapsed[:, np.newaxis] * free * start + np.einsum('kmj,mj->km', at.slopes, force)
    x = (z @ found.right.T).real
    direct = np.column_stack((model.D, model.y_trim))
    M, ny, n = len(times), model.ny, model.n
    by_pole = _by_pole(found, gain[np.newaxis] * s[:, np.newaxis])
    by_start = np.einsum('om,km,mi->koi', gain, free, found.left).real
    by_B = np.einsum('om,kmj,mi->koij', gain, at.responses, found.left, optimize=True).real
    each = np.eye(ny)
    by_C = np.einsum('op,ki->kopi', each, x).reshape(M, ny, ny * n)
    by_D = np.einsum('op,kj->kopj', each, at.inputs).reshape(M, ny, -1)
    columns = np.concatenate((by_pole, by_start, by_B.reshape(M, ny, -1), by_C, by_D), axis=2)
    return x @ model.C.T + at.inputs @ direct.T, columns, columns.shape[2] - by_D.shape[2]


def _by_pole(found: Modes, change: ComplexArray) -> Array:
    """Return derivatives by real numbers from those by complex poles (M, ny, m)."""
    columns = []
    for i, p in enumerate(found.values):
        columns.append(change[:, :, i].real)
        if p.imag > 0.0:
            columns.append(-change[:, :, i].imag)
    return np.stack(columns, axis=2)
