# SPDX-License-Identifier: Apache-2.0
"""
Predictors from a regression of the outputs on what was just before: where predictions start.

What was before is summed up by a few real modes of fixed poles, driven by the inputs and by the
outputs' own past; their weights are what the next samples tell of them, in closed loop, too.
Impulse responses of a predictor are continuous and decay: of all that the samples allow for,
those are likelier, with a covariance of

    lambda e^(-beta max(s, t))                                                               (1)

between s and t, as far as these modes have it. How large they are, lambda of the outputs' own
past, of the other outputs' and of the inputs, is what makes the samples likeliest (empirical
Bayes), and so are dead times from a grid. That predictor has many states, and balancing it leaves
those that matter: predictors of every order at once.

References
----------
Pillonetto and De Nicolao 2010, Automatica 46; Chen, Ohlsson and Ljung 2012, Automatica 48, (1);
MacKay 1992, Neural Computation 4 (lambda); Chiuso 2007, Automatica 43 (a regression on the past,
reduced); Moore 1981, IEEE Trans. Automatic Control 26 (balancing, here with the states' products
as measured); van den Hof, Heuberger and Bokor 1995, Automatica 31 (modes of fixed poles).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ctsid_core.likelihood.modal_model import ModalModel, bounded, in_order
from ctsid_core.likelihood.mode_columns import ROUNDING, columns_of
from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.least_squares import triangle
from ctsid_core.linear.types import Array, ComplexArray, Places
from ctsid_core.search.tried import POINT

_MODES = 8            # that sum up the past, ...
_SLOWEST, _FASTEST = 0.1, 2.0               # ... of so many radians in a sample interval
_DECAY = 0.1          # beta in a sample interval
_FIRST = 10.0         # lambda over the noise, of what is over its size: where it starts
_STEPS = 15           # of its fixed point, ...
_SETTLED = 0.1        # ... and the change of its logarithm that ends it
_ROWS = 4             # samples for each mode, at least
_SHIFTS = (0, 1, 2, 3, 4, 6, 8, 12, 16)     # dead times on the grid, in samples
_LEAST = 1e-12        # of a state's size over the largest one's


@dataclass(frozen=True, eq=False)
class Start:
    """A predictor of the regression."""

    model: ModalModel  # initial states and trims are zero
    parameters: float  # numbers that it is worth: fewer than it has, for what was expected of them


class Table(NamedTuple):
    """Rows of states and outputs, without what starts and trims explain."""

    states: Array        # (rows, modes * (nu + ny))
    y: Array             # (rows, channels): over the size of each output
    channels: slice
    raw: Array           # (nu + ny,): size of each channel that moves states, with all of it


class _Past(NamedTuple):
    """A regression with given dead times."""

    delay: Array         # (nu,) [s]
    tables: list[Table]
    weights: Array       # (ny, m, nu): of the modes
    noise: Array         # (ny,): its power
    worth: float         # free numbers that they are worth
    score: float         # -2 log likelihood, whatever the weights: the least is most likely


def regressed(joint: Samples, highest: int, known: Array, free: Free) -> dict[int, Start]:
    """
    Return the likeliest predictor of every order up to `highest`; of few samples none.

    `joint` has the outputs' own past among the inputs; `known` dead times (nu,) [s] are 0 where
    they are free; `free` is of the predictors.
    """
    best: _Past | None = None
    if np.min(joint.counts.sum(axis=0)) < _ROWS * _MODES:
        return {}
    known, step = np.concatenate((known, np.zeros(joint.ny))), joint.interval
    late, poles = np.array(free.delays), np.geomspace(_SLOWEST, _FASTEST, _MODES) / step
    for shift in _SHIFTS if late.any() else _SHIFTS[:1]:
        if shift * step > free.longest or best and joint.effort.beyond(POINT):
            break
        with suppress(np.linalg.LinAlgError):
            delay = np.where(late, shift * step, known)
            one = _weights(joint, poles, delay, _tables(joint, poles, delay))
            if best is None or one.score < best.score:
                best = one
    with suppress(np.linalg.LinAlgError):
        return {} if best is None else dict(_reduced(joint, poles, best, highest, free))
    return {}


def _reduced(joint: Samples, poles: Array, past: _Past, highest: int,
             free: Free) -> Iterator[tuple[int, Start]]:
    """Yield predictors of all orders."""
    m, nu, ny, records = len(poles), joint.nu, joint.ny, len(joint.records)
    delay, tables, weights, noise, worth, _ = past
    moved = np.vstack([t.states for t in tables])
    # What a state does to the outputs from now on, over their noise: the integral of squares.
    power, turn = np.linalg.eigh(1.0 / np.add.outer(poles, poles))
    root = np.sqrt(np.maximum(power, 0.0))[:, np.newaxis] * turn.T
    seen = np.einsum('ki,oij->okij', root, weights / np.sqrt(noise)[:, np.newaxis, np.newaxis])
    seen, weights = seen.reshape(ny * m, -1), weights.reshape(ny, -1)
    # States that are moved much, and seen much.
    left, s, right = np.linalg.svd(seen @ moved.T, full_matrices=False)
    A, B = -np.repeat(poles, nu)[:, np.newaxis], np.tile(np.eye(nu), (m, 1))
    for n in range(1, min(highest, int(np.sum(s > _LEAST * np.max(s, initial=0.0)))) + 1):
        to_state = (left[:, :n] / np.sqrt(s[:n])).T @ seen
        back = moved.T @ (right[:n].T / np.sqrt(s[:n]))
        b, c, p = _modes(to_state @ (A * back), to_state @ B, weights @ back, free)
        model = ModalModel(p, b, c, np.zeros((records, len(p)), dtype=complex),
                           np.zeros((ny, nu)), np.zeros((records, ny)), delay)
        yield n, Start(model, min(worth, n * (nu + ny)))


def _weights(joint: Samples, poles: Array, delay: Array, tables: list[Table]) -> _Past:
    """Return the regression with the likeliest weights of the modes."""
    m, nu, ny = len(poles), joint.nu, joint.ny
    weights, noise, worth, total = np.zeros((ny, m, nu)), np.ones(ny), 0.0, 0.0
    root = _root(poles, _DECAY / joint.interval)
    joint.effort.check()
    for states, y, channels, raw in tables:
        count = float(joint.counts[:, channels.start].sum())
        driven = states.reshape(len(states), m, nu)
        size = np.linalg.norm(driven[:, -1], axis=0) * poles[-1] / np.sqrt(count)
        size[size ** 2 <= ROUNDING * raw ** 2] = np.inf         # no motion: nothing to know of it
        turned = np.einsum('rkj,ka->rja', driven / size, root).reshape(len(states), -1)
        gram = turned.T @ turned
        for i, target in zip(range(channels.start, channels.stop), y.T, strict=True):
            group = np.full(nu, 2)
            group[nu - ny:], group[nu - ny + i] = 1, 0
            found, number, noise[i], score = _likeliest(
                gram, turned.T @ target, float(target @ target), count, np.repeat(group, m))
            weights[i] = root @ (found.reshape(nu, m) / size[:, np.newaxis]).T
            worth, total = worth + number, total + score
    return _Past(delay, tables, weights, noise, worth, total)


def _root(poles: Array, decay: float) -> Array:
    """Return R such that R R' is the covariance of weights of modes whose sum has (1)."""
    p, q = poles[:, np.newaxis], poles
    products = (p + q + 2.0 * decay) / ((p + decay) * (q + decay) * (p + q + decay))
    inverse = np.linalg.pinv(1.0 / (p + q), rcond=1e-13, hermitian=True)
    values, turn = np.linalg.eigh(inverse @ products @ inverse)
    return np.asarray(turn * np.sqrt(np.maximum(values, 0.0)))


def _likeliest(gram: Array, right: Array, power: float, count: float,
               group: Places) -> tuple[Array, float, float, float]:
    """Return weights, how many numbers they are worth, the noise's power, -2 log likelihood."""
    # Their prior covariance is 1 but for lambda of each group; the noise is what is left. What the
    # weights cost in -2 log likelihood, log det of what the samples add, is log(count) for each
    # number, as in Schwarz's criterion.
    share, best = np.full(int(np.max(group)) + 1, _FIRST), np.inf
    noise = max(power / count, ROUNDING)
    found = np.zeros(len(gram)), 0.0, noise, count * float(np.log(noise))
    if power <= ROUNDING * count:                   # nothing that moves: outputs have size 1
        return found
    for _ in range(_STEPS):
        size = np.sqrt(share)[group]
        factor = cho_factor(gram * size * size[:, np.newaxis] + np.eye(len(gram)))
        w = cho_solve(factor, right * size)
        noise = max(power - float(right * size @ w), ROUNDING * power) / count
        volume = 2.0 * float(np.sum(np.log(factor[0].diagonal())))
        score = volume + count * float(np.log(noise))
        known = 1.0 - cho_solve(factor, np.eye(len(gram))).diagonal()
        if score < best:
            best, found = score, (size * w, volume / float(np.log(count)), noise, score)
        before = share
        share = share * np.bincount(group, w ** 2) / (
            noise * np.maximum(np.bincount(group, known), 1e-9))
        share = np.clip(share, 1e-12, 1e12)
        if np.all(np.abs(np.log(share / before)) < _SETTLED):
            break
    return found


def _tables(joint: Samples, poles: Array, delay: Array) -> list[Table]:
    """Return states and outputs of each stream; what starts and trims explain is left out."""
    columns, found = columns_of(
        joint, -poles.astype(complex), delay, direct=False, slopes=False), []
    for i, stream in enumerate(joint.records[0].streams):
        parts, power = [], np.zeros(joint.nu)
        for own in columns.triangles:
            t, z = own[i], own[i].z.real
            driven = z[:, :, :-1].reshape(len(z), len(poles) * joint.nu)
            parts.append(triangle(np.hstack((z[:, :, -1], t.one[:, np.newaxis], driven, t.y)))[
                len(poles) + 1:, len(poles) + 1:])
            power += np.sum(z[:, -1, :-1] ** 2, axis=0)
        both, count = np.vstack(parts), joint.counts[:, stream.channels.start].sum()
        found.append(Table(both[:, :-t.y.shape[1]], both[:, -t.y.shape[1]:], stream.channels,
                           np.sqrt(power / count) * poles[-1]))
    return found


def _modes(A: Array, B: Array, C: Array,
           free: Free) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return b, c and poles, within their bounds, of modes in the order of `canonical`."""
    values, right = np.linalg.eig(A)
    kept = np.flatnonzero(values.imag >= 0.0)
    poles = bounded(values[kept].astype(complex), free.limit, free.fastest)
    order = in_order(poles)
    b = np.linalg.solve(right, B.astype(complex))[kept]
    c = (C @ right)[:, kept] * (1.0 + (poles.imag > 0.0))
    real = poles.imag == 0.0
    b[real], c[:, real] = b[real].real, c[:, real].real
    return b[order], c[:, order].astype(complex), poles[order]
