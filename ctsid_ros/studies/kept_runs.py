# SPDX-License-Identifier: Apache-2.0
"""
Outcomes of runs in a CSV file: a study that was interrupted goes on where it was.

Every row is a run, written as soon as it is done: names in `COLUMNS`, several numbers in one cell
apart by spaces, matrices by rows; the last cell is written last. Rows are taken again only if the
code that made them is the code that reads them, and NumPy and SciPy are the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
import csv
from functools import cache
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctsid_core.model.statespace import StateSpace
from ctsid_ros.config.origin import code_digest
from ctsid_ros.studies.monte_carlo import Outcome

COLUMNS = ('experiment', 'code', 'seed', 'order', 'status', 'error', 'deviation',
           'A', 'B', 'C', 'D', 'whole')
# Modules of the studies that results do not depend on.
DRAWING = ('clouds', 'network', 'figure_files', 'hd_basis', 'page', 'report_page', 'runner',
           'kept_runs', 'kept_rows', 'tables', 'study')


class KeptRuns:
    """
    The runs of one study.

    Parameters
    ----------
    path : Path
        The file; made when the first run is kept. Rows of other code are left as they are, and so
        is a row that was cut off while it was written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._done: dict[str, dict[int, Outcome]] = {}
        text = path.read_text(encoding='utf-8') if path.exists() else ''
        self._torn = bool(text) and not text.endswith('\n')
        for line in text.splitlines():
            row = next(csv.reader([line]), [])
            if len(row) == len(COLUMNS) and row[1] == code():
                with suppress(ValueError, IndexError):     # damaged, or cut off within a number
                    self._done.setdefault(row[0], {})[int(row[2])] = _outcome(row)
        self._empty = not text

    def of(self, experiment: str) -> dict[int, Outcome]:
        """Return the outcomes of an experiment by their seeds."""
        return dict(self._done.get(experiment, {}))

    def add(self, experiment: str, seed: int, found: Outcome) -> None:
        """Keep one run."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        row = (experiment, code(), str(seed), *_cells(found), 'end')
        with self._path.open('a', encoding='utf-8', newline='') as stream:
            stream.write('\n' * self._torn + _as_text([COLUMNS, row] if self._empty else [row]))
        self._torn = self._empty = False
        self._done.setdefault(experiment, {})[seed] = found


@cache
def code() -> str:
    """Return a digest of the code that results depend on."""
    return code_digest(('ctsid_core', 'ctsid_ros.studies'), DRAWING)


def _as_text(rows: Iterable[Sequence[str]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator='\n').writerows(rows)
    return stream.getvalue()


def _cells(found: Outcome) -> tuple[str, ...]:
    m = found.model
    entries = ('',) * 4 if m is None else tuple(_numbers(x) for x in (m.A, m.B, m.C, m.D))
    return (str(found.order), found.status, _numbers(found.error), _numbers(found.deviation),
            *entries)


def _outcome(row: list[str]) -> Outcome:
    order, status = int(row[3]), row[4]
    error = np.array([complex(x) for x in row[5].split()])
    model = None
    if row[7]:
        A, B, C, D = (_array(cell) for cell in row[7:11])
        n = round(np.sqrt(len(A)))
        ny, nu = len(C) // n, len(B) // n
        model = StateSpace(A.reshape(n, n), B.reshape(n, nu), C.reshape(ny, n), D.reshape(ny, nu))
    return Outcome(error, _array(row[6]), order, status, model)


def _numbers(values: NDArray[np.generic]) -> str:
    return ' '.join(str(x) for x in values.ravel().tolist())


def _array(cell: str) -> NDArray[np.float64]:
    return np.array([float(x) for x in cell.split()])
