# SPDX-License-Identifier: Apache-2.0
"""
Which of several bags are the parts of one recording, and which are recordings of their own.

Time tells. A recorder that splits its bag begins the next part with the next message, and two
recorders of different topics run at the same time. Bags that overlap, or follow each other within
a second, are one recording; between recordings somebody has stopped and started the recorder.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag

_NEAR = 10**9  # from the end of a part to the start of the next, or of their overlap, at most [ns]


@dataclass(frozen=True)
class _Span:
    path: str
    start_ns: int
    end_ns: int
    topics: frozenset[str]


def recordings(paths: Sequence[str], topics: Collection[str] = ()) -> list[tuple[str, ...]]:
    """
    Group bags by recording, in the order of time.

    Parameters
    ----------
    paths : sequence of str
    topics : collection of str
        That matter; all if empty.

    Returns
    -------
    list of tuple of str
        The parts of each recording, in the order in which they were given.

    Raises
    ------
    BagError
        If one is no bag, or two hold the same topics at the same time.
    """
    if len(paths) < 2:
        return [tuple(paths)]
    spans = [_span(path) for path in paths]
    groups: list[list[_Span]] = []
    for span in sorted(spans, key=lambda s: s.start_ns):
        if groups and (not span.end_ns or span.start_ns <= max(
                s.end_ns for s in groups[-1]) + _NEAR):
            for other in groups[-1]:
                _check_apart(other, span, topics)
            groups[-1].append(span)
        elif groups and not groups[-1][-1].end_ns:  # an empty bag has no time
            groups[-1].append(span)
        else:
            groups.append([span])
    return [tuple(s.path for s in sorted(group, key=spans.index)) for group in groups]


def _span(path: str) -> _Span:
    with open_bag(path) as bag:
        filled = frozenset(name for name, topic in bag.topics.items() if topic.count)
        return _Span(path, bag.start_ns, bag.end_ns, filled)


def _check_apart(one: _Span, other: _Span, topics: Collection[str]) -> None:
    shared = one.topics & other.topics & (frozenset(topics) or one.topics)
    if shared and min(one.end_ns, other.end_ns) - max(one.start_ns, other.start_ns) > _NEAR:
        raise BagError(f'{one.path} and {other.path} hold the same topics ('
                       f'{", ".join(sorted(shared)[:4])}) at the same time: the same recording '
                       'twice, or two robots; give one of them')
