# SPDX-License-Identifier: Apache-2.0
"""What models keep of where they come from: the program, and the channels."""

from __future__ import annotations

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


def described(config: Config) -> list[dict[str, object]]:
    """Return the channels as mappings, from which `Channel(**mapping)` makes them again."""
    return [{f.name: getattr(channel, f.name) for f in fields(channel)}
            for channel in config.channels]
