# SPDX-License-Identifier: Apache-2.0
"""
Corrupt samples of the outputs that stand out in the residuals of a model.

What neighbours show (`signals/outliers.py`) is asked again of what the model leaves of the
outputs: there honest motions are gone and the finest spikes stand out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.signals.outliers import EXPLAINED, Spikes, spikes
from ctsid_core.signals.record import Record, Signal
from ctsid_core.signals.spikes import resolution

_LEAST = 1e-6           # of a channel's motion, by which a corrupt sample is off at least
_HELP = 1.2             # scale over that without a model from which on the model is no help


def against_model(model: StateSpace, record: Record, before: Sequence[Spikes],
                  inputs: Sequence[Array | None]) -> tuple[list[Spikes], float]:
    """
    Find the corrupt samples of the outputs in the residuals of a model.

    Parameters
    ----------
    model : StateSpace
    record : Record
        With its corrupt samples.
    before : sequence of Spikes
        What was found without a model: kept where the model's simulation is no help, and where
        samples lie outside of the record's interval.

    inputs : sequence of (ndarray (N, nu) or None)
        Held inputs at the stamps of each output signal, which they may follow at once.

    Returns
    -------
    found : list of Spikes
    gain : float
        Power of the residuals with the samples of `before`, over that with the samples of
        `found`, or its inverse: the largest of all outputs.
    """
    seen = simulation(model, replace(record, outputs=tuple(
        replace(s, values=found.instead)
        for s, found in zip(record.outputs, before, strict=True))))
    places = np.cumsum([0, *(s.width for s in record.outputs)])
    pairs = [_left(s, seen.times, seen.y_hat[:, first:last], found, direct)
             for s, found, direct, first, last in
             zip(record.outputs, before, inputs, places[:-1], places[1:], strict=True)]
    return [found for found, _ in pairs], max(gain for _, gain in pairs)


def _left(signal: Signal, times: Array, y_hat: Array, before: Spikes,
          inputs: Array | None) -> tuple[Spikes, float]:
    """Return the corrupt samples of one output signal, given its simulation, and the gain."""
    inside = (signal.time >= times[0]) & (signal.time <= times[-1])
    expected = y_hat[np.searchsorted(times, signal.time[inside])]
    if not np.isfinite(expected).all():
        return before, 1.0
    least = np.array([max(resolution(row), _LEAST * float(np.std(row)))
                      for row in signal.values.T])
    found = spikes(signal.time[inside], signal.values[inside] - expected, least=least,
                   inputs=None if inputs is None else inputs[inside], closely=True)
    useful = ~(found.scale > _HELP * before.scale)
    block = np.ix_(inside, useful)
    mask, instead = before.mask.copy(), before.instead.copy()
    unexplained = np.abs(signal.values[inside] - expected) > EXPLAINED * np.abs(
        signal.values - before.instead)[inside]
    mask[block] = (found.mask | (before.mask[inside] & unexplained))[:, useful]
    instead[block] = np.where(found.mask, found.instead + expected, np.where(
        mask[inside], before.instead[inside], signal.values[inside]))[:, useful]
    old, new = (np.mean((values[inside] - expected) ** 2, axis=0)
                for values in (before.instead, instead))
    gain = np.maximum(old, new) / np.maximum(np.minimum(old, new), np.finfo(float).tiny)
    return Spikes(mask, instead, found.scale, found.suspects, found.too_many), float(np.max(gain))
