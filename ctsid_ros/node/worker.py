# SPDX-License-Identifier: Apache-2.0
"""A thread that works on the newest window while messages come in."""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition, Lock, Thread
from typing import Generic, TypeVar

Job = TypeVar('Job')
_LOOK = 0.02  # until one that waits for its turn looks whether it shall end [s]


class Worker(Generic[Job]):
    """
    Do jobs one after the other in a thread of its own; at most one waits.

    Parameters
    ----------
    work : callable
        Does one job. What it raises goes to `failed`, and the next job is taken.
    failed : callable
        Called with an exception.
    turn : Lock, optional
        Held while a job is done: workers that share it never work at the same time.

    Attributes
    ----------
    skipped : int
        Jobs that gave way to a newer one before they were begun.
    """

    def __init__(self, work: Callable[[Job], None], failed: Callable[[Exception], None],
                 turn: Lock | None = None) -> None:
        self._work, self._failed, self._turn = work, failed, turn or Lock()
        self._pending: Job | None = None
        self._condition = Condition()
        self._stopping = False
        self.skipped = 0
        # A daemon: an identification that takes long must not keep the process from ending.
        self._thread = Thread(target=self._run, name='identification', daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    @property
    def waiting(self) -> bool:
        """Whether a job waits."""
        return self._pending is not None

    def submit(self, job: Job) -> None:
        """Let a job be done as soon as the present one is; an older one that waits is skipped."""
        with self._condition:
            self.skipped += self._pending is not None
            self._pending = job
            self._condition.notify()

    def drop(self) -> None:
        """Forget the job that waits."""
        with self._condition:
            self._pending = None

    def stop(self, timeout: float) -> bool:
        """Begin no other job, wait for the present one [s]; return whether it has ended."""
        with self._condition:
            self._stopping, self._pending = True, None
            self._condition.notify()
        if self._thread.is_alive():
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (job := self._next()) is not None:
            try:
                self._work(job)
            except Exception as error:  # of any kind: the node goes on and reports it
                self._failed(error)
            finally:
                self._turn.release()

    def _next(self) -> Job | None:
        """Wait for a job and take the turn for it; None at the end."""
        while not self._stopping:
            with self._condition:
                self._condition.wait_for(lambda: self._stopping or self._pending is not None)
            if not self._turn.acquire(timeout=_LOOK):
                continue
            with self._condition:  # the newest one now, if there still is one
                job, self._pending = self._pending, None
            if job is not None:
                return job
            self._turn.release()
        return None
