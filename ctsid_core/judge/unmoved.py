# SPDX-License-Identifier: Apache-2.0
"""
Outputs that inputs do not move: stuck ones, rounding, and oscillations that last.

A sensor hangs, or a driver repeats its last value. Coarse sensors repeat values as well, while the
plant moves by less than they resolve: at rest, and for as long after it as dead time and lags
take. So the model is asked: the one that was found, taken to the maximum of the likelihood of all
other samples, for what is stuck spoils it. The output is stuck where inputs alone, whatever the
state was at first, move that model by more than what the sensor resolves and than what the model
misses elsewhere; or where there is noise elsewhere.

Rounding to a step q moves an output by q^2 / 12 in the mean square (Widrow and Kollar,
Quantization Noise, 2008). As long as it is another one at every sample it is noise like any other;
of inputs that repeat, and at rest, it repeats, too, and states are found that explain it. A model
that misses less than rounding moves does that: how the output itself moves is known no better.

Hum, a vibration, waves: what lasts is explained by an initial state, and its samples by two states
of the model. If inputs move these by less than what the model misses, nothing tells that they do:
what disturbs the plant does.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.judge.excitation import rivals_apart
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.likelihood.output_error import Fitted, climb_roughly, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import matrices_of
from ctsid_core.linear.types import Array
from ctsid_core.model.simulation import free_response, respond
from ctsid_core.model.statespace import StateSpace
from ctsid_core.search.own_past import AHEAD
from ctsid_core.search.solution import GROWS, Solution
from ctsid_core.search.tried import ENOUGH
from ctsid_core.signals.as_measured import Still, least, longest_still
from ctsid_core.signals.record import Record

_DEVIATIONS = 2.0     # of the power of rounding, by which less is no chance


def rounding(solution: Solution) -> Array:
    """Return what a model follows of the rounding of each output, over its motion, (ny,)."""
    samples, fit = solution.samples, solution.fit
    if solution.by_prediction:
        return np.zeros(samples.ny)
    counts, moved = samples.counts.sum(axis=0), (_steps(solution) / samples.size) ** 2 / 12.0
    # By chance it is more or less: of rounding the mean of N squares has a deviation of
    # sqrt(0.8 / N).
    left = moved - samples.mean(fit.power)
    told = (left > _DEVIATIONS * np.sqrt(0.8 / np.maximum(counts, 1.0)) * moved) & (
        left > ENOUGH ** 2)
    return np.sqrt(np.where(told, left, 0.0))


def beside_rounding(solution: Solution, followed: Array,
                    sought: tuple[bool, ...]) -> list[tuple[float, ModalModel]]:
    """
    Return models with other gains, and other dead times, that are as far away as that.

    `sought`: of which moving inputs the dead time was looked for.
    """
    if not followed.any():
        return []
    samples, m, more = solution.samples, solution.fit.model, 1.0 + followed[:, np.newaxis]
    gains, late = replace(m, c=more * m.c, D=more * m.D), m.delay + samples.interval
    # As far as the gains are for each input; a dead time that is given is known.
    far, away = (rivals_apart(samples, m, [(1.0, one)]) for one in (gains, replace(m, delay=late)))
    late = np.minimum(m.delay + samples.interval * far / np.maximum(away, 1e-300),
                      np.maximum(solution.free.longest, m.delay))
    return [(0.5, gains), (0.5, replace(m, delay=np.where(sought or False, late, m.delay)))]


def unmoved_notes(solution: Solution, followed: Array) -> Iterator[str]:
    """Yield which outputs have so few values, and which oscillations inputs hardly move."""
    last = solution.part.parts[solution.part.last]
    for place, step, share in zip(last.y, _steps(solution), followed, strict=True):
        if share:
            yield (f'output {last.whole.output_names[place]} is measured in steps of {step:.3g}, '
                   'and the model follows these steps: the motion between them is known to '
                   f'{100.0 * share:.2g} % of all; move inputs more, or less regularly, or '
                   'measure it more finely')
    if solution.by_prediction:
        return
    samples, poles = solution.samples, solution.fit.model.poles
    missed = float(np.sum(samples.mean(solution.fit.power) * samples.counts.sum(axis=0)))
    lasts = np.abs(poles.real) * samples.length < GROWS
    for k in np.flatnonzero(lasts & (poles.imag > 0.0)).tolist():
        if _moved(solution, k) < missed:
            yield (f'inputs move the oscillation at {abs(poles[k]) / (2.0 * np.pi):.3g} Hz by '
                   'less than what the model misses: what disturbs the plant does; leave it out '
                   'where a controller is designed')


def _steps(solution: Solution) -> Array:
    """Return the smallest step of each moving output from one sample to the next; 0 if none."""
    found = np.min([np.concatenate([
        least(np.diff(s.values[s.rows(part.record.start, part.record.end)], axis=0))
        for s in part.record.outputs]) for part in solution.part.parts], axis=0)
    return np.where(np.isfinite(found), found, 0.0)


def _moved(solution: Solution, k: int) -> float:
    """Return the sum of squares of what inputs move a mode by."""
    samples, m = solution.samples, solution.fit.model
    columns = columns_of(samples, m.poles[k:k + 1], m.delay, direct=False, turned=False,
                         slopes=False)
    return float(sum(np.sum(((t.z[:, 0, :-1] @ m.b[k])[:, np.newaxis] * m.c[s.channels, k]).real
                            ** 2)
                     for record, triangles in zip(samples.records, columns.triangles, strict=True)
                     for s, t in zip(record.streams, triangles, strict=True)))


@dataclass(frozen=True)
class Stuck:
    """An output, by its place among all, and from when to when after the start it is stuck [s]."""

    output: int
    start: float
    end: float


def stuck_outputs(solution: Solution, moving: StateSpace) -> tuple[Stuck, ...]:
    """Return the outputs that are stuck for a part of a record, of a model of moving channels."""
    found = []
    for place, part in enumerate(solution.part.parts):
        for run in longest_still(part.whole):
            # Others hardly move at all, which is told otherwise.
            if run.output in part.y and (
                    run.noise_ends or _driven_while_still(solution, moving, place, run)):
                start, end = run.times[[0, -1]] - part.whole.recording.start
                found.append(Stuck(run.output, float(start), float(end)))
    return tuple(found)


def _driven_while_still(solution: Solution, moving: StateSpace, place: int, run: Still) -> bool:
    """Return whether inputs alone would have moved an output that stands still."""
    part = solution.part.parts[place]
    channel = part.y.index(run.output)
    if solution.simulated is not None:
        moving, missed = _of_the_rest(solution.simulated, place, channel, run)
    else:
        missed = solution.errors_ahead[AHEAD, channel] * float(solution.samples.size[channel])
    return _driven(moving, part.record, channel, run) > max(run.resolution, missed)


def _of_the_rest(simulated: Fitted, place: int, channel: int,
                 run: Still) -> tuple[StateSpace, float]:
    """Return the model of all samples but those, and what it misses of the output elsewhere."""
    samples, fit, free = simulated
    rest = _without(samples, place, channel, run)
    with suppress(np.linalg.LinAlgError):
        fit = climb_roughly(rest, fit_at(rest, *fit.model.nonlinear, free), free)
    m = matrices_of(fit.model, samples.size)
    return (StateSpace(m.A, m.B, m.C, m.D, delay=tuple(fit.model.delay.tolist())),
            float(np.sqrt(fit.power[place, channel])) * float(samples.size[channel]))


def _without(samples: Samples, place: int, channel: int, run: Still) -> Samples:
    records = list(samples.records)
    records[place] = replace(records[place], streams=tuple(
        s.of((s.times < run.times[0]) | (s.times > run.times[-1]))
        if s.channels.start <= channel < s.channels.stop else s
        for s in records[place].streams))
    return replace(samples, records=tuple(records))


def _driven(moving: StateSpace, record: Record, channel: int, run: Still) -> float:
    """Return the rms of what inputs move that no initial state and no trim would undo."""
    x, u = respond(moving.A, moving.B, np.zeros(moving.n), record.inputs, moving.delay, run.times,
                   None)
    y = x @ moving.C[channel] + u @ moving.D[channel]
    free = np.column_stack((free_response(moving.A, moving.C, run.times)[0][:, channel],
                            np.ones(len(y))))
    return float(np.sqrt(np.mean((y - free @ np.linalg.lstsq(free, y, rcond=None)[0]) ** 2)))
