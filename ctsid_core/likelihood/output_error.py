# SPDX-License-Identifier: Apache-2.0
"""
Output error on the raw samples: the likelihood that decides.

Simulations from free initial states, with a trim, are compared with the output samples where they
are, each output with white noise of its own level. Poles and dead times move, of several outputs b
and initial states with them (Gauss-Newton, damped by what steps gain of what they promise), and
what is linear is solved for at every step (variable projection), so that poles and dead times are
all that a start needs.

References
----------
Ljung, System Identification, 2nd edition, sections 7.5 and 10.2; Golub and Pereyra 1973, SIAM J.
Numer. Anal. 10; Kaufman 1975, BIT 15; Nielsen 1999, IMM-REP-1999-05, Technical University of
Denmark (damping).
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.linalg.lapack import dgesv

from ctsid_core.likelihood.modal_model import ModalModel, PoleSteps, canonical, ranks_of
from ctsid_core.likelihood.mode_columns import ROUNDING, Columns, Triangle, columns_of
from ctsid_core.likelihood.samples import Residuals, Samples
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.types import Array, ComplexArray, Mask

_RANK = 1e-13         # relative singular value below which a linear direction is not determined
_LEAST_GAIN = 1e-4    # -2 log likelihood: a hundredth of a standard deviation
ROUGHLY = 0.3         # the same where models are only compared
LONGEST = 1.0         # largest change of the logarithm of a pole in one step
STEPS = 25            # of a climb, at most ...
_FEWER = 20           # ... and of a climb of a search
_DAMPING = 1e-2       # of the first step
_LEAST_DAMPING = 1e-9
_AT_BOUND = 1.0 - 1e-9


@dataclass(frozen=True)
class Free:
    """What is free in a model, and within which bounds."""

    feedthrough: bool         # whether D is
    trim: bool                # whether outputs have offsets
    delays: tuple[bool, ...]  # which of the nu dead times are
    longest: float            # of dead times [s]
    limit: float              # largest real part of a pole [rad/s]
    fastest: float            # largest magnitude of a pole [rad/s]

    def without(self, inputs: Container[int]) -> Free:
        """Return the same with the dead times of some inputs, by their places, held."""
        return replace(self, delays=tuple(
            late and j not in inputs for j, late in enumerate(self.delays)))


@dataclass(frozen=True, eq=False)
class Fit:
    """A model at given poles and dead times, everything linear at its best."""

    model: ModalModel
    columns: Columns  # of its poles and dead times
    power: Array      # (records, ny): mean square of the errors; outputs have size 1
    cost: float       # -2 log likelihood, up to a constant


Fitted = tuple[Samples, Fit, Free]     # samples, their best model, and what was free in it


class Guess(NamedTuple):
    """What a fit at other poles may start from."""

    model: ModalModel
    power: Array  # (records, ny): mean square of its errors, as far as it is known


def fit_at(samples: Samples, poles: ComplexArray, delay: Array, free: Free,
           near: Fit | Guess | None = None, columns: Columns | None = None,
           slopes: bool = True) -> Fit:
    """
    Return the best model with given poles (m,) [rad/s] and dead times (nu,) [s].

    A pole is there as often as its residue has ranks: equal ones move together. `near` is of
    nearly the same poles, in the same order: its b and initial states are the start where there
    are several inputs and outputs. `columns` are those of these poles and dead times,
    if they are known. Without `slopes` derivatives are left out, until a climb needs them.
    """
    poles = canonical(poles, samples.rank)
    columns = columns or columns_of(samples, poles, delay, direct=free.feedthrough, slopes=slopes)
    power = np.ones((len(samples.records), samples.ny)) if near is None else near.power
    if near is not None and (near.model.poles.imag > 0.0).tolist() == (poles.imag > 0.0).tolist():
        start = replace(near.model, poles=poles, delay=delay)
    else:
        start = free_start(samples, poles, delay, columns, free)
    return _solved(samples, start, columns, free, power)


def climb(samples: Samples, start: Fit, free: Free, *, steps: int = STEPS,
          rival: float = np.inf, least: float = _LEAST_GAIN) -> Fit:
    """
    Take a model to the maximum of the likelihood, by at most so many steps.

    Given up when neither five more steps like the last nor five times what the next one promises
    would reach the cost of a rival. `least` is the gain of -2 log likelihood that another step has
    to promise, and the last one to have brought.
    """
    best, damping, gain = _with_slopes(samples, start, free), _DAMPING, np.inf
    for taken in range(steps):
        if gain < least:
            break
        around = steps_around(samples, best.model)
        slopes = _slopes(samples, best, free, around)
        promise = slopes.promise(slopes.step(_LEAST_DAMPING))
        moved = None
        hope = max(_at_most(promise, samples), gain if taken else 0.0)
        if best.cost - 5.0 * hope > rival or promise < least:
            break
        for _ in range(6):
            step = slopes.step(damping)
            hoped = slopes.promise(step)
            trial = _moved(samples, best, step / slopes.scale, slopes.places, free, around)
            if trial is not None and trial.cost < best.cost:
                moved = trial
                break
            damping = max(damping, 10.0 * _LEAST_DAMPING) * 100.0
        if moved is None:
            break
        gain, best = best.cost - moved.cost, moved
        # Less, the more of what was hoped for the step has gained (Nielsen)
        damping = max(damping * max(0.1, 1.0 - (2.0 * (gain / hoped) - 1.0) ** 3), _LEAST_DAMPING)
        if samples.effort.over or np.all(best.power <= ROUNDING):
            break
    return best


def climb_roughly(samples: Samples, start: Fit, free: Free, rival: float = np.inf,
                  steps: int = _FEWER) -> Fit:
    """Take a model near the maximum of the likelihood, as far as it takes to compare it."""
    return climb(samples, start, free, steps=steps, least=ROUGHLY, rival=rival)


def steps_around(samples: Samples, model: ModalModel) -> PoleSteps:
    """Return how the poles of a model move."""
    return PoleSteps.of(model.poles, 1.0 / samples.length, samples.rank)


def _with_slopes(samples: Samples, fit: Fit, free: Free) -> Fit:
    """Return a fit with the derivatives of its columns."""
    return fit if fit.columns.layout.shape.slopes else replace(fit, columns=columns_of(
        samples, *fit.model.nonlinear, direct=free.feedthrough))


def _at_most(promise: float, samples: Samples) -> float:
    """Return -2 log likelihood of so much less power, as if all of it were of one output."""
    count = float(np.min(samples.counts[samples.counts > 0.0]))
    return -count * float(np.log(max(1.0 - promise / count, ROUNDING)))


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Where to move, all that is linear following at its best (variable projection)."""

    gradient: Array    # of what moves, over `scale`
    curvature: Array
    scale: Array       # size of each direction, infinite where it is that of something linear
    linear: float      # -2 log likelihood that is to be gained by what is linear alone
    places: Places

    def step(self, damping: float) -> Array:
        """Return the Gauss-Newton step over the inverse of `scale`, damped."""
        matrix = self.curvature.copy()
        matrix.ravel()[::len(matrix) + 1] += damping
        _, _, found, failed = dgesv(matrix.T, self.gradient, overwrite_a=1)
        if failed:
            raise np.linalg.LinAlgError('no step of Gauss-Newton: the curvature is singular')
        return np.asarray(found)

    def promise(self, step: Array) -> float:
        """Return the -2 log likelihood that a step gains, as far as slopes tell."""
        return float(step @ (2.0 * self.gradient - self.curvature @ step)) + self.linear


def _slopes(samples: Samples, fit: Fit, free: Free, around: PoleSteps) -> _Slopes:
    """Return where poles, dead times and, of several outputs, b and initial states should move."""
    samples.effort.check()
    model, (dp, late, places) = fit.model, _coordinates(samples, fit.model, free, around)
    n = places.moving
    curvature, gradient, squares, linear = _eliminated(samples, fit, free, around, n) \
        if samples.kernel is None else samples.kernel.slopes(
            fit.columns.layout, free.trim, fit.columns.values, model, fit.power, dp, late, n)
    scale = np.sqrt(curvature.diagonal())
    scale[~(scale > _RANK * np.sqrt(squares))] = np.inf
    scale[_held(model, free, gradient, places, around)] = np.inf
    return _Slopes(gradient / scale, curvature / scale / scale[:, np.newaxis], scale, linear,
                   places)


def _eliminated(samples: Samples, fit: Fit, free: Free, around: PoleSteps,
                n: int) -> tuple[Array, Array, Array, float]:
    """Return curvature and gradient of the first n numbers, the others at their best; and more."""
    # The squares of the derivatives, and what is to be gained by what is linear alone. That is
    # eliminated by a QR factorisation, not in the normal equations: beside a pole near zero an
    # offset, the free response and that to the mean of an input are alike to rounding there, and
    # damping would hold them, and with them the pole.
    rows, error, places = jacobian(samples, fit, free, around)
    several, width, linear = samples.ny > 1, rows.shape[1], 0.0
    moving = np.column_stack((rows[:, :n], error))
    rest, channels = moving.copy(), [range(s.channels.start, s.channels.stop)
                                     for r in samples.records for s in r.streams]
    output = np.repeat(np.concatenate(channels), np.repeat(
        fit.columns.layout.rows, [len(own) for own in channels]))
    for i in range(samples.ny):
        of_output, at = np.flatnonzero(output == i), n + i * places.own
        own = rows[of_output, at:at + places.own if several else width]
        if own.size:
            Q, R, _ = qr(own / (np.linalg.norm(own, axis=0) + 1e-300), mode='economic',
                         pivoting=True, check_finite=False)
            size = np.abs(R.diagonal())
            Q = Q[:, size > _RANK * size[:1]]
            told = Q.T @ moving[of_output]
            rest[of_output] -= Q @ told
            linear += float(told[:, n] @ told[:, n])
    slopes = rest[:, :n]
    return slopes.T @ slopes, slopes.T @ rest[:, n], np.sum(moving[:, :n] ** 2, axis=0), linear


def _coordinates(samples: Samples, model: ModalModel, free: Free,
                 around: PoleSteps | None) -> tuple[ComplexArray, NDArray[np.intp], Places]:
    """Return derivatives of modes by coordinates, inputs of free dead times, and places."""
    dp = np.zeros((0, len(model.poles)), complex) if around is None else around.derivatives()
    late, nu, n = np.flatnonzero(free.delays)[:None if around else 0], samples.nu, model.n
    records = len(samples.records)
    return dp, late, Places(len(dp), len(late), n * nu, n, n + nu * free.feedthrough
                            + records * free.trim, records * free.trim, records, samples.ny)


def _held(model: ModalModel, free: Free, gradient: Array, places: Places,
          around: PoleSteps) -> list[int]:
    """Return the places of real poles and dead times at a bound that would go beyond it."""
    delay = model.delay[list(free.delays)]
    ahead = gradient[places.poles:places.poles + places.delays]
    found = [places.poles + k for k, (g, d) in enumerate(
        zip(ahead.tolist(), delay.tolist(), strict=True))
        if (d <= 0.0 if g < 0.0 else d >= free.longest)]
    slow = [p.real >= free.limit for p in around.poles.tolist()]
    fast = [abs(p) >= free.fastest * _AT_BOUND for p in around.poles.tolist()]
    if any(slow) or any(fast):
        found += [k for k, one in around.single() if (slow if gradient[k] > 0.0 else fast)[one]]
    return found


def _moved(samples: Samples, fit: Fit, step: Array, places: Places, free: Free,
           around: PoleSteps) -> Fit | None:
    model = fit.model
    n, late = places.poles, np.array(free.delays)
    fraction = 1.0
    for _ in range(10):
        poles, modes = around.moved(fraction * step[:n], free.limit, free.fastest)
        if around.size_of(poles) <= LONGEST:
            break
        fraction *= 0.5
    delay = model.delay.copy()
    delay[late] = np.minimum(np.maximum(
        delay[late] + fraction * step[n:n + places.delays], 0.0), free.longest)
    if not np.isfinite(poles).all():
        return None
    if samples.rank > 1:
        whole = np.zeros(places.count)
        whole[:len(step)] = fraction * step
        model = _with_linear(model, whole, places, free)
        if len(modes) == len(model.poles):
            model = replace(model, b=model.b[modes], c=model.c[:, modes], x0=model.x0[:, modes])
    near = Guess(model, fit.power)
    try:
        return fit_at(samples, poles, delay, free, near)
    except np.linalg.LinAlgError:
        return None


@dataclass(frozen=True)
class Places:
    """How many numbers of each kind are free: columns of a Jacobian, in this order."""

    poles: int
    delays: int
    b: int
    x0: int          # of one record
    own: int         # of each output: c, D and trims
    trims: int       # among these
    records: int
    ny: int

    @property
    def count(self) -> int:
        """How many there are."""
        return self.poles + self.delays + self.b + self.records * self.x0 + self.ny * self.own

    @property
    def moving(self) -> int:
        """How many move together: of several outputs b and initial states, too."""
        return self.count - self.ny * self.own if self.ny > 1 else self.poles + self.delays

    def are(self, which: str) -> Mask:
        """Return which columns are of poles p, dead times d, b, states x, c, D or trims t."""
        own = 'c' * self.x0 + 'D' * (self.own - self.x0 - self.trims) + 't' * self.trims
        kinds = 'p' * self.poles + 'd' * self.delays + 'b' * self.b + 'x' * self.records * self.x0
        return np.isin(list(kinds + self.ny * own), list(which))


def _driving(model: ModalModel, record: int) -> ComplexArray:
    """Return what moves each mode: inputs and the initial state, (m, nu + 1)."""
    return np.concatenate((model.b, model.x0[record][:, np.newaxis]), axis=1)


def _real(responses: ComplexArray, poles: ComplexArray) -> Array:
    """Return the columns of real and, of pairs, imaginary parts of coefficients of responses."""
    first = int(np.sum(poles.imag == 0.0))
    found: Array = np.concatenate((responses.real, -responses[:, first:].imag), axis=1)
    return found.reshape(len(found), int(np.prod(found.shape[1:])))


def complex_of(rows: Array, poles: ComplexArray) -> ComplexArray:
    """Return complex coefficients of modes from real ones, all real parts before imaginary."""
    m = len(poles)
    found = rows[:m].astype(complex)
    found[2 * m - len(rows):].imag = rows[m:]
    return found


def _simulated(t: Triangle, model: ModalModel, record: int, driven: ComplexArray) -> Array:
    """Return the simulation of the outputs of a stream, given what drives each mode's response."""
    own = t.channels
    found: Array = (driven @ model.c[own].T).real + t.u @ model.D[own].T
    found += np.multiply.outer(t.one, model.y0[record, own])
    return found


def jacobian(samples: Samples, fit: Fit, free: Free, around: PoleSteps | None = None, *,
             moving: bool = True) -> tuple[Array, Array, Places]:
    """
    Return derivatives of the simulation over the noise, the errors over it, and places.

    Unless poles and dead times are `moving`, those by what is linear alone. `around`: how poles
    move, if that is known.
    """
    fit = _with_slopes(samples, fit, free) if moving else fit
    model, nu, ny, records = fit.model, samples.nu, samples.ny, len(samples.records)
    poles, n = model.poles, model.n
    dp, late, places = _coordinates(
        samples, model, free, (around or steps_around(samples, model)) if moving else None)
    if samples.kernel is not None:
        return *samples.kernel.jacobian(
            fit.columns.layout, free.trim, fit.columns.values, model, fit.power, dp, late,
            places.count), places
    count, own = places.count, places.own
    size = np.sqrt(np.maximum(fit.power, ROUNDING))
    blocks, errors = [], []
    for r, triangles in enumerate(fit.columns.triangles):
        driving = _driving(model, r)
        for t in triangles:
            driven = np.sum(t.z * driving, axis=2)
            of_c, direct = _real(driven, poles), _direct(t, free, r, records)
            error = t.y - _simulated(t, model, r, driven)
            slopes = np.sum(t.dz * driving, axis=2) if moving else driven[:0]
            for k, i in enumerate(t.channels):
                samples.effort.check()
                c = model.c[i]
                turned = t.z * c[:, np.newaxis]
                J = np.zeros((len(t.one), count))
                at = places.poles + places.delays
                if moving:
                    J[:, :places.poles] = (slopes @ (c * dp).T).real
                    J[:, places.poles:at] = _by_delay(t, model, i, fit.columns.first[r], late)
                J[:, at:at + places.b] = _real(turned[:, :, :nu], poles)
                at += places.b + r * places.x0
                J[:, at:at + places.x0] = _real(turned[:, :, nu:], poles)
                at = count - own * (ny - int(i))
                J[:, at:at + n] = of_c
                J[:, at + n:at + own] = direct
                blocks.append(J / size[r, i])
                errors.append(error[:, k] / size[r, i])
    return np.vstack(blocks), np.concatenate(errors), places


def _direct(t: Triangle, free: Free, record: int, records: int) -> Array:
    """Return the columns of an output's own D and trims, as far as they are free."""
    trims = np.zeros((len(t.one), records * free.trim))
    if free.trim:
        trims[:, record] = t.one
    return np.hstack((t.u, trims)) if free.feedthrough else trims


def _by_delay(t: Triangle, model: ModalModel, i: int, first: Array,
              late: NDArray[np.intp]) -> Array:
    """Return the derivatives by dead times: dz/dd = -(p z + b u) + b u(start) e^(p t), -D u'."""
    own = model.b[:, late] * model.c[i][:, np.newaxis]                      # (m, k)
    found: Array = (np.sum(t.z[:, :, -1:] * (own * first[late]), axis=1)
                    - np.sum(t.z[:, :, late] * (own * model.poles[:, np.newaxis]), axis=1)).real
    found -= t.u[:, late] * own.sum(axis=0).real + t.rates[:, late] * model.D[i, late]
    return found


def _with_linear(model: ModalModel, step: Array, places: Places, free: Free) -> ModalModel:
    """Return the model with all that is linear moved."""
    p, n, records = model.poles, model.n, len(model.x0)
    at = places.poles + places.delays + places.b
    end, direct = at + records * n, places.own - places.trims
    b, x0 = step[at - places.b:at].reshape(n, model.b.shape[1]), step[at:end].reshape(records, n)
    own = step[end:].reshape(len(model.c), places.own)
    return ModalModel(
        p, model.b + complex_of(b, p), model.c + complex_of(own[:, :n].T, p).T,
        model.x0 + complex_of(x0.T, p).T,
        model.D + own[:, n:direct].reshape(model.D.shape) if free.feedthrough else model.D,
        model.y0 + own[:, direct:].T if free.trim else model.y0, model.delay)


def free_start(samples: Samples, poles: ComplexArray, delay: Array, columns: Columns,
           free: Free) -> ModalModel:
    """Return the model whose residues are nearest to the best free ones, strongest ranks first."""
    m, nu, ny, records = len(poles), samples.nu, samples.ny, len(samples.records)
    start = ModalModel(poles, np.ones((m, nu), dtype=complex), np.ones((ny, m), dtype=complex),
                       np.zeros((records, m), dtype=complex), np.zeros((ny, nu)),
                       np.zeros((records, ny)), delay)
    if ny == 1:
        return start
    group, part = ranks_of(poles)
    # The size of the response of each mode to each input
    reach = np.sqrt(sum(np.sum(t.z[:, :, :-1].real ** 2, axis=0)
                        for own in columns.triangles for t in own)) + 1e-300
    residues, starts = _free_residues(samples, poles, columns, free)
    left, s, right = np.linalg.svd(residues * reach[part == 0, np.newaxis], full_matrices=False)
    c = left[group, :, part].T
    b = s[group, part, np.newaxis] * right[group, part] / reach
    x0 = np.einsum('im,rmi->rm', c.conj(), starts[:, group])
    real = poles.imag == 0.0
    c[:, real], b[real] = c[:, real].real, b[real].real
    x0[:, real] = x0[:, real].real
    return replace(start, b=b, c=c, x0=x0)


def _free_residues(samples: Samples, poles: ComplexArray, columns: Columns,
                   free: Free) -> tuple[ComplexArray, ComplexArray]:
    """Return residues (k, ny, nu) and free responses (records, k, ny) of any rank, poles once."""
    once = ranks_of(poles)[1] == 0
    poles, nu, ny, records = poles[once], samples.nu, samples.ny, len(samples.records)
    n = len(poles) + int(np.sum(poles.imag > 0.0))
    residues = np.zeros((len(poles), ny, nu), dtype=complex)
    starts = np.zeros((records, len(poles), ny), dtype=complex)
    for streams in zip(*columns.triangles, strict=True):
        design = np.vstack([np.hstack((
            _real(t.z[:, once, :nu], poles),
            np.kron(np.arange(records) == r, _real(t.z[:, once, nu:], poles)),
            _direct(t, free, r, records))) for r, t in enumerate(streams)])
        found = least_norm(design.T, np.vstack([t.y for t in streams]).T, _RANK)
        for i, theta in zip(streams[0].channels, found, strict=True):
            b, x0 = np.split(theta[:n * (nu + records)], (n * nu,))
            residues[:, i] = complex_of(b.reshape(n, nu), poles)
            starts[:, :, i] = complex_of(x0.reshape(records, n).T, poles).T
    return residues, starts


def _solve(samples: Samples, fit: Fit, free: Free, which: str) -> ModalModel:
    """Return the model with some of what is linear (`Places.are`) at its best, the rest held."""
    rows, error, places = jacobian(samples, fit, free, moving=False)
    step = np.zeros(rows.shape[1])
    own = places.are(which)
    step[own] = least_norm(rows[:, own].T, error[np.newaxis], _RANK)[0]
    return _with_linear(fit.model, step, places, free)


def _solved(samples: Samples, model: ModalModel, columns: Columns, free: Free,
            power: Array) -> Fit:
    """Return the model with b, c, D, initial states and trim at their best, one after another."""
    if samples.kernel is not None:
        model, power = samples.kernel.solve(columns.layout, free.trim, columns.values, model,
                                            power)
        return Fit(model, columns, power, _cost(samples, power))
    for _ in range(2):                  # the noise of outputs and records is known after one
        if samples.ny > 1:
            model = _solve(samples, Fit(model, columns, power, np.inf), free, 'cDt')
        model = _solve(samples, Fit(model, columns, power, np.inf), free, 'bxDt')
        old, power = power, _powers(samples, model, columns)
        if power.size == 1 or np.all(np.abs(np.log(power / old)) < 0.1):
            break
    return Fit(_normalised(model), columns, power, _cost(samples, power))


def _cost(samples: Samples, power: Array) -> float:
    """Return -2 log likelihood of errors of given power, up to a constant."""
    return float(np.sum(samples.counts * np.log(np.maximum(power, ROUNDING))))


def _powers(samples: Samples, model: ModalModel, columns: Columns) -> Array:
    power = np.ones((len(samples.records), samples.ny))
    for r, own in enumerate(errors_of(samples, model, columns)):
        for error, s in zip(own, samples.records[r].streams, strict=True):
            power[r, s.channels] = np.sum(error ** 2, axis=0) / max(len(s.times), 1) + 1e-300
    return power


def errors_of(samples: Samples, model: ModalModel, columns: Columns) -> Residuals:
    """
    Return measured less simulated outputs, or what their triangles keep of them.

    Of each record and stream, (rows, channels); columns are those of the model's poles and delays.
    """
    if samples.kernel is None:
        return tuple(tuple(t.y - _simulated(t, model, r, np.sum(t.z * _driving(model, r), axis=2))
                           for t in own) for r, own in enumerate(columns.triangles))
    values, at, found = samples.kernel.errors(columns.layout, columns.values, model), 0, []
    rows = iter(columns.layout.rows.tolist())
    for record in samples.records:
        own = []
        for s in record.streams:
            count, channels = next(rows), s.y.shape[1]
            own.append(values[at:at + count * channels].reshape(channels, count).T)
            at += count * channels
        found.append(tuple(own))
    return tuple(found)


def _normalised(model: ModalModel) -> ModalModel:
    """Return the same with b of size 1 (c of size 1 for one output)."""
    if len(model.c) == 1:
        return model
    size = np.linalg.norm(model.b, axis=1)
    size[~(size > 0.0)] = 1.0
    return replace(model, b=model.b / size[:, np.newaxis], x0=model.x0 / size, c=model.c * size)


def fit_states(samples: Samples, model: ModalModel, free: Free,
               columns: Columns | None = None) -> Fit:
    """
    Return a model as it is, with the initial states and the trim that suit the samples best.

    `columns` are those of its poles and dead times, if they are known.
    """
    columns = columns or columns_of(
        samples, *model.nonlinear, direct=free.feedthrough, slopes=False)
    power = np.ones((len(samples.records), samples.ny))
    model = replace(model, x0=np.zeros((len(power), len(model.poles)), dtype=complex),
                    y0=np.zeros_like(power))
    for _ in range(2):
        model = _solve(samples, Fit(model, columns, power, np.inf), free, 'xt')
        power = _powers(samples, model, columns)
    return Fit(model, columns, power, _cost(samples, power))
