# SPDX-License-Identifier: Apache-2.0
"""What a model makes of data that it has not seen, beside what its own let expect."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from ctsid_core.likelihood.residuals import coloured_power
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import Validation, prediction, simulation
from ctsid_core.search.held_out import allowed
from ctsid_core.search.own_past import AHEAD, HORIZONS
from ctsid_core.search.solution import DISTURBED
from ctsid_core.signals.record import Record


def as_judged(estimate: Estimate, model: StateSpace, record: Record, *,
              trim: Literal['model', 'refit'] = 'model') -> Validation:
    """Return a record beside a model, simulated or predicted: as the fits of its estimate are."""
    if not estimate.by_predictions:
        return simulation(model, record, trim=trim)
    if trim == 'refit':
        offset = simulation(model, record, trim=trim).offset
        model = replace(model, y_trim=model.y_trim + offset)
    return prediction(model, record, HORIZONS[AHEAD])


def failure(estimate: Estimate, found: Validation, record: Record, *, partly: bool = False
            ) -> str:
    """
    Return which outputs a model explains as badly as a part held out must not be, or nothing.

    `found` is what it makes of data that it has not seen, see `as_judged`. Errors are parts of the
    motion of a record: of all that is known of the plant's. `partly`: the model was identified
    from parts of it.
    """
    motion = np.concatenate([s.values.std(axis=0) for s in record.outputs])
    told = []
    # Noise, there and here, is no fault of the model.
    for i, limit in enumerate(np.minimum(allowed(estimate.verdict.coloured_error), DISTURBED)):
        e = (found.y - found.y_hat)[:, [i]]
        e = e[~np.isnan(e[:, 0])]
        with np.errstate(over='ignore', invalid='ignore'):      # a diverged simulation
            coloured = coloured_power(((e,),))[0]
        if not (np.isnan(found.fit[i]) or coloured <= (limit * motion[i]) ** 2):
            here, own = (np.round(fit[i], 1) + 0.0 for fit in (found.fit, estimate.fit))  # no -0.0
            told.append(f'{here} % of {record.output_names[i]} here, {own} % of its own data')
    return '' if not told else (f'the model explains {"; ".join(told)}: ' + (
        'the other parts of this recording move otherwise (farther, slower, in gusts), or the '
        'plant changed within it' if partly else
        'the plant is not the same (payload, battery, gains), or it moves otherwise than there '
        '(farther, faster, in gusts)'))
