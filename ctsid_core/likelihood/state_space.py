# SPDX-License-Identifier: Apache-2.0
"""A modal model as real matrices, and the covariance of these."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Fit, Free, Places, jacobian
from ctsid_core.likelihood.pole_steps import PoleSteps
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array, ComplexArray, Mask
from ctsid_core.model.covariance import Entries

_MET = 0.03           # relative distance of two poles below which they share a block
_GAUGE = 1e-7         # relative singular value below which a direction changes nothing


def matrices_of(model: ModalModel, size: Array, record: int = 0) -> Matrices:
    """
    Return the matrices of a modal model; its `tail` is the state at the start of a record.

    Parameters
    ----------
    model : ModalModel
    size : ndarray, shape (ny,)
        That outputs were divided by.
    record : int
        Whose trim and initial state are wanted.
    """
    A, B, C, x0 = _modal(model.poles, model.b, model.c * size[:, np.newaxis], model.x0[record])
    T = _mended(model)
    inverse = np.linalg.inv(T)
    n, ny = len(A), len(C)
    return Matrices(A=T @ A @ inverse, B=T @ B, C=C @ inverse, D=model.D * size[:, np.newaxis],
                    K=np.zeros((n, ny)), tail=(T @ x0)[:, np.newaxis], x_trim=np.zeros((n, 1)),
                    y_trim=(model.y0[record] * size)[:, np.newaxis])


def _modal(poles: ComplexArray, b: ComplexArray, c: ComplexArray,
           x0: ComplexArray) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C and x0 of real modal states: Re z of all modes, then Im z of pairs."""
    pairs = np.flatnonzero(poles.imag > 0.0)
    m = len(poles)
    A = np.diag(np.concatenate((poles.real, poles[pairs].real)))
    A[pairs, m + np.arange(len(pairs))] = -poles[pairs].imag
    A[m + np.arange(len(pairs)), pairs] = poles[pairs].imag
    B = np.vstack((b.real, b[pairs].imag))
    C = np.hstack((c.real, -c[:, pairs].imag))
    return A, B, C, np.concatenate((x0.real, x0[pairs].imag))


def _mended(model: ModalModel) -> Array:
    """Return T that keeps entries moderate where two poles nearly meet."""
    poles, n, m = model.poles, model.n, len(model.poles)
    T, single = np.eye(n), len(model.c) == 1
    for k, i in enumerate(np.flatnonzero(poles.imag > 0.0)):
        w = poles[i].imag
        if w < _MET * abs(poles[i]):
            T[m + k, m + k] = w if single else 1.0 / w
    for one, other in PoleSteps.of(poles, 0.0, min(len(model.c), model.b.shape[1]) > 1).factors:
        if other < 0 or abs(poles[one] - poles[other]) > _MET * abs(poles[one]):
            continue
        gap = (poles[one] - poles[other]).real
        block = np.array([[1.0, 1.0], [gap, 0.0]]) if single else \
            np.array([[1.0 / gap, -1.0 / gap], [0.0, 1.0]])
        T[np.ix_([one, other], [one, other])] = block
    return T


def entry_changes(samples: Samples, fit: Fit, free: Free, inflation: float) -> Entries:
    """
    Return the root of the covariance of A, B, C, D and dead times, a row for each direction.

    Parameters
    ----------
    samples : Samples
    fit : Fit
        At the maximum of the likelihood.
    free : Free
    inflation : float
        N / N_eff, by which the covariance of white errors is multiplied.
    """
    model = fit.model
    rows, _, places = jacobian(samples, fit, free)
    plant = _of_plant(samples, fit, free, places, rows.shape[1])
    nuisance = ~plant.any(axis=0)
    wanted = plant.any(axis=0)
    if samples.ny == 1:                             # c is 1 then
        wanted &= ~plant[1]
    elif samples.nu == 1:
        wanted[places.poles + places.delays:places.poles + places.delays + places.b] = False
    basis = _orthonormal(rows[:, nuisance])
    moving = rows[:, wanted]
    moving = moving - basis @ (basis.T @ moving)
    moving = np.vstack((moving, _intervals(samples, free, places, rows.shape[1])[:, wanted]
                        * np.sqrt(inflation)))
    norm = np.linalg.norm(moving, axis=0)
    norm[norm == 0.0] = np.inf
    _, s, right = np.linalg.svd(moving / norm, full_matrices=False)
    kept = s > _GAUGE * s[0]
    total = float(samples.counts.sum())
    spare = max(1.0 - (np.count_nonzero(kept) + basis.shape[1]) / total, 0.05)
    root = np.zeros((int(np.count_nonzero(kept)), rows.shape[1]))
    root[:, wanted] = right[kept] / s[kept, np.newaxis] / norm * np.sqrt(inflation / spare)
    steps = PoleSteps.of(model.poles, 1.0 / samples.length, samples.several).derivatives()
    m, nu, ny, pairs = *model.b.shape, samples.ny, np.flatnonzero(model.poles.imag > 0.0)
    n, r = model.n, len(root)
    dp = root[:, :places.poles] @ steps
    at = places.poles
    delay = np.zeros((r, nu))
    delay[:, np.flatnonzero(free.delays)] = root[:, at:at + places.delays]
    at += places.delays
    db = _complex(root[:, at:at + places.b].reshape(r, -1, nu), m, pairs)
    at += places.b + len(samples.records) * places.x0
    width = (root.shape[1] - at) // ny
    dc, dD = np.zeros((r, ny, m), dtype=complex), np.zeros((r, ny, nu))
    for i in range(ny):
        own = root[:, at + i * width:at + (i + 1) * width]
        dc[:, i] = _complex(own[:, :n, np.newaxis], m, pairs)[:, :, 0]
        if free.feedthrough:
            dD[:, i] = own[:, n:n + nu]
    T = _mended(model)
    inverse = np.linalg.inv(T)
    dA = np.zeros((r, n, n))
    for k in range(r):
        A = np.diag(np.concatenate((dp[k].real, dp[k, pairs].real)))
        A[pairs, m + np.arange(len(pairs))] = -dp[k, pairs].imag
        A[m + np.arange(len(pairs)), pairs] = dp[k, pairs].imag
        dA[k] = T @ A @ inverse
    dB, dC = np.zeros((r, n, nu)), np.zeros((r, ny, n))
    for k in range(r):
        dB[k] = T @ np.vstack((db[k].real, db[k, pairs].imag))
        dC[k] = (np.hstack((dc[k].real, -dc[k][:, pairs].imag))
                 * samples.size[:, np.newaxis]) @ inverse
    return Entries(dA, dB, dC, dD * samples.size[:, np.newaxis], delay)


def _intervals(samples: Samples, free: Free, places: Places, count: int) -> Array:
    """
    Return rows that say: dead times are known to a sample interval of the input, (delays, count).

    Where a held input is sampled with the outputs, a small change of dead time is one of zeros,
    and nothing bounds it to first order; a change by more than an interval the samples do show.
    """
    period = np.array([s.period for s in samples.records[0].inputs for _ in range(s.width)])
    found = np.zeros((places.delays, count))
    found[np.arange(places.delays), places.poles + np.arange(places.delays)] = \
        1.0 / period[np.flatnonzero(free.delays)]
    return found


def _of_plant(samples: Samples, fit: Fit, free: Free, places: Places, count: int) -> Mask:
    """Return which numbers are poles, dead times, b or D; and which are c: (2, count)."""
    found = np.zeros((2, count), dtype=bool)
    first = places.poles + places.delays + places.b
    found[0, :first] = True
    at = first + len(samples.records) * places.x0
    width = (count - at) // samples.ny
    for i in range(samples.ny):
        own = at + i * width
        found[1, own:own + fit.model.n] = True
        if free.feedthrough:
            found[0, own + fit.model.n:own + fit.model.n + samples.nu] = True
    return found


def _orthonormal(columns: Array) -> Array:
    """Return a basis of what columns span."""
    size = np.linalg.norm(columns, axis=0)
    kept = columns[:, size > 0.0] / size[size > 0.0]
    if not kept.shape[1]:
        return np.zeros((len(columns), 0))
    left, s, _ = np.linalg.svd(kept, full_matrices=False)
    found: Array = left[:, s > 1e-12 * s[0]]
    return found


def _complex(rows: Array, m: int, pairs: NDArray[np.intp]) -> ComplexArray:
    """Return complex changes of modes from real parts of all, then imaginary parts of pairs."""
    found = rows[:, :m].astype(complex)
    found[:, pairs] += 1j * rows[:, m:]
    return found
