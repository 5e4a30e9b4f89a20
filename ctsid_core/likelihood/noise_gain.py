# SPDX-License-Identifier: Apache-2.0
"""
The noise after the plant: a gain K of innovations, with the plant held.

What a simulation leaves is v = C x + e, dx/dt = A x + K e. Sampled with the step h of the slowest
output, with F = e^(A h) and G = int_0^h e^(A s) ds,

    x_(k+1) = F x_k + G K e_k,      e_k = v_k - C x_k,                                       (1)

and the sum of squares of e_k is made smallest over K (Gauss-Newton; the derivatives obey the same
recursion). The plant stays what simulations say it is.

References
----------
Ljung, System Identification, 2nd edition, section 4.3 (innovations form) and 10.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Fit
from ctsid_core.likelihood.samples import Residuals, Samples
from ctsid_core.likelihood.state_space import matrices_of
from ctsid_core.linear.matrix_functions import chain, exponentials, led_through
from ctsid_core.linear.types import Array, ComplexArray, Mask, Matrices
from ctsid_core.model.validation import cell

_STEPS = 10
_HALVINGS = 6
_SHARES = 10.0 ** np.arange(-5.0, 1.0)      # of noise in the modes, over that of the outputs
_DOUBLINGS = 40       # of the samples that a filter has had, at most
_LEAST = 0.02         # part of the errors' size that innovations must be smaller, to be worth K
_FIXED_POINT = 20
_SETTLED = 1e-6       # relative error of what K, or a filter, does from sample to sample
_SAME = 1e-6          # of a step, that stamps are rounded by
_LIMIT = 0.999        # largest magnitude of the predictor's modes, unless the plant's are larger
_WORK, _PER_NUMBER = 1.5e7, 2e3         # work: at least, and for each entry of K and sample


def noise_gain(A: Array, C: Array, parts: Sequence[Array], step: float,
               effort: Effort | None = None) -> tuple[Array, Array]:
    """
    Return the gain K, (n, ny), and the covariance of the innovations, (ny, ny).

    Of a stable plant, A (n, n), C (ny, n), and of `parts`: what the simulation of each record
    leaves, (N, ny), sampled with a uniform step [s]. K is zero if it would help little.
    """
    n, ny, effort = len(A), len(C), effort or Effort()
    total = sum(len(v) for v in parts)
    F, G = (x[0] for x in exponentials(A, np.array([step]), 1))
    weight = 1.0 / np.sqrt(np.mean(np.vstack(parts) ** 2, axis=0) + 1e-300)
    none = np.zeros((n, ny)), (np.vstack(parts) * weight).ravel(), float(total * ny)
    # Of a plant that integrates nothing leads from no gain to that of its filter.
    K, error, best = min((none, *_filters(F, G, C, parts, weight, effort)), key=lambda one: one[2])
    for _ in range(_STEPS):
        found = _run(F, G, C, K, parts, weight, effort, True)
        if found is None:
            break
        effort.check()
        rows = found[0]
        curvature = rows.T @ rows
        scale = np.sqrt(np.diag(curvature)) + 1e-300
        change = np.linalg.solve(curvature / np.outer(scale, scale) + 1e-6 * np.eye(n * ny),
                                 rows.T @ error / scale) / scale
        moved = False
        for k in range(_HALVINGS):
            trial = K + 0.5 ** k * change.reshape(n, ny)
            seen = _run(F, G, C, trial, parts, weight, effort)
            if seen is not None and seen[2] < best:
                gain, K, (_, error, best), moved = best - seen[2], trial, seen, True
                break
        if not moved or gain < 1e-4 * best:
            break
    start = none[2]
    if start * float(np.log(start / best)) < n * ny * np.log(total) or \
            best > (1.0 - _LEAST) ** 2 * start:
        K, error, _ = none
    update = np.linalg.solve(F, G @ K)
    e = error.reshape(-1, ny) / weight
    return continuous_gain(A, C, update, step), np.asarray(e.T @ e / max(total, 1))


def _filters(F: Array, G: Array, C: Array, parts: Sequence[Array], weight: Array,
             effort: Effort) -> Iterator[tuple[Array, Array, float]]:
    """Yield gains of Kalman filters, e and its sum: all modes disturbed alike, as outputs see."""
    values, right = np.linalg.eig(F)
    right = right / np.maximum(np.linalg.norm(weight[:, np.newaxis] * C @ right, axis=0), 1e-300)
    moved, noise = (right @ right.conj().T).real, np.diag(weight ** -2.0)
    with suppress(np.linalg.LinAlgError):
        covariances = _filtering(F, C, _SHARES[:, np.newaxis, np.newaxis] * moved, noise)
        for P in covariances[np.isfinite(covariances).all(axis=(1, 2))]:
            K = np.linalg.solve(G, F @ np.linalg.solve(C @ P @ C.T + noise, C @ P).T)
            seen = _run(F, G, C, K, parts, weight, effort)
            if seen is not None:
                yield K, *seen[1:]


def _filtering(F: Array, C: Array, Q: Array, R: Array) -> Array:
    """Return P = F P F' - F P C' (C P C' + R)^-1 C P F' + Q for many Q at once, (shares, n, n)."""
    # By doubling (Chu, Fan, Lin and Wang 2004, International Journal of Control 77): each step is
    # worth as many samples as all before.
    A, P = np.broadcast_to(F.T, Q.shape), Q
    G = np.broadcast_to(C.T @ np.linalg.solve(R, C), Q.shape)
    with np.errstate(all='ignore'):
        for _ in range(_DOUBLINGS):
            both = np.linalg.solve(np.eye(len(F)) + G @ P, np.concatenate((A, G), axis=2))
            left, right = both[:, :, :len(F)], both[:, :, len(F):]
            step = A.swapaxes(1, 2) @ P @ left
            G, P, A = G + A @ right @ A.swapaxes(1, 2), P + step, A @ left
            # Of every state by itself, for their units may differ.
            if np.all(np.einsum('kii->ki', step) <= _SETTLED * np.einsum('kii->ki', P)):
                break
    return P


def continuous_gain(A: Array, C: Array, update: Array, step: float) -> Array:
    """Return K whose predictor, innovations held for a step [s], updates states by `update` e."""
    K, size = update / step, float(np.linalg.norm(update))
    pace, left = 1.0, np.inf
    for _ in range(_FIXED_POINT if size > 0.0 else 0):
        mean = exponentials(A - K @ C, np.array([step]), 1)[1][0]
        rest = update - mean @ K
        before, left = left, float(np.linalg.norm(rest))
        if left < _SETTLED * size:
            break
        pace *= 1.0 if left < before else 0.5
        K = K + pace * np.linalg.solve(mean, rest)
        if not np.isfinite(K).all():
            raise np.linalg.LinAlgError('a predictor has no gain in continuous time')
    return K


def predicted_states(F: Array, L: Array, C: Array, v: Array, count: int) -> Array:
    """Return x_(k+1) = F x_k + L (v_k - C x_k), (N, n); the first is best for `count` samples."""
    closed = F - L @ C
    values, right = np.linalg.eig(closed) if np.isfinite(closed).all() else (
        np.full(len(F), np.inf), closed)
    if not np.max(np.abs(values), initial=0.0) <= 1.0:
        return np.full((len(v), len(F)), np.inf)
    driven = (np.linalg.inv(right) @ (L @ v.T)).astype(complex)
    first = np.zeros_like(driven)
    first[:, :1] = values[:, np.newaxis]
    free = _filtered(values.astype(complex), first)                      # (n, N)
    free[:, :1] = 1.0
    seen = C @ right
    rest = (v.T - (seen @ _filtered(values, driven)).real)[:, :count].ravel()
    columns = (seen[:, :, np.newaxis] * free[:, :count]).transpose(0, 2, 1).reshape(
        len(rest), len(F))
    x0 = np.linalg.lstsq(np.hstack((columns.real, -columns.imag)), rest, rcond=1e-9)[0]
    start = (x0[:len(values)] + 1j * x0[len(values):])[:, np.newaxis] * free
    return np.asarray((right @ (_filtered(values, driven) + start)).real.T)


def states_with_gaps(F: Array, L: Array, C: Array, v: Array, known: Mask, count: int) -> Array:
    """Return the same where v (N, ny) is not known everywhere: there nothing is corrected."""
    n = len(F)
    moves = np.where(known[:, np.newaxis, np.newaxis], F - L @ C, F)
    pushes = np.where(known[:, np.newaxis], v @ L.T, 0.0)
    rows, x0 = np.flatnonzero(known[:count]), np.zeros(n)
    if len(rows):
        first = np.pad(pushes[:count, :, np.newaxis], ((0, 0), (0, 0), (0, n)))
        states = led_through(moves[:count], first, np.eye(n, n + 1, k=1))[rows]
        told = C @ states[:, :, 1:]
        x0 = np.linalg.lstsq(told.reshape(-1, n), (v[rows] - states[:, :, 0] @ C.T).ravel(),
                             rcond=1e-9)[0]
    return led_through(moves, pushes[:, :, np.newaxis], x0[:, np.newaxis])[:, :, 0]


def _run(F: Array, G: Array, C: Array, K: Array, parts: Sequence[Array], weight: Array,
         effort: Effort, derivatives: bool = False) -> tuple[Array, Array, float] | None:
    """Return derivatives of -e by K, e (both over the errors' size), and its sum of squares."""
    # None if the predictor is unstable, or changes its sign from sample to sample: continuous in
    # time there is no such predictor.
    P = F - G @ K @ C
    values, right = np.linalg.eig(P)
    own = np.max(np.abs(np.linalg.eigvals(F)), initial=_LIMIT)
    if np.max(np.abs(values), initial=0.0) > own or np.linalg.cond(right) > 1e10 or \
            np.any((values.real < 0.0) & (values.imag == 0.0)):
        return None
    left = np.linalg.inv(right)
    rows, errors = [], []
    seen = C @ right                                                     # (ny, n)
    for v in parts:
        effort.check()
        driven = (left @ (G @ K @ v.T)).astype(complex)
        x = _filtered(values, driven)                                    # (n, N)
        e = v - (seen @ x).real.T
        errors.append(e * weight)
        if derivatives:
            effort.check()
            rows.append(_derivatives(values, left @ G, seen, e) * weight)
    error = np.concatenate([e.ravel() for e in errors])
    if not np.isfinite(error).all():
        return None
    flat = np.concatenate([r.swapaxes(1, 2).reshape(-1, r.shape[1]) for r in rows]) \
        if derivatives else np.empty((0, 0))
    return flat, error, float(error @ error)


def _filtered(values: ComplexArray, driven: ComplexArray) -> ComplexArray:
    """Return x_(k+1) = value x_k + driven_k from zero, (n, N)."""
    return chain(values[:, np.newaxis], driven[:, np.newaxis, :])[:, 0, :-1]


def _derivatives(values: ComplexArray, entry: ComplexArray, seen: ComplexArray, e: Array) -> Array:
    """Return d(C x) / dK, (N, n ny, ny): row by row of K."""
    n, ny = len(values), e.shape[1]
    driven = np.broadcast_to(e.T, (n, *e.T.shape)).astype(complex)
    modal = chain(values[:, np.newaxis], driven)[:, :, :-1].swapaxes(0, 1)     # (ny, n, N)
    # K[a, b] drives mode l by entry[l, a] e_b, and output i sees it by seen[i, l].
    found = np.einsum('il,la,blt->tabi', seen, entry, modal, optimize=True).real
    return np.asarray(found.reshape(len(e), n * ny, ny))


def with_noise(samples: Samples, fit: Fit, errors: Residuals,
               record: int) -> tuple[Matrices, Array]:
    """
    Return the matrices of a model with K, and the intensity of the innovations.

    Of a fit and the errors that it leaves; with the trim and the noise of a record.
    """
    m = matrices_of(fit.model, samples.size, record)
    step, parts = uniform(samples, errors)
    K, R = np.zeros_like(m.K), np.diag(fit.power[record] * samples.size ** 2)
    samples.effort.spend(gain_work(samples, len(m.A)))
    if len(m.A) and np.max(np.linalg.eigvals(m.A).real) < 0.0:
        with suppress(np.linalg.LinAlgError):       # none has a gain in continuous time: K is zero
            K, R = noise_gain(m.A, m.C, [v * samples.size for v in parts], step, samples.effort)
    return replace(m, K=K), R * step


def gain_work(samples: Samples, n: int) -> float:
    """Return the work of K for a model of n states (`effort.py`)."""
    return _WORK + _PER_NUMBER * n * float(samples.counts.sum())


def uniform(samples: Samples, errors: Residuals) -> tuple[float, list[Array]]:
    """Return the errors of all outputs at uniform instants, as coarse as the slowest output."""
    # Zero where there is no sample within half a step: one read twice would seem to tell the next.
    # Samples that came in bursts are read at a few times as many instants, not at all between.
    step, parts = max((cell(s.times) for r in samples.records for s in r.streams
                       if len(s.times) > 1), default=samples.interval), []
    for record, own in zip(samples.records, errors, strict=True):
        if not all(len(s.times) for s in record.streams):
            continue
        first = max(s.times[0] for s in record.streams)
        last = min(s.times[-1] for s in record.streams)
        t = first + step * np.arange(max(int((last - first) / step), 1))
        v = np.empty((len(t), samples.ny))
        for s, e in zip(record.streams, own, strict=True):
            nearest = np.clip(np.searchsorted(s.times, t - (0.5 + _SAME) * step), 0,
                              len(s.times) - 1)
            there = s.times[nearest] < t + (0.5 - _SAME) * step
            v[:, s.channels] = np.where(there[:, np.newaxis], e[nearest], 0.0)
        parts.append(v)
    return step, parts
