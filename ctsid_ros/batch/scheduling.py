# SPDX-License-Identifier: Apache-2.0
"""
Tasks of a batch on a cluster of Dask: processes of this computer, or any cluster by its address.

Dask tells which worker died, not which task killed it: several may have been given to it. So
a task whose worker died is set aside, and those are done one after the other when nothing else
runs. A bag that no worker has lived through three times is given up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
import logging
import multiprocessing
from typing import TYPE_CHECKING

from ctsid_core.errors import CtsidError, StorageError
from ctsid_ros.batch.task import Task, give_up, perform
from ctsid_ros.errors import lacks_extra
from ctsid_ros.workers import interrupts_held_back

if TYPE_CHECKING:
    from distributed import Client, Future

TRIES = 3
_MEMORY = 'distributed.worker.memory'
_LOCAL = {
    'distributed.scheduler.allowed-failures': 0,  # tries are counted here
    # Rows are small, and what a bag takes cannot be spilled: a worker that would take too much
    # memory is ended (at 95 % of its share), and never waits for better times.
    f'{_MEMORY}.target': False, f'{_MEMORY}.spill': False, f'{_MEMORY}.pause': False,
    # What only a dashboard shows takes some per cent of a core in each process.
    'distributed.worker.profile.enabled': False, 'distributed.admin.tick.interval': '1s',
    'distributed.admin.system-monitor.interval': '5s'}
KILLED = (f'given up: the process that identified it was killed {TRIES} times, as the system does '
          'where memory is short; try it by itself with `ctsid replay`, or a part of it')


class ClusterError(CtsidError):
    """A cluster that is not there, or that is lost."""


@contextmanager
def cluster(jobs: int, scheduler: str = '') -> Iterator[Client]:
    """
    Give a client of a cluster; one of this computer is ended with it, at once.

    Parameters
    ----------
    jobs : int
        Processes of this computer, each with one task at a time.
    scheduler : str
        Address of another cluster, like tcp://10.0.0.1:8786, instead.

    Raises
    ------
    ClusterError
        If Dask is not installed, or nothing answers at the address.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ClusterError(lacks_extra(error, 'for a batch', 'batch')) from error
    before = set(multiprocessing.active_children())
    with ExitStack() as stack:
        stack.enter_context(_quiet('asyncio'))  # of what was asked for when all ends
        if scheduler:
            try:
                yield stack.enter_context(Client(scheduler))
            except OSError as error:
                raise ClusterError(f'no scheduler of Dask answers at {scheduler} ({error}); check '
                                   'the address, or start it with `dask scheduler`') from error
            return
        stack.enter_context(dask.config.set(_LOCAL))
        with interrupts_held_back():  # in all threads and processes that are started from here
            local = stack.enter_context(LocalCluster(
                n_workers=jobs, threads_per_worker=1, dashboard_address='127.0.0.1:0',
                silence_logs=logging.CRITICAL))
            client = stack.enter_context(Client(local))
        stack.callback(_end, before)
        yield client


def performed(client: Client, tasks: Sequence[Task]) -> Iterator[Task]:
    """
    Do tasks, in any order; yield each when its rows are written.

    Raises
    ------
    StorageError
        If rows cannot be written: it would be so for all.
    ClusterError
        If the cluster is lost.
    """
    from distributed import KilledWorker, as_completed

    waiting = {_submit(client, task, 1): task for task in tasks}
    killed: list[Task] = []
    for future in as_completed(waiting):
        task, fault = waiting.pop(future), _fault(future)
        if isinstance(fault, KilledWorker):
            killed.append(task)
        else:
            _check(task, fault)
            yield task
    for task in killed:
        fault = None
        for count in range(2, TRIES + 1):
            future = _submit(client, task, count)
            fault = _fault(future)
            if not isinstance(fault, KilledWorker):
                break
        if isinstance(fault, KilledWorker):
            give_up(task, KILLED)
        else:
            _check(task, fault)
        yield task


def _submit(client: Client, task: Task, count: int) -> Future:
    return client.submit(perform, task, key=f'ctsid-{task.path("").stem}-{count}', pure=False)


def _fault(future: Future) -> BaseException | None:
    """Wait for the end of a task; return what it raised."""
    found: BaseException | None = future.exception()
    return found


def _check(task: Task, fault: BaseException | None) -> None:
    if fault is None:
        return
    if isinstance(fault, StorageError):
        raise fault
    raise ClusterError(f'{task.bag}: the cluster failed ({type(fault).__name__}: {fault}); run '
                       'the same command again: what is done is not done again') from fault


def _end(before: set[multiprocessing.process.BaseProcess]) -> None:
    """End the processes that a local cluster has started; else it waits until they are done."""
    for process in set(multiprocessing.active_children()) - before:
        process.kill()


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)
