# SPDX-License-Identifier: Apache-2.0
"""What is reachable: the best that brute-force output error gets on data it has not seen."""

from __future__ import annotations

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.signals.record import Record
from ctsid_ros.studies.robots.linear import Held
from ctsid_ros.studies.robots.output_error import (
    PAIR,
    REAL,
    OutputError,
    Samples,
    climbed,
    columns,
    poles_of,
    read,
    solved,
    states,
)

ORDERS = 4
RANKED = 700            # samples on which starts are ranked and climbed
LONGEST = 0.35          # dead time [s]
DELAYS = (0.0, 0.02, 0.05, 0.1, 0.17, 0.25)
DAMPINGS = (0.02, 0.1, 0.35, 0.8)


def reachable(train: Record, test: Record) -> float:
    """
    Return the fit of the best of the models of orders 1 to 4 [%]: mean of the outputs'.

    Parameters
    ----------
    train, test : Record
        Each with its inputs in one held signal. Each output has a model of its own: its order is
        the one that simulates the test best, which nobody knows beforehand.
    """
    fits = []
    for own, other in zip(outputs(train), outputs(test), strict=True):
        fits.append(max(model.fit(other) for model in models(own)))
    return float(np.mean(fits))


def outputs(record: Record) -> list[Samples]:
    """Return each output of a record, with the inputs."""
    held = Held(record.inputs[0].time, record.inputs[0].values)
    signal = record.outputs[0]
    return [Samples(held, signal.time, column) for column in signal.values.T]


def models(data: Samples) -> list[OutputError]:
    """Return the best model of each order."""
    scale = float(np.std(data.y)) or 1.0
    own = Samples(data.held, data.time, (data.y - data.y.mean()) / scale)
    few = own.thinned(RANKED)
    grid = Grid(few)
    best: dict[int, list[OutputError]] = {0: [OutputError((), np.zeros(1), np.zeros(1), 1.0)]}
    for order in range(1, ORDERS + 1):
        starts = []
        for kind in (REAL, PAIR):
            for parent in best.get(order - kind, [])[:2]:
                starts += grid.with_another(parent, kind)
        starts = _different(sorted(starts, key=lambda s: s[0]))
        ends = [climbed(kinds, at, few, LONGEST) for _, kinds, at in starts]
        best[order] = sorted(ends, key=lambda m: m.cost)
    whole = [climbed(top[0].kinds, top[0].at, own, LONGEST, 12)
             for order, top in best.items() if order]
    return [OutputError(m.kinds, m.at, scale * m.weights, scale ** 2 * m.cost) for m in whole]


Start = tuple[float, tuple[int, ...], Array]


def _different(starts: list[Start], most: int = 4) -> list[Start]:
    """Return the best starts, at most two of the same modes and none like another."""
    chosen: list[Start] = []
    for start in starts:
        alike = [s for s in chosen if s[1] == start[1]]
        if len(alike) < 2 and all(np.abs(s[2] - start[2]).max() > 0.3
                                  or abs(s[2][-1] - start[2][-1]) > 0.04 for s in alike):
            chosen.append(start)
        if len(chosen) == most:
            break
    return chosen


class Grid:
    """
    Modes over all frequencies, whose responses are found once.

    Parameters
    ----------
    data : Samples
        Those on which starts are ranked.
    """

    def __init__(self, data: Samples) -> None:
        self._data = data
        fast = 0.8 * np.pi / float(np.median(np.diff(data.time)))
        sizes = np.linspace(np.log(0.3 / data.duration), np.log(min(fast, 300.0)), 12)
        finer = np.linspace(sizes[2], sizes[-1], 16)
        self._modes: dict[int, list[tuple[Array, complex, ComplexArray]]] = {REAL: [], PAIR: []}
        for kind, places in ((REAL, [[a] for a in (sizes[0] - 4.0, *sizes)]),
                             (PAIR, [[a, np.log(d)] for a in finer for d in DAMPINGS])):
            for place in places:
                pole = poles_of((kind,), np.array(place))[0]
                self._modes[kind].append((np.array(place), pole, states(pole, data)))
        self._columns: dict[tuple[int, int, float], Array] = {}

    def with_another(self, parent: OutputError, kind: int) -> list[Start]:
        """Return starts: a model's modes with another one, at some dead times."""
        found, y = [], self._data.y
        for delay in {*DELAYS, float(parent.at[-1])}:
            at = np.append(parent.at[:-1], delay)
            _, basis, rest = solved(np.hstack(columns(parent.kinds, at, self._data)), y)
            for i, (place, _, _) in enumerate(self._modes[kind]):
                more = self._of(kind, i, delay)
                more = more - basis @ (basis.T @ more)
                gram, right = more.T @ more, more.T @ rest
                gram += 1e-9 * np.trace(gram) * np.eye(len(gram)) + 1e-300 * np.eye(len(gram))
                cost = float(rest @ rest - right @ np.linalg.solve(gram, right))
                found.append((cost, (*parent.kinds, kind),
                              np.concatenate((parent.at[:-1], place, [delay]))))
        return sorted(found, key=lambda s: s[0])[:12]

    def _of(self, kind: int, i: int, delay: float) -> Array:
        key = kind, i, delay
        if key not in self._columns:
            _, pole, z = self._modes[kind][i]
            driven = read(pole, z, self._data, delay)
            free = np.exp(pole * (self._data.time - self._data.time[0]))[:, np.newaxis]
            both = np.hstack((driven, free))
            self._columns[key] = both.real if kind == REAL else np.hstack((both.real, both.imag))
        return self._columns[key]
