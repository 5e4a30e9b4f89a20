# SPDX-License-Identifier: Apache-2.0
"""
The parameters of the node: declared, read all at once, and changed while it runs.

A parameter whose value in the file is of a wrong type is declared all the same, without a type:
so the node starts, `read` reports every fault at once, and a good value gives it its type back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field
from functools import partial
import time
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from ctsid_core.errors import SettingsError
from ctsid_core.settings import Settings, build_declared, value_faults
from ctsid_ros.config.channels import (
    CHANNEL_KEYS,
    OF_INPUTS,
    RESERVED,
    ROLE_LISTS,
    SETTINGS_KEYS,
    Channel,
    Config,
    Role,
)
from ctsid_ros.config.node_settings import NODE_KEYS, NodeSettings
from ctsid_ros.config.parameter_file import OWN_KEYS, as_number, parse_parameters
from ctsid_ros.config.parameter_text import describe
from ctsid_ros.node.descriptors import default, descriptor, untyped

_PLAIN = {'name': 'a', 'role': 'input', 'topic': 'a', 'type': '', 'field': 'a'}
_DISCOVERY = 2.0  # s: publishers that run are known by then
_WHOLE = (Parameter.Type.INTEGER, Parameter.Type.INTEGER_ARRAY)
_FIXED = ('is fixed while the node is configured; clean it up first (ros2 lifecycle set '
          '{node} cleanup), or change the parameter file')
_ELSEWHERE = ('no parameter of a file is for this node: the file has to name it, as `{node}:`, or '
              'all, as `/**:`; or start the node by the name in the file, with `-r __node:=NAME`')


def declare(node: Node) -> None:
    """
    Declare all parameters on a node, with their descriptions; the file's values count.

    Nothing in the file makes it raise: `read` reports what is wrong.
    """
    for name in (*ROLE_LISTS, *OWN_KEYS):
        _declare_anew(node, name, OWN_KEYS.get(name))
    for key in OF_INPUTS:  # it stands for those of the channels, if it is given
        if _value(node, key) == 'auto':
            node.undeclare_parameter(key)
    _declare_channels(node)


def read(node: Node) -> Config:
    """
    Return what the parameters of a node say.

    Raises
    ------
    SettingsError
        With all faults: of values, of names in the parameter file that are no parameters, of
        topics, and of channels whose message type is not given.
    """
    faults = _topic_faults(node)
    try:
        config = parse_parameters(_given(node))
    except SettingsError as error:
        faults = [*error.faults, *faults]
    if faults and _overrides(node).keys().isdisjoint((*ROLE_LISTS, *OWN_KEYS)):
        faults.append(_ELSEWHERE.format(node=node.get_fully_qualified_name()))
    if faults:
        raise SettingsError(faults)
    return config


def watch(node: Node, locked: Callable[[], bool], apply: Callable[[Config], None]) -> None:
    """
    Let the parameters of a node be changed.

    Parameters
    ----------
    node : Node
        With the parameters of `declare`.
    locked : callable
        Whether structural parameters are fixed. While they are not, setting `inputs` or `outputs`
        declares the parameters of new channels.
    apply : callable
        Given the new config after each change of another parameter while they are.
    """
    node.add_pre_set_parameters_callback(partial(_as_numbers, node))
    node.add_on_set_parameters_callback(lambda changed: _judge(node, locked(), changed))
    node.add_post_set_parameters_callback(
        lambda changed: _follow(node, locked(), apply, [p.name for p in changed]))


def _keys(node: Node) -> dict[str, Field[Any]]:
    """Return the declarations that count now, under their full names; without the lists."""
    shared = {key for key in OF_INPUTS if node.has_parameter(key)}
    keys = {name: d for name, d in OWN_KEYS.items() if name not in OF_INPUTS or name in shared}
    for channel, role in _listed(node).items():
        for key, declared in CHANNEL_KEYS.items():
            if key not in OF_INPUTS or (role == 'input' and key not in shared):
                keys[f'{channel}.{key}'] = declared
    return keys


def _listed(node: Node) -> dict[str, Role]:
    """Return the channels in `inputs` and `outputs` that can have parameters."""
    return {name: role for key, role in ROLE_LISTS.items() for name in _names(_value(node, key))
            if name.isidentifier() and name not in RESERVED}


def _names(value: object) -> list[str]:
    return [v for v in value if isinstance(v, str)] if isinstance(value, list) else []


def _value(node: Node, name: str) -> Any:
    """Return the value of a parameter; None if it is not declared, or an empty list in a file."""
    return _plain(node.get_parameter_or(name).value)


def _plain(value: Any) -> Any:
    return value if value is None or isinstance(value, bool | int | float | str) else list(value)


def _overrides(node: Node) -> dict[str, Any]:
    """
    Return the parameters that the command line and its files give to a node, known or not.

    rclpy keeps them to itself; its handle has them.
    """
    with node.handle:
        given = node.handle.get_parameters(Parameter)
    return {name: _plain(parameter.value) for name, parameter in given.items()}


def _declare_anew(node: Node, name: str, declared: Field[Any] | None) -> None:
    """Declare a parameter, or one of the lists (None); what is not of its type has none."""
    if node.has_parameter(name):  # by a node that declares all it is given
        node.undeclare_parameter(name)
    with_type = Parameter.Type.STRING_ARRAY if declared is None else default(declared)
    try:
        node.declare_parameter(name, with_type, descriptor(name, declared))
    except (InvalidParameterTypeException, InvalidParameterValueException):
        node.declare_parameter(name, None, untyped(name, declared))
        _mend(node, name, declared)
    if declared is None and _value(node, name) is None:
        node.set_parameters([Parameter(name, Parameter.Type.STRING_ARRAY, [])])


def _mend(node: Node, name: str, declared: Field[Any] | None) -> None:
    """Give a parameter without type its type, if its value suits it now."""
    value = _value(node, name)
    mixed = declared is not None and declared.metadata['words']     # has no type, ever
    if mixed or not node.describe_parameter(name).dynamic_typing:
        return
    if declared is not None:
        value = as_number(declared, value)
        if value_faults(declared, tuple(value) if isinstance(value, list) else value):
            return
    elif not value or len(_names(value)) < len(value):
        return
    node.undeclare_parameter(name)
    node.declare_parameter(name, value, descriptor(name, declared), ignore_override=True)


def _declare_channels(node: Node) -> None:
    """Declare what the channels listed now need, and drop what those listed no more had."""
    keys, listed = _keys(node), _listed(node)
    for name in node.list_parameters([], 0).names:
        head, _, tail = name.partition('.')
        if tail in CHANNEL_KEYS and head not in listed and \
                node.describe_parameter(name).description == describe(CHANNEL_KEYS[tail]):
            node.undeclare_parameter(name)
    for name, declared in keys.items():
        if not node.has_parameter(name):
            _declare_anew(node, name, declared)


def _given(node: Node) -> dict[str, object]:
    """Return what a parameter file would say that has the present values."""
    overrides = _overrides(node)
    keys = _keys(node)
    once = {name for key in ROLE_LISTS for name in _names(overrides.get(key))}
    unlisted = once - set(_listed(node))  # changed since then: not a fault of the file
    values: dict[str, object] = {
        name: value for name, value in overrides.items()
        if name not in keys and name.partition('.')[0] not in unlisted}
    values |= {key: _value(node, key) or [] for key in ROLE_LISTS}
    present = {name: _value(node, name) for name in keys}
    return values | {name: value for name, value in present.items()  # 0 and False are equal
                     if repr(value) != repr(default(keys[name]))}


def _topic_faults(node: Node) -> list[str]:
    """Return what is wrong with names of topics and their types, as far as the node knows."""
    graph, faults = dict(node.get_topic_names_and_types()), []
    until = time.monotonic() + _DISCOVERY
    for name in _listed(node):
        topic, kind = (_value(node, f'{name}.{key}') for key in ('topic', 'type'))
        if not topic or not isinstance(topic, str):
            continue  # its other faults are reported elsewhere
        types: Sequence[str] = ()
        try:
            own = node.resolve_topic_name(topic)
            # A node that has just started does not know yet what others publish.
            while kind == '' and own not in graph and time.monotonic() < until:
                time.sleep(0.05)
                graph = dict(node.get_topic_names_and_types())
            types = graph.get(own, ())
        except RuntimeError as error:  # RCLError: its class is private
            reason = str(error).partition(', at ')[0]
            faults.append(f'`{name}.topic` is {topic!r}, which cannot be a topic: {reason}')
            continue
        if kind == '':
            now = (f'{topic} is of type {" and ".join(types)} now' if types else
                   f'nobody publishes {topic} now from whom its type could be seen')
            example = types[0] if types else 'sensor_msgs/msg/Imu'
            faults.append(f'`{name}.type` is missing ({now}); add it, like {example}')
    return faults


def _as_numbers(node: Node, changed: list[Any]) -> list[Any]:
    """Return parameters with whole numbers as floats where floats are wanted."""
    keys = _keys(node)
    return [Parameter(p.name, value=as_number(keys[p.name], _plain(p.value)))
            if p.name in keys and p.type_ in _WHOLE else p for p in changed]


def _judge(node: Node, locked: bool, changed: list[Any]) -> SetParametersResult:
    """Accept or reject changes, judged together."""
    keys = _keys(node)
    new = {p.name: _plain(p.value) for p in changed  # what is being declared is not judged
           if (p.name in keys or p.name in ROLE_LISTS) and node.has_parameter(p.name)}
    fixed = [name for name, value in new.items() if locked and value != _value(node, name)
             and (name in ROLE_LISTS or keys[name].metadata['structural'])]
    faults = [f'`{name}` ' + _FIXED.format(node=node.get_fully_qualified_name())
              for name in fixed]
    faults += _value_faults(node, {n: v for n, v in new.items() if n in keys})
    return SetParametersResult(successful=not faults, reason='\n'.join(dict.fromkeys(faults)))


def _value_faults(node: Node, new: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with changes: of channels each alone, of the others all together."""
    now = {name: _value(node, name) for name in _keys(node) if name in OWN_KEYS}
    after = now | {name: value for name, value in new.items() if name in OWN_KEYS}
    known = _own_faults(now)
    faults = [fault for fault in _own_faults(after) if fault not in known]
    for name, value in new.items():
        if name not in OWN_KEYS:
            channel, _, key = name.partition('.')
            faults += _faults_of(Channel, **_PLAIN | {'name': channel, key: value})
    return faults


def _own_faults(values: Mapping[str, Any]) -> list[str]:
    return [fault for cls, keys in ((Settings, SETTINGS_KEYS), (NodeSettings, NODE_KEYS))
            for fault in _faults_of(build_declared, cls, {
                name: value for name, value in values.items() if name in keys})]


def _faults_of(build: Callable[..., object], *arguments: Any, **named: Any) -> tuple[str, ...]:
    try:
        build(*arguments, **named)
    except SettingsError as error:
        return error.faults
    return ()


def _follow(node: Node, locked: bool, apply: Callable[[Config], None], names: Sequence[str]
            ) -> None:
    """Do what changes entail."""
    keys = _keys(node)
    for name in names:
        if node.has_parameter(name) and (name in keys or name in ROLE_LISTS):
            _mend(node, name, keys.get(name))
    if not locked and not ROLE_LISTS.keys().isdisjoint(names):
        _declare_channels(node)
    if locked and any(name in keys and not keys[name].metadata['structural'] for name in names):
        apply(read(node))
