# SPDX-License-Identifier: Apache-2.0
"""How good the stamps of a topic are, and how much its scalars move."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.decoding.field_path import FieldPath
from ctsid_ros.ingest.ingest import STILL

_GAP = 3.0  # an interval is a gap if it is longer than so many median ones
_CONSTANT = 1e-9  # a range below this part of the size is no movement
_WHITE = 1.1  # von Neumann: white noise has sqrt(2), what moves smoothly has less


@dataclass(frozen=True)
class StampStats:
    """
    One source of time stamps of a topic.

    Parameters
    ----------
    source : {'header', 'log', 'publish'}
    usable : bool
    why : str
        Why not, if it is not.
    period : float
        Median interval of stamps that are not equal [s]; NaN for fewer than two stamps, as are
        those that follow.
    jitter : float
        Standard deviation of the intervals that are no gaps [s].
    gaps : int
        Number of intervals longer than three median ones.
    longest : float
        The longest interval [s].
    backward, repeated : int
        Number of steps back, and of stamps equal to the one before.
    """

    source: str
    usable: bool
    why: str = ''
    period: float = math.nan
    jitter: float = math.nan
    gaps: int = 0
    longest: float = math.nan
    backward: int = 0
    repeated: int = 0


@dataclass(frozen=True)
class FieldStats:
    """
    A scalar that could be a signal, by the messages that were decoded.

    Parameters
    ----------
    field : str
    low, high, mean, std : float
        Of its finite values.
    moves : bool
        Whether it is not constant.
    white : bool
        Whether it looks like white noise alone: neighbours are independent.
    monotone : bool
        Whether it only ever rises, by whole numbers: a counter or a clock.
    finite : float
        Share of the values that are finite.
    index : str
        What it is by index, if it is a field by name: `velocity[2]` of `velocity[elbow]`.
    """

    field: str
    low: float
    high: float
    mean: float
    std: float
    moves: bool
    white: bool
    monotone: bool
    finite: float
    index: str = ''


def stamp_stats(source: str, stamps: NDArray[np.int64], begins: NDArray[np.bool_] | None = None
                ) -> StampStats:
    """Measure the stamps [ns] of a topic; `begins` tells which follow on nothing that was read."""
    begins = np.zeros(len(stamps), bool) if begins is None else begins
    zeros = int(np.count_nonzero(stamps <= 0))
    if zeros:
        share = 'all' if zeros == len(stamps) else f'{zeros} of {len(stamps)}'
        if 2 * zeros > len(stamps):
            return StampStats(source, False, f'{share} are zero')
        begins, stamps = begins[stamps > 0], stamps[stamps > 0]
    step = np.diff(stamps)[~begins[1:]] * 1e-9
    if not len(step):
        return StampStats(source, bool(len(stamps)))
    moved = step[step != 0]
    period = float(np.median(moved)) if len(moved) else 0.0
    ordinary = step[(step > 0) & (step <= _GAP * period)]
    if not len(ordinary) or len(step) >= STILL * len(moved):
        return StampStats(source, False, 'most do not increase', period,
                          backward=int((step < 0).sum()), repeated=int((step == 0).sum()))
    return StampStats(
        source, True, f'{zeros} of {zeros + len(stamps)} are zero' if zeros else '', period,
        float(ordinary.std()), int((step > _GAP * period).sum()), float(np.max(step)),
        int((step < 0).sum()), int((step == 0).sum()))


@np.errstate(over='ignore', invalid='ignore')  # damaged numbers may be too large to be squared
def field_stats(path: FieldPath, values: Array, run: int, index: str = '') -> FieldStats:
    """
    Measure a scalar.

    Parameters
    ----------
    path : FieldPath
    values : ndarray, shape (N,)
    run : int
        So many of them at a time are neighbours.
    index : str, optional
    """
    good = values[np.isfinite(values)]
    if not len(good):
        nan = math.nan
        return FieldStats(str(path), nan, nan, nan, nan, False, False, False, 0.0,
                          index)
    if path.euler:
        good = np.unwrap(good)
    low, high, std = float(np.min(good)), float(np.max(good)), float(np.std(good))
    steps = _steps(good, run)
    moves = high - low > _CONSTANT * max(abs(low), abs(high))
    spread = float(np.sqrt(np.mean(steps ** 2))) if len(steps) else 0.0
    whole = np.diff(good)
    return FieldStats(
        str(path), low, high, float(good.mean()), std, moves, moves and spread > _WHITE * std,
        bool(len(good) > 2 and (whole >= 0).all() and (good == np.round(good)).all()
             and np.count_nonzero(whole) > 0.9 * len(whole)), len(good) / len(values), index)


def _steps(values: Array, run: int) -> Array:
    """Return the differences of neighbours, but not from one run to the next."""
    step = np.diff(values)
    return np.delete(step, np.arange(run - 1, len(step), run))
