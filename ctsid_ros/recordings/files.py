# SPDX-License-Identifier: Apache-2.0
"""Which files a path stands for, and what each of them is, judged by content, not by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
import difflib
from functools import lru_cache
from pathlib import Path
import shutil
import tempfile

import yaml
import zstandard

from ctsid_ros.errors import BagError
from ctsid_ros.recordings import (
    ardupilot_file,
    csv_file,
    mcap_file,
    parquet_file,
    ros1_file,
    sqlite_file,
    ulog_file,
)
from ctsid_ros.recordings.packed import ZSTD_MAGIC
from ctsid_ros.recordings.recording import Recording

SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd', '.bag', '.bag.active')
# Of files that no bag has; in a folder of a bag they are something else, such as results.
OTHER_SUFFIXES = ('.ulg', '.bin', '.csv', '.tsv', '.parquet')
Scan = Callable[[Path, ExitStack], Recording]
SCANS: dict[bytes, Scan] = {mcap_file.MAGIC: mcap_file.scan_mcap,
                            sqlite_file.MAGIC: sqlite_file.scan_sqlite,
                            ros1_file.MAGIC: ros1_file.scan_ros1}
LOOKS = {b'\x1f\x8b': 'a gzip archive (unpack it first)',
         b'PK\3\4': 'a zip archive (unpack it first)', b'BZh': 'a bzip2 archive (unpack it first)',
         b'\xfd7zXZ': 'an xz archive (unpack it first)', b'\x89HDF': 'an HDF5 file',
         b'MATLAB': 'a MATLAB file', b'\x93NUMPY': 'a NumPy array', b'\x7fELF': 'a program',
         b'\x89PNG': 'a picture', b'\xff\xd8\xff': 'a picture', b'%PDF': 'a PDF',
         b'rosbag2_bagfile_information': 'the metadata.yaml of a bag (give its folder)'}


@dataclass(frozen=True)
class BagFiles:
    """
    The files of one bag.

    Parameters
    ----------
    files : tuple of Path
    notes : tuple of str
        What is odd about the folder.
    stated : int or None
        Number of messages that its metadata.yaml states.
    listed : tuple of Path
        Those that its metadata.yaml lists: the parts of one recording.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    stated: int | None = None
    listed: tuple[Path, ...] = ()


def find_files(path: Path) -> BagFiles:
    """
    Return the bag files that a path stands for.

    Raises
    ------
    BagError
        If there is no such file or folder, or no bag file in the folder.
    """
    if path.is_file():
        return BagFiles((path,))
    if not path.exists():
        raise BagError(f'{path}: no such file or folder' + _near(path))
    if not path.is_dir():
        raise BagError(f'{path} is neither a file nor a folder')
    present = {p.name: p for p in files_in(path)}
    # `ros2 bag play` leaves the unpacked file beside the packed one: the same messages twice.
    files = {name: p for name, p in present.items()
             if name.removesuffix('.zstd') == name or name.removesuffix('.zstd') not in present}
    listed, stated, notes = _metadata(path)
    absent = [name for name in listed
              if name not in present and name.removesuffix('.zstd') not in present]
    more = [name for name in files if name not in listed and f'{name}.zstd' not in listed]
    if absent:
        notes.append(f'{path.name}: metadata.yaml lists files that are not there: '
                     + ', '.join(absent))
    if listed and more:
        notes.append(f'{path.name}: read as well, though metadata.yaml does not list them: '
                     + ', '.join(more))
    if not files:
        raise BagError(f'{path}: no bag file ({", ".join((*SUFFIXES, *OTHER_SUFFIXES))}) in this '
                       'folder'
                       + _inner(path))
    return BagFiles(tuple(files.values()), tuple(notes), None if more or absent else stated,
                    tuple(path for name, path in files.items() if name not in more))


def files_in(folder: Path) -> list[Path]:
    """
    Return the files of a folder that are bags; if there is no bag, those of other recordings.

    In a folder of folders with bags there is none: tables beside them are notes or results.
    """
    files = [path for path in sorted(folder.iterdir()) if path.is_file()]
    bags = [path for path in files if path.name.endswith(SUFFIXES)]
    if bags or any(path.name.endswith(SUFFIXES) for path in folder.glob('*/*')):
        return bags
    return [path for path in files if path.name.lower().endswith(OTHER_SUFFIXES)]


def only_inside(folder: Path) -> Path | None:
    """Return the only bag in the subfolders of a folder that has none itself, if it is so."""
    try:
        inner = [] if files_in(folder) else [
            path for path in folder.iterdir() if path.is_dir() and files_in(path)]
    except OSError:
        return None  # who opens it will say why
    return inner[0] if len(inner) == 1 else None


def scan_file(path: Path, resources: ExitStack, time: Sequence[str] = ()) -> Recording:
    """
    Read what a bag file of any kind contains.

    Parameters
    ----------
    path : Path
    resources : ExitStack
        What is to be closed in the end.
    time : sequence of str
        Names of the columns of a table that are times.

    Raises
    ------
    BagError
        If it is empty, not a bag, or damaged beyond use.
    """
    if not path.is_file():
        raise BagError(f'{path} is not a regular file')
    with path.open('rb') as file:
        start = file.read(512)
    if not start:
        raise BagError(f'{path} is empty (0 bytes): nothing was recorded, or nothing was copied')
    if start.startswith(ZSTD_MAGIC):
        unpacked = _unpack(path, resources)
        try:
            return scan_file(unpacked, resources, time)
        except BagError as error:
            raise BagError(str(error).replace(str(unpacked), f'{path} (unpacked)')) from None
    for magic, scan in SCANS.items():
        if start.startswith(magic):
            return scan(path, resources)
    state = path.stat()
    found = _read_columns(path, start, tuple(time), (state.st_mtime_ns, state.st_size))
    if found is None:
        raise BagError(f'{path} is not a bag: it looks like {_look(start)}; ctsid reads rosbag2 '
                       '(.mcap, .db3), ROS 1 (.bag), PX4 ULog, ArduPilot .bin, CSV (rows of '
                       'numbers, titles above) and Parquet')
    return found


@lru_cache(maxsize=2)  # they are read whole, and opened again for the record after the channels
def _read_columns(path: Path, start: bytes, time: tuple[str, ...], state: tuple[int, int]
                  ) -> Recording | None:
    """Read a file that is made of columns; None if it is none."""
    if start.startswith(ulog_file.MAGIC):
        return ulog_file.scan_ulog(path)
    if start.startswith(ardupilot_file.MAGIC):
        return ardupilot_file.scan_ardupilot(path)
    if start.startswith(parquet_file.MAGIC):
        return parquet_file.scan_parquet(path, time)
    return None if start.startswith(tuple(LOOKS)) else csv_file.scan_csv(path, time)


def _metadata(folder: Path) -> tuple[list[str], int | None, list[str]]:
    """Return file names and message count of metadata.yaml, as far as it can be read."""
    path = folder / 'metadata.yaml'
    if not path.is_file():
        return [], None, []
    try:
        stated = yaml.safe_load(path.read_text('utf-8'))['rosbag2_bagfile_information']
        names = [Path(name).name for name in stated['relative_file_paths']]
        return names, int(stated['message_count']), []
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError) as error:
        return [], None, [f'{folder.name}: metadata.yaml is not usable '
                          f'({type(error).__name__}) and not needed']


def _unpack(path: Path, resources: ExitStack) -> Path:
    """Decompress a file into a temporary folder; as much of it as is there."""
    folder = Path(resources.enter_context(tempfile.TemporaryDirectory(prefix='ctsid-')))
    target = folder / (path.name.removesuffix('.zstd') if path.suffix == '.zstd' else path.name)
    with path.open('rb') as packed, target.open('wb') as file:
        try:
            unpacker = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            with unpacker:
                shutil.copyfileobj(unpacker, file)
        except zstandard.ZstdError:
            pass  # the scan of what came out will tell
        except OSError as error:
            raise BagError(f'{path} cannot be unpacked to {folder}: {error.strerror}; set TMPDIR '
                           'to a folder with more space') from error
    return target


def _near(path: Path) -> str:
    folder = path.parent
    if not folder.is_dir():
        return f'; the folder {folder} does not exist either'
    names = [p.name for p in folder.iterdir()]
    near = difflib.get_close_matches(path.name, names, n=3)
    near += [name for name in names if name.startswith(f'{path.name}.') and name not in near]
    return f'; nearest: {", ".join(near)}' if near else ''


def _inner(folder: Path) -> str:
    inner = sorted({p.name for p in folder.iterdir() if p.is_dir() and files_in(p)})
    return f'; there are bags in its subfolders {", ".join(inner[:5])}: name one of them, or ' \
        'give the folder to `ctsid batch`, for models of each' if inner else ''


def _look(start: bytes) -> str:
    for magic, look in LOOKS.items():
        if start.startswith(magic):
            return look
    if b'ustar' in start[257:265]:
        return 'a tar archive (unpack it first)'
    if not start.strip(b'\0'):
        return 'zeros only: a recording whose data never reached the disk'
    try:
        text = start.decode('utf-8', errors='strict')
    except UnicodeDecodeError as error:
        if error.start < len(start) - 4:
            return f'binary data ({start[:4].hex(" ")} ...)'
        text = start[:error.start].decode('utf-8')
    if text and (text.isprintable() or '\n' in text):
        if len(text.splitlines()) == 1 and ',' in text:
            return f'titles ({text.strip()!r}) without rows of numbers below: nothing was recorded'
        return f'text ({text.splitlines()[0][:40]!r} ...)'
    return f'binary data ({start[:4].hex(" ")} ...)'
