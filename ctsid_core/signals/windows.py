# SPDX-License-Identifier: Apache-2.0
"""
Sliding windows on data time: samples in, records out.

Rules, all of them functions of the stamps and of the order of pushes, never of a clock nor of how
often `SlidingWindow.due` is called:

- The *watermark* is the largest stamp seen over all groups minus `max_delay`. What is older has
  its final order; a sample that arrives older than it is *late*: dropped and counted. It is
  common to all groups, so that a silent group cannot stall the others.
- The first window starts where every group has had its first sample, a held input one before the
  beginning (`begin`); the others follow by `stride`. Inputs have the `lead` seconds before it,
  too, if they are known: they act in it.
- A window is due when the watermark has passed its end and every interpolated group has the
  samples after it that its interpolation wants; or, for a group that stopped, a tenth of the
  length later. It is handed out with what there is. A window without any sample is skipped and
  counted, however long the gap.
- A sample is *astray* if it lies more than a length ahead of everything, or if it lies behind the
  watermark and its own group has jumped back to it. One or two are dropped and counted. Three in
  a row that agree are believed: ahead is a gap; back is a clock that restarted or a recording that
  looped, which ends the old stream (its last windows become due) and starts a new one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from math import isfinite
from operator import index
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Places
from ctsid_core.signals.record import Record, common_interval
from ctsid_core.signals.samples import STAMP_MAX, Counts, Group, Rows, Samples, check_groups

_GRACE = 10  # wait for the samples after a window at most this fraction of its length
_BELIEVED = 3  # stray samples in a row that are believed
_FEW = 32  # samples that are taken one by one sooner than halved again
_RESTART_NS = 10**9  # a clock corrected by less does not end a stream: its samples are late


class _Stray(NamedTuple):
    """A sample that is set aside until others confirm it."""

    track: Samples
    stamp_ns: int
    values: tuple[float, ...]
    offset_ns: int


class SlidingWindow:
    """
    Put samples in order and cut windows from them; the only mutable object of the core.

    Not for several threads. What `due` has not handed out is kept, so ask it regularly.

    Parameters
    ----------
    groups : sequence of Group
        At least one output among them; inputs and outputs keep their order in the records.
    length, stride : float
        Length of a window, and from the start of one to the start of the next [s].
    max_delay : float
        How much older than the newest sample one may arrive and still be put in order [s].
    lead : float
        History of the inputs kept before a window: the longest dead time [s].

    Raises
    ------
    DataError
        If groups or times cannot be.
    """

    def __init__(self, groups: Sequence[Group], length: float, stride: float, max_delay: float,
                 lead: float = 0.0) -> None:
        check_groups(groups)
        self._length = _nanoseconds('length', length, 1)
        self._stride = _nanoseconds('stride', stride, 1)
        self._max_delay = _nanoseconds('max_delay', max_delay, 0)
        self._lead = _nanoseconds('lead', lead, 0)
        self._grace = max(self._length // _GRACE, 1)
        self._restart = max(self._max_delay, min(_RESTART_NS, self._length))
        self._tracks = {group.name: Samples(group) for group in groups}
        self._pending: deque[Record] = deque()
        self._windows = self._empty = self._resets = 0
        self._clear()

    def _clear(self) -> None:
        for track in self._tracks.values():
            track.clear()
        self._newest = 0
        self._low, self._high = 1, STAMP_MAX  # stamps in this range are taken
        self._next: int | None = None  # start of the next window, once one was handed out
        self._check = 0  # watermark at which to look for due windows again
        self._strays: list[_Stray] = []

    @property
    def counts(self) -> Counts:
        """What became of the samples and the windows so far."""
        return Counts({name: track.counts() for name, track in self._tracks.items()},
                      self._windows, self._empty, self._resets)

    def forget_worst(self) -> None:
        """Let the counts tell of samples far out of place only if they come from now on."""
        for track in self._tracks.values():
            track.forget_worst()

    def begin(self) -> None:
        """Let the first window begin after what came so far: that is history of the inputs."""
        for track in self._tracks.values():
            track.begin()
            track.discard(self._low - max(self._lead, self._length))
        self._pending.clear()
        self._windows = self._empty = self._resets = 0

    @property
    def newest_ns(self) -> int:
        """The largest stamp of the present stream [ns]; 0 if there is none yet."""
        return self._newest

    @property
    def filled(self) -> float:
        """How much of the next window there is, 0 to 1; 0 while a group has had no sample."""
        start = self._start()
        return 0.0 if start is None else min(max((self._newest - start) / self._length, 0.0), 1.0)

    def push(self, group: str, stamp_ns: int, values: Sequence[float]) -> bool:
        """
        Take one sample of a group.

        Parameters
        ----------
        group : str
            Name of the group.
        stamp_ns : int
            Absolute time of the sample [ns].
        values : sequence of float, length m

        Returns
        -------
        bool
            Whether it was taken, or set aside until others confirm it; else it was dropped and
            counted.

        Raises
        ------
        DataError
            If there is no such group, or stamp or values are not numbers.
        """
        try:
            track = self._tracks[group]
            if (track.newest < stamp_ns and self._low <= stamp_ns <= self._high
                    and len(values) == track.width and isfinite(sum(values))
                    and not self._strays):
                track.stamps.append(stamp_ns)  # the ordinary sample: written out, this path
                track.values.extend(values)  # has to cost no more than a microsecond or two
                track.newest = stamp_ns
                if stamp_ns > self._newest:
                    self._newest = stamp_ns
                    self._low = stamp_ns - self._max_delay
                    self._high = stamp_ns + self._length
                return True
            return self._examine(track, stamp_ns, values)
        except KeyError:
            raise DataError(f'`group` is {group!r}, but the groups are '
                            f'{", ".join(map(repr, self._tracks))}') from None
        except TypeError as error:
            raise DataError(f'group {group!r}: stamp {stamp_ns!r} with values {values!r} cannot '
                            f'be a sample ({error}); give int nanoseconds and a sequence of '
                            'floats') from error

    def push_rows(self, order: Places, rows: Sequence[Rows]) -> list[tuple[int, int]]:
        """
        Take many samples: the same as `push` of one after another.

        Parameters
        ----------
        order : ndarray of int, shape (N,)
            Which of the `rows` each sample is of: it is the next one there.
        rows : sequence of Rows

        Returns
        -------
        list of (int, int)
            Which samples were dropped: which of the `rows`, and which row of it.
        """
        stamps = np.empty(len(order), np.int64)
        for number, part in enumerate(rows):
            stamps[order == number] = part.stamps
        return self._take_rows(order, rows, stamps, [0] * len(rows)) if len(order) else []

    def _take_rows(self, order: Places, rows: Sequence[Rows], stamps: NDArray[np.int64],
                   first: Sequence[int]) -> list[tuple[int, int]]:
        """Take samples, in halves if not all are ordinary; `first` is the number of each row."""
        if self._append_rows([part for part in rows if len(part.stamps)], stamps):
            return []
        if len(order) > _FEW:
            half = len(order) // 2
            counts = np.bincount(order[:half], minlength=len(rows)).tolist()
            early = [part[:n] for part, n in zip(rows, counts, strict=True)]
            late = [part[n:] for part, n in zip(rows, counts, strict=True)]
            later = [a + n for a, n in zip(first, counts, strict=True)]
            return self._take_rows(order[:half], early, stamps[:half], first) + self._take_rows(
                order[half:], late, stamps[half:], later)
        samples, numbers = [part.samples() for part in rows], [count(a) for a in first]
        pushed = ((number, next(numbers[number]), self.push(*next(samples[number])))
                  for number in order.tolist())
        return [(number, row) for number, row, taken in pushed if not taken]

    def _append_rows(self, rows: Sequence[Rows], stamps: NDArray[np.int64]) -> bool:
        """Take samples if every one is ordinary, see `push`; return whether they were taken."""
        newest = np.maximum.accumulate(stamps)
        before = np.concatenate(([self._newest], newest[:-1]))
        length, delay = self._length, self._max_delay
        if (self._strays or (self._low, self._high) != (self._newest - delay,
                                                        self._newest + length)
                or int(np.min(stamps)) <= 0 or newest[-1] >= STAMP_MAX
                or (stamps < before - delay).any() or (stamps > before + length).any()
                or not all(self._tracks[part.group].in_order(part) for part in rows)):
            return False
        for part in rows:
            self._tracks[part.group].extend(part)
        self._newest = max(self._newest, int(newest[-1]))
        self._low, self._high = self._newest - delay, self._newest + length
        return True

    def due(self) -> Iterator[Record]:
        """Hand out the windows that the stamps have passed, oldest first."""
        while self._pending or self._low > self._check:
            if self._pending:
                yield self._pending.popleft()
            elif record := self._take(self._low):
                yield record

    def flush(self) -> Iterator[Record]:
        """Hand out all windows that the samples reach the end of: no more will come."""
        self._finish()
        while self._pending:
            yield self._pending.popleft()

    def whole(self) -> Record | None:
        """
        Return everything from the start of the next window to where every group is known.

        For one record of a whole stream: with a `length` that no stream reaches. None if there is
        no such interval.
        """
        start = self._start()
        if start is None:
            return None
        record = self._record(start, self._newest)
        try:
            end = common_interval((*record.inputs, *record.outputs))[1]
        except DataError:
            return None
        return replace(record, end=end) if end > 0 else None

    def latest(self) -> Record | None:
        """
        Return the last `length` of samples whose order is final, whatever the stride.

        None if there is less. The windows that are due are not affected.
        """
        first = self._first()
        start = self._low - self._length
        return None if first is None or start < first else self._record(start, self._low)

    def _examine(self, track: Samples, stamp_ns: int, values: Sequence[float]) -> bool:
        """Take or drop a sample that is not ordinary."""
        stamp_ns = index(stamp_ns)
        if len(values) != track.width:
            return track.drop('wrong_width')
        if not all(map(isfinite, values)):
            return track.drop('non_finite')
        if not 0 < stamp_ns < STAMP_MAX:
            return track.drop('bad_stamp')
        offset = stamp_ns - self._newest
        back = track.first is not None and track.newest - stamp_ns > self._restart
        if stamp_ns > self._high or (back and stamp_ns < self._low):
            return self._set_aside(_Stray(track, stamp_ns, tuple(values), offset))
        if stamp_ns < self._low:
            return track.drop('late', offset)
        self._drop_strays()
        if not track.insert(stamp_ns, values):
            return track.drop('duplicate')
        if stamp_ns > self._newest:
            self._newest = stamp_ns
            self._low, self._high = stamp_ns - self._max_delay, stamp_ns + self._length
        return True

    def _set_aside(self, stray: _Stray) -> bool:
        back = stray.offset_ns < 0
        if self._strays and (self._strays[0].offset_ns < 0) != back:
            self._drop_strays()
        self._strays.append(stray)
        if len(self._strays) < _BELIEVED:
            return True
        believed, self._strays = self._strays, []
        if back:
            self._finish()
            self._clear()
            self._resets += 1
        else:
            self._high = believed[0].stamp_ns
        for track, stamp_ns, values, _ in believed:
            self._examine(track, stamp_ns, values)
        return True

    def _drop_strays(self) -> None:
        for stray in self._strays:
            stray.track.drop('astray', stray.offset_ns)
        self._strays = []

    def _finish(self) -> None:
        """Make all windows due that end before the newest stamp."""
        self._drop_strays()
        while record := self._take(self._newest, final=True):
            self._pending.append(record)

    def _start(self) -> int | None:
        """Return the start of the next window [ns]; None while a group has had no sample."""
        return self._first() if self._next is None else self._next

    def _first(self) -> int | None:
        """Return from when on all groups are known [ns]; None while one has had no sample."""
        starts = [track.first for track in self._tracks.values() if track.first is not None]
        return max(starts) if len(starts) == len(self._tracks) else None

    def _take(self, passed: int, *, final: bool = False) -> Record | None:
        """Cut the next window that is due now that stamps to `passed` are complete."""
        while (start := self._start()) is not None and start + self._length <= passed:
            end = start + self._length
            if not (final or passed >= end + self._grace or all(
                    track.has_after(end, passed) for track in self._tracks.values())):
                break
            self._next = start + self._stride
            if any((stamp := track.stamp_from(start)) is not None and stamp <= end
                   for track in self._tracks.values()):
                self._windows += 1
                record = self._record(start, end)
                self._discard(passed)
                return record
            self._skip(end, passed)
        self._discard(passed)
        # Looking costs some microseconds, so do not look again at every push; but soon if only the
        # samples after the end are awaited, for somebody waits for the model.
        self._check = passed + self._grace // 16
        if start is not None:
            self._check = max(start + self._length - 1, passed + self._grace // 512)
        return None

    def _skip(self, end: int, passed: int) -> None:
        """Count the empty window that ends at `end` and all the empty ones that follow it."""
        stamps = (track.stamp_from(end + 1) for track in self._tracks.values())
        target = min([passed, *(stamp for stamp in stamps if stamp is not None)])
        skipped = max(-((end - target) // self._stride), 1)
        self._empty += skipped
        self._next = end - self._length + skipped * self._stride

    def _discard(self, passed: int) -> None:
        """Forget what neither a window nor the search for duplicates needs any more."""
        start = self._start()
        needed = min(passed, self._low, *(
            [] if start is None else [start, self._low - self._length])) - self._lead
        for track in self._tracks.values():
            track.discard(needed)

    def _record(self, start: int, end: int) -> Record:
        """Return the record of the samples in [start, end] [ns]."""
        since = start - max(self._lead, self._length)   # what is older may lie beyond a gap
        inputs, outputs = (tuple(track.cut(start, self._lead, since, end, self._grace)
                                 for track in self._tracks.values() if track.group.role == role)
                           for role in ('input', 'output'))
        return Record(inputs, outputs, 0.0, (end - start) / 1e9, start)


def _nanoseconds(name: str, seconds: float, least: int) -> int:
    if not (isfinite(seconds) and least <= round(seconds * 1e9) < STAMP_MAX):
        raise DataError(f'`{name}` is {seconds!r} s; give a number of seconds, '
                        f'{"more than zero" if least else "zero or more"}')
    return round(seconds * 1e9)
