# SPDX-License-Identifier: Apache-2.0
"""
Information that further data would add on an identified model.

An input of power spectral density Phi(omega) that acts for a time T adds to the information

    M = T / (2 pi) integral Re( G'^H R^-1 G' ) Phi d omega,     G' = dG / d theta              (1)

R the density of the noise (L. Ljung, "System Identification", 2nd edition, section 13.2 to 13.4;
G. C. Goodwin, R. L. Payne, "Dynamic System Identification", 1977, chapter 6). Longer
data of the same kind multiply what there is; a larger input the part of it that it causes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import pi

import numpy as np

from ctsid_core.bases.hermite import project_record
from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.projection import Projection, real_times
from ctsid_core.likelihood.information import Information, information, trust, without_gain
from ctsid_core.likelihood.prediction_errors import Prediction, jacobian, simulation
from ctsid_core.likelihood.process_noise import with_linear_entries
from ctsid_core.likelihood.refine import by_parameter, whitener
from ctsid_core.likelihood.window_ends import line_distance
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import resolvent
from ctsid_core.linear.types import Array, ComplexArray, Lines
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record

_BANDS = 6
_POINTS = 16          # frequencies of a band at which (1) is summed
_BEYOND = 5.0         # times the fastest pole: nothing is to be learnt at higher frequencies


@dataclass(frozen=True)
class Band:
    """
    Further excitation of one input in one band.

    Parameters
    ----------
    input : str
    low, high : float
        [rad/s]
    rms : float
        What the input has now, all frequencies together: the size of the excitation.
    share : float
        Part of its power now that lies in this band.
    ratio : float
        Standard deviation of the pole with it, over that without.
    """

    input: str
    low: float
    high: float
    rms: float
    share: float
    ratio: float


@dataclass(frozen=True, eq=False)
class Added:
    """What one second of an input in one band adds to information and variance, (r, r)."""

    band: Band
    H: Array
    V: Array


@dataclass(frozen=True, eq=False)
class Forecast:
    """
    Information in the r directions that the data determine, and what would change it.

    Parameters
    ----------
    poles : ndarray, shape (n,)
    slopes : ndarray, shape (n, r)
        Derivatives of the poles.
    H, V : ndarray, shape (r, r)
        Information, and variance of the slope of the likelihood.
    by_inputs, by_noise : ndarray, shape (r, r)
        The parts of H that inputs and noise cause alone.
    white : float
        V over H, for an innovation form; NaN for a simulation, whose V is of the inputs' making.
    added : tuple of Added
    """

    poles: ComplexArray
    slopes: ComplexArray
    H: Array
    V: Array
    by_inputs: Array
    by_noise: Array
    white: float
    added: tuple[Added, ...]

    def deviation(self, k: int, H: Array, V: Array) -> float:
        """Return the standard deviation of pole k for some information [rad/s]."""
        x = np.linalg.solve(H, self.slopes[k].conj())
        return float(np.sqrt(max((x.conj() @ V @ x).real, 0.0)))

    def with_band(self, k: int, added: Added, seconds: float) -> float:
        """Return the same with further excitation."""
        return self.deviation(k, self.H + seconds * added.H, self.V + seconds * added.V)

    def with_size(self, k: int, factor: float) -> float:
        """Return the same with so many times the input."""
        H = factor ** 2 * self.by_inputs + self.by_noise \
            + factor * (self.H - self.by_inputs - self.by_noise)
        return self.deviation(k, H, factor ** 2 * self.V if np.isnan(self.white) else
                              self.white * H)


def forecast(part: Usable, model: StateSpace, estimate: Estimate) -> Forecast:
    """Return the information that further data would add, from the data an estimate is of."""
    settings = estimate.settings
    noisy = bool(estimate.statistics.get('process_noise', float(model.K.any())))
    own = settings.replace(delay=tuple(model.delay[j] for j in part.u), parts=settings.parts or 1)
    projection = project_record(part.record, own, settings.nmax)
    m = with_linear_entries(projection, _matrices(part, projection, model), settings.feedthrough)
    m = m if noisy else without_gain(projection, m, settings.feedthrough)
    known = information(projection, m, settings.feedthrough, noisy)
    basis = known.s[:, np.newaxis] * known.basis.T
    H, V = basis @ basis.T, (basis * known.size) @ (basis * known.size).T
    by_inputs, by_noise = H, np.zeros_like(H)
    if noisy:
        states = simulation(projection, m).x
        noise_free = _reduced(_rows(projection, m, settings.feedthrough, states, noisy=True,
                                    s=projection.s), known)
        rest = basis - noise_free
        by_inputs, by_noise = noise_free @ noise_free.T, rest @ rest.T
    values, right = np.linalg.eig(m.A)
    order = np.lexsort((values.imag, np.abs(values)))
    left, right, n2 = np.linalg.inv(right)[order], right[:, order], m.A.size
    gradient = np.einsum('ia,bi->iab', left, right).reshape(len(values), -1)
    return Forecast(
        values[order].astype(complex), gradient @ (known.right[:, :n2] / known.norm[:n2]).T, H, V,
        by_inputs, by_noise, float(known.size[0]) ** 2 if noisy else np.nan,
        tuple(_added(part, projection, m, known, settings, noisy=noisy)))


def _matrices(part: Usable, projection: Projection, model: StateSpace) -> Matrices:
    """Return the model of the moving channels; what belongs to this window only is zero."""
    u, y, n = list(part.u), list(part.y), model.n
    ones = len(projection.ones)
    return Matrices(A=model.A, B=model.B[:, u], C=model.C[y], D=model.D[np.ix_(y, u)],
                    K=model.K[:, y], tail=np.zeros((n, len(projection.tail))),
                    x_trim=np.zeros((n, ones)), y_trim=np.zeros((len(y), ones)))


def _rows(projection: Projection, m: Matrices, feedthrough: bool, x: Lines, *, noisy: bool,
          s: Lines, of: Projection | None = None) -> Array:
    """
    Return derivatives of the whitened errors as the states' lines x cause them.

    Parameters
    ----------
    projection : Projection
        That gives the size of the errors.
    of : Projection, optional
        Whose lines count instead.
    """
    whiten, _ = whitener(projection, m)
    of = of or projection
    closed = resolvent(m.A - m.K @ m.C, s)
    rows = by_parameter(jacobian(of, m, feedthrough, with_noise=noisy, whiten=whiten,
                                 prediction=Prediction(closed, x, np.zeros_like(of.y))))
    if noisy:
        rows = rows * np.tile(np.repeat(trust(s, line_distance(projection), m), 2), len(m.C))
    return rows


def _reduced(rows: Array, known: Information) -> Array:
    """Return derivatives by the directions that the data determine, (r, N)."""
    reduced: Array = known.right @ (rows / known.norm[:, np.newaxis])
    return reduced


def _added(part: Usable, projection: Projection, m: Matrices, known: Information,
           settings: Settings, *, noisy: bool) -> Iterator[Added]:
    """Return what each input adds in each band."""
    edges = _edges(projection, m)
    names = [part.whole.input_names[j] or f'u{j + 1}' for j in part.u]
    for j, (name, rms) in enumerate(zip(names, _rms(part.record), strict=True)):
        power = np.abs(projection.u[j]) ** 2
        for low, high in zip(edges, edges[1:], strict=False):
            inside = (np.abs(projection.s) >= low) & (np.abs(projection.s) < high)
            band = Band(name, low, high, rms, float(power[inside].sum() / power.sum()), 1.0)
            omega = low + (high - low) * (np.arange(_POINTS) + 0.5) / _POINTS
            rows, size = _response(projection, m, known, settings, j, omega, noisy=noisy)
            weight = rms ** 2 / (_POINTS * projection.unit)                             # (1)
            yield Added(band, weight * rows @ rows.T, weight * (rows * size) @ (rows * size).T)


def _response(projection: Projection, m: Matrices, known: Information, settings: Settings, j: int,
              omega: Array, *, noisy: bool) -> tuple[Array, Array]:
    """Return the derivatives for a unit input j at given frequencies, and the errors there."""
    s, count = (1j * omega).astype(complex), len(omega)
    u = np.zeros((len(projection.u), count), dtype=complex)
    u[j] = 1.0
    none = np.zeros((max(len(projection.tail), len(projection.ones), len(projection.y)), count),
                    dtype=complex)
    alone = replace(projection, s=s, u=u, y=none[:len(projection.y)],
                    tail=none[:len(projection.tail)], ones=none[:len(projection.ones)])
    x = resolvent(m.A, s).states(real_times(m.B, u))
    rows = _reduced(_rows(projection, m, settings.feedthrough, x, noisy=noisy, s=s, of=alone),
                    known)
    if len(known.size) == 1:
        return rows, known.size
    sizes = known.size.reshape(len(m.C), -1, 2)[:, :, 0]
    at = np.abs(projection.s)
    return rows, np.concatenate([np.repeat(np.interp(omega, at, row), 2) for row in sizes])


def _edges(projection: Projection, m: Matrices) -> list[float]:
    """Return the edges of the bands: from one period in the record to where the model ends."""
    low = 2.0 * pi / (projection.end - projection.start)
    top = _BEYOND * float(np.max(np.abs(np.linalg.eigvals(m.A)), initial=low))
    high = max(min(float(np.abs(projection.s[-1])), top), 4.0 * low)
    return [float(edge) for edge in np.geomspace(low, high, _BANDS + 1)]


def _rms(record: Record) -> list[float]:
    """Return the standard deviation of each input's samples within a record."""
    found: list[float] = []
    for signal in record.inputs:
        inside = (signal.time >= record.start) & (signal.time <= record.end)
        found += [float(x) for x in signal.values[inside].std(axis=0)]
    return found
