# SPDX-License-Identifier: Apache-2.0
"""Which bags a batch is of: paths, folders of bags, patterns, and lists in a file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from glob import glob, has_magic
import os
from pathlib import Path
import re

from ctsid_core.errors import SettingsError
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.files import OTHER_SUFFIXES, SUFFIXES

_LIST = '.txt'
_METADATA = 'metadata.yaml'


def find_bags(given: Sequence[str]) -> list[str]:
    """
    Return the absolute paths of bags, each once.

    Parameters
    ----------
    given : sequence of str
        Bags; folders, of which all bags are taken, also those in folders below (logs and tables
        where there is no bag, for beside bags these are something else); patterns like
        'flights/*/*.mcap' (`**` for all folders below); and files that end in .txt, with one of
        these on each line (a line that begins with # does not count).

    Raises
    ------
    BagError
        If a list cannot be read, or there is no bag at all.
    """
    found = [str(Path(bag).resolve()) for word in given for line in _lines(word)
             for bag in _bags(line)]
    if not found:
        raise BagError(f'there is no bag ({", ".join((*SUFFIXES, *OTHER_SUFFIXES))}) in '
                       f'{", ".join(given)}; give bags, a folder, a pattern in quotes, or a list '
                       'in a .txt file')
    return list(dict.fromkeys(found))


def vehicle(bag: str, pattern: str = '') -> str:
    """
    Return the vehicle that a bag is of.

    Parameters
    ----------
    bag : str
        Its path.
    pattern : str
        A regular expression for a part of the path: its first group, or all of it, is the name.
        Without one, the name of the folder that the bag lies in.
    """
    if not pattern:
        return Path(bag).parent.name
    found = re.search(pattern, bag)
    return '' if found is None else found.group(1 if found.re.groups else 0) or ''


def check_pattern(pattern: str) -> None:
    """
    Check the pattern of vehicles.

    Raises
    ------
    SettingsError
        If it is no regular expression.
    """
    try:
        re.compile(pattern)
    except re.error as error:
        raise SettingsError([f'--vehicle {pattern!r} is no regular expression ({error}); write '
                             "it like 'flights/([^/]+)/'"]) from None


def _bags(word: str) -> Iterator[str]:
    path = Path(word).expanduser()
    if path.is_dir():
        yield from list(_inside(path, SUFFIXES)) or _inside(path, OTHER_SUFFIXES)
    elif has_magic(word) and not path.exists():
        for match in map(Path, sorted(glob(str(path), recursive=True))):
            # of a file that a bag is made of, the pattern means the bag
            part = match.is_file() and (match.parent / _METADATA).exists()
            yield from _bags(str(match.parent if part else match))
    else:
        yield str(path)  # if there is no such file, its task will say so


def _inside(folder: Path, suffixes: tuple[str, ...]) -> Iterator[str]:
    """Yield the bags in a folder: a folder with metadata.yaml is one, else its files are."""
    seen: set[str] = set()
    for place, folders, files in os.walk(folder, followlinks=True):
        folders.sort()
        if (real := os.path.realpath(place)) in seen:       # links may lead back
            folders.clear()
            continue
        seen.add(real)
        if _METADATA in files:
            folders.clear()
            yield place
            continue
        for name in sorted(files):
            if name.lower().endswith(suffixes):
                yield str(Path(place) / name)


def _lines(word: str) -> list[str]:
    """Return the lines of a list; a word that names none stands for itself."""
    path = Path(word).expanduser()
    if path.suffix != _LIST or not path.is_file():
        return [word]
    try:
        lines = [line.strip() for line in path.read_text('utf-8').splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise BagError(f'{path} cannot be read as a list of bags ({error}); write one path on '
                       'each line') from error
    return [line for line in lines if line and not line.startswith('#')]
