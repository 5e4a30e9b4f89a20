# SPDX-License-Identifier: Apache-2.0
"""
Predictors from a regression of the outputs on what was just before: where predictions start.

What was before is summed up by a few real modes of fixed poles, driven by the inputs and by the
outputs' own past: least squares finds what they tell of the next samples, in closed loop, too.
That predictor has many states, and balancing it leaves those that matter: predictors of every
order at once. Inputs are shifted by dead times from a grid, so that few states are left to stand
in for what is not on it.

References
----------
Chiuso 2007, Automatica 43 (a regression on the past, reduced); Moore 1981, IEEE Trans. Automatic
Control 26 (balancing, here with the states' products as measured); van den Hof, Heuberger and
Bokor 1995, Automatica 31 (modes of fixed poles).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ctsid_core.likelihood.mode_columns import columns_of, cost_of
from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.pole_steps import bounded
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.tall_qr import triangle
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.by_order import POINT

_MODES = 5            # that sum up the past: few, for their weights are fitted to the noise, ...
_MORE = 2             # ... but so many more than an order needs of each output, ...
_SLOWEST, _FASTEST = 0.1, 2.0               # ... of so many radians in a sample interval
_ROWS = 4             # equations for each weight, at least
_SHIFTS = (0, 1, 2, 3, 4, 6, 8, 12, 16)     # dead times on the grid, in samples
_RIDGE = 1e-8         # of the power of the modes
_LEAST = 1e-12        # of a state's size over the largest one's


@dataclass(frozen=True, eq=False)
class Start:
    """
    A predictor of the regression, as modes in continuous time.

    Parameters
    ----------
    score : float
        -2 log likelihood: of one order the least is most likely.
    poles : ndarray, shape (m,)
        Real ones, and one of each pair [rad/s].
    b : ndarray, shape (m, nu + ny)
        By inputs and by the outputs' own past.
    delay : ndarray, shape (nu + ny,)
        [s]
    """

    score: float
    poles: ComplexArray
    b: ComplexArray
    delay: Array


def regressed(joint: Samples, highest: int, known: Array, free: Free) -> dict[int, Start]:
    """
    Return the best predictor of every order that the samples can tell; few samples: none.

    Parameters
    ----------
    joint : Samples
        With the outputs' own past among the inputs.
    highest : int
        Order.
    known : ndarray, shape (nu,)
        Dead times that are given; 0 where they are free [s].
    free : Free
        Of the predictors.
    """
    found: dict[int, Start] = {}
    known, step = np.concatenate((known, np.zeros(joint.ny))), joint.interval
    late, few = np.array(free.delays), joint.ny * (_MODES - _MORE)
    shifts = [k * step for k in _SHIFTS if k * step <= free.longest] if late.any() else [0.0]
    for shift in shifts:
        if found and joint.effort.beyond(POINT):
            break
        delay = np.where(late, shift, known)
        for modes, lowest, top in ((_MODES, 1, min(few, highest)),
                                   (-(-highest // joint.ny) + _MORE, few + 1, highest)):
            with suppress(np.linalg.LinAlgError):
                for n, one in _at(joint, modes, range(lowest, top + 1), delay, free):
                    if n not in found or one.score < found[n].score:
                        found[n] = one
    return found


def _at(joint: Samples, modes: int, orders: range, delay: Array,
        free: Free) -> Iterator[tuple[int, Start]]:
    """Yield predictors of some orders with given dead times."""
    m = min(modes, int(np.min(joint.counts.sum(axis=0))) // (_ROWS * joint.nu))
    if m < 2 or not orders:
        return
    poles = np.geomspace(_SLOWEST, _FASTEST, m) / -joint.interval
    tables = _tables(joint, poles, delay)
    weights = np.zeros((joint.ny, m * joint.nu))
    for states, y, channels in tables:
        size = np.linalg.norm(states, axis=0) + 1e-300
        ridge = np.sqrt(_RIDGE) * np.eye(len(size))
        weights[channels] = (np.linalg.lstsq(
            np.vstack((states / size, ridge)), np.vstack((y, np.zeros((len(size), y.shape[1])))),
            rcond=None)[0] / size[:, np.newaxis]).T
    moved = np.vstack([states for states, _, _ in tables])
    # What a state does to the outputs from now on: the integral of squares, as a root.
    power, turn = np.linalg.eigh(-1.0 / np.add.outer(poles, poles))
    root = np.sqrt(np.maximum(power, 0.0))[:, np.newaxis] * turn.T
    seen = np.einsum('ki,oij->okij', root, weights.reshape(joint.ny, m, joint.nu)).reshape(
        joint.ny * m, -1)
    left, s, right = np.linalg.svd(seen @ moved.T, full_matrices=False)
    A, B = np.repeat(poles, joint.nu)[:, np.newaxis], np.tile(np.eye(joint.nu), (m, 1))
    for n in orders[:max(int(np.sum(s > _LEAST * np.max(s, initial=0.0))) + 1 - orders.start, 0)]:
        to_state = (left[:, :n] / np.sqrt(s[:n])).T @ seen
        back = moved.T @ (right[:n].T / np.sqrt(s[:n]))
        squares = np.zeros(joint.ny)
        for states, y, channels in tables:
            x = states @ to_state.T
            squares[channels] = np.sum((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2, axis=0)
        score = float(cost_of(squares, joint.counts.sum(axis=0)))
        yield n, Start(score, *_modes(to_state @ (A * back), to_state @ B, free), delay)


def _tables(joint: Samples, poles: Array, delay: Array) -> list[tuple[Array, Array, slice]]:
    """Return states, outputs and their places; what starts and trims explain is left out."""
    columns, found = columns_of(
        joint, poles.astype(complex), delay, direct=False, slopes=False), []
    for i, stream in enumerate(joint.records[0].streams):
        parts = []
        for own in columns.triangles:
            t, z = own[i], own[i].z.real
            driven = z[:, :, :-1].reshape(len(z), len(poles) * joint.nu)
            parts.append(triangle(np.hstack((z[:, :, -1], t.one[:, np.newaxis], driven, t.y)))[
                len(poles) + 1:, len(poles) + 1:])
        both = np.vstack(parts)
        found.append((both[:, :-t.y.shape[1]], both[:, -t.y.shape[1]:], stream.channels))
    return found


def _modes(A: Array, B: Array, free: Free) -> tuple[ComplexArray, ComplexArray]:
    """Return poles, within their bounds, and b of modes, in the order of `canonical`."""
    values, right = np.linalg.eig(A)
    kept = values.imag >= 0.0
    poles = bounded(values[kept].astype(complex), free.limit, free.fastest)
    order = np.lexsort((poles.real, np.abs(poles), poles.imag > 0.0))
    return poles[order], np.linalg.solve(right, B.astype(complex))[kept][order]
