# SPDX-License-Identifier: Apache-2.0
"""A model of the moving channels, before it is judged."""

from __future__ import annotations

from dataclasses import dataclass

from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.projection import Projection
from ctsid_core.bases.records import Layout
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Choice, OrderTried
from ctsid_core.search.order import Search
from ctsid_core.settings import Settings


@dataclass(frozen=True, eq=False)
class Solution:
    """
    A model of the moving channels, and how it was identified.

    Parameters
    ----------
    settings : Settings
        As used: automatic values filled in.
    projection : Projection
        Of the records.
    search : Search
        Of the subspace models.
    matrices : Matrices
    singular_values : ndarray
        Of the subspace model that it began from.
    condition : float
        Of its regression.
    process_noise : bool
        Whether it is an innovation form with its K, or an output-error model.
    choices : tuple of Choice
    layout : Layout
        How the records were projected.
    by_prediction : bool
        Whether the plant is unstable, with process noise: simulations mean nothing.
    noise_model_uncertain : bool
        Whether process noise is accepted for lack of a better explanation only.
    orders : tuple of OrderTried
        Empty if the order was given.
    """

    settings: Settings
    projection: Projection
    search: Search
    matrices: Matrices
    singular_values: Array
    condition: float
    process_noise: bool
    choices: tuple[Choice, ...]
    layout: Layout
    orders: tuple[OrderTried, ...] = ()
    by_prediction: bool = False
    noise_model_uncertain: bool = False


def own_delays(part: Usable, settings: Settings) -> Settings:
    """Return the settings with the dead times of the moving inputs only."""
    if not isinstance(settings.delay, tuple):
        return settings
    delays = settings.delays(part.whole.nu)
    return settings.replace(delay=tuple(delays[j] for j in part.u))
