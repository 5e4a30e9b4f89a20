# SPDX-License-Identifier: Apache-2.0
"""
Continuous-time PBSID in the Laguerre domain (CT-PBSID), by projections.

What follows an instant t of the record is projected on a few Laguerre functions of pole a. With
c = sqrt(2 a), M = (A - a I)^-1 and xi_0 = x(t) the coefficients obey, whatever x(t) is,

    xi_(k+1) = A_o xi_k + B_o u_k + K_o e_k,      y_k = C_o xi_k + D_o u_k + e_k
    A_o = M (A + a I),   B_o = c M B,   C_o = -c C M,   D_o = D - C M B,

because l_k' + a l_k = l_(k-1)' - a l_(k-1) and all l_k(0) = c. Every instant is one run of this
discrete system from its own state, k = 0 .. p + 1: PBSID with one column for each instant. They
are the stamps of the slowest output, but for the last ones, from which the functions reach beyond
the end of the record. The model is then mapped back ([HD] eq. 4).

Trim is a constant, whose coefficients are the same seen from any instant but for their sign:
columns are centred instead of another input being added. D_o is free even if D is zero.

References
----------
Bergamasco and Lovera 2011, IET Control Theory & Applications 5; [HD] sections 1, 2 and 5.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.special import eval_laguerre

from ctsid_core.bases.records import Joint, output_band
from ctsid_core.bases.takenaka_malmquist import chain, respond
from ctsid_core.linear.least_squares import triangle
from ctsid_core.linear.types import Array, Matrices, plain_matrices
from ctsid_core.model.simulation import input_polynomials, knots_between, shifted
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_core.subspace.hd_pbsid import SLOWEST, Levels, MethodModel, Tuning, realise, regress

_PASTS = (4, 6, 10, 15)   # values of p tried; [HD] has 10
_POLES = 6                # values of the Laguerre pole tried
_LONGEST = 0.4            # of the record that functions may reach at most, if the pole is chosen
_MOST = 20000             # instants of a record
_DECAYED = 1e-10          # of a Laguerre function: what counts as zero


def by_projection(part: Joint, settings: Settings, orders: Sequence[int],
                  check: Callable[[], None]) -> Iterator[MethodModel]:
    """Yield the models of every order, pole and past left open."""
    records = [p.record for p in part.parts]
    pasts = [settings.past] if settings.past else _PASTS
    longest = max(r.duration for r in records)
    for a in _poles(records, settings, min(pasts)):
        # Functions have to decay within the records, with as much time to spare.
        fitting = [p for p in pasts if longest > 2.0 * reach(p + 2) / a]
        if not fitting:
            continue
        levels = laguerre_levels(records, settings, a, max(fitting) + 2, check)
        nz = len(levels.scale)
        for p in fitting:
            first = replace(levels, rows=levels.rows[-(p + 2):, :, :(p + 2) * nz])
            check()
            yield from _realised(first, settings.replace(
                laguerre_pole=a, past=p, future=settings.future or p), orders)


def _realised(levels: Levels, settings: Settings, orders: Sequence[int]) -> Iterator[MethodModel]:
    """Yield the models of one pole and one p; none if there are too few instants."""
    p, a = settings.past, settings.laguerre_pole
    nz, ny = len(levels.scale), levels.counts[3]
    if levels.rows.shape[2] < (p + 2) * nz:
        return
    subspace = regress(levels, Tuning(0.0, 1.0, p, settings.future), feedthrough=True,
                       rank_tolerance=settings.rank_tolerance)
    for n in orders:
        if n < min(p * ny, settings.future * ny + 1):
            yield MethodModel(to_continuous(realise(subspace, n), a), settings.replace(order=n),
                              subspace.singular_values, subspace.condition)


def _poles(records: Sequence[Record], settings: Settings, past: int) -> list[float]:
    """Return the Laguerre poles to try [rad/s]."""
    if settings.laguerre_pole:
        return [settings.laguerre_pole]
    length = max(r.duration for r in records)
    low = max(reach(past + 2) / _LONGEST, SLOWEST) / length
    high = max(max(output_band(r) for r in records), 4.0 * low)
    return [float(a) for a in np.geomspace(low, high, _POLES)]


def laguerre_levels(records: Sequence[Record], settings: Settings, a: float, count: int,
                    check: Callable[[], None] = lambda: None) -> Levels:
    """
    Return the Laguerre coefficients of records, compressed by one QR factorisation.

    Of `count` = p + 2 functions of pole a [rad/s]; at index m that of order count - 1 - m, with a
    row for each input and output. Too short records are left out.
    """
    nu, ny = records[0].nu, records[0].ny
    delays, blocks = (*settings.delays(nu), *(0.0,) * ny), []
    for record in records:
        if len(at := instants(record, reach(count) / a)):
            block = coefficients((*record.inputs, *record.outputs), at,
                                 (record.start, record.end), a, count, delays, check)
            blocks.append(block - block.mean(axis=2, keepdims=True) if settings.trim else block)
    check()
    z = np.concatenate(blocks, axis=2)                        # (count, nz, instants)
    scale = np.sqrt(np.mean(z ** 2, axis=(0, 2)))
    scale[scale == 0.0] = 1.0
    z /= scale[:, np.newaxis]
    compressed = triangle(z.reshape(-1, z.shape[2]).T).T
    return Levels(compressed.reshape(count, nu + ny, -1)[::-1], scale, (nu, 0, 0, ny))


def coefficients(signals: Sequence[Signal], at: Array, span: tuple[float, float], a: float,
                 count: int, delays: Sequence[float],
                 check: Callable[[], None] = lambda: None) -> Array:
    """
    Return `count` Laguerre coefficients of signals seen from instants (M,): (count, channels, M).

    Of pole a [rad/s], channels later by their delays [s] and zero outside of the span [s]. They
    are the responses of a chain of equal Takenaka-Malmquist filters in reversed time.
    """
    knots = knots_between(signals, delays, np.unique(np.concatenate((span, at))))
    ahead = input_polynomials(signals, delays, knots)[:, :-1]
    # The derivatives at the ends of intervals, where they begin in reversed time
    ends = shifted(ahead, np.diff(knots)[:, np.newaxis])
    ends[1::2] *= -1.0
    seen = respond(chain([a] * count), ends[:, ::-1], -knots[::-1], check)
    return seen[::-1][np.searchsorted(knots, at)].transpose(1, 2, 0)


@lru_cache(maxsize=64)
def reach(count: int) -> float:
    """Return the time after which so many Laguerre functions have decayed, times their pole."""
    x = np.linspace(0.0, 12.0 * count + 80.0, 2000)
    functions = np.exp(-0.5 * x) * eval_laguerre(np.arange(count)[:, np.newaxis], x)
    alive = np.abs(functions).max(axis=0) > _DECAYED
    return 0.5 * float(x[np.flatnonzero(alive)[-1] + 1])


def instants(record: Record, length: float) -> Array:
    """Return the instants [s] from which a record is seen by functions that reach `length` [s]."""
    at = min((s.time[s.rows(record.start, record.end - length)] for s in record.outputs), key=len)
    return at[::-(-len(at) // _MOST) or 1]


def to_continuous(m: Matrices, a: float) -> Matrices:
    """Map A_o, B_o, C_o, D_o, K_o of Laguerre pole a [rad/s] back to a model ([HD] eq. 4)."""
    c, ones = np.sqrt(2.0 * a), np.eye(len(m.A))
    try:
        A = a * np.linalg.solve(m.A - ones, m.A + ones)
        less = A - a * ones
        C = -m.C @ less / c
        D = m.D + C @ np.linalg.solve(less, less @ m.B) / c
        K = less @ np.linalg.solve(c * ones + m.K @ C, m.K)
    except np.linalg.LinAlgError:                  # a pole at infinity: not a model
        A, C, D, K = (np.full_like(x, np.nan) for x in (m.A, m.C, m.D, m.K))
        less = A
    return plain_matrices(A, less @ m.B / c, C, D, K)
