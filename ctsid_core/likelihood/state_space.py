# SPDX-License-Identifier: Apache-2.0
"""A modal model as real matrices, and the covariance of these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ctsid_core.likelihood.modal_model import ModalModel, PoleSteps
from ctsid_core.likelihood.mode_columns import ROUNDING, columns_of
from ctsid_core.likelihood.output_error import (
    Fit,
    Free,
    climb_roughly,
    complex_of,
    fit_at,
    jacobian,
    steps_around,
)
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.least_squares import orthonormal
from ctsid_core.linear.matrix_functions import CONDITION_LIMIT, modes
from ctsid_core.linear.types import Array, ComplexArray, Matrices
from ctsid_core.model.covariance import Entries
from ctsid_core.signals.record import Signal, placed

_MET = 0.03           # relative distance of two poles below which they share a block
GAUGE = 1e-7          # relative singular value below which a direction changes nothing
_SAME = 1e-12         # ... below which two columns are the same
_SPARE = 0.05         # share of the errors' power that a fit leaves at least
_BEGUN = 1e-6         # of a sample interval: just after 0
_WORK = 2.0           # of a covariance, for each sample and pair of numbers


def matrices_of(model: ModalModel, size: Array, record: int = 0) -> Matrices:
    """
    Return the matrices of a modal model, of outputs that were divided by their size (ny,).

    Trim and the state at the start are those of a record.
    """
    pairs = np.flatnonzero(model.poles.imag > 0.0)
    A, B, C = _modal(model.poles, model.b, model.c * size[:, np.newaxis], pairs)
    T = _mended(model)
    inverse = np.linalg.inv(T)
    n, ny = len(A), len(C)
    x0 = np.concatenate((model.x0[record].real, model.x0[record, pairs].imag))
    return Matrices(A=T @ A @ inverse, B=T @ B, C=C @ inverse, D=model.D * size[:, np.newaxis],
                    K=np.zeros((n, ny)), start=T @ x0, x_trim=np.zeros(n),
                    y_trim=model.y0[record] * size)


def modal_of(m: Matrices, samples: Samples, delay: Array,
             condition_limit: float = CONDITION_LIMIT) -> ModalModel | None:
    """
    Return the modal model of matrices, at rest and without trim, with dead times (nu,) [s].

    Outputs are over their size in the samples. None if the eigenvectors' condition is beyond the
    limit.
    """
    found = modes(m.A, condition_limit)
    if found is None:
        return None
    order = np.argsort(found.values.imag > 0.0, kind='stable')             # pairs after real poles
    size, records = samples.size[:, np.newaxis], len(samples.records)
    return ModalModel(found.values[order], (found.left @ m.B)[order],
                      (m.C @ found.right)[:, order] / size,
                      np.zeros((records, len(order)), dtype=complex), m.D / size,
                      np.zeros((records, samples.ny)), delay)


def _modal(poles: ComplexArray, b: ComplexArray, c: ComplexArray,
           pairs: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Return A, B and C of real modal states: Re z of all modes, then Im z of pairs."""
    m = poles.shape[-1]
    own, second = np.arange(m), m + np.arange(len(pairs))
    A = np.zeros((*poles.shape[:-1], m + len(pairs), m + len(pairs)))
    A[..., own, own], A[..., second, second] = poles.real, poles[..., pairs].real
    A[..., pairs, second], A[..., second, pairs] = -poles[..., pairs].imag, poles[..., pairs].imag
    return (A, np.concatenate((b.real, b[..., pairs, :].imag), axis=-2),
            np.concatenate((c.real, -c[..., pairs].imag), axis=-1))


def _mended(model: ModalModel) -> Array:
    """Return T that keeps entries moderate where two poles nearly meet."""
    poles, n, m = model.poles, model.n, len(model.poles)
    T, single = np.eye(n), len(model.c) == 1
    for k, i in enumerate(np.flatnonzero(poles.imag > 0.0)):
        w = poles[i].imag
        if w < _MET * abs(poles[i]):
            T[m + k, m + k] = w if single else 1.0 / w
    if min(len(model.c), model.b.shape[1]) > 1:     # of different residues: these stay apart
        return T
    for one, other in PoleSteps.of(poles, 0.0).factors:
        if other < 0 or abs(poles[one] - poles[other]) > _MET * abs(poles[one]):
            continue
        gap = (poles[one] - poles[other]).real
        block = np.array([[1.0, 1.0], [gap, 0.0]]) if single else \
            np.array([[1.0 / gap, -1.0 / gap], [0.0, 1.0]])
        T[np.ix_([one, other], [one, other])] = block
    return T


def entry_changes(samples: Samples, fit: Fit, free: Free, *, far: bool = False,
                  like: ModalModel | None = None) -> Entries:
    """
    Return the root of the covariance of A, B, C, D and dead times, a row for each direction.

    What is unsure of dead times tells the curvature of the likelihood, or its rise `far` from its
    maximum. The states are those of a model `like` it, which may have fewer inputs.

    With J the derivatives of the simulation and S the spectrum of the errors, the covariance is
    (J'J)^-1 (J' S J) (J'J)^-1: noise counts at the frequencies at which it is, and so does what
    the model leaves of the plant (Ljung, System Identification, 2nd edition, (9.55)). The fit is
    at the maximum of the likelihood.
    """
    model = fit.model
    near = _after_0(samples, fit, free)
    rows, error, places = jacobian(samples, near, free)
    width = rows.shape[1]
    samples.effort.spend(covariance_work(samples, model.n))
    one = 'c' if samples.ny == 1 else 'b' if samples.nu == 1 else ''      # it is 1 then
    nuisance, wanted = places.are('xt'), ~places.are('xt' + one)
    apart = orthonormal(rows[:, nuisance], _SAME)
    basis = rows[:, nuisance] @ apart
    moving = rows[:, wanted]
    moving = moving - basis @ (basis.T @ moving)
    moving = np.vstack((moving, _late(samples, fit, free, moving, places.poles, far)))
    turned = orthonormal(moving, GAUGE).T
    directions = np.zeros((width, apart.shape[1] + len(turned)))
    directions[nuisance, :apart.shape[1]] = apart
    directions[wanted, apart.shape[1]:] = turned.T
    directions[nuisance, apart.shape[1]:] = -apart @ (basis.T @ rows[:, wanted] @ turned.T)
    known = moving[len(rows):] @ turned.T
    power = known.T @ known + _noise_power(samples, near, free, directions)[
        apart.shape[1]:, apart.shape[1]:]
    values, vectors = np.linalg.eigh(power)
    root = np.zeros((len(turned), width))
    root[:, wanted] = (vectors * np.sqrt(np.maximum(values, 0.0))).T @ turned
    late = slice(places.poles, places.poles + places.delays)
    if not free.feedthrough and places.delays:
        now = model.delay[list(free.delays)]
        moved = now + turned[:, late].T @ (turned @ (moving[:len(rows)].T @ error))
        # Nor does another one go below 0 for the sake of one that goes ahead.
        weight = np.linalg.pinv(turned[:, late]).T
        step = nnls(weight, weight @ moved)[0] - now
        white, own = (np.linalg.norm(part[:, late], axis=0) for part in (turned, root))
        times = _times(samples, fit, free, white, step / np.where(own > 0.0, own, np.inf), far)
        root += root[:, late] * (times - 1.0) @ np.linalg.pinv(root[:, late]) @ root
    if free.feedthrough:
        alike = np.zeros((places.delays, width))
        alike[:, late] = np.diag(                                           # anywhere in both
            _read_alike(samples, fit)[list(free.delays)] / np.sqrt(6.0))
        root = np.vstack((root, alike))
    steps = steps_around(samples, model).derivatives()
    nu, ny, pairs = samples.nu, samples.ny, np.flatnonzero(model.poles.imag > 0.0)
    n, r = model.n, len(root)
    dp = root[:, :places.poles] @ steps
    delay = np.zeros((r, nu))
    delay[:, np.flatnonzero(free.delays)] = root[:, late]
    at = late.stop
    db = complex_of(root[:, at:at + places.b].reshape(r, -1, nu).swapaxes(0, 1),
                    model.poles).swapaxes(0, 1)
    at += places.b + len(samples.records) * places.x0
    own = root[:, at:at + ny * places.own].reshape(r, ny, places.own)
    dc = complex_of(own[:, :, :n].transpose(2, 0, 1), model.poles).transpose(1, 2, 0)
    dD = own[:, :, n:n + nu] if free.feedthrough else np.zeros((r, ny, nu))
    T = _mended(like or model)
    inverse = np.linalg.inv(T)
    A, B, C = _modal(dp, db, dc, pairs)
    return Entries(T @ A @ inverse, T @ B, (C * samples.size[:, np.newaxis]) @ inverse,
                   dD * samples.size[:, np.newaxis], delay)


def covariance_work(samples: Samples, n: int) -> float:
    """Return the work of the covariance of a model of n states (`effort.py`)."""
    width = n * (1 + samples.nu + samples.ny + len(samples.records))
    return _WORK * float(samples.counts.sum()) * width ** 2


def _noise_power(samples: Samples, fit: Fit, free: Free, directions: Array) -> Array:
    """Return the covariance of the errors' sums over orthonormal directions of the simulation."""
    # Of outputs that are sampled together with what they share.
    whole = replace(fit, columns=columns_of(
        samples, *fit.model.nonlinear, direct=free.feedthrough, turned=False))
    rows, errors, _ = jacobian(samples, whole, free)
    found, at = np.zeros((directions.shape[1],) * 2), 0
    for own in whole.columns.triangles:
        for t in own:
            samples.effort.check()
            count, channels = len(t.one), len(t.channels)
            if not count:
                continue
            block = slice(at, at + channels * count)
            at = block.stop
            noise = errors[block].reshape(channels, count)
            seen = np.empty((count // 2 + 1, channels, len(found)), dtype=complex)
            for k, channel in enumerate(np.split(rows[block], channels)):
                samples.effort.check()
                seen[:, k] = np.fft.rfft(channel @ directions, axis=0)
            samples.effort.check()
            both: Array = np.where(np.arange(len(seen)) % (0.5 * count), 2.0, 1.0)
            root = _root_of_spectra(seen @ _turned(seen) / count, np.fft.rfft(
                noise, axis=1).T / count, both, samples.effort.check)
            samples.effort.check()
            moved = root @ seen
            for part in (moved.real, moved.imag):
                samples.effort.check()
                part = part.reshape(-1, part.shape[2])
                found += part.T @ part
    return found


def _root_of_spectra(taken: ComplexArray, noise: ComplexArray, both: Array,
                     check: Callable[[], None]) -> ComplexArray:
    """Return roots of the spectra of errors (frequencies, outputs) over both half-planes."""
    # A spectrum is a mean over as many neighbouring frequencies as can be without error by the
    # fit, and more: what directions have `taken` out of it, (frequencies, outputs, outputs), is
    # allowed for.
    check()
    numbers = both @ np.einsum('fii->fi', taken).real
    reach = min(int(np.ceil(np.max(numbers))), len(taken) - 1)
    values, turn = np.linalg.eigh(mean_around(np.eye(taken.shape[1]) - taken, reach))
    less = (turn / np.sqrt(np.maximum(values, _SPARE))[:, np.newaxis]) @ _turned(turn)
    check()
    noise = noise[:, :, np.newaxis]
    power, turn = np.linalg.eigh(less @ mean_around(noise @ _turned(noise), reach) @ less)
    size = np.sqrt(both[:, np.newaxis] * np.maximum(power, 0.0))
    return np.asarray(size[:, :, np.newaxis] * _turned(turn))


def _turned(matrices: ComplexArray) -> ComplexArray:
    """Return the conjugate transposes of matrices."""
    return matrices.conj().swapaxes(1, 2)


def mean_around(values: NDArray[Any], reach: int,
                kind: Literal['even', 'odd'] = 'even') -> NDArray[Any]:
    """Return means over so many neighbours along the first axis, mirrored at its ends."""
    ends = [(0, 0)] * (values.ndim - 1)
    around = np.pad(values, [(reach, reach), *ends], mode='reflect', reflect_type=kind)
    total = np.cumsum(np.pad(around, [(1, 0), *ends]), axis=0)
    return np.asarray((total[2 * reach + 1:] - total[:-2 * reach - 1]) / (2 * reach + 1))


def _late(samples: Samples, fit: Fit, free: Free, moving: Array, at: int, far: bool) -> Array:
    """Return rows that say what is known of dead times beyond the first order, (delays, k)."""
    # A zero of the plant may stand in for a small change of dead time, to first order exactly if a
    # held input is sampled with the outputs; a larger change the samples do show. `moving` (N, k)
    # has what columns of dead times, from `at` on, and all others move.
    places = [j for j, late in enumerate(free.delays) if late]
    found = np.zeros((len(places), moving.shape[1]))
    for k, j in enumerate(places):
        others = np.delete(moving, at + k, axis=1)
        left = moving[:, at + k] - others @ np.linalg.lstsq(others, moving[:, at + k], None)[0]
        first = float(left @ left)
        if first * samples.interval ** 2 < 1.0:
            shown = _shown(samples, fit, free, j, samples.interval, far)
            found[k, at + k] = np.sqrt(max(shown ** -2 - first, 0.0))
    return found


def _after_0(samples: Samples, fit: Fit, free: Free) -> Fit:
    """Return the same where dead times that are 0 and free have just begun."""
    # At 0 a held input has jumped where a sample is of the same instant; after 0 it has not.
    model, late = fit.model, np.array(free.delays) & (fit.model.delay == 0.0)
    if not late.any():
        return fit
    model = replace(model, delay=np.where(late, _BEGUN * samples.interval, model.delay))
    return replace(fit, model=model, columns=columns_of(
        samples, *model.nonlinear, direct=free.feedthrough))


def _times(samples: Samples, fit: Fit, free: Free, white: Array, ahead: Array, far: bool) -> Array:
    """Return how unsure free dead times are, over their deviations to first order, (delays,)."""
    # `white` are these as if noise was white [s]; `far`: see `entry_changes`. That of an input
    # whose dead time is taken for 0 is about 0, though a step to the maximum goes so many
    # deviations `ahead`; it counts with its share of the Akaike weights, beside the model without
    # one.
    places = np.flatnonzero(free.delays)
    found = np.ones(len(places))
    for k, j in enumerate(places.tolist()):
        none, gain = fit.model.delay[j] == 0.0, max(float(ahead[k]), 0.0) ** 2
        if far and white[k]:
            found[k] = _shown(samples, fit, free, j, float(white[k]), far) / white[k]
        if none:
            found[k] = max(found[k], np.sqrt(1.0 + gain)) / np.sqrt(1.0 + np.exp(1.0 - 0.5 * gain))
    return found


def _shown(samples: Samples, fit: Fit, free: Free, j: int, change: float, far: bool) -> float:
    """Return half the change of a dead time that costs 4 in -2 log likelihood, the mean [s]."""
    found = two_deviations(samples, fit, free, j, change, far=far)
    return 0.5 * float(np.mean(np.abs(found))) if found else change


def two_deviations(samples: Samples, fit: Fit, free: Free, j: int, change: float, *,
                   far: bool = False) -> list[float]:
    """
    Return the changes of a dead time to both sides that cost 4 in -2 log likelihood [s].

    No further than it may go, with all that is linear free and, if it is asked how `far`, poles
    and other dead times; `change` is about half of them. Where inputs are held, the likelihood may
    have several maxima, the truth in between: how it is curved at one of them says little of how
    far the others are.
    """
    model, found = fit.model, list[float]()
    held = free.without((j,))
    for side in (1.0, -1.0):
        step, deviations, least, reach = 2.0 * change, 0.0, 0.0, 0.0
        room = free.longest - model.delay[j] if side > 0.0 else model.delay[j]
        while deviations < 2.0 and least < room:
            step, delay = min(step, room), model.delay.copy()
            delay[j] = max(delay[j] + side * step, 0.0)
            before = deviations
            try:
                start = fit_at(samples, model.poles, delay, held, fit, slopes=far)
                one = climb_roughly(samples, start, held) if far else start
                rise = one.cost - fit.cost
            except np.linalg.LinAlgError:
                break
            deviations = float(np.sqrt(max(rise, 0.0)))
            share = min((2.0 - before) / max(deviations - before, 1e-300), 1.0)
            reach, least, step = least + share * (step - least), step, 2.0 * step
        found += [side * reach] if reach else []
    return found


def _read_alike(samples: Samples, fit: Fit) -> Array:
    """Return the intervals of dead times within which D tells nothing of them, (nu,) [s]."""
    # Of a jump of a held input, D shows the dead time only where the jump passes a sample.
    model = fit.model
    found = np.zeros(samples.nu)
    for j in range(samples.nu):
        passed: list[list[tuple[Array, Array]]] = [[], []]
        for r, record in enumerate(samples.records):
            stamps, jumps = input_jumps(record.inputs, j)
            for s in record.streams:
                effect = jumps ** 2 * np.sum(model.D[s.channels, j] ** 2 / np.maximum(
                    fit.power[r, s.channels], ROUNDING))
                place = np.searchsorted(s.times, stamps + model.delay[j])
                for side, near in zip(passed, (place - 1, place), strict=True):
                    seen = (near >= 0) & (near < len(s.times))
                    side.append((np.abs(s.times[near[seen]] - stamps[seen] - model.delay[j]),
                                 effect[seen]))
        found[j] = sum(_until_seen(*map(np.concatenate, zip(*side, strict=True)))
                       for side in passed)
    return found


def _until_seen(change: Array, effect: Array) -> float:
    """Return by how much a dead time may change until -2 log likelihood does by 1."""
    order = np.argsort(change)
    seen = np.flatnonzero(np.cumsum(effect[order]) >= 1.0)
    return float(change[order[seen[0]]]) if len(seen) else 0.0


def input_jumps(signals: tuple[Signal, ...], place: int) -> tuple[Array, Array]:
    """Return the stamps of an input, and by how much it jumps there; none if it is not held."""
    s, own = next((s, own) for s, own in placed(signals) if place < own.stop)
    return (s.time[1:], np.diff(s.values[:, place - own.start])) if s.hold == 'zoh' else \
        (np.empty(0), np.empty(0))
