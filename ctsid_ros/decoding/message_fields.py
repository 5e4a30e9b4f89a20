# SPDX-License-Identifier: Apache-2.0
"""Field paths against message types: do they exist, which are there, how long are arrays."""

from __future__ import annotations

from collections.abc import Sequence

from ctsid_ros.decoding.angles import EULER_PARTS, QUATERNION
from ctsid_ros.decoding.cdr_layout import CODES, COUNT, DecodeError, Raw, layout_of
from ctsid_ros.decoding.field_path import (
    FieldError,
    FieldPath,
    Name,
    Range,
    Step,
    nearest,
    path_text,
)
from ctsid_ros.decoding.message_types import HEADER, TIMES, FieldType, MessageType
from ctsid_ros.decoding.names import Names, names_of


def bind(message_type: MessageType, field: FieldPath, raw: Raw) -> FieldPath:
    """
    Close the open ranges of a field by the lengths of the arrays in one message.

    Raises
    ------
    FieldError
        If the field does not fit the type.
    DecodeError
        If the message cannot be decoded, or the array is empty in it.
    """
    check_field(message_type, field)
    try:
        return field.bind(lambda steps: array_length(message_type, steps, raw))
    except FieldError as error:  # empty here, but the next message may be longer
        raise DecodeError(str(error)) from None


def array_length(message_type: MessageType, steps: Sequence[Step], raw: Raw | None) -> int:
    """
    Return the length of the array at `steps`: of the type, or else in this message (0 if None).

    Raises
    ------
    DecodeError
        If the message cannot be decoded, or lacks a name.
    """
    field = _descend(message_type, FieldPath(tuple(steps)))
    if field.kind != 'sequence' or raw is None:
        return field.length
    found = Names(message_type, raw, {}).resolve(
        (*(step for step in steps if not isinstance(step, Range)), COUNT))
    if found is None:
        raise DecodeError(f'this message has no {path_text(steps)}')
    layout = layout_of(message_type, found[:1], raw, {})
    return int(layout.scalars(layout.unpack(raw))[0])


def check_field(message_type: MessageType, field: FieldPath) -> None:
    """
    Check a field against a type.

    Raises
    ------
    FieldError
        If it does not exist or is not a number; the message says what there is instead.
    """
    found = _descend(message_type, field)
    end = path_text(field.steps)
    if found.kind != 'single':
        most = f'{end}[0:{found.length}]' if found.kind == 'array' else f'{end}[:]'
        raise FieldError(f'`{field}` is an array, {found}; choose elements: {end}[0] or {most}')
    members = message_type.types.get(found.base)
    if field.euler:
        parts = [(members or {}).get(part, found).base for part in QUATERNION]
        if not set(parts) <= {'float32', 'float64'}:
            raise FieldError(f'`{field}` needs a quaternion with fields x, y, z, w; {end} is '
                             f'{found}')
    elif members is not None:
        leaves = [str(leaf) for leaf in scalar_fields(message_type, None, below=field.steps)]
        listed = ', '.join(leaves[:12]) + (', ...' if len(leaves) > 12 else '')
        raise FieldError(f'`{field}` is not a number but {found}; '
                         + (f'choose from: {listed}' if leaves else 'no number lies below it'))
    elif found.base not in CODES:
        raise FieldError(f'`{field}` is not a number but {found}')


def scalar_fields(message_type: MessageType, sample: Raw | None, *, most: int = 64,
                  below: Sequence[Step] = ()) -> list[FieldPath]:
    """
    List the scalars of a message that could be signals.

    Numbers, elements of arrays, and the angles of quaternions; neither headers nor times.

    Parameters
    ----------
    message_type : MessageType
    sample : bytes-like, optional
        A message, for the lengths of sequences; without it they count as empty.
    most : int
        Longer arrays of numbers are left out, longer arrays of messages are cut; less inside
        arrays of messages.
    below : sequence of steps
        List only what lies below.

    Raises
    ------
    DecodeError
        If the sample cannot be decoded.
    """
    steps = tuple(below)
    field = _descend(message_type, FieldPath(steps)) if steps else FieldType(message_type.name)
    if field.kind != 'single':
        count = array_length(message_type, steps, sample)
        if count > most and field.base in CODES:
            return []
        inner = [(*steps, i) for i in range(min(count, most))]
        most = most if field.base in CODES else most // max(len(inner), 1)  # keep the list short
    elif field.base in CODES:
        return [FieldPath(steps)]
    elif field.base in (HEADER, *TIMES):
        return []
    else:
        members = message_type.types.get(field.base, {})
        if tuple(members) == QUATERNION and field.base.endswith('Quaternion'):
            return [FieldPath(steps, (part,)) for part in EULER_PARTS]
        inner = [(*steps, name) for name in members]
    return [leaf for path in inner
            for leaf in scalar_fields(message_type, sample, most=most, below=path)]


def _descend(message_type: MessageType, path: FieldPath) -> FieldType:
    """Return the type of what the steps of a path lead to."""
    found = FieldType(message_type.name)
    for depth, step in enumerate(path.steps):
        here = path_text(path.steps[:depth])
        if isinstance(step, str):
            if found.kind != 'single':
                raise FieldError(f'`{path}`: {here} is an array, {found}; choose an element: '
                                 f'{here}[0].{step}')
            members = message_type.types.get(found.base)
            if members is None:
                raise FieldError(f'`{path}`: {here} is {found} and has no field {step!r}')
            if step not in members:
                what = 'the table has no column' if found.base.startswith('table/') else \
                    f'{found} has no field'
                raise FieldError(f'`{path}`: {what} {step!r}'
                                 + _hint(message_type, step, list(members)))
            found = members[step]
            continue
        if found.kind == 'single':
            raise FieldError(f'`{path}`: {here} is {found}, not an array; leave out '
                             f'{path_text((step,))}')
        if isinstance(step, Name):
            if names_of(message_type, path.steps[:depth]) is None:
                raise FieldError(f'`{path}`: {message_type.name} has no array of names for the '
                                 f'elements of {here}; choose by index: {here}[0]')
            found = FieldType(found.base)
            continue
        last = step if isinstance(step, int) else (step.end or step.first + 1) - 1
        if found.kind == 'array' and last >= found.length:
            raise FieldError(f'`{path}`: {here} has {found.length} elements, the last is '
                             f'{here}[{found.length - 1}]')
        found = FieldType(found.base)
    return found


def _hint(message_type: MessageType, name: str, members: list[str]) -> str:
    """Name what is near: members of this level, and deeper fields that end with the name."""
    deeper = [str(leaf) for leaf in scalar_fields(message_type, None)
              if str(leaf).rpartition('.')[2] == name]
    meant = f'; did you mean {" or ".join(deeper[:3])}?' if deeper else ''
    return nearest(name, members) + meant
