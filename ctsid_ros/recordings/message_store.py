# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 2 Jazzy's own types made and serialised without ROS, by rosbags."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import get_typestore

from ctsid_ros.decoding.message_types import FieldType
from ctsid_ros.recordings.definitions import STORES, known_type


@cache
def _store() -> Any:
    return get_typestore(STORES['cdr'])


def make_message(kind: str, **fields: Any) -> Any:
    """Return a message of rosbags: `make_message('std_msgs/msg/String', data='a')`."""
    types = known_type(kind).fields
    return _store().types[kind](**{name: _value(types[name], value)
                                   for name, value in fields.items()})


def _value(field: FieldType, value: Any) -> Any:
    """Return a value as rosbags wants it: arrays of numbers are NumPy's, bytes are numbers."""
    if field.kind != 'single' and '/' not in field.base and field.base != 'string':
        return np.array(value, dtype=field.base)
    return value[0] if isinstance(value, bytes) else value


def serialise(message: Any) -> bytes:
    """Return a message of `make_message` as CDR."""
    return bytes(_store().serialize_cdr(message, message.__msgtype__))
