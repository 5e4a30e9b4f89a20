# SPDX-License-Identifier: Apache-2.0
"""CT-PBSID by Laguerre filters: the older variant, which the projections have replaced."""

from __future__ import annotations

from collections.abc import Sequence

from ctsid_core.bases.records import Joint
from ctsid_core.settings import Settings
from ctsid_core.subspace.ct_pbsid import by_projection
from ctsid_core.subspace.interface import Method, MethodModel


def by_filtering(part: Joint, settings: Settings, orders: Sequence[int]) -> list[MethodModel]:
    """Return the models by Laguerre filters, of every order, pole and past left open."""
    return by_projection(part, settings, orders, 'back')


FILTERS = Method(by_filtering)
