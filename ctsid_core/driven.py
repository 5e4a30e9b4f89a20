# SPDX-License-Identifier: Apache-2.0
"""
B, C and D of a system of known A, from simulations.

The outputs are linear in B (with D, initial states, trim) and then in C, and all responses are
exact at the stamps of the outputs, whatever these do in between. [TM] eq. 14 takes C from the
first filter alone; there the noise of one filter decides. [TM] eq. 15 asks for B in the equations of filtered outputs instead, with free
states: there an error of the observability matrix goes straight to B, multiplied with the states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.matrix_functions import Modes, modes, phi
from ctsid_core.pbsid import least_norm
from ctsid_core.signals import Record
from ctsid_core.simulation import input_polynomials, knots_between, recursion

Array = NDArray[np.float64]

_CONDITION = 1e10     # of the eigenvectors of A, beyond which there is no simulation by modes
_FURTHEST = 300.0     # exponent of an unstable mode's growth that floating point still holds


@dataclass(frozen=True, eq=False)
class Driven:
    """
    B, C and D whose simulations are near the samples.

    Parameters
    ----------
    B, C, D : ndarray, shapes (n, nu), (ny, n), (ny, nu)
    """

    B: Array
    C: Array
    D: Array


@dataclass(frozen=True, eq=False)
class _Seen:
    """One output signal of one record: its samples, and what inputs make of every mode."""

    record: int
    channels: slice
    y: Array                            # (times, channels)
    responses: NDArray[np.complex128]   # (times, modes, u then impulse then 1)
    u: Array                            # (times, nu)


def simulated(records: Sequence[Record], A: Array, C: Array, delay: tuple[float, ...], *,
              trim: bool, feedthrough: bool, tolerance: float) -> Driven | None:
    """
    Return the model of given A whose simulations are near the samples of the outputs.

    First B and D for the given C, then C and D for the states that this B makes. Each output
    counts by its own power; initial states and trim of each record are free.

    Parameters
    ----------
    records : sequence of Record
    A : ndarray, shape (n, n)
    C : ndarray, shape (ny, n)
    delay : tuple of float, length nu
        [s]
    trim : bool
        Whether constants drive states and outputs.
    feedthrough : bool
        Whether u acts on y at once.
    tolerance : float
        Directions of regressors below this fraction of the largest are left out.

    Returns
    -------
    Driven or None
        None if the eigenvectors of A are dependent, or a mode grows beyond all bounds.
    """
    found = modes(A, _CONDITION)
    length = max(r.duration for r in records)
    if found is None or (found.values.real * length > _FURTHEST).any():
        return None
    seen = [one for i, record in enumerate(records)
            for one in _seen(record, found, delay, trim, i)]
    B, drives = _inputs(seen, found, C, trim, feedthrough, tolerance)
    C, D = _outputs(seen, found, drives, len(C), trim, feedthrough, tolerance)
    return Driven(B, C, D)


def _seen(record: Record, found: Modes, delay: tuple[float, ...], trim: bool,
          own: int) -> list[_Seen]:
    parts, first = [], 0
    for signal in record.outputs:
        inside = (signal.time >= record.start) & (signal.time <= record.end)
        responses, u = _responses(record, found, delay, signal.time[inside], trim)
        parts.append(_Seen(own, slice(first, first + signal.width), signal.values[inside],
                           responses, u))
        first += signal.width
    return parts


def _inputs(seen: Sequence[_Seen], found: Modes, C: Array, trim: bool, feedthrough: bool,
            tolerance: float) -> tuple[Array, list[Array]]:
    """Return B, and for each record B beside its initial state and trim of states."""
    n, ny, nu = found.right.shape[0], len(C), seen[0].u.shape[1]
    feed, count = ny * nu * feedthrough, seen[-1].record + 1
    each, own = n * (1 + trim), n * (1 + trim) + ny * trim
    width = n * nu + feed + own * count
    triangle = np.zeros((0, width + 1))
    for one in seen:
        for j, channel in enumerate(range(one.channels.start, one.channels.stop)):
            made = np.einsum('k,kn,tkm->tmn', C[channel] @ found.right, found.left,
                             one.responses, optimize=True).real
            block, times = np.zeros((len(one.y), width + 1)), len(one.y)
            block[:, :n * nu] = made[:, :nu].reshape(times, -1)
            if feedthrough:
                first = n * nu + channel * nu
                block[:, first:first + nu] = one.u
            first = n * nu + feed + own * one.record
            block[:, first:first + each] = made[:, nu:].reshape(times, -1)
            if trim:
                block[:, first + each + channel] = 1.0
            block[:, -1] = one.y[:, j]
            block /= np.std(one.y[:, j]) + 1e-300
            triangle = np.linalg.qr(np.vstack((triangle, block)), mode='r')
    theta = least_norm(triangle[:, :-1].T, triangle[:, -1:].T, tolerance)[0]
    B = theta[:n * nu].reshape(nu, n).T
    rest = theta[n * nu + feed:].reshape(count, own)[:, :each].reshape(count, 1 + trim, n)
    return B, [np.hstack((B, r.T)) for r in rest]


def _outputs(seen: Sequence[_Seen], found: Modes, drives: Sequence[Array], ny: int, trim: bool,
             feedthrough: bool, tolerance: float) -> tuple[Array, Array]:
    """Return C and D for the states that are driven like that in each record."""
    n, nu, count = found.right.shape[0], seen[0].u.shape[1], len(drives)
    C, D = np.zeros((ny, n)), np.zeros((ny, nu))
    stacked: dict[int, list[Array]] = {}
    for one in seen:
        modal = np.einsum('tkm,km->tk', one.responses, found.left @ drives[one.record])
        x = (modal @ found.right.T).real
        ones = np.zeros((len(x), count * trim))
        if trim:
            ones[:, one.record] = 1.0
        block = np.hstack((x, one.u if feedthrough else one.u[:, :0], ones))
        for j, channel in enumerate(range(one.channels.start, one.channels.stop)):
            stacked.setdefault(channel, []).append(np.hstack((block, one.y[:, j:j + 1])))
    for channel, blocks in stacked.items():
        triangle = np.linalg.qr(np.vstack(blocks), mode='r')
        theta = least_norm(triangle[:, :-1].T, triangle[:, -1:].T, tolerance)[0]
        C[channel] = theta[:n]
        if feedthrough:
            D[channel] = theta[n:n + nu]
    return C, D


def _responses(record: Record, found: Modes, delay: tuple[float, ...], times: Array,
               trim: bool) -> tuple[NDArray[np.complex128], Array]:
    """Return 1 / (s - mode) of u, of an impulse at the start and of 1, (times, modes, signals)."""
    at = np.concatenate(([record.start], times, [record.end]))
    knots = knots_between(record.inputs, delay, at)
    u = input_polynomials(record.inputs, delay, knots)
    ones = np.zeros((len(u), len(knots), int(trim)))
    ones[0] = 1.0
    driving = np.concatenate((u, ones), axis=2)
    h = np.diff(knots)[:, np.newaxis]
    functions = phi(h * found.values, len(driving))
    rest = np.zeros(len(found.values), dtype=complex)
    paths = []
    for m in range(driving.shape[2]):
        drive = sum((h ** (j + 1) * functions[j + 1] * v[:-1, m, np.newaxis]
                     for j, v in enumerate(driving)), np.zeros(()))
        paths.append(recursion(functions[0], drive, rest))
    free = np.exp((knots - knots[0])[:, np.newaxis] * found.values)
    nu = record.nu
    rows = np.searchsorted(knots, times)
    return (np.stack([*paths[:nu], free, *paths[nu:]], axis=2)[rows], u[0][rows])
