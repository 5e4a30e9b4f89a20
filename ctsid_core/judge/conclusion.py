# SPDX-License-Identifier: Apache-2.0
"""From a model of the moving channels to the estimate of all, judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.judge.changed import NOTED, Change, most_likely_change
from ctsid_core.judge.curve import curve_gains
from ctsid_core.judge.drift import Drift, drift_of, drift_of_inputs, varying_gains
from ctsid_core.judge.evidence import Evidence
from ctsid_core.judge.excitation import excitations, rivals_apart
from ctsid_core.judge.feedback import distance_to_controller, holds, stamp_sensitivity
from ctsid_core.judge.lead import STATES, WITHIN, lead_by_search, lead_of_outputs
from ctsid_core.judge.offsets import jump_of_outputs
from ctsid_core.judge.rules import NONE, UNCORRELATED, change_note, few_sines, judge, tested
from ctsid_core.judge.unmoved import beside_rounding, rounding, stuck_outputs, unmoved_notes
from ctsid_core.likelihood.noise_gain import with_noise
from ctsid_core.likelihood.residuals import (
    by_output,
    coloured_power,
    driven,
    motion_ahead,
    residuals,
    white_part,
)
from ctsid_core.likelihood.samples import Residuals
from ctsid_core.likelihood.state_space import entry_changes, matrices_of
from ctsid_core.linear.types import Array, Matrices
from ctsid_core.model.covariance import Covariance, Rival, pole_deviation, spread
from ctsid_core.model.estimate import Estimate, RecordShare, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import whiteness
from ctsid_core.model.verdict import UNJUDGED, Excitation, Grade
from ctsid_core.search.by_prediction import changes_of_plant, in_record
from ctsid_core.search.held_out import HeldOut, held_out
from ctsid_core.search.own_past import AHEAD, HORIZONS, held_interval
from ctsid_core.search.solution import DIRECT, GROWS, NEARLY, Doubt, Solution, at_fastest
from ctsid_core.search.task import free_of, own_delays, samples_of_part
from ctsid_core.search.tried import SEARCH
from ctsid_core.signals.gaps import after_start, by_clock
from ctsid_core.signals.loop import never_rest
from ctsid_core.signals.wrapped import jumps_in_words, wrapped_channels


def conclude(solution: Solution, sought: tuple[bool, ...] = ()) -> Estimate:
    """
    Return the estimate: the model of all channels, its accuracy, and the verdict.

    `sought`: of which moving inputs the dead time was looked for; empty if of none.
    """
    coarse = rounding(solution)
    solution = replace(solution, rivals=(*solution.rivals, *beside_rounding(
        solution, coarse, sought)))
    part, fit, samples = solution.part, solution.fit, solution.samples
    effort = samples.effort
    effort.keep(0.0)
    errors = residuals(samples, fit)
    m, intensity = _matrices(solution, errors)
    last = part.parts[part.last]
    model = replace(_whole_model(last, m, solution.settings.delays(last.whole.nu), intensity),
                    actuators=solution.settings.actuators(last.whole.nu))
    moving = StateSpace(m.A, m.B, m.C, m.D, delay=tuple(solution.delay.tolist()))
    covariance = _covariance(solution, model, sought)
    deviation = np.full(model.n, np.nan) if covariance is None else \
        pole_deviation(covariance, model)
    unseen = held_out(solution)
    simulated = solution.simulated
    effort.check()
    apart = rivals_apart(samples, fit.model, () if solution.by_prediction else solution.rivals)[
        :len(last.u)]
    seen = excitations(samples, last, covariance, model, _ahead(solution), apart)
    effort.check()
    # Predictions take up what curves do: of a model found by them its plant is simulated.
    curves = curve_gains(*(simulated or (samples, fit, solution.free)),
                         solution.drifting and solution.drifting[0])
    if simulated is not None and solution.plant is not None and curves.any():
        # A controller makes curves of what disturbs the plant, which its predictor does not see.
        curves = np.where(curve_gains(*solution.source) > 0.0, curves, 0.0)
    # Last what a budget may leave out.
    asked = _asked_for_leads(sought, seen[0], model.n)
    lead = np.zeros(moving.nu) if simulated is None or not any(asked) or effort.leaves_out(
        'whether outputs answer before inputs') else lead_of_outputs(*simulated, asked)
    change = Change() if solution.refit else \
        most_likely_change(*solution.drifting) if solution.drifting is not None else \
        most_likely_change(*(simulated or solution.source), solution.smaller, *solution.telling)
    drift = _drift(solution) if solution.drifting or change.pushed or change.cost <= NOTED \
        else Drift()
    effort.check()
    evidence = _evidence(solution, errors, unseen, (change, drift), seen, model, moving,
                         deviation, curves, lead, apart)
    status, verdict = judge(evidence)
    if verdict.grade is Grade.GOOD:
        evidence = replace(evidence, stamp_sensitivity=stamp_sensitivity(solution, seen[0]),
                           spent=_spent(effort))
        status, verdict = judge(evidence)
    asked = _asked_for_leads(sought, seen[0], STATES)
    if verdict.grade is not Grade.GOOD and any(asked) and not lead.any() and not effort.over:
        lead = _lead_by_search(solution, asked)
        if lead.any():
            status, verdict = judge(replace(evidence, lead=_lead(lead, last)))
    corrupt, counts = part.corrupt()
    accepted = status is Status.OK
    return Estimate(
        status=status, settings=solution.settings,
        model=model if accepted else None, rejected_model=None if accepted else model,
        pole_std=deviation, covariance=covariance, verdict=verdict,
        fit=100.0 * (1.0 - verdict.error), held_out_fit=100.0 * (1.0 - verdict.held_out_error),
        singular_values=solution.singular_values, condition=solution.condition,
        choices=solution.choices, orders=solution.orders,
        notes=(*part.notes, *solution.notes, *corrupt, *unmoved_notes(solution, coarse),
               *(change_note(evidence, verdict.reason) if accepted else ()),
               *(f'{what}: if so, set `{setting}`' for what, setting in filter(
                   None, (evidence.wrapped, evidence.doubt)) if setting not in verdict.reason),
               *((evidence.spent,) if evidence.spent not in verdict.reason else ())),
        statistics={**counts, 'seconds_spent': effort.seconds,
                    **_about(part, change, drift)},
        records=_shares(solution) if part.several else ())


def _too_late(solution: Solution, seen: tuple[Excitation, ...]) -> Doubt | None:
    """Return that a dead time is about as long as any that is looked for, and its setting."""
    # Not of an input that no output may follow: there any dead time is as likely.
    longest = solution.free.longest
    return next(((f'the dead time of input {one.name} is near the longest that is looked for, '
                  f'{longest:.3g} s, and states may stand in for more', 'delay')
                 for one, free, delay in zip(seen, solution.free.delays, solution.delay.tolist(),
                                             strict=False)
                 if free and delay > NEARLY * longest and one.uncertainty < NONE), None)


def _whole_trim(part: Usable, m: Matrices) -> tuple[Array, Array]:
    """Return the trim of the states and of all outputs of a record, given its own model."""
    whole, y = part.whole, list(part.y)
    level = np.zeros(whole.ny) if len(y) == whole.ny else \
        np.concatenate([s.values.mean(axis=0) for s in whole.outputs])
    level[y] = m.y_trim + part.y_level - m.D @ part.u_level
    return m.x_trim - m.B @ part.u_level, level


def _whole_model(part: Usable, m: Matrices, delay: tuple[float, ...],
                 intensity: Array | None) -> StateSpace:
    """Return the model of all channels: constant ones have zero rows and columns."""
    # `m` is of the moving channels, `delay` of every input [s], `intensity` of the noise of the
    # moving outputs, a square matrix [unit^2 s], or None if it is not known.
    whole = part.whole
    n, nu, ny = len(m.A), whole.nu, whole.ny
    u, y = list(part.u), list(part.y)
    B, C, D, K = np.zeros((n, nu)), np.zeros((ny, n)), np.zeros((ny, nu)), np.zeros((n, ny))
    B[:, u], C[y], D[np.ix_(y, u)], K[:, y] = m.B, m.C, m.D, m.K
    drift, level = _whole_trim(part, m)
    noise = None if intensity is None else np.zeros((ny, ny))
    if noise is not None:
        noise[np.ix_(y, y)] = intensity
    return StateSpace(
        A=m.A, B=B, C=C, D=D, K=K, delay=delay, x_trim=drift, y_trim=level, noise=noise,
        input_names=whole.input_names, output_names=whole.output_names,
        input_units=whole.input_units, output_units=whole.output_units)


def _matrices(solution: Solution, errors: Residuals) -> tuple[Matrices, Array]:
    """Return the matrices with K, and the intensity of the innovations."""
    last, (samples, fit, _) = solution.part.last, solution.source
    if solution.plant is None:
        return with_noise(samples, fit, errors, last)
    m = solution.plant if solution.by_prediction else _with_trim(solution, last)
    return m, held_interval(samples) * np.diag(fit.power[last] * samples.size ** 2)


def _with_trim(solution: Solution, record: int) -> Matrices:
    """Return a plant that predictions found with the trim of its simulation of a record."""
    assert solution.plant is not None
    level = solution.fit.model.y0[record] * solution.samples.size
    return replace(solution.plant, x_trim=np.zeros_like(solution.plant.x_trim), y_trim=level)


def _covariance(solution: Solution, model: StateSpace,
                sought: tuple[bool, ...]) -> Covariance | None:
    """Return the covariance of the model of all channels."""
    # Dead times that were `sought` and are taken for 0 are not known, either; beside D any that
    # matters was found.
    samples, fit, free = solution.drifting or solution.source
    if not free.feedthrough:
        free = replace(free, delays=(*sought, *free.delays[len(sought):]))
    try:
        changes = entry_changes(samples, fit, free, far=solution.plant is None
                                and not solution.samples.effort.beyond(SEARCH),
                                like=solution.fit.model if solution.drifting else None)
        if solution.drifting is not None:
            nu = solution.samples.nu
            changes = changes._replace(B=changes.B[:, :, :nu], D=changes.D[:, :, :nu],
                                       delay=changes.delay[:, :nu])
        if solution.plant is not None:
            changes = changes_of_plant(*solution.source[:2], changes)
    except np.linalg.LinAlgError:
        return None
    if not all(np.isfinite(block).all() for block in changes):
        return None
    part = solution.part.parts[solution.part.last]
    return Covariance.of_entries(spread(changes, part.u, part.y, model.nu, model.ny), model,
                                 _rivals(solution, model))


def _rivals(solution: Solution, model: StateSpace) -> tuple[Rival, ...]:
    """Return the models of all channels that might be right instead."""
    last, found = solution.part.parts[solution.part.last], []
    for share, one in solution.rivals:
        m, delay = matrices_of(one, solution.samples.size), np.array(model.delay)
        delay[list(last.u)] = one.delay
        found.append(Rival(share, _whole_model(last, m, tuple(delay.tolist()), None)))
    return tuple(found)


def _evidence(solution: Solution, errors: Residuals, unseen: HeldOut,
              changing: tuple[Change, Drift],
              seen: tuple[tuple[Excitation, ...], Array, float], model: StateSpace,
              moving: StateSpace, deviation: Array, curves: Array, lead: Array,
              apart: Array) -> Evidence:
    part, power, (change, drift) = solution.part, solution.fit.power, changing
    last, effort = part.parts[part.last], solution.samples.effort
    whole = last.whole

    def everywhere(values: Array) -> Array:
        return _spread_out(values, last.y, whole.ny)

    fitted: Array = np.sqrt(solution.samples.mean(power))
    error, coloured = fitted, np.sqrt(coloured_power(errors))
    if solution.by_prediction:
        error = solution.errors_ahead[AHEAD]
        coloured = np.maximum(error, _not_white(solution, errors, error))
    share = solution.independent / solution.samples.counts.sum(axis=0)
    fixed = tuple(j for j in range(whole.nu) if j not in last.u)
    by_place = dict(zip(last.u, seen[0], strict=True))
    away, *at_once = (_spread_out(distance_to_controller(
        [p.record for p in part.parts], moving, seen[0], same), last.u, whole.nu, np.inf)
        for same in ((False, True) if moving.D.any() else (False,)))
    numbers = replace(
        UNJUDGED, excitation=tuple(by_place.get(j, Excitation(name))
                                   for j, name in enumerate(whole.input_names)),
        pole_uncertainty=float(np.max(deviation / np.maximum(
            np.abs(model.poles), 1.0 / part.length), initial=0.0)),
        whiteness=everywhere(np.array([
            whiteness(np.concatenate(parts)) for parts in by_output(errors)])),
        response_uncertainty=everywhere(seen[1]), error=everywhere(error),
        coloured_error=everywhere(coloured),
        held_out_error=everywhere(tested(unseen, fitted)),
        independent=everywhere(share), change_cost=change.cost, curve_gain=everywhere(curves))
    return Evidence(
        input_names=whole.input_names, output_names=whole.output_names, fixed_inputs=fixed,
        fixed_outputs=tuple(i for i in range(whole.ny) if i not in last.y),
        stuck=stuck_outputs(solution, moving),
        expected=everywhere(unseen.expected), untested=unseen.why,
        spent=_spent(effort),
        fitted=everywhere(fitted), driven=everywhere(
            np.zeros_like(error) if solution.by_prediction else
            driven(solution.samples, solution.fit, errors)),
        poles=model.poles, change=change, where=_where(part, change),
        worst=f', most of it of record {part.numbers[int(np.argmax(power.max(axis=1)))]}'
        if part.several else '',
        numbers=numbers, by_prediction=solution.by_prediction, unproven=solution.unproven,
        unheld=_unheld(solution, moving),
        fastest=not solution.by_prediction and at_fastest(solution.fit, solution.free),
        doubt=_too_late(solution, seen[0]) or solution.doubt, wrapped=_wrapped(part),
        distance_to_controller=away,
        lead=_lead(lead, last), apart=_spread_out(apart, last.u, whole.nu, 0.0),
        at_once=tuple(np.ravel(at_once).tolist()),
        follows_at_once=solution.doubt is not None and solution.doubt[1] == DIRECT
        and never_rest([p.record for p in part.parts]), within=seen[2], drift=drift,
        drifting=_drifting(part, drift), jumped=_jumped(solution),
        faults=part.numbered([p.whole.faults for p in part.parts]))


def _spent(effort: Effort) -> str:
    """Return what the budget has left out, in words."""
    return f'the budget of {effort.budget:.3g} s is spent; not asked, or in part, is ' \
           f'{", ".join(effort.left_out)}; raise `budget`' if effort.left_out else ''


def _unheld(solution: Solution, moving: StateSpace) -> bool:
    """Return whether modes grow that predictions found, and no input could hold."""
    growth = float(np.max(moving.poles.real, initial=0.0))
    return solution.by_prediction and growth * solution.samples.length > GROWS and not holds(
        [p.record for p in solution.part.parts], growth, bool(moving.D.any()))


def _drift(solution: Solution) -> Drift:
    """Return how the plant drifts; of one that predictions found if its predictor does, too."""
    last = solution.part.parts[solution.part.last]
    names = [last.whole.input_names[j] for j in last.u]
    if solution.drifting is not None:
        return drift_of_inputs(names, solution.fit, solution.drifting)
    if solution.refit or solution.simulated is None:
        return Drift()
    drift = drift_of(*solution.simulated)
    if drift.cost and solution.plant is not None and not drift_of(*solution.source,
                                                                  least=0.0).cost:
        drift = Drift()
    varying = varying_gains(*solution.simulated, names, [p.u_level for p in solution.part.parts])
    return max(drift, varying, key=lambda one: one.cost)


def _ahead(solution: Solution) -> float:
    """Return how far predictions go [s], within the record; infinite if there are none."""
    return np.inf if solution.plant is None else min(
        HORIZONS[-1] * held_interval(solution.source[0]), solution.samples.length)


def _lead(found: Array, part: Usable) -> Array:
    """Return by how much outputs answer before each of all inputs; 0 if hardly."""
    whole, lead = part.whole, _spread_out(found, part.u, part.whole.nu, 0.0)
    interval = np.repeat([s.period for s in whole.inputs], [s.width for s in whole.inputs])
    return np.where(lead > WITHIN * interval, lead, 0.0)


def _asked_for_leads(sought: tuple[bool, ...], seen: tuple[Excitation, ...],
                     states: int) -> tuple[bool, ...]:
    """Return of which inputs a lead may be looked for."""
    # Of sines it is a lag of the rest, and of one that moves with others no response is known.
    return tuple(asked and one.own >= UNCORRELATED and not few_sines(one, states)
                 for asked, one in zip(sought, seen, strict=False))


def _lead_by_search(solution: Solution, sought: tuple[bool, ...]) -> Array:
    part = solution.part
    samples = samples_of_part(part, solution.samples.effort)
    free = free_of(samples, own_delays(part, solution.settings))
    return lead_by_search(samples, replace(free, delays=sought), solution.delay)


def _wrapped(part: Joint) -> Doubt | None:
    """Return that a channel is an angle which wraps, and what to set of it, if one does."""
    for one in (found for usable in part.parts for found in wrapped_channels(usable.whole)):
        channel = one.name.partition('[')[0]
        return (f'the signal {one.name} jumps {jumps_in_words(one.turn, one.jumps)} '
                '(in Python, numpy.unwrap takes that back)',
                f'{channel}.turn: {one.turn!r}')
    return None


def _spread_out(values: Array, places: tuple[int, ...], count: int,
                constant: float = np.nan) -> Array:
    """Put the values of moving channels among all channels; constant ones have another."""
    out = np.full(count, constant)
    out[list(places)] = values
    return out


def _not_white(solution: Solution, errors: Residuals, ahead: Array) -> Array:
    """Return what is not white of errors ahead, over what outputs move by in that time."""
    last = solution.part.last
    record, own = solution.samples.records[last], errors[last]
    motion = np.concatenate([np.std(s.y, axis=0) for s in record.streams])
    noise = white_part((own,)) / np.maximum(motion, 1e-300)
    period = max(s.period for s in solution.part.parts[last].record.outputs)
    return np.asarray(np.sqrt(np.maximum(ahead ** 2 - noise ** 2, 0.0))
                      / motion_ahead(record, own, HORIZONS[AHEAD] * period))


def _where(part: Joint, change: Change) -> str:
    """Return when the plant changed, in words."""
    if change.record < 0:
        return ''
    whole, name = part.parts[change.record].whole, f'record {part.numbers[change.record]}'
    if not change.share:
        return f'in all of {name}'
    at = _share(part, change.record, change.share) * whole.recording.duration
    about = f'about {after_start(at)}'
    return by_clock(about, 0.0, name) if part.several else about


def _jumped(solution: Solution) -> str:
    """Return which output jumps by itself, how far and when, in words; empty if none does."""
    if solution.simulated is None:
        return ''
    part, (samples, fit, _) = solution.part, solution.simulated
    jump = jump_of_outputs(samples, fit)
    if jump.record < 0:
        return ''
    own = part.parts[jump.record]
    whole, output = own.whole, own.y[jump.output]
    when = f'about {after_start(jump.time - whole.recording.start)}'
    if part.several:
        when = by_clock(when, 0.0, f'record {part.numbers[jump.record]}')
    size = f'{jump.size * samples.size[jump.output]:.2g} {whole.output_units[output]}'.rstrip()
    return f'output {whole.output_names[output]} jumps by {size} {when}'


def _drifting(part: Joint, drift: Drift) -> str:
    """Return where the plant drifts, or when gains are others, in words."""
    if drift.record < 0 or not (drift.span or part.several):
        return ''
    name = f'record {part.numbers[drift.record]}'
    if not drift.span:
        return f' within {name}'
    duration = part.parts[drift.record].whole.recording.duration
    span = after_start(*(duration * _share(part, drift.record, at) for at in drift.span))
    return f' {by_clock(span, 0.0, name) if part.several else span}'


def _share(part: Joint, place: int, share: float) -> float:
    """Return what is a part of a record that is looked at, as a part of the whole one."""
    if place < 0:
        return float('nan')
    if not share:
        return 0.0
    own = part.parts[place]
    whole = own.whole.recording
    record = own.record if own.whole is whole else whole
    at = record.start + share * record.duration
    return float((at - whole.start) / whole.duration)


def _about(part: Joint, change: Change, drift: Drift) -> dict[str, float]:
    """Return what is known of change and drift: fits of one model and of two are in %."""
    found = {'change_cost': change.cost, 'change_share': _share(part, change.record, change.share)}
    for who, fits in (('one', change.one), ('two', change.two)):
        found |= zip((f'change_fit_{who}_before', f'change_fit_{who}_after'), fits, strict=True)
    if part.several and change.record >= 0:
        found['change_record'] = float(part.numbers[change.record])
    found['drift_cost'] = drift.cost
    for name, at in zip(('drift_from', 'drift_to'), drift.span, strict=False):
        found[name] = _share(part, drift.record, at)
    if part.several and drift.span:
        found['drift_record'] = float(part.numbers[drift.record])
    return found


def _shares(solution: Solution) -> tuple[RecordShare, ...]:
    """Return trim, fit and weight of each record; the trim is that after its last pause."""
    part, size, fit, shares = solution.part, solution.samples.size, solution.fit, []
    level, numbers = np.exp(0.5 * np.log(fit.power).mean()), np.array(part.numbers)
    for number in np.unique(numbers).tolist():
        places = np.flatnonzero(numbers == number)
        r, counts = int(places[-1]), np.maximum(solution.samples.counts[places], 1.0)
        usable, power = part.parts[r], np.average(fit.power[places], axis=0, weights=counts)
        whole, epoch = usable.whole.recording, usable.whole.epoch_ns
        own = matrices_of(fit.model, size, r) if solution.plant is None else \
            _with_trim(solution, r) if solution.predictor is not None else \
            in_record(solution.plant, fit, solution.samples, r)
        x_trim, y_trim = _whole_trim(usable, own)
        weight = float(level / np.exp(0.5 * np.log(power).mean()))
        shares.append(RecordShare(
            number, epoch + round(whole.start * 1e9), epoch + round(whole.end * 1e9),
            x_trim, y_trim,
            _spread_out(100.0 * (1.0 - np.sqrt(power)), usable.y, whole.ny), weight))
    return tuple(shares)
