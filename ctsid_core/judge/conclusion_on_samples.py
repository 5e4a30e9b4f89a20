# SPDX-License-Identifier: Apache-2.0
"""From a model of the raw output samples to the estimate, judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.all_channels import spread_out, whole_model
from ctsid_core.bases.preparation import Usable
from ctsid_core.judge.evidence import Evidence, examine
from ctsid_core.judge.rules import judge, pole_uncertainty
from ctsid_core.likelihood.information import entries_of
from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance, pole_deviation, spread
from ctsid_core.model.estimate import Choice, Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import EXPLAINED, UNJUDGED, Verdict
from ctsid_core.search.samples import OnSamples, density
from ctsid_core.search.samples_model import SamplesSolution
from ctsid_core.search.solution import Solution
from ctsid_core.settings import Settings
from ctsid_core.signals.stuck import stuck_outputs


def conclude_on_samples(found: OnSamples) -> Estimate:
    """Return the estimate; the numbers behind its verdict are those of a projection, if any."""
    part, solution, settings, why = found.part, found.solution, found.settings, found.why
    numbers = None if found.lines is None else _numbers(part, found.lines)
    m = solution.fit.matrices
    model = whole_model(part, m, settings.delays(part.whole.nu),
                        np.diag(density(part, solution)))
    covariance = _covariance(part, solution, settings, model)
    deviation = np.full(model.n, np.nan) if covariance is None else \
        pole_deviation(covariance, model)
    evidence = _evidence(part, solution, model, deviation, numbers)
    status, verdict = judge(evidence)
    corrupt, counts = part.corrupt()
    notes = [f'output {part.whole.output_names[j]} is not explained: fit {evidence.worst[j]:.0f} %'
             for j in part.y if evidence.worst[j] < EXPLAINED]
    ok = status is Status.OK
    return Estimate(
        status=status, settings=settings.replace(order=model.n), model=model if ok else None,
        rejected_model=None if ok else model, pole_std=deviation, covariance=covariance,
        verdict=verdict, fit=evidence.fit, held_out_fit=evidence.held_out,
        choices=_choices(solution, model.n, why), orders=solution.table,
        notes=(*(n.replace(': bridged by straight lines', '') for n in part.notes), *corrupt,
               *notes),
        statistics={**counts, 'process_noise': 0.0})


def _choices(solution: SamplesSolution, order: int, why: str) -> tuple[Choice, ...]:
    choices = [Choice('domain', 'time', f'{why}; the model was made from the samples themselves')]
    if solution.table:
        table = ', '.join(f'{one.order}: {one.criterion:.0f}' for one in solution.table)
        choices.append(Choice('order', order, "Schwarz's criterion (BIC), above its smallest "
                              f'value, by order: {table}'))
    return (*choices, Choice('noise', 'measurement', 'process noise is not estimated from samples '
                             'that cannot be interpolated'))


def _covariance(part: Usable, solution: SamplesSolution, settings: Settings,
                model: StateSpace) -> Covariance | None:
    changes = entries_of(solution.fit.root, solution.fit.matrices, settings.feedthrough,
                         delays=False)
    if not all(np.isfinite(block).all() for block in changes):
        return None
    return Covariance.of_entries(spread(changes, part.u, part.y, model.nu, model.ny), model)


def _evidence(part: Usable, solution: SamplesSolution, model: StateSpace, deviation: Array,
              numbers: Verdict | None) -> Evidence:
    whole, resolution = part.whole, 2.0 * np.pi / part.record.duration
    unknown = np.full(len(part.y), np.nan)
    known = numbers or replace(UNJUDGED, missing=unknown, missing_p_value=unknown,
                               whiteness=unknown, next_ratio=unknown)

    def everywhere(values: Array) -> Array:
        return spread_out(values, part.y, whole.ny)

    return Evidence(
        input_names=whole.input_names, output_names=whole.output_names,
        fixed_inputs=tuple(j for j in range(whole.nu) if j not in part.u),
        fixed_outputs=tuple(i for i in range(whole.ny) if i not in part.y),
        stuck=stuck_outputs(whole), fit=everywhere(solution.simulated),
        held_out=everywhere(solution.unseen), poles=model.poles, deviation=deviation,
        resolution=resolution, change='', process_noise=False,
        unexamined=numbers is None,
        numbers=replace(
            known, missing=everywhere(known.missing),
            missing_p_value=everywhere(known.missing_p_value),
            whiteness=everywhere(known.whiteness), next_ratio=everywhere(known.next_ratio),
            pole_uncertainty=pole_uncertainty(model.poles, deviation, resolution)))


def _numbers(part: Usable, found: Solution) -> Verdict:
    """Return the numbers of a verdict from the lines of interpolated outputs."""
    nothing = np.full(len(found.matrices.C), np.nan)
    return examine(found.projection, found.matrices, [part.record], nothing,
                   feedthrough=found.settings.feedthrough)
