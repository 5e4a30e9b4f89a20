# SPDX-License-Identifier: Apache-2.0
"""Parquet files, by pyarrow: tables with typed columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.errors import BagError, lacks_extra
from ctsid_ros.recordings.recording import Recording
from ctsid_ros.recordings.table_columns import column_of, table_recording

MAGIC = b'PAR1'
_MOST = 64  # elements of a list that become columns


def scan_parquet(path: Path, time: Sequence[str] = ()) -> Recording:
    """
    Read a Parquet file.

    Parameters
    ----------
    path : Path
    time : sequence of str
        Names of the columns that are times.

    Raises
    ------
    BagError
        If pyarrow is not installed, nothing of the file can be read, or no column is a time.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise BagError(lacks_extra(error, f'{path} is a Parquet file: to read it', 'parquet')
                       ) from None
    notes: list[str] = []
    try:
        with parquet.ParquetFile(path) as file:
            table = _groups(file, path, notes)
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError) as error:
        raise BagError(f'{path}: the file is cut off or damaged ({_line(error)}); the description '
                       'of a Parquet file is at its end, so nothing can be recovered') from None
    words: dict[str, str] = {}  # and what they begin with
    columns = [column_of(name, values) for name, column in _flat(table)
               for name, values in _arrays(name, column, words)]
    if words:
        notes.append(f'{path.name}: left out, for they are no numbers: {", ".join(words)}')
    return table_recording(path, columns, time, notes, words)


def _groups(file: Any, path: Path, notes: list[str]) -> Any:
    """Read all groups of rows that can be read."""
    import pyarrow

    groups, lost, why = [], 0, ''
    for i in range(file.num_row_groups):
        try:
            groups.append(file.read_row_group(i))
        except (pyarrow.ArrowException, OSError) as error:
            lost += file.metadata.row_group(i).num_rows
            why = _line(error)
    if lost:
        notes.append(f'{path.name}: damaged: {lost} of {file.metadata.num_rows} rows left out '
                     f'({why})')
    if not groups:
        raise OSError(why or 'it has no rows')
    return pyarrow.concat_tables(groups)


def _line(error: Exception) -> str:
    return str(error).splitlines()[0][:120] if str(error) else type(error).__name__


def _flat(table: Any) -> Iterator[tuple[str, Any]]:
    """Yield columns; those inside of structures by their path."""
    import pyarrow

    while any(pyarrow.types.is_struct(entry.type) for entry in table.schema):
        table = table.flatten()
    for name, column in zip(table.column_names, table.columns, strict=True):
        yield name, column.combine_chunks()


def _arrays(name: str, column: Any, words: dict[str, str]
            ) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the numbers of a column; of one of lists, those at each place."""
    import pyarrow
    from pyarrow import compute, types

    kind = column.type
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        length = compute.max(compute.list_value_length(column)).as_py() or 0
        if length > _MOST or not (types.is_integer(kind.value_type)
                                  or types.is_floating(kind.value_type)):
            words[name] = next(map(str, column), '')
            return
        whole = compute.equal(compute.list_value_length(column), length)
        short = column.filter(whole)
        for i in range(length):
            values = np.full(len(column), np.nan)
            values[whole.fill_null(False).to_numpy(zero_copy_only=False)] = \
                compute.list_element(short, i).to_numpy(zero_copy_only=False)
            yield f'{name}[{i}]', values
    elif types.is_timestamp(kind) or types.is_date(kind):
        yield name, column.cast(pyarrow.timestamp('ns')).to_numpy(
            zero_copy_only=False).astype('datetime64[ns]')
    elif types.is_duration(kind):
        counts = column.cast(pyarrow.duration('ns')).cast(pyarrow.int64())
        yield name, counts.cast(pyarrow.float64()).to_numpy(zero_copy_only=False) * 1e-9
    elif types.is_boolean(kind) or types.is_decimal(kind) or (
            types.is_integer(kind) and column.null_count):
        yield name, column.cast(pyarrow.float64()).to_numpy(zero_copy_only=False)
    elif types.is_integer(kind) or types.is_floating(kind):
        yield name, column.to_numpy(zero_copy_only=False)
    else:
        words[name] = next(map(str, column), '')
