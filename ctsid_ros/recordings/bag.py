# SPDX-License-Identifier: Apache-2.0
"""
Bags: rosbag2 in MCAP or SQLite, ROS 1; one file, a folder, or several that belong together.

Other recordings (ULog, ArduPilot, tables) are read as if they were bags.

    with open_bag('flight') as bag:
        for block in bag.blocks({'/imu': [parse_field('angular_velocity.x')]}):
            (imu,) = block.columns
            imu.header_ns, imu.values[:, 0]

`Bag.messages` gives raw messages one by one, for whatever is no signal.

Whatever is complete is read; what was damaged, recovered or odd is said in `bag.notes`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from itertools import islice
import os
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from ctsid_ros.decoding.block import Block, Decode
from ctsid_ros.decoding.cdr import ABSENT, Extractor
from ctsid_ros.decoding.cdr_layout import DecodeError
from ctsid_ros.decoding.field_path import FieldError, FieldPath, nearest
from ctsid_ros.decoding.message_fields import bind, scalar_fields
from ctsid_ros.decoding.message_types import MessageType
from ctsid_ros.decoding.names import by_name, missing, mixed
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.files import find_files, scan_file
from ctsid_ros.recordings.packed import raw, unpacking
from ctsid_ros.recordings.recording import Recording, Wanted, continued, merge_in_time
from ctsid_ros.recordings.remote import local
from ctsid_ros.recordings.topics import TopicInfo, join_topics

__all__ = ['Bag', 'BagMessage', 'DecodeError', 'TopicInfo', 'open_bag']


class BagMessage(NamedTuple):
    """A serialised message; times in ns. Publish time is log time where it is not recorded."""

    topic: str
    log_ns: int
    publish_ns: int
    raw: bytes


class Bag:
    """
    An open bag; made by `open_bag`, closed by `close` or at the end of a `with` block.

    Attributes
    ----------
    topics : mapping of str to TopicInfo
    start_ns, end_ns : int
        First and last log time of all messages; 0 if there are none.
    own_clock : bool
        Whether these count from a start of their own, as autopilots do.
    tables : bool
        Whether all of its files are tables.
    size : int
        Of its files [bytes].
    """

    def __init__(self, recordings: Sequence[Recording], notes: Iterable[str],
                 resources: ExitStack, size: int = 0) -> None:
        self._recordings = tuple(recordings)
        self._resources, self.size = resources, size
        joined = join_topics(self._recordings)
        self._types, self._names = joined.types, joined.names
        self._notes = dict.fromkeys([*notes, *joined.notes])
        self._met: set[tuple[str, FieldPath]] = set()  # fields by name that messages have
        self.topics: Mapping[str, TopicInfo] = joined.infos
        filled = [recording for recording in self._recordings if recording.count]
        self.start_ns = min((recording.start_ns for recording in filled), default=0)
        self.end_ns = max((recording.end_ns for recording in filled), default=0)
        self.own_clock = bool(filled) and all(recording.own_clock for recording in filled)
        self.tables = bool(filled) and all(recording.alone for recording in filled)
        if not filled:
            self._note('there is no message in the bag')

    @property
    def notes(self) -> tuple[str, ...]:
        """What was damaged, recovered, skipped or odd; may grow while messages are read."""
        return tuple(self._notes)

    def blocks(self, fields: Mapping[str, Sequence[FieldPath]],
               span_ns: tuple[int, int] | None = None) -> Iterator[Block]:
        """
        Iterate over the messages of some topics as columns, a few thousand rows at a time.

        Parameters
        ----------
        fields : mapping of str to sequence of FieldPath
            Wanted of each topic; they are the columns, in this order.
        span_ns : (int, int), optional
            First and last log time that matter: what lies far outside is not read.

        Returns
        -------
        iterator of Block
            In the order of log time; columns in the order of the topics.

        Raises
        ------
        BagError
            If a topic or field is not in the bag, or it cannot be read on.
        """
        extractors = {topic: self.extractor(topic, [self.bind(topic, path) for path in paths])
                      for topic, paths in fields.items()}
        blocks = self._blocks({topic: unpacking(extract.columns)
                               for topic, extract in extractors.items()}, span_ns)
        return self._watched(blocks, extractors)

    def _watched(self, blocks: Iterator[Block], extractors: Mapping[str, Extractor]
                 ) -> Iterator[Block]:
        """Note fields by index that are not always of the same name."""
        try:
            yield from blocks
        finally:
            for topic, extract in extractors.items():
                for field in extract.fields:
                    if fault := mixed(field, extract.called):
                        self._note(f'topic {topic}: {fault}')

    def messages(self, topics: str | Iterable[str] | None = None) -> Iterator[BagMessage]:
        """
        Iterate over the messages of one or more topics (all if None) in the order of log time.

        Raises
        ------
        BagError
            If a topic is not in the bag, or it cannot be read on.
        """
        if isinstance(topics, str):
            topics = [topics]
        wanted = dict.fromkeys(self.topics if topics is None else topics, unpacking(raw))
        return (message for block in self._blocks(wanted) for message in _rows(block))

    def _blocks(self, decoders: Mapping[str, Decode],
                span_ns: tuple[int, int] | None = None) -> Iterator[Block]:
        names = list(decoders)
        slots = {self.topic(name).name: slot for slot, name in enumerate(names)}
        streams: list[tuple[int, Callable[[], Iterator[Block]]]] = []
        for recording, topics in zip(self._recordings, self._names, strict=True):
            chosen = {number: slots[name] for number, name in topics.items() if name in slots}
            wanted = Wanted(chosen, names, list(decoders.values()), span_ns)
            if chosen and wanted.overlaps(recording.start_ns, recording.end_ns):
                streams.append((recording.start_ns, partial(self._stream, recording, wanted)))
        return merge_in_time(streams) if len(streams) != 1 else streams[0][1]()

    def topic(self, name: str) -> TopicInfo:
        """
        Return a topic.

        Raises
        ------
        BagError
            If it is not in the bag; the message names the nearest.
        """
        found = name if name in self.topics else self._by_part(name)
        if found not in self.topics:
            raise BagError(f'no topic {name!r} in the bag' + nearest(name, sorted(self.topics)))
        if found != name:
            self._note(f'topic {name} is read from {found}, the only table')
        return self.topics[found]

    def _by_part(self, name: str) -> str:
        """Return the topic of a table that is alone here, called by the name of another one."""
        tables = {recording.alone for recording in self._recordings}
        alone = tables.pop() if len(tables) == 1 else ''
        _, slash, part = name.partition('/')
        return f'{alone}{slash}{part}' if alone else name

    def note_unused(self, topics: Iterable[str]) -> None:
        """Note the tables that none of these topics is of."""
        used = {self.topic(name).name for name in topics}
        for recording, names in zip(self._recordings, self._names, strict=True):
            if recording.alone and not used & {*names.values()}:
                self._note(f'table {recording.alone} is not used, for no channel is of it')

    def message_type(self, topic: str) -> MessageType:
        """
        Return the type of a topic's messages.

        Raises
        ------
        BagError
            If there is no such topic, or its messages cannot be decoded.
        """
        problem = self.topic(topic).problem
        if problem:
            raise BagError(f'topic {topic} cannot be decoded: {problem}')
        return self._types[self.topic(topic).name]

    def extractor(self, topic: str, fields: Sequence[FieldPath]) -> Extractor:
        """
        Return a function: raw message -> (header stamp [ns] or None, scalars of the fields).

        It raises `DecodeError` (a ValueError) for a message that does not hold them.

        Raises
        ------
        BagError
            If there is no such topic or field, or a field is not a number.
        """
        try:
            return Extractor(self.message_type(topic), fields)
        except FieldError as error:
            raise BagError(f'topic {topic}: {error}') from None

    def bind(self, topic: str, path: FieldPath) -> FieldPath:
        """
        Close the open ranges of a field (`effort[:]`) by the first message that has elements.

        A field by name (`velocity[elbow]`) is looked for in the messages.

        Raises
        ------
        BagError
            If there is no such topic or field, or no message with elements, or with the name: it
            says which names there are.
        """
        kind = self.message_type(topic)
        reason: Exception | str = 'there is no message'
        try:
            if not path.is_open:
                self._look_for(topic, path)
                return path
            with closing(self._stream_of(topic)) as messages:
                for message in messages:
                    try:
                        return bind(kind, path, message.raw)
                    except DecodeError as error:
                        reason = error
        except FieldError as error:
            raise BagError(f'topic {topic}: {error}') from None
        raise BagError(f'topic {topic}: the length of `{path}` is not known: {reason}')

    def _look_for(self, topic: str, path: FieldPath) -> None:
        extract = Extractor(self.message_type(topic), [path])
        # Or there is nothing to look for.
        damaged = not path.elements or (topic, path) in self._met or not self.topic(topic).count
        with closing(self._stream_of(topic)) as messages:
            for message in () if damaged else messages:
                try:
                    _, (first, *_) = extract(message.raw)
                except DecodeError:
                    damaged = True  # it is said later why there are no samples
                    continue
                if first is not ABSENT:
                    self._met.add((topic, path))
                    return
        if not damaged:
            raise BagError(f'topic {topic}: {missing(path, extract.names)}')

    def scalar_fields(self, topic: str, most: int = 64) -> list[FieldPath]:
        """
        List the scalars of a topic that could be signals, by its first message.

        Parameters
        ----------
        topic : str
        most : int
            Longer arrays of numbers are left out.

        Raises
        ------
        BagError
            If there is no such topic, or its messages cannot be decoded.
        """
        kind = self.message_type(topic)
        with closing(self._stream_of(topic)) as messages:
            for message in messages:
                try:
                    return scalar_fields(kind, message.raw, most=most)
                except DecodeError:
                    continue
        return scalar_fields(kind, None, most=most)

    def named_fields(self, topic: str, most: int) -> dict[FieldPath, str]:
        """
        List the scalars of a topic that could be signals, by name where messages have names.

        Parameters
        ----------
        topic : str
        most : int
            Of so many messages the names are looked at, since several publishers may have theirs.

        Returns
        -------
        dict
            Their fields, and what the first message that has one calls it by index.

        Raises
        ------
        BagError
            If there is no such topic, or its messages cannot be decoded.
        """
        kind = self.message_type(topic)
        found: dict[FieldPath, str] = {}
        watch: Extractor | None = None  # it tells whether a message has names that are new
        known = 0
        with closing(self._stream_of(topic)) as messages:
            for message in islice(messages, most):
                try:
                    if watch is not None:
                        watch(message.raw)
                        if len(watch.names) == known:
                            continue
                        known = len(watch.names)
                    paths = [(by_name(kind, path, message.raw), str(path))
                             for path in scalar_fields(kind, message.raw)]
                except DecodeError:
                    continue
                taken = set(found.values())
                found |= {path: '' if index in taken else index for path, index in paths
                          if path not in found}
                named = [path for path in found if path.elements]
                if not named:
                    return found
                self._met |= {(topic, path) for path in named}
                watch = watch or Extractor(kind, named[:1])
        return found or {path: str(path) for path in scalar_fields(kind, None)}

    def problem(self, topic: str, fields: Sequence[FieldPath]) -> str:
        """
        Say why messages of a topic do not hold some fields, by the first that does not.

        Raises
        ------
        BagError
            If there is no such topic or field, or the bag cannot be read on.
        """
        extract = self.extractor(topic, fields)
        with closing(self._stream_of(topic)) as messages:
            for message in messages:
                try:
                    extract(message.raw)
                except DecodeError as error:
                    return str(error)
        return ''

    def close(self) -> None:
        """Close files and remove temporary ones."""
        self._resources.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def _note(self, text: str) -> None:
        self._notes[text] = None

    def _stream_of(self, topic: str) -> Generator[BagMessage, None, None]:
        yield from self.messages([topic])

    def _stream(self, recording: Recording, wanted: Wanted) -> Iterator[Block]:
        try:
            yield from recording.blocks(wanted, self._note)
        except OSError as error:
            raise BagError(f'reading stopped: {error}') from error


def _rows(block: Block) -> Iterator[BagMessage]:
    rows = [zip(c.log_ns.tolist(), c.publish_ns.tolist(), c.values, strict=True)
            for c in block.columns]
    for number in block.which.tolist():
        yield BagMessage(block.columns[number].topic, *next(rows[number]))


def open_bag(path: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
             time: Sequence[str] = ()) -> Bag:
    """
    Open a bag, or another recording.

    Parameters
    ----------
    path : path or several
        A file (.mcap, .db3, .bag, packed with zstd or not), a folder with such files
        (metadata.yaml is not needed), or several of both, to be read as one bag merged by time.
        Other recordings: PX4 ULog, ArduPilot .bin, CSV, Parquet (docs/recordings.md); a URL.
    time : sequence of str, optional
        Names of the columns of a table that are times, with a unit where they do not tell it
        (`t`, `t:ms`).

    Raises
    ------
    BagError
        If there is no bag, or it is damaged beyond use; the message says which and why.
    """
    paths = [path] if isinstance(path, str | os.PathLike) else list(path)
    if not paths:
        raise BagError('no bag was named')
    notes: list[str] = []
    recordings: dict[Path, Recording] = {}
    with ExitStack() as resources:
        for given in paths:
            try:
                _open_one(local(given, notes.append), recordings, notes, resources, time)
            except BagError:
                raise
            except PermissionError as error:
                raise BagError(f'{error.filename or given}: permission denied; check its owner '
                               'and mode with `ls -ld`') from error
            except OSError as error:
                raise BagError(f'{given}: {error.strerror or error}') from error
        if time and not any(recording.alone for recording in recordings.values()):
            raise BagError(f'{" and ".join(time)} would be the time of a table (CSV, Parquet), '
                           'but there is none; leave --time out')
        size = sum(path.stat().st_size for path in recordings)
        return Bag(continued(tuple(recordings.values())), notes, resources.pop_all(), size)


def _open_one(path: Path, recordings: dict[Path, Recording], notes: list[str],
              resources: ExitStack, time: Sequence[str]) -> None:
    """Add the recordings of one path; in a folder, single unusable files are noted."""
    found = find_files(path)
    notes += found.notes
    unusable: list[BagError] = []
    count = 0
    for file in found.files:
        try:
            recording = recordings[file.resolve()] = scan_file(file, resources, time)
            notes += recording.notes
            count += recording.count
        except BagError as error:
            unusable.append(error)
    if len(unusable) == len(found.files):
        raise unusable[0]
    notes += [f'skipped: {error}' for error in unusable]
    if found.stated not in (None, count):
        notes.append(f'{path.name}: metadata.yaml states {found.stated} messages, {count} are '
                     'there')
