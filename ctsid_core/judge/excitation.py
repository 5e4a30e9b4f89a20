# SPDX-License-Identifier: Apache-2.0
"""
How much each input excites the plant, in which band, and how well its response is determined.

An input that is correlated with others adds no information beyond theirs: what counts is the part
of its lines that no other input explains (partial spectrum; Bendat and Piersol 2010, Random
Data, ch. 7). The predictor's response to that part is compared with the noise, line by line; the
sum over lines of that ratio is the information on the size of the response.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from ctsid_core.bases.projection import Projection, as_real, real_times
from ctsid_core.likelihood.prediction_errors import predict
from ctsid_core.likelihood.refine import whitener_of
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import Resolvent, resolvent
from ctsid_core.linear.types import Array, Lines
from ctsid_core.model.verdict import Excitation
from ctsid_core.signals.record import Record, Signal

_SMOOTHING = 9        # frequencies over which spectra are averaged, at least ...
_PER_INPUT = 3        # ... and so many for each input
_TAPER = 10.0         # of a Kaiser window: side lobes 75 dB below, ...
_LOBE = 4.2           # ... and so many frequencies wide, as `_breadth` counts a sine
_FEWEST = 256         # instants
_SUFFICIENT = 1.0     # power of the response over that of the noise in which a band is excited


class LinePrediction:
    """
    One-step predictions of a projection's lines: computed once, for all numbers of a verdict.

    Parameters
    ----------
    projection : Projection
    m : Matrices

    Attributes
    ----------
    error : ndarray, shape (ny, L)
        Prediction errors, of unit covariance over outputs.
    response : ndarray, shape (nu, ny, L)
        The predictor's response to each input's lines of size one, in the same coordinates.
    noise : ndarray, shape (L,)
        Power of the errors per real number, smoothed over lines; 1 on average.
    own : ndarray, shape (ny, L)
        Prediction errors in the units of the outputs.
    """

    def __init__(self, projection: Projection, m: Matrices) -> None:
        closed = resolvent(m.A - m.K @ m.C, projection.s)
        self.projection, self.own = projection, predict(projection, m, closed).error
        whiten = whitener_of(projection, as_real(self.own))
        self.error = real_times(whiten, self.own)
        self.response = _response(m, closed, whiten)
        power = np.mean(np.abs(self.error) ** 2, axis=0) / projection.weights
        self.noise = np.maximum(smoothed(power, _SMOOTHING), 1e-3)


def _response(m: Matrices, closed: Resolvent, whiten: Array) -> Lines:
    gain = closed.outputs(whiten @ m.C)                     # (n, ny, L)
    B, D = m.B - m.K @ m.D, whiten @ m.D
    found: Lines = np.tensordot(B.T, gain, axes=1) + D.T[:, :, np.newaxis]
    return found


def smoothed(power: Array, width: int) -> Array:
    """Return the running mean over the last axis; mirrored at its ends."""
    half = max(min(width // 2, power.shape[-1] - 2), 0)
    pad = [(0, 0)] * (power.ndim - 1) + [(half + 1, half)]
    sums = np.cumsum(np.pad(power, pad, mode='reflect'), axis=-1)
    mean: Array = (sums[..., 2 * half + 1:] - sums[..., :-2 * half - 1]) / (2 * half + 1)
    return mean


def excitations(prediction: LinePrediction, record: Record,
                parameters: int) -> tuple[Excitation, ...]:
    """
    Return how each input excites the plant, and how well the response to it is determined.

    Parameters
    ----------
    prediction : LinePrediction
    record : Record
        That was projected.
    parameters : int
        Number of parameters in a column of B and D.
    """
    p = prediction.projection
    omega, u = tapered(record, float(np.abs(p.s).max()))
    power, partial = _partial(u)
    lines = np.abs(p.s)
    gain = np.sum(np.abs(prediction.response) ** 2, axis=1) / prediction.noise     # (nu, L)
    found = []
    for j, name in enumerate(record.input_names):
        # The same power as on the lines, but none has leaked from the ends of the window.
        own = np.interp(lines, omega, partial[j])
        size = np.interp(lines, omega, power[j])
        scale = np.sum(np.abs(p.u[j]) ** 2) / max(float(size.sum()), 1e-300)
        ratio = gain[j] * own * scale
        fine = np.interp(omega, lines, ratio / p.weights)
        band = omega[fine >= _SUFFICIENT]
        low, high = (band[0], band[-1]) if len(band) else (np.nan, np.nan)
        found.append(Excitation(
            name, float(low), float(high), _breadth(u[j]) / _LOBE,
            float(own.sum() / max(float(size.sum()), 1e-300)),
            float(np.sqrt(parameters / max(float(ratio.sum()), 1e-300)))))
    return tuple(found)


def combined(records: Sequence[tuple[Excitation, ...]]) -> tuple[Excitation, ...]:
    """Return the excitation by each input in several records together."""
    found = []
    for own in zip(*records, strict=True):
        known = 1.0 / float(np.linalg.norm([1.0 / max(x.uncertainty, 1e-150) for x in own])
                            + 1e-300)
        lows, highs = ([getattr(x, end) for x in own if x.high > 0.0] for end in ('low', 'high'))
        best = max(own, key=lambda x: x.frequencies)
        found.append(Excitation(own[0].name, min(lows, default=np.nan),
                                max(highs, default=np.nan), best.frequencies, best.own, known))
    return tuple(found)


def tapered(record: Record, highest: float) -> tuple[Array, Lines]:
    """
    Return spectra of the inputs, tapered so that the ends of the window do not leak.

    Returns
    -------
    omega : ndarray, shape (K,)
        Frequencies up to about `highest`, as far apart as the window resolves [rad/s].
    u : ndarray, shape (nu, K)
    """
    step = 2.0 * np.pi / record.duration
    lines = int(np.ceil(highest / step)) + 1
    count = max(_FEWEST, 3 * lines)
    times = record.start + record.duration * (np.arange(count) + 0.5) / count
    u = np.hstack([_values(signal, times) for signal in record.inputs]).T
    u = (u - u.mean(axis=1, keepdims=True)) * _taper(count)
    omega = np.asarray(step * np.arange(lines), dtype=np.float64)
    return omega, np.fft.rfft(u, axis=1)[:, :lines]


@lru_cache(maxsize=16)
def _taper(count: int) -> Array:
    taper = np.kaiser(count, _TAPER)
    taper.flags.writeable = False  # it is shared
    return taper


def _breadth(u: Lines) -> float:
    """Return the effective number of frequencies, small amplitudes counting less."""
    size = np.abs(u)
    return float(size.sum() ** 2 / max(float(size @ size), 1e-300))


def _values(signal: Signal, times: Array) -> Array:
    if signal.hold == 'zoh':
        rows = np.searchsorted(signal.time, times, side='right') - 1
        held: Array = signal.values[np.maximum(rows, 0)]
        return held
    return np.stack([np.interp(times, signal.time, row) for row in signal.values.T], axis=1)


def _partial(u: Lines) -> tuple[Array, Array]:
    """Return the power of each input, smoothed, and the part that no other explains (nu, K)."""
    nu = len(u)
    if nu == 1:
        return np.abs(u) ** 2, np.abs(u) ** 2
    width = max(_SMOOTHING, _PER_INPUT * nu)
    width = min(width + 1 - width % 2, 2 * (u.shape[1] - 2) + 1)
    scale = np.sqrt(np.mean(np.abs(u) ** 2, axis=1, keepdims=True)) + 1e-300
    scaled = u / scale
    products = (scaled[:, np.newaxis] * scaled.conj()).reshape(nu * nu, -1)
    cross = smoothed(products.real, width) + 1j * smoothed(products.imag, width)
    cross = cross.reshape(nu, nu, -1).transpose(2, 0, 1)
    level = np.einsum('kii->k', cross).real / nu
    ridge = (1e-12 * level + 1e-300)[:, np.newaxis, np.newaxis] * np.eye(nu)
    inverse = np.einsum('kii->ik', np.linalg.inv(cross + ridge)).real
    power = np.einsum('kii->ik', cross).real * scale ** 2
    # A regression on nu - 1 others over so few frequencies explains some of it by chance.
    free = scale ** 2 / np.maximum(inverse, 1e-300) * width / max(width - nu + 1, 1)
    return power, np.minimum(free, power)
