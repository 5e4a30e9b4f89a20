# SPDX-License-Identifier: Apache-2.0
"""
One-step prediction errors of raw samples: the likelihood in closed loop.

Under feedback inputs carry the noise of the past, and only predictions that use nothing but the
past are free of bias. Lines fill a finite band, in which what is faster than the band, or runs
backwards in time, is not told from what acts at once: there the inverse of the controller, y =
-u / F, predicts y perfectly. On the samples themselves it does not.

For outputs sampled every h, with F = e^(A h) and a constant gain L,

    x_(k+1) = F x_k + (what inputs do, exactly) + L e_k,        e_k = y_k - C x_k - D u_k,

which is x = x^s + d, x^s any simulation (here the bounded one), and a filter of its residuals,

    d_(k+1) = (F - L C) d_k + L r_k,        e_k = r_k - C d_k,        r = y - y^s,   d_0 free.

Derivatives go the same way. -2 log likelihood is N log det of the covariance of e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from ctsid_core.linear.matrix_functions import Modes, modes
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.mode_sensitivity import output_sensitivities, steady_recursion
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Record, Signal

_UNEVEN = 0.02        # of an interval between outputs: more and the gain is not constant
_RANK = 1e-8
_HALVINGS = 6
_LEAST_GAIN = 1e-2    # -2 log likelihood
_CONDITION = 1e7      # of eigenvectors


@dataclass(frozen=True, eq=False)
class Samples:
    """
    What is predicted, and what from.

    Parameters
    ----------
    inputs : tuple of Signal
    times : ndarray, shape (N,)
        Uniform [s].
    y : ndarray, shape (N, ny)
    """

    inputs: tuple[Signal, ...]
    times: Array
    y: Array

    @property
    def step(self) -> float:
        """Between samples [s]."""
        return float((self.times[-1] - self.times[0]) / (len(self.times) - 1))


@dataclass(frozen=True, eq=False)
class Predictor:
    """
    A model, the gain of its predictor per sample, and the state it begins with.

    Parameters
    ----------
    model : StateSpace
        Its K does not matter.
    L : ndarray, shape (n, ny)
    start : ndarray, shape (n,)
        d_0.
    """

    model: StateSpace
    L: Array
    start: Array


def uniform_samples(record: Record) -> Samples | None:
    """Return the samples of a record, or None if its outputs are not uniform and simultaneous."""
    parts = [s.between(record.start, record.end, context=0) for s in record.outputs]
    times = parts[0].time
    if len(times) < 50 or any(not np.array_equal(p.time, times) for p in parts):
        return None
    intervals = np.diff(times)
    if np.max(np.abs(intervals / intervals.mean() - 1.0)) > _UNEVEN:
        return None
    return Samples(record.inputs, times, np.hstack([p.values for p in parts]))


def predictor(model: StateSpace, step: float) -> Predictor:
    """Return the predictor of uniform samples that a model with its K amounts to."""
    n = model.n
    joined = np.block([[model.A - model.K @ model.C, model.K],
                       [np.zeros((model.ny, n + model.ny))]])
    return Predictor(model, expm(joined * step)[:n, n:], np.zeros(n))


def continuous_gain(model: StateSpace, L: Array, step: float) -> Array:
    """Return the K of which `predictor` makes L, by fixed-point iteration; NaN if it fails."""
    K = L / step
    for _ in range(30):
        if not np.isfinite(K).all():
            return np.full_like(L, np.nan)
        held = predictor(replace(model, K=K), step).L
        K = K + (L - held) / step
    return K


def prediction_cost(samples: Samples, p: Predictor) -> float:
    """Return -2 log likelihood, up to a constant; infinite if the predictor is unstable."""
    found = _filtered(samples, p)
    return np.inf if found is None else _cost(found[0])


def settled(samples: Samples, p: Predictor) -> tuple[Predictor, float]:
    """Return the predictor with the state to begin with that suits the samples best, and cost."""
    found = _filtered(samples, p)
    if found is None:
        return p, np.inf
    n, e = p.model.n, found[0]
    closed = expm(p.model.A * samples.step) - p.L @ p.model.C
    moved = _follow(closed, np.zeros((len(e) - 1, n, n)), np.eye(n))
    if moved is None:
        return p, np.inf
    # Weighted by the errors of the second half, where what it began with is forgotten.
    size = np.sqrt(np.mean(e[len(e) // 2:] ** 2, axis=0)) + 1e-300
    effect = np.einsum('oi,kip->kop', p.model.C, moved)
    rows = (effect / size[:, np.newaxis]).reshape(-1, n)
    step = np.linalg.lstsq(rows, (e / size).ravel(), rcond=_RANK)[0]
    return replace(p, start=p.start + step), _cost(e - effect @ step)


def _cost(e: Array) -> float:
    sign, value = np.linalg.slogdet(e.T @ e / len(e))
    return float(len(e) * value) if sign > 0 and np.isfinite(value) else np.inf


def refine_in_time(samples: Samples, p: Predictor, *, feedthrough: bool, trim: bool,
                   steps: int = 12) -> tuple[Predictor, float]:
    """
    Take a predictor to the maximum of the samples' likelihood.

    Parameters
    ----------
    samples : Samples
    p : Predictor
    feedthrough, trim : bool
        Whether D, and the trim, are free.
    steps : int
        At most.

    Returns
    -------
    predictor : Predictor
    cost : float
        -2 log likelihood; infinite if the start is not admissible.
    """
    cost = prediction_cost(samples, p)
    for _ in range(steps):
        step = _step(samples, p, feedthrough, trim) if np.isfinite(cost) else None
        if step is None:
            break
        for halving in range(_HALVINGS):
            trial = _moved(p, step * 0.5 ** halving)
            new = np.inf if trial is None else prediction_cost(samples, trial)
            if trial is not None and new < cost:
                break
        else:
            break
        gain, p, cost = cost - new, trial, new
        if gain < _LEAST_GAIN:
            break
    return p, cost


def _filtered(samples: Samples, p: Predictor) -> tuple[Array, Array] | None:
    """Return e (N, ny) and d (N, n); None if the predictor is unstable or has no modes."""
    model = p.model
    if modes(model.A, _CONDITION) is None:
        return None
    simulated = output_sensitivities(model, np.zeros(model.n), samples.inputs, samples.times,
                                     derivatives=False)[0]
    residual = samples.y - simulated
    closed = expm(model.A * samples.step) - p.L @ model.C
    if not np.isfinite(residual).all() or not _stable(closed):
        return None
    d = _follow(closed, (residual[:-1] @ p.L.T)[:, :, np.newaxis], p.start[:, np.newaxis])
    if d is None:
        return None
    return residual - d[:, :, 0] @ model.C.T, d[:, :, 0]


def _stable(closed: Array) -> bool:
    return bool(np.isfinite(closed).all() and np.max(np.abs(np.linalg.eigvals(closed))) < 1.0)


def _follow(closed: Array, drive: Array, start: Array) -> Array | None:
    """Return x of x+ = closed x + drive for columns (N - 1, n, P), from (n, P)."""
    values, vectors = np.linalg.eig(closed)
    if not np.linalg.cond(vectors) < _CONDITION:
        return None
    inverse = np.linalg.inv(vectors)
    path = steady_recursion(values.astype(complex), (inverse @ drive).astype(complex),
                            (inverse @ start).astype(complex))
    found: Array = (vectors @ path).real
    return found


def slopes(samples: Samples, p: Predictor) -> tuple[Array, Array] | None:
    """
    Return the prediction errors and minus their derivatives.

    Returns
    -------
    e : ndarray, shape (N, ny)
    columns : ndarray, shape (N, ny, parameters)
        By the poles' real numbers, [B x_trim], C, [D y_trim], L and d_0; see
        `output_sensitivities`.
    """
    model, found = p.model, _filtered(samples, p)
    own = modes(model.A, _CONDITION)
    if found is None or own is None:
        return None
    e, d = found
    n, ny, N = model.n, model.ny, len(e)
    columns = output_sensitivities(model, np.zeros(n), samples.inputs, samples.times)[1]
    columns = np.delete(columns, np.s_[n:2 * n], axis=2)            # rest: d_0 stands for it
    C = n + n * (model.nu + 1)
    columns[:, :, C:C + ny * n] += np.einsum('op,ki->kopi', np.eye(ny), d).reshape(N, ny, -1)
    width = columns.shape[2]
    drive = np.zeros((N - 1, n, width + n * ny + n))
    drive[:, :, :width] = -np.einsum('io,kop->kip', p.L, columns[:-1])
    drive[:, :, :n] += _by_pole(own, d[:-1], samples.step)
    drive[:, :, width:width + n * ny] = np.einsum(
        'ij,ko->kijo', np.eye(n), e[:-1]).reshape(N - 1, n, -1)
    start = np.zeros((n, drive.shape[2]))
    start[:, -n:] = np.eye(n)
    moved = _follow(expm(model.A * samples.step) - p.L @ model.C, drive, start)
    if moved is None:
        return None
    out = np.einsum('oi,kip->kop', model.C, moved)
    out[:, :, :width] += columns
    return e, out


def _by_pole(own: Modes, d: Array, step: float) -> Array:
    """Return dF d by the poles' real numbers, (N, n, n)."""
    columns = []
    part = (d @ own.left.T) * (step * np.exp(own.values * step))
    for i, p in enumerate(own.values):
        change: ComplexArray = part[:, i, np.newaxis] * own.right[:, i]
        columns.append(change.real)
        if p.imag > 0.0:
            columns.append(-change.imag)
    return np.stack(columns, axis=2)


def _step(samples: Samples, p: Predictor, feedthrough: bool, trim: bool) -> Array | None:
    found = slopes(samples, p)
    if found is None:
        return None
    e, columns = found
    free = _free(p.model, feedthrough, trim, columns.shape[2])
    whiten = np.linalg.inv(np.linalg.cholesky(e.T @ e / len(e)))
    rows = np.einsum('ij,kjp->kip', whiten, columns[:, :, free]).reshape(-1, int(free.sum()))
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0.0] = 1.0
    target = (e @ whiten.T).ravel()
    if not (np.isfinite(rows).all() and np.isfinite(target).all()):
        return None
    step = np.zeros(len(free))
    step[free] = np.linalg.lstsq(rows / norm, target, rcond=_RANK)[0] / norm
    return step


def _free(model: StateSpace, feedthrough: bool, trim: bool, count: int) -> Array:
    n, nu, ny = model.n, model.nu, model.ny
    B, D = np.ones((n, nu + 1), dtype=bool), np.ones((ny, nu + 1), dtype=bool)
    B[:, -1], D[:, -1], D[:, :-1] = trim, trim, feedthrough
    parts = [np.ones(n, dtype=bool), B.ravel(), np.ones(ny * n, dtype=bool), D.ravel()]
    used = sum(map(len, parts))
    return np.concatenate([*parts, np.ones(count - used, dtype=bool)])


def _moved(p: Predictor, step: Array) -> Predictor | None:
    """Add a step to all parameters; poles move, their eigenvectors stay."""
    m, own = p.model, modes(p.model.A, _CONDITION)
    if own is None or not np.isfinite(step).all():
        return None
    n, nu, ny = m.n, m.nu, m.ny
    sizes = np.cumsum([n, n * (nu + 1), ny * n, ny * (nu + 1), n * ny])
    poles, B, C, D, L, start = np.split(step, sizes)
    values, at = own.values.copy(), 0
    for i, value in enumerate(own.values):
        values[i] += poles[at]
        at += 1
        if value.imag > 0.0:
            values[i] += 1j * poles[at]
            at += 1
    if (values.imag < 0.0).any():
        return None
    A = ((own.right * values) @ own.left).real
    B, D = B.reshape(n, -1), D.reshape(ny, -1)
    moved = replace(m, A=A, B=m.B + B[:, :-1], x_trim=m.x_trim + B[:, -1],
                    C=m.C + C.reshape(ny, n), D=m.D + D[:, :-1], y_trim=m.y_trim + D[:, -1])
    return Predictor(moved, p.L + L.reshape(n, ny), p.start + start)


def likeliest(samples: Samples, starts: Sequence[StateSpace], *, feedthrough: bool, trim: bool,
              few: int = 2, steps: int = 12) -> tuple[Predictor, float] | None:
    """
    Return the most likely predictor reached from the best of several models.

    Parameters
    ----------
    samples : Samples
    starts : sequence of StateSpace
        With their K.
    feedthrough, trim : bool
    few : int
        How many of them are refined.
    steps : int
        At most, of each.

    Returns
    -------
    predictor : Predictor
    cost : float
        -2 log likelihood. None if there is no admissible start.
    """
    made = [settled(samples, predictor(model, samples.step)) for model in starts]
    best = sorted((pair for pair in made if np.isfinite(pair[1])), key=lambda pair: pair[1])
    found = [refine_in_time(samples, p, feedthrough=feedthrough, trim=trim, steps=steps)
             for p, _ in best[:few]]
    return min(found, key=lambda pair: pair[1]) if found else None
