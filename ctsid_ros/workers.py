# SPDX-License-Identifier: Apache-2.0
"""Processes that compute for this one: one per core, ended at once, never left behind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
import multiprocessing
from multiprocessing.process import BaseProcess
import os
import signal
from threading import Thread
from typing import ParamSpec, TypeVar

from ctsid_ros.blas import use_one_thread

P = ParamSpec('P')
S = TypeVar('S')
T = TypeVar('T')


class Workers:
    """
    Processes that compute for this one, each with one BLAS thread.

    They are started when they are needed, do not hear Ctrl-C, and end with this process, however
    it ends. One that is killed makes what was given to them raise `BrokenProcessPool`.

    Parameters
    ----------
    jobs : int
        How many processes, at most.
    preload : str
        A module that all tasks need: imported once for all, where the system can do so.
    """

    def __init__(self, jobs: int, preload: str) -> None:
        use_one_thread()        # of every process that is started from here
        self._processes: set[BaseProcess] = set()
        self._pool = ProcessPoolExecutor(jobs, _context(preload), _end_with_parent)

    def submit(self, task: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Give a task to the next free process; it has to be a function of a module."""
        with self._starting():
            return self._pool.submit(task, *args, **kwargs)

    def map(self, task: Callable[[S], T], values: Iterable[S], chunk: int) -> Iterator[T]:
        """Return what a task makes of values, in their order; so many are sent at a time."""
        with self._starting():
            return self._pool.map(task, values, chunksize=chunk)

    def end(self) -> None:
        """End them at once, whatever they do."""
        with interrupts_held_back():
            for process in self._processes:
                process.kill()
            self._pool.shutdown(cancel_futures=True)

    @contextmanager
    def _starting(self) -> Iterator[None]:
        with interrupts_held_back():
            before = set(multiprocessing.active_children())
            try:
                yield
            finally:
                self._processes |= set(multiprocessing.active_children()) - before


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') \
        else os.cpu_count() or 1


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """
    Let Ctrl-C count as soon as this ends, and not at all in processes that are started here.

    These are ended by this one, which nothing may keep from it.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _context(preload: str) -> multiprocessing.context.BaseContext:
    """Return a way to start processes that imports what they need once for all of them."""
    if 'forkserver' not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context('spawn')
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload([preload])
    return context


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        Thread(target=_wait_for_end, args=(parent,), daemon=True).start()


def _wait_for_end(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
