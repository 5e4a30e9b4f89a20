# SPDX-License-Identifier: Apache-2.0
"""The samples of one group of channels, buffered in the order of their stamps."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array
from ctsid_core.settings import HOLDS, Hold
from ctsid_core.signals.record import Signal

STAMP_MAX = 2**62  # the year 2116; beyond lie only garbage and the overflow of int64
BEFORE = 3  # samples of context before a window: a held value, a spline's end conditions
AFTER: Mapping[Hold, int] = {'zoh': 0, 'linear': 1, 'smooth': 3}  # a held value needs no future


@dataclass(frozen=True)
class Group:
    """Channels of one role that always come together, under one stamp."""

    name: str                    # what `SlidingWindow.push` calls it
    width: int                   # number of channels m
    role: Literal['input', 'output']
    hold: Hold                   # what is known between the samples
    names: tuple[str, ...] = ()  # m of them, or none
    units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1:
            raise DataError(f'group {self.name!r} has width {self.width}; give at least 1')
        if self.role not in ('input', 'output') or self.hold not in HOLDS:
            raise DataError(f'group {self.name!r} has role {self.role!r} and hold {self.hold!r}; '
                            f"a role is 'input' or 'output', a hold one of {HOLDS}")
        for what, entries in (('names', self.names), ('units', self.units)):
            if entries and len(entries) != self.width:
                raise DataError(f'group {self.name!r} has {len(entries)} {what} for '
                                f'{self.width} channels')


@dataclass(frozen=True)
class GroupCounts:
    """Counts of the samples of one group since the beginning: all but accepted were dropped."""

    accepted: int = 0
    late: int = 0
    duplicate: int = 0         # of equal stamps the first is kept
    astray: int = 0
    bad_stamp: int = 0         # zero, negative, or beyond the year 2116
    non_finite: int = 0
    wrong_width: int = 0
    # how far behind (negative) the newest stamp of all groups the worst was [s]
    worst_late: float = 0.0
    worst_astray: float = 0.0  # likewise, or ahead (positive) [s]


@dataclass(frozen=True)
class Counts:
    """What became of the samples, and of the windows, since the beginning."""

    groups: Mapping[str, GroupCounts]
    windows: int  # handed out
    empty: int    # skipped because no group had any sample in them
    resets: int   # how often the stamps jumped back for good


@dataclass(frozen=True)
class Rows:
    """Samples of one group, a row each, in the order in which they come."""

    group: str
    stamps: NDArray[np.int64]  # (N,), absolute [ns]
    values: Array              # (N, m)
    sound: NDArray[np.bool_]   # (N,): which have values; others count as of a wrong width

    def __getitem__(self, rows: slice) -> Rows:
        return Rows(self.group, self.stamps[rows], self.values[rows], self.sound[rows])

    def samples(self) -> Iterator[tuple[str, int, tuple[float, ...]]]:
        """Yield them as `SlidingWindow.push` takes them."""
        for stamp, values, sound in zip(self.stamps.tolist(), self.values.tolist(),
                                        self.sound.tolist(), strict=True):
            yield self.group, stamp, tuple(values) if sound else ()


def check_groups(groups: Sequence[Group]) -> None:
    """Raise `DataError` unless names differ and there is an output."""
    names = [group.name for group in groups]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise DataError(f'the group name {repeated[0]!r} is used twice; names must differ')
    if not any(group.role == 'output' for group in groups):
        raise DataError(f'none of the groups {names} is an output; give at least one')


class Samples:
    """
    Buffer of one group: in the order of stamps, one sample per stamp; and what was dropped.

    A part of `SlidingWindow`, which decides what is taken.
    """

    __slots__ = ('after', 'discarded', 'dropped', 'first', 'group', 'newest', 'repeated', 'stamps',
                 'values', 'width', 'worst_ns')

    def __init__(self, group: Group) -> None:
        self.group = group
        self.width = group.width
        self.after = AFTER[group.hold]
        self.discarded = 0
        self.dropped = dict.fromkeys(('late', 'duplicate', 'astray', 'bad_stamp', 'non_finite',
                                      'wrong_width'), 0)
        self.forget_worst()
        self.stamps = array('q')
        self.values = array('d')  # row by row
        self.repeated = array('q')  # stamps under which other values came
        self.clear()

    def clear(self) -> None:
        """Forget all samples, for a new stream; the counts go on."""
        self.discarded += len(self.stamps)
        del self.stamps[:], self.values[:], self.repeated[:]
        self.first: int | None = None
        self.newest = STAMP_MAX  # so that the first sample is not taken for an ordinary one

    def begin(self) -> None:
        """Take all samples so far for history, and count anew; what is held stays known."""
        if self.group.role != 'input' or self.group.hold != 'zoh' or not self.stamps:
            self.first, self.newest = None, STAMP_MAX
        self.discarded, self.dropped = -len(self.stamps), dict.fromkeys(self.dropped, 0)
        self.forget_worst()

    def in_order(self, rows: Rows) -> bool:
        """Whether all rows are whole and finite, and each is newer than all before it."""
        return bool(self.newest < rows.stamps[0] and (rows.stamps[1:] > rows.stamps[:-1]).all()
                    and rows.sound.all() and rows.values.shape[1] == self.width
                    and np.isfinite(rows.values).all())

    def extend(self, rows: Rows) -> None:
        """Take samples that are `in_order`."""
        for own, new in ((self.stamps, rows.stamps), (self.values, rows.values)):
            own.frombytes(memoryview(np.ascontiguousarray(new)).cast('B'))
        self.newest = self.stamps[-1]

    def insert(self, stamp_ns: int, values: Sequence[float]) -> bool:
        """Put a sample at its place; return False if its stamp is taken."""
        index = bisect_left(self.stamps, stamp_ns)
        if index < len(self.stamps) and self.stamps[index] == stamp_ns:
            if self.values[index * self.width:(index + 1) * self.width] != array('d', values):
                self.repeated.append(stamp_ns)
            return False
        self.stamps.insert(index, stamp_ns)
        self.values[index * self.width:index * self.width] = array('d', values)
        self.newest = self.stamps[-1]
        self.first = min(stamp_ns, self.first or stamp_ns)
        return True

    def drop(self, reason: str, offset_ns: int = 0) -> bool:
        """Count a dropped sample and how far it was out of place; return False."""
        self.dropped[reason] += 1
        if abs(offset_ns) > abs(self.worst_ns.get(reason, 0)):
            self.worst_ns[reason] = offset_ns
        return False

    def forget_worst(self) -> None:
        """Begin anew to look for the samples that are farthest out of place."""
        self.worst_ns: dict[str, int] = {}

    def discard(self, before_ns: int) -> None:
        """Forget what no window from `before_ns` on needs; rarely, for it moves the rest."""
        count = bisect_left(self.stamps, before_ns) - BEFORE
        if 2 * count > len(self.stamps):
            del self.stamps[:count], self.values[:count * self.width]
            self.discarded += count
            self.repeated = array('q', filter(before_ns.__le__, self.repeated))

    def has_after(self, end_ns: int, passed_ns: int) -> bool:
        """Whether the samples wanted after `end_ns` have come, and are older than `passed_ns`."""
        wanted = bisect_right(self.stamps, end_ns) + self.after - 1
        return not self.after or (wanted < len(self.stamps) and self.stamps[wanted] <= passed_ns)

    def stamp_from(self, at_ns: int) -> int | None:
        """Return the first stamp at or after `at_ns`."""
        index = bisect_left(self.stamps, at_ns)
        return self.stamps[index] if index < len(self.stamps) else None

    def cut(self, epoch_ns: int, lead_ns: int, since_ns: int, end_ns: int, grace_ns: int
            ) -> Signal:
        """
        Return the samples of a window with their context, relative to its start.

        An input has `lead_ns` of history before it, if that is after `since_ns`; samples to
        `grace_ns` after its end are context.
        """
        low = max(bisect_left(self.stamps, epoch_ns) - BEFORE, 0)
        if self.group.role == 'input':
            low = min(low, max(bisect_left(self.stamps, epoch_ns - lead_ns) - BEFORE,
                               bisect_left(self.stamps, since_ns)))
        inside = bisect_right(self.stamps, end_ns)
        high = min(inside + self.after, bisect_right(self.stamps, end_ns + grace_ns))
        # Subtract while they are integers: a double keeps an absolute stamp to 256 ns only.
        stamps = np.frombuffer(self.stamps[low:high], dtype=np.int64) - epoch_ns
        values = np.frombuffer(self.values[low * self.width:high * self.width])
        time = stamps / 1e9
        # Context from before a gap of months: nanoseconds apart, it can coincide after all.
        keep = np.append(np.diff(time) > 0, True)
        lost = sum(epoch_ns <= stamp < end_ns for stamp in self.repeated)
        whole = lost + bisect_left(self.stamps, end_ns) - bisect_left(self.stamps, epoch_ns)
        return Signal(time[keep], values.reshape(-1, self.width)[keep], self.group.hold,
                      self.group.names, self.group.units, lost / max(whole, 1))

    def counts(self) -> GroupCounts:
        """Return what became of the samples so far."""
        late, astray = (self.worst_ns.get(key, 0) / 1e9 for key in ('late', 'astray'))
        return GroupCounts(accepted=self.discarded + len(self.stamps), **self.dropped,
                           worst_late=late, worst_astray=astray)
