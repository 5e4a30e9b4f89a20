# SPDX-License-Identifier: Apache-2.0
"""Signals that somebody names: which fields of a bag the words stand for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import re
from typing import NamedTuple

from ctsid_ros.decoding.field_path import nearest
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.guess_candidates import Key
from ctsid_ros.recordings.survey import Survey

_FEWEST = 2  # samples of a signal
_MOST_NAMED = 4  # topics, in an error


class Named(NamedTuple):
    """
    What somebody wants of a bag.

    Parameters
    ----------
    inputs, outputs : tuple of (str, str)
        Topics and fields; empty where it is to be chosen.
    """

    inputs: tuple[Key, ...] = ()
    outputs: tuple[Key, ...] = ()


NOBODY = Named()


def named(survey: Survey, inputs: Sequence[str], outputs: Sequence[str]) -> Named:
    """
    Return the fields that some words stand for; of several, those that move.

    Parameters
    ----------
    survey : Survey
    inputs, outputs : sequence of str
        Each a field (`angular_velocity.x`), a topic (all of its fields that move), or both with a
        space or slash between them, as `ctsid info` shows them: `*` and `?` stand for any
        characters, `[0:3]` for several elements, `{x,y}` for one word or the other.

    Raises
    ------
    BagError
        If nothing is called so, several topics are and no `*` says that all are meant, or
        something is named twice.
    """
    found = Named(*(tuple(dict.fromkeys(key for text in words for key in _matches(survey, text)))
                    for words in (inputs, outputs)))
    twice = [key for key in found.inputs if key in found.outputs]
    if twice:
        raise BagError(f'{" ".join(twice[0])} cannot be an input and an output; name it once')
    return found


def _matches(survey: Survey, text: str) -> list[Key]:
    found = [key for plain in _plain(text) for key in _called(survey, plain)]
    found = [key for key in found if key[1] == text] or found       # a table may be called as well
    topics = list(dict.fromkeys(topic for topic, _ in found))
    if len(topics) > 1 and not re.search(r'[*?]', text):
        more = ', ...' if len(topics) > _MOST_NAMED else ''
        raise BagError(f'{text!r} is in several topics ({", ".join(topics[:_MOST_NAMED])}{more}); '
                       f"name the topic as well: '{topics[0]} {text}'")
    return found


def _called(survey: Survey, text: str) -> list[Key]:
    """Return what is called so and moves."""
    pattern = re.compile(re.escape(text).replace(r'\*', '.*').replace(r'\?', '.'))
    alike = [(topic, field) for topic in survey.topics for field in topic.fields
             if any(map(pattern.fullmatch, (topic.info.name, *(
                 form for name in (field.field, field.index or field.field)
                 for form in (name, f'{topic.info.name} {name}', f'{topic.info.name}/{name}')))))]
    if not alike:
        raise BagError(f'nothing that could be a signal is called {text!r}{_hint(survey, text)}; '
                       '`ctsid info --all` shows all')
    found = [(topic.info.name, field.field) for topic, field in alike
             if field.moves and topic.info.count >= _FEWEST]
    if not found:
        raise BagError(f'nothing that is called {text!r} moves: no model can be identified from '
                       'it; `ctsid info` shows what moves')
    return found


def _hint(survey: Survey, text: str) -> str:
    if text.endswith(('.yaml', '.yml')):
        return ' (the file to write is -o FILE)'
    keys = [(t.info.name, f.field) for t in survey.topics for f in t.moving]
    topics = list(dict.fromkeys(topic for topic, _ in keys))
    if any(text.startswith((f'{topic} ', f'{topic}/')) for topic in topics) or ' ' in text:
        return nearest(text, [' '.join(key) for key in keys])
    fields = dict.fromkeys(field for _, field in keys)
    if len(topics) == 1:        # as of a table
        return nearest(text, [*fields])
    return nearest(text, [*topics, *fields]) or nearest(text, topics)


def _plain(text: str) -> Iterator[str]:
    """Yield the words that a text with ranges and braces stands for, in order."""
    match = re.search(r'\[(\d+):(\d+)\]|\{([^{}]*)\}', text)
    if not match:
        yield text
        return
    first, end, words = match.groups()
    inner = words.split(',') if words is not None else [
        f'[{i}]' for i in range(int(first), min(int(end), int(first) + 1000))]
    for one in inner:
        yield from _plain(text[:match.start()] + one.strip() + text[match.end():])
