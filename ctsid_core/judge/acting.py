# SPDX-License-Identifier: Apache-2.0
"""What acts of inputs, beside a drift, curves, and a change, which may explain as much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.judge.changed import NOTED, most_likely_change, numbers_of
from ctsid_core.judge.slopes import SEARCHED, slopes_of
from ctsid_core.likelihood.residuals import independent, mean_square, residuals
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array
from ctsid_core.search.actuators import SURELY
from ctsid_core.search.solution import Doubt, Solution
from ctsid_core.search.tried import parameters, tried
from ctsid_core.settings import Actuator
from ctsid_core.signals.actuators import in_words

_MOST = 0.5           # of the error of a drift that is not noise, that what acts may leave


def explained_best(solution: Solution, acted: Solution) -> Solution:
    """
    Return the model of what acts, or that of what was sent if curves or changes explain as much.

    A drift, curves, or two models of what was sent may be likelier, by the independent samples of
    its errors, numbers paid: a gain that falls looks like play, a plant that changes between steps
    of two sizes like a dead zone, and drag like a limit. Where it is not surely likelier than a
    drift or a change, whatever numbers cost, or hardly explains what a drift does not, that is a
    doubt.
    """
    if solution.simulated is None or acted.simulated is None:
        return acted
    samples, fit, free = solution.simulated
    seen, one, _ = acted.simulated
    own, new = (fit.model, free), _new(solution, acted)
    fewer = numbers_of(samples, own) - numbers_of(seen, (one.model, free)) - len(new)

    def ahead(power: Array, other: Samples, more: int) -> tuple[float, float]:
        """Return by how much what leaves so much of such samples is likelier, and numbers paid."""
        errors = residuals(seen if other is samples else seen.thinned(SEARCHED), one)
        n_eff, missed = np.maximum(independent(errors), 2.0), mean_square(errors)
        left = np.where(np.isnan(power), missed, np.maximum(power, 1e-300))     # NaN: not known
        gain = float(n_eff @ np.log(missed / left))
        return gain, gain - float(np.log(np.max(n_eff))) * (more + fewer)
    thin = samples.thinned(SEARCHED)
    slopes = slopes_of(thin, own)
    curved = slopes.curved()
    _, paid = ahead(slopes.power(curved), thin, curved.numbers - slopes.rows.shape[1])
    if paid > 0.0:
        return solution
    changes, alike = [], False
    if solution.drifts is not None:
        alike = tried(*acted.simulated).unexplained > _MOST * solution.drifts.unexplained
        changes.append(ahead(solution.drifts.power, samples, solution.drifts.parameters
                             - parameters(samples, fit, free)))
    change = most_likely_change(samples, fit, free, solution.smaller, *solution.telling)
    if change.cost > NOTED and change.share > 0.0:
        before, after = ((1.0 - 0.01 * side) ** 2 for side in change.two)
        two = np.full(samples.ny, np.nan)               # that of the output of which most is left
        two[np.argmax(seen.mean(one.power))] = change.share * before + (1.0 - change.share) * after
        changes.append(ahead(two, thin, numbers_of(samples, own) + fit.model.n + samples.ny))
    if any(paid > 0.0 for _, paid in changes):
        return solution
    if alike or any(gain > -SURELY for gain, _ in changes):
        return replace(solution, doubt=_may_act(solution, *new[0]))
    return acted


def _new(solution: Solution, acted: Solution) -> list[tuple[int, str, float]]:
    """Return of which of all inputs what acts by a model, and not by another: kind and number."""
    nu = solution.part.parts[0].whole.nu
    return [(j, kind, value) for j, both in enumerate(zip(
        solution.settings.actuators(nu), acted.settings.actuators(nu), strict=True))
        for kind, known, value in zip(Actuator._fields, *both, strict=True) if value != known]


def _may_act(solution: Solution, j: int, kind: str, value: float) -> Doubt:
    """Return what may act of an input, and its setting."""
    whole = solution.part.parts[0].whole
    words, = in_words(whole.input_names[j:j + 1], [Actuator(**{kind: value})],
                      whole.input_units[j:j + 1])
    return (f'it may be that {words}, or that the plant changes or drifts: both explain as much',
            f'{whole.input_names[j].partition("[")[0]}.{kind}: {value:.3g}')
