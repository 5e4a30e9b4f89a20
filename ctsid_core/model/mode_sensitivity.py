# SPDX-License-Identifier: Apache-2.0
"""
Derivatives of a simulation at the samples by everything in its model, exactly.

A mode dz/dt = p z + v with v a polynomial between two knots (`simulation.py`) goes from knot to
knot, a distance h apart, by

    z+ = phi_0(p h) z + sum_j h^(j+1) phi_(j+1)(p h) v^(j)

and its derivative by p, with phi_j' = phi_j - j phi_(j+1), by

    s+ = phi_0(p h) (s + h z) + sum_j h^(j+2) phi_(j+1)'(p h) v^(j).

Growing modes are followed backwards, from rest at the end: then nothing grows.

Where no poles coincide, the poles together with all entries of B, C, D, of the trim and of the
first state move a model in every direction there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError
from ctsid_core.linear.matrix_functions import Modes, modes, phi
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.simulation import input_polynomials, knots_between, recursion
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Signal


@dataclass(frozen=True, eq=False)
class ModeResponses:
    """
    What inputs do to modes that start at rest; growing ones end at rest.

    Parameters
    ----------
    responses : ndarray, shape (M, m, nu + 1)
        Of every mode to every input; the last one is the constant 1.
    slopes : ndarray, shape (M, m, nu + 1)
        Their derivatives by the pole.
    inputs : ndarray, shape (M, nu + 1)
        The inputs themselves.
    away : ndarray, shape (M, m)
        Time since where each mode is at rest; negative for growing modes [s].
    """

    responses: ComplexArray
    slopes: ComplexArray
    inputs: Array
    away: Array


def mode_responses(poles: ComplexArray, inputs: Sequence[Signal], delay: Sequence[float],
                   times: Array, *, derivatives: bool = True) -> ModeResponses:
    """
    Return what inputs do to modes that are at rest at the first, growing ones at the last time.

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
    derivatives : bool
        Whether the slopes are wanted; else they are empty.
    """
    knots = knots_between(inputs, delay, times)
    v = input_polynomials(inputs, delay, knots)
    one = np.zeros((len(v), len(knots), 1))
    one[0] = 1.0
    v = np.concatenate((v, one), axis=2)
    rows = np.searchsorted(knots, times)
    m, width = len(poles), v.shape[2]
    h, place = np.unique(np.diff(knots), return_inverse=True)
    if np.ptp(h) < 1e-9 * h[-1]:                # a uniform grid, but for rounding
        h, place = h.mean(keepdims=True), np.zeros_like(place)
    functions = phi(h[:, np.newaxis] * poles, len(v) + 1)
    drive = np.zeros((len(knots) - 1, m, width), dtype=complex)
    for j in range(len(v)):
        gain = functions[j + 1] * h[:, np.newaxis] ** (j + 1)
        drive += gain[place][:, :, np.newaxis] * v[j][:-1, np.newaxis]
    grows = poles.real > 0.0
    step = np.exp(np.where(grows, -1.0, 1.0) * h[:, np.newaxis] * poles)[place]
    # Backwards: z = (z+ - drive) / phi_0, and s = (s+ - slope) / phi_0 - h z.
    drive[:, grows] *= -step[:, grows, np.newaxis]
    z = _follow(step, drive, grows)
    away = times[:, np.newaxis] - np.where(grows, times[-1], times[0])
    if not derivatives:
        return ModeResponses(z[rows], z[:0], v[0][rows], away)
    slope = np.zeros_like(drive)
    for j in range(len(v)):
        fall = functions[j + 1] - (j + 1) * functions[j + 2]
        gain = fall * h[:, np.newaxis] ** (j + 2)
        slope += gain[place][:, :, np.newaxis] * v[j][:-1, np.newaxis]
    slope[:, grows] *= -step[:, grows, np.newaxis]
    slope += h[place][:, np.newaxis, np.newaxis] * np.where(
        grows[:, np.newaxis], -z[:-1], step[:, :, np.newaxis] * z[:-1])
    s = _follow(step, slope, grows)
    return ModeResponses(z[rows], s[rows], v[0][rows], away)


def _follow(step: ComplexArray, drive: ComplexArray, grows: NDArray[np.bool_]) -> ComplexArray:
    """Return z (K + 1, ...) of z+ = step z + drive, backwards of z = step z+ + drive."""
    count, m, width = drive.shape
    found = np.empty((count + 1, m, width), dtype=complex)
    uniform = not np.ptp(step, axis=0).any()
    for chosen, order in ((~grows, slice(None)), (grows, slice(None, None, -1))):
        if not chosen.any():
            continue
        part, start = drive[order, chosen], np.zeros((chosen.sum(), width), dtype=complex)
        if uniform:
            found[order, chosen] = steady_recursion(step[0, chosen], part, start)
        else:
            decay = np.repeat(step[order, chosen], width, axis=1)
            path = recursion(decay, part.reshape(count, -1), start.ravel())
            found[order, chosen] = path.reshape(count + 1, -1, width)
    return found


def steady_recursion(a: ComplexArray, g: ComplexArray, z0: ComplexArray) -> ComplexArray:
    """
    Return z of z_(k+1) = a z_k + g_k, of the same factor at each step.

    Parameters
    ----------
    a : ndarray, shape (m,)
    g : ndarray, shape (K, m, P)
    z0 : ndarray, shape (m, P)

    Returns
    -------
    ndarray, shape (K + 1, m, P)
    """
    from scipy.signal import lfilter  # heavy: half as long to load as all the rest

    z = np.empty((len(g) + 1, *z0.shape), dtype=complex)
    z[0] = z0
    for i, factor in enumerate(a):
        z[1:, i], _ = lfilter([1.0], [1.0, -factor], g[:, i], axis=0,
                              zi=factor * z0[np.newaxis, i])
    return z


def rest_state(model: StateSpace, x0: Array, inputs: Sequence[Signal], times: Array) -> Array:
    """
    Return the state that each mode has where it is at rest in `mode_responses`.

    Parameters
    ----------
    model : StateSpace
        Without coinciding poles.
    x0 : ndarray, shape (n,)
        State at the first of the times.
    inputs : sequence of Signal
    times : ndarray, shape (M,)
        [s]
    """
    found = _modes(model)
    at = mode_responses(found.values, inputs, model.delay, times)
    force = found.left @ np.column_stack((model.B, model.x_trim))
    start = (found.left @ x0 - (at.responses[0] * force).sum(axis=1)
             ) * np.exp(-at.away[0] * found.values)
    state: Array = (found.right @ start).real
    return state


def _modes(model: StateSpace) -> Modes:
    found = modes(model.A, 1e10)
    if found is None:
        raise DataError('`model` has poles that coincide: there are no derivatives by each of '
                        'them; move one of them a little')
    return found


def output_sensitivities(model: StateSpace, rest: Array, inputs: Sequence[Signal], times: Array,
                         *, derivatives: bool = True) -> tuple[Array, Array, int]:
    """
    Return the outputs of a simulation, and their derivatives by all that it depends on.

    Parameters
    ----------
    model : StateSpace
        Without coinciding poles.
    rest : ndarray, shape (n,)
        State that each mode has where it is at rest in `mode_responses` (see `rest_state`).
    inputs : sequence of Signal
    times : ndarray, shape (M,)
        [s]
    derivatives : bool
        Whether they are wanted; else they are empty.

    Returns
    -------
    y : ndarray, shape (M, ny)
    columns : ndarray, shape (M, ny, parameters)
        By the n real numbers that the poles are (of a pair: real part, imaginary part; in the
        order of `modes(model.A)`), then by the entries of `rest`, [B x_trim], C, [D y_trim]. B
        and C share n directions, that change the states' units only.
    split : int
        Where D begins: the columns from there on.

    Raises
    ------
    DataError
        If poles coincide.
    """
    found = _modes(model)
    at = mode_responses(found.values, inputs, model.delay, times, derivatives=derivatives)
    gain = model.C @ found.right                                          # (ny, m)
    force = found.left @ np.column_stack((model.B, model.x_trim))         # (m, nu + 1)
    free = np.exp(at.away * found.values)
    start = found.left @ rest
    z = free * start + np.einsum('kmj,mj->km', at.responses, force)
    x = (z @ found.right.T).real
    direct = np.column_stack((model.D, model.y_trim))
    M, ny, n = len(times), model.ny, model.n
    y = x @ model.C.T + at.inputs @ direct.T
    if not derivatives:
        return y, np.empty((M, ny, 0)), 0
    s = at.away * free * start + np.einsum('kmj,mj->km', at.slopes, force)
    by_pole = _by_pole(found, gain[np.newaxis] * s[:, np.newaxis])
    by_start = np.einsum('om,km,mi->koi', gain, free, found.left).real
    by_B = np.einsum('om,kmj,mi->koij', gain, at.responses, found.left, optimize=True).real
    each = np.eye(ny)
    by_C = np.einsum('op,ki->kopi', each, x).reshape(M, ny, ny * n)
    by_D = np.einsum('op,kj->kopj', each, at.inputs).reshape(M, ny, -1)
    columns = np.concatenate((by_pole, by_start, by_B.reshape(M, ny, -1), by_C, by_D), axis=2)
    return y, columns, columns.shape[2] - by_D.shape[2]


def _by_pole(found: Modes, change: ComplexArray) -> Array:
    """Return derivatives by real numbers from those by complex poles (M, ny, m)."""
    columns = []
    for i, p in enumerate(found.values):
        columns.append(change[:, :, i].real)
        if p.imag > 0.0:
            columns.append(-change[:, :, i].imag)
    return np.stack(columns, axis=2)
