# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C in a program: at once where it works, as soon as they are over while modules load."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import signal
import sys
from types import FrameType

_AGAIN = 0.02  # s until it is looked again whether modules still load
_LOADER = '<frozen importlib._bootstrap>'


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
    signal.signal(signal.SIGALRM, _interrupt)
    signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Python ends: nothing catches it any more


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _loading(frame):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
    else:
        raise KeyboardInterrupt


def _loading(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _LOADER:
            return True
        frame = frame.f_back
    return False
