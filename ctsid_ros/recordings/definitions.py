# SPDX-License-Identifier: Apache-2.0
"""
Message definitions as bags store them, turned into message types.

The definition in the bag wins. Where a bag has none (old sqlite3 bags, recordings without the
type's package), the type of that name in ROS 2 Jazzy, or ROS 1 Noetic, stands in.
"""

from __future__ import annotations

from functools import cache
import re
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype

from ctsid_ros.decoding.message_types import (
    Encoding,
    Fields,
    FieldType,
    MessageType,
    Types,
    reachable,
)
from ctsid_ros.recordings.recording import Connection

STORES = {'cdr': Stores.ROS2_JAZZY, 'ros1': Stores.ROS1_NOETIC}
_IDL_SEPARATOR = '=' * 80 + '\n'


class DefinitionError(ValueError):
    """A topic whose messages cannot be decoded; the message says why."""


def message_type(connection: Connection) -> MessageType:
    """
    Return the type of a connection's messages.

    Raises
    ------
    DefinitionError
        If they are neither CDR nor ROS 1, or the definition is missing or cannot be parsed.
    """
    if connection.message_type:
        return connection.message_type
    if connection.encoding not in STORES:
        raise DefinitionError(f'its messages are encoded as {connection.encoding!r}; ctsid reads '
                              'cdr and ros1')
    name = normalize_msgtype(connection.type)
    encoding: Encoding = 'cdr' if connection.encoding == 'cdr' else 'ros1'
    return _message_type(name, encoding, connection.format, connection.definition)


@cache
def _message_type(name: str, encoding: Encoding, form: str, text: str) -> MessageType:
    own = _parse(name, form, text)
    try:
        types, missing = reachable(name, own)
        if missing:  # else those of rosbags need not be loaded, which takes long
            types, missing = reachable(name, {**_default_types(encoding), **own})
    except ValueError as error:
        raise DefinitionError(str(error)) from None
    if name in missing:
        raise DefinitionError(f'the definition of {name} is neither in the bag nor known to '
                              'ctsid; record it where its package is sourced')
    return MessageType(name, types, encoding)


def _parse(name: str, form: str, text: str) -> dict[str, Fields]:
    if not text.strip():
        return {}
    try:
        if form in ('ros2msg', 'ros1msg'):
            return _types(get_types_from_msg(text, name))
        if form == 'ros2idl':
            return _parse_idl(text)
    except Exception as error:  # the parsers of rosbags raise all sorts on malformed text
        raise DefinitionError(f'the definition of {name} in the bag cannot be parsed: '
                              f'{type(error).__name__} {error}') from None
    raise DefinitionError(f'the definition of {name} is written in {form!r}; ctsid reads ros2msg, '
                          'ros2idl and ros1msg')


def _parse_idl(text: str) -> dict[str, Fields]:
    """Parse one IDL text, or several, each after a separator and the line 'IDL: name'."""
    parts = [text]
    if text.startswith(_IDL_SEPARATOR):
        parts = [part.partition('\n')[2] for part in text.split(_IDL_SEPARATOR) if part.strip()]
    types: dict[str, Fields] = {}
    for part in parts:
        # The parser of rosbags does not know the lines `#include "..."` of generated files.
        types |= _types(get_types_from_idl(re.sub(r'(?m)^\s*#.*$', '', part)))
    return types


def known_type(name: str) -> MessageType:
    """Return a type of ROS 2 Jazzy itself, such as `std_msgs/msg/String`."""
    return _message_type(name, 'cdr', '', '')


@cache
def _default_types(encoding: Encoding) -> Types:
    return _types(get_typestore(STORES[encoding]).fielddefs)


def _types(parsed: Any) -> dict[str, Fields]:
    return {name: {field: _field_type(description) for field, description in fields}
            for name, (_, fields) in parsed.items()}


def _field_type(description: Any) -> FieldType:
    node, content = description
    if node == Nodetype.BASE:
        return FieldType(content[0])
    if node == Nodetype.NAME:
        return FieldType(content)
    inner, count = content
    base = _field_type(inner).base
    return FieldType(base, 'array', count) if node == Nodetype.ARRAY else FieldType(
        base, 'sequence')
