# SPDX-License-Identifier: Apache-2.0
"""
What is in a bag: rates, stamps as they are, and the scalars that move.

The work is bounded whatever the size of the bag: stamps of the first `MOST` messages, and the
scalars of about `DECODED` messages per topic, in runs of `RUN` that are spread over its length.
Pictures, clouds and the like are counted, not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
import re

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.decoding.block import Columns, Decoded, Located, Stamps
from ctsid_ros.decoding.cdr import Extractor, chosen
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import Bag, TopicInfo
from ctsid_ros.recordings.survey_stats import FieldStats, StampStats, field_stats, stamp_stats

MOST = 2_000_000
DECODED = 2048
RUN = 32
_BULKY = re.compile(
    r'.*(Image|PointCloud2?|LaserScan|LaserEcho|OccupancyGrid\w*|CameraInfo|Theora\w*|Marker|'
    r'MarkerArray|InteractiveMarker\w*|TFMessage|Costmap|Octomap\w*|Mesh\w*|CompressedVideo|Log|'
    r'ParameterEvent|ParameterDescriptions|Config|RobotDescription|Clock)$')
# Numbers that are no signals: bookkeeping, and what says how sure the others are.
_NOT_A_SIGNAL = re.compile(
    r'covariance|(^|[._])(layout|seq|sequence|stamp|time_?stamp\w*|time|id|index|counter?|'
    r'checksum|crc|height|width|step|data_offset)($|[._\[])')


@dataclass(frozen=True)
class TopicSurvey:
    """
    A topic.

    Parameters
    ----------
    info : TopicInfo
    first, last : float
        Log time of its first and last message that was looked at, after the start of the bag [s].
    rate : float
        Messages per second between them [Hz].
    stamps : tuple of StampStats
    late : float
        Median of log time minus header stamp [s]; NaN without header stamps.
    fields : tuple of FieldStats
    undecodable : int
        Messages that could not be decoded, or lack fields that the first one has.
    note : str
        Why nothing more is said, if so.
    """

    info: TopicInfo
    first: float = math.nan
    last: float = math.nan
    rate: float = math.nan
    stamps: tuple[StampStats, ...] = ()
    late: float = math.nan
    fields: tuple[FieldStats, ...] = ()
    undecodable: int = 0
    note: str = ''

    @property
    def moving(self) -> tuple[FieldStats, ...]:
        """The fields that could be signals: they move and are no counters."""
        return tuple(f for f in self.fields if f.moves and not f.monotone)

    @property
    def stamp(self) -> str:
        """The source that `stamp: auto` takes."""
        return next((s.source for s in self.stamps if s.usable), 'log')


@dataclass(frozen=True)
class Survey:
    """
    A bag.

    Parameters
    ----------
    duration : float
        Between the first and the last log time [s].
    start_ns : int
        First log time [ns].
    messages : int
        All messages of all topics.
    covered : float
        Up to where messages were looked at, after the start [s].
    topics : tuple of TopicSurvey
        By name.
    notes : tuple of str
    """

    duration: float
    start_ns: int
    messages: int
    covered: float
    topics: tuple[TopicSurvey, ...]
    notes: tuple[str, ...]


@dataclass
class _Watch:
    """What is gathered of one topic."""

    info: TopicInfo
    stamp_of: Extractor
    scalars_of: Extractor
    every: int  # one run of messages of so many is decoded
    seen: int = 0  # by the decoder: up to a batch ahead of what is gathered
    decoded: int = 0
    undecodable: int = 0
    log: list[Stamps] = field(default_factory=list)
    publish: list[Stamps] = field(default_factory=list)
    header: list[Stamps] = field(default_factory=list)
    chosen: list[Array] = field(default_factory=list)  # scalars, in the order of the decoder
    places: list[NDArray[np.intp]] = field(default_factory=list)  # theirs, in the order of time

    def decode(self, parts: Sequence[Located]) -> Decoded:
        """Read the stamps of all messages and the scalars of some; values are their places."""
        found = self.stamp_of.columns(parts)
        count = len(found.sound)
        some = (np.arange(self.seen, self.seen + count) // RUN) % self.every == 0
        self.seen += count
        places, sound = np.full(count, -1), found.sound.copy()
        _, values, whole = self.scalars_of.columns(chosen(parts, np.flatnonzero(some)))
        sound[some] &= whole
        places[some & sound] = np.arange(self.decoded, self.decoded + (some & sound).sum())
        self.chosen.append(values[sound[some]])
        self.decoded += len(self.chosen[-1])
        return Decoded(found.header_ns, places, sound)

    def take(self, rows: Columns) -> None:
        """Gather messages in the order of time."""
        self.log.append(rows.log_ns)
        self.publish.append(rows.publish_ns)
        if rows.header_ns is not None:
            self.header.append(rows.header_ns[rows.sound])
        self.places.append(rows.values[rows.values >= 0])
        self.undecodable += int(np.count_nonzero(~rows.sound))


def survey(bag: Bag, most: int = MOST) -> Survey:
    """
    Look at a bag.

    Parameters
    ----------
    bag : Bag
    most : int
        Number of messages to look at.

    Raises
    ------
    BagError
        If the bag cannot be read on.
    """
    notes: list[str] = []
    watches, skipped = _watches(bag)
    last_ns = bag.end_ns
    left = most
    blocks = bag.decoded({name: watch.decode for name, watch in watches.items()}) \
        if watches else iter(())
    for block in blocks:
        inside, rest = block.split(left)
        for rows in inside.columns:
            watches[rows.topic].take(rows)
        left -= len(inside)
        if len(rest):
            last_ns = int(rest.log_ns[0])
            notes.append(f'only the first {most} messages were looked at')
            break
    found = [*(_finish(watch, bag.start_ns) for watch in watches.values()), *skipped]
    return Survey((bag.end_ns - bag.start_ns) * 1e-9, bag.start_ns,
                  sum(info.count for info in bag.topics.values()),
                  (last_ns - bag.start_ns) * 1e-9,
                  tuple(sorted(found, key=lambda t: t.info.name)), (*bag.notes, *notes))


def _watches(bag: Bag) -> tuple[dict[str, _Watch], list[TopicSurvey]]:
    """Return what to look at, and the topics that are not worth it."""
    watches: dict[str, _Watch] = {}
    skipped: list[TopicSurvey] = []
    for name, info in bag.topics.items():
        note = ''
        if not info.count:
            note = 'no message'
        elif info.problem:
            note = f'cannot be decoded: {info.problem}'
        elif _BULKY.match(info.type):
            note = 'no signals: not looked at'
        if note:
            skipped.append(TopicSurvey(info, note=note))
            continue
        try:
            paths = [p for p in bag.scalar_fields(name) if not _NOT_A_SIGNAL.search(str(p))]
            stamp_of, scalars_of = bag.extractor(name, []), bag.extractor(name, paths)
        except BagError as error:
            skipped.append(TopicSurvey(info, note=str(error)))
            continue
        watches[name] = _Watch(info, stamp_of, scalars_of, max(-(-info.count // DECODED), 1))
    return watches, skipped


def _finish(watch: _Watch, start_ns: int) -> TopicSurvey:
    if not sum(map(len, watch.log)):
        return TopicSurvey(watch.info, note='no message among those looked at')
    log, publish = np.concatenate(watch.log), np.concatenate(watch.publish)
    first, last = (log[[0, -1]] - start_ns) * 1e-9
    stamps = []
    late = math.nan
    if watch.info.has_header:
        header = np.concatenate(watch.header)
        stamps = [stamp_stats('header', header)]
        if stamps[0].usable and len(header) == len(log):
            late = float(np.median(log - header)) * 1e-9
    stamps.append(stamp_stats('log', log))
    if (publish != log).any():
        stamps.append(stamp_stats('publish', publish))
    rows = np.concatenate(watch.chosen)[np.concatenate(watch.places)]
    fields = tuple(field_stats(path, rows[:, i], RUN)
                   for i, path in enumerate(watch.scalars_of.fields) if len(rows))
    rate = (len(log) - 1) / (last - first) if last > first else math.nan
    return TopicSurvey(watch.info, float(first), float(last), float(rate), tuple(stamps), late,
                       fields, watch.undecodable)
