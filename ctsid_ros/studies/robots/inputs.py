# SPDX-License-Identifier: Apache-2.0
"""What moves a robot while it is recorded: seven kinds of inputs of amplitude 1 or so."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from ctsid_core.linear.types import Array

KINDS = ('sweep', 'prbs', 'multisine', 'pilot', 'doublets', 'staircase', 'step')
NOISE_LIKE = ('prbs', 'multisine', 'pilot')     # may have been running since before the record


def drive(kind: str, rng: np.random.Generator, time: Array, duration: float, band: float,
          width: int = 1) -> Array:
    """
    Return values of an input at its stamps.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    rng : numpy.random.Generator
    time : ndarray, shape (N,)
        Stamps; the record lies in [0, duration] [s].
    duration : float
        [s]
    band : float
        Highest frequency that is to be excited [Hz].
    width : int
        Channels, each moved on its own.

    Returns
    -------
    ndarray, shape (N, width)
    """
    channels = [_MAKERS[kind](rng, time, duration, band, (i, width)) for i in range(width)]
    values: Array = np.column_stack(channels)
    if kind not in NOISE_LIKE:
        values[time < 0.0] = 0.0
    return values


def _sweep(rng: np.random.Generator, time: Array, duration: float, band: float,
           place: tuple[int, int]) -> Array:
    low = max(1.0 / duration, band / 20.0) * rng.uniform(0.8, 1.25)
    high = max(band * rng.uniform(0.8, 1.25), 2.0 * low)
    rate = np.log(high / low) / duration
    size = rng.uniform(0.7, 1.3) * rng.choice((-1.0, 1.0))
    phase = 2.0 * np.pi * low * np.expm1(rate * np.maximum(time, 0.0)) / rate
    return np.asarray(size * np.sin(phase + place[0] * np.pi * rng.uniform(0.3, 0.7)))


def _held_levels(time: Array, edges: Array, levels: ArrayLike) -> Array:
    """Return levels[i] from edges[i] on; 0 before the first edge."""
    return np.asarray(np.append(0.0, levels)[np.searchsorted(edges, time, side='right')])


def _prbs(rng: np.random.Generator, time: Array, duration: float, band: float,
          place: tuple[int, int]) -> Array:
    clock = 0.35 / band
    edges = np.arange(time[0], duration + clock, clock)
    size = rng.uniform(0.7, 1.3)
    return size * _held_levels(time, edges, 2.0 * rng.integers(0, 2, len(edges)) - 1.0)


def _multisine(rng: np.random.Generator, time: Array, duration: float, band: float,
               place: tuple[int, int]) -> Array:
    count = int(rng.integers(8, 20))
    f: Array = np.geomspace(max(1.0 / duration, band / 30.0), band, count)
    f *= rng.uniform(0.95, 1.05, count)
    waves = np.sin(2.0 * np.pi * np.outer(time, f) + rng.uniform(0.0, 2.0 * np.pi, count))
    return np.asarray(waves.sum(axis=1) * rng.uniform(0.8, 1.2) / np.sqrt(count))


def _pilot(rng: np.random.Generator, time: Array, duration: float, band: float,
           place: tuple[int, int]) -> Array:
    """Stick moves: held for a while, often let go, never moved in no time."""
    edges = time[0] + np.cumsum(rng.exponential(0.7 / band, int(4 * (duration + 3) * band) + 20))
    levels = rng.standard_normal(len(edges)) * (rng.random(len(edges)) > 0.35)
    raw = _held_levels(time, edges, levels)
    keep = np.exp(-np.median(np.diff(time)) * 2.0 * np.pi * band)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], raw))


def _doublets(rng: np.random.Generator, time: Array, duration: float, band: float,
              place: tuple[int, int]) -> Array:
    """Two to four doublets, each followed by rest; those of several channels take turns."""
    channel, width = place
    pulse = min(rng.uniform(0.6, 1.0) / band, duration / 16.0 / width)
    count = 1 if width > 2 else int(rng.integers(2, 5)) if width == 1 else 2
    slot = 0.9 * duration / (count * width)
    value = np.zeros_like(time)
    for i in range(count):
        start = (i * width + channel) * slot + rng.uniform(0.1, 0.3) * slot
        size = rng.uniform(0.6, 1.3) * rng.choice((-1.0, 1.0))
        edges: Array = start + pulse * np.arange(3.0)
        value += _held_levels(time, edges, np.array([size, -size, 0.0]))
    return value


def _staircase(rng: np.random.Generator, time: Array, duration: float, band: float,
               place: tuple[int, int]) -> Array:
    count = int(rng.integers(5, 9))
    edges: Array = duration * (np.arange(count) + rng.uniform(0.1, 0.8, count)) / count
    return _held_levels(time, edges, np.asarray(rng.uniform(-1.3, 1.3, count)))


def _step(rng: np.random.Generator, time: Array, duration: float, band: float,
          place: tuple[int, int]) -> Array:
    start = duration * (0.08 + (place[0] + rng.uniform(0.0, 0.3)) * 0.7 / place[1])
    size = rng.uniform(0.6, 1.4) * rng.choice((-1.0, 1.0))
    return _held_levels(time, np.array([start]), np.array([size]))


_MAKERS = {'sweep': _sweep, 'prbs': _prbs, 'multisine': _multisine, 'pilot': _pilot,
           'doublets': _doublets, 'staircase': _staircase, 'step': _step}
