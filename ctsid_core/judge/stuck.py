# SPDX-License-Identifier: Apache-2.0
"""
Outputs that stop moving: a sensor that hangs, or a driver that repeats its last value.

Coarse sensors repeat values as well, while the plant moves by less than they resolve: at rest,
and for as long after it as dead time and lags take. So the model is asked: the one that was found,
taken to the maximum of the likelihood of all other samples, for what is stuck spoils it. The
output is stuck where inputs alone, whatever the state was at first, move that model by more than
what the sensor resolves and than what the model misses elsewhere; or where there is noise
elsewhere.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.likelihood.output_error import Fitted, climb_roughly, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import matrices_of
from ctsid_core.model.simulation import free_response, respond
from ctsid_core.model.statespace import StateSpace
from ctsid_core.search.own_past import AHEAD
from ctsid_core.search.solution import Solution
from ctsid_core.signals.record import Record
from ctsid_core.signals.still import Still, longest_still


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
                    run.noise_ends or _moved(solution, moving, place, run)):
                start, end = run.times[[0, -1]] - part.whole.recording.start
                found.append(Stuck(run.output, float(start), float(end)))
    return tuple(found)


def _moved(solution: Solution, moving: StateSpace, place: int, run: Still) -> bool:
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
        fit = climb_roughly(rest, fit_at(rest, fit.model.poles, fit.model.delay, free), free)
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
