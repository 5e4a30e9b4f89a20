# SPDX-License-Identifier: Apache-2.0
"""
Whether curves explain what a linear model leaves.

An actuator that saturates or ignores small commands, drag that grows with the square of speed,
feet that strike the ground, a sensor that clips: the errors of the best linear model then follow
squares and cubes of what goes in or comes out. They are fitted to the errors in three places: of
the inputs, before the model; of the simulated outputs, as they would move its modes; and of these
after it. What other poles, residues, dead times or trims would explain as well is left to them.

References
----------
Ramsey 1969, J. Royal Statistical Society B 31 (RESET, here of the simulated output); Billings and
Voon 1986, Int. J. Control 44 (of inputs and outputs); Cochrane and Orcutt 1949, J. American
Statistical Association 44 (least squares with errors of an autoregression).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.mode_columns import Triangle, columns_of
from ctsid_core.likelihood.output_error import Fit, Free
from ctsid_core.likelihood.residuals import autoregression, motion_within, residuals
from ctsid_core.likelihood.samples import RecordSamples, Residuals, Samples
from ctsid_core.linear.least_squares import basis_of, triangle
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.modal import steps_of
from ctsid_core.search.drifting import delays_with_time
from ctsid_core.signals.record import Signal

_POWERS = (2, 3)
_SEARCHED = 600       # samples of a stream that are looked at
MOST = 0.5           # columns for each sample: with more nothing is told
_TIMES = 3            # that noise is estimated
_CHANCE = 2.0         # deviations beyond what numbers gain by chance, that are by chance, too
_LEAST = 0.02         # motion within a tenth of a record, over all: less is as much


def curve_gains(samples: Samples, fit: Fit, free: Free, drifting: Samples | None = None) -> Array:
    """
    Return the points of fit that curves gain after the model, less those by chance, (ny,) [%].

    They are points of the motion within a tenth of a record. What inputs that drift explain, too,
    `drifting` with the time among them, is left to these.
    """
    samples = samples.thinned(_SEARCHED)
    model, gains, errors = fit.model, np.zeros(samples.ny), residuals(samples, fit)
    if not samples.counts.all():
        return gains
    known, delay = (samples, model.delay) if drifting is None else (
        drifting.thinned(_SEARCHED), delays_with_time(model.delay))
    columns = columns_of(known, model.poles, delay, direct=free.feedthrough, turned=False)
    samples.effort.check()
    curved = _powers(samples, errors)
    for k, stream in enumerate(samples.records[0].streams):
        parts = [(*_linear(found[k], model.poles, free), _curves(record, k, model, own))
                 for record, found, own in zip(samples.records, columns.triangles, curved,
                                               strict=True)]
        states, driven, curves = zip(*parts, strict=True)
        base = np.hstack((block_diag(*states), np.vstack(driven)))
        gains[stream.channels] = _gained(base, np.vstack(curves), [own[k] for own in errors],
                                         samples.effort.check)
    return gains / np.maximum(motion_within(samples, errors), _LEAST)


def curves_of(samples: Samples, fit: Fit) -> list[Array]:
    """
    Return the columns of curves for each output, of all records, over the rms of its errors.

    None, if of an output of a record there is no sample.
    """
    if not samples.counts.all():
        return []
    powers = _powers(samples, residuals(samples, fit))
    size = np.sqrt(np.maximum(fit.power, 1e-300))
    found = [[block / one for k, stream in enumerate(record.streams)
              for block in [_curves(record, k, fit.model, curved)] for one in own[stream.channels]]
             for record, curved, own in zip(samples.records, powers, size, strict=True)]
    return [np.vstack(same) for same in zip(*found, strict=True)]


def _powers(samples: Samples, errors: Residuals) -> list[list[Signal]]:
    """Return, of each record, squares of its inputs and simulated outputs, then their cubes."""
    signals = [[*r.inputs, *(Signal(s.times, s.y - e, 'linear')
                             for s, e in zip(r.streams, own, strict=True))]
               for r, own in zip(samples.records, errors, strict=True)]
    means = [np.mean(np.concatenate([s.values for s in same]), axis=0)
             for same in zip(*signals, strict=True)]
    sizes = [max(float(np.max(np.abs(s.values - mean))) for s in same) or 1.0
             for same, mean in zip(zip(*signals, strict=True), means, strict=True)]
    return [[replace(s, values=((s.values - mean) / size) ** power) for power in _POWERS
             for s, mean, size in zip(own, means, sizes, strict=True)] for own in signals]


def _linear(t: Triangle, poles: ComplexArray, free: Free) -> tuple[Array, Array]:
    """Return the columns of what is a record's own, and of what inputs do, with slopes."""
    both = _real(np.concatenate((t.z, t.dz), axis=1).swapaxes(1, 2), np.tile(poles, 2))
    states, driven = both[:, -1], both[:, :-1].reshape(len(both), -1)
    direct = (t.u, t.rates) if free.feedthrough else ()
    return np.column_stack((states, t.one)), np.hstack((driven, *direct))


def _curves(record: RecordSamples, k: int, model: ModalModel, curved: list[Signal]) -> Array:
    """Return the columns of curves before the model, at its modes, and after it, of a stream."""
    s, (nu, ny), count = record.streams[k], (len(model.delay), len(model.c)), len(_POWERS)
    z, _ = steps_of(curved, np.tile(np.append(model.delay, np.zeros(ny)), count), record.start,
                    s.times).responses(model.poles, slopes=False)
    seen = z.transpose(2, 1, 0).reshape(len(s.times), count, nu + ny, -1)
    before = ((seen[:, :, :nu] * model.b.T) @ model.c[s.channels].T).real
    inside = _real(seen[:, :, nu:].reshape(len(seen), count * ny, -1), model.poles)
    after = [one.values for one in curved[len(record.inputs) + k::len(curved) // count]]
    return np.hstack((before.reshape(len(seen), -1), inside.reshape(len(seen), -1), *after))


def _real(responses: ComplexArray, poles: ComplexArray) -> Array:
    """Return real and, of pairs, imaginary parts of modes' responses, (N, channels, n)."""
    return np.concatenate((responses.real, responses[:, :, poles.imag > 0.0].imag), axis=2)


def _gained(base: Array, curves: Array, errors: list[Array], check: Callable[[], None]) -> Array:
    """Return the points of fit that curves gain beside what the model can do, by output."""
    # How much of each curve there is tell the errors as coloured noise (generalised least
    # squares), first as if there were no curves: gusts that a controller answers, or a plant that
    # integrates, would be taken for them else.
    count, gains = len(base), np.zeros(errors[0].shape[1])
    if base.shape[1] + curves.shape[1] > MOST * count:
        return gains
    Q, edges = basis_of(base), np.cumsum([len(one) for one in errors])[:-1]
    own, width = basis_of(curves, Q), Q.shape[1]
    for i, e in enumerate(np.concatenate(errors).T if own.shape[1] else ()):
        part = np.zeros(count)
        for _ in range(_TIMES):
            check()
            R = triangle(np.vstack([
                _innovations(autoregression(noise)[1], rows) for noise, rows in zip(
                    np.split(e - part, edges), np.split(np.column_stack((Q, own, e)), edges),
                    strict=True)]))
            back = np.linalg.inv(R[width:-1, width:-1])
            weights = back @ R[width:-1, -1]
            part = own @ weights
        spread = back.T @ back
        by_chance = R[-1, -1] ** 2 / (count - len(R) + 1) * (
            np.trace(spread) + _CHANCE * np.sqrt(2.0 * np.sum(spread ** 2)))
        before = np.sum((e - Q @ (Q.T @ e)) ** 2)
        after = before - np.clip(weights @ weights - by_chance, 0.0, before)
        gains[i] = 100.0 * (np.sqrt(before / count) - np.sqrt(after / count))
    return gains


def _innovations(polynomial: Array, rows: Array) -> Array:
    """Return what is new in each row after those before it."""
    found = rows.copy()
    for k, weight in enumerate(polynomial[1:].tolist(), 1):
        found[k:] += weight * rows[:-k]
    return found
