# SPDX-License-Identifier: Apache-2.0
"""How far a long run is: a bar where a person watches, else a line each ten percent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
import sys
from time import monotonic
from typing import TextIO

_PATIENCE = 0.5  # s: what is over in less is not worth a line
Advance = Callable[[float, str], None]  # fraction done, what is worth knowing just now


def silent(fraction: float, text: str) -> None:
    """Take note of nothing."""


@contextmanager
def progress(title: str, *, quiet: bool = False, stream: TextIO | None = None
             ) -> Iterator[Advance]:
    """
    Give a function that shows how far a run is; on stderr, for stdout carries the result.

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


def _lines(title: str, stream: TextIO) -> Advance:
    shown, since = 0, monotonic()

    def advance(fraction: float, text: str) -> None:
        nonlocal shown, since
        tenths = int(10 * min(max(fraction, 0.0), 1.0) + 1e-9)
        if tenths > shown and monotonic() - since > _PATIENCE:
            shown, since = tenths, monotonic()
            print(f'{title}: {10 * tenths} %' + (f', {text}' if text else ''), file=stream,
                  flush=True)

    return advance


@contextmanager
def _bar(title: str, stream: TextIO) -> Iterator[Advance]:
    from rich.console import Console  # slow to import, and seldom needed
    from rich.markup import escape
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(),
               TimeRemainingColumn(), TextColumn('{task.fields[now]}'))
    with Progress(*columns, console=Console(file=stream), transient=True) as bar:
        task = bar.add_task(escape(title), total=1.0, now='')

        def advance(fraction: float, text: str) -> None:
            bar.update(task, completed=min(max(fraction, 0.0), 1.0), now=escape(text))

        yield advance
