# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C in a program: at once where it works, as soon as they are over while modules load."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import signal
import sys
from time import monotonic
from types import FrameType

_AGAIN = 0.02  # s until it comes again: while modules load, or where Python swallowed it
_PAUSE = 1.0  # s in which a further one, as of a key that is held, does not break off the ending
_LOADER = '<frozen importlib._bootstrap>'
_SIGNALS = [getattr(signal, name) for name in ('SIGALRM', 'SIGINT') if hasattr(signal, name)]
_deaf_until = 0.0  # of the clock `monotonic`


@contextmanager
def interruptible() -> Iterator[None]:
    """
    Let Ctrl-C raise `KeyboardInterrupt`, but never out of an import; afterwards, ignore it.

    Python notes an interrupt that passes through code made from text, as that of dataclasses,
    and dies of SIGINT in the end; compiled modules turn it into an `ImportError`. For a whole
    program only: who called Python with SIGINT ignored, as a shell does behind `&`, is obeyed.
    """
    if sys.platform == 'win32' or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        yield
        return
    _handle(_interrupt)
    before = sys.unraisablehook

    def again(swallowed: sys.UnraisableHookArgs) -> None:
        """Interrupt again, where Python drops objects and prints and forgets what that raises."""
        global _deaf_until
        if not issubclass(swallowed.exc_type, KeyboardInterrupt):
            before(swallowed)
            return
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
        _deaf_until = 0.0

    sys.unraisablehook = again
    try:
        yield
    finally:
        _handle(signal.SIG_IGN)  # Python ends: nothing catches it any more
        sys.unraisablehook = before


@contextmanager
def deferred() -> Iterator[Callable[[], None]]:
    """
    Keep Ctrl-C until it is asked for: give a function that raises `KeyboardInterrupt` then.

    For loops around compiled code and its callbacks, out of which an exception may not come.
    """
    before = [signal.getsignal(number) for number in _SIGNALS]
    if signal.SIG_IGN in before:
        yield lambda: None
        return
    came: list[int] = []

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    _handle(lambda number, frame: came.append(number))
    try:
        yield check
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)


def _handle(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _deaf_until
    if _loading(frame):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
    elif monotonic() > _deaf_until:
        _deaf_until = monotonic() + _PAUSE
        raise KeyboardInterrupt


def _loading(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _LOADER:
            return True
        frame = frame.f_back
    return False
