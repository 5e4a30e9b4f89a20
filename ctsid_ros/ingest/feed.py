# SPDX-License-Identifier: Apache-2.0
"""
From raw messages as they arrive to windows, on the running robot.

The robot's counterpart of `playback`: what comes from subscriptions is put in the order of
arrival, decoded and pushed into the same `Ingest`. The order and the log times in which it is
pushed are those that a recording of it has, so that a replay of the recording gives the same
windows to the last bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import NamedTuple, Protocol

from ctsid_core.errors import SettingsError, StorageError
from ctsid_core.signals.record import Record
from ctsid_ros.config.channels import Config
from ctsid_ros.decoding.cdr import DecodeError, Extractor
from ctsid_ros.decoding.field_path import FieldError
from ctsid_ros.decoding.message_fields import bind, check_field
from ctsid_ros.decoding.message_types import MessageType
from ctsid_ros.decoding.names import missing, mixed
from ctsid_ros.ingest.counts import IngestCounts, complaints
from ctsid_ros.ingest.ingest import Ingest, decoded
from ctsid_ros.ingest.recent import Called, Totals
from ctsid_ros.ingest.sequence_numbers import SequenceNumbers
from ctsid_ros.ingest.sim_clock import STEP_NS, SimClock

_WAITING = 20_000  # messages kept until the lengths of all arrays are known
_TIMES = 4096  # arrivals remembered, for the latency


class Taken(NamedTuple):
    """
    One message as the middleware hands it out.

    Parameters
    ----------
    arrival_ns : int
        When it arrived [ns], by the computer's clock.
    topic : str
    raw : bytes
        Serialised.
    source_ns : int
        When it was published [ns]; 0 if not known.
    sequence : int or None
        Its number among those of its publisher.
    """

    arrival_ns: int
    topic: str
    raw: bytes
    source_ns: int = 0
    sequence: int | None = None


class Recorder(Protocol):
    """What keeps the messages as they are pushed."""

    def write(self, topic: str, log_ns: int, publish_ns: int, sequence: int, raw: bytes) -> None:
        """Keep one message."""


@dataclass
class TopicState:
    """What has come on one topic."""

    numbers: SequenceNumbers
    messages: int = 0
    last_ns: int = 0  # arrival of the last message
    numbered: bool = False  # whether it had a number of its publisher's


class Feed:
    """
    Take messages, hand out windows. Not for several threads.

    Parameters
    ----------
    config : Config
    types : mapping of str to MessageType
        Of each topic.
    publishers : callable
        Returns how many publishers a topic has now; asked to count losses.
    recorder : Recorder, optional
    clock : SimClock, optional
        Given where time is simulated: its time takes the place of that of arrival.

    Raises
    ------
    SettingsError
        If a field does not fit the type of its topic: all faults at once.
    """

    def __init__(self, config: Config, types: Mapping[str, MessageType],
                 publishers: Callable[[str], int], recorder: Recorder | None = None,
                 clock: SimClock | None = None) -> None:
        _check(config, types)
        self._given, self._types, self._publishers = config, types, publishers
        self._recorder, self._clock = recorder, clock
        self._held: list[Taken] = []  # not to be pushed yet
        self._last_ns = 0  # last log time
        self._broken: list[str] = []  # why the recording has ended
        self.reset()

    def reset(self) -> None:
        """Forget all samples and counts."""
        self.config = self._given
        self.topics = {topic: TopicState(SequenceNumbers(partial(self._publishers, topic)))
                       for topic in dict.fromkeys(c.topic for c in self.config.channels)}
        self.largest_batch = 0  # messages taken at once
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_TIMES)  # newest stamp, arrival
        self._waiting: deque[tuple[str, int, int, bytes, int]] = deque(maxlen=_WAITING)
        self._ingest: Ingest | None = None
        self._extract: dict[str, Extractor] = {}
        self._bound: dict[str, str] = {}  # fields whose open ranges are closed
        self._open_ingest()

    def take(self, batch: Iterable[Taken], until_ns: int, now_ns: int = 0) -> list[Record]:
        """
        Take what has come; return the windows that are due.

        Parameters
        ----------
        batch : iterable of Taken
        until_ns : int
            Messages that arrived later wait for the next call: others that arrived before them
            may not have been handed out yet [ns].
        now_ns : int, optional
            The time when the last of the batch was handed out [ns], if that took long.
        """
        self._held += batch
        self._held.sort(key=attrgetter('arrival_ns'))
        ready: list[Taken] = []
        later: list[Taken] = []
        horizon_ns = max(until_ns, now_ns) + STEP_NS
        for taken in self._held:
            # What arrived long after "now" came before the clock was set back.
            early = until_ns < taken.arrival_ns < horizon_ns
            (later if early else ready).append(taken)
        self._held = later
        self.largest_batch = max(self.largest_batch, len(ready))
        records: list[Record] = []
        for taken in ready:
            self._push(taken)
            if self._ingest is not None:
                records += self._ingest.due()
        if ready:
            self._arrivals.append((self.newest_ns, ready[-1].arrival_ns))
        return records

    def latest(self) -> Record | None:
        """Return the last `window.length` of data; None if there is not so much yet."""
        return None if self._ingest is None else self._ingest.latest()

    def arrival_ns(self, stamp_ns: int) -> int | None:
        """Return when the first sample of that stamp or later arrived [ns]; None if unknown."""
        return next((arrival for newest, arrival in self._arrivals if newest >= stamp_ns), None)

    @property
    def newest_ns(self) -> int:
        """The largest stamp of the present stream [ns]; 0 if there is none yet."""
        return 0 if self._ingest is None else self._ingest.newest_ns

    @property
    def filled(self) -> float:
        """How much of the next window there is, 0 to 1."""
        return 0.0 if self._ingest is None else self._ingest.filled

    def mixes(self, topic: str) -> bool:
        """Whether publishers of a topic may have taken turns within the last `window.length`."""
        return not self.topics[topic].numbered or (
            self._ingest is not None and self._ingest.mixes(topic))

    def counts(self) -> IngestCounts | None:
        """Return what became of the samples; None while the lengths of arrays are awaited."""
        return None if self._ingest is None else self._ingest.counts()

    def totals(self) -> Totals:
        """Return all counts, and begin anew to look for the samples farthest out of place."""
        found = self._totals()
        if self._ingest is not None:
            self._ingest.forget_worst()
        for extract in self._extract.values():
            extract.forget()
        return found

    def _totals(self) -> Totals:
        return Totals(
            self.counts(), {topic: state.numbers.lost for topic, state in self.topics.items()},
            {topic: dict(extract.called) for topic, extract in self._extract.items()})

    def report(self, some: Totals | None = None, when: str = '') -> list[str]:
        """
        Return a sentence on each fault, and its cure.

        Parameters
        ----------
        some : Totals, optional
            What it is about; all if not given.
        when : str
            Which samples these are, as ' of the last 10 s'.
        """
        some = some or self._totals()
        lines = [*self._broken, *(
            f'{topic}: {lost} messages{when} were lost on the way; raise `ingest.depth`, '
            'lower the load of this computer, or check the network'
            for topic, lost in some.lost.items() if lost)]
        if some.counts is not None:
            return [*lines, *self._of_names(some.counts, some.called, when),
                    *complaints(some.counts, self.config, when)]
        return lines + [f'`{channel.name}`: waiting for a message on {channel.topic} that shows '
                        f'how long {channel.field} is' for channel in self.config.channels
                        if channel.path.is_open and channel.name not in self._bound]

    def _of_names(self, counts: IngestCounts, called: Called, when: str) -> Iterator[str]:
        """Yield a sentence on each field that by the names in messages is not what is wanted."""
        for channel in self.config.channels:
            own = counts.channels[channel.name]
            fault = mixed(channel.path, called.get(channel.topic, {}))
            if own.absent and not own.total:
                fault = missing(channel.path, self._extract[channel.topic].names, when)
            if fault:
                yield f'`{channel.name}`: topic {channel.topic}: {fault}'

    def _push(self, taken: Taken) -> None:
        state = self.topics[taken.topic]
        state.messages += 1
        state.last_ns = taken.arrival_ns
        number = taken.sequence or 0
        state.numbered = number > 0
        if number:
            state.numbers.take(number)
        log_ns = self._log_time(taken.arrival_ns)
        if self._recorder is not None:
            self._record(taken, log_ns)
        if self._ingest is None:
            self._wait(taken.topic, log_ns, taken.source_ns, taken.raw, number)
        else:
            self._ingest.push(taken.topic, log_ns, taken.source_ns,
                              *decoded(self._extract[taken.topic], taken.raw), number)

    def _record(self, taken: Taken, log_ns: int) -> None:
        assert self._recorder is not None
        try:
            self._recorder.write(taken.topic, log_ns, taken.source_ns, taken.sequence or 0,
                                 taken.raw)
        except StorageError as error:
            self._recorder = None
            self._broken = [f'the recording has ended: {error}']

    def _log_time(self, arrival_ns: int) -> int:
        """
        Return a strictly increasing time of arrival, so that a recording keeps the order.

        While simulated time is not known it is 0, which is no stamp: such samples are counted.
        """
        log_ns = arrival_ns if self._clock is None else self._clock.at(arrival_ns)
        if log_ns == 0:
            return 0
        if self._last_ns - STEP_NS < log_ns <= self._last_ns:
            log_ns = self._last_ns + 1
        self._last_ns = log_ns
        return log_ns

    def _wait(self, topic: str, log_ns: int, publish_ns: int, raw: bytes, number: int) -> None:
        """Keep a message until all arrays have shown how long they are."""
        self._waiting.append((topic, log_ns, publish_ns, raw, number))
        try:
            self._bound |= {c.name: str(bind(self._types[topic], c.path, raw))
                            for c in self.config.channels
                            if c.topic == topic and c.path.is_open and c.name not in self._bound}
        except DecodeError:  # counted once it is pushed; the next one may tell
            return
        self._open_ingest()

    def _open_ingest(self) -> None:
        if any(c.path.is_open and c.name not in self._bound for c in self.config.channels):
            return
        self.config = self.config.with_fields(self._bound)
        self._ingest = Ingest(self.config)
        self._extract = {topic: Extractor(self._types[topic], fields)
                         for topic, fields in self._ingest.fields.items()}
        for topic, log_ns, publish_ns, raw, number in self._waiting:
            self._ingest.push(topic, log_ns, publish_ns, *decoded(self._extract[topic], raw),
                              number)
        self._waiting.clear()


def _check(config: Config, types: Mapping[str, MessageType]) -> None:
    faults = []
    for channel in config.channels:
        try:
            check_field(types[channel.topic], channel.path)
        except FieldError as error:
            faults.append(f'`{channel.name}.field`: topic {channel.topic} '
                          f'({types[channel.topic].name}): {error}')
    if faults:
        raise SettingsError(faults)
