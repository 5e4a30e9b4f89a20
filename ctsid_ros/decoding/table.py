# SPDX-License-Identifier: Apache-2.0
"""One layout laid over many messages at once: a structured type of NumPy instead of a struct."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.decoding.block import Content, Located, Stamps, joined

_NARROW = 'bBhHiI'  # with these, a stamp fits into 64 bits


@dataclass(frozen=True)
class Table:
    """
    Length words and wanted fields of messages of one shape.

    Parameters
    ----------
    order : {'<', '>'}
        Byte order.
    items : tuple of (int, str)
        Positions in a message, and codes as in `struct`.
    words : mapping of int to int or bytes
        Which items are length words, the encapsulation or texts, and what they are.
    scalars : tuple of int
        Which items are the wanted fields.
    stamp : tuple of int, optional
        Which items are seconds and nanoseconds of the header.
    """

    order: str
    items: tuple[tuple[int, str], ...]
    words: Mapping[int, Any]
    scalars: tuple[int, ...]
    stamp: tuple[int, int] | None

    @cached_property
    def size(self) -> int:
        """How many bytes of a message are looked at."""
        return max((at + struct.calcsize('<' + code) for at, code in self.items), default=0)

    @cached_property
    def _runs(self) -> list[tuple[int, int, str]]:
        """Return first and last column of fields of one code that lie side by side."""
        runs: list[tuple[int, int, str]] = []
        end = -1
        for column, item in enumerate(self.scalars):
            at, code = self.items[item]
            if runs and at == end and code == runs[-1][2]:
                runs[-1] = (runs[-1][0], column + 1, code)
            else:
                runs.append((column, column + 1, code))
            end = at + struct.calcsize('<' + code)
        return runs

    @cached_property
    def _words(self) -> Mapping[int, int | bytes]:
        """Return the words, the two bytes of the encapsulation as a number; no empty text."""
        return {i: int.from_bytes(word, 'little') if self.items[i][1] == '2s' else word
                for i, word in self.words.items() if word != b''}

    @cached_property
    def _type(self) -> np.dtype[Any]:
        names, formats, offsets = [], [], []
        for i in (*self._words, *(self.stamp or ())):
            at, code = self.items[i]
            names.append(f'item {i}')
            formats.append('<u2' if code == '2s' else f'S{code[:-1]}' if code.endswith('s')
                           else self.order + code)
            offsets.append(at)
        for first, last, code in self._runs:
            names.append(f'run {first}')
            formats.append((f'{self.order}{"B" if code == "?" else code}', (last - first,)))
            offsets.append(self.items[self.scalars[first]][0])
        return np.dtype({'names': names, 'formats': formats, 'offsets': offsets,
                         'itemsize': self.size})

    def rows(self, parts: Sequence[Located]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return the messages as rows of this table, and which of them have its shape."""
        matches = joined([part.lengths for part in parts]) >= self.size
        if not self.size:
            return np.empty(len(matches), 'V1'), matches
        rows = joined([take(part.content, part.offsets, self.size) for part in parts])
        rows = rows.view(self._type)
        for i, word in self._words.items():
            matches &= rows[f'item {i}'] == word
        return rows, matches

    @property
    def fits(self) -> bool:
        """Whether stamps of this layout can be read here: of 32 bits, as all in ROS are."""
        return self.stamp is None or all(self.items[i][1] in _NARROW for i in self.stamp)

    def stamps(self, rows: NDArray[Any]) -> Stamps:
        """Return the header stamps [ns]."""
        assert self.stamp is not None
        seconds, nanoseconds = (rows[f'item {i}'].astype(np.int64) for i in self.stamp)
        return np.asarray(seconds * 1_000_000_000 + nanoseconds)

    @np.errstate(invalid='ignore')  # what is no number may be of the kind that signals
    def fill(self, rows: NDArray[Any], values: Array) -> None:
        """Write the wanted fields of all rows into the columns of `values`."""
        for first, last, code in self._runs:
            run = rows[f'run {first}']
            values[:, first:last] = run != 0 if code == '?' else run


def take(content: Content, offsets: NDArray[np.intp], size: int) -> NDArray[Any]:
    """Return `size` bytes from each of the offsets, of what lies before the end instead."""
    # Windows that overlap: one begins at every byte, and none is copied but those asked for.
    count = len(content) - size + 1
    if count <= 0:
        return np.zeros(len(offsets), f'V{size}')
    windows = np.ndarray(count, f'V{size}', content, 0, (1,))
    return windows[np.minimum(offsets, count - 1)]
