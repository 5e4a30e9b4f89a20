# SPDX-License-Identifier: Apache-2.0
"""
Responses of a model to sampled inputs at the outputs' stamps, and their derivatives, exactly.

In modal coordinates all that a model of given inputs can do is a sum of elementary responses, one
for each mode l and drive j (an input, the initial state, a constant),

    s_lj(t) = int e^(p_l (t - r)) u_j(r) dr,

and what an entry of A changes is a sum of convolutions of two modes,

    int e^(p_l (t - r)) z_k(r) dr = sum_j b_kj (s_kj - s_lj) / (p_k - p_l),  z_k = sum_j b_kj s_kj,

or of ds_lj / dp_l where two poles are the same. Between knots (the stamps of all inputs and
outputs) inputs are polynomials, so that s and its derivative are sums over the knots
(`simulation.py`), and nothing is approximated. Only the sums over the steps between two output
stamps are carried on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.matrix_functions import Modes, modes, phi
from ctsid_core.linear.types import Array, Lines
from ctsid_core.model.simulation import input_polynomials, knots_between, recursion
from ctsid_core.signals.record import Record, channel_slices

_SAME = 1e-7          # relative distance of poles below which they count as equal


@dataclass(frozen=True, eq=False)
class Stamps:
    """
    The samples of a record in time: what does not depend on a model.

    Parameters
    ----------
    times : ndarray, shape (M,)
        Merged stamps of the outputs within the record [s].
    step : ndarray, shape (K - 1,)
        From knot to knot [s].
    ahead : ndarray, shape (K - 1,)
        From the end of each step to the next stamp of an output [s].
    drive : ndarray, shape (degree + 1, K, drives)
        The inputs after their dead time and the constant (if there is trim), and their
        derivatives, just after each knot.
    places : ndarray of int, shape (M,)
        Knots of the outputs' stamps.
    streams : tuple of (slice, ndarray of int)
        Channels of each output signal, and the places of its stamps among `times`.
    y : tuple of ndarray, each of shape (channels, N)
        The samples of each output signal.
    nu : int
        Number of inputs.
    """

    times: Array
    step: Array
    ahead: Array
    drive: Array
    places: NDArray[np.intp]
    streams: tuple[tuple[slice, NDArray[np.intp]], ...]
    y: tuple[Array, ...]
    nu: int

    @property
    def since(self) -> Array:
        """Time since the first stamp, (M,) [s]."""
        since: Array = self.times - self.times[0]
        return since

    @property
    def counts(self) -> Array:
        """Number of samples of each output channel."""
        return np.array([y.shape[1] for y in self.y for _ in range(len(y))], dtype=float)


def stamps_of(record: Record, delay: tuple[float, ...], trim: bool) -> Stamps:
    """
    Return the samples of a record, ready for models to be compared with.

    Parameters
    ----------
    record : Record
    delay : tuple of float, length nu
        Dead time of each input [s].
    trim : bool
        Whether states and outputs have constant offsets.
    """
    inside = [(s.time >= record.start) & (s.time <= record.end) for s in record.outputs]
    own = [s.time[rows] for s, rows in zip(record.outputs, inside, strict=True)]
    times = np.unique(np.concatenate(own))
    knots = knots_between(record.inputs, delay, times)
    drive = input_polynomials(record.inputs, delay, knots)
    if trim:
        constant = np.zeros((*drive.shape[:2], 1))
        constant[0] = 1.0
        drive = np.concatenate((drive, constant), axis=2)
    streams = [(places, np.searchsorted(times, stamps))
               for places, stamps in zip(channel_slices(record.outputs), own, strict=True)]
    y = tuple(np.ascontiguousarray(s.values[rows].T)
              for s, rows in zip(record.outputs, inside, strict=True))
    ahead = times[np.searchsorted(times, knots[1:])] - knots[1:]
    return Stamps(times, np.diff(knots), ahead, drive, np.searchsorted(knots, times),
                  tuple(streams), y, record.nu)


@dataclass(frozen=True, eq=False)
class Responses:
    """
    What a model makes of the inputs.

    Parameters
    ----------
    modes : Modes
    gain : ndarray, shape (m, drives + 1)
        By how much each drive moves each mode: inputs, initial state, constant.
    s : ndarray, shape (m, drives + 1, M)
        Elementary responses at the outputs' stamps.
    x : ndarray, shape (n, M)
        The states.
    """

    modes: Modes
    gain: Lines
    s: Lines
    x: Array


def responses(stamps: Stamps, m: Matrices) -> Responses | None:
    """
    Return the responses of a model whose `tail` is the state at the first of the stamps.

    None if its eigenvectors are ill-conditioned, or if it explodes.
    """
    found = modes(m.A)
    if found is None:
        return None
    with np.errstate(over='ignore', invalid='ignore'):
        s = elementary(stamps, found.values)
        gain = found.left @ np.hstack((m.B, m.tail, m.x_trim))
        x = (found.right @ np.einsum('lj,ljt->lt', gain, s)).real
    return Responses(found, gain, s, np.ascontiguousarray(x)) if np.isfinite(x).all() else None


def elementary(stamps: Stamps, poles: Lines) -> Lines:
    """Return the elementary responses of poles at the outputs' stamps, (m, drives + 1, M)."""
    decay, push, _ = _pushes(stamps, poles, False)
    s = recursion(decay, push, np.zeros(push.shape[1], dtype=complex))
    return _with_free(stamps, poles, s, np.exp(poles[:, np.newaxis] * stamps.since))


def slopes(stamps: Stamps, poles: Lines) -> Lines:
    """Return the derivatives of `elementary` by the poles, (m, drives + 1, M)."""
    decay, push, turn = _pushes(stamps, poles, True)
    rest = np.zeros(push.shape[1], dtype=complex)
    s = recursion(decay, push, rest)
    turn += np.diff(stamps.times)[:, np.newaxis] * decay * s[:-1]
    free = (stamps.since * np.exp(poles[:, np.newaxis] * stamps.since)).astype(complex)
    return _with_free(stamps, poles, recursion(decay, turn, rest), free)


def _pushes(stamps: Stamps, poles: Lines, slope: bool) -> tuple[Lines, Lines, Lines]:
    """
    Return by how much modes decay from output stamp to output stamp, and what drives add.

    Each of shape (M - 1, m drives), the last one the derivative of what they add by the poles.
    """
    h, u, ahead = stamps.step[:, np.newaxis], stamps.drive, stamps.ahead[:, np.newaxis]
    functions = phi(h * poles, len(u) + slope)
    shape = (len(h), len(poles), u.shape[2])
    push, turn = np.zeros(shape, dtype=complex), np.zeros(shape, dtype=complex)
    left = np.exp(ahead * poles)
    for j, derivative in enumerate(u):
        force = derivative[:-1, np.newaxis]
        step = left * h ** (j + 1) * functions[j + 1]
        push += step[:, :, np.newaxis] * force
        if slope:
            # d/dp of h^(j+1) phi_(j+1)(p h): phi_j' = phi_j - j phi_(j+1)
            bend = left * h ** (j + 2) * (functions[j + 1] - (j + 1) * functions[j + 2])
            turn += (bend + ahead * step)[:, :, np.newaxis] * force
    first = stamps.places[:-1]
    decay = np.exp(np.diff(stamps.times)[:, np.newaxis] * poles)
    flat = (len(first), shape[1] * shape[2])
    return (np.repeat(decay, shape[2], axis=1), np.add.reduceat(push, first).reshape(flat),
            np.add.reduceat(turn, first).reshape(flat))


def _with_free(stamps: Stamps, poles: Lines, s: Lines, free: Lines) -> Lines:
    """Put the free motion between the inputs and the constant: (m, drives + 1, M)."""
    forced = s.T.reshape(len(poles), -1, len(s))
    found: Lines = np.concatenate((forced[:, :stamps.nu], free[:, np.newaxis],
                                   forced[:, stamps.nu:]), axis=1)
    return found


def derivatives(stamps: Stamps, m: Matrices, found: Responses, size: Array,
                feedthrough: bool) -> Array:
    """
    Return the derivatives of the outputs by the entries of A, [B tail x_trim], C, [D y_trim].

    Parameters
    ----------
    stamps : Stamps
    m : Matrices
    found : Responses
        Of the model.
    size : ndarray, shape (ny,)
        What each output is divided by.
    feedthrough : bool
        Whether the entries of D are free.

    Returns
    -------
    ndarray, shape (parameters, sum of N)
        The samples of one output channel after those of another.
    """
    n, ny, drives = len(m.A), len(m.C), found.gain.shape[1]
    direct = _direct(stamps, m, feedthrough)
    states, driven = n * n, n * drives
    out = np.zeros((states + driven + ny * (n + len(direct)), int(stamps.counts.sum())))
    by_state = _convolved(stamps, found)                                     # (m, n, M)
    column = 0
    for channels, rows in stamps.streams:
        C = m.C[channels] / size[channels, np.newaxis]
        outer = (C @ found.modes.right)[:, np.newaxis] * found.modes.left.T   # (channels, n, m)
        for i, weights in zip(range(channels.start, channels.stop), outer, strict=True):
            span = slice(column, column + len(rows))
            column += len(rows)
            out[:states, span] = _real_product(weights, by_state[:, :, rows])
            out[states:states + driven, span] = _real_product(weights, found.s[:, :, rows])
            first = states + driven + i * n
            out[first:first + n, span] = found.x[:, rows] / size[i]
            first = states + driven + ny * n + i * len(direct)
            out[first:first + len(direct), span] = direct[:, rows] / size[i]
    return out


def _direct(stamps: Stamps, m: Matrices, feedthrough: bool) -> Array:
    """Return what acts on the outputs at once, at their stamps: inputs, the constant."""
    at = stamps.drive[0][stamps.places].T
    direct: Array = at[0 if feedthrough else stamps.nu:stamps.nu + m.y_trim.shape[1]]
    return direct


def outputs(stamps: Stamps, m: Matrices, found: Responses) -> Array:
    """Return the outputs of a model at all stamps, (ny, M)."""
    y: Array = m.C @ found.x + np.hstack((m.D, m.y_trim)) @ _direct(stamps, m, True)
    return y


def _convolved(stamps: Stamps, found: Responses) -> Lines:
    """Return int e^(p_l (t - r)) x_q(r) dr for modes l and states q, (m, n, M)."""
    p, pair = found.modes.values, found.modes.values.imag > 0.0
    poles = np.concatenate((p, p[pair].conj()))
    right = np.where(pair, 0.5, 1.0) * found.modes.right
    right = np.hstack((right, right[:, pair].conj()))
    gain = np.concatenate((found.gain, found.gain[pair].conj()))
    z = np.einsum('lj,ljt->lt', found.gain, found.s)
    z = np.concatenate((z, z[pair].conj()))
    apart = poles - p[:, np.newaxis]                                 # (m, n) : l, k
    same = np.abs(apart) <= _SAME * np.abs(p[:, np.newaxis])
    apart[same] = 1.0
    met = (z - gain @ found.s) / apart[:, :, np.newaxis]
    slope = slopes(stamps, p)
    for mode, other in np.argwhere(same):
        met[mode, other] = gain[other] @ slope[mode]
    convolved: Lines = right @ met
    return convolved


def _real_product(weights: Lines, rows: Lines) -> Array:
    """Return the real part of weights (n, m) times rows (m, k, N), as (n k, N)."""
    found: Array = (weights @ rows.reshape(len(rows), -1)).real
    return found.reshape(len(weights) * rows.shape[1], rows.shape[2])
