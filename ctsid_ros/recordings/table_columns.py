# SPDX-License-Identifier: Apache-2.0
"""
Tables of columns with one or several times: from columns to series.

The topic is the name of the file, with that of the time if there are several: each is that of the
columns that follow it. Columns that are filled in other rows than the rest are sampled at other
times: a topic of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import itertools
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Stamps
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.recording import Recording
from ctsid_ros.recordings.series import Series, plain_name, recording
from ctsid_ros.recordings.table_times import (
    Column,
    Time,
    constant_rate,
    find_times,
    joined_seconds,
    read_times,
    split_unit,
)

# Of the rows that either of two columns fills both do: sampled together, but for lost samples. A
# sensor of half the rate fills half.
_ALIKE = 2 / 3
# Rows on both sides of a step back that lie in the same time: two runs. Rows that a network has
# swapped are fewer; and of one time that is false, all others are on one side.
_RUN = 20
_NEAR = 1000  # rows before it that are looked at
_ENDINGS = re.compile(r'(\.(csv|tsv|txt|dat|log|parquet|pq|gz|bz2|xz|zstd?))+$', re.IGNORECASE)
_UNIT = re.compile(r'(.*\S)\s*[\[(<]\s*([^\d\])>][^\])>]*)[\])>]')


def column_of(title: str, values: NDArray[Any]) -> Column:
    """Return a column; its title may have a unit (`t [s]`), and slashes (`/imu/rate/x`)."""
    title = title.strip().lstrip('#%').strip()
    unit = ''
    if found := _UNIT.fullmatch(title):
        title, unit = found[1], found[2].strip()
    name = title.strip('/').replace('/', '.')
    name = re.sub(r'\.(\d+)(?=\.|$)', r'[\1]', name)
    return Column(name, unit, values)


def table_recording(path: Path, columns: Sequence[Column], wanted: Sequence[str],
                    notes: Sequence[str], texts: Mapping[str, str]) -> Recording:
    """
    Return a table as what a file of a bag is.

    Parameters
    ----------
    path : Path
    columns : sequence of Column
    wanted : sequence of str
        Names of the time columns, with or without a unit (`t:ms`), or the rate of the rows
        (`100Hz`); told by the table if empty.
    notes : sequence of str
        On what was left out so far.
    texts : mapping of str to str
        Columns of text that were left out, and what they begin with.

    Raises
    ------
    BagError
        If no column is a time, or starts again, or none is left beside it.
    """
    stem = plain_name(_ENDINGS.sub('', path.name))
    columns = joined_seconds(columns)
    empty = [column.name for column in columns if not column.known.any()]
    columns = [column for column in columns if column.name not in empty]
    said = list(notes)
    if empty:
        said.append(f'{path.name}: left out, for they are empty: {", ".join(empty)}')
    if rate := constant_rate(wanted, columns):
        rows = np.arange(len(columns[0].values)) if columns else np.empty(0)
        columns, wanted = [Column(wanted[0], 's', rows / rate), *columns], wanted[:1]
    at = find_times(columns, wanted, str(path), texts)
    names = [column.name for column in columns]
    units = dict(split_unit(text, names) for text in wanted)
    times = read_times([columns[i] for i in at], units)
    series: list[Series] = []
    for number, (i, time) in enumerate(zip(at, times, strict=True)):
        end = at[number + 1] if number + 1 < len(at) else len(columns)
        own = [*(columns[:i] if number == 0 else ()), *columns[i + 1:end]]
        topic = stem if len(at) == 1 else f'{stem}/{plain_name(time.name)}'
        said += _remarks(path, columns[i], time, len(at) > 1)
        series += _sampled_together(topic, time, [c for c in own if not c.is_date])
    if not series:
        raise BagError(f'{path}: there is no column of numbers beside the time '
                       f'({", ".join(time.name for time in times)})')
    for one in series:
        if count := _first_run(one.log_ns):
            raise BagError(f'{path}: time starts again after {count} rows of {one.topic}: these '
                           'are several runs; put each into a file of its own (if they are one, '
                           'whose rows are not in order, sort them by time)')
    return recording(series, said, alone=stem,
                     own_clock=not all(time.is_date for time in times))


def _first_run(log_ns: Stamps) -> int:
    """Return after how many rows time starts again; 0 if it does not."""
    back = np.flatnonzero(np.diff(log_ns) < 0) + 1
    if not len(back):
        return 0
    behind = np.add.reduceat(log_ns < np.maximum.accumulate(log_ns), back)
    return next((at for at in back[behind >= _RUN].tolist()
                 if np.count_nonzero(log_ns[max(at - _NEAR, 0):at] > log_ns[at]) >= _RUN), 0)


def _remarks(path: Path, column: Column, time: Time, several: bool) -> Iterator[str]:
    known = column.known
    lost, back = int(np.count_nonzero(~known)), int((np.diff(time.log_ns[known]) < 0).sum())
    if time.note:
        yield f'{path.name}: {time.note}'
    if lost and not several:
        yield f'{path.name}: rows left out, for their time ({time.name}) is empty: {lost}'
    if back:
        yield (f'{path.name}: places where {time.name} goes back: {back}; the rows were put in '
               'the order of time')


def _sampled_together(topic: str, time: Time, columns: Sequence[Column]) -> Iterator[Series]:
    """Make a topic of the columns that are filled in the same rows."""
    rows = time.log_ns > 0
    groups: list[tuple[NDArray[np.bool_], list[Column]]] = []
    for column in columns:
        filled = column.known & rows
        if not filled.any():
            continue
        for known, members in groups:
            if (known & filled).sum() >= _ALIKE * (known | filled).sum():
                members.append(column)
                break
        else:
            groups.append((filled, [column]))
    taken: set[str] = set()
    for filled, members in groups:
        whole = filled.sum() >= _ALIKE * rows.sum() and topic not in taken
        name = topic if whole else f'{topic}/{_common([c.name for c in members], groups)}'
        taken.add(name)
        some = np.any([c.known for c in members], axis=0) & rows
        yield Series(name, 'table', 'Row', time.log_ns[some],
                     {c.name: c.values[some] for c in _distinct(members)},
                     units={c.name: c.unit for c in _distinct(members)})


def _common(names: Sequence[str], groups: Sequence[tuple[Any, Sequence[Column]]]) -> str:
    """Return the path that the names of a group share and no other group's; else the first."""
    inner = [re.split(r'[.\[]', name)[:-1] for name in names]
    prefix = '.'.join(itertools.takewhile(bool, (
        same[0] if len(set(same)) == 1 else '' for same in zip(*inner, strict=False))))
    having = [members for _, members in groups if any(
        column.name.startswith((f'{prefix}.', f'{prefix}[')) for column in members)]
    return re.sub(r'\s+', '_', prefix if prefix and len(having) == 1 else names[0])


def _distinct(columns: Sequence[Column]) -> Iterator[Column]:
    """Number columns of the same name."""
    seen: dict[str, int] = {}
    for column in columns:
        seen[column.name] = count = seen.get(column.name, 0) + 1
        yield column if count == 1 else Column(f'{column.name}_{count}', column.unit,
                                               column.values)
