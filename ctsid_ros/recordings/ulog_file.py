# SPDX-License-Identifier: Apache-2.0
"""
PX4 ULog files, by pyulog; sound, cut off or damaged (https://docs.px4.io/main/en/dev_log).

A topic is a message and its instance: `vehicle_attitude`, and `sensor_gyro.1` for the second one.
Times are those since the autopilot was started: when a message was published (log), and of what
is measured also when it was sampled (`timestamp_sample`, the header stamp here).
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import redirect_stdout
import io
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.errors import BagError, lacks_extra
from ctsid_ros.recordings.recording import Recording
from ctsid_ros.recordings.series import Series, left_out, recording, sound_times

MAGIC = b'ULog\x01\x12\x35'
_TIMES = ('timestamp', 'timestamp_sample')
# What acts does so from its publishing on; `timestamp_sample` is that of the gyro it answers to.
_COMMAND = re.compile('setpoint|actuator|command|control')
_LATEST = 60_000_000  # us: a first message may come so long after all others, or as a log lasts
_ATTITUDE = re.compile(r'(^|\.)q(_d)?\[3\]$')


def scan_ulog(path: Path) -> Recording:
    """
    Read a ULog file.

    Raises
    ------
    BagError
        If pyulog is not installed, or nothing of the file can be read.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise BagError(lacks_extra(error, f'{path} is a PX4 ULog: to read it', 'px4')) from None
    try:
        with _Watched(io.FileIO(path)) as file, redirect_stdout(io.StringIO()):
            log = ULog(file)
    except OSError:
        raise
    except Exception as error:  # its parser raises all sorts where bytes are damaged
        raise BagError(f'{path}: the file is damaged before its first message '
                       f'({type(error).__name__}: {error}); nothing can be recovered') from None
    notes: list[str] = []
    span = _span_us(log)
    series = [one for data in log.data_list if (one := _series(data, span, path, notes))]
    count = sum(map(len, series))
    if not count:
        raise BagError(f'{path}: the file is cut off or damaged before its first message; nothing '
                       'can be recovered')
    if log.file_corruption:
        notes.append(f'{path.name}: damaged: {count} messages read, those in damaged places are '
                     'lost; a ULog has no checksums, so what is false within messages cannot be '
                     'told')
    elif file.cut:
        notes.append(f'{path.name}: truncated: {count} messages recovered (the file ends within '
                     'one: the logger was not stopped, or the copy is not complete)')
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts) * 1e-3
        times = 'once' if len(log.dropouts) == 1 else f'{len(log.dropouts)} times'
        notes.append(f'{path.name}: the logger dropped messages {times}, for {lost:.2g} s in all: '
                     'the card could not keep up')
    return recording(series, notes, own_clock=True)


class _Watched(io.BufferedReader):
    """A file that knows whether it ended within what was read last: pyulog does not tell."""

    cut = False

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        # At the end, pyulog asks for three more bytes, the head of a message.
        self.cut = len(data) < (size or 0) and (size, len(data)) != (3, 0)
        return data


def _span_us(log: Any) -> tuple[int, int]:
    """
    Return when the log begins and ends.

    The first message of a topic may be one that was waiting when the logger began: it was
    published long before, or its time is even that of an earlier run.
    """
    later = [data.data['timestamp'][1:] for data in log.data_list if 'timestamp' in data.data]
    known = np.concatenate([np.empty(0, np.uint64), *later])
    sound = known[sound_times(known, 1000)[1]]
    start = int(log.start_timestamp)
    return start, max(int(np.max(sound, initial=0)), start)


def _series(data: Any, span_us: tuple[int, int], path: Path, notes: list[str]) -> Series | None:
    text = {entry.field_name for entry in data.field_data if entry.type_str == 'char'}
    columns = {name: column for name, column in data.data.items()
               if name not in _TIMES and name not in text and '_padding' not in name}
    time = data.data.get('timestamp')
    if time is None or not columns:
        return None
    topic = data.name + (f'.{data.multi_id}' if data.multi_id else '')
    start, end = span_us
    if len(time) and time[0] and (time[0] < start or time[0] > end + max(end - start, _LATEST)):
        time = np.concatenate((np.clip(time[:1], start, end), time[1:]))
    log_ns, sound = sound_times(time, 1000)
    notes += left_out(path, topic, sound)
    columns |= _quaternions(columns)
    if not sound.all():
        columns = {name: column[sound] for name, column in columns.items()}
    header_ns = None
    if 'timestamp_sample' in data.data and not _COMMAND.search(data.name):
        sampled, known = sound_times(data.data['timestamp_sample'][sound], 1000)
        header_ns = np.where(known, sampled, 0)
    name = ''.join(word.capitalize() for word in re.split(r'\W|_', data.name)) or 'Message'
    return Series(topic, 'ulog', name, log_ns[sound], columns, header_ns)


def _quaternions(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the attitudes of PX4, arrays w, x, y, z, as quaternions that have angles."""
    names = [name[:-3] for name in columns if _ATTITUDE.search(name)]
    return {f'{name}_xyzw.{part}': columns[f'{name}[{i}]'] for name in names
            if f'{name}[4]' not in columns
            for part, i in (('x', 1), ('y', 2), ('z', 3), ('w', 0))}
