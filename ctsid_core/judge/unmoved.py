# SPDX-License-Identifier: Apache-2.0
"""
Oscillations that last and that inputs hardly move: what disturbs the plant does.

Hum, a vibration, waves: what lasts is explained by an initial state, and its samples by two states
of the model. If inputs move these by less than what the model misses, nothing tells that they do.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.search.solution import GROWS, Solution


def unmoved_notes(solution: Solution) -> Iterator[str]:
    """Yield which oscillations last, and are moved by inputs less than what the model misses."""
    samples, poles = solution.samples, solution.fit.model.poles
    missed = float(np.sum(samples.mean(solution.fit.power) * samples.counts.sum(axis=0)))
    lasts = np.abs(poles.real) * samples.length < GROWS
    for k in np.flatnonzero(lasts & (poles.imag > 0.0)).tolist():
        if _moved(solution, k) < missed:
            yield (f'inputs move the oscillation at {abs(poles[k]) / (2.0 * np.pi):.3g} Hz by '
                   'less than what the model misses: what disturbs the plant does; leave it out '
                   'where a controller is designed')


def _moved(solution: Solution, k: int) -> float:
    """Return the sum of squares of what inputs move a mode by."""
    samples, m = solution.samples, solution.fit.model
    columns = columns_of(samples, m.poles[k:k + 1], m.delay, direct=False, turned=False,
                         slopes=False)
    return float(sum(np.sum(((t.z[:, 0, :-1] @ m.b[k])[:, np.newaxis] * m.c[s.channels, k]).real
                            ** 2)
                     for record, triangles in zip(samples.records, columns.triangles, strict=True)
                     for s, t in zip(record.streams, triangles, strict=True)))
