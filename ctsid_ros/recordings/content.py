# SPDX-License-Identifier: Apache-2.0
"""What a bag is made of: its files, their state on the disk, and the hash of their content."""

from __future__ import annotations

from collections.abc import Sequence
import hashlib
from pathlib import Path

_PIECE = 1 << 20  # bytes


def all_files(bags: Sequence[str]) -> list[Path]:
    """Return all files of bags in the order of their names, metadata among them."""
    return [f for bag in map(Path, bags) for f in
            (sorted(p for p in bag.iterdir() if p.is_file()) if bag.is_dir() else [bag])]


def size(files: Sequence[Path]) -> int:
    """Return how many bytes files have."""
    return sum(f.stat().st_size for f in files)


def content_hash(files: Sequence[Path]) -> str:
    """Return the SHA-256 of files, one after the other."""
    digest = hashlib.sha256()
    for file in files:
        with file.open('rb') as stream:
            while piece := stream.read(_PIECE):
                digest.update(piece)
    return digest.hexdigest()


def state(files: Sequence[Path]) -> str:
    """Return what changes when a file is written: names, sizes and times, in a short word."""
    digest = hashlib.sha256()
    for file in files:
        found = file.stat()
        digest.update(repr((str(file.resolve()), found.st_size, found.st_mtime_ns,
                            found.st_ctime_ns)).encode())
    return digest.hexdigest()[:16]
