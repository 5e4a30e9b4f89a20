# SPDX-License-Identifier: Apache-2.0
"""
Which experiment would make a model as accurate as it is wanted.

A model that has been found foretells what further data would tell: an input of power spectral
density Phi(omega) that acts for a time T adds to the Fisher information

    M = T / (2 pi) integral Re( G'^H R^-1 G' ) Phi d omega,     G' = dG / d theta              (1)

R the density of the noise (L. Ljung, "System Identification", 2nd edition, section 13.2 to 13.4;
G. C. Goodwin, R. L. Payne, "Dynamic System Identification", 1977, chapter 6). Longer data of the
same kind multiply what there is; a larger input the part of it that the input causes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.base import Lines, Projection, real_times
from ctsid_core.bases.hermite import project_record
from ctsid_core.deviation import Information, information, trust, without_gain
from ctsid_core.errors import DataError
from ctsid_core.estimate import Estimate, Status
from ctsid_core.pbsid import Matrices
from ctsid_core.prediction_errors import Prediction, jacobian, simulation
from ctsid_core.process_noise import driven
from ctsid_core.refine import by_parameter, whitener
from ctsid_core.resolvent import resolvent
from ctsid_core.settings import Settings
from ctsid_core.signals import Record
from ctsid_core.statespace import StateSpace
from ctsid_core.usable import Usable, usable
from ctsid_core.window_ends import line_distance

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_BANDS = 6
_POINTS = 16          # frequencies of a band at which (1) is summed
_BEYOND = 5.0         # times the fastest pole: nothing is to be learnt at higher frequencies
_MOST = 1e4           # times as long or as large: never
_SMALL = 0.97         # of the deviation: a band that leaves more than this does not help


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


@dataclass(frozen=True)
class PoleAdvice:
    """
    What it takes to know one pole, or pair, as well as wanted.

    Parameters
    ----------
    pole : complex
        [rad/s]; of a pair the upper one.
    std, wanted : float
        Standard deviation now, and wanted [rad/s].
    longer : float
        How many times as long the data have to be, with the same excitation; 1 if they are long
        enough.
    larger : float
        How many times as large the excitation has to be over the same time; infinite if that is
        not the way, because the deviation comes from elsewhere.
    bands : tuple of Band
        What further excitation in one band would do, the most helpful first.
    enough : float
        How long it has to be in the most helpful one [s]; infinite if that is not the way.
    """

    pole: complex
    std: float
    wanted: float
    longer: float
    larger: float
    bands: tuple[Band, ...]
    enough: float


@dataclass(frozen=True)
class Advice:
    """
    Which experiment is missing.

    Parameters
    ----------
    poles : tuple of PoleAdvice
        Slowest first; empty if there is no model.
    seconds : float
        How long the further excitation of `bands` lasts [s].
    sentences : tuple of str
        The same for people.
    """

    poles: tuple[PoleAdvice, ...]
    seconds: float
    sentences: tuple[str, ...]


def advise(estimate: Estimate, record: Record, wanted: float = 0.05,
           seconds: float = 10.0) -> Advice:
    """
    Tell which duration, amplitude or band of excitation is missing for a wanted accuracy.

    Parameters
    ----------
    estimate : Estimate
        Of `identify(record, ...)`; a rejected model serves as well.
    record : Record
    wanted : float
        Standard deviation of each pole over its size (over 1 / duration, if that is larger).
    seconds : float
        How long further excitation in one band would last [s].

    Raises
    ------
    DataError
        If the channels do not fit the model, or a number is not positive.

    Notes
    -----
    A forecast from the model found: as good as that, and blind to dynamics that it does not have.
    In closed loop the excitation is that of the input itself, not of the reference.
    """
    for name, value in (('wanted', wanted), ('seconds', seconds)):
        if not 0.0 < value < np.inf:
            raise DataError(f'`{name}` is {value}; a positive number is wanted')
    model = estimate.model or estimate.rejected_model
    part = usable(record, estimate.settings)
    if model is None or isinstance(part, Status):
        return Advice((), seconds, tuple(_without_model(estimate, record)))
    model.check_width('input', record.nu, model.nu)
    model.check_width('output', record.ny, model.ny)
    try:
        forecast = _forecast(part, model, estimate)
        size = np.maximum(np.abs(forecast.poles), 1.0 / part.record.duration)
        poles = tuple(forecast.advice(k, wanted * size[k], seconds)
                      for k in np.flatnonzero(forecast.poles.imag >= 0).tolist())
    except np.linalg.LinAlgError as error:       # of the data's making
        return Advice((), seconds, (f'The arithmetic of the forecast failed: {error}.',))
    return Advice(poles, seconds, tuple(_sentences(poles, wanted, seconds)))


@dataclass(frozen=True, eq=False)
class _Added:
    """What one second of an input in one band adds to information and variance, (r, r)."""

    band: Band
    H: Array
    V: Array


@dataclass(frozen=True, eq=False)
class _Forecast:
    """
    Information in the r directions that the data determine, and what would change it.

    Parameters
    ----------
    poles : ndarray, shape (n,)
    slopes : ndarray, shape (n, r)
        Derivatives of the poles.
    H, V : ndarray, shape (r, r)
        Information, and variance of the slope of the likelihood.
    caused, shaken : ndarray, shape (r, r)
        The parts of H that inputs and noise cause alone.
    white : float
        V over H, for an innovation form; NaN for a simulation, whose V is of the inputs' making.
    added : tuple of _Added
    """

    poles: ComplexArray
    slopes: ComplexArray
    H: Array
    V: Array
    caused: Array
    shaken: Array
    white: float
    added: tuple[_Added, ...]

    def deviation(self, k: int, H: Array, V: Array) -> float:
        """Return the standard deviation of pole k for some information [rad/s]."""
        x = np.linalg.solve(H, self.slopes[k].conj())
        return float(np.sqrt(max((x.conj() @ V @ x).real, 0.0)))

    def with_band(self, k: int, added: _Added, seconds: float) -> float:
        """Return the same with further excitation."""
        return self.deviation(k, self.H + seconds * added.H, self.V + seconds * added.V)

    def with_size(self, k: int, factor: float) -> float:
        """Return the same with so many times the input."""
        H = factor ** 2 * self.caused + self.shaken \
            + factor * (self.H - self.caused - self.shaken)
        return self.deviation(k, H, factor ** 2 * self.V if np.isnan(self.white) else
                              self.white * H)

    def advice(self, k: int, wanted: float, seconds: float) -> PoleAdvice:
        """Return what it takes to know pole k."""
        now = self.deviation(k, self.H, self.V)
        found = sorted(((self.with_band(k, added, seconds) / now, i, added)
                        for i, added in enumerate(self.added)), key=lambda x: x[:2])
        best = found[0][2]
        done = now <= wanted
        return PoleAdvice(
            complex(self.poles[k]), now, wanted, max((now / wanted) ** 2, 1.0),
            1.0 if done else _least(lambda g: self.with_size(k, g) <= wanted, 1.0),
            tuple(replace(added.band, ratio=ratio) for ratio, _, added in found),
            0.0 if done else _least(lambda t: self.with_band(k, best, t) <= wanted,
                                    1e-3 * seconds))


def _least(good: Callable[[float], bool], start: float) -> float:
    """Return the least number from `start` upwards that is good, to 1 %; infinite if none is."""
    low, high = start, start * _MOST
    if not good(high):
        return np.inf
    while high > 1.01 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if good(middle) else (middle, high)
    return high


def _forecast(part: Usable, model: StateSpace, estimate: Estimate) -> _Forecast:
    settings = estimate.settings
    noisy = bool(estimate.statistics.get('process_noise', float(model.K.any())))
    own = settings.replace(delay=tuple(model.delay[j] for j in part.u), parts=settings.parts or 1)
    projection = project_record(part.record, own, settings.nmax)
    m = driven(projection, _matrices(part, projection, model), settings.feedthrough)
    m = m if noisy else without_gain(projection, m, settings.feedthrough)
    known = information(projection, m, settings.feedthrough, noisy)
    basis = known.s[:, np.newaxis] * known.basis.T
    H, V = basis @ basis.T, (basis * known.size) @ (basis * known.size).T
    caused, shaken = H, np.zeros_like(H)
    if noisy:
        quiet = _reduced(_rows(projection, m, settings.feedthrough, simulation(projection, m).x,
                               noisy=True, s=projection.s), known)
        caused, shaken = quiet @ quiet.T, (basis - quiet) @ (basis - quiet).T
    values, right = np.linalg.eig(m.A)
    order = np.lexsort((values.imag, np.abs(values)))
    left, right, n2 = np.linalg.inv(right)[order], right[:, order], m.A.size
    gradient = np.einsum('ia,bi->iab', left, right).reshape(len(values), -1)
    return _Forecast(
        values[order].astype(complex), gradient @ (known.right[:, :n2] / known.norm[:n2]).T, H, V,
        caused, shaken, float(known.size[0]) ** 2 if noisy else np.nan,
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
        That tells the size of the errors.
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
           settings: Settings, *, noisy: bool) -> Iterator[_Added]:
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
            yield _Added(band, weight * rows @ rows.T, weight * (rows * size) @ (rows * size).T)


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


def _without_model(estimate: Estimate, record: Record) -> Iterator[str]:
    yield estimate.status.value
    if estimate.status in (Status.NO_EXCITATION, Status.TOO_SHORT):
        slow = max(s.period for s in record.outputs)
        yield (f'For a first model move the inputs between {2 / record.duration:.2g} and '
               f'{0.1 / slow:.2g} Hz (two periods in this window, a tenth of the slowest '
               'sampling), as strongly as is safe.')


def _sentences(poles: Sequence[PoleAdvice], wanted: float, seconds: float) -> Iterator[str]:
    """Return the advice in words, the poles that miss the wanted accuracy only."""
    missing = [p for p in poles if p.std > p.wanted]
    if not missing:
        yield (f'All poles are known to {100 * wanted:.3g} % of their size or better: nothing is '
               'missing.')
    for p in missing:
        yield (f'{_named(p.pole)}: standard deviation {p.std:.2g} rad/s, wanted {p.wanted:.2g}. '
               f'With the same excitation the data would have to be {p.longer:.2g} times as long'
               + (f', or the input {p.larger:.2g} times as large' if p.larger < np.inf else '')
               + '. ' + _band_words(p, seconds))


def _band_words(p: PoleAdvice, seconds: float) -> str:
    best = p.bands[0]
    if best.ratio > _SMALL:
        return 'No band of further excitation helps much: the noise has to become smaller.'
    words = (f'{seconds:.3g} s more of {best.input} at {best.low / (2 * pi):.2g} to '
             f'{best.high / (2 * pi):.2g} Hz, as large as now (rms {best.rms:.3g}), would divide '
             f'it by {1 / best.ratio:.2g}')
    return words + (f'; {p.enough:.2g} s are enough.' if p.enough < np.inf else '.')


def _named(pole: complex) -> str:
    kind = 'Pole' if pole.imag == 0 else 'Pair'
    value = f'{pole.real:.3g}' if pole.imag == 0 else f'{pole.real:.3g} +- {pole.imag:.3g}j'
    return f'{kind} {value}'
