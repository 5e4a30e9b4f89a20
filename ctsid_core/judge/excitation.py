# SPDX-License-Identifier: Apache-2.0
"""
Where each input excites the plant, and how well the response to it is known there.

The spectrum of the differenced response to an input, over omega, says which frequencies matter:
differenced, so that a single step, which is an edge, counts at all frequencies up to the plant's
bandwidth; over omega, so that every octave counts alike. With this weight the standard deviation
of the frequency response is averaged.
"""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.modal import mode_responses
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Excitation

_POINTS = 4096        # of the uniform grid of time, at most
_LINES = 200          # of the spectrum of the inputs, the strongest
_LOBE = 2.0           # lines that one sine has after the taper
_TAIL = 0.01          # of the weight that lies below, and above, the excited band


def excitations(samples: Samples, delay: Array, covariance: Covariance | None, moving: StateSpace,
                names: tuple[str, ...]) -> tuple[tuple[Excitation, ...], Array]:
    """
    Return the excitation of each moving input, and how unsure the response of each output is.

    Parameters
    ----------
    samples : Samples
    delay : ndarray, shape (nu,)
        Of the inputs; what further ones `samples` has does not count [s].
    covariance : Covariance or None
        Of `moving`.
    moving : StateSpace
        The same model, of the moving channels.
    names : tuple of str, length nu
    """
    record = max(samples.records, key=_motion)
    omega, weight, lines, inputs, frequencies = _spectra(record, delay)
    response = moving.frequency_response(omega) / samples.size[:, np.newaxis]
    variance, changes = np.full(response.shape, np.inf), None
    if covariance is not None:
        try:
            changes = covariance.response_changes(moving, omega)
            variance = np.sum(np.abs(changes) ** 2, axis=0) / samples.size[:, np.newaxis] ** 2
        except np.linalg.LinAlgError:
            pass
    own = _uncorrelated(inputs)
    found = []
    for j, name in enumerate(names):
        seen = weight[:, j] * np.sum(np.abs(response[:, :, j]) ** 2, axis=1)
        total = float(seen.sum())
        if not total > 0.0 or not np.isfinite(total):
            found.append(Excitation(name, frequencies=float(frequencies[j]), own=float(own[j])))
            continue
        part = np.cumsum(seen) / total
        low, high = (float(omega[min(int(np.searchsorted(part, share)), len(omega) - 1)])
                     for share in (_TAIL, 1.0 - _TAIL))
        unsure = float(np.sqrt((weight[:, j, np.newaxis] * variance[:, :, j]).sum() / total))
        found.append(Excitation(name, low, high, float(frequencies[j]), float(own[j]), unsure))
    by_output = np.full(samples.ny, np.inf)
    if changes is not None:
        moved = np.einsum('rfij,jf->fir', changes, lines) / samples.size[:, np.newaxis]
        seen = np.einsum('fij,jf->fi', response, lines)
        with np.errstate(invalid='ignore', divide='ignore'):
            by_output = np.sqrt(np.sum(np.abs(moved) ** 2, axis=(0, 2))
                                / np.sum(np.abs(seen) ** 2, axis=0))
    return tuple(found), np.nan_to_num(by_output, nan=np.inf)


def _motion(record: RecordSamples) -> float:
    """Return by how much the inputs of a record change in all."""
    return float(sum(np.abs(np.diff(s.values, axis=0)).sum() for s in record.inputs))


def _spectra(record: RecordSamples,
             delay: Array) -> tuple[Array, Array, ComplexArray, Array, Array]:
    """
    Return frequencies, weights (M, nu) and lines (nu, M) of the inputs there, and more.

    The strongest lines only. Further the inputs at uniform instants, and the effective number of
    frequencies of each.
    """
    finest = min(float(np.median(np.diff(s.times))) for s in record.streams)
    count = int(np.clip((record.end - record.start) / finest, 32, _POINTS))
    t = np.linspace(record.start, record.end, count)
    ends = np.cumsum([s.width for s in record.inputs])
    inputs = record.inputs[:int(np.searchsorted(ends, len(delay))) + 1]
    u = mode_responses(np.empty(0, dtype=complex), inputs, delay.tolist(), record.start, t,
                       slopes=False).inputs
    lines = np.fft.rfft(np.diff(u, axis=1), axis=1)[:, 1:]
    omega = 2.0 * np.pi * np.fft.rfftfreq(count - 1, t[1] - t[0])[1:]
    power = np.abs(lines) ** 2 / omega
    strength = np.sum(power / (power.sum(axis=1, keepdims=True) + 1e-300), axis=0)
    places = np.sort(np.argsort(-strength, kind='stable')[:_LINES])
    tapered = np.abs(np.fft.rfft(np.diff(u, axis=1) * np.hanning(count - 1), axis=1)) ** 2
    breadth = tapered.sum(axis=1) ** 2 / np.maximum(np.sum(tapered ** 2, axis=1), 1e-300)
    return (omega[places], power[:, places].T, lines[:, places] / np.sqrt(omega[places]), u,
            breadth / _LOBE)


def _uncorrelated(u: Array) -> Array:
    """Return the share of each input's power that no other input explains, (nu,)."""
    u = u - u.mean(axis=1, keepdims=True)
    power = np.sum(u ** 2, axis=1)
    own = np.zeros(len(u))
    for j in range(len(u)):
        others = np.delete(u, j, axis=0)
        left = u[j]
        if len(others):
            left = left - np.linalg.lstsq(others.T, left, rcond=1e-10)[0] @ others
        own[j] = float(left @ left / power[j]) if power[j] > 0.0 else 0.0
    return own
