# SPDX-License-Identifier: Apache-2.0
"""
Exact response of a linear system to sampled inputs, at any stamps.

Merge the stamps of all inputs (each later by its dead time) with the wanted ones into knots.
Between two knots every input is a polynomial: of degree 0 where it is held, 1 on straight lines, 3
on its cubic spline. Hence, without any approximation,

    x(s + h) = e^(A h) x(s) + sum_j h^(j+1) phi_(j+1)(A h) B u^(j)(s)

with the functions of `matrix_functions`. Where the eigenvectors of A are well-conditioned, this
is one scalar recursion per mode, and all of them run at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import factorial

import numpy as np
from scipy.interpolate import CubicSpline, PPoly
from scipy.linalg import schur, solve_sylvester

from ctsid_core.errors import DataError
from ctsid_core.linear.matrix_functions import Modes, chain, exponentials, modes, phi
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.signals.record import Signal, placed

_CHUNK = 4096  # intervals at a time where matrices are stored per interval
_GROWTH = 5.0  # times e, that modes may grow which are simulated from their start

# From signals, their dead times [s] and knots to what the signals are between the knots.
Pieces = Callable[[Sequence[Signal], Sequence[float], Array], Array]


def input_polynomials(inputs: Sequence[Signal], delay: Sequence[float], knots: Array) -> Array:
    """
    Return the inputs and their derivatives just after each knot, (degree + 1, K, nu).

    Before its first and after its last stamp an input is held. Valid up to the next of the
    increasing knots (K,) [s] if all stamps, later by the dead times of the channels, are knots.
    """
    joined = np.zeros((4, len(knots), sum(signal.width for signal in inputs)))
    for signal, places in placed(inputs):
        own = np.asarray(delay[places])
        for d in np.unique(own):
            channels = own == d
            found = _pieces(signal.time + d, signal.values[:, channels], signal.hold, knots)
            joined[:len(found), :, places][:, :, channels] = found
    degree = max((j for j in range(len(joined)) if joined[j].any()), default=0)
    return joined[:degree + 1]


def _pieces(stamps: Array, values: Array, hold: str, knots: Array) -> Array:
    if hold == 'zoh' or len(stamps) < 2:
        index = np.searchsorted(stamps, knots, side='right') - 1
        return values[np.maximum(index, 0)][np.newaxis]
    if hold == 'linear':
        slope = np.diff(values, axis=0) / np.diff(stamps)[:, np.newaxis]
        curve, degree = PPoly(np.array([slope, values[:-1]]), stamps), 1
    else:
        curve, degree = CubicSpline(stamps, values), 3
    inside = (knots >= stamps[0]) & (knots < stamps[-1])
    value = curve(np.clip(knots, stamps[0], stamps[-1]))
    slopes = [np.where(inside[:, np.newaxis], curve(knots, nu=j), 0.0)
              for j in range(1, degree + 1)]
    return np.array([value, *slopes])


def shifted(derivatives: Array, h: float | Array) -> Array:
    """Return polynomials, given by their derivatives, from a time h later on [s]: Taylor's sum."""
    return np.array([sum(x * h ** k / factorial(k) for k, x in enumerate(derivatives[j:]))
                     for j in range(len(derivatives))])


def respond(A: Array, B: Array, offset: Array, inputs: Sequence[Signal], delay: Sequence[float],
            times: Array, x0: Array | None) -> tuple[Array, Array]:
    """
    Return a solution x of dx/dt = A x + B u(t - delay) + offset, exactly, and its inputs.

    At times (M,) that do not decrease [s]: (M, n) and (M, nu), inputs after their dead time [s]
    and at a jump the new value. `x0` is the state at `times[0]`. None: the solution whose stable
    modes start and whose unstable modes end at zero. It is bounded, however unstable A is, so that
    e^(A t) can be added to it without cancellation. (If the eigenvectors of A are ill-conditioned,
    modes that grow by less than some e^5 over all times may start at zero, too.)

    Raises `DataError` if an input has no sample, or `times` decreases or is not finite.
    """
    for signal in inputs:
        if not len(signal.time):
            raise DataError(f'input {signal.names or ""} has no sample; an input is unknown '
                            'before its first one')
    if times.ndim != 1 or not np.isfinite(times).all() or (np.diff(times) < 0).any():
        raise DataError(f'`times` (shape {times.shape}) must be one row of finite stamps that do '
                        'not decrease; sort them')
    if not len(times):
        return np.empty((0, len(A))), np.empty((0, B.shape[1]))
    knots = knots_between(inputs, delay, times)
    u = input_polynomials(inputs, delay, knots)
    rows = np.searchsorted(knots, times)
    h = np.diff(knots)
    found = modes(A)
    with np.errstate(over='ignore', invalid='ignore'):
        if found is not None:
            x = _by_modes(found, B, offset, u, h, x0)
        else:
            force = u @ B.T
            force[0] += offset
            force = force[..., np.newaxis]
            x = _bounded(A, force, h) if x0 is None else \
                by_matrices(A, np.eye(len(A)), force, h, x0[:, np.newaxis])[..., 0]
    return x[rows], u[0][rows]


def knots_between(inputs: Sequence[Signal], delay: Sequence[float], times: Array) -> Array:
    """Return `times` merged with the stamps of delayed inputs that lie between them [s]."""
    stamps = [times]
    for signal, places in placed(inputs):
        for d in set(delay[places]):
            late = signal.time + d
            stamps.append(late[(late > times[0]) & (late < times[-1])])
    return np.unique(np.concatenate(stamps))


def _by_modes(found: Modes, B: Array, offset: Array, u: Array, h: Array,
              x0: Array | None) -> Array:
    z = h[:, np.newaxis] * found.values
    functions = phi(z, len(u))
    gain = found.left @ B
    drive = np.zeros_like(z)
    for j, derivative in enumerate(u):
        # In place where it can be: each is a table of as many rows as there are steps.
        np.multiply(h[:, np.newaxis] ** (j + 1), functions[j + 1], out=functions[j + 1])
        drive += functions[j + 1] * (
            derivative[:-1] @ gain.T + (found.left @ offset if j == 0 else 0))
    step, grows = functions[0], found.values.real > 0
    del functions
    if x0 is not None or not grows.any():
        start = np.zeros(len(grows), dtype=complex) if x0 is None else found.left @ x0
        return np.asarray((_chained(step, drive, start) @ found.right.T).real)
    path = np.empty((len(h) + 1, len(found.values)), dtype=complex)
    rest = np.zeros(len(found.values), dtype=complex)
    path[:, ~grows] = _chained(step[:, ~grows], drive[:, ~grows], rest[~grows])
    shrink = np.exp(-z[:, grows])[::-1]
    path[::-1, grows] = _chained(shrink, -shrink * drive[::-1, grows], rest[grows])
    return np.asarray((path @ found.right.T).real)


def _chained(a: ComplexArray, g: ComplexArray, z0: ComplexArray) -> ComplexArray:
    """Return z of z_(k+1) = a_k z_k + g_k from z0, (K + 1, m), of a and g (K, m)."""
    push = g.T[:, np.newaxis].copy()
    push[:, :, :1] += (a[:1].T * z0[:, np.newaxis])[:, np.newaxis]
    z = chain(a.T, push)[:, 0]
    z[:, 0] = z0
    return z.T


def _parts(A: Array, length: float) -> tuple[tuple[Array, Array, Array], ...]:
    """Return the part of A that does not grow much over a length, and the part that does."""
    # Each as the matrix that moves it, what it adds to the state, and what the state adds to it.
    # The cut is where poles are farthest apart: they may be so close that they have no parts.
    growth = np.sort(np.append(np.clip(length * np.linalg.eigvals(A).real, 0.0, _GROWTH),
                               (0.0, _GROWTH)))
    widest = int(np.argmax(np.diff(growth)))
    limit = 0.5 * (growth[widest] + growth[widest + 1])
    T, Z, count = schur(A, sort=lambda real, _: real * length <= limit)
    own, other = slice(count), slice(count, None)
    Y = solve_sylvester(T[own, own], -T[other, other], -T[own, other]) \
        if 0 < count < len(A) else np.zeros((count, len(A) - count))
    return ((T[own, own], Z[:, own], Z[:, own].T - Y @ Z[:, other].T),
            (T[other, other], Z[:, own] @ Y + Z[:, other], Z[:, other].T))


def _bounded(A: Array, force: Array, h: Array) -> Array:
    """Return the solution whose growing part ends at zero and whose other part starts there."""
    found = np.zeros((len(h) + 1, len(A)))
    for backwards, (own, right, left) in enumerate(_parts(A, float(h.sum()))):
        found += by_matrices(own, left, force, h, np.zeros((len(own), 1)),
                             bool(backwards))[..., 0] @ right.T
    return found


def by_matrices(A: Array, B: Array, inputs: Array, h: Array, x0: Array,
                backwards: bool = False, check: Callable[[], None] = lambda: None) -> Array:
    """
    Return x of dx/dt = A x + B v, (K + 1, n, m), from x0 (n, m), or backwards to x0 at the end.

    Intervals are h (K,) [s]; `inputs`, (degree + 1, K or more, r, m), are v and its derivatives
    just after the start of each, where v is a polynomial. With none of them v is zero.
    """
    x = np.empty((len(h) + 1, *x0.shape))
    x[-1 if backwards else 0] = x0
    for first in range(0, len(h), _CHUNK)[::-1 if backwards else 1]:
        check()
        rows = slice(first, min(first + _CHUNK, len(h)))
        lengths, which = np.unique(h[rows], return_inverse=True)
        step, *integrals = exponentials(A, lengths, len(inputs))
        drive = sum(((f @ B)[which] @ inputs[j, rows] for j, f in enumerate(integrals)),
                    np.zeros((len(which), 1, 1)))
        if backwards:
            back = exponentials(A, -lengths, 0)[0]
            for k in reversed(range(rows.start, rows.stop)):
                x[k] = back[which[k - first]] @ (x[k + 1] - drive[k - first])
            continue
        for k in range(rows.start, rows.stop):
            x[k + 1] = step[which[k - first]] @ x[k] + drive[k - first]
    return x


def free_response(A: Array, C: Array, times: Array) -> tuple[Array, Array]:
    """
    Return a basis of all responses C e^(A t) x0, scaled so that none overflows.

    Stable modes are 1 at the first time, unstable ones 1 at the last. The basis, (M, ny, n), has a
    response per column; column i of the second matrix is the state at `times[0]` that gives it.
    """
    found = modes(A)
    first, last = (times[0], times[-1]) if len(times) else (0.0, 0.0)
    if found is None:
        bases, states = [], []
        for backwards, (own, right, _) in enumerate(_parts(A, last - first)):
            one = np.eye(len(own))
            path = by_matrices(own, one, np.empty((0, 0)), np.diff(times), one, bool(backwards))
            bases.append((C @ right @ path)[:len(times)])
            states.append(right @ path[0])
        return np.concatenate(bases, axis=2), np.hstack(states)
    reference = np.where(found.values.real > 0, last, first)
    growth = np.exp((times[:, np.newaxis] - reference) * found.values)
    response = growth[:, np.newaxis] * (C @ found.right)
    state = found.right * np.exp((first - reference) * found.values)
    pairs = found.values.imag > 0
    return (np.concatenate([response.real, -response.imag[..., pairs]], axis=-1),
            np.concatenate([state.real, -state.imag[:, pairs]], axis=-1))
