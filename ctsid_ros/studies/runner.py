# SPDX-License-Identifier: Apache-2.0
"""Many runs of one experiment, over all cores; those done before are taken from a file."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
import multiprocessing
import os
from pathlib import Path
import signal

from ctsid_ros.blas import use_one_thread
from ctsid_ros.progress import progress
from ctsid_ros.studies.kept_runs import KeptRuns
from ctsid_ros.studies.monte_carlo import Outcome

Task = Callable[[int], Outcome]


def runs(task: Task, count: int, title: str, jobs: int = 1,
         kept: KeptRuns | None = None) -> list[Outcome]:
    """
    Return the outcomes of seeds 0, 1, ...

    Parameters
    ----------
    task : callable
        From the seed; of a module, for other processes have to find it.
    count : int
    title : str
        Of the experiment: for the line that shows how far it is, and for what is kept.
    jobs : int
        Processes; 1: this one.
    kept : KeptRuns, optional
        What is in it is not run again, and what is run is added to it.
    """
    done = kept.of(title) if kept else {}
    missing = [seed for seed in range(count) if seed not in done]
    with progress(title) as advance:
        for seed, found in zip(missing, _each(task, missing, jobs), strict=True):
            done[seed] = found
            if kept:
                kept.add(title, seed, found)
            advance(len(done) / max(count, len(done)), '')
    return [done[seed] for seed in range(count)]


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') \
        else os.cpu_count() or 1


def _each(task: Task, seeds: Sequence[int], jobs: int) -> Iterator[Outcome]:
    if jobs == 1 or len(seeds) < 2:
        yield from map(task, seeds)
        return
    use_one_thread()        # of every process that is started from here
    chunk = max(1, min(4, len(seeds) // jobs))
    pool = ProcessPoolExecutor(jobs, mp_context=_context())
    try:
        with _interrupts_held_back():
            found = pool.map(task, seeds, chunksize=chunk)
        yield from found
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Start processes that leave Ctrl-C to this one, where it counts as soon as this ends."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _context() -> multiprocessing.context.BaseContext:
    """Return a way to start processes that import the library once for all of them."""
    if 'forkserver' not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context('spawn')
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload(['ctsid_ros.studies.monte_carlo'])
    return context


def arguments(doc: str | None, name: str, count: int | None,
              argv: Sequence[str] | None = None) -> argparse.Namespace:
    """
    Parse the command line that all studies share.

    Parameters
    ----------
    doc : str
    name : str
        Of the study: of its folder in results/studies.
    count : int, optional
        Runs of each experiment, unless told otherwise; None: nothing is random.
    argv : sequence of str, optional
    """
    parser = argparse.ArgumentParser(description=doc, prog=f'ctsid study {name}',
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    if count:
        parser.add_argument('--seeds', type=_positive, default=count, metavar='N',
                            help='runs of each experiment (%(default)s)')
        parser.add_argument('--jobs', type=_positive, default=cores(), metavar='N',
                            help='processes (one for each core)')
    parser.add_argument('--out', type=Path, default=Path('results/studies') / name,
                        metavar='FOLDER', help='for tables, figures and, if runs are '
                        'random, runs.csv, which an interrupted study takes up again '
                        '(%(default)s)')
    return parser.parse_args(argv)


def _positive(word: str) -> int:
    value = int(word)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{value} is less than 1')
    return value


def keeping(given: argparse.Namespace) -> Callable[[Task, str], list[Outcome]]:
    """Return `runs` with what the command line says."""
    kept = KeptRuns(given.out / 'runs.csv')
    return partial(_runs_kept, given=given, kept=kept)


def _runs_kept(task: Task, title: str, given: argparse.Namespace,
               kept: KeptRuns) -> list[Outcome]:
    return runs(task, given.seeds, title, given.jobs, kept)
