# SPDX-License-Identifier: Apache-2.0
"""A model on an experiment that it has not seen: simulated, its response compared, predicted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.actuators import acting
from ctsid_core.signals.record import Record
from ctsid_ros.studies.robots.experiment import Experiment
from ctsid_ros.studies.robots.linear import Held, growth, mode_responses

LEAST = -1e30           # fit of what overflows [%]
FAR = 3.0               # growth of an unstable mode [nepers] over which an initial state is fitted
EXCITED = 10.0          # power of the response over that of the noise
FREQUENCIES = 240
FINE = 0.002            # [s]


def _modal(A: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return poles and eigenvectors; poles that coincide are moved apart by next to nothing."""
    poles, vectors = np.linalg.eig(A.astype(complex))
    if len(A) and not np.linalg.cond(vectors) < 1e7:
        off = np.random.default_rng(0).standard_normal(A.shape)
        poles, vectors = np.linalg.eig(A + 1e-9 * np.linalg.norm(A) * off + 0j)
    return poles, vectors


def simulated(model: StateSpace, record: Record) -> Array:
    """
    Return the fit of each output when a model runs freely [%].

    The trim of the outputs is refitted, and so is the initial state: of a model with unstable
    poles on that part of the record in which these grow by exp(3) at most.

    Parameters
    ----------
    model : StateSpace
    record : Record
        With one signal of held inputs and one of outputs.
    """
    signal, held = record.outputs[0], _acting(model, record)
    times, y = signal.time, signal.values
    poles, vectors = _modal(model.A)
    with np.errstate(all='ignore'):
        known = _driven(model, poles, vectors, held.time, held.values, times)
        free = np.exp((times - times[0])[:, np.newaxis] * poles)
        basis = np.einsum('im,tm->tim', model.C @ vectors, free)
        real = np.concatenate((basis.real, basis.imag), axis=2)
        rest = y - known - _refitted(real, y - known, times, poles)
        spread = np.linalg.norm(y - y.mean(axis=0), axis=0)
        fit = 100.0 * (1.0 - np.linalg.norm(rest, axis=0) / np.where(spread > 0.0, spread, 1.0))
    return np.asarray(np.maximum(np.nan_to_num(fit, nan=LEAST, neginf=LEAST), LEAST))


def _acting(model: StateSpace, record: Record) -> Held:
    """Return what acts of the inputs, ramps in fine steps."""
    whole, signals = record.inputs[0], acting(record.inputs, model.actuators)
    if signals == record.inputs:
        return Held(whole.time, whole.values)
    first, last = float(whole.time[0]), float(max(record.end, whole.time[-1]))
    knots = np.unique(np.concatenate((np.arange(first, last, FINE), *(s.time for s in signals))))
    middle = knots + 0.5 * np.diff(knots, append=knots[-1])
    return Held(knots, np.column_stack([
        np.interp(middle, s.time, s.values[:, 0]) if s.hold == 'linear' else
        Held(s.time, s.values).at(knots) for s in signals]))


def _driven(model: StateSpace, poles: ComplexArray, vectors: ComplexArray, stamps: Array,
            values: Array, times: Array) -> Array:
    """Return outputs by inputs and trim from rest, each input after its dead time."""
    b, c = np.linalg.solve(vectors, model.B + 0j), model.C @ vectors
    y = np.tile(model.y_trim, (len(times), 1))
    for j, late in enumerate(model.delay):
        one = Held(stamps, values[:, j:j + 1])
        z = mode_responses(poles, one, times - late)[:, :, 0] * b[:, j]
        y = y + (z @ c.T).real + one.at(times - late) @ model.D[:, j:j + 1].T
    drift = growth(poles, times - times[0]) * np.linalg.solve(vectors, model.x_trim + 0j)
    return np.asarray(y + (drift @ c.T).real)


def _early(times: Array, poles: ComplexArray) -> NDArray[np.bool_]:
    """Return which instants an initial state is fitted to."""
    fastest = float(np.max(poles.real, initial=0.0))
    end = FAR / fastest if fastest * (times[-1] - times[0]) > FAR else np.inf
    rows = times - times[0] <= end
    rows[:min(len(rows), 5 * len(poles) + 5)] = True
    return np.asarray(rows, dtype=np.bool_)


def _refitted(free: Array, wanted: Array, times: Array, poles: ComplexArray) -> Array:
    """Return the free response and trim that come closest to what is wanted."""
    count, ny, n = free.shape
    size = np.std(wanted[np.isfinite(wanted).all(axis=1)], axis=0) + 1e-300
    trim = np.broadcast_to(np.eye(ny), (count, ny, ny))
    matrix, rows = np.concatenate((free, trim), axis=2), _early(times, poles)
    left = (matrix / size[:, np.newaxis])[rows].reshape(-1, n + ny)
    right = (wanted / size)[rows].reshape(-1)
    if not (np.isfinite(left).all() and np.isfinite(right).all()):
        return np.zeros_like(wanted)
    scale = np.linalg.norm(left, axis=0) + 1e-300
    found = np.linalg.lstsq(left / scale, right, rcond=1e-10)[0] / scale
    return np.asarray(matrix @ found)


def excited(experiment: Experiment) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return frequencies, and which entries of the response the inputs of a record excite at them.

    An entry is excited where what its input causes has ten times the power of the noise.

    Returns
    -------
    omega : ndarray, shape (M,)
    rows : ndarray of bool, shape (M, ny, nu)
    """
    held, times = experiment.record.inputs[0], experiment.noise_time
    step, span = float(np.median(np.diff(times))), float(times[-1] - times[0])
    omega = np.geomspace(2.0 * np.pi / span, 0.9 * np.pi / step, FREQUENCIES)
    edges = np.exp(-1j * np.outer(omega, held.time[1:]))
    u = edges @ np.diff(held.values, axis=0) / (1j * omega[:, np.newaxis])
    noise = np.exp(-1j * np.outer(omega, times)) @ experiment.noise * step
    assert experiment.response is not None
    signal = np.abs(experiment.response(omega) * u[:, np.newaxis, :]) ** 2
    power = _smooth(np.abs(noise) ** 2)[:, :, np.newaxis]
    return omega, _smooth(signal) > EXCITED * power


def _smooth(power: Array) -> Array:
    """Return means over nine neighbouring frequencies."""
    padded = np.pad(power, ((4, 4), *((0, 0),) * (power.ndim - 1)), mode='edge')
    return np.asarray(np.mean([padded[i:i + len(power)] for i in range(9)], axis=0))


def response_off(experiment: Experiment, model: StateSpace,
                 estimate: Estimate) -> tuple[float, bool]:
    """
    Return how far a model's response is off where it is excited.

    Returns
    -------
    worst : float
        Largest relative error [%].
    wrong : bool
        Whether somewhere it is more than 15 % and more than four of the estimate's own standard
        deviations (which count as 0 where it has none).
    """
    if experiment.response is None:
        return float('nan'), False
    omega, rows = excited(experiment)
    if not rows.any():
        return float('nan'), False
    truth, found = experiment.response(omega), model.frequency_response(omega)
    said = estimate.frequency_response_std(omega)
    own = np.nan_to_num(np.abs(found) * np.hypot(said.magnitude, said.phase))
    error = np.nan_to_num(np.abs(found - truth), nan=np.inf, posinf=np.inf)
    wrong = rows & (error > 0.15 * np.abs(truth)) & (error > 4.0 * own)
    return 100.0 * float(np.max((error / np.abs(truth))[rows])), bool(wrong.any())
