# SPDX-License-Identifier: Apache-2.0
"""
One bag of a batch: identified window by window, and written.

A task is known by the content of the bag, the parameters and the version; what is done is not
done again, wherever the bag lies. It runs in a process of a cluster, which shares the disk.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
import hashlib
import json
from pathlib import Path

from ctsid_core.effort import work_rate
from ctsid_core.errors import CtsidError, StorageError
from ctsid_ros.batch.rows import (
    AGAIN,
    FAILURE,
    SUFFIX,
    UNREAD,
    WINDOWS,
    Made,
    Rows,
    failure_row,
    made_of,
    read_rows,
    window_rows,
    write_rows,
)
from ctsid_ros.config.channels import Config
from ctsid_ros.config.origin import code_digest, described, package_version
from ctsid_ros.recordings.content import all_files, content_hash, size, state
from ctsid_ros.replay.results import bag_name

_CODE = ('ctsid_core', 'ctsid_ros.decoding', 'ctsid_ros.ingest', 'ctsid_ros.recordings',
         'ctsid_ros.replay', 'ctsid_ros.batch')
# Modules that rows do not depend on.
_PAGES = ('summary', 'scheduling', 'bags', 'outliers', 'store')


@dataclass(frozen=True)
class Recipe:
    """
    All that the rows of a bag depend on, beside its content.

    Parameters
    ----------
    config : Config
    version : str
        Of ctsid, its code, NumPy and SciPy.
    rate : float
        Work per second that budgets count with.
    """

    config: Config
    version: str
    rate: float

    @classmethod
    def of(cls, config: Config) -> Recipe:
        """Return the recipe of this program."""
        return cls(config, version(), work_rate())

    @property
    def key(self) -> str:
        """The same for the same rows."""
        words = json.dumps([described(self.config), asdict(self.config.settings), self.version,
                            self.rate], sort_keys=True)
        return hashlib.sha256(words.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Task:
    """
    A bag, the folder for its rows, and how it is identified.

    Parameters
    ----------
    bag : str
        Absolute path.
    folder : str
    recipe : Recipe
    """

    bag: str
    folder: str
    recipe: Recipe

    def path(self, content: str) -> Path:
        """Return the file for the rows of the bag, of this content."""
        place = hashlib.sha256(self.bag.encode()).hexdigest()[:8]
        return Path(self.folder) / f'{bag_name([self.bag])}-{content[:16]}-{place}{SUFFIX}'

    def written(self, content: str) -> Path | None:
        """Return the file of rows that are written for this content: the bag's, or a copy's."""
        own = self.path(content)
        for path in (own, *Path(self.folder).glob(f'*-{content[:16]}-*{SUFFIX}')):
            made = made_of(path)
            if made and made.outcome != AGAIN and (made.content, made.recipe) == (
                    content, self.recipe.key):
                return path
        return None


@cache
def version() -> str:
    """Return what results depend on beside bags and parameters, in a word."""
    return f'{package_version()} {code_digest(_CODE, _PAGES)}'


def perform(task: Task) -> str:
    """
    Identify a bag and write its rows, unless that is done; return the name of their file.

    A bag that cannot be read, or gives no window, has a row that says so.

    Raises
    ------
    StorageError
        If the rows cannot be written, or this process runs another version of ctsid.
    """
    if version() != task.recipe.version:
        raise StorageError(f'this worker runs ctsid {version()}, but the batch was begun with '
                           f'{task.recipe.version}; install the same everywhere')
    found, content = '', UNREAD
    try:
        files = all_files([task.bag])
        found, content = state(files), content_hash(files)
        rows, outcome = _known(task, content) or (_rows(task), WINDOWS)
    except Exception as error:  # noqa: BLE001  # whatever it is: one bag must not end the others
        rows = failure_row(task.bag, _words(error))
        outcome = AGAIN if _of_the_computer(error) else FAILURE
    return _write(task, rows, Made(task.bag, found, content, task.recipe.key, outcome))


def rounds(tasks: Sequence[Task]) -> Iterator[list[Task]]:
    """
    Yield tasks that can be done at the same time.

    A bag as large as another may be its copy: it waits for that one, whose rows it then takes.
    """
    sizes: dict[int, Task] = {}
    later: dict[str, Task] = {}
    for task in tasks:
        try:
            if sizes.setdefault(size(all_files([task.bag])), task) is not task:
                later[task.bag] = task
        except OSError:
            continue  # its task will say so
    yield [task for task in tasks if task.bag not in later]
    if later:
        yield list(later.values())


def give_up(task: Task, failure: str) -> str:
    """Write the row of a bag that no process has lived through; return the name of its file."""
    files = all_files([task.bag])
    return _write(task, failure_row(task.bag, failure),
                  Made(task.bag, state(files), content_hash(files), task.recipe.key, FAILURE))


def _write(task: Task, rows: Rows, made: Made) -> str:
    path = task.path(made.content)
    write_rows(path, rows, made)
    return path.name


def _known(task: Task, content: str) -> tuple[Rows, str] | None:
    """Return rows that are written, for this bag or a copy of it; None if there are none."""
    path = task.written(content)
    if path is None:
        return None
    rows = read_rows(path)
    failed = any(row['failure'] for row in rows)
    if failed and path != task.path(content):
        return None  # it may name the copy
    return [row | {'bag': task.bag} for row in rows], FAILURE if failed else WINDOWS


def _rows(task: Task) -> Rows:
    from ctsid_ros.recordings.bag import open_bag  # here: solvers are for those who solve
    from ctsid_ros.replay.clock import zero_ns
    from ctsid_ros.replay.replay import Replay

    with open_bag(task.bag) as bag:
        run = Replay(bag, task.recipe.config)
        run.run()
        return window_rows(task.bag, bag.start_ns, run.results, run.best,
                           zero_ns(bag, run.results[0].estimate.start_ns))


def _words(error: Exception) -> str:
    if isinstance(error, CtsidError):
        return str(error)
    if isinstance(error, OSError):
        return (f'it cannot be read ({error.strerror}); check that it is there, and the '
                'permissions')
    return f'{type(error).__name__}: {error}'


def _of_the_computer(error: BaseException | None) -> bool:
    """Whether memory or disk failed, or there is no such file: another time it may go well."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError)
                                              and not isinstance(error, CtsidError)):
            return True
        error = error.__cause__
    return False
