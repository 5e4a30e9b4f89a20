# SPDX-License-Identifier: Apache-2.0
"""The folder of a batch: which bags are done, and what is of no use any more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ctsid_core.errors import StorageError
from ctsid_ros.batch.rows import AGAIN, FAILURE, SUFFIX, Made, made_of
from ctsid_ros.batch.task import Recipe
from ctsid_ros.recordings.content import all_files, state

ROWS = 'rows'


class Store:
    """
    The rows of a batch.

    Parameters
    ----------
    folder : Path
        Of results; rows are in its folder ROWS, a file for each bag.
    recipe : Recipe
    force : bool
        Remove what is of other parameters or another version.
    retry : bool
        Remove the failures, so that these bags are tried again.

    Raises
    ------
    StorageError
        If it has rows of other parameters or another version, unless `force` is given.
    """

    def __init__(self, folder: Path, recipe: Recipe, *, force: bool = False,
                 retry: bool = False) -> None:
        self.folder, self._recipe = folder / ROWS, recipe
        self._seen: dict[tuple[Path, int], Made | None] = {}
        other = [path for path, made in self._all().items() if made.recipe != recipe.key]
        if other and not force:
            raise StorageError(f'{self.folder} has rows of {len(other)} bags that were made with '
                               'other parameters or another version of ctsid; choose another '
                               'folder with --out, or add --force to replace them')
        failed = [path for path, made in self._all().items() if made.outcome == FAILURE and retry]
        for path in (*other, *failed):
            path.unlink()

    def done(self, bags: Sequence[str]) -> dict[str, Path]:
        """Return the files of rows of those bags that are done and were not written since."""
        found = {}
        for path, made in self._all().items():
            if made.outcome != AGAIN and made.recipe == self._recipe.key:
                found[made.bag, made.state] = path
        keys = {bag: (bag, _state(bag)) for bag in bags}
        return {bag: found[key] for bag, key in keys.items() if key in found}

    def rows(self, bags: Sequence[str]) -> dict[str, Path]:
        """Return the files of rows of bags, whatever came of them; remove those of old content."""
        done, files, wanted = self.done(bags), self._all(), set(bags)
        used = set(done.values())
        contents = {files[path].content for path in done.values()}
        found = dict(done)
        for path, made in files.items():
            moved = made.content in contents and not Path(made.bag).exists()
            if made.bag not in done and made.bag in wanted:
                found[made.bag] = path
            elif path not in used and (made.bag in done or moved):
                path.unlink()
        return {bag: found[bag] for bag in bags if bag in found}

    def _all(self) -> Mapping[Path, Made]:
        found = {}
        for path in sorted(self.folder.glob(f'*{SUFFIX}')):
            key = path, path.stat().st_mtime_ns
            if key not in self._seen:
                self._seen[key] = made_of(path)
            if made := self._seen[key]:
                found[path] = made
        return found


def _state(bag: str) -> str:
    try:
        return state(all_files([bag]))
    except OSError:
        return ''
