# SPDX-License-Identifier: Apache-2.0
"""What is known about a model when it is judged."""

from __future__ import annotations

from dataclasses import dataclass

from ctsid_core.judge.changed import Change
from ctsid_core.judge.drift import Drift
from ctsid_core.judge.unmoved import Stuck
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.verdict import Verdict
from ctsid_core.search.solution import Doubt


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """The evidence on a model, for all channels of the record; `numbers` has the rest."""

    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    fixed_inputs: tuple[int, ...]   # places of the channels that are constant over the window
    fixed_outputs: tuple[int, ...]
    stuck: tuple[Stuck, ...]        # outputs that stop moving within it
    # (ny,): the part of the error on what was held out that the uncertainty of the rest's model
    # lets expect, over the motion
    expected: Array
    fitted: Array                   # (ny,): what the error on that is compared with
    driven: Array                   # (ny,): rms of what inputs explain, over the motion, or 0
    distance_to_controller: Array   # (nu,): see `ctsid_core.judge.feedback`
    lead: Array                     # (nu,): see `ctsid_core.judge.lead` [s]
    apart: Array                    # (nu,): see `excitation.rivals_apart`
    poles: ComplexArray             # (n,)
    change: Change
    where: str                      # which window, or record, changed, and when
    worst: str                      # which of several records is explained least
    numbers: Verdict                # with the numbers that have a place in it
    untested: str = ''              # why nothing was held out, in words
    spent: str = ''                 # what the budget has left out, in words
    by_prediction: bool = False     # found by its predictions: errors are those of predictions
    within: float = float('inf')    # time the response is asked for [s]: as they go
    unproven: bool = False          # modes grow of which the data do not show that they do
    unheld: bool = False            # modes grow that no input could hold
    fastest: bool = False           # a pole is about as fast as any that is looked for
    # (nu,), if D is not 0: the distance to a controller that answers at once
    at_once: tuple[float, ...] = ()
    # Outputs seem to follow at once an input that never rests, though D is not allowed
    follows_at_once: bool = False
    stamp_sensitivity: float = 0.0  # see `ctsid_core.judge.feedback.stamp_sensitivity`
    drift: Drift = Drift()
    drifting: str = ''              # which of several records drifts
    doubt: Doubt | None = None      # what it looks like if a setting is not right
    wrapped: Doubt | None = None    # an angle that wraps, and what unwraps it
    jumped: str = ''                # which output jumps by itself, and when
    faults: tuple[str, ...] = ()    # of the samples, see `Record`
