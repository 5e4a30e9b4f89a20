# SPDX-License-Identifier: Apache-2.0
"""
Instants in notes, and in the reasons of verdicts.

They count from the start of the window, for that is all that a judge of one window knows; people
read them by the clock of what the window was cut from.
"""

from __future__ import annotations

import re

_AFTER = 's after the start of the window'
_NUMBER = r'(?<![\w./-])(-?\d+(?:\.\d+)?)'   # no part of a name
_INSTANTS = re.compile(rf'(?:from {_NUMBER} to )?{_NUMBER} {_AFTER}')


def after_start(time: float, until: float | None = None) -> str:
    """Return an instant, or from when to when, after the start of the window [s], in words."""
    at = f'{time:z.1f}' if until is None else f'from {time:z.1f} to {until:z.1f}'
    return f'{at} {_AFTER}'


def by_clock(text: str, start: float, of: str) -> str:
    """
    Return a text with all such instants by another clock, which counts from the start of `of`.

    The window starts at `start` [s] by that clock.
    """
    def shifted(found: re.Match[str]) -> str:
        first, last = ('' if t is None else f'{float(t) + start:.1f}' for t in found.groups())
        return f'{f"from {first} to " if first else ""}{last} s after the start of {of}'

    return _INSTANTS.sub(shifted, text)
