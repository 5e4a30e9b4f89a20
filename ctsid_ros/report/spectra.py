# SPDX-License-Identifier: Apache-2.0
"""
What spectra say of the response and its support, without a model: for pictures only.

Outputs are interpolated to uniform times here, which no identification does.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.validation import Validation
from ctsid_core.signals.record import Record, Signal

_SEGMENTS = 8       # of the record, half overlapping ...
_PER_INPUT = 4      # ... and at least so many for each input, to tell them apart
_SHORTEST = 32      # samples of a segment
_MOST = 2**18       # samples that are looked at
_SHOWN = 0.8        # of the highest frequency: beyond it, interpolation shows
_EXPLAINED = 0.5    # of the power at a frequency: above, the data support the model there


@dataclass(frozen=True)
class Spectra:
    """
    Frequency response and coherence as spectra give them.

    Parameters
    ----------
    omega : ndarray, shape (M,)
        [rad/s]
    response : ndarray, shape (M, ny, nu)
        All inputs together: least squares at each frequency.
    coherence : ndarray, shape (M, ny, nu)
        Share of the output's power at a frequency that is of this input, the other inputs being
        accounted for (partial coherence; of one input, the ordinary one).
    """

    omega: Array
    response: ComplexArray
    coherence: Array


def spectra(record: Record) -> Spectra | None:
    """Return the spectral estimates of a record; None if it is too short for them."""
    step = max(s.period for s in record.outputs)
    count = min(int(record.duration / step), _MOST) if math.isfinite(step) and step > 0.0 else 0
    size = 2 * count // (max(_SEGMENTS, _PER_INPUT * record.nu) + 1)
    if size < _SHORTEST:
        return None
    from scipy.signal import csd

    times = record.start + step * np.arange(float(count))
    rows = np.concatenate([_at(s, times) for s in (*record.inputs, *record.outputs)])
    rows = rows - rows.mean(axis=1, keepdims=True)
    scale = rows.std(axis=1)
    rows /= np.where(scale > 0.0, scale, 1.0)[:, np.newaxis]
    frequency, own = csd(rows[:, np.newaxis], rows[np.newaxis], 1.0 / step, nperseg=size)
    kept = _spread(len(frequency), int(_SHOWN * len(frequency)))
    S = np.moveaxis(own[..., kept], -1, 0)
    nu, ny = record.nu, record.ny
    response = np.linalg.pinv(S[:, :nu, :nu], rcond=1e-9, hermitian=True) @ S[:, :nu, nu:]
    coherence = np.stack([_partial(S[:, [*range(nu), nu + i]][:, :, [*range(nu), nu + i]])
                          for i in range(ny)], axis=1)
    units = scale[np.newaxis, nu:, np.newaxis] / np.where(scale > 0.0, scale, np.inf)[:nu]
    return Spectra(2.0 * math.pi * frequency[kept], np.swapaxes(response, 1, 2) * units,
                   coherence)


def _spread(count: int, last: int, most: int = 300) -> list[int]:
    """Return lines of a spectrum, without the first, evenly along a logarithmic axis."""
    lines = np.unique(np.rint(np.geomspace(1, max(min(last, count - 1), 1), most)).astype(int))
    return [int(k) for k in lines]


def _at(signal: Signal, times: Array) -> Array:
    if signal.hold == 'zoh':
        place = np.clip(np.searchsorted(signal.time, times, side='right') - 1, 0, None)
        held: Array = signal.values[place].T
        return held
    return np.array([np.interp(times, signal.time, x) for x in signal.values.T])


def _partial(S: ComplexArray) -> Array:
    """Return the coherence of the last signal with each of the others, less the rest of them."""
    tiny = 1e-12 * np.trace(S, axis1=1, axis2=2).real[:, np.newaxis, np.newaxis]
    P = np.linalg.inv(S + (tiny + 1e-300) * np.eye(S.shape[1]))
    own = np.abs(np.einsum('kii->ki', P))
    found: Array = np.abs(P[:, -1, :-1]) ** 2 / (own[:, -1:] * own[:, :-1])
    return np.clip(found, 0.0, 1.0)


def supported_band(found: Validation) -> tuple[float, float] | None:
    """
    Return the band in which a model explains most of the power of some output [rad/s].

    Notes
    -----
    Spectra of the output and of the simulation's residuals, averaged over eight half-overlapping
    segments. Of several such bands the one with the most octaves; None if there is none.
    """
    bands = [band for i in range(found.y.shape[1]) if (band := _band_of(found, i))]
    return (min(b[0] for b in bands), max(b[1] for b in bands)) if bands else None


def _band_of(found: Validation, i: int) -> tuple[float, float] | None:
    good = np.isfinite(found.y[:, i]) & np.isfinite(found.y_hat[:, i])
    times, y, e = found.times[good], found.y[good, i], (found.y - found.y_hat)[good, i]
    if len(times) < 16 * _SEGMENTS:
        return None
    from scipy.signal import welch

    grid = np.linspace(times[0], times[-1], len(times))
    size = 2 * len(grid) // (_SEGMENTS + 1)
    frequency, power = welch(np.array([np.interp(grid, times, x) for x in (y, e)]),
                             1.0 / (grid[1] - grid[0]), nperseg=size)
    explained = np.concatenate([[False], power[1][1:] < (1 - _EXPLAINED) * power[0][1:], [False]])
    edges = np.flatnonzero(np.diff(explained.astype(int)))
    step = 2 * math.pi * float(frequency[1])
    # What reaches down to the first line of the spectra reaches down to the length of the record.
    least = 2 * math.pi / float(times[-1] - times[0])
    runs = [(step * (a + 1) if a else least, step * b)
            for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return max(runs, key=lambda run: run[1] / run[0], default=None)
