# SPDX-License-Identifier: Apache-2.0
"""
Which frequencies of a response matter: the spectrum of inputs.

That of the differenced response to an input, over omega: differenced, so that a single step,
which is an edge, counts at all frequencies up to the plant's bandwidth; over omega, so that every
octave counts alike.
"""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.modal import mode_responses

_POINTS = 4096        # of the uniform grid of time, at most
_LINES = 200          # of the spectrum of the inputs, the strongest
_LOBE = 2.0           # lines that one sine has after the taper


def input_spectra(samples: Samples,
                  delay: Array) -> tuple[Array, Array, ComplexArray, Array, Array]:
    """
    Return frequencies, weights (M, nu) and lines (nu, M) of the inputs there, and more.

    Of the record in which inputs change most, the strongest lines only. Further the inputs at
    uniform instants, and the effective number of frequencies of each.
    """
    record = max(samples.records, key=_motion)
    finest = min(s.period for s in record.streams)
    count = int(np.clip((record.end - record.start) / finest, 32, _POINTS))
    t = np.linspace(record.start, record.end, count)
    ends = np.cumsum([s.width for s in record.inputs])
    inputs = record.inputs[:int(np.searchsorted(ends, len(delay))) + 1]
    none = np.empty(0, dtype=complex)
    as_sent, u = (mode_responses(none, inputs, d.tolist(), record.start, t, slopes=False).inputs
                  for d in (0.0 * delay, delay))
    lines = np.fft.rfft(np.diff(u, axis=1), axis=1)[:, 1:]
    omega = 2.0 * np.pi * np.fft.rfftfreq(count - 1, t[1] - t[0])[1:]
    power = np.abs(lines) ** 2 / omega
    strength = np.sum(power / (power.sum(axis=1, keepdims=True) + 1e-300), axis=0)
    places = np.sort(np.argsort(-strength, kind='stable')[:_LINES])
    tapered = np.abs(np.fft.rfft(np.diff(as_sent, axis=1) * np.hanning(count - 1),
                                 axis=1))[:, 1:] ** 2 / omega
    # What lies beyond half the rate of an input are the edges of its hold.
    tapered *= omega < np.pi / np.array([[s.period] for s in inputs for _ in range(s.width)])
    breadth = tapered.sum(axis=1) ** 2 / np.maximum(np.sum(tapered ** 2, axis=1), 1e-300)
    return (omega[places], power[:, places].T, lines[:, places] / np.sqrt(omega[places]), u,
            breadth / _LOBE)


def _motion(record: RecordSamples) -> float:
    """Return by how much the inputs of a record change in all."""
    return float(sum(np.abs(np.diff(s.values, axis=0)).sum() for s in record.inputs))
