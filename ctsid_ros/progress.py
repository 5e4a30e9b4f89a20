# SPDX-License-Identifier: Apache-2.0
"""
What a long run does and how far it is: a bar where a person watches, else a line each ten percent.

On stderr, for stdout carries the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
import sys
from threading import Timer
from time import monotonic
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress

_PATIENCE = 0.5  # s: what is over in less is not worth a line
_SURE = 1.0  # s of a run before the time left is estimated
Advance = Callable[[float, str], None]  # fraction done, what is worth knowing just now


def silent(fraction: float, text: str) -> None:
    """Take note of nothing."""


@contextmanager
def progress(title: str, *, quiet: bool = False, stream: TextIO | None = None
             ) -> Iterator[Advance]:
    """
    Give a function that shows how far a run is, and how long it will go on.

    Parameters
    ----------
    title : str
    quiet : bool
        Show nothing.
    stream : text file, optional
        stderr if not given.
    """
    stream = stream or sys.stderr
    if quiet:
        yield silent
    elif stream.isatty() and find_spec('rich'):
        with _bar(title, stream) as advance:
            yield advance
    else:
        yield _lines(title, stream)


@contextmanager
def working(title: str, *, quiet: bool = False, stream: TextIO | None = None) -> Iterator[None]:
    """
    Show what is being done while nobody knows how far it is, and for how long it has been.

    Without a terminal it is one line, once it has taken a while.
    """
    stream = stream or sys.stderr
    if quiet:
        yield
    elif stream.isatty() and find_spec('rich'):
        with _rich(stream, endless=True) as shown:
            shown.add_task(_escaped(title), total=None, now='')
            yield
    else:
        told = Timer(_PATIENCE, lambda: print(f'{title} ...', file=stream, flush=True))
        told.daemon = True
        told.start()
        try:
            yield
        finally:
            told.cancel()


def time_left(done: float, seconds: float) -> str:
    """
    Return how long a run will go on, as words; '' where it is too early to say.

    Parameters
    ----------
    done : float
        The part that is done, 0 to 1.
    seconds : float
        How long that took [s].
    """
    if not 0.0 < done < 1.0 or seconds < _SURE:
        return ''
    left = seconds * (1.0 - done) / done
    return f'about {left:.0f} s left' if left < 100 else f'about {left / 60:.0f} min left'


def _lines(title: str, stream: TextIO) -> Advance:
    start = since = monotonic()
    shown = 0

    def advance(fraction: float, text: str) -> None:
        nonlocal shown, since
        done = min(max(fraction, 0.0), 1.0)
        tenths = int(10 * done + 1e-9)
        if tenths > shown and monotonic() - since > _PATIENCE:
            shown, since = tenths, monotonic()
            words = (f'{title}: {10 * tenths} %', text, time_left(done, since - start))
            print(', '.join(word for word in words if word), file=stream, flush=True)

    return advance


@contextmanager
def _bar(title: str, stream: TextIO) -> Iterator[Advance]:
    with _rich(stream) as bar:
        task, start = bar.add_task(_escaped(title), total=1.0, now=''), monotonic()

        def advance(fraction: float, text: str) -> None:
            done = min(max(fraction, 0.0), 1.0)
            words = (text, time_left(done, monotonic() - start))
            bar.update(task, completed=done, now=_escaped('; '.join(w for w in words if w)))

        yield advance


def _rich(stream: TextIO, *, endless: bool = False) -> Progress:
    from rich.console import Console  # slow to import, and seldom needed
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )

    now = TextColumn('{task.fields[now]}')
    columns = (TextColumn('{task.description}'), SpinnerColumn(), TimeElapsedColumn(), now) \
        if endless else (TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(), now)
    return Progress(*columns, console=Console(file=stream), transient=True)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)
