# SPDX-License-Identifier: Apache-2.0
"""A recording of hundreds of channels on one page: a line for each topic that could matter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import re
from typing import TYPE_CHECKING

from ctsid_ros.report.document import Bullets, Section
from ctsid_ros.report.tables import Table, number

if TYPE_CHECKING:
    from ctsid_ros.recordings.survey import Survey, TopicSurvey

PAGE = 60  # lines: what needs more is shown in brief
_MOST_TOPICS = 25
_MOST_NAMES = 6  # of topics, in a sentence
_WIDTH = 60  # of the fields of a topic
_ELEMENT = re.compile(r'(.*)\[(\d+)\](.*)')
_MEMBER = re.compile(r'(.*)\.(\w{1,5})')


def lines(found: Survey) -> int:
    """Return how many lines all topics, stamps and fields of a recording take."""
    return sum(1 + len(t.stamps) + len(t.moving) + any(not f.moves for f in t.fields)
               for t in found.topics)


def overview(found: Survey, title: str, used: Sequence[str], likely: Sequence[str]
             ) -> Iterator[Section]:
    """
    Yield what moves, the likeliest signals first, and in sentences what else there is.

    Parameters
    ----------
    found : Survey
    title : str
    used : sequence of str
        Topics of the pairs that are offered, the best first.
    likely : sequence of str
        Topics that could hold signals, the likeliest first.
    """
    by_name = {t.info.name: t for t in found.topics}
    offered = [name for name in dict.fromkeys(used) if name in by_name]
    others = [name for name in likely if name not in offered]
    shown = [*offered, *sorted(others[:max(_MOST_TOPICS - len(offered), 0)])]
    yield Section(title, (Table(
        ('topic', 'messages', 'rate [Hz]', 'stamp', 'gaps', 'fields that move'),
        tuple(_row(by_name[name]) for name in shown), ('topic', 'stamp', 'fields that move')),)
        if shown else ())
    hidden = [t for t in found.topics if t.info.name not in shown and not t.note]
    rest = (('further topics move', [t for t in hidden if t.info.name in likely]),
            ('topics move, but have few messages',
             [t for t in hidden if t.moving and t.info.name not in likely]),
            ('topics do not move', [t for t in hidden if not t.moving]))
    sentences = [f'{len(topics)} {what}: {_names([t.info.name for t in topics])}'
                 for what, topics in rest if topics]
    for note in dict.fromkeys(t.note for t in found.topics if t.note):
        sentences.append(f'{_names([t.info.name for t in found.topics if t.note == note])}: '
                         f'{note}')
    yield Section('Not shown (--all shows all, with stamps and ranges; --json for programs)',
                  (Bullets(tuple(sentences)),) if sentences else ())


def _row(topic: TopicSurvey) -> tuple[str, ...]:
    stamps = next((s for s in topic.stamps if s.source == topic.stamp), None)
    return (topic.info.name, str(topic.info.count), number(topic.rate, 3), topic.stamp,
            str(stamps.gaps) if stamps else '-', _fields([f.field for f in topic.moving]))


def _names(names: Sequence[str]) -> str:
    more = len(names) - _MOST_NAMES
    return ', '.join(names[:_MOST_NAMES]) + (f' and {more} more' if more > 0 else '')


def _fields(names: Sequence[str]) -> str:
    """Return as many fields as a line holds."""
    parts = grouped(names)
    shown = next(n for n in range(len(parts), 0, -1)
                 if n == 1 or len(', '.join(parts[:n])) <= _WIDTH)
    more = len(parts) - shown
    return ', '.join(parts[:shown]) + (f' and {more} more' if more else '')


def grouped(names: Sequence[str]) -> list[str]:
    """Return names of fields, neighbouring elements and members as one: xyz[0:3], rate.{x,y}."""
    elements: dict[tuple[str, str], list[int]] = {}  # indices, by what is before and behind them
    for name in names:
        match = _ELEMENT.fullmatch(name)
        head, index, tail = match.groups() if match else (name, '-1', '')
        elements.setdefault((head, tail), []).append(int(index))
    members: dict[tuple[str, bool], list[str]] = {}
    for (head, tail), indices in elements.items():
        for text in _runs(sorted(indices)):
            match = _MEMBER.fullmatch(f'{head}{text}{tail}')
            members.setdefault((match[1] if match else f'{head}{text}{tail}', bool(match)),
                               []).append(match[2] if match else '')
    return [stem + (f'.{{{",".join(own)}}}' if len(own) > 1 else f'.{own[0]}') * is_member
            for (stem, is_member), own in members.items()]


def _runs(indices: Sequence[int]) -> Iterator[str]:
    """Yield what chooses the elements with these indices, ascending; -1 stands for none."""
    first = indices[0]
    for i, following in zip(indices, [*indices[1:], None], strict=True):
        if following != i + 1:
            yield '' if i < 0 else f'[{first}:{i + 1}]' if i > first else f'[{i}]'
            first = i if following is None else following
