# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a recording, or with a node that is watched."""

from __future__ import annotations

from ctsid_core.errors import CtsidError


class BagError(CtsidError, OSError):
    """A bag that cannot be read, or that lacks what was asked of it."""


class LiveError(CtsidError):
    """A running node that cannot be watched."""


# Of no ROS release and needed for bags only, so that a node runs without them.
BAG_PACKAGES = ('mcap', 'rosbags', 'lz4', 'zstandard')


def lacks_bag_package(error: ImportError, what: str) -> str:
    """Return what to install if an import failed for want of one of them, else ''."""
    package = (error.name or '').partition('.')[0]
    if package not in BAG_PACKAGES:
        return ''
    return (f'{what} needs the Python package {package}, which is not installed here: pip install '
            f'{" ".join(BAG_PACKAGES)}')


def lacks_extra(error: ImportError, what: str, extra: str) -> str:
    """Return what to install where an optional library is missing."""
    package = (error.name or str(error)).partition('.')[0]
    return (f'{what}, ctsid needs the Python package {package}, which is not installed here: pip '
            f'install {package} (it is the extra `{extra}` of ctsid)')
