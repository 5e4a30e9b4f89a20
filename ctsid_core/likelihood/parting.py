# SPDX-License-Identifier: Apache-2.0
"""
How the modes of one pole part, where a residue of several ranks is not enough.

r modes of a pole p are a block p I of the matrix A. To first order any matrix of r^2 numbers moves
it, of which a pole that moves as a whole knows the multiples of I. What the others promise, one
step of Gauss-Newton tells (a score test) before more poles have to climb. After that step the
block is diagonal in the basis of its eigenvectors: two real poles may have become a pair.

References
----------
Rao 1948, Mathematical Proceedings of the Cambridge Philosophical Society 44 (score test).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import (
    LONGEST,
    Fit,
    Free,
    Guess,
    fit_at,
    jacobian,
    steps_around,
)
from ctsid_core.likelihood.pole_steps import PoleSteps, bounded, in_order
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.types import Array, ComplexArray

_KNOWN = 1e-2         # relative singular value below which a step does not move a direction
_FRACTIONS = 0.5 ** np.arange(6)        # of the step, until errors are less


def parted(samples: Samples, fit: Fit, free: Free, price: float) -> Fit | None:
    """
    Return a model with its equal poles apart, if that promises more than it costs; else None.

    That is the `price` of each further number, in -2 log likelihood, and what a step of the poles
    as they are promises.
    """
    if len(set(fit.model.poles.tolist())) == len(fit.model.poles):
        return None
    around = steps_around(samples, fit.model)
    moves, whole = _moves(around)
    rows, error, places = jacobian(samples, fit, free, moves=moves)
    at = len(moves) + np.arange(places.delays)
    pull, delay = rows[:, at].T @ error, fit.model.delay[list(free.delays)]
    rows[:, at[np.where(pull < 0.0, delay <= 0.0, delay >= free.longest)]] = 0.0
    step, promise = _step(rows, error)
    _, before = _step(np.hstack((rows[:, :len(moves)] @ whole, rows[:, len(moves):])), error)
    if promise - before <= max(before, price * (len(moves) - whole.shape[1])):
        return None
    change = np.tensordot(step[:len(moves)], moves, 1)
    for fraction in _FRACTIONS:
        model = _diagonal(fit.model, around.ranks, fraction * change)
        poles = bounded(model.poles, free.limit, free.fastest)
        # Fewer states: a pole of a pair has crossed the real axis
        if model.n == fit.model.n and around.size_of(poles) <= LONGEST:
            with suppress(np.linalg.LinAlgError):
                found = fit_at(samples, poles, model.delay, free, Guess(model, fit.power))
                if found.cost < fit.cost:
                    return found
    return None


def _moves(around: PoleSteps) -> tuple[ComplexArray, Array]:
    """Return how blocks may move, (k, m, m), and which of that moves whole poles, (k, whole)."""
    moves, whole = list[ComplexArray](), list[Array]()
    ends = np.cumsum(around.ranks)
    for p, size, rank, end in zip(around.poles, around.scale, around.ranks, ends, strict=True):
        for unit in (1.0, 1.0j)[:1 + int(p.imag > 0.0)]:
            for place in np.ndindex(rank, rank):
                moves.append(np.zeros((ends[-1], ends[-1]), dtype=complex))
                moves[-1][place[0] + end - rank, place[1] + end - rank] = unit * size
            whole.append(np.eye(rank).reshape(-1, 1))
    return np.array(moves), block_diag(*whole)


def _step(rows: Array, error: Array) -> tuple[Array, float]:
    """Return a step of Gauss-Newton and what it promises."""
    step = least_norm(rows.T, error[np.newaxis], _KNOWN)[0]
    return step, float(error @ (rows @ step))


def _diagonal(model: ModalModel, ranks: tuple[int, ...], change: ComplexArray) -> ModalModel:
    """Return the model whose A is changed in the blocks of its poles, in the modes of that."""
    poles, into, back, end = list[ComplexArray](), list[ComplexArray](), list[ComplexArray](), 0
    for rank in ranks:
        own = slice(end, end := end + rank)
        block, real = change[own, own], model.poles[own.start].imag == 0.0
        values, vectors = np.linalg.eig(block.real if real else block)
        one = values.imag >= 0.0 if real else np.full(rank, True)      # of each pair
        poles.append(model.poles[own][one] + values[one])
        into.append((vectors * np.where(real & (values.imag > 0.0), 2.0, 1.0))[:, one])
        back.append(np.linalg.inv(vectors)[one])
    found, T, S = np.concatenate(poles).astype(complex), block_diag(*into), block_diag(*back)
    order = in_order(found)
    return replace(model, poles=found[order], b=(S @ model.b)[order], c=(model.c @ T)[:, order],
                   x0=(model.x0 @ S.T)[:, order])
