# SPDX-License-Identifier: Apache-2.0
"""
The method `gobf`: subspace identification in generalized orthonormal bases, [TM] section IV.

Every signal goes through a chain of Takenaka-Malmquist filters. With w_v the chain's states for
the signal v, L and b of `bases.takenaka_malmquist`, and zero states of the chain at the start,

    w_y = O x - (s - L)^-1 (O B - b D) u - (s - L)^-1 O x_0,      O A - L O = b C       (6)

(Kronecker products with the identity of the outputs left out). This is [TM] eq. 6 and 7 with
feedthrough and initial state. x_0 and the trim are inputs of their own: an impulse at the start,
and the constant 1, each through the chain.

`docs/method.md` lists the errata of [TM]. The regressors psi_(j,i+1) M_i u of eq. 6, N (N + 1) / 2
of them, lie in the span of N, the chain itself: every one is a strictly proper function with poles
among the chain's. So u(t) of eq. 6 has dependent rows, L11 of lemma 3 is singular, and a plain LQ
factorisation gives arbitrary rows of Q. Here the N independent ones are used.

An output is D u + C B J u + C A B J^2 u + ..., J the integral, beside the smooth free response.
A held input jumps at its stamps, so J u has corners there, and J^2 u jumps of curvature. No
polynomial through samples of the output follows these. With S the interpolation, linear in the
samples, what it misses is (1 - S) y = C B (1 - S) J u + C A B (1 - S) J^2 u + ...: known signals
times unknown numbers. As inputs that act on the outputs at once, they make the equations of
interpolated outputs exact to the next power of the sampling period.

Pole sequences are from the data: `functions` poles, evenly spread up to a frequency (the Legendre
spacing of [TM] section III), which is one of a few fractions of the band in which the outputs rise
above their noise. The caller takes the model that simulates best. Of it only the poles are used:
[TM] takes C from the first filter alone (eq. 14), and B from the equations of filtered outputs
with free states (eq. 15). There an error of the observability matrix goes straight to B,
multiplied with the states: poles can be right to four digits and B to none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import factorial

import numpy as np

from ctsid_core.bases.records import Joint, output_band
from ctsid_core.bases.takenaka_malmquist import Chain, chain, legendre, of_one_degree, respond
from ctsid_core.errors import SettingsError
from ctsid_core.linear.least_squares import svd, triangle
from ctsid_core.linear.types import Array, plain_matrices
from ctsid_core.model.simulation import (
    Pieces,
    by_matrices,
    input_polynomials,
    knots_between,
    shifted,
)
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_core.subspace.hd_pbsid import SLOWEST, MethodModel

KINKS = 2             # integrals of held inputs whose kinks are worth it
_NOTHING = 1e-12      # of a signal, that interpolation misses by rounding
_FRACTIONS = (1.0, 0.3, 0.1)    # of the outputs' band, that the largest pole may lie at
_FUNCTIONS = 8
_SHARE = 0.8                    # of the fewest samples, that rows of the equations may be


def by_bases(part: Joint, settings: Settings, orders: Sequence[int],
             check: Callable[[], None]) -> Iterator[MethodModel]:
    """
    Yield models of all orders that the chain can hold, for each pole sequence that comes in.

    Raises `SettingsError` if the pole sequence of the settings is none.
    """
    records = [p.record for p in part.parts]
    nu, ny = records[0].nu, records[0].ny
    delay = settings.delays(nu)
    samples = sum(len(sample_times(record)) for record in records)
    for own in _chains(part, settings, max(orders)):
        if own.size * (nu + 2 * len(records) + ny) > _SHARE * samples:
            continue
        filtered = filter_records(records, own, delay, trim=settings.trim,
                                  feedthrough=settings.feedthrough, check=check)
        seen = observe(filtered, settings.rank_tolerance)
        real, imag = own.poles.real.tolist(), own.poles.imag.tolist()
        used = settings.replace(tm_real=tuple(real), tm_imag=tuple(imag) if any(imag) else 'auto',
                                tm_functions=own.size)
        for n in orders:
            if n >= min(own.size * ny - 1, len(seen.singular_values)):
                continue
            A, C = dynamics(own, seen.left[:, :n])
            yield MethodModel(
                plain_matrices(A, np.zeros((n, nu)), C, np.zeros((ny, nu))),
                used.replace(order=n), seen.singular_values, seen.condition, poles_only=True)


def _chains(part: Joint, settings: Settings, order: int) -> list[Chain]:
    """Return the chains that the settings leave open."""
    if not isinstance(settings.tm_real, str):
        real = np.atleast_1d(np.array(settings.tm_real, dtype=float))
        imag = np.zeros(len(real)) if isinstance(settings.tm_imag, str) else \
            np.atleast_1d(np.array(settings.tm_imag, dtype=float))
        if len(real) != len(imag):
            raise SettingsError([f'`takenaka_malmquist.poles_imag` has {len(imag)} values, '
                                 f'`takenaka_malmquist.poles_real` {len(real)}; give one for each '
                                 'pole, or auto'])
        return [chain(np.asarray(real + 1j * imag, dtype=complex))]
    records = [p.record for p in part.parts]
    size = settings.tm_functions or max(
        _FUNCTIONS, 2 * -(-(settings.order or min(order, 6)) // records[0].ny))
    band = max(output_band(record) for record in records)
    least = SLOWEST / part.length
    tops = sorted({max(band * fraction, least) for fraction in _FRACTIONS}, reverse=True)
    return [legendre(top / (size - 0.5), size) for top in tops]


@dataclass(frozen=True, eq=False)
class Filtered:
    """Signals through a chain, compressed by one QR factorisation."""

    chain: Chain
    inputs: Array  # (N, k, columns): u, impulses (initial states), constants 1 (trim), kinks
    y: Array       # (N, ny, columns)
    counts: tuple[int, int, int, int]  # how many of the inputs are u, impulses, constants, kinks

    @property
    def scale(self) -> Array:
        """Size of each output, (ny,); 1 for one that is zero."""
        size = np.sqrt(np.sum(self.y ** 2, axis=(0, 2)))
        return np.where(size == 0.0, 1.0, size)


@dataclass(frozen=True, eq=False)
class Observability:
    """What lemma 3 of [TM] gives, of outputs that were scaled to equal power."""

    left: Array             # (N ny, r): left singular vectors of L22; the outputs run fastest
    singular_values: Array  # (r,)
    condition: float        # of the chain's states of the inputs, dependent directions left out


def filter_records(records: Sequence[Record], chain: Chain, delay: tuple[float, ...], *,
                   trim: bool, feedthrough: bool = True, pieces: Pieces = input_polynomials,
                   kinks: int = KINKS, check: Callable[[], None] = lambda: None) -> Filtered:
    """
    Return the signals of records through a chain, at the stamps of the densest output of each.

    Each record of the one plant has an initial state and, with `trim`, a constant of its own. Dead
    times are those of the inputs [s]; with feedthrough u acts on y at once, and y is as uneven.
    `pieces` says what signals are between their samples, and `kinks` how many integrals of inputs
    that are held, or on straight lines, are looked at for what interpolation misses of them.
    """
    found = [_filtered(record, chain, delay, pieces, kinks, feedthrough, check)
             for record in records]
    nu, ny, count = records[0].nu, records[0].ny, len(records)
    blocks = []
    for i, part in enumerate(found):
        own = np.zeros((*part.shape[:2], count * (1 + trim)))     # of each record one, or two
        own[:, :, i::count] = part[:, :, nu:nu + 1 + trim]
        blocks.append(np.concatenate((part[:, :, :nu], own, part[:, :, nu + 2:]), axis=2))
    rows = np.concatenate(blocks)
    check()
    missed = slice(nu + count * (1 + trim), -ny)
    keep = np.ones(rows.shape[2], dtype=bool)
    keep[missed] = np.any(rows[:, :, missed], axis=(0, 1))
    counts = (nu, count, count * trim, int(keep[missed].sum()))
    flat = rows[:, :, keep].transpose(1, 2, 0).reshape(-1, len(rows))
    check()
    compressed = triangle(flat.T).T if flat.shape[1] > flat.shape[0] else flat
    short = compressed.reshape(chain.size, sum(counts) + ny, -1)
    return Filtered(chain, short[:, :-ny], short[:, -ny:], counts)


def _filtered(record: Record, chain: Chain, delay: tuple[float, ...], pieces: Pieces,
              kinks: int, feedthrough: bool, check: Callable[[], None]) -> Array:
    """Return u, impulse, constant, kinks and y through a chain, (times, N, signals)."""
    times = sample_times(record)
    none = (0.0,) * record.ny
    knots = knots_between((*record.inputs, *record.outputs), (*delay, *none), times)
    u = pieces(record.inputs, delay, knots)
    y = pieces(record.outputs, none, knots)
    uneven = np.repeat([s.hold != 'smooth' for s in record.inputs],
                       [s.width for s in record.inputs]).astype(bool)
    missed = interpolation_errors(u[:, :, uneven], knots, record.outputs, pieces, kinks,
                                  0 if feedthrough else 1, check)
    ones = np.ones((1, len(knots), 1))
    signals = np.concatenate(of_one_degree((u, ones, missed, y)), axis=2)
    w = respond(chain, signals, knots, check)[np.searchsorted(knots, times)]
    b = chain.b[:, np.newaxis]
    impulse = by_matrices(chain.L, b, np.empty((0, 0, 1, 1)), np.diff(times), b, check=check)
    return np.concatenate((w[:, :, :record.nu], impulse, w[:, :, record.nu:]), axis=2)


def sample_times(record: Record) -> Array:
    """Return the stamps of the densest output within the record, and its start and end [s]."""
    own = [s.time[(s.time > record.start) & (s.time < record.end)] for s in record.outputs]
    return np.concatenate(([record.start], max(own, key=len), [record.end]))


def observe(filtered: Filtered, rank_tolerance: float) -> Observability:
    """
    Return the column space of O ([TM] lemma 3).

    Directions of the inputs below `rank_tolerance` of the largest are left out.
    """
    U = filtered.inputs.reshape(-1, filtered.inputs.shape[2])
    Y = (filtered.y / filtered.scale[:, np.newaxis]).reshape(-1, U.shape[1])
    norm = np.sqrt(np.sum(U ** 2, axis=1))
    norm[norm == 0.0] = 1.0
    _, s, right = svd(U / norm[:, np.newaxis])
    rank = int(np.count_nonzero(s > rank_tolerance * s[0])) if len(s) else 0
    inside = right[:rank]
    left, values, _ = svd(Y - (Y @ inside.T) @ inside)
    return Observability(left, values, float(s[0] / s[rank - 1]) if rank else 1.0)


def dynamics(chain: Chain, theta: Array) -> tuple[Array, Array]:
    """
    Return A and C of an extended observability matrix (N ny, n), up to a change of states.

    [TM] eq. 11 to 14; the outputs run fastest. Of N ny rows, those of the first N - 1 functions
    differ from the next.
    """
    sigma, n = chain.poles, theta.shape[1]
    seen = np.tensordot(chain.turn, theta.reshape(chain.size, -1, n), axes=1)
    root = np.sqrt(2.0 * sigma.real)[:, np.newaxis, np.newaxis]
    pole = sigma[:, np.newaxis, np.newaxis]
    M = (seen / root)[:-1] - (seen / root)[1:]
    R = (pole.conj() * seen / root)[:-1] + (pole * seen / root)[1:]
    left, right = (np.vstack((x.real.reshape(-1, n), x.imag.reshape(-1, n))) for x in (M, R))
    A: Array = np.linalg.lstsq(left, right, rcond=None)[0]
    C = seen[0] @ (A + sigma[0] * np.eye(n)) / root[0, 0, 0]
    return A, np.asarray(C.real)


def integrated(derivatives: Array, knots: Array) -> Array:
    """
    Return the integral from the first knot of piecewise polynomials, in the same form.

    From derivatives just after each knot, (degree + 1, K, m), at knots (K,) [s]; one degree more.
    """
    h = np.diff(knots)[:, np.newaxis]
    steps = sum((v[:-1] * h ** (j + 1) / factorial(j + 1) for j, v in enumerate(derivatives)),
                np.zeros(()))
    value = np.concatenate([np.zeros_like(derivatives[0, :1]), np.cumsum(steps, axis=0)])
    return np.concatenate([value[np.newaxis], derivatives])


def interpolation_errors(u: Array, knots: Array, outputs: Sequence[Signal], interpolate: Pieces,
                         count: int, first: int,
                         check: Callable[[], None] = lambda: None) -> Array:
    """
    Return what interpolation of each output signal misses of the inputs' integrals.

    Inputs u (degree + 1, K, nu) are given with derivatives just after each knot; all stamps are
    among the knots (K,) [s]. Of the outputs, stamps and holds count. `count` integrals are looked
    at, none at all for 0, and with `first` = 0 the inputs themselves, which outputs follow at
    once. Shape (degree + 1 + count or less, K, (count + 1 - first) * nu * signals), zero where it
    is no more than rounding.
    """
    found: list[Array] = []
    integral = u
    for power in range(count + 1 if u.shape[2] and count else 0):
        check()
        integral = integrated(integral, knots) if power else integral
        if power >= first:
            found += [_interpolation_error(integral, knots, signal, interpolate)
                      for signal in outputs]
    return np.concatenate(of_one_degree(found), axis=2) if found else np.zeros((1, len(knots), 0))


def _interpolation_error(signal: Array, knots: Array, output: Signal,
                         interpolate: Pieces) -> Array:
    inside = np.isin(output.time, knots)
    places = np.searchsorted(knots, output.time[inside])
    m = signal.shape[2]
    sampled = replace(output, time=output.time[inside], values=signal[0, places], names=(),
                      units=())
    curve = interpolate((sampled,), (0.0,) * m, knots)
    whole, smooth = of_one_degree((signal, curve))
    error = whole - smooth
    size = np.abs(signal[0]).max(axis=0) + 1e-300
    middle = shifted(error[:, :-1], 0.5 * np.diff(knots)[:, np.newaxis])[0]
    error[:, :, np.abs(middle).max(axis=0) <= _NOTHING * size] = 0.0
    return error
