# SPDX-License-Identifier: Apache-2.0
"""
Search for the order and the modes of a model on the raw output samples.

Where samples come in bursts, what lies between them can only be told by a model of the inputs'
effect, not by interpolation. Modes are therefore found one after the other: of a grid of real
poles and pairs, the one whose exact response explains most of what a model leaves of the samples
joins it, and all of them are taken to the maximum of the likelihood (orthogonal matching pursuit:
Pati, Rezaiifar and Krishnaprasad 1993, Asilomar 27). Schwarz's criterion chooses the order: the
first one that neither one more pole nor one more pair improves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.likelihood.samples_output_error import (
    InTime,
    climb_in_time,
    errors_in_time,
    with_covariance,
)
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array, Lines
from ctsid_core.model.estimate import OrderTried
from ctsid_core.model.mode_responses import Stamps, elementary, responses, slopes, stamps_of
from ctsid_core.search.order import NOTHING_LEFT
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record

_REAL = 16            # real poles on the grid
_DAMPING = (0.1, 0.4, 0.8)
_PAIRS = 24           # natural frequencies on the grid at each damping
_LIGHT = 300          # lightly damped pairs on the grid at most
_AT_ONCE = 64         # poles whose responses are computed at a time
_LARGEST = 1e7        # numbers that the responses of the grid may take
_STEPS = 8            # of the way to the maximum, while models are compared with others
_NYQUIST = 0.8        # part of the Nyquist frequency within bursts that is looked at


@dataclass(frozen=True)
class ModeSearch:
    """
    The model that was chosen, and the table of criteria that decided.

    Parameters
    ----------
    fit : InTime
    table : tuple of OrderTried
        Schwarz's criterion above its smallest value, by order.
    """

    fit: InTime
    table: tuple[OrderTried, ...]


def search_in_time(record: Record, delay: tuple[float, ...],
                   settings: Settings) -> ModeSearch | None:
    """
    Find the order and a model on the raw samples; None if none can be made of them, or too many.

    Parameters
    ----------
    record : Record
    delay : tuple of float, length nu
        Dead time of each input [s].
    settings : Settings
        Of which order, max_order, feedthrough and trim matter here.
    """
    stamps = stamps_of(record, delay, settings.trim)
    grid = _grid(stamps)
    if 2 * len(grid) * (stamps.nu + 1) * len(stamps.times) > _LARGEST:
        return None
    shapes = _shapes(stamps, grid)
    feed, top = settings.feedthrough, settings.order or settings.max_order
    best = {0: _nothing(stamps, settings)}
    criterion: dict[int, float] = {}
    for n in range(top):
        if n not in best:
            continue
        for start in _extended(stamps, best[n][0], grid, shapes):
            order = len(start.A)
            rival = best[order][1] if order in best else np.inf
            found = climb_in_time(stamps, start, feed, limit=1.0 / stamps.since[-1],
                                  steps=_STEPS, rival=rival) if order <= top else None
            if found is not None:
                best[order] = found
                criterion[order] = found[1] + _price(found[0], stamps, feed)
        chosen = min(criterion, key=lambda k: criterion[k], default=0)
        if not settings.order and (n >= chosen or _clean(stamps, best[chosen][0])):
            break
    chosen = settings.order or chosen
    table = tuple(OrderTried(k, criterion[k] - criterion[chosen], float('nan'))
                  for k in sorted(criterion) if not settings.order)
    if chosen not in criterion:
        return None
    found = climb_in_time(stamps, best[chosen][0], feed, limit=1.0 / stamps.since[-1])
    fit = with_covariance(stamps, *(found or best[chosen]), feed)
    return None if fit is None else ModeSearch(fit, table)


def _price(m: Matrices, stamps: Stamps, feedthrough: bool) -> float:
    """Return what Schwarz's criterion charges for a model, its gauge apart."""
    n, ny = len(m.A), len(m.C)
    direct = m.B.shape[1] * feedthrough + m.y_trim.shape[1]
    return float((n * (m.B.shape[1] + 1 + ny) + ny * direct) * np.log(stamps.counts.sum()))


def _clean(stamps: Stamps, m: Matrices) -> bool:
    errors = errors_in_time(stamps, m)
    return errors is not None and all(
        (np.mean(e ** 2, axis=1) <= NOTHING_LEFT * np.var(y, axis=1)).all()
        for e, y in zip(errors, stamps.y, strict=True))


def _nothing(stamps: Stamps, settings: Settings) -> tuple[Matrices, float]:
    """Return the model without states: level and feedthrough are left to what follows."""
    ny, ones = len(stamps.counts), int(settings.trim)
    m = Matrices(A=np.zeros((0, 0)), B=np.zeros((0, stamps.nu)), C=np.zeros((ny, 0)),
                 D=np.zeros((ny, stamps.nu)), K=np.zeros((0, ny)), tail=np.zeros((0, 1)),
                 x_trim=np.zeros((0, ones)), y_trim=np.zeros((ny, ones)))
    return m, np.inf


def _grid(stamps: Stamps) -> Lines:
    """Return the poles that are tried: real ones, and one of each pair [rad/s]."""
    length = float(stamps.times[-1] - stamps.times[0])
    slow, top = 1.0 / length, _NYQUIST * np.pi / float(np.median(np.diff(stamps.times)))
    real = -np.geomspace(slow, top, _REAL)
    size = np.geomspace(2.0 * np.pi * slow, top, _PAIRS)
    pairs = [size * (-z + 1j * np.sqrt(1.0 - z * z)) for z in _DAMPING]
    count = int(min(np.ceil(2.0 * top / (np.pi * slow)), _LIGHT))
    light = -2.0 * slow + 1j * np.linspace(np.pi * slow, top, count)
    return np.concatenate((real, *pairs, light))


def _shapes(stamps: Stamps, grid: Lines) -> Array:
    """Return the responses of each pole on the grid, real and imaginary, (G, rows, M)."""
    found = []
    for part in np.array_split(grid, -(-len(grid) // _AT_ONCE)):
        s = elementary(stamps, part)[:, :stamps.nu + 1]
        found.append(np.concatenate((s.real, s.imag), axis=1))
    return np.concatenate(found)


def _extended(stamps: Stamps, m: Matrices, grid: Lines, shapes: Array) -> Iterator[Matrices]:
    """Yield a model with the real pole, and one with the pair, that promise most."""
    known, errors = _known(stamps, m), errors_in_time(stamps, m)
    if known is None or errors is None:
        return
    real = grid.imag == 0.0
    score = np.zeros(len(grid))
    directions = []
    for error, (_, rows) in zip(errors, stamps.streams, strict=True):
        basis = np.linalg.svd(known[:, rows].T, full_matrices=False)
        basis_q = basis[0][:, basis[1] > 1e-9 * max(basis[1][0], 1e-300)]
        left = error - (error @ basis_q) @ basis_q.T
        own = shapes[:, :, rows] - (shapes[:, :, rows] @ basis_q) @ basis_q.T
        size = np.linalg.norm(own, axis=2)
        new = size > 1e-6 * np.linalg.norm(shapes[:, :, rows], axis=2)
        own = np.where(new[:, :, np.newaxis], own / np.where(new, size, 1.0)[:, :, np.newaxis], 0)
        gram = own @ own.swapaxes(1, 2) + 1e-8 * np.eye(own.shape[1])
        pull = own @ left.T                                         # (G, rows, channels)
        theta = np.linalg.solve(gram, pull)
        gain = np.einsum('gri,gri->gi', theta, pull) / np.maximum(
            np.sum(left ** 2, axis=1), 1e-300)
        score += error.shape[1] * np.log1p(-np.clip(gain, 0.0, 1.0 - 1e-12)).sum(axis=1)
        directions.append(theta / np.where(new, size, 1.0)[:, :, np.newaxis])
    weights = np.concatenate(directions, axis=2)                    # (G, rows, ny)
    for kind in (real, ~real):
        place = int(np.flatnonzero(kind)[np.argmin(score[kind])])
        yield _joined(m, grid[place], weights[place], shapes[place])


def _known(stamps: Stamps, m: Matrices) -> Array | None:
    """Return what a model explains, whatever its residues, and if its poles move: (rows, M)."""
    direct: Array = stamps.drive[0][stamps.places].T
    if not len(m.A):
        return direct
    found = responses(stamps, m)
    if found is None:
        return None
    bent = slopes(stamps, found.modes.values)
    parts = [part.reshape(-1, part.shape[2]) for part in (found.s, bent)]
    rows = np.concatenate([direct, *(p.real for p in parts), *(p.imag for p in parts)])
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    known: Array = rows / np.where(size > 0.0, size, 1.0)
    return known


def _joined(m: Matrices, pole: complex, weights: Array, shape: Array) -> Matrices:
    """Return the model with one more mode; its residues (rows, ny) say what it does to outputs."""
    half = len(weights) // 2
    residue = (weights[:half] - 1j * weights[half:]) * np.linalg.norm(shape[:half], axis=1,
                                                                     keepdims=True)
    c = np.linalg.svd(residue.T if pole.imag else residue.T.real)[0][:, 0]
    block = np.array([[pole.real]]) if pole.imag == 0.0 else np.array(
        [[pole.real, -pole.imag], [pole.imag, pole.real]])
    columns = c.real[:, np.newaxis] if pole.imag == 0.0 else np.stack((c.real, -c.imag), axis=1)
    n, more = len(m.A), len(block)
    A = np.zeros((n + more, n + more))
    A[:n, :n], A[n:, n:] = m.A, block

    def longer(matrix: Array) -> Array:
        return np.vstack((matrix, np.zeros((more, matrix.shape[1]))))

    return replace(m, A=A, B=longer(m.B), C=np.hstack((m.C, columns)), K=longer(m.K),
                   tail=longer(m.tail), x_trim=longer(m.x_trim))
