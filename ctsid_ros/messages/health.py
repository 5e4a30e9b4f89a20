# SPDX-License-Identifier: Apache-2.0
"""How the node is, as a diagnostic message and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from ctsid_core.errors import StorageError
from ctsid_ros.messages.making import Make, header, ros_message


class Level(IntEnum):
    """How something is, as in `diagnostic_msgs/DiagnosticStatus`."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Health:
    """
    How one part of the node is.

    Parameters
    ----------
    name : str
    level : Level
    message : str
        One sentence.
    values : mapping of str to object
        Numbers and words; the unit is part of the key: 'rate [Hz]'.
    """

    name: str
    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


def encode_diagnostics(stamp_ns: int, statuses: Sequence[Health], make: Make = ros_message
                       ) -> Any:
    """
    Return the health of the node as `diagnostic_msgs/DiagnosticArray`.

    Parameters
    ----------
    stamp_ns : int
        Now [ns].
    statuses : sequence of Health
        Their numbers are written with six digits, for people.
    make : Make
        What makes messages, see `messages.making`.
    """
    return make('diagnostic_msgs/msg/DiagnosticArray', header=header(stamp_ns, make), status=[
        make('diagnostic_msgs/msg/DiagnosticStatus',
             level=bytes([status.level]), name=status.name, message=status.message,
             hardware_id='',
             values=[make('diagnostic_msgs/msg/KeyValue', key=key, value=_shown(value))
                     for key, value in status.values.items()])
        for status in statuses])


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def decode_diagnostics(msg: Any) -> tuple[int, tuple[Health, ...]]:
    """
    Return stamp [ns] and health of a `diagnostic_msgs/DiagnosticArray`; values are texts.

    Raises
    ------
    StorageError
        If it is not such a message.
    """
    try:
        stamp = msg.header.stamp
        return int(stamp.sec) * 10**9 + int(stamp.nanosec), tuple(
            Health(status.name, _level(status.level), status.message,
                   {pair.key: pair.value for pair in status.values}) for status in msg.status)
    except (AttributeError, TypeError, ValueError, IndexError) as error:
        raise StorageError(f'this message is not a diagnostic_msgs/DiagnosticArray ({error}); '
                           'check who publishes on the topic') from error


def _level(value: bytes | int) -> Level:
    return Level(value[0] if isinstance(value, bytes) else value)
