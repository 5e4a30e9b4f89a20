# SPDX-License-Identifier: Apache-2.0
"""How models do on data they have not seen: the rest of their records, and other records."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.likelihood.output_error import (
    Fit,
    Free,
    climb_roughly,
    errors_of,
    fit_at,
    fit_states,
    jacobian,
)
from ctsid_core.likelihood.residuals import coloured_power, independent, mean_square, residuals
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import GAUGE, modal_of
from ctsid_core.linear.least_squares import orthonormal
from ctsid_core.linear.matrix_functions import SOUND
from ctsid_core.linear.types import Array, Mask
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import Validation, prediction, simulation
from ctsid_core.search.by_prediction import plant_of
from ctsid_core.search.own_past import AHEAD, HORIZONS
from ctsid_core.search.solution import DISTURBED, Solution
from ctsid_core.signals.gaps import GAP_PERIODS
from ctsid_core.signals.record import Record

_PARTS = 3            # of each record are held out
_SEARCHED = 2000      # samples of a stream that are looked at
_MORE = 3.0           # times its own error, that a model may err on data held out ...
_LEAST = 0.05         # ... or this part of the motion; no test if ...
_EXPECTED = 2.0       # ... so many deviations that the rest of the data leaves are more
_NO_MODEL = 'the rest of them alone gives no such model'


@dataclass(frozen=True)
class HeldOut:
    """Errors on samples that a model has not seen, (ny,); NaN if nothing was held out."""

    error: Array     # rms, over the motion of the whole window
    # The part of it that is to be expected, because the rest of the data leaves the model
    # uncertain: after the only step nobody can tell what the step would have shown
    expected: Array
    unseen: Mask     # whether most of the motion by any of the inputs is in what is held out
    why: str = ''    # nothing was held out, in words


def held_out(solution: Solution) -> HeldOut:
    """
    Return the errors on the share of the samples that is held out.

    The ends of the thirds of each record, so that sweeps and steps, and axes that are moved one
    after the other, are in both: the model of the rest, with the poles of the whole refined there,
    runs through them, with its states and its trim. Of a model that only predictions tell:
    one-step predictions. A method that refits makes the model of the first part, else output error
    does, or predictions by which the plant was found.
    """
    samples, fit, free = solution.samples, solution.fit, solution.free
    share, refit = solution.settings.share_held_out, solution.refit
    if share == 0.0:
        return _nothing(samples, 'none are asked for (`validation.held_out`, or `hermite.edges`)')
    if len(samples.records) > 1:        # too short for other methods, if they are many
        refit = None
    samples, count = samples.thinned(_SEARCHED), _PARTS if refit is None else 1

    def kept(whole: Samples) -> Samples:
        return _parts(whole, share, False, count)

    def of(early: Samples) -> Fit | None:
        if refit is not None:
            return refit(early)
        if solution.predictor is None:
            # From the residues of the whole: of poles that are alike no others tell them.
            near = fit_states(early, fit.model, free)
            return climb_roughly(early, fit_at(early, *fit.model.nonlinear, free, near), free)
        joint, top, own = solution.predictor
        rest = kept(joint.thinned(_SEARCHED))
        top = climb_roughly(rest, fit_at(rest, *top.model.nonlinear, own), own)
        m = plant_of(top, rest, 0, free.limit, predicts=False)
        # Two integrators hardly differ; here six digits are enough.
        plant = None if m is None else modal_of(m, early, top.model.delay[:samples.nu], SOUND)
        return None if plant is None else fit_states(early, plant, free)

    try:
        early, late = kept(samples), _parts(samples, share, True, count)
        if np.min(early.counts.mean(axis=0)) < 4 * fit.model.n + 4:
            return _nothing(samples, 'too few samples would be left for the model')
        own = of(early)
        if own is None:
            return _nothing(samples, _NO_MODEL)
        there, everywhere = (_motion(part, fit) for part in (late, samples))
        error = np.sqrt(mean_square(residuals(late, own)))
        return HeldOut(error, np.zeros(samples.ny) if refit is not None else
                       _expected(early, late, own, free),
                       np.any(there > 0.5 * everywhere, axis=0))
    except np.linalg.LinAlgError:
        return _nothing(samples, _NO_MODEL)


def _nothing(samples: Samples, why: str) -> HeldOut:
    none = np.full(samples.ny, np.nan)
    return HeldOut(none, none, np.zeros(samples.ny, dtype=bool), why)


def allowed(error: Array) -> Array:
    """Return the error that a model may have on a part held out, by its own error."""
    return np.asarray(np.maximum(_MORE * error, _LEAST))


def unsure(expected: Array, error: Array) -> Mask:
    """Return whether the rest cannot tell what to expect: what is held out tests nothing."""
    return np.asarray(_EXPECTED * expected > allowed(error))


def _parts(samples: Samples, share: float, held: bool, count: int) -> Samples:
    """Return the samples in the parts of each record that are held out, or those in the others."""
    def kept(times: Array, start: float, end: float) -> Mask:
        phase = np.mod((times - end) / (end - start) * count, 1.0)     # the last part ends it
        return np.asarray((phase > 1.0 - share) == held)

    return replace(samples, records=tuple(
        replace(r, streams=tuple(s.of(kept(s.times, r.start, r.end)) for s in r.streams))
        for r in samples.records))


def _motion(samples: Samples, fit: Fit) -> Array:
    """Return the squares of what each input alone moves from sample to sample, (nu, ny)."""
    found, model = np.zeros((samples.nu, samples.ny)), fit.model
    columns = columns_of(samples, *model.nonlinear, direct=bool(model.D.any()),
                         turned=False, slopes=False)
    everything = errors_of(samples, model, columns)
    for j, squares in enumerate(found):
        others = np.arange(samples.nu) != j
        without = errors_of(samples, replace(
            model, b=model.b * others, D=model.D * others), columns)
        for errors, left, record in zip(everything, without, samples.records, strict=True):
            for e, rest, s in zip(errors, left, record.streams, strict=True):
                moves = np.diff(rest - e, axis=0)
                # Not over what is left out between parts.
                near = np.diff(s.times) < GAP_PERIODS * s.period
                squares[s.channels] += np.sum(moves[near] ** 2, axis=0)
    return found


def _expected(early: Samples, late: Samples, own: Fit, free: Free) -> Array:
    """Return the rms error that a model's own uncertainty lets expect on other samples, (ny,)."""
    rows, _, _ = jacobian(early, own, free)
    there = replace(own, columns=columns_of(late, *own.model.nonlinear, direct=free.feedthrough))
    seen, _, _ = jacobian(late, there, free)
    moved = np.sum((seen @ orthonormal(rows, GAUGE)) ** 2, axis=1)
    squares, at = np.zeros(late.ny), 0
    for r, triangles in enumerate(there.columns.triangles):
        for t in triangles:
            for i in t.channels:
                squares[i] += own.power[r, i] * np.sum(moved[at:at + len(t.y)])
                at += len(t.y)
    counts = early.counts.sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(late.counts.sum(axis=0), 1.0) * counts
                              / independent(residuals(early, own))))


def as_judged(estimate: Estimate, model: StateSpace, record: Record, *,
              trim: Literal['model', 'refit'] = 'model') -> Validation:
    """Return a record beside a model, simulated or predicted: as the fits of its estimate are."""
    if not estimate.by_predictions:
        return simulation(model, record, trim=trim)
    if trim == 'refit':
        offset = simulation(model, record, trim=trim).offset
        model = replace(model, y_trim=model.y_trim + offset)
    return prediction(model, record, HORIZONS[AHEAD])


def failure(estimate: Estimate, found: Validation, record: Record, *, partly: bool = False) -> str:
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
