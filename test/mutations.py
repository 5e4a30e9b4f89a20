# SPDX-License-Identifier: Apache-2.0
"""
Recordings spoilt at random, and what reading them may end in: data, or an error that says so.

    python test/mutations.py --count 100000     # half an hour, and a table
    python test/mutations.py --bits 2000        # which share of single bits is wrong and not said

Each case is a small sound recording of one format with one to four faults: bits, bytes and
numbers that are others, places that are zeroed, taken out, repeated, or put in, and ends that are
cut off. It is opened, surveyed, and read whole. Anything but a `BagError` or `DecodeError` is a
fault, and so is a case of more than `SLOW` seconds, or of memory beyond `MEMORY`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
import faulthandler
from pathlib import Path
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings

from bag_fixtures import (
    STORE,
    array,
    bare,
    flight,
    flight_ros1,
    imu,
    joints,
    make,
    write_mcap,
    write_ros1,
    write_rosbag2,
)
import numpy as np
from recording_files import flight as experiment
from recording_files import write_ardupilot, write_csv, write_ulog

from ctsid_ros.decoding.block import Located
from ctsid_ros.decoding.cdr import Extractor
from ctsid_ros.decoding.cdr_layout import DecodeError
from ctsid_ros.decoding.message_fields import scalar_fields
from ctsid_ros.decoding.message_types import MessageType
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.definitions import message_type
from ctsid_ros.recordings.recording import Connection
from ctsid_ros.recordings.survey import survey

SLOW = 5.0  # s; a sound one takes some milliseconds
MEMORY = 1 << 30  # bytes beyond what the process has with the libraries loaded


def _csv(path: Path) -> Path:
    t_u, u, t_y, y = experiment(3.0)
    return write_csv(path, {'t_u': t_u, 'cmd': u, 't_y': t_y, 'rate.x': y})


def _parquet(path: Path) -> Path:
    import pyarrow
    from pyarrow import parquet
    t_u, u, _, _ = experiment(3.0)
    parquet.write_table(pyarrow.table({'t': t_u, 'cmd': u, 'rate': [{'x': v} for v in u],
                                       'list': [[v, v] for v in u]}), path, row_group_size=20)
    return path


FORMATS: dict[str, Callable[[Path], Path]] = {
    'mcap, zstd': lambda p: write_mcap(p / 'a.mcap', flight(60)),
    'mcap, lz4': lambda p: write_mcap(p / 'a.mcap', flight(60), 'lz4'),
    'mcap, no CRC': lambda p: write_mcap(p / 'a.mcap', flight(60), 'none', enable_crcs=False),
    'mcap, no chunks': lambda p: write_mcap(p / 'a.mcap', flight(60), 'none', use_chunking=False),
    'sqlite3': lambda p: bare(write_rosbag2(p / 'a', flight(60), 'sqlite3'), '.db3'),
    'ROS 1, none': lambda p: write_ros1(p / 'a.bag', flight_ros1(60)),
    'ROS 1, lz4': lambda p: write_ros1(p / 'a.bag', flight_ros1(60), 'lz4'),
    'ROS 1, bz2': lambda p: write_ros1(p / 'a.bag', flight_ros1(60), 'bz2'),
    'ULog': lambda p: write_ulog(p / 'a.ulg', *experiment(3.0)),
    'ArduPilot': lambda p: write_ardupilot(p / 'a.bin', *experiment(3.0)),
    'CSV': lambda p: _csv(p / 'a.csv'),
    'Parquet': lambda p: _parquet(p / 'a.parquet'),
}
CHECKED = {  # with a checksum for every byte of messages and of the summary
    compression: lambda p, c=compression: write_mcap(p / 'a.mcap', flight(60), c)
    for compression in ('zstd', 'lz4', 'none')}
_NUMBERS = [value.to_bytes(size, 'little', signed=False) for size in (1, 2, 4, 8)
            for bits in (size * 8, size * 8 - 1) for value in (2**bits - 1, 2**bits - 2, 1)]


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return data with one to four faults."""
    spoilt = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if spoilt:
            _FAULTS[rng.integers(len(_FAULTS))](spoilt, int(rng.integers(len(spoilt))), rng)
    return bytes(spoilt)


def _bit(data: bytearray, at: int, rng: np.random.Generator) -> None:
    data[at] ^= 1 << int(rng.integers(8))


def _noise(data: bytearray, at: int, rng: np.random.Generator) -> None:
    size = min(int(rng.integers(1, 33)), len(data) - at)
    data[at:at + size] = rng.bytes(size)


def _number(data: bytearray, at: int, rng: np.random.Generator) -> None:
    value = _NUMBERS[rng.integers(len(_NUMBERS))]
    data[at:at + len(value)] = value


def _zeros(data: bytearray, at: int, rng: np.random.Generator) -> None:
    size = min(int(rng.integers(1, 2000)), len(data) - at)
    data[at:at + size] = bytes(size)


def _cut_out(data: bytearray, at: int, rng: np.random.Generator) -> None:
    del data[at:at + int(rng.integers(1, 600))]


def _repeated(data: bytearray, at: int, rng: np.random.Generator) -> None:
    piece = data[at:at + int(rng.integers(1, 600))]
    to = int(rng.integers(len(data)))
    data[to:to] = piece


def _end(data: bytearray, at: int, rng: np.random.Generator) -> None:
    del data[at:]


_FAULTS = (_bit, _bit, _noise, _number, _number, _zeros, _cut_out, _repeated, _end)


def read(path: Path) -> int:
    """Do what commands do with a recording; return how many messages it gave."""
    with open_bag(path) as bag:
        survey(bag)
        fields = {}
        for topic in bag.topics:
            try:
                fields[topic] = bag.scalar_fields(topic)
            except BagError:
                continue  # a topic that cannot be decoded
        for block in bag.blocks(fields) if fields else ():
            for columns in block.columns:
                assert len(columns.values) == len(columns.log_ns) == len(columns.sound)
        count = sum(1 for _ in bag.messages())
        assert all(isinstance(note, str) and note for note in bag.notes)
        return count


Given = dict[str, tuple[str, list[tuple[int, bytes]]]]


def what_it_gives(path: Path) -> tuple[Given, str]:
    """Return type and messages of each topic of a recording, and its notes."""
    with open_bag(path) as bag:
        given: Given = {name: (topic.type, []) for name, topic in bag.topics.items()}
        for message in bag.messages():
            given[message.topic][1].append((message.log_ns, bytes(message.raw)))
        return given, ' '.join(bag.notes)


def outcome_of(path: Path, spoilt: bytes, sound: tuple[Given, str]) -> str:
    """Return what became of damage: it is 'harmless', it is 'said', or 'silent'."""
    path.write_bytes(spoilt)
    try:
        found = what_it_gives(path)
    except BagError:
        return 'said'
    return 'said' if found[1] != sound[1] else 'harmless' if found == sound else 'silent'


def bit_flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Return data with another bit."""
    spoilt = bytearray(data)
    _bit(spoilt, int(rng.integers(len(spoilt))), rng)
    return bytes(spoilt)


def zeroed(data: bytes, rng: np.random.Generator) -> bytes:
    """Return data with a block of 512 zeros, as a sector that was not written."""
    at = int(rng.integers(len(data)))
    return data[:at] + bytes(min(512, len(data) - at)) + data[at + 512:]


def messages() -> list[tuple[MessageType, bytes]]:
    """Return sound messages of several types, in both encodings and byte orders."""
    found = []
    for message in (imu(10**9, 0.5), joints(10**9, [0.1, 0.2, 0.3]), array(1.0, 2.0),
                    make('my_msgs/msg/State', gains=np.ones(3, np.float32), name='a',
                         labels=['b', 'cd'], pair=[make('my_msgs/msg/Flat')] * 2),
                    make('nav_msgs/msg/Odometry'), make('sensor_msgs/msg/PointCloud2')):
        name = message.__msgtype__
        for encoding, version in (('cdr', 2), ('ros1', 1)):
            text = STORE.generate_msgdef(name, ros_version=version)[0]
            kind = message_type(Connection(0, '/t', name, encoding, f'ros{version}msg', text, 1))
            for little in (True, False) if encoding == 'cdr' else (True,):
                raw = STORE.serialize_cdr(message, name, little_endian=little) \
                    if encoding == 'cdr' else STORE.serialize_ros1(message, name)
                found.append((kind, bytes(raw)))
    return found


def decode(kind: MessageType, sound: bytes, spoilt: bytes) -> int:
    """Decode a message beside a sound one: each alone, and both as columns, to the same."""
    extractor = Extractor(kind, scalar_fields(kind, sound))
    rows = []
    for raw in (sound, spoilt):
        try:
            rows.append(extractor(raw)[1])
        except DecodeError:
            rows.append(None)
    with suppress(DecodeError):
        scalar_fields(kind, spoilt)
    lengths = np.array([len(sound), len(spoilt)])
    offsets = np.array([0, len(sound)])
    found = Extractor(kind, extractor.fields).columns(
        [Located(0, sound + spoilt, offsets, lengths, offsets, offsets)])
    assert found.sound.tolist() == [row is not None for row in rows]
    for row, values in zip(rows, found.values, strict=True):
        if row is not None:
            np.testing.assert_array_equal(values, row)
    return int(rows[1] is not None)


class TooSlowError(Exception):
    """A case that takes too long."""


def _stop(number: int, frame: object) -> None:
    raise TooSlowError


def cases(count: int, seed: int, formats: list[str]) -> Iterator[tuple[str, int, Callable[[], int],
                                                                       bytes]]:
    """Yield format, number, what to do, and the spoilt bytes of each case; formats take turns."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        sound: dict[str, tuple[str, bytes]] = {}
        for i, name in enumerate(n for n in formats if n in FORMATS):
            (folder / str(i)).mkdir()
            path = FORMATS[name](folder / str(i))
            sound[name] = (path.suffix, path.read_bytes())
        kinds = messages()
        for number in range(count):
            rng = np.random.default_rng((seed, number))
            name = formats[number % len(formats)]
            if name == 'message':
                kind, raw = kinds[rng.integers(len(kinds))]
                spoilt = mutated(raw, rng)
                yield name, number, lambda k=kind, r=raw, s=spoilt: decode(k, r, s), spoilt
                continue
            suffix, data = sound[name]
            spoilt = mutated(data, rng)
            path = folder / f'spoilt{suffix}'
            path.write_bytes(spoilt)
            yield name, number, lambda p=path: read(p), spoilt


def run(count: int, seed: int, formats: list[str], failed: Callable[[str, int, bytes], None]
        ) -> dict[str, Counter[str]]:
    """
    Try so many cases.

    Parameters
    ----------
    count, seed : int
    formats : list of str
        Of `FORMATS`, or 'message'; each as often as it is in the list.
    failed : callable
        Called with format, number and bytes of each case that fails, while the error is handled.

    Returns
    -------
    dict of str to Counter
        By format: how many were read, refused, and failed.
    """
    outcome: dict[str, Counter[str]] = {name: Counter() for name in formats}
    previous = signal.signal(signal.SIGALRM, _stop)
    try:
        warnings.simplefilter('error', RuntimeWarning)  # NumPy's, which would reach the terminal
        for name, number, do, spoilt in cases(count, seed, formats):
            signal.setitimer(signal.ITIMER_REAL, SLOW)
            try:
                outcome[name]['read' if do() else 'nothing'] += 1
            except BagError:
                outcome[name]['refused'] += 1
            except BaseException as error:
                signal.setitimer(signal.ITIMER_REAL, 0)
                if isinstance(error, KeyboardInterrupt):
                    raise
                outcome[name]['FAILED'] += 1
                failed(name, number, spoilt)
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        signal.signal(signal.SIGALRM, previous)
    return outcome


def bits(count: int, formats: list[str]) -> None:
    """Print by format which share of single bits is wrong and not said."""
    print('share of single bits [%]: of messages and times in the file; harmless, said, silent')
    for name in formats:
        with tempfile.TemporaryDirectory() as scratch:
            path = FORMATS[name](Path(scratch))
            data, sound = path.read_bytes(), what_it_gives(path)
            held = sum(len(raw) + 8 for _, rows in sound[0].values() for _, raw in rows)
            rng = np.random.default_rng(4)
            found = Counter(outcome_of(path, bit_flipped(data, rng), sound) for _ in range(count))
        print(f'{name:16} {100 * held / len(data):6.1f}', *(
            f'{100 * found[what] / count:6.1f}' for what in ('harmless', 'said', 'silent')))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('--count', type=int, default=1000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--formats', nargs='+', default=[*FORMATS, 'message', 'message'],
                        choices=[*FORMATS, 'message'], metavar='FORMAT')
    parser.add_argument('--keep', type=Path, help='folder for the cases that fail')
    parser.add_argument('--bits', type=int, help='only count what single bits do, of so many')
    args = parser.parse_args()
    if args.bits:
        bits(args.bits, [name for name in args.formats if name in FORMATS])
        return 0
    faulthandler.enable()
    seen: Counter[str] = Counter()

    def failed(name: str, number: int, spoilt: bytes) -> None:
        text = traceback.format_exc(limit=-6)
        place = ' '.join(line for line in text.splitlines() if line.startswith('  File'))
        seen[place] += 1
        if seen[place] > 1:
            return
        print(f'--- {name}, case {number} of seed {args.seed}\n{text}', flush=True)
        if args.keep:
            args.keep.mkdir(exist_ok=True, parents=True)
            (args.keep / f'{name.replace(" ", "_").replace(",", "")}-{number}').write_bytes(spoilt)

    run(4 * len(args.formats), 0, args.formats, lambda *_: None)  # what is loaded once is loaded
    size = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    begin, used = time.perf_counter(), time.process_time()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    outcome = run(args.count, args.seed, args.formats, failed)
    for name, counts in outcome.items():
        print(f'{name:16}', ', '.join(f'{count} {what}' for what, count in sorted(counts.items())))
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f'{args.count} cases in {time.perf_counter() - begin:.0f} s '
          f'({time.process_time() - used:.0f} s of processor); largest resident size '
          f'{before / 1024:.0f} MB before, {after / 1024:.0f} MB after; {len(seen)} kinds of '
          f'failures, {seen.total()} in all')
    return int(bool(seen))


if __name__ == '__main__':
    sys.exit(main())
