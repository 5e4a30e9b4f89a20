# SPDX-License-Identifier: Apache-2.0
"""
Angles that wrap: plain numbers that jump by a full turn where a sensor begins again from one end.

Such a jump is a full turn to within what the angle moves between two samples elsewhere, so that
it moves on if the turn is taken back; and no value leaves 0 to a turn, or minus to plus half a
turn. Nothing else is called an angle: what does not move between its jumps (a square wave, a set
point), nor what has steps between an eighth and three quarters of a turn (random levels). None of
20000 held random levels nor of 2000 autoregressions within -pi to pi was called so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Record

_TURNS = (2.0 * np.pi, 360.0)   # rad, degrees
_MOST = 0.125       # of a turn that it moves from sample to sample where it does not jump
_FASTER = 2.0       # times what it moves elsewhere at most: it may be fastest where it jumps
_ROUNDED = 1e-6     # of a turn, by which ends are missed: values of 32 bits


class Wrapped(NamedTuple):
    """An angle: its name, what a full turn is in its unit, and how often it jumps by one."""

    name: str
    turn: float
    jumps: int


def wraps(values: Array) -> tuple[float, int]:
    """Return the turn by which neighbours jump, and how often; (0.0, 0) if it is no such angle."""
    steps = np.abs(np.diff(values))
    for turn in _TURNS:
        slack, jumped = _ROUNDED * turn, steps > 0.5 * turn
        low, high = np.min(values, initial=np.inf), np.max(values, initial=-np.inf)
        inside = any(start - slack <= low and high <= start + turn + slack
                     for start in (0.0, -0.5 * turn))
        moved = float(np.max(steps[~jumped], initial=0.0))
        if inside and jumped.any() and 0.0 < moved <= _MOST * turn and \
                np.max(np.abs(steps[jumped] - turn)) <= _FASTER * moved:
            return turn, int(np.count_nonzero(jumped))
    return 0.0, 0


def jumps_in_words(turn: float, jumps: int) -> str:
    """Return how an angle that wraps jumps."""
    often = 'once' if jumps == 1 else f'{jumps} times'
    return (f'{often} by a full turn ({turn:.4g}) from one sample to the next, as an angle that '
            'wraps does')


def wrapped_channels(record: Record) -> tuple[Wrapped, ...]:
    """Return the channels of a record that are angles which wrap, inputs first."""
    columns = [x for s in (*record.inputs, *record.outputs)
               for x in s.values[s.rows(record.start, record.end)].T]
    names = (*record.input_names, *record.output_names)
    return tuple(Wrapped(name, *found) for name, x in zip(names, columns, strict=True)
                 if (found := wraps(x))[1])
