# SPDX-License-Identifier: Apache-2.0
"""
Which of several bags are the parts of one recording, and which are recordings of their own.

The files that a metadata.yaml lists are parts of one. For others, and in a folder of them, time
tells. A recorder that splits its bag begins the next part with the next message, and two
recorders of different topics run at the same time. Bags that overlap, or follow each other within
a second, are one recording; between recordings somebody has stopped and started the recorder.

Autopilots and many tables count from a start of their own, so that time tells little: files with
the same columns (of tables: or these and more) are recordings of their own, and files with other
columns belong together. Only where the times of one table continue those of another, and of no
third, a logger has split it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.files import files_in, find_files
from ctsid_ros.recordings.recording import NEAR, Times, successors
from ctsid_ros.recordings.remote import local

_SIGNALS = 2  # an input and an output


@dataclass(frozen=True)
class _Span:
    """Files that are one bag for certain, and when they were recorded."""

    given: str
    files: tuple[str, ...]
    start_ns: int
    end_ns: int
    topics: frozenset[str]
    own_clock: bool = False
    types: frozenset[str] = frozenset()  # of those with a clock of their own
    table: bool = False
    columns: frozenset[frozenset[str]] = frozenset()  # of each topic of a table

    def repeats(self, other: _Span) -> bool:
        """Whether it has the signals of another: a recording of its own, whatever else it has."""
        return bool(self.types & other.types) or any(
            len(one & two) >= _SIGNALS and (one <= two or two <= one)
            for one in self.columns for two in other.columns)


def recordings(paths: Sequence[str], topics: Collection[str] = (),
               note: Callable[[str], None] = lambda _: None,
               time: Sequence[str] = ()) -> list[tuple[str, ...]]:
    """
    Group bags by recording, in the order of time.

    Parameters
    ----------
    paths : sequence of str
        Files, or folders with files or with bags.
    topics : collection of str
        That matter; all if empty.
    note : callable, optional
        Takes what is left out: files of a folder that cannot be read; and what time does not tell.
    time : sequence of str, optional
        See `open_bag`.

    Returns
    -------
    list of tuple of str
        The parts of each recording, in the order in which they were given. A folder of which all
        is one recording stands for itself.

    Raises
    ------
    BagError
        If one is no bag, or two hold the same topics at the same time.
    """
    bags = [(path, files) for path in paths for files in _bags(local(path, note))]
    if len(bags) < 2:
        return [tuple(paths)]
    spans = _spans(bags, note, time)
    groups: list[list[_Span]] = []
    for chain in _chains([s for s in spans if s.own_clock], note):
        _add_by_columns(groups, chain, frozenset(topics), note)
    alone = len(groups)
    for span in sorted((s for s in spans if not s.own_clock), key=lambda s: s.start_ns):
        if groups[alone:] and (not span.end_ns or span.start_ns <= max(
                s.end_ns for s in groups[-1]) + NEAR):
            for other in groups[-1]:
                if other.given != span.given:
                    _check_apart(other, span, topics)
            groups[-1].append(span)
        elif groups[alone:] and not groups[-1][-1].end_ns:  # an empty bag has no time
            groups[-1].append(span)
        else:
            groups.append([span])
    return [_parts(sorted(group, key=spans.index), [s.given for s in spans]) for group in groups]


def _chains(spans: Sequence[_Span], note: Callable[[str], None]) -> list[list[_Span]]:
    """Put tables that continue others behind them."""
    following, doubtful = successors([Times(span.types if span.table else (), span.start_ns,
                                            span.end_ns) for span in spans])
    if doubtful:
        files = ', '.join(file for i in doubtful for file in spans[i].files)
        note(f'{files}: time does not tell which of these tables continues which, so they are not '
             'joined; give the parts of one run at a time')
    chains = []
    for head in sorted({*range(len(spans))} - {*following.values()}):
        places = [head]
        while places[-1] in following:
            places.append(following[places[-1]])
        chains.append([spans[i] for i in places])
    return chains


def _add_by_columns(groups: list[list[_Span]], chain: Sequence[_Span], topics: frozenset[str],
                    note: Callable[[str], None]) -> None:
    """Add files to the last recording if none there has their columns, or both are asked for."""
    last, span = groups[-1] if groups else [], chain[0]
    again = any(span.repeats(other) for other in last)
    asked = all(one.topics & topics for one in (span, *last)) \
        and not any(span.topics & other.topics for other in last)
    if last and (asked or not again):
        if not asked:
            files = ', '.join(file for s in (*last, *chain) for file in s.files)
            note(f'{files}: taken for parts '
                 'of one recording, for they have no columns in common and their clocks begin at '
                 'their start; give files of different runs one at a time, or to `ctsid batch`')
        last.extend(chain)
    else:
        groups.append([*chain])


def _bags(path: Path) -> list[tuple[str, ...]]:
    """Return the bags that a path stands for: files, of which some are one bag for certain."""
    if not path.is_dir():
        return [(str(path),)]
    try:
        found = find_files(path)
    except BagError:
        inner = sorted(folder for folder in path.iterdir() if folder.is_dir())
        bags = [bag for folder in inner if _has_files(folder) for bag in _bags(folder)]
        if not bags:
            raise
        return bags
    whole = tuple(str(file) for file in found.listed)
    return [whole] * bool(whole) + [(str(file),) for file in found.files
                                    if file not in found.listed]


def _has_files(folder: Path) -> bool:
    return bool(files_in(folder))


def _parts(group: Sequence[_Span], given: Sequence[str]) -> tuple[str, ...]:
    """Return the files of a recording; a path in their place where it stands for no other."""
    own = [span.given for span in group]
    whole = {path for path in own if own.count(path) == given.count(path)
             and not _is_outer(local(path))}
    return tuple(dict.fromkeys(part for span in group for part in (
        [span.given] if span.given in whole else span.files)))


def _is_outer(path: Path) -> bool:
    """Whether it is a folder of bags, not of files."""
    return path.is_dir() and not _has_files(path)


def _spans(bags: Sequence[tuple[str, tuple[str, ...]]], note: Callable[[str], None],
           time: Sequence[str]) -> list[_Span]:
    """Look at all bags; of a folder, single files may be unusable."""
    spans: list[_Span] = []
    faults: list[BagError] = []
    for path, files in bags:
        try:
            spans.append(_span(path, files, time))
        except BagError as error:
            if (str(local(path)),) == files:
                raise
            faults.append(error)
    if not spans:
        raise faults[0]
    for fault in faults:
        note(f'left out: {fault}')
    return spans


def _span(path: str, files: tuple[str, ...], time: Sequence[str]) -> _Span:
    with open_bag(files, time) as bag:
        filled = frozenset(name for name, topic in bag.topics.items() if topic.count)
        types = frozenset(repr(bag.message_type(name)) for name in filled) if bag.own_clock \
            else frozenset()
        columns = frozenset(frozenset(map(str, bag.scalar_fields(name))) for name in filled) \
            if bag.tables else frozenset()
        return _Span(path, files, bag.start_ns, bag.end_ns, filled, bag.own_clock, types,
                     bag.tables, columns)


def _check_apart(one: _Span, other: _Span, topics: Collection[str]) -> None:
    shared = one.topics & other.topics & (frozenset(topics) or one.topics)
    if shared and min(one.end_ns, other.end_ns) - max(one.start_ns, other.start_ns) > NEAR:
        raise BagError(f'{one.given} and {other.given} hold the same topics ('
                       f'{", ".join(sorted(shared)[:4])}) at the same time: the same recording '
                       'twice, or two robots; give one of them')
