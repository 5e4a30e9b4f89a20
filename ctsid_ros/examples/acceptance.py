# SPDX-License-Identifier: Apache-2.0
"""Whether a model that came over a topic is good enough to tune a controller by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace

_ROUNDING = 1e-9  # of the largest entry of a covariance


@dataclass(frozen=True)
class Limits:
    """
    What is asked of a model.

    Parameters
    ----------
    inputs, outputs : tuple of str
        Names of its channels, in this order: gains for other signals would be nonsense.
    vague : float
        Largest standard deviation of a pole, as a part of the size of the pole.
    fit : float
        Least fit of each output, on the window and on its part that was held out [%].
    fresh_fit : float
        Least fit of the model before it on the data that have come since [%].
    age : float
        Longest time since the end of its window [s].
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    vague: float = 0.2
    fit: float = 70.0
    fresh_fit: float = 50.0
    age: float = 5.0


def objection(estimate: Estimate, fresh_fit: Array, now_ns: int, limits: Limits) -> str:
    """
    Return why no controller should be tuned by an estimate, as a sentence; '' if one may.

    Parameters
    ----------
    estimate : Estimate
    fresh_fit : ndarray, shape (ny,)
        From the metadata of the same message [%]; NaN or empty if not known.
    now_ns : int
        Time on the clock of the stamps [ns].
    limits : Limits
    """
    model = estimate.model
    if model is None or not estimate.good:
        return f'{estimate.verdict.grade.name}: {estimate.verdict.reason.rstrip(".")}'
    if (model.input_names, model.output_names) != (limits.inputs, limits.outputs):
        return (f'the model is from {_listed(model.input_names)} to '
                f'{_listed(model.output_names)}; wanted is from {_listed(limits.inputs)} to '
                f'{_listed(limits.outputs)}')
    if estimate.end_ns <= estimate.start_ns:
        return 'the window of the model ends before it begins'
    if why := old(estimate, now_ns, limits):
        return why
    return (_impossible(model)
            or _vague(estimate, model, limits.vague)
            or _low(estimate.fit, limits.fit, 'fit on the window')
            or _low(estimate.held_out_fit, limits.fit, 'fit on data held out')
            or _low(fresh_fit, limits.fresh_fit,
                    'fit of the model before it on the data since (did the plant change?)'))


def old(estimate: Estimate, now_ns: int, limits: Limits) -> str:
    """Return what is wrong with the age of an estimate; '' if it is of now."""
    age = (now_ns - estimate.end_ns) * 1e-9
    return '' if -1.0 <= age <= limits.age else \
        f'the window of the model ended {age:.1f} s ago, on the clock of this node'


def _impossible(model: StateSpace) -> str:
    """Return what is wrong with the noise of a model; '' if it can be that of a plant."""
    if model.noise is None:
        return ''
    size = float(np.abs(model.noise).max(initial=0.0))
    skew = float(np.abs(model.noise - model.noise.T).max(initial=0.0))
    least = float(np.min(np.linalg.eigvalsh(model.noise)))
    if skew > _ROUNDING * size or least < -_ROUNDING * size:
        return 'the covariance of its noise is not positive semidefinite'
    return ''


def _vague(estimate: Estimate, model: StateSpace, limit: float) -> str:
    if len(estimate.pole_std) != model.n or not np.isfinite(estimate.pole_std).all():
        return 'how sure its poles are is not known'
    # A pole slower than the window can tell is measured by the window instead.
    slowest = 2e9 * np.pi / max(estimate.end_ns - estimate.start_ns, 1)
    ratio = estimate.pole_std / np.maximum(np.abs(model.poles), slowest)
    if np.all(ratio <= limit):
        return ''
    worst = int(np.argmax(ratio))
    return (f'the pole {model.poles[worst]:.3g} rad/s has a standard deviation of '
            f'{estimate.pole_std[worst]:.2g}, {100 * ratio[worst]:.0f} % of its size; wanted '
            f'are {100 * limit:g} %')


def _low(fits: Array, limit: float, what: str) -> str:
    """Return what is wrong with a fit; a fit that is not known is no fault."""
    least = float(np.min(fits[np.isfinite(fits)], initial=np.inf))
    return '' if least >= limit else f'the {what} is {least:.0f} %; wanted are {limit:g} %'


def _listed(names: tuple[str, ...]) -> str:
    return ', '.join(names) or 'nothing'
