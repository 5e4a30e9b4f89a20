# SPDX-License-Identifier: Apache-2.0
"""
Information that further data would add on an identified model.

An input of power spectral density Phi(omega) that acts for a time T adds to the information

    M = T / (2 pi) integral Re( G'^H R^-1 G' ) Phi d omega,     G' = dG / d theta              (1)

R the density of what is not explained (L. Ljung, "System Identification", 2nd edition, section
13.2 to 13.4; G. C. Goodwin, R. L. Payne, "Dynamic System Identification", 1977, chapter 6). Along
the rows of the root of the covariance the information is 1 now, and the covariance (1 + M)^-1
then. Longer data of the same kind multiply what there is, a larger input by its square.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import pi

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.covariance import Covariance, scatter_of_poles
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.simulation import input_polynomials
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Verdict
from ctsid_core.model.whiteness import cell
from ctsid_core.signals.record import Record

_BANDS = 6
_POINTS = 16          # frequencies of a band at which (1) is summed
_BEYOND = 5.0         # times the fastest pole: nothing is to be learnt at higher frequencies


@dataclass(frozen=True)
class Band:
    """Further excitation of one input in one band."""

    input: str
    low: float    # [rad/s]
    high: float   # [rad/s]
    rms: float    # what the input has now, all frequencies together: the size of the excitation
    share: float  # part of its power now that lies in this band
    ratio: float = 1.0  # standard deviation of the pole with it, over that without


@dataclass(frozen=True, eq=False)
class Forecast:
    """How well the poles are known, and what would change it."""

    poles: ComplexArray   # (n,)
    slopes: ComplexArray  # (r, n): their changes along r directions of unit variance
    bands: tuple[Band, ...]
    added: Array          # (bands, r, r): information along them that a second in each band adds

    def deviation(self, k: int, larger: float = 1.0) -> float:
        """Return the standard deviation of pole k now, or with so many times the input [rad/s]."""
        return float(scatter_of_poles(self.poles, self.slopes / larger)[k])

    def with_band(self, k: int, band: int, seconds: float) -> float:
        """Return the same with further excitation in one band."""
        M = np.eye(len(self.slopes)) + seconds * self.added[band]
        known = np.linalg.solve(np.linalg.cholesky(M), self.slopes)
        return float(scatter_of_poles(self.poles, known)[k])


def forecast(estimate: Estimate, model: StateSpace, covariance: Covariance,
             records: Sequence[Record]) -> Forecast:
    """
    Return what further data would add to what records have given.

    The model of an estimate may be accepted or not; its errors are those that its deviations
    count.
    """
    edges, bands, added = _edges(model, records), [], []
    noise = _innovations if estimate.by_predictions else _white
    density = partial(noise, estimate.verdict, model, records)
    for j, name in enumerate(model.input_names):
        powers = [_power(record, j, edges) for record in records]
        seconds = np.array([record.duration for record in records])
        total, *inside = (seconds @ np.array(powers) / seconds.sum()).tolist()
        for low, high, power in zip(edges, edges[1:], inside, strict=False):
            if total > 0.0:
                bands.append(Band(name, low, high, float(np.sqrt(total)), power / total))
                added.append(total * _information(model, covariance, density, j, low, high))
    return Forecast(model.poles, covariance.pole_changes(model), tuple(bands), np.array(added))


def _information(model: StateSpace, covariance: Covariance, density: Callable[[Array], Array],
                 j: int, low: float, high: float) -> Array:
    """Return what a second of unit power of input j adds (1), (r, r)."""
    omega = low + (high - low) * (np.arange(_POINTS) + 0.5) / _POINTS
    changes = covariance.response_changes(model, omega)[:, :, :, j] / np.sqrt(density(omega))
    rows = changes.reshape(len(changes), -1)
    return (rows @ rows.conj().T).real / _POINTS


def _white(verdict: Verdict, _: StateSpace, records: Sequence[Record],
           omega: Array) -> Array:
    """Return the density of what is not explained, as deviations count it: (M, ny) [unit^2 s]."""
    found = []
    for signals in zip(*(record.outputs for record in records), strict=True):
        size = np.std(np.concatenate([s.values for s in signals]), axis=0)
        found.append(size ** 2 * np.median([s.period for s in signals]))
    density = np.concatenate(found) * verdict.error ** 2 / np.nanmin(verdict.independent)
    return np.tile(_told(density), (len(omega), 1))


def _innovations(verdict: Verdict, model: StateSpace, _: Sequence[Record],
                 omega: Array) -> Array:
    """Return the same of a model that predicts: innovations, seen through the plant."""
    system = 1j * omega[:, np.newaxis, np.newaxis] * np.eye(model.n) - model.A
    colour = np.eye(model.ny) + model.C @ np.linalg.solve(
        system, np.broadcast_to(model.K, (len(omega), *model.K.shape)))
    intensity = np.zeros((model.ny, model.ny)) if model.noise is None else model.noise
    seen = np.einsum('mij,jk,mik->mi', colour, intensity, colour.conj()).real
    return _told(seen / np.nanmin(verdict.independent))


def _told(density: Array) -> Array:
    """Return a density, infinite for constant outputs: they tell nothing."""
    return np.where(density > 0.0, density, np.inf)


def _edges(model: StateSpace, records: Sequence[Record]) -> list[float]:
    """Return the edges of the bands: from one period in a record to where the model ends."""
    low = 2.0 * pi / max(record.duration for record in records)
    sampled = pi / max(s.period for record in records for s in record.outputs)
    top = _BEYOND * float(np.max(model.natural_frequency, initial=low))
    return [float(e) for e in np.geomspace(low, max(min(sampled, top), 4.0 * low), _BANDS + 1)]


def _power(record: Record, j: int, edges: Sequence[float]) -> list[float]:
    """Return the mean square of an input of a record, less its mean, and that in each band."""
    signal = next(s for s, last in zip(record.inputs, np.cumsum([s.width for s in record.inputs]),
                                       strict=True) if last > j)
    count = max(int(record.duration / cell(signal.time)), 2) if len(signal.time) > 1 else 2
    t = record.start + record.duration * np.arange(count) / count
    u = input_polynomials(record.inputs, (0.0,) * record.nu, t)[0][:, j]
    u = u - u.mean()
    power = np.abs(np.fft.rfft(u)) ** 2
    power[1:(count + 1) // 2] *= 2.0
    below = np.cumsum(power / count ** 2)
    at = np.searchsorted(2.0 * pi / record.duration * np.arange(len(below)), edges)
    return [float(below[-1]), *np.diff(np.concatenate(([0.0], below))[at]).tolist()]
