# SPDX-License-Identifier: Apache-2.0
"""
From messages to windows: the one way in, for the live node and for bags.

A message arrives as its times and the scalars of its topic's channels; what decodes it is of no
concern here. "log" is the time of recording in a bag and that of receipt in the node.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError
from ctsid_core.signals.record import Record, Signal
from ctsid_core.signals.samples import Group, Rows
from ctsid_core.signals.windows import SlidingWindow
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.decoding.block import Block, Columns
from ctsid_ros.decoding.cdr import ABSENT, DecodeError, Extracted, Extractor
from ctsid_ros.decoding.cdr_layout import Raw
from ctsid_ros.decoding.field_path import FieldPath, nearest
from ctsid_ros.ingest.counts import SET, ChannelCounts, IngestCounts, complaints
from ctsid_ros.ingest.header_clock import AHEAD, DRIFT, ON_THE_WAY, REAL_TIME, HeaderClock
from ctsid_ros.ingest.mixing import Mixing
from ctsid_ros.ingest.sequence_numbers import SequenceNumbers

_ZEROS = 3  # messages with a zero header stamp after which a topic is known to have none
STILL = 10  # so many for one stamp: a clock of seconds, or none; a few alike are a driver's
# Of the samples of a signal. Responses of motors, 20 to 5 samples in a time constant, were within
# 3 % of the truth with up to a third missing so, 12 % with half, 250 % with four fifths.
_REPEATED = 0.2
_SOURCES = {'log': 0, 'publish': 1, 'header': 2}  # position among the times of a message
_Times = tuple[int, int, int | None]  # log, publish, header [ns]
_Message = tuple[_Times, Sequence[float], int]  # and the number of the publisher, 0: not known
_Turns = list[tuple[int, float]]  # column, and a full turn of its angle
_Kind = tuple[str, str, str, str]  # of a signal: role, topic, stamp, hold


class _Topic:
    """How the messages of one topic become samples of groups."""

    def __init__(self, channels: Sequence[Channel], groups: Mapping[str, Sequence[Channel]],
                 ) -> None:
        self.fields = tuple(channel.path for channel in channels)
        self.parts: dict[str, slice] = {}
        self.width = 0
        for channel in channels:
            self.parts[channel.name] = slice(self.width, self.width + channel.width)
            self.width += channel.width
        self.stamps = {channel.name: channel.stamp for channel in channels}
        self.groups = [(name, slice(self.parts[members[0].name].start,
                                    self.parts[members[-1].name].stop), members[0].stamp)
                       for name, members in groups.items()]
        self.undivided = len(self.groups) == 1
        self.by_name = any(path.elements for path in self.fields)
        self.absent = dict.fromkeys(groups, 0)
        self.non_finite = dict.fromkeys(self.parts, 0)
        # How many publishers there are now a recording does not tell.
        self.numbers = SequenceNumbers(lambda: 1)
        self.clock = HeaderClock()
        self.source = self.why = ''  # of the channels whose stamp is 'auto'
        self.routes: list[tuple[str, slice, int]] = []  # group, its values, its source
        self.held: list[_Message] = []  # messages that wait for the source to be known
        self.settled = False
        self.header_ns = 0  # the first stamp in a header, until another one has come
        if 'auto' not in self.stamps.values():
            self.settle('', '')

    def settle(self, source: str, why: str) -> list[_Message]:
        """Choose the source of the stamps; return the messages that have waited for it."""
        self.source, self.why, self.settled = source, why, True
        self.routes = [(name, part, _SOURCES[source if stamp == 'auto' else stamp])
                       for name, part, stamp in self.groups]
        held, self.held = self.held, []
        return held

    def publishers(self, sequences: NDArray[np.int64] | None) -> NDArray[np.int64] | None:
        """Return the publishers of messages with these numbers; None if they are not known."""
        return None if sequences is None or not sequences.all() else \
            self.numbers.take_all(sequences)

    def source_of(self, channel: str) -> tuple[str, str]:
        """Return the source of the stamps of a channel, and why."""
        stamp = self.stamps[channel]
        return (self.source, self.why) if stamp == 'auto' else (stamp, SET)


class Ingest:
    """
    Take messages, hand out windows; the same for the live node and for bags.

    Not for several threads. What `due` has not handed out is kept, so ask it regularly.

    Parameters
    ----------
    config : Config
        Inputs and outputs keep its order in the records. Neighbours of one role, topic, stamp and
        hold form one signal if they have the same stamps.

    Raises
    ------
    SettingsError
        If the number of scalars of a channel is known only from a message.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        # Elements that are chosen by name come together only if a message has all of them.
        runs = [list(run) for _, run in groupby(
            (*config.inputs, *config.outputs), key=lambda c: (*_kind(c), c.path.elements))]
        groups = {', '.join(channel.name for channel in run): run for run in runs}
        self._group_of = {channel.name: name for name, run in groups.items() for channel in run}
        self._topics = {
            topic: _Topic([c for run in runs for c in run if c.topic == topic],
                          {name: run for name, run in groups.items() if run[0].topic == topic})
            for topic in dict.fromkeys(run[0].topic for run in runs)}
        self._mixing = {name: Mixing() for name in groups}
        settings = config.settings
        self._window = SlidingWindow(
            [_group(name, run) for name, run in groups.items()], settings.window_length,
            settings.window_stride, settings.window_max_delay,
            config.longest_delay(settings.window_length))
        self._push = self._window.push
        self._turns: dict[str, list[_Turns]] = {'input': [], 'output': []}
        for run in runs:
            turns = [turn for channel in run for turn in channel.turns]
            self._turns[run[0].role].append([(i, turn) for i, turn in enumerate(turns) if turn])
        self._kinds = {role: [_kind(run[0]) for run in runs if run[0].role == role]
                       for role in self._turns}

    @property
    def fields(self) -> dict[str, tuple[FieldPath, ...]]:
        """The fields wanted of each topic; `push` wants their scalars in this order."""
        return {name: topic.fields for name, topic in self._topics.items()}

    @property
    def newest_ns(self) -> int:
        """The largest stamp of the present stream [ns]; 0 if there is none yet."""
        return self._window.newest_ns

    @property
    def filled(self) -> float:
        """How much of the next window there is, 0 to 1."""
        return self._window.filled

    def push(self, topic: str, log_ns: int, publish_ns: int, header_ns: int | None,
             values: Sequence[float], sequence: int = 0) -> None:
        """
        Take one message.

        Parameters
        ----------
        topic : str
        log_ns : int
            When it was recorded, or received [ns].
        publish_ns : int
            When it was published [ns]; 0 if that is not known.
        header_ns : int or None
            The stamp in its header [ns]; None if it has no header.
        values : sequence of float
            The scalars of `fields[topic]`, one after another, `ABSENT` where it has no sample;
            empty for a message that could not be decoded: it is counted.
        sequence : int
            Its number among those of its publisher; 0 if that is not known.

        Raises
        ------
        DataError
            If no channel is of this topic, or times and values are not numbers.
        """
        target = self._topics.get(topic)
        if target is None:
            raise DataError(f'no channel is of topic {topic!r}'
                            f'{nearest(topic, list(self._topics))}')
        publisher = target.numbers.take(sequence) if sequence else 0
        if target.settled:
            self._route(target, (log_ns, publish_ns, header_ns), values, publisher)
        else:
            self._choose(target, (log_ns, publish_ns, header_ns), values, publisher)

    def push_block(self, block: Block) -> None:
        """
        Take many messages: the same as `push` of one after another.

        Parameters
        ----------
        block : Block
            Its columns are the `fields` of their topics.
        """
        if pushed := self._settle_by(block):
            _, block = block.split(pushed)
        routes: list[tuple[_Topic, slice]] = []
        parts: list[Rows] = []
        places: list[NDArray[np.intp]] = []
        publishers: list[NDArray[np.int64] | None] = []
        for number, rows in enumerate(block.columns):
            topic = self._topics[rows.topic]
            who = topic.publishers(rows.sequences)
            if rows.header_ns is not None:
                topic.clock.take_rows(rows.log_ns, rows.header_ns)
            for group, part, source in topic.routes if len(rows) else ():
                place = np.flatnonzero(block.which == number)
                own, kept = rows, who
                if rows.absent is not None and (absent := rows.absent[:, part].any(axis=1)).any():
                    topic.absent[group] += int(np.count_nonzero(absent))
                    own, place = rows[np.flatnonzero(~absent)], place[~absent]
                    kept = None if who is None else who[~absent]
                if not len(own):
                    continue
                stamps = (own.log_ns, own.publish_ns, own.header_ns)[source]
                routes.append((topic, part))
                parts.append(Rows(group, np.zeros_like(own.log_ns) if stamps is None else stamps,
                                  own.values[:, part], own.sound))
                places.append(place)
                publishers.append(kept)
        if not parts:
            return
        which = np.repeat(np.arange(len(parts)), [len(at) for at in places])
        order = which[np.argsort(np.concatenate(places), kind='stable')]
        dropped = self._window.push_rows(order, parts)
        for number, who in enumerate(publishers):
            if who is not None:
                rest = [row for at, row in dropped if at == number]
                self._mixing[parts[number].group].take_rows(
                    *(np.delete(column, rest) for column in (who, parts[number].stamps)))
        for number, row in dropped:
            topic, part = routes[number]
            if parts[number].sound[row]:
                self._count_non_finite(topic, part, parts[number].values[row])

    def _settle_by(self, block: Block) -> int:
        """Push messages one by one until all topics in it are settled; return how many."""
        waiting = {number: len(rows) for number, rows in enumerate(block.columns)
                   if len(rows) and not self._topics[rows.topic].settled}
        if not waiting:
            return 0
        messages = [_messages(rows) for rows in block.columns]
        for pushed, number in enumerate(block.which.tolist()):
            if not waiting:
                return pushed
            self.push(*next(messages[number]))
            if number in waiting:
                waiting[number] -= 1
                if not waiting[number] or self._topics[block.columns[number].topic].settled:
                    del waiting[number]
        return len(block)

    def begin(self) -> None:
        """Let the first window begin after what came so far: that is history of the inputs."""
        self._window.begin()
        for topic in self._topics.values():
            topic.held.clear()
            for counts in (topic.absent, topic.non_finite):
                counts.update(dict.fromkeys(counts, 0))

    def due(self) -> Iterator[Record]:
        """Hand out the windows that the stamps have passed, oldest first."""
        return map(self._due, self._window.due())

    def flush(self) -> Iterator[Record]:
        """Hand out all windows that the samples reach the end of: no more will come."""
        self._settle_all()
        return map(self._finished, self._window.flush())

    def whole(self) -> Record | None:
        """
        Return everything from the start of the next window to where every channel is known.

        For one record of a whole stream: with a `window.length` that no stream reaches. None if
        there is no such interval.
        """
        self._settle_all()
        record = self._window.whole()
        return record and self._finished(record)

    def latest(self) -> Record | None:
        """
        Return the last `window.length` of data, whatever the stride; None if there is less yet.

        The windows that are due are not affected.
        """
        record = self._window.latest()
        return record and self._finished(record)

    def counts(self) -> IngestCounts:
        """Return what became of messages and windows so far."""
        counts, channels = self._window.counts, {}
        for channel in self._config.channels:
            topic = self._topics[channel.topic]
            samples = replace(counts.groups[self._group_of[channel.name]],
                              non_finite=topic.non_finite[channel.name])
            channels[channel.name] = ChannelCounts(*topic.source_of(channel.name), samples,
                                                   topic.absent[self._group_of[channel.name]])
        return IngestCounts(channels, counts.windows, counts.empty, counts.resets)

    def mixes(self, topic: str) -> bool:
        """Whether publishers of a topic have taken turns within the last `window.length`."""
        since = self.newest_ns - round(self._config.settings.window_length * 1e9)
        return any(self._mixing[group].since(since) for group, _, _ in self._topics[topic].groups)

    def forget_worst(self) -> None:
        """Let the counts tell of samples far out of place only if they come from now on."""
        self._window.forget_worst()

    def report(self) -> list[str]:
        """Return a sentence on each fault, and its cure."""
        return complaints(self.counts(), self._config)

    def _route(self, topic: _Topic, times: _Times, values: Sequence[float], publisher: int
               ) -> None:
        if len(values) != topic.width:
            values = ()  # nobody knows which of them are whose: a wrong width for all
        for group, part, source in topic.routes:
            # A header stamp that is missing counts as zero: the window drops and counts it.
            own = values if topic.undivided else values[part]
            if topic.by_name and any(value is ABSENT for value in own):
                topic.absent[group] += 1
                continue
            if not self._push(group, times[source] or 0, own):
                self._count_non_finite(topic, part, values[part])
            elif publisher:
                self._mixing[group].take(publisher, times[source] or 0)
        topic.clock.take(times[0], times[2] or 0)

    def _count_non_finite(self, topic: _Topic, dropped: slice, values: Sequence[float]) -> None:
        for name, part in topic.parts.items():
            if dropped.start <= part.start < dropped.stop:
                own = slice(part.start - dropped.start, part.stop - dropped.start)
                topic.non_finite[name] += not all(map(isfinite, values[own]))

    def _choose(self, topic: _Topic, times: _Times, values: Sequence[float], publisher: int
                ) -> None:
        """Settle where the stamps of a topic come from, once and for all its messages."""
        topic.held.append((times, values, publisher))
        header_ns = times[2]
        if header_ns is None:
            held = topic.settle('log', 'its messages have no header')
        elif header_ns not in (0, topic.header_ns):
            # The first sample is not to wait for the next, which may come late or never.
            held = topic.settle('header', 'its messages have a header with a stamp')
            topic.settled, topic.header_ns = topic.header_ns != 0, header_ns
        elif len(topic.held) == (STILL if topic.header_ns else _ZEROS):
            held = topic.settle('log', 'the stamps in its headers '
                                + ('stand still' if topic.header_ns else 'are zero'))
        else:
            return
        for message in held:
            self._route(topic, *message)

    def _settle_all(self) -> None:
        for topic in self._topics.values():
            if topic.held:
                for message in topic.settle(*(topic.source, topic.why) if topic.routes else (
                        'log', 'the stamps in its headers are zero')):
                    self._route(topic, *message)

    def _due(self, record: Record) -> Record:
        finished = self._finished(record)
        for mixing in self._mixing.values():
            mixing.forget(record.epoch_ns)  # the next windows begin later
        for topic in self._topics.values():
            topic.clock.forget(record.epoch_ns)
        return finished

    def _finished(self, record: Record) -> Record:
        """Unwrap angles, now that samples are in order, join what came together, tell faults."""
        inputs, outputs = (
            _together(_unwrapped(signals, self._turns[role]), self._kinds[role])
            for role, signals in (('input', record.inputs), ('output', record.outputs)))
        return replace(record, inputs=inputs, outputs=outputs, faults=tuple(self._faults(record)))

    def _faults(self, record: Record) -> Iterator[str]:
        signals = dict(zip(self._mixing, (*record.inputs, *record.outputs), strict=True))
        for name, topic in self._topics.items():
            if own := [group for group, _, _ in topic.groups
                       if self._mixing[group].within(signals[group], record)]:
                yield (f'Samples of several publishers are mixed in {", ".join(own)}, of {name}; '
                       'stop all but one of them, or give them topics of their own.')
            for group, _, source in topic.routes:
                if (share := signals[group].repeated) > _REPEATED:
                    yield (f'{100 * share:.0f} % of the samples of {group} are not used, for they '
                           'have the stamp of another one, but other values; '
                           f'{self._way_out(name, source)}.')
        timed = [c.name for c in self._config.channels
                 if self._topics[c.topic].source_of(c.name)[0] != 'header']
        for name, topic in self._topics.items() if timed else ():
            # Headers that no channel is stamped by tell of a simulation only.
            used = any(c.topic == name and c.name not in timed for c in self._config.channels)
            rate = topic.clock.rate(record, DRIFT if used else REAL_TIME)
            if abs(rate - 1.0) > REAL_TIME:
                yield (f'Headers of {name} run {rate:.4g} times as fast as the clock of '
                       f'{", ".join(timed)}, as in a simulation that is not in real time, so '
                       'time constants are wrong; use topics with headers for all channels, or '
                       'record with `--use-sim-time` (the node: `use_sim_time`).')
            elif rate != 1.0:
                yield (f'Headers of {name} run {rate:.4g} times as fast as the clock of '
                       f'{", ".join(timed)}, so dead times drift; set `stamp: log` for all '
                       'channels.')

        yield from self._ahead(record)

    def _ahead(self, record: Record) -> Iterator[str]:
        """Yield headers that are ahead of when their messages come, beside another clock."""
        source = {c.name: self._topics[c.topic].source_of(c.name)[0]
                  for c in self._config.channels}
        # Of what has no header of its own the clock of the log is that of its stamps.
        clocks = {c.name: self._topics[c.topic].clock.ahead(record)
                  if source[c.name] == 'header' else 0.0
                  for c in self._config.channels if source[c.name] != 'publish'}
        for topic in self._topics:
            seconds = max((clocks[c.name] for c in self._config.channels
                           if c.topic == topic and source[c.name] == 'header'), default=0.0)
            others = [name for name, other in clocks.items() if other <= AHEAD and
                      seconds - other > (AHEAD if source[name] == 'log' else ON_THE_WAY)]
            if seconds > AHEAD and others:
                yield (f'Headers of {topic} are {seconds:.3g} s ahead of when its messages come, '
                       f'and those of {", ".join(others)} are not: their clocks differ, and dead '
                       'times are wrong by as much; set `stamp: log` for all channels, or set '
                       'the clocks by each other.')

    def _way_out(self, topic: str, source: int) -> str:
        if any(c.topic == topic and c.type.startswith('table/') for c in self._config.channels):
            return ('where rows follow each other at a constant rate, say it, `--time 10Hz` for '
                    'ten in a second')
        return 'set `stamp` to log, or correct the clock' if source else 'correct the clock'


def _messages(rows: Columns
              ) -> Iterator[tuple[str, int, int, int | None, tuple[float, ...], int]]:
    """Yield messages as `Ingest.push` takes them."""
    headers = [None] * len(rows) if rows.header_ns is None else rows.header_ns.tolist()
    for i, header_ns in enumerate(headers):
        yield (rows.topic, int(rows.log_ns[i]), int(rows.publish_ns[i]), header_ns,
               _values(rows, i) if rows.sound[i] else (),
               0 if rows.sequences is None else int(rows.sequences[i]))


def _values(rows: Columns, i: int) -> tuple[float, ...]:
    values = rows.values[i].tolist()
    if rows.absent is not None:
        values = [ABSENT if absent else value
                  for value, absent in zip(values, rows.absent[i].tolist(), strict=True)]
    return tuple(values)


def decoded(extract: Extractor, raw: Raw) -> Extracted:
    """
    Return header stamp and scalars of a message as `Ingest.push` wants them.

    One that cannot be decoded has no scalars, so that it is counted; its header stamp is zero,
    not absent, so that it does not settle where the stamps come from.
    """
    try:
        return extract(raw)
    except DecodeError:
        return (0 if extract.message_type.has_header else None), ()


def _group(name: str, channels: Sequence[Channel]) -> Group:
    first = channels[0]
    names = tuple(scalar for channel in channels for scalar in channel.scalar_names)
    units = tuple(channel.unit for channel in channels for _ in range(channel.width))
    return Group(name, len(names), first.role, first.hold, names, units)


def _kind(channel: Channel) -> _Kind:
    return channel.role, channel.topic, channel.stamp, channel.hold


def _together(signals: Sequence[Signal], kinds: Sequence[_Kind]) -> tuple[Signal, ...]:
    """Make one signal of neighbours of one kind whose stamps are equal: that is less work."""
    joined: list[Signal] = []
    for i, signal in enumerate(signals):
        if joined and kinds[i] == kinds[i - 1] and np.array_equal(joined[-1].time, signal.time):
            last = joined[-1]
            joined[-1] = replace(last, values=np.hstack((last.values, signal.values)),
                                 names=last.names + signal.names, units=last.units + signal.units)
        else:
            joined.append(signal)
    return tuple(joined)


def _unwrapped(signals: tuple[Signal, ...], turns: Sequence[_Turns]) -> tuple[Signal, ...]:
    joined = []
    for signal, angles in zip(signals, turns, strict=True):
        if angles:
            values = signal.values.copy()
            for column, turn in angles:
                values[:, column] = np.unwrap(values[:, column], period=turn)
            signal = replace(signal, values=values)
        joined.append(signal)
    return tuple(joined)
