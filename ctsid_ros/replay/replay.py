# SPDX-License-Identifier: Apache-2.0
"""Sliding windows along a bag: every one identified, and tested on data that it has not seen."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from ctsid_core.bases.preparation import without_corrupt
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.validation import simulation
from ctsid_core.sequence.tracking import EDGE, Tracked, Tracker, time_of
from ctsid_core.signals.record import Record
from ctsid_ros.config.channels import Config
from ctsid_ros.errors import BagError
from ctsid_ros.ingest.ingest import Ingest
from ctsid_ros.recordings.bag import Bag
from ctsid_ros.recordings.playback import (
    Advance,
    Interval,
    Played,
    Spans,
    apart,
    fit_config,
    play,
    read_record,
    why_nothing,
)
from ctsid_ros.replay.ahead import KILLED, Ahead, Identified

_LIKE = 1.0  # fits [%] that differ by less are alike


@dataclass(frozen=True)
class Result:
    """
    One window along a bag.

    Parameters
    ----------
    tracked : Tracked
        As the node publishes it: the estimate in states that stay along the bag, the rows of its
        eigenvalues, and how well the previous model simulates what is new in this window.
    next_fit : ndarray, shape (ny,)
        Simulation fit on the first later window that shares no data with it [%], with the trim
        of the model; NaN where there is none.
    """

    tracked: Tracked
    next_fit: Array

    @property
    def estimate(self) -> Estimate:
        """The estimate of the window."""
        return self.tracked.estimate

    @property
    def tested(self) -> bool:
        """Whether it was tested on data of other windows."""
        return bool(np.isfinite(self.next_fit).any())


class Replay:
    """
    Sliding windows along a bag: every one of them is identified, none is skipped.

    `run` may be interrupted at any time: `results` and `played` show how far it came.

    Parameters
    ----------
    bag : Bag
    config : Config
    interval : Interval, optional
    jobs : int
        How many windows are identified at a time, by processes of their own where they take long.
        The results are the same, to the bit.

    Attributes
    ----------
    results : list of Result
    broken : str
        Why the bag could not be read to its end; empty if it could.

    Raises
    ------
    BagError
        If topics, fields or types are not in the bag.
    """

    def __init__(self, bag: Bag, config: Config, interval: Interval | None = None,
                 jobs: int = 1) -> None:
        self._bag, self._interval = bag, interval or Interval()
        self.config = fit_config(bag, config)
        self._ingest = Ingest(self.config)
        self._tracker = Tracker(self.config.settings.for_windows())
        self._ahead = Ahead(self._tracker.settings, jobs)
        self._kept: dict[int, Record] = {}  # of results that may become the best
        self._untested: deque[int] = deque()  # results that wait for data of their own future
        self.results: list[Result] = []
        self.broken = ''

    @property
    def played(self) -> Played:
        """What became of the messages so far."""
        end = [f'the bag could not be read to its end, and these are the windows before: '
               f'{self.broken}'] if self.broken else []
        end += [KILLED] if self._ahead.killed else []
        return Played(self.config, self._ingest.counts(), (*end, *self._ingest.report()))

    @property
    def left(self) -> float:
        """How much at the end is in no window, short of a further stride [s]."""
        record = self._ingest.whole()
        return 0.0 if record is None or not self.results else 1e-9 * (
            record.epoch_ns - self.results[-1].estimate.end_ns) + record.end

    @property
    def best(self) -> int | None:
        """The number of the result to keep, see `best_of`; None if no model was accepted."""
        return best_of(self.results, last_change(self.results))

    def run(self, advance: Advance | None = None) -> None:
        """
        Play the interval to its end, or to where the bag cannot be read on (`broken`).

        Raises
        ------
        BagError
            If there is no window because the bag cannot be read, because a channel is missing, the
            channels do not overlap, or the window is longer than the data.
        """
        total, spans = self._expected(), Spans()

        def moved(now: float = 0.0, _: str = '') -> None:
            if advance:
                done = len(self.results) / total if total else now
                advance(min(done, 0.99), self._news(total))

        try:
            self._identify(spans, total, moved)
        finally:
            self._ahead.end()
        if advance:
            advance(1.0, self._news(total))
        if self.broken and not self.results:
            raise BagError(self.broken)
        if self.best is None and apart(spans):
            raise BagError(why_nothing(self._bag, self.config, self._ingest, spans,
                                        self.played.complaints))
        if not self.results:
            raise BagError(self._why_no_window())

    def _identify(self, spans: Spans, total: int, moved: Callable[..., None]) -> None:
        """Read, identify and join; what is done when it is interrupted is joined as well."""
        read = 0
        try:
            for record in self._read(spans, moved):
                read += 1
                self._join(self._ahead.take(record, total - read), moved)
            self._join(self._ahead.rest(), moved)
        except KeyboardInterrupt:
            if self._ahead.given == len(self.results):  # else within the joining of one
                self._join(self._ahead.done(), moved)
            raise

    def _read(self, spans: Spans, moved: Callable[..., None]) -> Iterator[Record]:
        """Yield the windows; those before it, where the bag cannot be read on."""
        try:
            yield from self._windows(self._ingest, moved, spans)
        except BagError as error:
            self.broken = str(error)
        if self.broken:
            yield from self._ingest.flush()

    def record(self, number: int) -> Record:
        """
        Return the data of a result: those of the best are kept, others are read anew.

        Raises
        ------
        BagError
            If the bag cannot be read again.
        """
        if number in self._kept:
            return self._kept[number]
        for record in islice(self._windows(Ingest(self.config), None, None), number, None):
            return record
        raise BagError('the bag does not give the same windows when it is read again')

    def _windows(self, ingest: Ingest, advance: Advance | None, spans: Spans | None
                 ) -> Iterator[Record]:
        for _ in play(self._bag, ingest, self._interval, advance, spans):
            yield from ingest.due()
        yield from ingest.flush()

    def _join(self, identified: Iterable[Identified], moved: Callable[[], None]) -> None:
        """Put windows behind those before them; test models on what is new."""
        for record, estimate in identified:
            start_ns = record.epoch_ns + round(record.start * 1e9)
            while self._untested and self.results[self._untested[0]].estimate.end_ns <= start_ns:
                self._test(self._untested.popleft(), record)
            tracked = self._tracker.join(record, estimate)
            self.results.append(Result(tracked, np.full(record.ny, np.nan)))
            if tracked.estimate.ok:
                self._untested.append(len(self.results) - 1)
            self._keep(record)
            moved()

    def _keep(self, record: Record) -> None:
        """Keep the last record, and of the others those whose models may become the best."""
        last = len(self.results) - 1
        self._kept[last] = record
        wanted = {last, *self._untested}
        orders: dict[int, list[int]] = {}
        for number in self._kept:
            model = self.results[number].estimate.model
            if model:
                orders.setdefault(model.n, []).append(number)
        changed_ns = last_change(self.results)
        for numbers in orders.values():  # whatever comes, no other of this order is the best
            best = best_of([self.results[number] for number in numbers], changed_ns)
            wanted |= {numbers[best]} if best is not None else set()
        self._kept = {number: self._kept[number] for number in sorted(wanted)}

    def _test(self, number: int, record: Record) -> None:
        result = self.results[number]
        assert result.estimate.model is not None
        record, _ = without_corrupt(record, self.config.settings)
        self.results[number] = replace(
            result, next_fit=simulation(result.estimate.model, record).fit)

    def _expected(self) -> int:
        """Return how many windows there may be, by the times of recording; 0 if none."""
        first_ns, last_ns = self._interval.span_ns(self._bag)
        settings = self.config.settings
        room = (last_ns - first_ns) * 1e-9 - settings.window_length
        return int(room / settings.window_stride) + 1 if room > 0 else 0

    def _news(self, total: int) -> str:
        if not self.results:
            return 'no window yet'
        last = self.results[-1].estimate
        fit = ', '.join(f'{value:.1f}' for value in last.fit)
        count = f'{len(self.results)} of {max(total, len(self.results))} windows'
        return f'{count}, fit {fit} %, {last.verdict.grade.name}' if last.ok else \
            f'{count}, {last.status.name}'

    def _why_no_window(self) -> str:
        length = self.config.settings.window_length
        recorded = read_record(self._bag, self.config, self._interval)
        return '\n'.join([
            f'no window of {length:g} s fits into the data, in which all channels are known for '
            f'{recorded.record.duration:.3g} s; lower `window.length`, or make one model of the '
            'whole interval with `ctsid identify`', *self.played.complaints])


def last_change(results: Sequence[Result]) -> int:
    """Return when the plant changed last, as windows that are rejected for it tell [ns]; or 0."""
    # Windows that are rejected for what earlier ones have shown tell none of their own.
    shares = [(r.estimate, r.estimate.statistics.get('change_share', np.nan)) for r in results
              if r.estimate.status is Status.CHANGED]
    return max((time_of(e, share) for e, share in shares if np.isfinite(share)), default=0)


def best_of(results: Sequence[Result], changed_ns: int = 0) -> int | None:
    """
    Return the number of the model to keep; None if none was accepted.

    Of the GOOD ones after the last change of the plant, or else of all GOOD ones, if there are
    any; of those that explain unseen data nearly as well as any
    (the windows they were tested on differ, so that the last percent means nothing), the one with
    the fewest states; of these the one that explains them best.
    """
    accepted = [(i, r, r.estimate.model.n) for i, r in enumerate(results) if r.estimate.model]
    accepted = [entry for entry in accepted if entry[1].estimate.good] or accepted
    accepted = [entry for entry in accepted if entry[1].estimate.good
                and time_of(entry[1].estimate, EDGE) >= changed_ns] or accepted
    tested = [entry for entry in accepted if entry[1].tested] or accepted
    if not tested:
        return None
    top = max(_merit(r) for _, r, _ in tested)
    close = [(n, -_merit(r), i) for i, r, n in tested if _merit(r) >= top - _LIKE]
    return min(close)[2]


def _merit(result: Result) -> float:
    """Return the mean fit on data that the model has not seen, as far as there are any [%]."""
    for values in (result.next_fit, result.estimate.held_out_fit, result.estimate.fit):
        if np.isfinite(values).any():
            return float(np.nanmean(np.maximum(values, -1e3)))
    return -1e3
