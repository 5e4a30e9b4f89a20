# SPDX-License-Identifier: Apache-2.0
"""
Inputs that count as 0 while they are silent: a timeout stops a robot that hears no more.

Mobile bases hold a command for some time only (`cmd_vel_timeout`). What acts is 0 from so long
after a message on, until the next one comes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Record, Signal, channel_slices


def acting(inputs: Sequence[Signal], timeout: Sequence[float]) -> tuple[Signal, ...]:
    """
    Return inputs as they act, given the timeout of each channel, (nu,) [s]; 0: never.

    Raises `DataError` if channels of one signal, which share their messages, do not share it.
    """
    for signal, channels in zip(inputs, channel_slices(inputs), strict=True):
        if len(set(timeout[channels])) > 1:
            raise DataError(f'`timeout` is {tuple(timeout[channels])} of channels '
                            f'{signal.names or ""} of the same messages; give them the same')
    return tuple(stopped(signal, timeout[channels.start]) if signal.width else signal
                 for signal, channels in zip(inputs, channel_slices(inputs), strict=True))


def as_acting(record: Record, timeout: Sequence[float]) -> Record:
    """Return a record whose inputs are as they act."""
    return replace(record, inputs=acting(record.inputs, timeout))


def stopped(signal: Signal, timeout: float, rest: Array | float = 0.0) -> Signal:
    """Return a signal that, if it is held, is at rest so long after messages, if none follows."""
    t, late = signal.time, signal.time + timeout
    at = np.flatnonzero((t < late) & (late < np.append(t[1:], np.inf))
                        & np.any(signal.values != rest, axis=1))
    if signal.hold != 'zoh' or not len(at):
        return signal
    return replace(signal, time=np.insert(t, at + 1, late[at]),
                   values=np.insert(signal.values, at + 1, rest, axis=0))


def in_words(names: Sequence[str], timeout: Sequence[float]) -> tuple[str, ...]:
    """Return a sentence on each input that a timeout stops."""
    return tuple(f'input {name} counts as 0 from {seconds:.3g} s after a message on, until the '
                 'next one' for name, seconds in zip(names, timeout, strict=True) if seconds)
