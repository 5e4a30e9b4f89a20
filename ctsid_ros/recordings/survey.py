# SPDX-License-Identifier: Apache-2.0
"""
What is in a bag: rates, stamps as they are, and the scalars that move.

The work is bounded whatever the size of the bag: stamps of the first `MOST` messages, and the
scalars of about `DECODED` messages per topic, in runs of `RUN` that are spread over its length.
Of files of many gigabytes only portions are read. Pictures, clouds and the like are counted, not
read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import math
import re

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.decoding.block import Block, Columns, Stamps
from ctsid_ros.decoding.field_path import FieldPath, plain
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import Bag, TopicInfo
from ctsid_ros.recordings.portions import portions
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
    r'covariance|variance|_var($|[._\[])|'
    r'(^|[._])\w*(std_?dev|accuracy|noise|_cov|time_?stamp)\w*($|[._\[])|'
    r'(^|[._])(layout|seq|sequence|stamp|time_?stamp\w*|time|id|index|counter?|buttons|flags|'
    r'checksum|crc|e[pv][hv]|[hvpt]dop)($|[._\[])')
_PICTURE = re.compile(r'(^|[._])(height|width|step|data_offset)($|[._\[])')  # but in tables


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
    reason : str
        Why, of the first of these.
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
    reason: str = ''
    note: str = ''

    @property
    def moving(self) -> tuple[FieldStats, ...]:
        """The fields that could be signals: they move and are no counters."""
        return tuple(f for f in self.fields if f.moves and not f.monotone)

    @property
    def stamp(self) -> str:
        """The source that `stamp: auto` takes."""
        return next((s.source for s in self.stamps if s.usable), 'log')

    @property
    def unusable(self) -> bool:
        """Whether its messages have headers, but no stamps in them that can be used."""
        return self.info.has_header and bool(self.stamps) and not self.stamps[0].usable


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
    """What is gathered of one topic: columns, block by block."""

    info: TopicInfo
    paths: Mapping[FieldPath, str]  # and how they are called by index
    every: int  # one run of messages of so many is kept
    seen: int = 0
    undecodable: int = 0
    log: list[Stamps] = field(default_factory=list)
    publish: list[Stamps] = field(default_factory=list)
    header: list[Stamps] = field(default_factory=list)
    sound: list[NDArray[np.bool_]] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    absent: list[NDArray[np.bool_]] = field(default_factory=list)
    cuts: list[int] = field(default_factory=list)  # before which messages nothing was read

    def add(self, rows: Columns) -> None:
        """Take some messages."""
        runs = (np.arange(self.seen, self.seen + len(rows)) // RUN) % self.every == 0
        self.seen += len(rows)
        self.undecodable += int(np.count_nonzero(~rows.sound))
        self.log.append(rows.log_ns)
        self.publish.append(rows.publish_ns)
        self.sound.append(rows.sound)
        if rows.header_ns is not None:
            self.header.append(rows.header_ns[rows.sound])
        kept = runs & rows.sound
        self.values.append(rows.values[kept].astype(float))
        self.absent.append(np.zeros_like(self.values[-1], bool) if rows.absent is None
                           else rows.absent[kept])


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
    parts = portions(bag)
    if len(parts) > 1:
        length = parts[0][1] - parts[0][0]
        notes.append(f'the bag is large: only {len(parts)} portions of {length:.0f} s were '
                     'looked at')
    last_ns, left = bag.end_ns, most
    for block in _blocks(bag, watches, parts):
        inside = block.split(left)[0]
        for rows in inside.columns:
            watches[rows.topic].add(rows)
        left -= len(inside)
        if len(inside) < len(block):
            last_ns = int(block.log_ns[len(inside)])
            notes.append(f'only the first {most} messages were looked at')
            break
    found = [*(_finish(watch, bag) for watch in watches.values()), *skipped]
    return Survey((bag.end_ns - bag.start_ns) * 1e-9, bag.start_ns,
                  sum(info.count for info in bag.topics.values()),
                  (last_ns - bag.start_ns) * 1e-9,
                  tuple(sorted(found, key=lambda t: t.info.name)), (*bag.notes, *notes))


def _blocks(bag: Bag, watches: Mapping[str, _Watch], parts: Sequence[tuple[float, float]]
            ) -> Iterator[Block]:
    """Yield the messages of the watched topics in some parts of a bag."""
    for first, last in parts:
        for watch in watches.values():
            watch.cuts.append(watch.seen)
        span = (bag.start_ns + round(first * 1e9), bag.start_ns + round(last * 1e9))
        fields = {name: [*watch.paths] for name, watch in watches.items()}
        for block in bag.blocks(fields, span) if watches else ():
            low, high = np.searchsorted(block.log_ns, (span[0], span[1] + 1)).tolist()
            yield block.split(high)[0].split(low)[1]


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
            paths = {p: index for p, index in bag.named_fields(name, DECODED).items()
                     if not _NOT_A_SIGNAL.search(plain(str(p))) and (
                         info.type.startswith('table/') or not _PICTURE.search(plain(str(p))))}
        except BagError as error:
            skipped.append(TopicSurvey(info, note=str(error)))
            continue
        watches[name] = _Watch(info, paths, max(-(-info.count // DECODED), 1))
    return watches, skipped


def _finish(watch: _Watch, bag: Bag) -> TopicSurvey:
    if not watch.seen:
        return TopicSurvey(watch.info, note='no message among those looked at')
    log, publish = np.concatenate(watch.log), np.concatenate(watch.publish)
    header = np.concatenate(watch.header) if watch.header else np.empty(0, np.int64)
    sound = np.concatenate(watch.sound)
    first, last = (log[[0, -1]] - bag.start_ns) * 1e-9
    begins = np.zeros(len(log), bool)
    begins[[cut for cut in watch.cuts if cut < len(log)]] = True
    stamps = [stamp_stats('header', header, begins[sound])] if watch.info.has_header else []
    stamps.append(stamp_stats('log', log, begins))
    if (publish != log).any():
        stamps.append(stamp_stats('publish', publish, begins))
    late = math.nan
    if watch.info.has_header and stamps[0].usable:
        late = float(np.median((log[sound] - header)[header > 0])) * 1e-9
    rows, absent = np.concatenate(watch.values), np.concatenate(watch.absent)
    fields = tuple(field_stats(path, rows[~absent[:, i], i], RUN,
                               index if path.elements else '')
                   for i, (path, index) in enumerate(watch.paths.items()) if len(rows))
    steps = np.diff(log)[~begins[1:]]
    length = float(steps.sum()) * 1e-9
    rate = len(steps) / length if length > 0 else math.nan
    return TopicSurvey(watch.info, float(first), float(last), float(rate), tuple(stamps), late,
                       fields, watch.undecodable,
                       bag.problem(watch.info.name, [*watch.paths]) if watch.undecodable else '')
