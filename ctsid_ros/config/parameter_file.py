# SPDX-License-Identifier: Apache-2.0
"""
Parameter files: read and written.

One ROS 2 parameter file drives the node (`--ros-args --params-file`) and the command line.
Parameters may be nested or dotted, under `/**` or a node's name. All faults of a file are
listed at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import Field
from pathlib import Path
import re
from typing import Any, TypeVar

import yaml

from ctsid_core.errors import SettingsError
from ctsid_core.settings import Settings, build_declared, is_number, value_faults
from ctsid_ros.config.channels import (
    CHANNEL_KEYS,
    OF_INPUTS,
    RESERVED,
    ROLE_LISTS,
    SETTINGS_KEYS,
    Channel,
    Config,
    Role,
    list_faults,
)
from ctsid_ros.config.node_settings import NODE_KEYS, NodeSettings
from ctsid_ros.config.parameter_text import dump_config, parameters_markdown
from ctsid_ros.decoding.field_path import nearest

__all__ = ['Channel', 'Config', 'dump_config', 'parameters_markdown', 'parse_config',
           'parse_parameters', 'read_config', 'with_parameters']

NODE = 'identifier'
OWN_KEYS = {**SETTINGS_KEYS, **NODE_KEYS}  # those of no channel
# Parameters that ROS itself gives every node: not ours, and no fault.
_OF_ROS = re.compile(r'(use_sim_time|start_type_description_service|qos_overrides\..*)$')
_T = TypeVar('_T')


def read_config(path: str | Path) -> Config:
    """
    Read a parameter file.

    Raises
    ------
    SettingsError
        If there is no such file, it is not YAML, or anything in it is wrong: all faults at once.
    """
    path = Path(path)
    try:
        document = yaml.load(path.read_text(encoding='utf-8'), Loader=_Loader)
    except FileNotFoundError:
        others = sorted(p.name for p in path.parent.glob('*.y*ml')) if path.parent.is_dir() else []
        raise SettingsError([f'there is no file {path}{nearest(path.name, others)}']) from None
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError([f'{path} cannot be read as a parameter file: {error}']) from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise SettingsError([f'{path} is not YAML: {error}\n  (a value that contains any of '
                             "[ ] { } , : # needs quotes: 'effort[0]')"]) from error
    if document is None:
        raise SettingsError([f'{path} is empty; `ctsid init` writes a file to start from'])
    return parse_config(document)


def parse_config(document: object) -> Config:
    """
    Build a config from the content of a parameter file.

    Parameters
    ----------
    document : mapping
        `{node: {'ros__parameters': {...}}}`. Of several nodes, those named by a wildcard or
        `identifier` count, and later ones override.

    Raises
    ------
    SettingsError
        With one sentence per fault.
    """
    nodes = list(_nodes(document, ''))
    if not nodes:
        raise SettingsError(['there is no `ros__parameters` in it; a parameter file begins with\n'
                             '    /**:\n      ros__parameters:'])
    ours = [values for name, values in nodes
            if name.rsplit('/', 1)[-1] in (NODE, '*', '**') or len(nodes) == 1]
    if not ours:
        raise SettingsError([f'it has parameters for {", ".join(n for n, _ in nodes)}, but none '
                             f'for {NODE} nor /**; rename one of them'])
    faults: list[str] = []
    flat: dict[str, object] = {}
    for values in ours:
        flat |= _flatten(values, faults)
    return _build(flat, faults)


def parse_parameters(values: Mapping[str, object]) -> Config:
    """
    Build a config from the parameters of one node, nested or dotted.

    Raises
    ------
    SettingsError
        With one sentence per fault.
    """
    return parse_config({'/**': {'ros__parameters': values}})


def with_parameters(config: Config, changes: Sequence[str]) -> Config:
    """
    Return a config with other values of some parameters, each as `name=value`, names dotted.

    One `delay` for all, or for each input in turn, takes the place of those of the channels, and
    so does what else each input has of its own (`OF_INPUTS`).

    Raises
    ------
    SettingsError
        With one sentence per fault.
    """
    faults = [f'{text!r} is not NAME=VALUE, such as order=4' for text in changes
              if not re.match(r'[^=\s]+=', text)]
    if faults:
        raise SettingsError(faults)
    (_, values), = _nodes(yaml.load(dump_config(config, comments=False), Loader=_Loader), '')
    flat = _flatten(values, faults)
    for name, _, value in (text.partition('=') for text in changes):
        try:
            flat[name] = yaml.load(value, Loader=_Loader)
        except (yaml.YAMLError, ValueError) as error:
            raise SettingsError([f'the value of {name}={value} cannot be read: {error}']) from None
        if name in OF_INPUTS:
            flat = {key: old for key, old in flat.items() if not key.endswith(f'.{name}')}
    return _build(flat, faults)


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """YAML as ROS reads it, where 1e-3 is a number; and a key given twice is a fault."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key.value, str) and key.value in seen:
                raise yaml.MarkedYAMLError(problem=f'`{key.value}` is given twice',
                                           problem_mark=key.start_mark)
            seen |= {key.value} if isinstance(key.value, str) else set()
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'),
    list('-+.0123456789'))


def _nodes(document: object, path: str) -> Iterator[tuple[str, object]]:
    """Yield the full name and the parameters of each node of a file."""
    for key, value in document.items() if isinstance(document, Mapping) else ():
        if key == 'ros__parameters':
            yield path, value
        else:
            yield from _nodes(value, f'{path}/{str(key).strip("/")}')


def _flatten(values: object, faults: list[str], prefix: str = '') -> dict[str, object]:
    """Return nested parameters under their dotted names."""
    if not isinstance(values, Mapping):
        faults.append(f'`ros__parameters` is {values!r}; it should hold lines of name: value')
        return {}
    flat: dict[str, object] = {}
    for key, value in values.items():
        if not isinstance(key, str):
            faults.append(f'the name {prefix}{key!r} is not text; put it between quotes')
            continue
        new = {prefix + key: value}
        if isinstance(value, Mapping):
            new = _flatten(value, faults, f'{prefix}{key}.')
        faults += [f'`{name}` is given twice, nested and dotted; keep one'
                   for name in new if name in flat]
        flat |= new
    return {name: value for name, value in flat.items() if not _OF_ROS.match(name)}


def _build(flat: dict[str, object], faults: list[str]) -> Config:
    """Sort parameters into channels, settings and those of the node; raise with all faults."""
    listed = [(name, role) for key, role in ROLE_LISTS.items()
              for name in _names(key, flat.pop(key, []), faults)]
    faults += list_faults(listed)
    own: dict[str, dict[str, object]] = {name: {} for name, _ in listed if name not in RESERVED}
    rest: dict[str, object] = {}
    for name, value in flat.items():
        head, _, tail = name.partition('.')
        if head in own:
            own[head] |= {tail: value} if tail else {}
        else:
            rest[name] = value
    unlisted = _sort_out(rest, list(own), faults)
    for key in OF_INPUTS:
        _share(key, rest, {n: own[n] for n, role in listed if role == 'input' and n in own},
               faults)
    settings: Settings | None = _gather(faults, build_declared, Settings, _of(SETTINGS_KEYS, rest))
    node: NodeSettings | None = _gather(faults, build_declared, NodeSettings, _of(NODE_KEYS, rest))
    channels = [_gather(faults, _channel, name, role, own[name], unlisted)
                for name, role in dict(listed).items() if name in own]
    if faults or settings is None or node is None:
        raise SettingsError(faults)
    return Config(tuple(channel for channel in channels if channel), settings, node)


def _of(keys: Mapping[str, Field[Any]], values: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in values.items() if name in keys}


def _gather(faults: list[str], build: Callable[..., _T], *arguments: Any) -> _T | None:
    try:
        return build(*arguments)
    except SettingsError as error:
        faults += error.faults
        return None


def _names(key: str, value: object, faults: list[str]) -> list[str]:
    if isinstance(value, list | tuple) and all(isinstance(name, str) for name in value):
        return list(value)
    faults.append(f'`{key}` is {value!r}, but a list of channel names is wanted, like '
                  f"{key}: [a, b] (with quotes where a name means something to YAML: 'on')")
    return [value] if isinstance(value, str) else []


def _sort_out(rest: dict[str, object], listed: list[str], faults: list[str]) -> list[str]:
    """Keep those of no channel; report the others and return the channels that are not listed."""
    unlisted = sorted({head for head, _, tail in (name.partition('.') for name in rest)
                       if tail in CHANNEL_KEYS and head not in RESERVED})
    faults += [f'the channel `{name}` is described but not listed; add it to `inputs` or '
               f'`outputs`, or remove it{nearest(name, listed)}' for name in unlisted]
    for name in [name for name in rest if name not in OWN_KEYS]:
        del rest[name]
        if name.partition('.')[0] not in unlisted:
            faults.append(f'`{name}` is not a parameter'
                          f'{nearest(name, [*OWN_KEYS, *ROLE_LISTS])}')
    rest.update({name: as_number(OWN_KEYS[name], value) for name, value in rest.items()})
    return unlisted


def _share(key: str, rest: dict[str, object], inputs: Mapping[str, dict[str, object]],
           faults: list[str]) -> None:
    """Give a value that stands for all inputs, or for each in turn, to their channels."""
    if key not in rest:
        return
    given = rest.pop(key)
    each = given if isinstance(given, list) else [given] * len(inputs)
    new = value_faults(SETTINGS_KEYS[key], tuple(each) if isinstance(given, list) else given)
    if len(each) != len(inputs):
        new.append(f'`{key}` has {len(each)} values but there are {len(inputs)} input channels; '
                   'give one for all, or one per channel')
    if twice := [name for name, own in inputs.items() if key in own]:
        new.append(f'`{key}` is given, and `{twice[0]}.{key}` too; keep one of them')
    faults += new
    for own, value in zip(inputs.values(), each, strict=False):
        if own and not new:
            own[key] = value


def _channel(name: str, role: Role, own: Mapping[str, object], unlisted: list[str]) -> Channel:
    if not own:
        raise SettingsError([f'the channel `{name}` is listed but not described; add '
                             f'{name}: {{topic: ..., type: ..., field: ...}}'
                             f'{nearest(name, unlisted)}'])
    faults = [f'`{name}.{key}` is not a parameter{nearest(key, list(CHANNEL_KEYS))}'
              for key in own if key not in CHANNEL_KEYS]
    values = {key: as_number(CHANNEL_KEYS[key], value) for key, value in own.items()
              if key in CHANNEL_KEYS}
    channel: Channel | None = _gather(
        faults, build_declared, Channel,
        {'type': '', **values, 'name': name, 'role': role}, f'{name}.')
    if faults or channel is None:
        raise SettingsError(faults)
    return channel


def as_number(declared: Field[Any], value: object) -> object:
    """Return whole numbers as floats where floats are wanted: people write 20 for 20.0."""
    if isinstance(value, list):
        return [as_number(declared, item) for item in value]
    if is_number(declared) and type(value) is int and abs(value) < 2**53:
        return float(value)
    return value
