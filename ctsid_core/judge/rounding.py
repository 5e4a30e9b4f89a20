# SPDX-License-Identifier: Apache-2.0
"""
Outputs with few values, whose rounding a model may follow as if the plant moved so.

Rounding to a step q moves an output by q^2 / 12 in the mean square (Widrow and Kollar,
Quantization Noise, 2008). As long as it is another one at every sample it is noise like any other;
of inputs that repeat, and at rest, it repeats, too, and states are found that explain it. A model
that misses less than rounding moves does that: how the output itself moves is known no better.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ctsid_core.judge.excitation import rivals_apart
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.linear.types import Array
from ctsid_core.search.solution import Solution
from ctsid_core.search.tried import ENOUGH, parameters


def rounding(solution: Solution) -> Array:
    """Return what a model follows of the rounding of each output, over its motion, (ny,)."""
    samples, fit = solution.samples, solution.fit
    # Of noise numbers explain as many samples.
    noise = 1.0 - parameters(samples, fit, solution.free) / samples.counts.sum()
    followed = np.sqrt(np.maximum(
        noise * (_steps(solution) / samples.size) ** 2 / 12.0 - samples.mean(fit.power), 0.0))
    return np.where(followed > ENOUGH, followed, 0.0) * (not solution.by_prediction)


def beside_rounding(solution: Solution, followed: Array) -> list[tuple[float, ModalModel]]:
    """Return models with other gains, and other dead times, that are as far away as that."""
    if not followed.any():
        return []
    samples, model = solution.samples, solution.fit.model
    away = rivals_apart(samples, model, [(1.0, replace(
        model, delay=model.delay + samples.interval))])
    late = np.minimum(samples.interval * np.max(followed) / np.maximum(away, 1e-300),
                      solution.free.longest)
    more = 1.0 + followed[:, np.newaxis]
    return [(0.5, replace(model, c=more * model.c, D=more * model.D)),
            (0.5, replace(model, delay=model.delay + late))]


def rounding_notes(solution: Solution, followed: Array) -> Iterator[str]:
    """Yield which outputs have so few values, and what to do."""
    last = solution.part.parts[solution.part.last]
    for place, step, share in zip(last.y, _steps(solution), followed, strict=True):
        if share:
            yield (f'output {last.whole.output_names[place]} is measured in steps of {step:.3g}, '
                   'and the model follows these steps: how it moves between them is known to '
                   f'{100.0 * share:.2g} % of its motion; move inputs more, or less regularly, or '
                   'measure it more finely')


def _steps(solution: Solution) -> Array:
    """Return the smallest step of each moving output from one sample to the next; 0 if none."""
    steps = [np.abs(np.diff(s.values[s.rows(part.record.start, part.record.end)], axis=0))
             for part in solution.part.parts for s in part.record.outputs]
    least = [np.min(own, axis=0, where=own > 0.0, initial=np.inf) for own in steps]
    found = np.min(np.concatenate(least).reshape(len(solution.part.parts), -1), axis=0)
    return np.where(np.isfinite(found), found, 0.0)
