# SPDX-License-Identifier: Apache-2.0
"""
The same record by a second method, with the order and the dead times that the first one found.

Dead times that the first method did not look for, and with them the order, are left to the second
if that looks for them.

Two methods that treat the same data differently agree where the model is right, to within what
noise does; where it cannot be right (a dead time not allowed for, an order too low), each errs in
its own way. Where noise leaves room for a difference that matters, they cannot tell: a difference
within its deviations is no agreement. That they agree does not prove that they are right: a wrong
order, dead time, hold or stamp that is given to both is wrong for both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ctsid_core.judge.rules import KNOWN, weakened
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Agreement
from ctsid_core.search.actuators import APART
from ctsid_core.settings import UNCHECKED, Actuator, Settings
from ctsid_core.subspace.methods import METHODS

RELATIVE = 0.05       # of the response, above which a difference matters
DEVIATIONS = 3.0      # above which it is not chance ...
EFFICIENT = 2.0       # ... if the second method is at the maximum of the likelihood
_FREQUENCIES = 60     # compared for each input
_SPAN = 1000.0        # between the last and the first of them, at most


def cross_checked(found: Estimate, settings: Settings,
                  identify: Callable[[Settings], Estimate]) -> Estimate:
    """
    Return an estimate whose verdict has the agreement with a second method, if asked for.

    Settings are those given; `identify` identifies the same record with others.
    """
    if settings.cross_check == UNCHECKED or found.model is None:
        return found
    other = identify(_second_settings(settings, found.model))
    verdict = replace(found.verdict, agreement=agreement(found, other, settings.cross_check))
    return replace(found, verdict=weakened(verdict))


def _second_settings(settings: Settings, model: StateSpace) -> Settings:
    """Return the settings of the second method."""
    other = settings.replace(method=settings.cross_check, cross_check=UNCHECKED, refine=True)
    if any(map(any, model.actuators)):
        other = other.with_actuators(model.actuators)
    if METHODS[other.method].refines and any(settings.unknown_delays(model.nu)):
        # States may stand for a dead time that the first did not look for.
        return other
    return other.replace(order=model.n, delay=model.delay)


def agreement(first: Estimate, second: Estimate, method: str) -> Agreement:
    """
    Return how far the model of a second method is from that of the first, of the same record.

    Compared is, for each input, the response of all outputs together, each in units of its own
    size, over the band that the input excites (`Excitation`), of rejected models, too. Standard
    deviations are those of both estimates, as if they were independent.

    A difference beyond chance at any frequency contradicts, and so does a model that diverges
    within the record where the other does not: a slow mode that grows is hardly seen within the
    band. To agree is more: see `Agreement`.
    """
    # What was found, without what to try next: that is for who asked for this method.
    reason = second.verdict.reason
    finding = (reason.rpartition('; ')[0] or reason).removesuffix('.')
    problem = '' if second.ok else f'{second.status.name}. {finding}.'
    one, other = (e.model or e.rejected_model for e in (first, second))
    if one is None or other is None:
        return Agreement(method, False, True, problem=problem or 'there is no model to compare.')
    problem = problem or _other_actuators(one, other) or _divergence(first, one, other)
    bands = _bands(first)
    if not bands:
        return Agreement(method, False, bool(problem),
                         problem=problem or 'no input excites a band to compare in.')
    try:
        relative, std = _differences(first, second, one, other, bands)
    except np.linalg.LinAlgError:                       # an undamped pole at one of them
        return Agreement(method, False, bool(problem),
                         problem=problem or 'a response is not finite.')
    late, dead_time = _later(first, second, one, other)
    with np.errstate(divide='ignore', invalid='ignore'):
        deviations = relative / std
    limit = EFFICIENT if METHODS[method].refines else DEVIATIONS
    beyond = ~(relative <= RELATIVE) & ~(deviations <= limit)
    seen = np.where(np.isfinite(relative), relative, np.inf)
    row, at = divmod(int(np.argmax(np.where(beyond, seen, -1.0) if beyond.any() else seen)),
                     _FREQUENCIES)
    j, contradicts = list(bands)[row], bool(problem or late or beyond.any())
    # Rms over the band of each input
    away, unsure = (np.sqrt(np.mean(x ** 2, axis=1)) for x in (relative, std))
    sure = (away > KNOWN) & (away > DEVIATIONS * unsure)
    worst = int(np.argmax(np.where(sure, away, -1.0) if sure.any() else
                          np.nan_to_num(np.hypot(away, unsure), nan=np.inf)))
    told = bool(np.all((away <= KNOWN) & (unsure <= KNOWN)))
    return Agreement(method, told and not contradicts, contradicts, float(relative[row, at]),
                     float(deviations[row, at]), one.input_names[j], float(bands[j][at]),
                     float(away[worst]), float(unsure[worst]), late, dead_time, problem)


def _other_actuators(one: StateSpace, other: StateSpace) -> str:
    """Return what lies otherwise before which input, if anything does."""
    return next((f'`{kind}` of input {name} is {b:.3g}, and {a:.3g} with the first (0: none).'
                 for name, mine, its in zip(one.input_names, one.actuators, other.actuators,
                                            strict=True)
                 for kind, a, b in zip(Actuator._fields, mine, its, strict=True)
                 if abs(a - b) > APART * max(a, b)), '')


def _divergence(first: Estimate, one: StateSpace, other: StateSpace) -> str:
    """Say which of two models grows by more than a factor e within the record, if one does."""
    growth = [float(np.max(model.poles.real, initial=0.0)) for model in (one, other)]
    unstable = [g * 1e-9 * (first.end_ns - first.start_ns) > 1.0 for g in growth]
    if unstable[0] == unstable[1]:
        return ''
    which, rest = ('its model', 'the first') if unstable[1] else ('the first model', 'its own')
    return f'{which} diverges, as exp({max(growth):.2g} t), and {rest} does not.'


def _later(first: Estimate, second: Estimate, one: StateSpace,
           other: StateSpace) -> tuple[str, float]:
    """Return the input whose dead time the second method most surely finds otherwise, and how."""
    away = np.subtract(other.delay, one.delay)
    std = np.hypot(first.delay_std, second.delay_std)
    with np.errstate(divide='ignore', invalid='ignore'):
        sure = np.where((away == 0.0) | np.isnan(std), 0.0, np.abs(away) / std)
    at = int(np.argmax(sure))
    return (one.input_names[at], float(away[at])) if sure[at] > DEVIATIONS else ('', 0.0)


def _bands(estimate: Estimate) -> dict[int, Array]:
    """Return the frequencies that inputs excite, by their places; none that is too slow to see."""
    slowest = 2e9 * np.pi / max(estimate.end_ns - estimate.start_ns, 1)
    return {j: np.geomspace(min(max(x.low, x.high / _SPAN, slowest), x.high), x.high,
                            _FREQUENCIES)
            for j, x in enumerate(estimate.verdict.excitation) if x.high > 0.0}


def _scale(model: StateSpace, bands: Mapping[int, Array]) -> Array:
    """Return one over the size of each output, by all inputs in their bands; 0 if it has none."""
    power = sum((np.mean(np.abs(model.frequency_response(omega)[:, :, j]) ** 2, axis=0)
                 for j, omega in bands.items()), np.zeros(model.ny))
    return np.asarray(1.0 / np.sqrt(np.where(power > 0.0, power, np.inf)))


def _differences(first: Estimate, second: Estimate, one: StateSpace, other: StateSpace,
                 bands: Mapping[int, Array]) -> tuple[Array, Array]:
    """Return differences over the response and their deviations, (inputs, frequencies)."""
    scale, rows = _scale(one, bands), []
    for j, omega in bands.items():
        response, second_response = (m.frequency_response(omega)[:, :, j] for m in (one, other))
        if not np.isfinite([response, second_response]).all():
            raise np.linalg.LinAlgError
        away = np.linalg.norm(scale * (second_response - response), axis=1)
        size = np.sqrt(np.mean(np.sum((scale * np.abs(response)) ** 2, axis=1)))
        with np.errstate(divide='ignore', invalid='ignore'):
            rows.append((away / size, np.hypot(
                _deviation(first, one, omega, scale, j),
                _deviation(second, other, omega, scale, j)) / size))
    relative, std = map(np.array, zip(*rows, strict=True))
    return relative, std


def _deviation(estimate: Estimate, model: StateSpace, omega: Array, scale: Array, j: int) -> Array:
    if estimate.covariance is None:
        return np.full(len(omega), np.nan)
    changes = estimate.covariance.response_differences(model, omega)[..., j]
    return np.sqrt(np.sum((scale * np.abs(changes)) ** 2, axis=(0, 2)))
