# SPDX-License-Identifier: Apache-2.0
"""The folder of results, and what a model file says of where the model comes from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
import re
from typing import TYPE_CHECKING

from ctsid_core.errors import SettingsError, StorageError
from ctsid_ros.config.origin import described, package_version

if TYPE_CHECKING:
    from ctsid_core.settings import Settings
    from ctsid_ros.config.channels import Config

MODEL, SERIES, TABLE = 'model.json', 'estimates.npz', 'estimates.csv'
REPORT, PAGE = 'report.md', 'report.html'
TOPICS_BAG = 'estimates.mcap'  # what the node would have published
_HASHED = 2**28  # bytes: larger bags are named, but not hashed
_SUFFIXES = re.compile(r'(\.(mcap|db3|bag|zstd|active|ulg|bin|csv|tsv|parquet))+$',
                       re.IGNORECASE)


def make_folder(out: str | None, bags: Sequence[str], method: str, *, force: bool) -> Path:
    """
    Make the folder of results.

    Parameters
    ----------
    out : str or None
        Its path; None for `results/<bag>-<method>-<UTC>`.
    bags : sequence of str
    method : str
    force : bool
        Whether it may exist: then only the files of ctsid in it are replaced.

    Raises
    ------
    StorageError
        If it exists, or cannot be made or written to, or what a report needs is not installed.
    """
    _check_packages()
    if out is None:
        stamp = datetime.now(UTC).strftime('%Y%m%dT%H%M%SZ')
        folder = Path('results') / f'{bag_name(bags)}-{method}-{stamp}'
        twin = 2
        while folder.exists():  # made within the same second
            folder = folder.with_name(f'{bag_name(bags)}-{method}-{stamp}-{twin}')
            twin += 1
    else:
        folder = Path(out).expanduser()
    if folder.exists() and not folder.is_dir():
        raise StorageError(f'{folder} is a file, but a folder is wanted; choose another with '
                           '--out')
    if folder.exists() and not force:
        raise StorageError(f'{folder} exists already; choose another folder with --out, or add '
                           '--force to replace the results in it')
    try:
        folder.mkdir(parents=True, exist_ok=True)
        trial = folder / '.writable'
        trial.touch()
        trial.unlink()
    except OSError as error:
        raise StorageError(f'{folder} cannot be written to ({error.strerror}); choose another '
                           'folder with --out') from error
    return folder


def _check_packages() -> None:
    """Raise `StorageError` before the work, not after it, if the report could not be written."""
    def lacks(name: str) -> bool:
        return find_spec(name) is None

    drawn = 'matplotlib' if lacks('plotly') and lacks('matplotlib') else ''
    missing = [name for name in ('jinja2' * lacks('jinja2'), drawn) if name]
    if missing:
        keys = ' '.join(f'python3-{name}' for name in missing)
        raise StorageError(f'the report needs {" and ".join(missing)}; install with: python3 -m '
                           f'pip install {" ".join(missing)} (keys of rosdep: {keys})')


@contextmanager
def results_folder(out: str | None, bags: Sequence[str], method: str, *, force: bool
                   ) -> Iterator[Path]:
    """Give the folder of results, as `make_folder`; removed again if nothing came into it."""
    folder = make_folder(out, bags, method, force=force)
    try:
        yield folder
    finally:
        with suppress(OSError):  # not empty
            folder.rmdir()


def write_results(folder: Path, contents: Mapping[str, str]) -> None:
    """
    Write texts by file name; results of an earlier run that have no successor are removed.

    Raises
    ------
    StorageError
        If a file cannot be written.
    """
    own = [folder / name for name in (MODEL, SERIES, TABLE, REPORT, PAGE, TOPICS_BAG)]
    for path in (*own, *folder.glob('estimates-[2-9].mcap')):  # further parts, see BagWriter
        with suppress(OSError):
            path.unlink()
    write_report(folder, contents)


def write_report(folder: Path, contents: Mapping[str, str]) -> None:
    """Write texts by file name, and leave other files alone; errors: as `write_results`."""
    from ctsid_core.model.storage import write_file

    for name, text in contents.items():
        write_file(folder / name, text.encode(), force=True)


def bag_name(bags: Sequence[str]) -> str:
    """Return a short name of a bag for people: that of its file or folder."""
    name = Path(bags[0].partition('?')[0]).expanduser().resolve().name
    return _SUFFIXES.sub('', name) or name or 'bag'


def origin(config: Config, bags: Sequence[str], interval: Mapping[str, object],
           records: Sequence[Mapping[str, object]] = ()) -> dict[str, object]:
    """Return what a model file keeps of where the model comes from; of several records, each."""
    return {'ctsid': package_version(), 'bag': [Path(b.partition('?')[0]).name for b in bags],
            'sha256': bag_hash(bags), 'interval': dict(interval),
            **({'records': [dict(r) for r in records]} if records else {}),
            'channels': described(config)}


def config_of(metadata: Mapping[str, object], settings: Settings, path: str) -> Config:
    """
    Return the channels that a model file names.

    Raises
    ------
    StorageError
        If it names none, or they are not valid.
    """
    from ctsid_ros.config.channels import OF_INPUTS, Channel, Config

    listed = metadata.get('channels')
    if not isinstance(listed, list) or not listed:
        raise StorageError(f'{path} does not say which topics and fields its channels are; give '
                           'them with --params')
    try:
        return Config(tuple(Channel(**channel) for channel in listed),
                      settings.replace(**dict.fromkeys(OF_INPUTS, 'auto')))
    except (TypeError, SettingsError) as error:
        raise StorageError(f'{path}: `metadata.channels` is not usable ({error}); give --params'
                           ) from error


def bag_hash(bags: Sequence[str]) -> str | None:
    """Return the SHA-256 of all files of a bag in the order of their names, if it is small."""
    from ctsid_ros.recordings.content import all_files, content_hash, size

    files = all_files(bags)
    return None if size(files) > _HASHED else content_hash(files)
