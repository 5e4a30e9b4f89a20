# SPDX-License-Identifier: Apache-2.0
"""
Which experiment would make a model as accurate as it is wanted.

Longer, larger, or in which band: for every pole, from the information that further data would
add. An input of power spectral density Phi(omega) that acts for a time T adds

    M = T / (2 pi) integral Re( G'^H R^-1 G' ) Phi d omega,     G' = dG / d theta              (1)

R the density of what is not explained (L. Ljung, "System Identification", 2nd edition, section
13.2 to 13.4; G. C. Goodwin, R. L. Payne, "Dynamic System Identification", 1977, chapter 6). Along
the rows of the root of the covariance the information is 1 now, and the covariance (1 + M)^-1
then. Longer data of the same kind multiply what there is, a larger input by its square.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import pi

import numpy as np
from scipy.optimize import brentq

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.covariance import Covariance, scatter_of_poles
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.simulation import input_polynomials
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import cell
from ctsid_core.model.verdict import Remedy, Verdict
from ctsid_core.signals.record import Record

_MOST = 1e4           # times as long or as large: never
_SMALL = 0.97         # of the deviation: a band that leaves more than this does not help
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
class _Forecast:
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


@dataclass(frozen=True)
class PoleAdvice:
    """What it takes to know one pole, or pair, as well as wanted."""

    pole: complex            # [rad/s]; of a pair the upper one
    std: float               # standard deviation now [rad/s]
    wanted: float            # [rad/s]
    # how many times as long the data have to be, with the same excitation; 1 if they are long
    # enough. Reckoned as if in separate windows: one long record is at least as good
    longer: float
    # how many times as large the excitation has to be over the same time, if the plant stays
    # linear; 1 if it is large enough, infinite (as `longer`) if that is not the way
    larger: float
    bands: tuple[Band, ...]  # what further excitation in one band would do, the most helpful first
    # how long it has to last in the most helpful one [s]; infinite if that is not the way
    enough: float

    @property
    def lasting(self) -> float:
        """As `enough`, but a period at least [s]: less of it is not in the band."""
        return max(self.enough, 2.0 * pi / self.bands[0].high)


@dataclass(frozen=True)
class Advice:
    """Which further experiment would help."""

    poles: tuple[PoleAdvice, ...]  # slowest first; empty if there is no model
    seconds: float                 # how long the further excitation of `bands` lasts [s]
    sentences: tuple[str, ...]     # the same for people


def advise(estimate: Estimate, record: Record | Sequence[Record], wanted: float = 0.05,
           seconds: float = 10.0) -> Advice:
    """
    Return which duration, amplitude or band of excitation a wanted accuracy needs.

    `estimate` is that of the record, or of the records; a rejected model serves as well. `wanted`
    is the standard deviation of each pole over its size (over 1 / duration, if that is larger),
    `seconds` how long further excitation in one band would last. Raises `DataError` if the
    channels do not fit the model, or a number is not positive.

    A forecast from the model: as good as that, and without dynamics that it does not have.
    In closed loop the excitation is that of the input itself, not of the reference.
    """
    for name, value in (('wanted', wanted), ('seconds', seconds)):
        if not 0.0 < value < np.inf:
            raise DataError(f'`{name}` is {value}; a positive number is wanted')
    records = (record,) if isinstance(record, Record) else tuple(record)
    model, covariance = estimate.model or estimate.rejected_model, estimate.covariance
    if model is None or covariance is None:
        first = (f'For a first model {_motion(records, "the inputs")}.',) if estimate.status in (
            Status.NO_EXCITATION, Status.TOO_SHORT) else ()
        return Advice((), seconds, (estimate.verdict.reason, *first))
    for one in records:
        model.check_width('input', one.nu, model.nu)
        model.check_width('output', one.ny, model.ny)
    try:
        of = _forecast(estimate, model, covariance, records)
        size = np.maximum(np.abs(of.poles), 1.0 / max(one.duration for one in records))
        poles = tuple(_advice(of, k, wanted * size[k], seconds)
                      for k in np.flatnonzero(of.poles.imag >= 0).tolist())
    except np.linalg.LinAlgError as error:       # of the data's making
        return Advice((), seconds, (f'The arithmetic of the forecast failed: {error}.',))
    asks = estimate.verdict.remedy in (Remedy.EXCITE, Remedy.LONGER)
    if not asks or any(p.std > p.wanted for p in poles):
        return Advice(poles, seconds, tuple(_sentences(poles, wanted, seconds)))
    return Advice(poles, seconds, (
        f'If this model is right, the standard deviation of every pole is at most '
        f'{100 * wanted:.3g} % of its size; its verdict asks for more than that: '
        f'{_motion(records, ", ".join(model.input_names))}.',))


def _advice(of: _Forecast, k: int, wanted: float, seconds: float) -> PoleAdvice:
    """Return what it takes to know pole k."""
    now = of.deviation(k)
    larger = _least(partial(of.deviation, k), wanted, 1.0, _MOST)
    bands = sorted(((replace(band, ratio=of.with_band(k, i, seconds) / now), i)
                    for i, band in enumerate(of.bands)), key=lambda x: x[0].ratio)
    return PoleAdvice(
        complex(of.poles[k]), now, wanted, larger ** 2, larger,
        tuple(band for band, _ in bands),
        0.0 if now <= wanted else _least(
            partial(of.with_band, k, bands[0][1]), wanted, 1e-3 * seconds, 1e-3 * seconds * _MOST))


def _least(deviation: Callable[[float], float], wanted: float, low: float, high: float) -> float:
    """Return the least number from `low` upwards that is enough; infinite if `high` is not."""
    if deviation(low) <= wanted:
        return low
    if not deviation(high) <= wanted:
        return np.inf
    return float(brentq(lambda x: deviation(x) - wanted, low, high))


def _forecast(estimate: Estimate, model: StateSpace, covariance: Covariance,
              records: Sequence[Record]) -> _Forecast:
    """Return what further data would add to what records have given."""
    # The model of an estimate may be accepted or not; its errors are those that its deviations
    # count.
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
    return _Forecast(model.poles, covariance.pole_changes(model), tuple(bands), np.array(added))


def _information(model: StateSpace, covariance: Covariance, density: Callable[[Array], Array],
                 j: int, low: float, high: float) -> Array:
    """Return what a second of unit power of input j adds (1), (r, r)."""
    omega = low + (high - low) * (np.arange(_POINTS) + 0.5) / _POINTS
    changes = covariance.response_changes(model, omega)[:, :, :, j] / np.sqrt(density(omega))
    rows = changes.reshape(len(changes), -1)
    return (rows @ rows.conj().T).real / _POINTS


def _white(verdict: Verdict, _: StateSpace, records: Sequence[Record], omega: Array) -> Array:
    """Return the density of what is not explained, as deviations count it: (M, ny) [unit^2 s]."""
    found = []
    for signals in zip(*(record.outputs for record in records), strict=True):
        size = np.std(np.concatenate([s.values for s in signals]), axis=0)
        found.append(size ** 2 * np.median([s.period for s in signals]))
    density = np.concatenate(found) * verdict.error ** 2 / np.nanmin(verdict.independent)
    return np.tile(_told(density), (len(omega), 1))


def _innovations(verdict: Verdict, model: StateSpace, _: Sequence[Record], omega: Array) -> Array:
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


def _motion(records: Sequence[Record], inputs: str) -> str:
    """Return at which frequencies to move inputs of which too little is known to say more."""
    slow = max(s.period for one in records for s in one.outputs)
    long = max(one.duration for one in records)
    return (f'move {inputs} between {2 / long:.2g} and {0.1 / slow:.2g} Hz (two periods in this '
            'window, a tenth of the slowest sampling), as strongly as is safe')


def _sentences(poles: Sequence[PoleAdvice], wanted: float, seconds: float) -> Iterator[str]:
    """Return the advice in words, of the poles less accurate than wanted."""
    inaccurate = [p for p in poles if p.std > p.wanted]
    if not inaccurate:
        yield (f'The standard deviation of every pole is at most {100 * wanted:.3g} % of its '
               'size: no further data are needed.')
    for p in inaccurate:
        more = (f'With the same excitation the data would have to be {p.longer:.3g} times as '
                f'long, or the input {p.larger:.3g} times as large. ') if p.larger < np.inf else (
            f'With the same excitation the input would have to be more than {_MOST:.0e} times as '
            'large: fewer states may do (`order`). ')
        yield (f'{_named(p.pole)}: standard deviation {p.std:.2g} rad/s, wanted {p.wanted:.2g}. '
               + more + _band_words(p, seconds))


def _band_words(p: PoleAdvice, seconds: float) -> str:
    best = p.bands[0]
    if best.ratio > _SMALL:
        return 'No band of further excitation helps much: the noise has to become smaller.'
    words = (f'{seconds:.3g} s more of {best.input} at {best.low / (2 * pi):.2g} to '
             f'{best.high / (2 * pi):.2g} Hz, as large as now (rms {best.rms:.3g}), would divide '
             f'it by {1 / best.ratio:.2g}')
    return words + (f'; {p.lasting:.2g} s are enough.' if p.enough < np.inf else '.')


def _named(pole: complex) -> str:
    kind = 'Pole' if pole.imag == 0 else 'Pair'
    value = f'{pole.real:.3g}' if pole.imag == 0 else f'{pole.real:.3g} +- {pole.imag:.3g}j'
    return f'{kind} {value}'
