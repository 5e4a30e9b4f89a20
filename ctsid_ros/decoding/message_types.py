# SPDX-License-Identifier: Apache-2.0
"""What a message type consists of: the one form in which definitions reach the extractors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import importlib
import re
from typing import Any, Literal

from ctsid_ros.decoding.field_path import nearest

HEADER = 'std_msgs/msg/Header'
TIMES = ('builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')
Encoding = Literal['cdr', 'ros1']


@dataclass(frozen=True)
class FieldType:
    """
    Type of one field.

    Parameters
    ----------
    base : str
        A primitive (`float64`, `string`, ...) or the name of a message type (`pkg/msg/Name`).
    kind : {'single', 'array', 'sequence'}
        One element, a fixed number of them, or a number that each message states.
    length : int
        Number of elements of a fixed array.
    unit : str
        As the title of a column says it.
    """

    base: str
    kind: Literal['single', 'array', 'sequence'] = 'single'
    length: int = 0
    unit: str = ''

    def __str__(self) -> str:
        bounds = {'single': '', 'array': f'[{self.length}]', 'sequence': '[]'}
        return self.base + bounds[self.kind]


Fields = Mapping[str, FieldType]
Types = Mapping[str, Fields]


@dataclass(frozen=True)
class MessageType:
    """
    A message type with all types that it is made of.

    Parameters
    ----------
    name : str
        Such as `sensor_msgs/msg/Imu`.
    types : mapping
        Fields, in order, of this type and of every type reachable from it.
    encoding : {'cdr', 'ros1'}
        How its messages are serialised.
    """

    name: str
    types: Types
    encoding: Encoding = 'cdr'

    @property
    def fields(self) -> Fields:
        """Fields of the outermost type."""
        return self.types[self.name]

    @property
    def has_header(self) -> bool:
        """Whether messages carry a stamp of their own: a field `header` of std_msgs/Header."""
        time = self.types.get(HEADER, {}).get('stamp', FieldType('')).base
        return (self.fields.get('header') == FieldType(HEADER)
                and {'sec', 'nanosec'} <= set(self.types.get(time, ())))


def reachable(name: str, types: Types) -> tuple[dict[str, Fields], list[str]]:
    """
    Return the types that `name` consists of, and the names of those that `types` lacks.

    Raises
    ------
    ValueError
        If a type contains itself.
    """
    found: dict[str, Fields] = {}
    missing: list[str] = []

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name not in types:
            missing.append(name)
            return
        found[name] = types[name]
        for base in dict.fromkeys(field.base for field in types[name].values()):
            if base in (*above, name):
                raise ValueError(f'the definition of {base} contains itself')
            if '/' in base and base not in found:
                visit(base, (*above, name))

    visit(name, ())
    return found, missing


def definition(message_type: MessageType) -> str:
    """Return the text of a type's definition as bags hold it (encoding `ros2msg`)."""
    texts: list[str] = []
    others = [name for name in message_type.types if name != message_type.name]
    for name in (message_type.name, *others):
        lines = [f'{field}'.replace('/msg/', '/') + f' {word}'
                 for word, field in message_type.types[name].items()]
        head = [] if not texts else ['=' * 80, 'MSG: ' + name.replace('/msg/', '/')]
        texts.append('\n'.join([*head, *lines]) + '\n')
    return ''.join(texts)


def of_message_class(message_class: Any) -> MessageType:
    """
    Return the type of a message class that rosidl generated (as rclpy uses them).

    Raises
    ------
    TypeError
        If it is no such class.
    """
    if not hasattr(message_class, 'get_fields_and_field_types'):
        raise TypeError(f'{message_class!r} is not a message class of ROS 2')
    types: dict[str, Fields] = {}

    def visit(name: str, cls: Any) -> None:
        declared = cls.get_fields_and_field_types()
        types[name] = {field: _rosidl_type(text) for field, text in declared.items()}
        for field in types[name].values():
            if '/' in field.base and field.base not in types:
                package, _, nested = field.base.split('/')
                module = importlib.import_module(f'{package}.msg')
                visit(field.base, getattr(module, nested))

    name = type_name(message_class)
    visit(name, message_class)
    return MessageType(name, types)


def type_name(message_class: Any) -> str:
    """Return the name of a message class of rclpy, such as `sensor_msgs/msg/Imu`."""
    return f'{message_class.__module__.partition(".")[0]}/msg/{message_class.__name__}'


def message_class(name: str) -> Any:
    """
    Return the class of a message type for rclpy.

    Parameters
    ----------
    name : str
        `sensor_msgs/msg/Imu` or `sensor_msgs/Imu`.

    Raises
    ------
    ImportError
        If it is not installed, or the package has no such message; the text says what is there.
    """
    package, _, kind = name.partition('/')
    kind = kind.removeprefix('msg/')
    try:
        module = importlib.import_module(f'{package}.msg')
    except ImportError as error:
        raise ImportError(f'the messages of {package} are not installed here ({error}); install '
                          'or source the package that defines them') from error
    found = getattr(module, kind, None)
    if found is None or not hasattr(found, 'get_fields_and_field_types'):
        raise ImportError(f'{package} has no message {kind}'
                          + nearest(kind, [n for n in vars(module) if n[:1].isupper()]))
    return found


def _rosidl_type(text: str) -> FieldType:
    sequence = re.fullmatch(r'sequence<(.+?)(, \d+)?>', text)
    array = re.fullmatch(r'(.+)\[(\d+)\]', text)
    if sequence:
        return FieldType(_rosidl_base(sequence[1]), 'sequence')
    if array:
        return FieldType(_rosidl_base(array[1]), 'array', int(array[2]))
    return FieldType(_rosidl_base(text))


def _rosidl_base(text: str) -> str:
    text = re.sub(r'<\d+>$', '', text)  # bounded strings
    words = {'double': 'float64', 'float': 'float32', 'boolean': 'bool', 'octet': 'byte'}
    if '/' in text:
        package, _, name = text.partition('/')
        return f'{package}/msg/{name.removeprefix("msg/")}'
    return words.get(text, text)
