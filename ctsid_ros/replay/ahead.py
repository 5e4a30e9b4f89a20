# SPDX-License-Identifier: Apache-2.0
"""Windows identified in several processes, and given back in their order."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from time import monotonic

from ctsid_core.identify import identify
from ctsid_core.model.estimate import Estimate
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record
from ctsid_ros.workers import Workers

Identified = tuple[Record, Estimate]
_WORTH = 2.0  # [s] of work that is left before processes are started, which takes about one
_AHEAD = 2    # windows for each process that are read before the first of them is back
KILLED = ('a process that identified windows was killed, as the system does where memory is '
          'short; its windows and all after them were identified by one process, with --jobs 1')


class Ahead:
    """
    Identify windows by several processes; records go in, and come out in the same order.

    An estimate is a function of its record and the settings alone, so that it has the same bits
    whoever computes it. The first window is identified here: it tells whether processes pay.

    Parameters
    ----------
    settings : Settings
    jobs : int
        How many windows may be identified at a time; 1: all of them here.

    Attributes
    ----------
    given : int
        How many windows have come out.
    killed : bool
        Whether a process was killed: its windows are done again here.
    """

    def __init__(self, settings: Settings, jobs: int) -> None:
        self.given, self.killed = 0, False
        self._settings, self._jobs = settings, jobs
        self._workers: Workers | None = None
        self._queue: deque[tuple[Record, Future[Estimate]]] = deque()

    def take(self, record: Record, left: int) -> Iterator[Identified]:
        """
        Take the next record; yield what is done meanwhile.

        Parameters
        ----------
        record : Record
        left : int
            How many may still come.
        """
        if self._workers is None:
            yield from self.rest()  # of processes that were killed
            start = monotonic()
            estimate = identify(record, self._settings)
            if self._jobs > 1 and not self.killed and (monotonic() - start) * left > _WORTH:
                self._workers = Workers(self._jobs, 'ctsid_core.identify')
            self.given += 1
            yield record, estimate
            return
        self._queue.append((record, self._submitted(self._workers, record)))
        while self._queue and (self._queue[0][1].done()
                               or len(self._queue) > _AHEAD * self._jobs):
            yield self._next()

    def rest(self) -> Iterator[Identified]:
        """Yield all that is not back yet."""
        while self._queue:
            yield self._next()

    def done(self) -> Iterator[Identified]:
        """Yield what needs no waiting."""
        while self._queue and self._queue[0][1].done() and not _lost(self._queue[0][1]):
            yield self._next()

    def end(self) -> None:
        """End the processes at once."""
        if self._workers is not None:
            self._workers.end()
            self._workers = None

    def _submitted(self, workers: Workers, record: Record) -> Future[Estimate]:
        try:
            return workers.submit(identify, record, self._settings)
        except BrokenProcessPool:
            lost: Future[Estimate] = Future()
            lost.cancel()
            return lost

    def _next(self) -> Identified:
        record, future = self._queue[0]
        if _lost(future):
            self.killed = True
            self.end()
            estimate = identify(record, self._settings)
        else:
            estimate = future.result()
        self._queue.popleft()
        self.given += 1
        return record, estimate


def _lost(future: Future[Estimate]) -> bool:
    """Wait for a future; return whether the processes were killed before it was done."""
    try:
        return isinstance(future.exception(), BrokenProcessPool)
    except CancelledError:
        return True
