# SPDX-License-Identifier: Apache-2.0
"""
Inputs that only answer to the outputs, as those of a controller that holds a plant in place.

Then inputs and outputs tell of the controller, u = -C y, at least as much as of the plant, and a
model of y by u may be -1/C, however well it fits. What else moves an input, a set point or an
experiment, shows in how it changes: the outputs' past does not tell that.

References
----------
Ljung, System Identification, 2nd edition, section 13.4 (closed loop, informative data).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.types import Array
from ctsid_core.signals.record import Record, Signal

_PAST = 20            # samples of an input, over which the outputs are looked at
_EACH = 6             # changes for each number, at least
_TOLERANCE = 1e-10    # of regressors that depend on each other
_SMOOTH = 1e-10       # power of changes that its own past does not tell: less, and it tells all


def answers(records: Sequence[Record]) -> Array:
    """
    Return how much of its changes each input owes to more than the outputs, (nu,).

    The power of the changes that the outputs' past does not tell, over the power that the input's
    own past does not tell: 1 or more of an input that a person moves, 0 of what a controller
    computes from the outputs alone. Of several records that with the largest.
    """
    return np.max([np.concatenate([_of_signal(s, r) for s in r.inputs]) for r in records], axis=0)


def _of_signal(signal: Signal, record: Record) -> Array:
    rows = signal.rows(record.start, record.end)
    times, values = signal.time[rows], signal.values[rows]
    # What an input is computed from has the same stamp or an earlier one.
    outputs = np.column_stack([
        s.values[np.maximum(np.searchsorted(s.time, times, side='right') - 1, 0)]
        for s in record.outputs])[1:]
    found = np.ones(signal.width)
    past = min(_PAST, len(outputs) // (_EACH * outputs.shape[1]))
    if past > 0:
        for j, changes in enumerate(np.diff(values, axis=0).T):
            own = _left(changes[:-1, np.newaxis], changes[1:], past)
            if own > _SMOOTH * np.mean(changes ** 2):
                found[j] = _left(outputs, changes, past) / own
    return found


def _left(regressors: Array, targets: Array, past: int) -> float:
    """Return the mean square of what so many rows of regressors up to each do not tell of it."""
    count = len(targets) - past + 1
    columns = [regressors[past - 1 - k:past - 1 - k + count].T for k in range(past)]
    known = np.vstack((*columns, np.ones((1, count))))
    wanted = targets[np.newaxis, past - 1:]
    left = wanted - least_norm(known, wanted, _TOLERANCE) @ known
    return float(np.sum(left ** 2)) / max(count - len(known), 1)
