# SPDX-License-Identifier: Apache-2.0
"""
What jumps at some instants explains, to first order: the gain of an input, or a load at it.

Who says that a plant changes has a rival. Somebody leans on a robot for a second, a gust hits a
drone, a wheel climbs a bump: one plant, and a load that nobody measures comes and goes. It counts
if it explains as much with as many numbers.

References
----------
Pati, Rezaiifar and Krishnaprasad 1993, Asilomar Conference (orthogonal matching pursuit).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ctsid_core.judge.slopes import Left, Slopes
from ctsid_core.linear.types import Array

INSTANTS = 48         # parts of a record, between which anything may jump
_MOST = 20            # jumps
NOTHING = 1e-4        # of a column: less is left of it by rounding

_Jump = tuple[int, int, int]               # its channel, from which instant, to which


def under_loads(slopes: Slopes, jumps: int, common: Array) -> Left:
    """
    Return what loads leave that jump so often, beside common columns.

    One jump after another, or two by two, whichever explains more: the first jump of a short push
    explains nothing by itself.
    """
    steps, lefts = moved_by(slopes, None), list[Left]()
    for pairs in (False, True):
        *_, found = [], *(one for one, _ in jumps_of(slopes, steps, jumps, pairs, common))
        lefts.append(slopes.beside(np.column_stack((common, *(
            steps[start, :, j] - steps[end, :, j] for j, start, end in found)))))
    return min(lefts, key=lambda left: left.cost)


def jumps_of(slopes: Slopes, steps: Array, most: int = _MOST, pairs: bool = False,
             common: Array | None = None) -> Iterator[tuple[list[_Jump], Array]]:
    """
    Yield the jumps that explain most beside those before, and the errors that are left.

    `steps` (instants, N, channels) are what jumps at each instant move. Pairs begin at any of
    them, and count twice; what is no pair, or the last of an odd number, begins with the record.
    """
    slopes.samples.effort.spend(2.0 * steps.size * (slopes.rows.shape[1] + INSTANTS))
    least = (NOTHING * np.max(np.linalg.norm(steps, axis=1))) ** 2
    rows, error = slopes.without(steps.transpose(1, 2, 0).reshape(steps.shape[1], -1), common)
    columns = rows.reshape(len(rows), -1, INSTANTS).transpose(1, 0, 2)
    products = columns.swapaxes(1, 2) @ columns
    found, count = list[_Jump](), 0
    while count < most:
        slopes.samples.effort.spend(3.0 * columns.size)
        jump = _most_telling(products, error @ columns, least,
                             INSTANTS if pairs and count + 1 < most else 1)
        if jump is None:
            return
        j, start, end = jump
        best = columns[j, :, start] - columns[j, :, end]
        best = best / np.linalg.norm(best)
        error = error - best * (best @ error)
        less = best @ columns
        columns = columns - best[:, np.newaxis] * less[:, np.newaxis]
        products = products - less[:, :, np.newaxis] * less[:, np.newaxis]
        found.append(jump)
        count += 1 + (start > 0)
        yield found.copy(), error


def _most_telling(products: Array, told: Array, least: float, starts: int) -> _Jump | None:
    """Return the jump that explains most, from one of the first instants; None if none does."""
    own = np.diagonal(products, axis1=1, axis2=2)
    size = own[:, :starts, np.newaxis] + own[:, np.newaxis] - 2.0 * products[:, :starts]
    tells = np.where(size > least, (told[:, :starts, np.newaxis] - told[:, np.newaxis]) ** 2
                     / np.maximum(size, 1e-300), 0.0)
    j, start, end = map(int, np.unravel_index(int(np.argmax(tells)), tells.shape))
    return (j, start, end) if tells[j, start, end] > 0.0 else None


def moved_by(slopes: Slopes, means: Sequence[Array] | None) -> Array:
    """
    Return what inputs move from each instant on, (instants, N, nu), outputs over errors.

    By themselves: what they move at all, less what is left of that by then, which decays, and
    what their `means` move. Without these what a constant load at each of them moves.
    """
    samples, model = slopes.samples, slopes.fit.model
    found = np.zeros((INSTANTS, len(slopes.error), samples.nu))
    at = 0
    for r, (record, triangles) in enumerate(zip(samples.records, slopes.fit.columns.triangles,
                                                strict=True)):
        mean = np.ones(samples.nu) if means is None else means[r]
        start, end = record.span
        for s, t in zip(record.streams, triangles, strict=True):
            (count, channels), size = s.y.shape, np.sqrt(slopes.fit.power[r, s.channels])
            residues = (model.c[s.channels] / size[:, np.newaxis]).T \
                * model.b.T[:, :, np.newaxis]                           # (nu, m, channels)
            direct = (model.D[s.channels] / size[:, np.newaxis]).T[:, np.newaxis]
            inputs = (t.z[:, :, :samples.nu], t.u) if means is not None else (
                np.zeros((count, len(model.poles), samples.nu)), np.zeros((count, samples.nu)))
            for k in range(INSTANTS):
                first = int(np.searchsorted(s.times, start + k / INSTANTS * (end - start)))
                if first == count:
                    break
                z, u = (one[first:] for one in inputs)
                since = s.times[first:, np.newaxis] - s.times[first:first + 1]
                rising = np.where(model.poles == 0.0, since, np.expm1(since * model.poles)
                                  / np.where(model.poles == 0.0, 1.0, model.poles))
                z = z - z[:1] * np.exp(since * model.poles)[:, :, np.newaxis] \
                    + np.multiply.outer(rising, mean)
                moved = (z.transpose(2, 0, 1) @ residues).real \
                    + (u + mean).T[:, :, np.newaxis] * direct           # (nu, N, channels)
                places = at + first + count * np.arange(channels)[:, np.newaxis] \
                    + np.arange(count - first)
                found[k, places] = moved.transpose(2, 1, 0)
            at += count * channels
    return found
