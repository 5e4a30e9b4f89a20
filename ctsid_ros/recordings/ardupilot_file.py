# SPDX-License-Identifier: Apache-2.0
"""
ArduPilot's binary logs (.bin), by pymavlink; sound or cut off.

pymavlink knows the formats and finds where messages lie; their columns are read from there all at
once. A topic is a message and its instance: `RATE`, `IMU`, and `IMU.1` for the second one. Times
(`TimeUS`) are those since the autopilot was started. Values are scaled as their format says.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import io
import os
from pathlib import Path
from typing import Any

import numpy as np

from ctsid_ros.decoding.table import take
from ctsid_ros.errors import BagError, lacks_extra
from ctsid_ros.recordings.recording import Recording
from ctsid_ros.recordings.series import Series, left_out, plain_name, recording, sound_times

MAGIC = b'\xa3\x95\x80'
_HEAD = 3  # bytes before each message
_PAGE = 528  # bytes: logs of flash memory end with a page that is not full
_TIMES = {'TimeUS': 1000, 'TimeMS': 1_000_000}
# Those that describe the log, not the flight.
_DEFINITIONS = {'FMT', 'FMTU', 'UNIT', 'MULT', 'PARM', 'FILE'}


def scan_ardupilot(path: Path) -> Recording:
    """
    Read a binary log of ArduPilot.

    Raises
    ------
    BagError
        If pymavlink is not installed, or nothing of the file can be read.
    """
    try:
        from pymavlink.DFReader import DFReader_binary
    except ImportError as error:
        raise BagError(lacks_extra(error, f'{path} is an ArduPilot log: to read it', 'ardupilot')
                       ) from None
    notes: list[str] = []
    try:
        with _silence():
            log = DFReader_binary(str(path))
        try:
            series = list(_all_series(log, path, notes))
            gaps, tail, cut = _unread(log)
        finally:
            log.close()
    except OSError:
        raise
    except Exception as error:  # its parser raises all sorts where bytes are damaged
        raise BagError(f'{path}: the log is damaged ({type(error).__name__}: {error}); nothing '
                       'can be recovered') from None
    count = sum(map(len, series))
    if not count:
        raise BagError(f'{path}: the log is cut off or damaged before its first message; nothing '
                       'can be recovered')
    if gaps or (tail >= _PAGE and not cut):
        notes.append(f'{path.name}: damaged: {count} messages read, those in damaged places are '
                     'lost; such a log has no checksums, so what is false within messages cannot '
                     'be told')
    if cut:
        notes.append(f'{path.name}: truncated: {count} messages recovered (the log ends within '
                     'its last message)')
    return recording(series, notes, own_clock=True)


@contextmanager
def _silence() -> Iterator[None]:
    """Keep pymavlink from the terminal: it writes a line for each damaged byte, and in C."""
    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        with redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)


def _unread(log: Any) -> tuple[int, int, bool]:
    """Return the bytes between messages, those after the last, and whether it is cut off."""
    found = [(np.asarray(log.offsets[number], np.intp) + form.len, form.len)
             for number, form in log.formats.items() if len(log.offsets[number])]
    whole = [(ends[ends <= log.data_len], length) for ends, length in found]
    last = max((int(np.max(ends)) for ends, _ in whole if len(ends)), default=0)
    # pymavlink does not look at the head of a message with nothing behind it.
    begun = 0 < log.data_len - last <= _HEAD and MAGIC.startswith(log.data_map[last:][:2])
    return (last - sum(len(ends) * length for ends, length in whole), log.data_len - last, begun
            or any(len(own) < len(ends) for (ends, _), (own, _) in zip(found, whole, strict=True)))


def _all_series(log: Any, path: Path, notes: list[str]) -> Iterator[Series]:
    for number, form in sorted(log.formats.items()):
        if form.name in _DEFINITIONS or not len(log.offsets[number]):
            continue
        kind, scales, times = _layout(form)
        if not times or kind.itemsize + _HEAD != form.len:
            continue  # it has no time, or is not what its format says
        offsets = np.asarray(log.offsets[number], dtype=np.intp) + _HEAD
        whole = offsets + kind.itemsize <= log.data_len
        rows = take(log.data_map, offsets[whole], kind.itemsize).view(kind)
        yield from _instances(form, rows, scales, times, path, notes)


def _layout(form: Any) -> tuple[np.dtype[Any], dict[str, float], list[str]]:
    """Return type and scales of the columns of a message, and which of them are times."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    fields: list[tuple[str, str]] = []
    scales: dict[str, float] = {}
    for name, letter in zip(form.columns, form.format, strict=False):
        code, scale, _ = FORMAT_TO_STRUCT[letter]
        fields.append((name, f'S{code[:-1]}' if code.endswith('s') else '<' + code))
        scales |= {name: scale} if scale else {}
    return np.dtype(fields), scales, [name for name in _TIMES if name in form.columns]


def _instances(form: Any, rows: np.ndarray[Any, Any], scales: dict[str, float], times: list[str],
               path: Path, notes: list[str]) -> Iterator[Series]:
    log_ns, sound = sound_times(rows[times[0]], _TIMES[times[0]])
    notes += left_out(path, form.name, sound)
    which = rows[form.instance_field] if form.instance_field else np.zeros(len(rows), np.uint8)
    if which.dtype.kind not in 'iu':  # a name for each: NVF has a row for every quantity
        return
    for instance in np.unique(which[sound]).tolist():
        own = sound & (which == instance)
        columns = {name: rows[name][own] * scales[name] if name in scales else rows[name][own]
                   for name in rows.dtype.names or () if rows[name].dtype.kind in 'iuf'
                   and name not in (*times, form.instance_field)}
        if columns:
            yield Series(form.name + (f'.{instance}' if instance else ''), 'ardupilot',
                         plain_name(form.name), log_ns[own], columns)
