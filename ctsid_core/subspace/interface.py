# SPDX-License-Identifier: Apache-2.0
"""What a subspace method has to give: models of the moving channels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from ctsid_core.bases.records import Joint
from ctsid_core.linear.types import Array, Matrices
from ctsid_core.settings import Settings

SLOWEST = 10.0      # least pole to look for, times the length of the record


@dataclass(frozen=True, eq=False)
class MethodModel:
    """A continuous-time model of the moving channels, one of those that a method offers."""

    matrices: Matrices      # what belongs to single records does not count
    # with the order and whatever the method chose filled in: they give this model
    settings: Settings
    singular_values: Array  # whose drop shows the order
    condition: float        # condition number of the regression
    # B, C and D are then those of the best simulation with its poles
    poles_only: bool = False


@dataclass(frozen=True)
class Method:
    """A row of the table of methods."""

    # From the records, the settings, the orders that are wanted and what is called often to all
    # models that the method has to offer: of every order and every tuning that the settings leave
    # open. Orders that the data are too short for are left out.
    models: Callable[[Joint, Settings, Sequence[int], Callable[[], None]], Iterator[MethodModel]]
    # Whether its models are taken to the maximum of the likelihood, with dead times that are not
    # given; else they stay as they are made, the likeliest is taken, and those count as 0.
    refines: bool = False
