# SPDX-License-Identifier: Apache-2.0
"""Are errors white over the lines? The smoothed periodogram against its mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from ctsid_core.linear.types import Array, Lines

_NARROW = 9           # lines over which power is averaged: a lightly damped mode
_BROAD = 8            # parts of the band over which it is averaged, too: a well damped one


@dataclass(frozen=True)
class Peak:
    """
    Where errors stand out most of what white ones do.

    Parameters
    ----------
    ratio : float
        Power there over the mean power.
    p_value : float
        Bonferroni's bound of the chance that white errors show as much anywhere.
    """

    ratio: float
    p_value: float


def highest_peak(error: Lines) -> Peak:
    """
    Return the most telling peak of errors.

    Parameters
    ----------
    error : ndarray, shape (ny, L)
        Each output counts by the power of its own errors.
    """
    power = np.abs(error) ** 2
    power = (power / (power.mean(axis=1, keepdims=True) + 1e-300)).mean(axis=0)
    widths = {min(_NARROW, len(power)), max(len(power) // _BROAD, 1)}
    found = [_peak(power, width, len(error), len(power) * len(widths)) for width in widths]
    return min(found, key=lambda peak: (peak.p_value, -peak.ratio))


def _peak(power: Array, width: int, ny: int, places: int) -> Peak:
    sums = np.cumsum(np.concatenate(([0.0], power)))
    ratio = float(np.max(sums[width:] - sums[:-width])) / width
    freedom = 2.0 * ny * width
    return Peak(ratio, min(float(chdtrc(freedom, freedom * ratio)) * places, 1.0))
