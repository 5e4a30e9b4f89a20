# SPDX-License-Identifier: Apache-2.0
"""Rows of the exam in a CSV file: one that was interrupted goes on where it was."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import csv
from dataclasses import fields
import io
from pathlib import Path
from typing import Any

from ctsid_ros.studies.kept_runs import code
from ctsid_ros.studies.robots.scoring import Row

NAMES = tuple(f.name for f in fields(Row))
COLUMNS = ('experiment', 'code', *NAMES, 'whole')


class KeptRows:
    """
    The rows of an exam; those of other code are left as they are, and count for nothing.

    Parameters
    ----------
    path : Path
        The file; made when the first row is kept.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._done: dict[str, dict[int, Row]] = {}
        text = path.read_text(encoding='utf-8') if path.exists() else ''
        self._torn, self._empty = bool(text) and not text.endswith('\n'), not text
        for cells in csv.reader(text.splitlines()):
            if len(cells) == len(COLUMNS) and cells[1] == code():
                with suppress(ValueError):          # cut off within a number
                    row = _row(cells[2:-1])
                    self._done.setdefault(cells[0], {})[row.number] = row

    def of(self, experiment: str) -> dict[int, Row]:
        """Return the rows of an experiment by their numbers."""
        return dict(self._done.get(experiment, {}))

    def add(self, experiment: str, seed: int, found: Row) -> None:
        """Keep one row."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator='\n')
        if self._empty:
            writer.writerow(COLUMNS)
        writer.writerow((experiment, code(), *_cells(found), 'end'))
        with self._path.open('a', encoding='utf-8', newline='') as file:
            file.write('\n' * self._torn + stream.getvalue())
        self._torn = self._empty = False
        self._done.setdefault(experiment, {})[seed] = found


def _cells(row: Row) -> list[str]:
    values = [getattr(row, name) for name in NAMES]
    return [' '.join(str(x) for x in v) if isinstance(v, tuple) else
            ' '.join(v.split()) if isinstance(v, str) else str(v) for v in values]


def _row(cells: list[str]) -> Row:
    readers: dict[str, Callable[[str], Any]] = {
        'int': int, 'float': float, 'bool': 'True'.__eq__, 'str': str,
        'tuple[float, ...]': lambda cell: tuple(float(x) for x in cell.split())}
    values = {f.name: readers[str(f.type)](cell)
              for f, cell in zip(fields(Row), cells, strict=True)}
    return Row(**values)
