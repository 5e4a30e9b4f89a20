# SPDX-License-Identifier: Apache-2.0
"""
Models and series of estimates in files.

One model: JSON (see `model_json`). Many windows: NPZ for programs, CSV for people and plots.
Files are written under a temporary name beside the final one and then renamed, so that a reader
never meets half of one. Nothing is overwritten unless `force` is given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
import csv
import io
import os
from pathlib import Path
from typing import Any
import uuid
import zipfile
import zlib

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError, StorageError
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.gains import gains
from ctsid_core.model.model_json import from_json, parse, to_json
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Actuator, Settings

__all__ = ['from_json', 'load_estimate', 'load_metadata', 'load_model', 'load_series',
           'save_model', 'save_series', 'to_json', 'write_file']

SERIES_FORMAT = 'ctsid-series'
SERIES_VERSION = 1
PER_POLE = ('re [rad/s]', 'im [rad/s]', 'std [rad/s]', 'natural_frequency [rad/s]',
            'natural_frequency_std [rad/s]', 'damping', 'damping_std')
PER_INPUT = (('delay', ' [s]'), ('delay_std', ' [s]'), ('timeout', ' [s]'),
             *((kind, '') for kind in Actuator._fields[1:]))      # and the unit, but the input's
PER_PAIR = ('gain', 'gain_std', 'rate_gain', 'rate_gain_std')       # of an output and an input


def save_model(path: str | os.PathLike[str], estimate: Estimate | StateSpace,
               metadata: Mapping[str, object] | None = None, *, force: bool = False) -> None:
    """
    Write an estimate, or a model by itself, as JSON.

    Parameters
    ----------
    path : path-like
    estimate : Estimate or StateSpace
    metadata : mapping, optional
        What else to keep (name of the bag, versions): names to words, numbers, lists or mappings.
    force : bool
        Whether an existing file may be replaced.

    Raises
    ------
    StorageError
        If the file exists, or cannot be written.
    """
    if isinstance(estimate, StateSpace):
        estimate = Estimate(status=Status.OK, settings=Settings(), model=estimate, notes=(
            'This model was stored by itself; the settings are not those of its identification.',))
    write_file(path, to_json(estimate, metadata).encode(), force=force)


def load_estimate(path: str | os.PathLike[str]) -> Estimate:
    """
    Read what `save_model` has written, equal to the last bit.

    Raises `StorageError` if the file cannot be read, is not a model file, or of a newer version.
    """
    return _load(path)[0]


def load_model(path: str | os.PathLike[str]) -> StateSpace:
    """
    Read the model of a file that `save_model` has written, equal to the last bit.

    Raises like `load_estimate`, and if the identification gave no accepted model.
    """
    estimate = load_estimate(path)
    if estimate.model is None:
        raise StorageError(f'{path} holds no accepted model: {estimate.status.value} (A rejected '
                           'one, if any, is in load_estimate(path).rejected_model.)')
    return estimate.model


def load_metadata(path: str | os.PathLike[str]) -> dict[str, object]:
    """Read the metadata of a model file; raises like `load_estimate`."""
    return _load(path)[1]


def _load(path: str | os.PathLike[str]) -> tuple[Estimate, dict[str, object]]:
    data = _read_file(path)
    try:
        return parse(data.decode())
    except UnicodeDecodeError as error:
        raise StorageError(f'{path}: not a text file ({error.reason}); choose a model.json that '
                           'ctsid has written') from error
    except StorageError as error:
        raise StorageError(f'{path}: {error}') from error


def save_series(path: str | os.PathLike[str], estimates: Sequence[Estimate], *,
                columns: Mapping[str, Sequence[float]] | None = None,
                force: bool = False) -> None:
    """
    Write the estimates of many windows; the suffix of the path decides how.

    '.csv': one row per window: window, status, verdict, order, poles with standard deviation,
    natural frequency and damping (with theirs), fits. '.npz': the same and the matrices as arrays
    with one entry per window, padded with NaN to the largest order, and each whole estimate as
    JSON. Columns are further numbers, by name with unit: one per estimate.

    Raises `StorageError` if the suffix is another, or like `save_model`, and `DataError` if a
    column is of another length.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in ('.csv', '.npz'):
        raise StorageError(f'{path} ends in {suffix!r}; name it .csv or .npz')
    columns = columns or {}
    for name, values in columns.items():
        if len(values) != len(estimates):
            raise DataError(f'column {name!r} has {len(values)} numbers for {len(estimates)} '
                            'estimates; give one for each')
    data = (_csv if suffix == '.csv' else _npz)(estimates, columns)
    write_file(path, data, force=force)


def load_series(path: str | os.PathLike[str]) -> tuple[Estimate, ...]:
    """
    Read the estimates of an NPZ file that `save_series` has written, equal to the last bit.

    Raises `StorageError` if the file cannot be read, is not such a file, or of a newer version.
    """
    data = _read_file(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            if 'format' not in found or str(found['format']) != SERIES_FORMAT:
                raise StorageError('it holds other arrays')
            version, texts = int(found['version']), found['json'].tolist()
    except (StorageError, ValueError, KeyError, OSError, EOFError, TypeError, AttributeError,
            zipfile.BadZipFile, zlib.error) as error:
        raise StorageError(f'{path}: not a {SERIES_FORMAT} file, or cut off ({error}); choose an '
                           'estimates.npz that ctsid has written') from error
    if version > SERIES_VERSION:
        raise StorageError(f'{path}: written by a newer ctsid (version {version}; this one reads '
                           f'up to {SERIES_VERSION}); upgrade ctsid')
    try:
        return tuple(from_json(text.decode()) for text in texts)
    except StorageError as error:
        raise StorageError(f'{path}: {error}') from error


def _csv(estimates: Sequence[Estimate], columns: Mapping[str, Sequence[float]]) -> bytes:
    order = max((e.model.n for e in estimates if e.model), default=0)
    given = next((m for e in estimates for m in (e.model, e.rejected_model) if m), None)
    outputs = _called('y', given.output_names if given else (), max(
        (max(len(e.fit), len(e.held_out_fit)) for e in estimates), default=0))
    inputs = _called('u', given.input_names if given else ())
    ny, pairs = len(outputs), [f'{y}/{u}' for y in outputs for u in inputs]
    stream = io.StringIO(newline='')
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(('start_ns', 'end_ns', 'status', 'verdict', 'order',
                     *(f'pole{k + 1}_{what}' for k in range(order) for what in PER_POLE),
                     *(f'{what}_{name}{unit}' for what, unit in PER_INPUT for name in inputs),
                     *(f'{what}_{pair}' for what in PER_PAIR for pair in pairs),
                     *(f'fit_{name} [%]' for name in outputs),
                     *(f'held_out_fit_{name} [%]' for name in outputs), *columns))
    for i, e in enumerate(estimates):
        cells = (*_pole_cells(e, order), *_input_cells(e, ny, len(inputs)),
                 *_padded(e.fit, (ny,)), *_padded(e.held_out_fit, (ny,)),
                 *(float(values[i]) for values in columns.values()))
        writer.writerow((e.start_ns, e.end_ns, e.status.name, e.verdict.grade.name,
                         e.model.n if e.model else '',
                         *('' if np.isnan(x) else repr(float(x)) for x in cells)))
    return stream.getvalue().encode()


def _called(letter: str, names: Sequence[str], least: int = 0) -> list[str]:
    """Return names of channels, a letter and a number for those that have none."""
    return [name or f'{letter}{i + 1}'
            for i, name in enumerate((*names, *('',) * (least - len(names))))]


def _pole_cells(estimate: Estimate, order: int) -> Array:
    """Return what `PER_POLE` says of each pole, NaN up to the largest order."""
    m, cells = estimate.model, np.empty((0, len(PER_POLE)))
    if m is not None:
        cells = np.column_stack((
            m.poles.real, m.poles.imag, _padded(estimate.pole_std, (m.n,)), m.natural_frequency,
            estimate.natural_frequency_std, m.damping, estimate.damping_std))
    return _padded(cells, (order, len(PER_POLE))).ravel()


def _input_cells(estimate: Estimate, ny: int, nu: int) -> Array:
    """Return what `PER_INPUT` and `PER_PAIR` say; NaN what is not known."""
    m, own = estimate.model, np.full((len(PER_INPUT), nu), np.nan)
    found = np.full((4, ny, nu), np.nan)
    if m is not None:
        own[:] = m.delay, estimate.delay_std, *zip(*m.actuators, strict=True)
        if known := gains(m, estimate.covariance):
            for k, rate in enumerate((False, True)):
                found[2 * k:2 * k + 2] = np.where(
                    known.rate == rate, (known.value, known.std), np.nan)
    return np.concatenate((own.ravel(), found.ravel()))


def _padded(values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    whole = np.full(shape, np.nan, dtype=values.dtype)
    whole[tuple(slice(size) for size in values.shape)] = values
    return whole


def _npz(estimates: Sequence[Estimate], columns: Mapping[str, Sequence[float]]) -> bytes:
    arrays: dict[str, Any] = {
        'format': SERIES_FORMAT, 'version': SERIES_VERSION,
        'start_ns': np.array([e.start_ns for e in estimates], dtype=np.int64),
        'end_ns': np.array([e.end_ns for e in estimates], dtype=np.int64),
        'status': np.array([e.status.name for e in estimates], dtype=str),
        'verdict': np.array([e.verdict.grade.name for e in estimates], dtype=str),
        'reason': np.array([e.verdict.reason for e in estimates], dtype=str),
        'order': np.array([e.model.n if e.model else 0 for e in estimates], dtype=np.int64),
        'condition': np.array([e.condition for e in estimates], dtype=float),
        'json': np.array([to_json(e).encode() for e in estimates], dtype=bytes)}
    for name in ('pole_std', 'natural_frequency_std', 'damping_std', 'fit', 'held_out_fit',
                 'singular_values'):
        arrays[name] = _stacked([getattr(e, name) for e in estimates])
    models = [e.model for e in estimates]
    for k, kind in enumerate(Actuator._fields):
        arrays[kind] = _stacked([np.array([own[k] for own in m.actuators]) if m else np.empty(0)
                                 for m in models])
    for name in ('A', 'B', 'C', 'D', 'K', 'x_trim', 'y_trim', 'delay', 'poles',
                 'natural_frequency', 'damping'):
        rank = 2 if name in 'ABCDK' else 1
        arrays[name] = _stacked([np.asarray(getattr(m, name)) if m else np.empty((0,) * rank)
                                 for m in models])
    arrays |= {name: np.array(values, dtype=float) for name, values in columns.items()}
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _stacked(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
    if not values:
        return np.empty(0)
    kind = np.result_type(*values)
    shape = tuple(np.max([v.shape for v in values], axis=0))
    return np.array([_padded(v.astype(kind), shape) for v in values])


def _read_file(path: str | os.PathLike[str]) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise StorageError(f'{path} cannot be read ({error.strerror}); check the path and the '
                           'permissions') from error


def write_file(path: str | os.PathLike[str], data: bytes, *, force: bool = False) -> None:
    """
    Write a file under a temporary name and rename it.

    Raises `StorageError` if it exists and `force` is not given, or it cannot be written.
    """
    target = Path(path)
    if target.is_dir() or (os.path.lexists(target) and not force):
        cure = 'choose another name' if target.is_dir() else 'choose another name, or force it'
        raise StorageError(f'{path} exists already; {cure}')
    draft = target.with_name(f'.{target.name}.{uuid.uuid4().hex[:8]}.tmp')
    try:
        with open(draft, 'xb') as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(draft, target)
    except OSError as error:
        raise StorageError(f'{path} cannot be written ({error.strerror}); check that the folder '
                           'exists, is writable and has room') from error
    finally:
        with suppress(OSError):  # renamed, or never made
            draft.unlink()
