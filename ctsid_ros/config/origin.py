# SPDX-License-Identifier: Apache-2.0
"""What models keep of where they come from: the program, and the channels."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ctsid_ros.config.channels import Config


def package_version() -> str:
    """Return the version of ctsid."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version('ctsid')
    except PackageNotFoundError:
        return 'unknown (not installed)'


def code_digest(packages: Sequence[str], without: Collection[str] = ()) -> str:
    """
    Return a digest of code, and of the versions of NumPy and SciPy, that results depend on.

    Parameters
    ----------
    packages : sequence of str
        Names, like ctsid_core.
    without : collection of str
        Names of modules in them that do not matter.
    """
    import hashlib
    from importlib import import_module
    from importlib.metadata import version
    from pathlib import Path

    digest = hashlib.sha256(f'{version("numpy")} {version("scipy")}'.encode())
    for package in packages:
        folder = Path(str(import_module(package).__file__)).parent
        for path in sorted(p for p in folder.rglob('*.py') if p.stem not in without):
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def described(config: Config) -> list[dict[str, object]]:
    """Return the channels as mappings, from which `Channel(**mapping)` makes them again."""
    return [{f.name: getattr(channel, f.name) for f in fields(channel)}
            for channel in config.channels]
