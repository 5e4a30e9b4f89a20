# SPDX-License-Identifier: Apache-2.0
"""Many runs of one experiment, over all cores; those done before are taken from a file."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
import sys
from typing import Protocol, TypeVar

from ctsid_ros.progress import Advance, progress
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.figure_files import write_table
from ctsid_ros.studies.kept_runs import KeptRuns
from ctsid_ros.studies.monte_carlo import Outcome
from ctsid_ros.workers import Workers, cores

Task = Callable[[int], Outcome]
Told = Callable[[int, int], None]
T = TypeVar('T')


def unheard(missing: int, ended: int) -> None:
    """Take note of nothing."""


class Kept(Protocol[T]):
    """What came of runs that were done before."""

    def of(self, experiment: str) -> dict[int, T]:
        """Return what came of an experiment, by seed."""

    def add(self, experiment: str, seed: int, found: T) -> None:
        """Keep one run."""


def runs(task: Callable[[int], T], title: str, count: int, jobs: int = 1,
         kept: Kept[T] | None = None, study: str = '', told: Told = unheard) -> list[T]:
    """
    Return the outcomes of seeds 0, 1, ...

    Parameters
    ----------
    task : callable
        From the seed; of a module, for other processes have to find it.
    title : str
        Of the experiment, for what is kept.
    count : int
    jobs : int
        Processes; 1: this one.
    kept : KeptRuns or the like, optional
        What is in it is not run again, and what is run is added to it.
    study : str
        Whose experiment it is: others may have the same title.
    told : callable, optional
        Called with how many runs are missing and how many of these are done, at first and whenever
        one is.
    """
    experiment = f'{study}: {title}' if study else title
    done = kept.of(experiment) if kept else {}
    missing = [seed for seed in range(count) if seed not in done]
    told(len(missing), 0)
    for ended, (seed, found) in enumerate(
            zip(missing, _each(task, missing, jobs), strict=True), 1):
        done[seed] = found
        if kept:
            kept.add(experiment, seed, found)
        told(len(missing), ended)
    return [done[seed] for seed in range(count)]


class HowFar:
    """
    How far a study of several experiments is; what was done before does not count.

    Parameters
    ----------
    experiments, count : int
        And how many runs each of them has.
    advance : callable
        Of `progress`.
    """

    def __init__(self, experiments: int, count: int, advance: Advance) -> None:
        self._experiments, self._count, self._advance = experiments, count, advance
        self._begun = self._before = 0

    def begin(self, title: str) -> Told:
        """Return what an experiment tells how far it is."""
        self._begun += 1
        done, rest = self._before, (self._experiments - self._begun) * self._count

        def told(missing: int, ended: int) -> None:
            self._before = done + ended
            self._advance((done + ended) / max(done + missing + rest, 1),
                          f'{title} ({self._begun} of {self._experiments}): '
                          f'{self._count - missing + ended} of {self._count} runs')

        return told


@contextmanager
def shown(study: str, experiments: int, count: int, jobs: int) -> Iterator[HowFar]:
    """
    Show what a study does, how far it is, and how long it will go on.

    Parameters
    ----------
    study : str
    experiments, count, jobs : int
        And runs of each, and processes.
    """
    if not sys.stderr.isatty():     # there a bar tells
        print(f'{study}: {experiments} experiments of {count} run{"s" * (count > 1)}, '
              f'in {jobs} process{"es" * (jobs > 1)}', file=sys.stderr, flush=True)
    with progress(study) as advance:
        yield HowFar(experiments, count, advance)


def conclude(given: argparse.Namespace, name: str, table: Table, words: str = '') -> None:
    """
    Write the table of a study and print it.

    Parameters
    ----------
    given : Namespace
        Of `arguments`.
    name : str
        Of the files.
    table : Table
    words : str
        Before it; how many runs each row is of, if empty.
    """
    write_table(given.out / name, table)
    print(f'\n{words or f"{given.seeds} runs of each"}\n\n{table.text()}\n\n'
          f'Results: {given.out}')


def _each(task: Callable[[int], T], seeds: Sequence[int], jobs: int) -> Iterator[T]:
    if jobs == 1 or len(seeds) < 2:
        yield from map(task, seeds)
        return
    workers = Workers(jobs, 'ctsid_ros.studies.monte_carlo')
    try:
        yield from workers.map(task, seeds, max(1, min(4, len(seeds) // jobs)))
    finally:
        workers.end()


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
        parser.add_argument('--seeds', type=positive, default=count, metavar='N',
                            help='runs of each experiment (%(default)s)')
        parser.add_argument('--jobs', type=positive, default=cores(), metavar='N',
                            help='processes (one for each core)')
    parser.add_argument('--out', type=Path, default=Path('results/studies') / name,
                        metavar='FOLDER', help='for tables, figures and, if runs are '
                        'random, runs.csv, which an interrupted study takes up again '
                        '(%(default)s)')
    parser.set_defaults(study=name)
    return parser.parse_args(argv)


def positive(word: str) -> int:
    """Return the number that a word of the command line is, 1 or more."""
    value = int(word)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{value} is less than 1')
    return value


@contextmanager
def keeping(given: argparse.Namespace, experiments: int
            ) -> Iterator[Callable[[Task, str], list[Outcome]]]:
    """Give `runs` of so many experiments with what the command line says, and show how far."""
    kept = KeptRuns(given.out / 'runs.csv')
    with shown(given.study, experiments, given.seeds, given.jobs) as far:
        def one(task: Task, title: str) -> list[Outcome]:
            return runs(task, title, given.seeds, given.jobs, kept, given.study, far.begin(title))

        yield one
