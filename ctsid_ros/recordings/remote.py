# SPDX-License-Identifier: Apache-2.0
"""Paths that are URLs (s3://, gs://, https://): read into a local cache, by fsspec."""

from __future__ import annotations

from collections.abc import Callable
import hashlib
import os
from pathlib import Path
from typing import Any

from ctsid_ros.errors import BagError, lacks_extra


def is_url(path: str | os.PathLike[str]) -> bool:
    """Whether a path is a URL."""
    return '://' in os.fspath(path)


def local(path: str | os.PathLike[str], note: Callable[[str], None] = lambda _: None) -> Path:
    """
    Return a path on this computer: a URL is read into the cache, unless it is there already.

    Parameters
    ----------
    path : path or URL
        Of a file or a folder.
    note : callable, optional
        Takes the sentence on where it was read to.

    Raises
    ------
    BagError
        If fsspec or the library of that kind of URL is not installed, or it cannot be read.
    """
    if not is_url(path):
        return Path(path).expanduser()
    url = os.fspath(path)
    shown = url.partition('?')[0].rstrip('/')  # what follows may be a key
    try:
        import fsspec
    except ImportError as error:
        raise BagError(lacks_extra(error, f'{shown} is a URL: to read it', 'remote')) from None
    try:
        system, inner = fsspec.url_to_fs(url)
        entries = _entries(system, inner)
        # A file that has changed there is another one.
        known = hashlib.sha256(repr((shown, entries)).encode()).hexdigest()[:16]
        target = _cache() / known / shown.rpartition('/')[2]
        if target.exists():
            note(f'{shown}: the copy in {target} is read')
            return target
        _copy(system, entries, inner, target)
    except BagError:
        raise
    except FileNotFoundError:
        raise BagError(f'{shown} cannot be read: there is no such file') from None
    except Exception as error:  # each kind of storage has its own, and says what to install
        why = str(error).replace(url, shown) or type(error).__name__
        raise BagError(f'{shown} cannot be read: {why}') from None
    note(f'{shown} was read into {target}')
    return target


def _entries(system: Any, inner: str) -> list[tuple[str, str]]:
    """Return name and state of a file, or of those in a folder."""
    about = system.info(inner)  # `isdir` of https would read all of it
    if about['type'] != 'directory':
        return [(inner, _state(about))]
    found = [info for info in system.ls(inner, detail=True) if info['type'] == 'file']
    if not found:
        raise BagError(f'{inner}: there is no file in this folder')
    return sorted((info['name'], _state(info)) for info in found)


def _state(info: dict[str, Any]) -> str:
    return repr([(key, str(info[key])) for key in sorted(info)
                 if key.lower() in ('size', 'etag', 'lastmodified', 'mtime', 'created')])


def _copy(system: Any, entries: list[tuple[str, str]], inner: str, target: Path) -> None:
    """Copy into the cache; what is interrupted leaves no copy that looks whole."""
    part = target.with_name(f'{target.name}.{os.getpid()}.part')
    part.parent.mkdir(parents=True, exist_ok=True)
    if [name for name, _ in entries] == [inner]:
        system.get_file(inner, str(part))
    else:
        part.mkdir()
        for name, _ in entries:
            system.get_file(name, str(part / name.rpartition('/')[2]))
    part.replace(target)


def _cache() -> Path:
    home = os.environ.get('XDG_CACHE_HOME') or '~/.cache'
    return Path(home).expanduser() / 'ctsid'
