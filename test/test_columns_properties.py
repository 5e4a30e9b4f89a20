# SPDX-License-Identifier: Apache-2.0
"""Columns of any message type equal what rosbags deserialises: CDR of both byte orders, ROS 1."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ctsid_ros.decoding.block import Located
from ctsid_ros.decoding.cdr import Extractor
from ctsid_ros.decoding.field_path import FieldError
from ctsid_ros.decoding.message_fields import scalar_fields
from ctsid_ros.recordings.definitions import message_type
from ctsid_ros.recordings.recording import Connection

hypothesis = pytest.importorskip('hypothesis')
st = hypothesis.strategies

IDL = {'bool': 'boolean', 'byte': 'octet', 'char': 'uint8', 'float32': 'float',
       'float64': 'double'}
NUMBERS = {
    'bool': st.booleans(), 'byte': st.integers(0, 127), 'char': st.integers(0, 255),
    **{f'{sign}int{bits}': st.integers(int(np.iinfo(f'{sign}int{bits}').min),
                                       int(np.iinfo(f'{sign}int{bits}').max))
       for sign in ('', 'u') for bits in (8, 16, 32, 64)},
    'float32': st.floats(width=32), 'float64': st.floats()}
TEXTS = st.text('abcdefgh', max_size=9)
# A type: fields by name; a field is a base (a primitive, or a type) and how many of it there are:
# '' one, '[2]' a fixed number, '[]' as many as the message says.
LEAVES = st.sampled_from([*NUMBERS, 'string'])
COUNTS = st.sampled_from(['', '', '[2]', '[]'])


def structures(inner):
    return st.lists(st.tuples(inner, COUNTS), min_size=1, max_size=4).map(
        lambda fields: {f'f{i}': field for i, field in enumerate(fields)})


TYPES = structures(st.recursive(LEAVES, structures, max_leaves=8))


def named(fields: Mapping, types: dict, prefix: str = 'T') -> str:
    """Give names to a type and to those inside of it, as 'p/msg/T'."""
    name = f'p/msg/{prefix}'
    types[name] = {}
    for i, (field, (base, count)) in enumerate(fields.items()):
        base = base if isinstance(base, str) else named(base, types, f'{prefix}{i}')
        types[name][field] = (base, count)
    return name


def definition(types: Mapping, idl: bool) -> str:
    """Write all types, the outermost first."""
    texts = []
    for name, fields in types.items():
        short = name.rpartition('/')[2]
        if not idl:
            lines = [f'{base.replace("/msg/", "/")}{count} {field}'
                     for field, (base, count) in fields.items()]
            head = [] if not texts else ['=' * 80, f'MSG: p/{short}']
            texts.append('\n'.join([*head, *lines]))
            continue
        members, typedefs = [], []
        for field, (base, count) in fields.items():
            kind = IDL.get(base, base).replace('/', '::')
            if count == '[2]':
                typedefs.append(f'typedef {kind} {short}_{field}[2];')
                kind = f'{short}_{field}'
            members.append(f'sequence<{kind}> {field};' if count == '[]' else f'{kind} {field};')
        texts.append('\n'.join(['=' * 80, f'IDL: {name}', 'module p { module msg {', *typedefs,
                                f'struct {short} {{', *members, '}; }; };']))
    return '\n'.join(texts) + '\n'


def values(types: Mapping, name: str, store, draw):
    """Draw a message."""
    content = {}
    for field, (base, count) in types[name].items():
        def one(base=base):
            return draw(NUMBERS[base]) if base in NUMBERS else draw(TEXTS) \
                if base == 'string' else values(types, base, store, draw)
        number = {'': 1, '[2]': 2}.get(count)
        number = draw(st.integers(0, 3)) if number is None else number
        found = [one() for _ in range(number)]
        if count and base in NUMBERS:
            kind = {'byte': 'uint8', 'char': 'uint8'}.get(base, base)
            content[field] = np.array(found, dtype=kind)
        else:
            content[field] = found if count else found[0]
    return store.types[name](**content)


@st.composite
def recordings(draw):
    """Return a type as we read it, its store of rosbags, raw messages, and how to read them."""
    types: dict = {}
    name = named(draw(TYPES), types)
    form = draw(st.sampled_from(['ros2msg', 'ros2idl', 'ros1msg']))
    store = get_typestore(Stores.EMPTY)
    text = definition(types, idl=False)
    store.register(get_types_from_msg(text, name))
    kind = message_type(Connection(0, '/t', name, 'ros1' if form == 'ros1msg' else 'cdr', form,
                                   definition(types, form == 'ros2idl'), 1))
    messages = [values(types, name, store, draw) for _ in range(draw(st.integers(1, 4)))]
    if form == 'ros1msg':
        return kind, [bytes(store.serialize_ros1(message, name)) for message in messages], \
            lambda raw: store.deserialize_ros1(raw, name)
    little = draw(st.booleans())
    return kind, [bytes(store.serialize_cdr(message, name, little_endian=little))
                  for message in messages], lambda raw: store.deserialize_cdr(raw, name)


def check(recording) -> None:
    kind, raws, deserialised = recording
    messages = [deserialised(raw) for raw in raws]
    offsets = np.cumsum([0, *map(len, raws)])
    part = Located(0, b''.join(raws), offsets[:-1], np.diff(offsets), offsets[:-1], offsets[:-1])
    fields = dict.fromkeys(path for raw in raws for path in scalar_fields(kind, raw))
    for path in fields:
        found = Extractor(kind, [path]).columns([part])
        assert found.header_ns is None
        for message, sound, row in zip(messages, found.sound, found.values, strict=True):
            try:
                expected = path.get(message)
            except FieldError:  # an array that is shorter in this message
                assert not sound
            else:
                assert sound
                np.testing.assert_array_equal(row, np.array(expected, dtype=float))


def examples(count: int):
    """The same ones each time; the machine may be slow."""
    return hypothesis.settings(max_examples=count, deadline=None, derandomize=True,
                               suppress_health_check=list(hypothesis.HealthCheck))


@pytest.mark.slow
@examples(15)
@hypothesis.given(recordings())
def test_columns_equal_what_rosbags_deserialises(recording):
    check(recording)


@pytest.mark.slow
@examples(300)
@hypothesis.given(recordings())
def test_columns_equal_what_rosbags_deserialises_in_many_cases(recording):
    check(recording)
