# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag: connections of all its files, joined by name and definition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ctsid_ros.decoding.message_types import MessageType
from ctsid_ros.recordings.definitions import DefinitionError, message_type
from ctsid_ros.recordings.recording import Connection, Recording


@dataclass(frozen=True)
class TopicInfo:
    """
    A topic of a bag.

    Parameters
    ----------
    name, type : str
    count : int
        Number of messages.
    has_header : bool
        Whether its messages carry a stamp of their own (std_msgs/Header).
    problem : str
        Why its messages cannot be decoded; empty if they can.
    """

    name: str
    type: str
    count: int
    has_header: bool
    problem: str = ''


@dataclass(frozen=True)
class Topics:
    """
    All topics of a bag.

    Parameters
    ----------
    infos : mapping
        By name.
    types : mapping
        Types of those that can be decoded, by name.
    names : tuple of mappings
        For each recording: names of the topics by connection.
    notes : tuple of str
        What cannot be decoded, and what was left out.
    """

    infos: Mapping[str, TopicInfo]
    types: Mapping[str, MessageType]
    names: tuple[Mapping[int, str], ...]
    notes: tuple[str, ...]


@dataclass
class _Group:
    """Connections of one topic and one definition."""

    type: str
    message_type: MessageType | None
    problem: str = ''
    count: int = 0
    members: list[tuple[int, int]] = field(default_factory=list)  # recording, connection

    def accepts(self, other: _Group) -> bool:
        return (self.type, self.message_type) == (other.type, other.message_type)


def join_topics(recordings: Sequence[Recording]) -> Topics:
    """Join the connections of each topic; those of minority definitions are left out and noted."""
    infos: dict[str, TopicInfo] = {}
    types: dict[str, MessageType] = {}
    names: list[dict[int, str]] = [{} for _ in recordings]
    notes: list[str] = []
    for name, groups in sorted(_groups(recordings).items()):
        most, *others = sorted(groups, key=lambda group: -group.count)
        kind = most.message_type
        infos[name] = TopicInfo(name, most.type, most.count, bool(kind and kind.has_header),
                                most.problem)
        for recording, connection in most.members:
            names[recording][connection] = name
        if kind:
            types[name] = kind
        elif most.count:
            notes.append(f'topic {name} ({most.type}) cannot be decoded: {most.problem}')
        notes += [f'topic {name}: {group.count} messages of another definition of {group.type} '
                  'skipped' for group in others if group.count]
    return Topics(infos, types, tuple(names), tuple(notes))


def _groups(recordings: Sequence[Recording]) -> dict[str, list[_Group]]:
    groups: dict[str, list[_Group]] = {}
    for i, recording in enumerate(recordings):
        for connection in recording.connections:
            group = _group(connection)
            known = groups.setdefault(connection.topic, [])
            same = next((other for other in known if other.accepts(group)), None)
            if same is None:
                known.append(same := group)
            same.count += connection.count
            same.members.append((i, connection.id))
    return groups


def _group(connection: Connection) -> _Group:
    try:
        kind = message_type(connection)
    except DefinitionError as error:
        return _Group(connection.type, None, str(error))
    return _Group(kind.name, kind)
