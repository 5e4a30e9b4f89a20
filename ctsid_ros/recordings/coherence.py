# SPDX-License-Identifier: Apache-2.0
"""The figures that people know of a pair of signals: coherence, and lag of the correlation."""

from __future__ import annotations

import numpy as np
from scipy.signal import coherence, correlate, correlation_lags, csd

from ctsid_core.linear.types import Array
from ctsid_ros.recordings.excerpts import Clock
from ctsid_ros.recordings.guess_pairs import without_slow

_SEGMENTS = 8  # at least, of each stretch: the coherence of one alone would be 1
_LONGEST = 10.0  # units of time: of a segment
_LATEST = 3.0  # units of time: of a lag that is looked for


def mean_coherence(u: Array, y: Array, clock: Clock) -> float:
    """
    Return the coherence of two signals, averaged over the frequencies at which y moves.

    Parameters
    ----------
    u, y : ndarray, shape (N,)
        At the ticks of the clock; NaN where not known.
    clock : Clock

    Returns
    -------
    float
        Of each frequency weighted by the power of y there; NaN if there is too little.
    """
    found, weights = [], []
    for one, other in _known(u, y, clock):
        size = int(min(_LONGEST * clock.unit, len(one) / _SEGMENTS * 2))
        if size < 8:
            continue
        _, shares = coherence(one, other, 1 / clock.step, nperseg=size)
        _, power = csd(other, other, 1 / clock.step, nperseg=size)
        found.append(float(np.sum(np.nan_to_num(shares) * power.real) / max(
            float(np.sum(power.real)), 1e-300)))
        weights.append(len(one))
    return float(np.average(found, weights=weights)) if found else float('nan')


def lag(u: Array, y: Array, clock: Clock) -> float:
    """Return by how much y comes after u where their correlation is largest [s]; NaN if none."""
    total = None
    reach = round(_LATEST * clock.unit)
    for one, other in _known(u, y, clock):
        lags = correlation_lags(len(other), len(one))
        near = np.abs(lags) <= reach
        product = correlate(other, one, method='fft')[near]
        if near.sum() == 2 * reach + 1:
            total = product if total is None else total + product
    return float('nan') if total is None else float(
        (np.argmax(np.abs(total)) - reach) * clock.step)


def _known(u: Array, y: Array, clock: Clock) -> list[tuple[Array, Array]]:
    """Return the stretches of both from where to where they are known, gaps filled with rest."""
    u, y = without_slow(u, clock), without_slow(y, clock)
    found = []
    for part in clock.parts:
        both = np.flatnonzero(np.isfinite(u[part]) & np.isfinite(y[part]))
        if len(both):
            inside = slice(part.start + both[0], part.start + both[-1] + 1)
            found.append((np.nan_to_num(u[inside]), np.nan_to_num(y[inside])))
    return found
