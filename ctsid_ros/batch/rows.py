# SPDX-License-Identifier: Apache-2.0
"""
What a batch keeps of a bag: a Parquet file with a row for each window, or one for its failure.

The metadata of the file say what it was made of: the content of the bag, parameters and version.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctsid_core.errors import StorageError
from ctsid_core.linear.types import Array
from ctsid_core.model.gains import gains
from ctsid_ros.replay.along import Windows, along

if TYPE_CHECKING:
    import pyarrow as pa

    from ctsid_core.model.estimate import Estimate
    from ctsid_ros.replay.replay import Result

SUFFIX = '.parquet'
WINDOWS, FAILURE, AGAIN = 'windows', 'failure', 'again'
UNREAD = 'unread'  # in place of the hash of a bag that cannot be read at all
_PREFIX = 'ctsid.'
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Made:
    """
    What a file of rows was made of.

    Parameters
    ----------
    bag : str
        Absolute path.
    state : str
        Of its files on the disk, see `content.state`.
    content : str
        Hash of its content; UNREAD if it could not be read at all.
    recipe : str
        Key of parameters and version.
    outcome : str
        WINDOWS, FAILURE (of the bag), or AGAIN (the computer failed, and not the bag).
    """

    bag: str
    state: str
    content: str
    recipe: str
    outcome: str


@cache
def schema() -> pa.Schema:
    """Return names and types of the columns."""
    import pyarrow as pa

    number = pa.float64()
    time = pa.timestamp('ns', 'UTC')

    def listed(words: tuple[str, ...], *names: str) -> pa.DataType:
        return pa.list_(pa.struct([*((word, pa.string()) for word in words),
                                   *((name, number) for name in names)]))

    return pa.schema([
        ('bag', pa.string()), ('recorded', time), ('window', pa.int32()),
        ('start', time), ('end', time), ('status', pa.string()), ('verdict', pa.string()),
        ('reason', pa.string()), ('best', pa.bool_()), ('order', pa.int32()),
        ('poles', listed((), 're', 'im', 'std', 'natural_frequency', 'natural_frequency_std',
                         'damping', 'damping_std')),
        ('gains', listed(('input', 'output'), 'gain', 'gain_std', 'rate_gain', 'rate_gain_std')),
        ('fits', listed(('output',), 'fit', 'held_out_fit', 'next_fit')),
        ('delays', listed(('input',), 'delay', 'delay_std')),
        ('bag_verdict', pa.string()), ('bag_reason', pa.string()), ('failure', pa.string())])


def window_rows(bag: str, recorded_ns: int, results: Sequence[Result], best: int | None,
                zero_ns: int) -> Rows:
    """
    Return a row for each window of a bag.

    Parameters
    ----------
    bag : str
    recorded_ns : int
        When its first message was recorded.
    results : sequence of Result
    best : int or None
        Place of the window whose model is kept; None if none was accepted.
    zero_ns : int
        What the reason for the bag counts seconds from.
    """
    place = len(results) - 1 if best is None else best
    windows = Windows.of(results, zero_ns)
    whole = along(windows, place)
    reason = ' '.join((*whole.changed, *whole.failed)) or windows.estimates[place].verdict.reason
    return [{'bag': bag, 'recorded': recorded_ns, 'window': number,
             **_row(result.estimate, result.next_fit), 'best': number - 1 == best,
             'bag_verdict': whole.word, 'bag_reason': reason}
            for number, result in enumerate(results, 1)]


def failure_row(bag: str, failure: str) -> Rows:
    """Return the row of a bag that gave none, and why."""
    return [{'bag': bag, 'failure': failure}]


def write_rows(path: Path, rows: Rows, made: Made) -> None:
    """
    Write rows, whole or not at all.

    Raises
    ------
    StorageError
        If the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    from ctsid_core.model.storage import write_file

    columns = {name: [row.get(name) for row in rows] for name in schema().names}
    table = pa.table(columns, schema().with_metadata(
        {f'{_PREFIX}{key}': value for key, value in asdict(made).items()}))
    stream = io.BytesIO()
    pq.write_table(table, stream, compression='zstd')
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, stream.getvalue(), force=True)


def read_rows(path: Path, columns: Sequence[str] | None = None) -> Rows:
    """
    Return the rows of a file, times as whole nanoseconds.

    Raises
    ------
    StorageError
        If it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.ParquetFile(path).read(columns)
        times = [name for name in ('recorded', 'start', 'end') if name in table.column_names]
        for name in times:  # whole nanoseconds, which Python has no type for
            place = table.column_names.index(name)
            table = table.set_column(place, name, table[name].cast(pa.int64()))
        rows: Rows = table.to_pylist()
    except (OSError, pa.ArrowException) as error:
        raise StorageError(f'{path} cannot be read ({error}); remove it, and run the same '
                           'command again') from error
    return rows


def made_of(path: Path) -> Made | None:
    """Return what a file of rows was made of; None if it is not a whole one of ours."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        found = pq.read_schema(path).metadata or {}
        return Made(*(found[f'{_PREFIX}{name}'.encode()].decode()
                      for name in Made.__dataclass_fields__))
    except (OSError, pa.ArrowException, KeyError):
        return None


def _row(estimate: Estimate, next_fit: Array) -> dict[str, Any]:
    model = estimate.model
    row: dict[str, Any] = {
        'start': estimate.start_ns, 'end': estimate.end_ns, 'status': estimate.status.name,
        'verdict': estimate.verdict.grade.name, 'reason': estimate.verdict.reason,
        'order': None if model is None else model.n}
    shown = model or estimate.rejected_model
    if shown is not None:
        row['fits'] = _structs({'output': shown.output_names}, fit=estimate.fit,
                               held_out_fit=estimate.held_out_fit, next_fit=next_fit)
    if model is None:
        return row
    row['poles'] = _structs({}, re=model.poles.real, im=model.poles.imag,
                            std=estimate.pole_std, natural_frequency=model.natural_frequency,
                            natural_frequency_std=estimate.natural_frequency_std,
                            damping=model.damping, damping_std=estimate.damping_std)
    found = gains(model, estimate.covariance)
    row['gains'] = [] if found is None else _structs(
        {'input': model.input_names * model.ny,
         'output': [name for name in model.output_names for _ in range(model.nu)]},
        **{f'{word}{more}': np.where(found.rate == (word == 'rate_gain'), values, np.nan).ravel()
           for word in ('gain', 'rate_gain')
           for more, values in (('', found.value), ('_std', found.std))})
    row['delays'] = _structs({'input': model.input_names}, delay=np.array(model.delay),
                             delay_std=estimate.delay_std)
    return row


def _structs(words: Mapping[str, Sequence[str]], **columns: Array) -> list[dict[str, Any]]:
    """Return an entry for each place of arrays; none in place of what is not known."""
    count = max(map(len, words.values() or columns.values()), default=0)
    return [{key: names[i] for key, names in words.items()}
            | {key: _number(values, i) for key, values in columns.items()}
            for i in range(count)]


def _number(values: Array, place: int) -> float | None:
    value = float(values[place]) if place < len(values) else np.nan
    return None if np.isnan(value) else value
