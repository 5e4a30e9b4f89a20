# SPDX-License-Identifier: Apache-2.0
"""
Which experiment would make a model as accurate as it is wanted.

Longer, larger, or in which band: for every pole, from the information that further data would
add (`forecast.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import pi

import numpy as np
from scipy.optimize import brentq

from ctsid_core.advice.forecast import Band, Forecast, forecast
from ctsid_core.errors import DataError
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import Remedy
from ctsid_core.signals.record import Record

_MOST = 1e4           # times as long or as large: never
_SMALL = 0.97         # of the deviation: a band that leaves more than this does not help


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

    Parameters
    ----------
    estimate : Estimate
        Of `identify(record, ...)`; a rejected model serves as well.
    record : Record or sequence of Record
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
        of = forecast(estimate, model, covariance, records)
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


def _advice(of: Forecast, k: int, wanted: float, seconds: float) -> PoleAdvice:
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
