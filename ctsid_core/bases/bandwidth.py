# SPDX-License-Identifier: Apache-2.0
"""
How many Hermite functions a window needs: its time-bandwidth product.

The span of h_0 .. h_nmax is (nearly) the disc of radius R = sqrt(2 nmax + 1) in the
time-frequency plane: a window of half-length tau reaches R^2 / tau rad/s, at its centre. Two and
a half times that product keeps the band over nearly all of the window.
"""

from __future__ import annotations

import numpy as np

from ctsid_core.bases.quadrature import smooth_values
from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Record, Signal

_REACH = 2.5            # times tau omega / 2
_NYQUIST = 0.8          # part of the slowest signal's Nyquist frequency that is used
_LEAST, _MOST = 200, 1500
_MOST_PARTS = 10        # of a long record
_ABOVE_NOISE = 4.0      # power over the noise floor that counts as signal
_DYNAMIC_RANGE = 1e-8   # power below this part of the peak is not looked for
_FINENESS = 12.0        # steps per octave of nmax, so that windows alike share a basis
_SMOOTHING = 31         # periodogram lines averaged, so that noise alone stays below the threshold


def choose_nmax(record: Record, band: float = 0.0) -> tuple[int, int]:
    """
    Return the highest order of the Hermite functions, and the number of parts.

    Of each part of a long record; `band` is up to which the outputs rise above their noise in
    other records [rad/s].
    """
    tau = 0.5 * record.duration
    band = max(band, output_band(record))
    slowest = max((s.period for s in (*record.inputs, *record.outputs) if s.hold != 'zoh'),
                  default=record.duration / 20.0)
    highest = _NYQUIST * np.pi / slowest
    wanted = max(_REACH * 0.5 * tau * band, _LEAST)
    product = min(wanted, 0.5 * tau * highest)
    parts = int(min(np.ceil(product / _MOST), _MOST_PARTS))
    nmax = 2.0 ** (np.floor(_FINENESS * np.log2(min(product / parts, _MOST))) / _FINENESS)
    return max(int(nmax), 8), parts


def output_band(record: Record) -> float:
    """Return the frequency up to which the outputs of a record rise above their noise [rad/s]."""
    return max(signal_band(s, record.start, record.end) for s in record.outputs)


def signal_band(signal: Signal, start: float, end: float) -> float:
    """
    Return the frequency up to which a signal rises above its noise in [start, end] [rad/s].

    Periodogram of the interpolated signal with a window of low side lobes; the noise floor is the
    median of the upper quarter of the frequencies, where no plant responds.
    """
    inside = signal.between(start, end, context=0)
    count = len(inside.time)
    if count < 16:
        return float(np.pi / signal.period)
    grid = np.linspace(inside.time[0], inside.time[-1], count)
    values = smooth_values(inside.time, inside.values.T, grid)
    values = values - values.mean(axis=1, keepdims=True)
    power = np.abs(np.fft.rfft(values * np.kaiser(count, 16.0), axis=1)) ** 2
    width = min(_SMOOTHING, max(power.shape[1] // 8, 1))
    kernel = np.ones(width) / width
    smooth = np.array([np.convolve(row, kernel, mode='same') for row in power])
    step = 2.0 * np.pi / float(grid[-1] - grid[0])
    return step * max(_last_above(row) for row in smooth)


def _last_above(power: Array) -> int:
    floor = np.median(power[-max(len(power) // 4, 1):])
    above = np.flatnonzero(power > max(_ABOVE_NOISE * floor, _DYNAMIC_RANGE * np.max(power)))
    return int(above[-1]) if len(above) else 0
