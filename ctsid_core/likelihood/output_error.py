# SPDX-License-Identifier: Apache-2.0
"""
Output error on the raw samples: the likelihood that decides.

Simulations from free initial states, with a trim, are compared with the output samples where they
are, each output with white noise of its own level. Poles, dead times, residues, initial states and
trim move together (Gauss-Newton, damped), and what is linear is solved for at every step (variable
projection), so that poles and dead times are all that a start needs.

References
----------
Ljung, System Identification, 2nd edition, sections 7.5 and 10.2; Golub and Pereyra 1973, SIAM J.
Numer. Anal. 10; Kaufman 1975, BIT 15.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.effort import Effort
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.mode_columns import Columns, Triangle, columns_of, weights
from ctsid_core.likelihood.pole_steps import PoleSteps, canonical
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.types import Array, ComplexArray

ROUNDING = 1e-24      # of an output's power: what is left of it is rounding
_RANK = 1e-13         # relative singular value below which a linear direction is not determined
_LEAST_GAIN = 1e-4    # -2 log likelihood: a smaller gain is not worth another step
_LONGEST = 1.0        # largest change of the logarithm of a pole in one step
_SPLIT = 1.05         # of a pole beside an equal one, over that
_OVERHEAD = 3e6       # operations that an evaluation of no samples takes the time of
_PER_RESPONSE = 1e3   # operations for each sample and response
_DAMPING = 1e-4       # of the first step


@dataclass(frozen=True)
class Free:
    """
    What is free in a model, and within which bounds.

    Parameters
    ----------
    feedthrough : bool
        Whether D is.
    trim : bool
        Whether outputs have offsets.
    delays : tuple of bool, length nu
        Which dead times are.
    longest : float
        Of dead times [s].
    limit : float
        Largest real part of a pole [rad/s].
    fastest : float
        Largest magnitude of a pole [rad/s].
    """

    feedthrough: bool
    trim: bool
    delays: tuple[bool, ...]
    longest: float
    limit: float
    fastest: float


@dataclass(frozen=True, eq=False)
class Fit:
    """
    A model at given poles and dead times, everything linear at its best.

    Parameters
    ----------
    model : ModalModel
    columns : tuple of Columns
        Of its poles and dead times.
    power : ndarray, shape (records, ny)
        Mean square of the errors; outputs have size 1.
    cost : float
        -2 log likelihood, up to a constant.
    """

    model: ModalModel
    columns: tuple[Columns, ...]
    power: Array
    cost: float


def fit_at(samples: Samples, poles: ComplexArray, delay: Array, free: Free,
           near: Fit | None = None) -> Fit:
    """
    Return the best model with given poles and dead times.

    Parameters
    ----------
    samples : Samples
    poles : ndarray, shape (m,)
        Real ones and one of each pair [rad/s].
    delay : ndarray, shape (nu,)
        [s]
    free : Free
    near : Fit, optional
        Of nearly the same poles, in the same order: its b and initial states are the start where
        there are several inputs and outputs.
    """
    poles = canonical(poles)
    columns = columns_of(samples, poles, delay)
    power = np.ones((len(columns), samples.ny)) if near is None else near.power
    kept = near is not None and len(near.model.poles) == len(poles) and \
        bool(np.array_equal(near.model.poles.imag > 0.0, poles.imag > 0.0))
    start = replace(near.model, poles=poles, delay=delay) if kept and near is not None else \
        _start(samples, poles, delay, columns, free, power)
    return _solved(samples, start, columns, free, power)


def climb(samples: Samples, start: Fit, free: Free, effort: Effort, *, steps: int = 100,
          rival: float = np.inf, least: float = _LEAST_GAIN) -> Fit:
    """
    Take a model to the maximum of the likelihood.

    Parameters
    ----------
    samples : Samples
    start : Fit
    free : Free
    effort : Effort
    steps : int
        At most.
    rival : float
        Cost of another model: given up when five more steps like the last would not reach it.
    least : float
        Gain below which another step is not worth it.
    """
    best, damping = start, _DAMPING
    work = evaluation_work(samples, len(start.model.poles))
    for _ in range(steps):
        rows, error, places = jacobian(samples, best, free)
        gradient, curvature = rows.T @ error, rows.T @ rows
        scale = np.sqrt(np.diag(curvature))
        scale[~(scale > 1e-150)] = 1.0
        curvature = curvature / np.outer(scale, scale)
        moved = None
        for _ in range(6):
            effort.check()
            effort.spend(work)
            step = np.linalg.solve(curvature + damping * np.eye(len(scale)), gradient / scale)
            step /= scale
            trial = _moved(samples, best, step, places, free)
            if trial is not None and trial.cost < best.cost:
                moved = trial
                break
            damping = max(damping, 1e-3) * 10.0
        if moved is None:
            break
        gain, best, damping = best.cost - moved.cost, moved, max(damping * 0.1, 1e-9)
        if gain < least or best.cost - 5.0 * gain > rival or effort.over:
            break
        if np.all(best.power <= ROUNDING):
            break
    return best


def evaluation_work(samples: Samples, modes: int) -> float:
    """Return the work of one evaluation, in operations (`effort.py`): measured, within 20 %."""
    count = sum(float(len(s.times)) for r in samples.records for s in r.streams)
    columns = 4.0 * modes * (samples.nu + 1) + samples.nu + samples.ny + 1
    return _OVERHEAD + count * (_PER_RESPONSE * modes * (samples.nu + 1) + 2.0 * columns ** 2)


def _moved(samples: Samples, fit: Fit, step: Array, places: Places, free: Free) -> Fit | None:
    model = fit.model
    around = PoleSteps.of(model.poles, 1.0 / samples.length, samples.several)
    n, late = places.poles, np.array(free.delays)
    fraction = 1.0
    for _ in range(10):
        poles = around.moved(fraction * step[:n], free.limit, free.fastest)
        if around.size_of(poles) <= _LONGEST:
            break
        fraction *= 0.5
    delay = model.delay.copy()
    delay[late] = np.clip(delay[late] + fraction * step[n:n + places.delays], 0.0, free.longest)
    if not np.isfinite(poles).all():
        return None
    near = fit
    if samples.several:
        near = replace(fit, model=_with_linear(model, fraction * step, places))
    try:
        return fit_at(samples, poles, delay, free, near)
    except np.linalg.LinAlgError:
        return None


@dataclass(frozen=True)
class Places:
    """How many numbers of each kind are free."""

    poles: int
    delays: int
    b: int
    x0: int          # of one record


def _templates(poles: ComplexArray, nu: int) -> tuple[ComplexArray, ComplexArray]:
    """Return unit changes of b and of one x0: (directions, m, nu + 1)."""
    m, pairs = len(poles), np.flatnonzero(poles.imag > 0.0)
    rows = [(i, 1.0) for i in range(m)] + [(int(i), 1j) for i in pairs]
    of_b = np.zeros((len(rows) * nu, m, nu + 1), dtype=complex)
    of_x = np.zeros((len(rows), m, nu + 1), dtype=complex)
    for k, (i, one) in enumerate(rows):
        of_x[k, i, nu] = one
        for j in range(nu):
            of_b[k * nu + j, i, j] = one
    return of_b, of_x


def _driving(model: ModalModel, record: int) -> ComplexArray:
    """Return what moves each mode: inputs and the initial state, (m, nu + 1)."""
    found: ComplexArray = np.concatenate((model.b, model.x0[record][:, np.newaxis]), axis=1)
    return found


def _c_units(poles: ComplexArray) -> ComplexArray:
    m, pairs = len(poles), np.flatnonzero(poles.imag > 0.0)
    units = np.zeros((m + len(pairs), m), dtype=complex)
    units[np.arange(m), np.arange(m)] = 1.0
    units[m + np.arange(len(pairs)), pairs] = 1j
    return units


def _direct_weights(poles: ComplexArray, nu: int, free: Free) -> Array:
    """Return the weights of D (if it is free) and of the trim, a row for each."""
    zero = np.zeros((nu + 1, len(poles), nu + 1), dtype=complex)
    of_u, of_one = np.zeros((nu + 1, nu)), np.zeros(nu + 1)
    of_u[:nu] = np.eye(nu)
    of_one[nu] = 1.0
    found = weights(poles, zero, None, of_u, of_one)
    return found[0 if free.feedthrough else nu:nu + free.trim]


def jacobian(samples: Samples, fit: Fit, free: Free) -> tuple[Array, Array, Places]:
    """Return derivatives of the simulation over the noise, the errors over it, and places."""
    model, nu, ny, records = fit.model, samples.nu, samples.ny, len(samples.records)
    poles = model.poles
    of_b, of_x = _templates(poles, nu)
    units, direct = _c_units(poles), _direct_weights(poles, nu, free)
    dp = PoleSteps.of(poles, 1.0 / samples.length, samples.several).derivatives()
    late = np.flatnonzero(free.delays)
    places = Places(len(dp), len(late), len(of_b), len(of_x))
    shared = places.poles + places.delays + places.b + records * places.x0
    nd = nu if free.feedthrough else 0
    own = len(units) + nd + records * free.trim
    size = np.sqrt(np.maximum(fit.power, ROUNDING))
    blocks, errors = [], []
    for r, columns in enumerate(fit.columns):
        driving = _driving(model, r)
        of_c = weights(poles, units[:, :, np.newaxis] * driving)
        for triangle in columns.triangles:
            for k, i in enumerate(triangle.channels):
                c = model.c[i]
                W = np.zeros((shared + own * ny, triangle.columns.shape[1]))
                W[:places.poles] = weights(
                    poles, np.zeros((len(dp), *driving.shape), dtype=complex),
                    dp[:, :, np.newaxis] * (c[:, np.newaxis] * driving))
                at = places.poles
                if len(late):
                    W[at:at + len(late)] = _by_delay(model, c, model.D[i], columns.first, late)
                    at += len(late)
                W[at:at + places.b] = weights(poles, of_b * c[:, np.newaxis])
                at += places.b + r * places.x0
                W[at:at + places.x0] = weights(poles, of_x * c[:, np.newaxis])
                at = shared + own * int(i)
                W[at:at + len(units)] = of_c
                W[at + len(units):at + len(units) + nd] = direct[:nd]
                if free.trim:
                    W[at + len(units) + nd + r] = direct[nd]
                blocks.append(triangle.columns @ W.T / size[r, i])
                w = _output_weights(model, r, int(i), driving)
                errors.append((triangle.y[:, k] - triangle.columns @ w) / size[r, i])
    return np.vstack(blocks), np.concatenate(errors), places


def _by_delay(model: ModalModel, c: ComplexArray, D: Array, first: Array,
              late: NDArray[np.intp]) -> Array:
    """Return the derivatives by dead times: dz/dd = -(p z + b u) + b u(start) e^(p t), -D u'."""
    m, nu = model.b.shape
    of_z = np.zeros((len(late), m, nu + 1), dtype=complex)
    of_u, of_rates = np.zeros((len(late), nu)), np.zeros((len(late), nu))
    for k, j in enumerate(late):
        gain = c * model.b[:, j]
        of_z[k, :, j] = -model.poles * gain
        of_z[k, :, nu] = first[j] * gain
        of_u[k, j], of_rates[k, j] = -gain.real.sum(), -D[j]
    return weights(model.poles, of_z, None, of_u, None, of_rates)


def _output_weights(model: ModalModel, record: int, i: int, driving: ComplexArray) -> Array:
    return weights(model.poles, model.c[i][:, np.newaxis] * driving, None, model.D[i],
                   np.asarray(model.y0[record, i]))


def _with_linear(model: ModalModel, step: Array, places: Places) -> ModalModel:
    """Return the model with b and initial states moved."""
    m, nu = model.b.shape
    pairs = np.flatnonzero(model.poles.imag > 0.0)
    at = places.poles + places.delays
    rows = step[at:at + places.b].reshape(-1, nu)
    b = model.b + rows[:m]
    b[pairs] += 1j * rows[m:]
    at += places.b
    x0 = model.x0.copy()
    for r in range(len(x0)):
        own = step[at + r * places.x0:at + (r + 1) * places.x0]
        x0[r] += own[:m]
        x0[r, pairs] += 1j * own[m:]
    return replace(model, b=b, x0=x0)


def _start(samples: Samples, poles: ComplexArray, delay: Array, columns: tuple[Columns, ...],
           free: Free, power: Array) -> ModalModel:
    """Return residues of rank one that are nearest to the best free ones."""
    m, nu, ny, records = len(poles), samples.nu, samples.ny, len(columns)
    c = np.ones((ny, m), dtype=complex)
    b, x0 = np.ones((m, nu), dtype=complex), np.zeros((records, m), dtype=complex)
    start = ModalModel(poles, b, c, x0, np.zeros((ny, nu)), np.zeros((records, ny)), delay)
    if ny == 1:
        return start
    residues, starts = _free_residues(samples, poles, columns, free, power)
    reach = _reach(columns, m, nu)
    left, s, right = np.linalg.svd(residues.transpose(1, 0, 2) * reach[:, np.newaxis],
                                   full_matrices=False)
    c = left[:, :, 0].T.copy()
    b = s[:, :1] * right[:, 0] / reach
    x0 = np.einsum('im,irm->rm', c.conj(), starts)
    real = poles.imag == 0.0
    c[:, real], b[real] = c[:, real].real, b[real].real
    x0[:, real] = x0[:, real].real
    return replace(start, b=b, c=c, x0=x0)


def _free_residues(samples: Samples, poles: ComplexArray, columns: tuple[Columns, ...],
                   free: Free, power: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return residues (ny, m, nu) and free responses (ny, records, m), of any rank."""
    m, nu, ny, records = len(poles), samples.nu, samples.ny, len(columns)
    of_b, of_x = _templates(poles, nu)
    fixed = np.vstack((weights(poles, of_b), _direct_weights(poles, nu, free)))
    free_x = weights(poles, of_x)
    residues = np.zeros((ny, m, nu), dtype=complex)
    starts = np.zeros((ny, records, m), dtype=complex)
    for i in range(ny):
        rows, targets = [], []
        for r, own in enumerate(columns):
            for t, k in _of_output(own, i):
                apart = np.zeros((len(t.columns), records * len(free_x)))
                apart[:, r * len(free_x):(r + 1) * len(free_x)] = t.columns @ free_x.T
                rows.append(np.hstack((t.columns @ fixed.T, apart)) / np.sqrt(power[r, i]))
                targets.append(t.y[:, k] / np.sqrt(power[r, i]))
        theta = _least_squares(np.vstack(rows), np.concatenate(targets))
        own_b = theta[:len(of_b)].reshape(-1, nu)
        residues[i] = own_b[:m]
        pairs = np.flatnonzero(poles.imag > 0.0)
        residues[i][pairs] += 1j * own_b[m:]
        for r in range(records):
            x = theta[len(fixed) + r * len(free_x):][:len(free_x)]
            starts[i, r] = x[:m]
            starts[i, r, pairs] += 1j * x[m:]
    return residues, starts


def split(samples: Samples, fit: Fit, free: Free) -> Fit | None:
    """
    Return a start with one more real pole, beside one that does the work of two.

    With several inputs and outputs one pole may be there several times (roll and pitch of a
    symmetric vehicle), each with a residue of rank one: what is left shows the next one.
    """
    model = fit.model
    if not (model.poles.imag == 0.0).any():
        return None
    best = max((_residue_of_rest(samples, fit, free, int(k))
                for k in np.flatnonzero(model.poles.imag == 0.0)), key=lambda found: found[0])
    _, k, c, b, x0 = best
    poles = np.append(model.poles, model.poles[k] * _SPLIT)
    order = [int(i) for i in np.argsort([np.argmin(np.abs(canonical(poles) - p)) for p in poles])]
    joined = replace(
        model, poles=poles[order], b=np.vstack((model.b, b.astype(complex)))[order],
        c=np.column_stack((model.c, c.astype(complex)))[:, order],
        x0=np.column_stack((model.x0, x0.astype(complex)))[:, order])
    return fit_at(samples, joined.poles, model.delay, free, replace(fit, model=joined))


def _residue_of_rest(samples: Samples, fit: Fit, free: Free,
                     k: int) -> tuple[float, int, Array, Array, Array]:
    """Return what one more mode at a real pole would do to the errors: size, k, c, b, x0."""
    model, nu, ny = fit.model, samples.nu, samples.ny
    m, records = len(model.poles), len(fit.columns)
    unit = np.zeros((nu + 1, m, nu + 1), dtype=complex)
    unit[np.arange(nu + 1), k, np.arange(nu + 1)] = 1.0
    wanted = weights(model.poles, unit)
    reach = _reach(fit.columns, m, nu)[k]
    residue, x0 = np.zeros((ny, nu)), np.zeros((ny, records))
    for i in range(ny):
        rows, errors = [], []
        for r, own in enumerate(fit.columns):
            w = _output_weights(model, r, i, _driving(model, r))
            for t, place in _of_output(own, i):
                both = t.columns @ wanted.T
                apart = np.zeros((len(both), records))
                apart[:, r] = both[:, nu]
                size = np.sqrt(fit.power[r, i]) + 1e-300
                rows.append(np.hstack((both[:, :nu], apart)) / size)
                errors.append((t.y[:, place] - t.columns @ w) / size)
        theta = _least_squares(np.vstack(rows), np.concatenate(errors))
        residue[i], x0[i] = theta[:nu], theta[nu:]
    scale = np.sqrt(fit.power.mean(axis=0))[:, np.newaxis] + 1e-300
    left, s, right = np.linalg.svd(residue * reach / scale, full_matrices=False)
    c = left[:, 0] * scale[:, 0]
    return float(s[0]), k, c, s[0] * right[0] / reach, c @ x0 / float(c @ c)


def _reach(columns: tuple[Columns, ...], m: int, nu: int) -> Array:
    """Return the size of the response of each mode to each input, (m, nu)."""
    total = np.zeros(m * (nu + 1))
    for own in columns:
        for t in own.triangles:
            total += np.sum(t.columns[:, :len(total)] ** 2, axis=0)
    return np.sqrt(total.reshape(m, nu + 1)[:, :nu]) + 1e-300


def _of_output(columns: Columns, i: int) -> list[tuple[Triangle, int]]:
    return [(t, int(np.flatnonzero(t.channels == i)[0])) for t in columns.triangles
            if i in t.channels]


def _least_squares(rows: Array, target: Array) -> Array:
    found: Array = least_norm(rows.T, target[np.newaxis], _RANK)[0]
    return found


def _solved(samples: Samples, model: ModalModel, columns: tuple[Columns, ...], free: Free,
            power: Array) -> Fit:
    """Return the model with b, c, D, initial states and trim at their best, one after another."""
    for _ in range(2):                  # the noise of outputs and records is known after one
        if samples.ny > 1:
            model = _solve_c(samples, model, columns, free, power)
        model = _solve_b(samples, model, columns, free, power)
        old, power = power, _powers(samples, model, columns)
        if power.size == 1 or np.all(np.abs(np.log(power / old)) < 0.1):
            break
    return Fit(_normalised(model), columns, power, _cost(samples, power))


def _cost(samples: Samples, power: Array) -> float:
    """Return -2 log likelihood of errors of given power, up to a constant."""
    return float(np.sum(samples.counts * np.log(np.maximum(power, ROUNDING))))


def _powers(samples: Samples, model: ModalModel, columns: tuple[Columns, ...]) -> Array:
    power = np.ones((len(columns), samples.ny))
    for r, own in enumerate(columns):
        driving = _driving(model, r)
        for t in own.triangles:
            for k, i in enumerate(t.channels):
                error = t.y[:, k] - t.columns @ _output_weights(model, r, int(i), driving)
                power[r, i] = float(error @ error) / max(t.count, 1) + 1e-300
    return power


def _solve_c(samples: Samples, model: ModalModel, columns: tuple[Columns, ...], free: Free,
             power: Array) -> ModalModel:
    poles, nu, records = model.poles, samples.nu, len(columns)
    units, direct = _c_units(poles), _direct_weights(poles, nu, free)
    nd, m = (nu if free.feedthrough else 0), len(poles)
    c, D, y0 = model.c.copy(), model.D.copy(), model.y0.copy()
    pairs = np.flatnonzero(poles.imag > 0.0)
    designs = [weights(poles, units[:, :, np.newaxis] * _driving(model, r))
               for r in range(records)]
    for i in range(samples.ny):
        rows, targets = [], []
        for r, own in enumerate(columns):
            for t, k in _of_output(own, i):
                trim = np.zeros((len(t.columns), records * free.trim))
                if free.trim:
                    trim[:, r] = t.columns @ direct[nd]
                rows.append(np.hstack((t.columns @ designs[r].T, t.columns @ direct[:nd].T, trim))
                            / np.sqrt(power[r, i]))
                targets.append(t.y[:, k] / np.sqrt(power[r, i]))
        theta = _least_squares(np.vstack(rows), np.concatenate(targets))
        c[i] = theta[:m]
        c[i, pairs] += 1j * theta[m:len(units)]
        D[i] = theta[len(units):len(units) + nd] if nd else D[i]
        if free.trim:
            y0[:, i] = theta[len(units) + nd:]
    return replace(model, c=c, D=D, y0=y0)


def _solve_b(samples: Samples, model: ModalModel, columns: tuple[Columns, ...], free: Free,
             power: Array) -> ModalModel:
    poles, nu, ny, records = model.poles, samples.nu, samples.ny, len(columns)
    of_b, of_x = _templates(poles, nu)
    direct = _direct_weights(poles, nu, free)
    nd, m, pairs = (nu if free.feedthrough else 0), len(poles), np.flatnonzero(poles.imag > 0.0)
    nb, nx = len(of_b), len(of_x)
    own_of_output = nd + records * free.trim
    rows, targets = [], []
    for r, own in enumerate(columns):
        for t in own.triangles:
            for k, i in enumerate(t.channels):
                c = model.c[i][:, np.newaxis]
                block = np.zeros((len(t.columns), nb + records * nx + ny * own_of_output))
                block[:, :nb] = t.columns @ weights(poles, of_b * c).T
                block[:, nb + r * nx:nb + (r + 1) * nx] = t.columns @ weights(poles, of_x * c).T
                at = nb + records * nx + int(i) * own_of_output
                block[:, at:at + nd] = t.columns @ direct[:nd].T
                if free.trim:
                    block[:, at + nd + r] = t.columns @ direct[nd]
                rows.append(block / np.sqrt(power[r, i]))
                targets.append(t.y[:, k] / np.sqrt(power[r, i]))
    theta = _least_squares(np.vstack(rows), np.concatenate(targets))
    of_rows = theta[:nb].reshape(-1, nu)
    b = of_rows[:m].astype(complex)
    b[pairs] += 1j * of_rows[m:]
    x0, D, y0 = np.zeros_like(model.x0), np.zeros_like(model.D), np.zeros_like(model.y0)
    for r in range(records):
        own_x = theta[nb + r * nx:nb + (r + 1) * nx]
        x0[r] = own_x[:m]
        x0[r, pairs] += 1j * own_x[m:]
    for i in range(ny):
        at = nb + records * nx + i * own_of_output
        D[i] = theta[at:at + nd] if nd else 0.0
        if free.trim:
            y0[:, i] = theta[at + nd:at + own_of_output]
    return replace(model, b=b, x0=x0, D=D, y0=y0)


def _normalised(model: ModalModel) -> ModalModel:
    """Return the same with b of size 1 (c of size 1 for one output)."""
    if len(model.c) == 1:
        return model
    size = np.linalg.norm(model.b, axis=1)
    size[~(size > 0.0)] = 1.0
    return replace(model, b=model.b / size[:, np.newaxis], x0=model.x0 / size,
                   c=model.c * size)


def fit_states(samples: Samples, model: ModalModel, free: Free) -> Fit:
    """Return a model as it is, with the initial states and the trim that suit the samples best."""
    columns = columns_of(samples, model.poles, model.delay)
    power = np.ones((len(columns), samples.ny))
    if len(model.x0) != len(columns):
        model = replace(model, x0=np.zeros((len(columns), len(model.poles)), dtype=complex),
                        y0=np.zeros((len(columns), samples.ny)))
    for _ in range(2):
        model = _solve_states(samples, model, columns, free, power)
        power = _powers(samples, model, columns)
    return Fit(model, columns, power, _cost(samples, power))


def _solve_states(samples: Samples, model: ModalModel, columns: tuple[Columns, ...], free: Free,
                  power: Array) -> ModalModel:
    poles, ny, m = model.poles, samples.ny, len(model.poles)
    pairs = np.flatnonzero(poles.imag > 0.0)
    _, of_x = _templates(poles, samples.nu)
    nx = len(of_x)
    x0, y0 = np.zeros_like(model.x0), np.zeros_like(model.y0)
    one = weights(poles, np.zeros((m, samples.nu + 1), dtype=complex), None,
                  np.zeros(samples.nu), np.ones(()))
    for r, own in enumerate(columns):
        still = replace(model, x0=x0, y0=y0)
        driving = _driving(still, r)
        rows, targets = [], []
        for t in own.triangles:
            for k, i in enumerate(t.channels):
                block = np.zeros((len(t.columns), nx + ny * free.trim))
                block[:, :nx] = t.columns @ weights(poles, of_x * model.c[i][:, np.newaxis]).T
                if free.trim:
                    block[:, nx + i] = t.columns @ one
                size = np.sqrt(power[r, i])
                rows.append(block / size)
                targets.append((t.y[:, k] - t.columns @ _output_weights(
                    still, r, int(i), driving)) / size)
        theta = _least_squares(np.vstack(rows), np.concatenate(targets))
        x0[r] = theta[:m]
        x0[r, pairs] += 1j * theta[m:nx]
        if free.trim:
            y0[r] = theta[nx:]
    return replace(model, x0=x0, y0=y0)
