# SPDX-License-Identifier: Apache-2.0
"""Windows to models in a thread of its own: the part of the node that knows no ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from threading import Lock
import time
import traceback

from ctsid_core.errors import Cancelled
from ctsid_core.sequence.tracking import Tracked, Tracker
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record
from ctsid_ros.node.worker import Worker


@dataclass(frozen=True)
class Window:
    """
    A window of data on its way to a model.

    Parameters
    ----------
    record : Record
    number : int
        Of the windows that were due, counted from 1.
    arrival_ns : int or None
        When the sample arrived that completed the window [ns], by the computer's clock.
    requested : bool
        Whether somebody asked for it, out of turn.
    """

    record: Record
    number: int
    arrival_ns: int | None
    requested: bool = False


@dataclass(frozen=True)
class Identified:
    """
    A window and what came of it.

    Parameters
    ----------
    window : Window
    tracked : Tracked
    computing : float
        How long its identification took [s].
    latency : float
        From the arrival of the last sample of the window to the end of its publication [s]; NaN
        until then, or if not known.
    skipped : int
        Windows that were skipped while it was identified.
    """

    window: Window
    tracked: Tracked
    computing: float
    latency: float = math.nan
    skipped: int = 0


@dataclass(frozen=True)
class UnderWay:
    """
    The window that is being identified.

    Parameters
    ----------
    number : int
        Of the window.
    seconds : float
        How long it has been at it [s].
    skipped : int
        Windows skipped meanwhile.
    """

    number: int
    seconds: float
    skipped: int


@dataclass(frozen=True)
class Progress:
    """
    How far identification has come.

    Parameters
    ----------
    windows : int
        Windows that were to be identified.
    skipped : int
        Those of them that gave way to a newer one.
    failures : int
        Those of which the identification broke off: faults of ctsid itself.
    failure : str
        The fault of the last window, if it broke off.
    under_way : UnderWay or None
    waiting : bool
        Whether a window waits to be identified.
    last, accepted : Identified or None
        The last window, and the last one with an accepted model.
    budget : float
        Processor time that the search for a model of a window may take [s].
    idle : float
        Time since the last window came [s]; NaN before the first.
    overdue : float
        By how much that is more than between the windows before it, or their stride [s].
    """

    windows: int = 0
    skipped: int = 0
    failures: int = 0
    failure: str = ''
    under_way: UnderWay | None = None
    waiting: bool = False
    last: Identified | None = None
    accepted: Identified | None = None
    budget: float = math.nan
    idle: float = math.nan
    overdue: float = 0.0


class Session:
    """
    Identify windows one after the other in a thread of its own.

    Parameters
    ----------
    settings : Settings
    publish : callable
        Given each result, in the thread of identification.
    warn : callable
        Given the text of a fault of ctsid itself.
    turn : Lock, optional
        Sessions that share it never identify at the same time.
    """

    def __init__(self, settings: Settings, publish: Callable[[Identified], None],
                 warn: Callable[[str], None], turn: Lock | None = None) -> None:
        self._settings, self._publish, self._warn = settings.for_windows(), publish, warn
        self._tracker = Tracker(self._settings)
        self._term = 0  # counts what makes all windows before it void
        self._tracked = 0  # of the windows that the tracker remembers
        self._progress, self._lock = Progress(), Lock()
        # When the last window came, and how long after the one before, if there was one: by the
        # computer's clock, beside which simulated time may be slow.
        self._came, self._every = math.nan, 0.0
        self._begun: tuple[int, float, int] | None = None  # number, time, windows skipped by then
        self._worker: Worker[tuple[int, Window]] = Worker(self._identify, self._failed, turn)
        self._worker.start()

    @property
    def progress(self) -> Progress:
        """How far it has come."""
        begun, skipped = self._begun, self._worker.skipped
        idle = time.monotonic() - self._came
        under_way = begun and UnderWay(begun[0], time.monotonic() - begun[1], skipped - begun[2])
        return replace(self._progress, skipped=skipped, under_way=under_way,
                       waiting=self._worker.waiting, budget=self._settings.budget, idle=idle,
                       overdue=idle - max(self._every, self._settings.window_stride))

    def submit(self, record: Record, arrival_ns: int | None, *, requested: bool = False) -> None:
        """Identify a window as soon as the present one is done; see `Window`."""
        with self._lock:
            number, now = self._progress.windows + 1, time.monotonic()
            if not requested:
                self._came, self._every = now, max(0.0, now - self._came)
            self._progress = replace(self._progress, windows=number)
            self._worker.submit((self._term, Window(record, number, arrival_ns, requested)))

    def change(self, settings: Settings) -> None:
        """Use other settings from the next window on."""
        self._settings = settings.for_windows()

    def reset(self) -> None:
        """Forget the models and the window that waits; break off the one under way."""
        with self._lock:
            self._worker.drop()
            self._term += 1  # the tracker is told by the thread that uses it
            self._progress = replace(self._progress, last=None, accepted=None)
            self._came = math.nan

    def cancel(self) -> None:
        """Break off the window under way, begin no other, publish nothing more."""
        with self._lock:
            self._term += 1
            self._worker.stop(0.0)

    def stop(self, timeout: float) -> bool:
        """Break off, end the thread [s], publish nothing more; return whether it has ended."""
        self.cancel()
        return self._worker.stop(timeout)

    def _identify(self, job: tuple[int, Window]) -> None:
        (term, window), start = job, time.monotonic()
        before = self._worker.skipped
        self._begun = window.number, start, before
        try:
            tracked = self._track(term, window.record)
        except Cancelled:
            return
        finally:
            self._begun = None
        result = Identified(window, tracked, time.monotonic() - start,
                            skipped=self._worker.skipped - before)
        if not self._keep(term, result):  # reset or stopped in the meantime
            return
        self._publish(result)       # who hears it may ask to save it at once
        if window.arrival_ns is not None:
            self._keep(term, replace(
                result, latency=(time.time_ns() - window.arrival_ns) * 1e-9))

    def _keep(self, term: int, result: Identified) -> bool:
        """Keep a result as the last one, unless a new term has begun; return whether it is."""
        with self._lock:
            if term == self._term:
                accepted = result if result.tracked.estimate.ok else self._progress.accepted
                self._progress = replace(self._progress, last=result, accepted=accepted,
                                         failure='')
            return term == self._term

    def _track(self, term: int, record: Record) -> Tracked:
        if term != self._tracked:
            self._tracker.reset()
            self._tracked = term
        self._tracker.settings = self._settings
        return self._tracker.take(record, lambda: self._term != term)

    def _failed(self, error: Exception) -> None:
        with self._lock:
            self._progress = replace(self._progress, failures=self._progress.failures + 1,
                                     failure=f'{type(error).__name__}: {error}')
        self._warn('the identification of a window broke off, which is a fault of ctsid:\n'
                   + ''.join(traceback.format_exception(error)))
