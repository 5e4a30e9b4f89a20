# SPDX-License-Identifier: Apache-2.0
"""The tables of the exam: by family, by kind of input, all together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ctsid_ros.report.tables import Table
from ctsid_ros.studies.robots.scoring import Row

HEAD = ('n', 'usable', 'GOOD of usable', 'false no', 'wrong GOOD', 'GOOD', 'near reachable',
        'divergent', 'median s', 'most s')


def cells(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return what rows amount to: shares are of the usable ones."""
    usable = [r for r in rows if r.usable]
    late = sum(r.grade == 'LATE' for r in rows)
    seconds = [r.seconds for r in rows]
    return (str(len(rows)), str(len(usable)), _share([r.good for r in usable]),
            str(sum(r.false_no for r in rows)), str(sum(r.wrong for r in rows)),
            str(sum(r.good for r in rows)), _share([r.near for r in usable]),
            str(sum(r.divergent for r in rows)), f'{np.median(seconds):.2f}',
            f'{max(seconds):.1f}' + (f' ({late} late)' if late else ''))


def _share(flags: Sequence[bool]) -> str:
    return f'{100.0 * np.mean(flags):.0f} %' if flags else '-'


def grouped(rows: Sequence[Row], by: Callable[[Row], str], title: str) -> Table:
    """Return a table with a row for each value of something, in the order of appearance."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(by(row), []).append(row)
    groups['all'] = list(rows)
    lines = tuple((name, *cells(group)) for name, group in groups.items() if group)
    return Table((title, *HEAD), lines, (title,))


def by_family(rows: Sequence[Row]) -> Table:
    """Return the table of the families."""
    return grouped(rows, lambda row: row.family, 'family')


def by_kind(rows: Sequence[Row]) -> Table:
    """Return the table of the kinds of input, of records that have a right model."""
    right = sorted((r for r in rows if r.judge != 'none'), key=lambda row: row.kind)
    return grouped(right, lambda row: row.kind, 'input')
