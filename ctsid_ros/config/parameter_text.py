# SPDX-License-Identifier: Apache-2.0
"""What people read about the parameters: commented parameter files, and their reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field
import json
import re
import textwrap
from typing import Any

from ctsid_core.settings import is_number
from ctsid_ros.config.channels import CHANNEL_KEYS, OF_INPUTS, SETTINGS_KEYS, Config
from ctsid_ros.config.node_settings import NODE_KEYS

_HEAD = ('One file serves the node (--ros-args --params-file FILE) and the command line '
         '(--params FILE).')
LISTS = {'inputs': 'Names of the channels that act on the plant, in the order of the model.',
          'outputs': 'Names of the channels that measure it.'}
_FIRST = ('order', 'feedthrough', 'window.length', 'window.stride',
          'window.max_delay')
_PLAIN = re.compile(r'[A-Za-z_/][\w./-]*', re.ASCII)
_OTHER_MEANING = {'y', 'n', 'yes', 'no', 'on', 'off', 'true', 'false', 'null'}


def dump_config(config: Config, comments: bool = True) -> str:
    """Return a parameter file that reads back equal, every parameter with its comment."""
    lines = _comment(_HEAD, 0) + ['/**:', '  ros__parameters:']
    for key, channels in (('inputs', config.inputs), ('outputs', config.outputs)):
        names = ', '.join(_text(channel.name) for channel in channels)
        lines += ['', *_comment(LISTS[key], 4), f'    {key}: [{names}]']
    for number, channel in enumerate((*config.inputs, *config.outputs)):
        lines += ['', *_comment(f'The {channel.role} {channel.name}:', 4),
                  f'    {_text(channel.name)}:']
        for key, declared in CHANNEL_KEYS.items():
            if key not in OF_INPUTS or channel.role == 'input':
                lines += _entry(key, declared, channel, 6, explain=number == 0)
    lines += _grouped(SETTINGS_KEYS, config.settings)
    lines += ['', *_comment('The rest is for the node; the command line has no use for it.', 4)]
    lines += _grouped(NODE_KEYS, config.node)
    if not comments:
        lines = [line for line in lines if line and not line.lstrip().startswith('#')]
    return '\n'.join(lines) + '\n'


def dump_brief(config: Config) -> str:
    """
    Return a parameter file of one page that reads back equal.

    What was decided for these channels stands there; all else is commented out, with its default.
    """
    lines = _comment(_HEAD, 0) + ['/**:', '  ros__parameters:']
    for key, channels in (('inputs', config.inputs), ('outputs', config.outputs)):
        lines.append(f'    {key}: [{", ".join(_text(channel.name) for channel in channels)}]')
    for channel in (*config.inputs, *config.outputs):
        lines += ['', f'    {_text(channel.name)}:  # {channel.role}']
        for key, declared in CHANNEL_KEYS.items():
            if key not in OF_INPUTS or channel.role == 'input':
                lines += _brief(key, declared, channel, 6)
    lines += ['', *_comment('Most often changed; docs/parameters.md explains all, and `ctsid '
                            'params` prints it.', 4)]
    plain = {key: declared for key, declared in SETTINGS_KEYS.items() if key not in OF_INPUTS}
    first = {key: plain[key] for key in _FIRST}
    lines += _brief_groups(first, config.settings, shown=True)
    lines += ['', *_comment('The rest, at its defaults; remove the # to change a value.', 4)]
    lines += _brief_groups({key: d for key, d in plain.items() if key not in first},
                           config.settings)
    lines += ['', *_comment('For the node only:', 4)]
    lines += _brief_groups(NODE_KEYS, config.node)
    return '\n'.join(lines) + '\n'


def _brief_groups(keys: Mapping[str, Field[Any]], owner: object, shown: bool = False
                  ) -> list[str]:
    """Return entries group by group; a group of which nothing is set is commented out too."""
    groups: dict[str, list[str]] = {'': []}
    for name, declared in keys.items():
        group, _, key = name.rpartition('.')
        groups.setdefault(group, []).extend(
            _brief(key, declared, owner, 6 if group else 4, shown))
    lines = groups.pop('')
    for group, entries in groups.items():
        hidden = all(line.lstrip().startswith('#') for line in entries)
        lines += [f'    {"# " * hidden}{group}:', *entries]
    return lines


def _brief(key: str, declared: Field[Any], owner: object, indent: int, shown: bool = False
           ) -> list[str]:
    """Return an entry, commented out if it has its default and need not be shown."""
    value = getattr(owner, declared.name)
    usual = declared.default if declared.name != 'hold' else 'zoh' if getattr(
        owner, 'role', '') == 'input' else 'smooth'
    hidden = not shown and declared.default is not MISSING and value == usual
    return [f'{" " * indent}{"# " * hidden}{key}: {value_text(declared, value)}']


def _grouped(keys: Mapping[str, Field[Any]], owner: object) -> list[str]:
    """Return the entries of declared parameters, those of no group first."""
    groups: dict[str, list[str]] = {'': []}
    for name, declared in keys.items():
        group, _, key = name.rpartition('.')
        lines = groups.setdefault(group, ['', f'    {group}:'])
        if name not in OF_INPUTS:  # they are with the channels
            lines += [] if group else ['']
            lines += _entry(key, declared, owner, 6 if group else 4)
    return [line for lines in groups.values() for line in lines]


def _entry(key: str, declared: Field[Any], owner: object, indent: int,
           explain: bool = True) -> list[str]:
    comment = _comment(describe(declared), indent) if explain else []
    value = value_text(declared, getattr(owner, declared.name))
    return [*comment, f'{" " * indent}{key}: {value}']


def describe(declared: Field[Any]) -> str:
    """Return what there is to say of a declared parameter: meaning, unit, range, default."""
    meta = declared.metadata
    facts = [meta['unit'], limits(declared)]
    if declared.default is not MISSING:
        facts.append(f'default {value_text(declared, declared.default)}')
    listed = ', '.join(fact for fact in facts if fact)
    return ' '.join(part for part in (meta['doc'], f'[{listed}]' if listed else '', meta['when'])
                    if part)


def limits(declared: Field[Any]) -> str:
    """Return range or choices of a declared parameter, and what 0 means; '' if there are none."""
    meta = declared.metadata
    low, high = (None if meta[side] is None else f'{meta[side]:g}' for side in ('low', 'high'))
    automatic = f', 0 is automatic: {meta["auto"]}' if meta['auto'] else ''
    if meta['choices']:
        return ' | '.join(meta['choices'])
    if low and high:
        return ' | '.join((*meta['words'], f'{low} to {high}{automatic}'))
    return (f'at least {low}' if low else f'at most {high}' if high else '') + automatic


def parameters_markdown() -> str:
    """Return the reference of all parameters, for `docs/parameters.md`."""
    lines = ['<!-- Written from the declarations in the code; do not edit. -->', '# Parameters',
             '', _HEAD, 'Those marked * are fixed while the node is configured.', '',
             '## Channels', '', *(f'- `{key}`: {text}' for key, text in LISTS.items()), '',
             'Each channel, say `torque`, has:', '',
             *_table({f'torque.{key}': declared for key, declared in CHANNEL_KEYS.items()}),
             '', '## Identification', '', *_table(SETTINGS_KEYS),
             '', '## Node', '', 'The command line accepts them and has no use for them.', '',
             *_table(NODE_KEYS)]
    return '\n'.join(lines) + '\n'


def _table(declarations: Mapping[str, Field[Any]]) -> Iterator[str]:
    yield '| parameter | default | unit | range | meaning |'
    yield '|---|---|---|---|---|'
    for name, declared in declarations.items():
        meta = declared.metadata
        default = '' if declared.default is MISSING else \
            f'`{value_text(declared, declared.default)}`'
        cells = (f'`{name}`' + ('*' if meta['structural'] else ''), default, meta['unit'],
                 limits(declared), f'{meta["doc"]} {meta["when"]}'.strip())
        yield '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'


def _comment(text: str, indent: int) -> list[str]:
    prefix = ' ' * indent + '# '
    return textwrap.wrap(text, 99, initial_indent=prefix, subsequent_indent=prefix,
                         break_long_words=False, break_on_hyphens=False)


def value_text(declared: Field[Any], value: object) -> str:
    """Return the value of a parameter as YAML that ROS, YAML 1.1 and YAML 1.2 read alike."""
    if isinstance(value, tuple):
        return f'[{", ".join(value_text(declared, item) for item in value)}]'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float) and is_number(declared):
        mantissa, exponent, rest = repr(float(value)).partition('e')
        return mantissa + ('.0' if '.' not in mantissa else '') + exponent + rest
    return _text(value) if isinstance(value, str) else str(value)


def _text(value: str) -> str:
    if _PLAIN.fullmatch(value) and value.lower() not in _OTHER_MEANING:
        return value
    if value.isprintable():
        return "'" + value.replace("'", "''") + "'"
    return json.dumps(value)
