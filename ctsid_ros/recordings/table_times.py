# SPDX-License-Identifier: Apache-2.0
"""
Which columns of a table are times, and what they count.

Told by the user (`--time t`, `--time t:ms`, `--time 100Hz`), by names and units (`t [s]`,
`time_ms`), else by the values: a date lies between 2000 and 2100 in one unit only, and what robots
record comes every few microseconds to every few seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.decoding.block import Stamps
from ctsid_ros.decoding.field_path import nearest
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.series import BOOT_NS

_GUESSED = {'s': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1}
UNITS = {**_GUESSED, 'min': 60 * 10**9, 'h': 3600 * 10**9}
_WORDS = {**dict.fromkeys(('h', 'hr', 'hrs', 'hour', 'hours'), 'h'),
          **dict.fromkeys(('min', 'mins', 'minute', 'minutes'), 'min'),
          **dict.fromkeys(('s', 'sec', 'secs', 'second', 'seconds'), 's'),
          **dict.fromkeys(('ms', 'msec', 'msecs', 'millis', 'millisecond', 'milliseconds'), 'ms'),
          **dict.fromkeys(('us', 'µs', 'μs', 'usec', 'usecs', 'micros', 'microsecond',
                           'microseconds'), 'us'),
          **dict.fromkeys(('ns', 'nsec', 'nsecs', 'nanos', 'nanosecond', 'nanoseconds'), 'ns')}
_NAME = re.compile(
    r'_*(t|times?|time_?stamps?|timestamps?|stamps?|secs?|seconds|date|datetime)([^a-z].*)?'
    r'|.*[^a-z](t|time|timestamp|stamp)([^a-z]*(s|ms|us|ns|sec|msec|usec|nsec|min|h))?|time(us|ms|ns)')
_CLOCKS = ('utc', 'gps', 'tai', 'local', 'unix', 'epoch', 'boot')    # no units
_RATE = re.compile(r'(\d+\.?\d*|\.\d+)\s*Hz', re.IGNORECASE)
_SECONDS = re.compile(r'(?<![a-z])(secs?|seconds)$', re.IGNORECASE)
_NANOSECONDS = re.compile(r'(?<![a-z])(nsecs?|nanosecs?|nanoseconds)$', re.IGNORECASE)
_FAR = 2.0**62  # ns: what is beyond is no time of any recording, and too large to be counted
_CENTURY = (946_684_800, 4_102_444_800)  # 2000 to 2100 [s]
_SLOWEST = 2.0  # interval of samples; twice as long is rather told in the next smaller unit [s]
_SURE = 0.2  # shorter ones are of seconds: as milliseconds they would be of 5 kHz and more [s]
_ORDERED = 0.98  # of the steps of a time column go forward: a clock may have been set


@dataclass(frozen=True)
class Column:
    """
    A column of a table.

    Parameters
    ----------
    name : str
        Without its unit.
    unit : str
        As the header has it; may be empty.
    values : ndarray, shape (N,)
        Numbers, NaN where a cell is empty; or `datetime64[ns]`.
    """

    name: str
    unit: str
    values: NDArray[Any]

    @property
    def is_date(self) -> bool:
        """Whether it holds dates."""
        return self.values.dtype.kind == 'M'

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which of its cells are filled."""
        if self.is_date:
            return ~np.isnat(self.values)
        return np.isfinite(self.values)

    @property
    def increases(self) -> bool:
        """Whether it could be a time: it goes on, but for a few steps."""
        steps = np.diff(self.values[self.known].astype(
            np.int64 if self.is_date else np.float64, copy=False))
        return bool((steps > 0).any()) and bool(np.mean(steps >= 0) >= _ORDERED)

    @cached_property
    def ordered(self) -> NDArray[np.float64]:
        """Its filled cells in order: rows may be in disorder."""
        return np.sort(self.values[self.known].astype(np.float64))

    @cached_property
    def step(self) -> float:
        """The median of the steps that are any; 1 if there is none."""
        steps = np.diff(self.ordered)
        return float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0

    @property
    def named_time(self) -> bool:
        """Whether it is called like a time."""
        return self.is_date or _is_called_time(self.name)


@dataclass(frozen=True)
class Time:
    """
    A column of times.

    Parameters
    ----------
    name : str
    log_ns : ndarray of int64, shape (N,)
        Zero where it is not known.
    is_date : bool
        Whether it tells the date, or counts from a start of its own.
    note : str
        What was guessed.
    """

    name: str
    log_ns: Stamps
    is_date: bool
    note: str


def joined_seconds(columns: Sequence[Column]) -> list[Column]:
    """Make one time of neighbours that hold its seconds and nanoseconds, as stamps of ROS do."""
    found: list[Column] = []
    for column in columns:
        if found and _are_pair(found[-1], column):
            seconds = found.pop()
            known = seconds.known & column.known
            whole, rest = (np.where(known, c.values, 0).astype(np.int64)
                           for c in (seconds, column))
            times = whole * 10**9 + rest
            name = _SECONDS.sub('', seconds.name).strip('._ ') or 'stamp'
            found.append(Column(name, 'ns', times if known.all() else
                                np.where(known, times, np.nan)))
        else:
            found.append(column)
    return found


def _are_pair(seconds: Column, rest: Column) -> bool:
    if seconds.is_date or rest.is_date or not (_SECONDS.search(seconds.name)
                                               and _NANOSECONDS.search(rest.name)):
        return False
    values = rest.values[rest.known]
    return _SECONDS.sub('', seconds.name) == _NANOSECONDS.sub('', rest.name) \
        and len(values) > 0 and bool(np.min(values) >= 0 and np.max(values) < 1e9)


def constant_rate(wanted: Sequence[str], columns: Sequence[Column]) -> float:
    """Return the rate of rows without times that the user says, '100Hz'; else 0 [Hz]."""
    if len(wanted) == 1 and wanted[0] not in [column.name for column in columns] \
            and (found := _RATE.fullmatch(wanted[0])):
        return float(found[1])
    return 0.0


def _is_called_time(name: str) -> bool:
    word = name.lower()
    # `s` may be a length, and `min` the least of something
    return bool(_NAME.fullmatch(word)) or _WORDS.get(word, 's') not in ('s', 'min', 'h')


def find_times(columns: Sequence[Column], wanted: Sequence[str], path: str,
               texts: Mapping[str, str]) -> list[int]:
    """
    Return which of the columns are times: the wanted ones, or those that look so.

    `texts` are columns that could be none, and what they begin with.

    Raises
    ------
    BagError
        If there is none.
    """
    names = [column.name for column in columns]
    if wanted:
        chosen = [split_unit(text, names)[0] for text in wanted]
        found = [names.index(name) for name in dict.fromkeys(chosen) if name in names]
        if not found:
            if held := _texts(texts, chosen):
                raise BagError(f'{path}: {"; ".join(held)}')
            raise BagError(f'{path}: no column is called {" or ".join(chosen)}'
                           + nearest(chosen[0], names))
        return sorted(found)
    likely = [i for i, column in enumerate(columns) if column.named_time and column.increases]
    # Several times: each is followed by columns of its own.
    if len(likely) > 1 and all(b - a > 1 for a, b in zip(likely, [*likely[1:], len(columns)],
                                                         strict=True)) \
            and _overlap([columns[i] for i in likely]):
        return likely
    if likely:
        return likely[:1]
    rising = [i for i, column in enumerate(columns) if column.increases
              and column.known.all() and (np.diff(column.values) > 0).all()]
    if rising and rising[0] == 0:
        return rising[:1]
    why = _texts(texts, filter(_is_called_time, texts)) + [
        f'column {column.name} ' + ('goes back or stands still too often' if column.known.sum() > 1
                                    else 'has no two times') for column in columns
        if column.named_time]
    raise BagError(f'{path}: no column is known to be the time: '
                   + ('; '.join(why) or 'none is called t or time and increases')
                   + '; say which one by --time COLUMN' + nearest('time', names)
                   + '; if there is none, but rows follow each other at a constant rate, say it '
                   'in rows per second, such as --time 100Hz')


def _texts(texts: Mapping[str, str], names: Iterable[str]) -> list[str]:
    return [f'column {name} holds {texts[name]!r}, which is read neither as a number nor as a '
            'date (2024-05-01 10:00:00.25)' for name in names if name in texts]


def _overlap(columns: Sequence[Column]) -> bool:
    """Whether times are of one clock."""
    spans = [(log_ns[0], log_ns[-1])
             for column, time in zip(columns, read_times(columns, {}), strict=True)
             for log_ns in (np.sort(time.log_ns[column.known]),)]
    return bool(max(first for first, _ in spans) < min(last for _, last in spans))


def split_unit(text: str, names: Sequence[str] = ()) -> tuple[str, str]:
    """Return 't', 'ms' of 't:ms'; without a unit if it is a name as it stands."""
    name, _, unit = text.rpartition(':')
    return (name, unit) if name and unit in UNITS and text not in names else (text, '')


def read_times(columns: Sequence[Column], told: Mapping[str, str]) -> list[Time]:
    """
    Return columns of a table as times.

    Those whose unit nothing says, no date neither, share that of the one with the shortest steps.

    Parameters
    ----------
    columns : sequence of Column
    told : mapping of str
        Units that the user says, by names of columns.
    """
    units = [told.get(c.name) or _WORDS.get(c.unit.lower() or _suffix(c.name), '')
             or ('' if c.is_date else _dated(c)) for c in columns]
    unsaid = [c for c, unit in zip(columns, units, strict=True) if not (unit or c.is_date)]
    steps = [c for c in unsaid if c.known.sum() > 1]
    guessed = _guess(min(steps or unsaid, key=lambda c: c.step)) if unsaid else ''
    return [_read(c, unit or guessed, '' if unit or c.is_date else _doubt(c, guessed))
            for c, unit in zip(columns, units, strict=True)]


def _read(column: Column, unit: str, note: str) -> Time:
    known = column.known
    if column.is_date:
        log_ns = np.where(known, column.values.astype(np.int64), 0)
        return Time(column.name, log_ns, True, '')
    values, far = np.where(known, column.values, 0), _FAR / UNITS[unit]
    log_ns = values.astype(np.int64) * UNITS[unit] if values.dtype.kind in 'iu' \
        else np.rint(np.clip(values, -far, far) * float(UNITS[unit])).astype(np.int64)
    middle = float(np.median(log_ns[known])) * 1e-9 if known.any() else 0.0
    is_date = _CENTURY[0] < middle < _CENTURY[1]
    return Time(column.name, np.where(known, log_ns + BOOT_NS * (not is_date), 0), is_date, note)


def _suffix(name: str) -> str:
    found = re.search(r'(?:^|[^a-z])([a-zµμ]+)$', name.lower())
    return 'us' if name == 'TimeUS' else found[1] if found else ''


def _dated(column: Column) -> str:
    """Return the unit in which times are dates, if there is one."""
    middle = float(np.median(column.ordered)) if len(column.ordered) else 0.0
    return next((unit for unit, ns in _GUESSED.items()
                 if _CENTURY[0] < middle * ns * 1e-9 < _CENTURY[1]
                 and 1e-7 < column.step * ns * 1e-9 < 1e4), '')


def _guess(column: Column) -> str:
    """Return the unit that steps tell."""
    return next((unit for unit, ns in _GUESSED.items()
                 if column.step < _SLOWEST * UNITS['s'] / ns), 'ns')


def _doubt(column: Column, unit: str) -> str:
    """Return a note on how the unit was guessed, if values leave room for another one."""
    step, strange = column.step, column.unit and column.unit.lower() not in _CLOCKS
    if unit == 's' and step < _SURE and not strange:
        return ''
    named = f'have the unit {column.unit!r}, which is not known,' if strange else 'name no unit'
    length = float(np.ptp(column.ordered)) * UNITS[unit] / UNITS['s'] if len(column.ordered) else 0
    return (f'the times of column {column.name} {named} and are taken as {unit}, for they step by '
            f'{step:g}: {length:.6g} s in all; if that is wrong, say --time {column.name}:s (or '
            f'{", ".join(list(UNITS)[1:])})')
