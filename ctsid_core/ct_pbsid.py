# SPDX-License-Identifier: Apache-2.0
"""Continuous-time PBSID in the Laguerre domain."""

from __future__ import annotations

from collections.abc import Sequence

from ctsid_core.joint import Joint
from ctsid_core.other_method import Made
from ctsid_core.settings import Settings


def by_projection(part: Joint, settings: Settings, orders: Sequence[int]) -> list[Made]:
    """Return the models by Laguerre projections."""
    return []


def by_filtering(part: Joint, settings: Settings, orders: Sequence[int]) -> list[Made]:
    """Return the models by Laguerre filters."""
    return []
