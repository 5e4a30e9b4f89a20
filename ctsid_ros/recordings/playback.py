# SPDX-License-Identifier: Apache-2.0
"""
From a bag to records, by the same `Ingest` as the live node.

An interval of a bag is counted in the time of recording, so that it means the same whatever
clock the stamps are of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np

from ctsid_core.signals.as_measured import as_measured
from ctsid_core.signals.record import Record
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.decoding.block import Block
from ctsid_ros.decoding.field_path import nearest
from ctsid_ros.errors import BagError
from ctsid_ros.ingest.counts import IngestCounts
from ctsid_ros.ingest.ingest import Ingest
from ctsid_ros.recordings.bag import Bag

Advance = Callable[[float, str], None]
Spans = dict[str, tuple[int, int]]  # first and last log time by topic [ns]
_WHOLE = 1e5  # a window that no recording is longer than [s]: the largest the settings allow
_SLIVER = 0.05  # of the bag: a record shorter than this may be an accident


@dataclass(frozen=True)
class Interval:
    """
    A part of a bag.

    Parameters
    ----------
    start : float
        Seconds after its first message.
    duration : float
        Length [s].
    """

    start: float = 0.0
    duration: float = math.inf

    def span_ns(self, bag: Bag) -> tuple[int, int]:
        """
        Return the first and the last log time that belong to it [ns].

        Raises
        ------
        BagError
            If it lies behind the end of the bag.
        """
        length = (bag.end_ns - bag.start_ns) * 1e-9
        if self.start > length or self.duration <= 0:
            raise BagError(f'nothing of the bag lies after {self.start:g} s: the bag is '
                           f'{length:.1f} s long; choose an earlier start')
        first = bag.start_ns + round(self.start * 1e9)
        return first, bag.end_ns if self.start + self.duration >= length \
            else first + round(self.duration * 1e9)


@dataclass(frozen=True)
class Played:
    """
    What became of an interval of a bag on its way to records.

    Parameters
    ----------
    config : Config
        As used: open ranges closed, types filled in.
    counts : IngestCounts
    complaints : tuple of str
        A sentence on each fault of the data.
    """

    config: Config
    counts: IngestCounts
    complaints: tuple[str, ...]

    def samples(self, channel: Channel) -> int:
        """Return how many samples of a channel are used."""
        return self.counts.channels[channel.name].samples.accepted


@dataclass(frozen=True)
class Recorded(Played):
    """
    An interval of a bag as one record.

    Parameters
    ----------
    record : Record
    split : float
        Where in the record the requested splitting time lies [s]; NaN if none was requested.
    """

    record: Record = field(kw_only=True)
    split: float = math.nan

    def samples(self, channel: Channel) -> int:
        """Return how many samples of a channel are in the record."""
        signal = next(s for s in (*self.record.inputs, *self.record.outputs)
                      if channel.scalar_names[0] in s.names)
        return len(signal.time[signal.rows(self.record.start, self.record.end)])


def fit_config(bag: Bag, config: Config) -> Config:
    """
    Return the config with types filled in and open ranges closed.

    Raises
    ------
    BagError
        If the bag has not what the channels want: all that is wrong at once.
    """
    faults: list[str] = []
    channels = [_fit_channel(bag, channel, faults) for channel in config.channels]
    if faults:
        raise BagError('\n'.join(dict.fromkeys(faults)))
    bag.note_unused(channel.topic for channel in channels)
    return config.with_channels(channels)


def _fit_channel(bag: Bag, channel: Channel, faults: list[str]) -> Channel:
    try:
        kind = bag.message_type(channel.topic).name
        if channel.type and _full(channel.type) != _full(kind):
            raise BagError(f'topic {channel.topic} is of type {kind} in the bag, but '
                           f'`{channel.name}.type` says {channel.type}; correct it'
                           + nearest(channel.type, sorted({t.type for t in bag.topics.values()})))
        if not bag.topic(channel.topic).count:
            raise BagError(f'topic {channel.topic} has no message in the bag, so `{channel.name}` '
                           'cannot be known; choose another topic or bag')
        return replace(channel, type=kind, field=str(bag.bind(channel.topic, channel.path)))
    except BagError as error:
        faults.append(f'`{channel.name}`: {error}')
        return channel


def _full(kind: str) -> str:
    package, _, name = kind.partition('/')
    return f'{package}/msg/{name.removeprefix("msg/")}'


def read_record(bag: Bag, config: Config, interval: Interval | None = None, *,
                split: float | None = None, advance: Advance | None = None) -> Recorded:
    """
    Return an interval of a bag as one record.

    Parameters
    ----------
    bag : Bag
    config : Config
    interval : Interval, optional
        The whole bag if not given.
    split : float, optional
        Where to split the record later: seconds after the first message of the bag.
    advance : callable, optional
        Called with the progress.

    Raises
    ------
    BagError
        If topics, fields or types are not in the bag, or the channels give no record.
    """
    interval = interval or Interval()
    config = fit_config(bag, config)
    # The window is never full, so that all is in one record; estimates get the settings as given.
    ingest = Ingest(replace(config, settings=config.settings.replace(
        window_length=_WHOLE, window_stride=_WHOLE)))
    split_ns = math.inf if split is None else bag.start_ns + split * 1e9
    mark = 0
    spans: Spans = {}
    for log_ns in play(bag, ingest, interval, advance, spans, split_ns):
        if not mark and log_ns >= split_ns:
            mark = ingest.newest_ns
    record = ingest.whole()
    complaints = tuple(ingest.report())
    if record is None or (record.duration < _SLIVER * (bag.end_ns - bag.start_ns) * 1e-9
                          and apart(spans)):
        raise BagError(why_nothing(bag, config, ingest, spans, complaints))
    before = (log_ns - bag.start_ns) * 1e-9 - interval.start - record.duration - 0.05
    if ingest.counts().resets and before > 0.1:
        complaints += (
            f'only what comes after the last jump back is used, {record.duration:.1f} s of data; '
            f'for a model of what comes before it: `--start {interval.start:g} --duration '
            f'{math.floor(10 * before) / 10:.1f}`; with `stamp` set to log all is used',)
    inside = record.start + (mark - record.epoch_ns) * 1e-9
    if split is not None and not record.start < inside < record.end:
        raise BagError(f'{split:g} s does not lie within the recorded signals, which last from '
                       f'{_seconds(bag, record)}; choose another time to split at')
    record, notes = as_measured(record.between(
        record.start, record.end, lead=config.longest_delay(record.duration)))
    return Recorded(config, ingest.counts(), (*complaints, *notes), record=record,
                    split=math.nan if split is None else inside)


def _seconds(bag: Bag, record: Record) -> str:
    first = (record.epoch_ns - bag.start_ns) * 1e-9
    return f'{first + record.start:.1f} to {first + record.end:.1f} s'


def play(bag: Bag, ingest: Ingest, interval: Interval, advance: Advance | None = None,
         spans: Spans | None = None, pause_ns: float = math.inf) -> Iterator[int]:
    """
    Push the messages of an interval, block by block; yield the last log time of each [ns].

    What was recorded before it is history of the inputs.

    Parameters
    ----------
    bag : Bag
    ingest : Ingest
    interval : Interval
    advance : callable, optional
        Called with the progress.
    spans : dict, optional
        Filled with first and last log time of each topic [ns].
    pause_ns : float, optional
        The first message with this log time or a later one ends a block [ns].

    Raises
    ------
    BagError
        If topics or fields are not in the bag, or it cannot be read on.
    """
    first_ns, last_ns = interval.span_ns(bag)
    for both in _paused(bag.blocks(ingest.fields), last_ns, pause_ns):
        before, block = both.split(int(np.searchsorted(both.log_ns, first_ns)))
        if len(before):
            ingest.push_block(before)
            ingest.begin()
        if not len(block):
            continue
        ingest.push_block(block)
        now_ns = int(block.log_ns[-1])
        if spans is not None:
            for rows in block.columns:
                if len(rows):
                    first, last = int(rows.log_ns[0]), int(rows.log_ns[-1])
                    spans[rows.topic] = (spans.get(rows.topic, (first, 0))[0], last)
        if advance:
            advance((now_ns - first_ns) / max(last_ns - first_ns, 1), '')
        yield now_ns
    if advance:
        advance(1.0, '')


def _paused(blocks: Iterator[Block], last_ns: int, pause_ns: float) -> Iterator[Block]:
    """Cut blocks at the end of an interval, and behind the first message from `pause_ns` on."""
    for block in blocks:
        high = int(np.searchsorted(block.log_ns, last_ns + 1))
        inside = block if high == len(block) else block.split(high)[0]
        log_ns = inside.log_ns
        if len(log_ns) and pause_ns <= log_ns[-1]:
            early, inside = inside.split(int(np.searchsorted(log_ns, pause_ns)) + 1)
            pause_ns = math.inf
            yield early
        if len(inside):
            yield inside
        if high < len(block):
            return


def apart(spans: Spans) -> bool:
    """Whether topics do not overlap in the time of recording."""
    return bool(spans) and min(last for _, last in spans.values()) <= \
        max(first for first, _ in spans.values())


def why_nothing(bag: Bag, config: Config, ingest: Ingest, spans: Spans,
                 complaints: Sequence[str]) -> str:
    """Say why there is no record: a channel without samples, or channels that do not overlap."""
    counts = ingest.counts().channels
    few = {c.name: counts[c.name].samples.accepted for c in config.channels
           if counts[c.name].samples.accepted < 2}
    if few:
        names = ', '.join(f'`{c.name}` ({c.topic}): {few[c.name] or "none"}'
                          for c in config.channels if c.name in few)
        lines = [f'too few usable samples in this interval of {names}; choose another field, '
                 'topic or interval']
        lines += [f'`{c.name}`: {problem}' for c in config.channels
                  if few.get(c.name) == 0 and (problem := bag.problem(c.topic, [c.path]))]
    else:
        listed = ', '.join(
            f'`{c.name}` ({c.topic}) '
            + ' to '.join(f'{(t - bag.start_ns) * 1e-9:.2f}' for t in spans[c.topic]) + ' s'
            for c in config.channels)
        lines = [f'the channels do not overlap in time: {listed} after the start of the bag; '
                 'check their stamps, or choose another bag']
    return '\n'.join([*lines, *complaints, *bag.notes])      # such as units that are guessed
