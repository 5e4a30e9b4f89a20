# SPDX-License-Identifier: Apache-2.0
"""
What is in a bag: rates, stamps as they are, and the scalars that move.

The work is bounded whatever the size of the bag: stamps of the first `MOST` messages, and the
scalars of about `DECODED` messages per topic, in runs of `RUN` that are spread over its length.
Pictures, clouds and the like are counted, not read.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
import math
import re

import numpy as np

from ctsid_ros.decoding.field_path import FieldPath
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import Bag, DecodeError, TopicInfo
from ctsid_ros.recordings.survey_stats import FieldStats, StampStats, field_stats, stamp_stats

MOST = 2_000_000
CLOCKS = 0.5  # header and log apart by more than this are two clocks [s]
DECODED = 2048
RUN = 32
_BULKY = re.compile(
    r'.*(Image|PointCloud2?|LaserScan|LaserEcho|OccupancyGrid\w*|CameraInfo|Theora\w*|Marker|'
    r'MarkerArray|InteractiveMarker\w*|TFMessage|Costmap|Octomap\w*|Mesh\w*|CompressedVideo|Log|'
    r'ParameterEvent|ParameterDescriptions|Config|RobotDescription|Clock)$')
# Numbers that are no signals: bookkeeping, and what says how sure the others are.
_NOT_A_SIGNAL = re.compile(
    r'covariance|variance|(^|[._])\w*(std_?dev|accuracy|noise|_cov|time_?stamp)\w*($|[._\[])|'
    r'(^|[._])(layout|seq|sequence|stamp|time_?stamp\w*|time|id|index|counter?|buttons|flags|'
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
    paths: Sequence[FieldPath]
    every: int  # one run of messages of so many is decoded
    seen: int = 0
    undecodable: int = 0
    log: array[int] = field(default_factory=lambda: array('q'))
    publish: array[int] = field(default_factory=lambda: array('q'))
    header: array[int] = field(default_factory=lambda: array('q'))
    values: list[tuple[float, ...]] = field(default_factory=list)


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
    stamp_of = {name: bag.extractor(name, []) for name in watches}
    scalars_of = {name: bag.extractor(name, watch.paths) for name, watch in watches.items()}
    messages = bag.messages(watches) if watches else ()
    for seen, (topic, log_ns, publish_ns, raw) in enumerate(messages):
        if seen == most:
            last_ns = log_ns
            notes.append(f'only the first {most} messages were looked at')
            break
        watch = watches[topic]
        watch.log.append(log_ns)
        watch.publish.append(publish_ns)
        decode = (watch.seen // RUN) % watch.every == 0
        watch.seen += 1
        try:
            watch.header.append(stamp_of[topic](raw)[0] or 0)
            if decode:
                watch.values.append(scalars_of[topic](raw)[1])
        except DecodeError:
            watch.undecodable += 1
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
        except BagError as error:
            skipped.append(TopicSurvey(info, note=str(error)))
            continue
        watches[name] = _Watch(info, paths, max(-(-info.count // DECODED), 1))
    return watches, skipped


def _finish(watch: _Watch, start_ns: int) -> TopicSurvey:
    log = np.array(watch.log, dtype=np.int64)
    if not len(log):
        return TopicSurvey(watch.info, note='no message among those looked at')
    header = np.array(watch.header, dtype=np.int64)
    first, last = (log[[0, -1]] - start_ns) * 1e-9
    stamps = [stamp_stats('header', header)] if watch.info.has_header else []
    stamps.append(stamp_stats('log', log))
    publish = np.array(watch.publish, dtype=np.int64)
    if (publish != log).any():
        stamps.append(stamp_stats('publish', publish))
    late = math.nan
    if watch.info.has_header and stamps[0].usable and len(header) == len(log):
        late = float(np.median(log - header)) * 1e-9
    rows = np.array(watch.values, dtype=float).reshape(
        len(watch.values), len(watch.values[0]) if watch.values else 0)
    fields = tuple(field_stats(path, rows[:, i], RUN) for i, path in enumerate(watch.paths)
                   if i < rows.shape[1])
    rate = (len(log) - 1) / (last - first) if last > first else math.nan
    return TopicSurvey(watch.info, float(first), float(last), float(rate), tuple(stamps), late,
                       fields, watch.undecodable)
