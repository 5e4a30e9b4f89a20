# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a recording."""

from __future__ import annotations

from ctsid_core.errors import CtsidError


class BagError(CtsidError, OSError):
    """A bag that cannot be read, or that lacks what was asked of it."""
