# SPDX-License-Identifier: Apache-2.0
"""From a model of the moving channels to the estimate of all, judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.all_channels import spread_out, whole_model, whole_trim
from ctsid_core.bases.projection import as_real, of_records
from ctsid_core.bases.records import Joint
from ctsid_core.judge.change import ChangedRecord, most_likely_changed_record
from ctsid_core.judge.evidence import Evidence, examine
from ctsid_core.judge.rules import PREDICTED, judge, pole_uncertainty
from ctsid_core.likelihood.information import entry_changes
from ctsid_core.likelihood.prediction_errors import line_fit, predicted_fit, prediction_errors
from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance, pole_deviation, spread
from ctsid_core.model.estimate import Estimate, RecordShare, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import EXPLAINED
from ctsid_core.search.held_out import HeldOut
from ctsid_core.search.solution import Solution
from ctsid_core.signals.stuck import stuck_outputs


def conclude(part: Joint, solution: Solution, tested: HeldOut) -> Estimate:
    """
    Return the estimate: the model of all channels, its accuracy, and the verdict.

    Parameters
    ----------
    part : Joint
        The records.
    solution : Solution
        Made of them.
    tested : HeldOut
        The fit of a model of their first parts on the last.
    """
    model = _to_statespace(part, solution)
    covariance = _covariance(part, solution, model)
    deviation = np.full(model.n, np.nan) if covariance is None else \
        pole_deviation(covariance, model)
    evidence = _evidence(part, solution, tested, model.poles, deviation)
    status, verdict = judge(evidence)
    # The test is for a model at the maximum of the likelihood.
    testable = solution.settings.refine and (status is Status.OK or part.several)
    differing = most_likely_changed_record(
        solution.projection, solution.matrices, solution.settings, solution.layout) \
        if testable and np.isfinite(solution.matrices.A).all() else ChangedRecord()
    change = differing.change
    last: tuple[str, ...] = ()
    if change.matters:
        reason, note = _changed(part, differing)
        status, verdict = judge(replace(evidence, change=reason))
        last = (note,)
    corrupt, counts = part.corrupt()
    return Estimate(
        status=status, settings=solution.settings, model=model if status is Status.OK else None,
        rejected_model=None if status is Status.OK else model,
        pole_std=deviation, covariance=covariance, verdict=verdict,
        fit=evidence.fit, held_out_fit=evidence.held_out,
        singular_values=solution.singular_values,
        condition=solution.condition, choices=solution.choices, orders=solution.orders,
        notes=(*part.notes, *corrupt, *_remarks(part, evidence), *last),
        statistics={**counts, 'process_noise': float(solution.process_noise),
                    'change_p_value': change.p_value, 'change_size': change.size,
                    'change_gain': change.gain, 'change_share': _share(part, differing)},
        records=_shares(part, solution) if part.several else ())


def _remarks(part: Joint, evidence: Evidence) -> list[str]:
    """Return a sentence on each output that is not explained."""
    names, worst = evidence.output_names, evidence.worst
    return [f'output {names[j]} is not explained: fit {worst[j]:.0f} %'
            for j in part.parts[0].y if worst[j] < evidence.enough]


def _evidence(part: Joint, solution: Solution, tested: HeldOut, poles: NDArray[np.complex128],
              deviation: Array) -> Evidence:
    """Return the evidence on a model, but for a change of the plant."""
    last, projection, m = part.parts[part.last], solution.projection, solution.matrices
    whole, resolution = last.whole, 2.0 * np.pi / part.length
    numbers = examine(projection, m, [p.record for p in part.parts], tested.density,
                      feedthrough=solution.settings.feedthrough)

    def everywhere(values: Array) -> Array:
        return spread_out(values, last.y, whole.ny)

    return Evidence(
        input_names=whole.input_names, output_names=whole.output_names,
        fixed_inputs=tuple(j for j in range(whole.nu) if j not in last.u),
        fixed_outputs=tuple(i for i in range(whole.ny) if i not in last.y),
        stuck=tuple(one for p in part.parts for one in stuck_outputs(p.whole)),
        fit=everywhere((predicted_fit if solution.by_prediction else line_fit)(projection, m)),
        held_out=everywhere(tested.fit),
        poles=poles, deviation=deviation, resolution=resolution, change='',
        process_noise=solution.process_noise,
        enough=PREDICTED if solution.by_prediction else EXPLAINED,
        numbers=replace(
            numbers, missing=everywhere(numbers.missing),
            missing_p_value=everywhere(numbers.missing_p_value),
            whiteness=everywhere(numbers.whiteness), next_ratio=everywhere(numbers.next_ratio),
            pole_uncertainty=pole_uncertainty(poles, deviation, resolution)))


def _share(part: Joint, differing: ChangedRecord) -> float:
    """Return where the change lies, as a part of the whole record: it may begin earlier."""
    own = part.parts[differing.place]
    at = own.record.start + differing.change.share * own.record.duration
    return (at - own.whole.start) / own.whole.duration


def _changed(part: Joint, differing: ChangedRecord) -> tuple[str, str]:
    """Return a sentence on a change of the plant that says what to do, and a note."""
    change, place = differing.change, differing.place
    if not differing.within:
        numbers = part.numbers
        who = f'records {numbers[0]} and {numbers[1]} show different plants' \
            if len(numbers) == 2 else \
            f'record {numbers[place]} shows another plant than the other records'
        cure = 'each' if len(numbers) == 2 else 'it'
        note = (f'{who}: the responses to the inputs differ by {100 * change.size:.0f} %; '
                f'identify {cure} separately')
        return f'{note[0].upper()}{note[1:]}.', note
    share = _share(part, differing)
    at = f'{share * part.parts[place].whole.duration:.2g} s after'
    where = f'record {part.numbers[place]}' if part.several else 'the window'
    prefix = f'{where}: ' if part.several else ''
    return (f'The plant, or the offset of a signal, changed about {at} the start of {where}; take '
            'a window before or after that, or wait until it has left the window.',
            f'{prefix}the most likely time of the change is {share * 100:.0f} % of the '
            f'window, {at} its start')


def _shares(part: Joint, solution: Solution) -> tuple[RecordShare, ...]:
    """Return trim, fit and weight of each record."""
    matrices, projection, shares = solution.matrices, solution.projection, []
    for i, (usable, p, m) in enumerate(zip(part.parts, projection.records,
                                           of_records(matrices, projection), strict=True)):
        whole, epoch = usable.whole, usable.whole.epoch_ns
        x_trim, y_trim = whole_trim(usable, m)
        shares.append(RecordShare(
            part.numbers[i], epoch + round(whole.start * 1e9), epoch + round(whole.end * 1e9),
            x_trim, y_trim, spread_out(line_fit(p, m), usable.y, whole.ny),
            solution.layout.weights[i]))
    return tuple(shares)


def _covariance(joint: Joint, solution: Solution, model: StateSpace) -> Covariance | None:
    """Return the covariance of the entries of the model of all channels; None if not finite."""
    changes = entry_changes(solution.projection, solution.matrices, solution.settings.feedthrough,
                            process_noise=solution.process_noise)
    if not all(np.isfinite(block).all() for block in changes):
        return None
    part = joint.parts[0]
    return Covariance.of_entries(spread(changes, part.u, part.y, model.nu, model.ny), model)


def _to_statespace(joint: Joint, solution: Solution) -> StateSpace:
    """Return the model of all channels."""
    part, weight = joint.parts[joint.last], solution.layout.weights[joint.last]
    error = as_real(prediction_errors(solution.projection, solution.matrices))
    intensity = solution.projection.unit * (error @ error.T) / error.shape[1] / weight ** 2
    return whole_model(part, of_records(solution.matrices, solution.projection)[joint.last],
                       solution.settings.delays(part.whole.nu), intensity)
