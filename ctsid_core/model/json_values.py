# SPDX-License-Identifier: Apache-2.0
"""
Values of JSON documents, written and strictly read.

A reader takes a value and its place in the document, and returns what it stands for, or raises
`StorageError` with that place. NaN is null, infinities are the words "Infinity" and "-Infinity".
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from enum import Enum
import json
import math
from typing import Any

import numpy as np

from ctsid_core.errors import StorageError
from ctsid_core.linear.types import Array

Reader = Callable[[Any, str], Any]


def to_text(value: Any) -> str:
    """Return a value as JSON text."""
    return _text(_plain(value))


def _plain(value: Any) -> Any:
    # To what JSON has words for
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else 'Infinity' if value > 0 else '-Infinity'
    return value if value is None or isinstance(value, str | bool | int | float) else str(value)


def _text(value: Any, indent: str = '') -> str:
    # One line per entry, row or long sentence; short lists on one line
    if isinstance(value, dict) and value:
        lines = [f'{_line(k)}: {_text(v, indent + "  ")}' for k, v in value.items()]
    elif isinstance(value, list) and any(isinstance(v, dict | list | str) for v in value) and (
            len(_line(value)) > 70 or not isinstance(value[0], str)):
        lines = [_line(v) for v in value]
    else:
        return _line(value)
    ends = '{}' if isinstance(value, dict) else '[]'
    body = ',\n'.join(f'{indent}  {line}' for line in lines)
    return f'{ends[0]}\n{body}\n{indent}{ends[1]}'


def _line(value: Any) -> str:
    return json.dumps(value, allow_nan=False)


def from_text(text: str) -> Any:
    """Return the value of JSON text, in which no key occurs twice."""
    try:
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_without_twins)
    except StorageError:
        raise
    except (ValueError, RecursionError) as error:
        raise StorageError(f'not JSON, or cut off ({error}); copy or write the file again'
                           ) from error


def _refuse_constant(word: str) -> None:
    raise StorageError(f'holds {word}, which JSON does not know; write null for an unknown number')


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [k for k, _ in pairs]
        twins = sorted({k for k in names if names.count(k) > 1})
        raise StorageError(f'the key {", ".join(map(repr, twins))} occurs twice; keep one')
    return found


def entries(value: Any, where: str, readers: Mapping[str, Reader],
            optional: Collection[str] = ()) -> dict[str, Any]:
    """Return what an object holds: one entry for each reader, some may be missing; no others."""
    found = mapping(value, where)
    faults = [f'{what}: {", ".join(keys)}' for what, keys in (
        ('missing', [k for k in readers if k not in found and k not in optional]),
        ('unknown', [k for k in found if k not in readers])) if keys]
    if faults:
        place = f' in `{where}`' if where else ''
        raise StorageError(f'keys{place} do not match the format ({"; ".join(faults)}); write the '
                           'file again')
    return {key: read(found[key], f'{where}.{key}' if where else key)
            for key, read in readers.items() if key in found}


def readers_of(cls: type[Any], **others: Reader) -> dict[str, Reader]:
    """Return the readers of the fields of a dataclass: of words and numbers, and others."""
    by_type = {'str': word, 'bool': answer, 'int': whole, 'float': number, 'object': anything,
               'Array': numbers(nan=True), 'tuple[str, ...]': listed(word)}
    return {f.name: others.get(f.name) or by_type[str(f.type)] for f in fields(cls)}


def made(cls: type[Any], **others: Reader) -> Reader:
    """Return a reader of a dataclass whose keys are its fields."""
    wanted = readers_of(cls, **others)
    return lambda value, where: cls(**entries(value, where, wanted))


def listed(read: Reader) -> Reader:
    """Return a reader of lists, as tuples."""
    def read_all(value: Any, where: str) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise _refused(value, where, 'a list')
        return tuple(read(v, f'{where}[{i}]') for i, v in enumerate(value))
    return read_all


def numbers(*shape: int, nan: bool = False) -> Reader:
    """Return a reader of arrays of finite numbers, or of any with `nan`; a row without a shape."""
    def read(value: Any, where: str) -> Array:
        if not isinstance(value, list):
            raise _refused(value, where, 'a list of numbers')
        wanted = shape or (len(value),)
        if len(value) != wanted[0]:
            raise StorageError(f'`{where}` has {len(value)} entries, but '
                               f'{" by ".join(map(str, wanted))} numbers are wanted')
        own = numbers(*wanted[1:], nan=nan) if len(wanted) > 1 else number if nan else finite
        return np.array(listed(own)(value, where), dtype=float).reshape(wanted)
    return read


def member(of: type[Enum]) -> Reader:
    """Return a reader of the names of an enumeration."""
    def read(value: Any, where: str) -> Enum:
        if not isinstance(value, str) or value not in of.__members__:
            raise StorageError(f'`{where}` is {_shown(value)}; this ctsid knows '
                               f'{", ".join(of.__members__)}: upgrade it')
        return of[value]
    return read


def of_type(kind: type[Any], wanted: str) -> Reader:
    """Return a reader of values of one type, which is what JSON says it is."""
    def read(value: Any, where: str) -> Any:
        if type(value) is not kind:
            raise _refused(value, where, wanted)
        return value
    return read


mapping, word = of_type(dict, 'an object'), of_type(str, 'a word')
answer, whole = of_type(bool, 'true or false'), of_type(int, 'a whole number')


def number(value: Any, where: str) -> float:
    """Read a number that may be NaN or infinite."""
    if value is None:
        return math.nan
    words = {'Infinity': math.inf, '-Infinity': -math.inf}
    return words[value] if isinstance(value, str) and value in words else finite(value, where)


def finite(value: Any, where: str) -> float:
    """Read a finite number."""
    try:
        found = float(value) if type(value) in (int, float) else math.nan
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise _refused(value, where, 'a finite number')
    return found


def anything(value: Any, where: str) -> Any:
    """Read what is not looked at, or not yet; lists as tuples."""
    return tuple(anything(v, where) for v in value) if isinstance(value, list) else value


def _refused(value: Any, where: str, wanted: str) -> StorageError:
    return StorageError(f'`{where}` is {_shown(value)}, but {wanted} is wanted')


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 40 else text[:36] + ' ...'
