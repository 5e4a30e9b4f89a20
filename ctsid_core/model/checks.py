# SPDX-License-Identifier: Apache-2.0
"""Shapes and entries that matrices, dead times and names of a model must have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array


def numbers(name: str, value: ArrayLike) -> Array:
    """Return a copy as float64; raise `DataError` unless all entries are finite numbers."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise DataError(f'`{name}` is not an array of numbers: {error}') from error
    if not np.isfinite(array).all():
        raise DataError(f'`{name}` holds NaN or infinity; every entry must be finite')
    return array


def shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """
    Return a read-only copy of the wanted shape, or raise `DataError`.

    An empty row stands for zeros where a matrix may be left out (D, K, x_trim, y_trim).
    """
    array = numbers(name, value)
    if array.shape == (0,) and name in ('D', 'K', 'x_trim', 'y_trim'):
        array = np.zeros(shape)  # not given
    if array.shape != shape:
        raise DataError(f'`{name}` has shape {array.shape}, wanted is {shape}: A is (n, n), '
                        'B (n, nu), C (ny, n), D (ny, nu), K (n, ny)')
    array.setflags(write=False)
    return array


def delays(given: Sequence[float], nu: int) -> tuple[float, ...]:
    """Return `nu` dead times [s], zeros if none are given, or raise `DataError`."""
    values = tuple(float(d) for d in given) or (0.0,) * nu
    if len(values) != nu or not all(0 <= d < float('inf') for d in values):
        raise DataError(f'`delay` is {values}; wanted are {nu} dead times in s, one per input, '
                        'none negative')
    return values


def words(name: str, given: Sequence[str], count: int) -> tuple[str, ...]:
    """Return `count` names or units, '' if none are given, or raise `DataError`."""
    if isinstance(given, str) or (len(given) and len(given) != count):
        raise DataError(f'`{name}` is {given!r}; wanted are {count}, one per channel')
    return tuple(given) or ('',) * count
