# SPDX-License-Identifier: Apache-2.0
"""
The method `gobf`: models of the Takenaka-Malmquist subspace method, for every order wanted.

Pole sequences from the data: `functions` poles, evenly spread up to a frequency (the Legendre
spacing of [TM] section III), which is one of a few fractions of the band in which the outputs
rise above their noise. The caller takes the model that simulates best.

Only its poles are used. [TM] takes C from the first filter alone (eq. 14), and B from the
equations of filtered outputs with free states (eq. 15). There an error of the observability matrix
goes straight to B, multiplied with the states: poles can be right to four digits and B to none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.bases.bandwidth import output_band
from ctsid_core.bases.records import Joint
from ctsid_core.bases.takenaka_malmquist import Chain, chain, legendre
from ctsid_core.errors import SettingsError
from ctsid_core.linear.types import ComplexArray, plain_matrices
from ctsid_core.settings import Settings
from ctsid_core.subspace.gobf_equations import (
    dynamics,
    filter_records,
    observe,
    sample_times,
)
from ctsid_core.subspace.interface import SLOWEST, MethodModel

_FRACTIONS = (1.0, 0.3, 0.1)    # of the outputs' band, that the largest pole may lie at
_FUNCTIONS = 8
_SHARE = 0.8                    # of the fewest samples, that rows of the equations may be


def by_bases(part: Joint, settings: Settings, orders: Sequence[int]) -> list[MethodModel]:
    """
    Return models of all orders that the chain can hold, for each pole sequence that comes in.

    Raises `SettingsError` if the pole sequence of the settings is none.
    """
    records = [p.record for p in part.parts]
    nu, ny = records[0].nu, records[0].ny
    delay = settings.delays(nu)
    samples = sum(len(sample_times(record)) for record in records)
    found = []
    for own in _chains(part, settings, max(orders)):
        if own.size * (nu + 2 * len(records) + ny) > _SHARE * samples:
            continue
        filtered = filter_records(records, own, delay, trim=settings.trim,
                                  feedthrough=settings.feedthrough)
        seen = observe(filtered, settings.rank_tolerance)
        for n in orders:
            if n >= min(own.size * ny - 1, len(seen.singular_values)):
                continue
            A, C = dynamics(own, seen.left[:, :n])
            found.append(MethodModel(
                plain_matrices(A, np.zeros((n, nu)), C, np.zeros((ny, nu))),
                _used(settings, own, n), seen.singular_values, seen.condition, poles_only=True))
    return found


def _used(settings: Settings, own: Chain, n: int) -> Settings:
    imag = tuple(own.poles.imag.tolist()) if np.any(own.poles.imag) else 'auto'
    return settings.replace(order=n, tm_real=tuple(own.poles.real.tolist()), tm_imag=imag,
                            tm_functions=own.size)


def _chains(part: Joint, settings: Settings, order: int) -> list[Chain]:
    """Return the chains that the settings leave open."""
    given = _given(settings)
    if given is not None:
        return [chain(given)]
    records = [p.record for p in part.parts]
    size = settings.tm_functions or max(
        _FUNCTIONS, 2 * -(-(settings.order or min(order, 6)) // records[0].ny))
    band = max(output_band(record) for record in records)
    least = SLOWEST / part.length
    tops = sorted({max(band * fraction, least) for fraction in _FRACTIONS}, reverse=True)
    return [legendre(top / (size - 0.5), size) for top in tops]


def _given(settings: Settings) -> ComplexArray | None:
    """Return the pole sequence of the settings; None if it is to be found."""
    if isinstance(settings.tm_real, str):
        return None
    real = np.atleast_1d(np.array(settings.tm_real, dtype=float))
    imag = np.zeros(len(real)) if isinstance(settings.tm_imag, str) else \
        np.atleast_1d(np.array(settings.tm_imag, dtype=float))
    if len(real) != len(imag):
        raise SettingsError([f'`takenaka_malmquist.poles_imag` has {len(imag)} values, '
                             f'`takenaka_malmquist.poles_real` {len(real)}; give one for each '
                             'pole, or auto'])
    return np.asarray(real + 1j * imag, dtype=complex)
