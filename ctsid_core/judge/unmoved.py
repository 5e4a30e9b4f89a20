# SPDX-License-Identifier: Apache-2.0
"""
Oscillations that last and that inputs hardly move: what disturbs the plant does.

Hum, a vibration, waves: what lasts is explained by an initial state, and its
samples by two states of the model. No controller moves these.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.search.solution import GROWS, Solution

_HARDLY = 0.1         # of what a mode does by itself


def unmoved_notes(solution: Solution) -> Iterator[str]:
    """Yield which oscillations last, and are moved by inputs by a part of what they do."""
    poles = solution.fit.model.poles
    lasts = np.abs(poles.real) * solution.samples.length < GROWS
    for k in np.flatnonzero(lasts & (poles.imag > 0.0)).tolist():
        if (share := _moved(solution, k)) < _HARDLY:
            yield (f'inputs hardly move the mode at {abs(poles[k]) / (2.0 * np.pi):.3g} Hz '
                   f'({100.0 * share:.2g} % of what it does by itself): what disturbs the plant '
                   'does; leave it out where a controller is designed')


def _moved(solution: Solution, k: int) -> float:
    """Return what inputs move a mode by that its initial state cannot, over what that does."""
    samples, m = solution.samples, solution.fit.model
    columns = columns_of(samples, m.poles[k:k + 1], m.delay, direct=False, turned=False,
                         slopes=False)
    moved = own = 0.0
    for place, (record, triangles) in enumerate(zip(samples.records, columns.triangles,
                                                    strict=True)):
        for s, t in zip(record.streams, triangles, strict=True):
            c = m.c[s.channels, k]
            driven = (np.sum(t.z[:, 0, :-1] * m.b[k], axis=1)[:, np.newaxis] * c).real
            free = np.exp(m.poles[k] * (s.times - record.start))
            known = np.column_stack((free.real, free.imag, np.ones(len(free))))
            driven -= known @ np.linalg.lstsq(known, driven, None)[0]
            moved += float(np.sum(driven ** 2))
            own += float(np.sum((free[:, np.newaxis] * m.x0[place, k] * c).real ** 2))
    return float(np.sqrt(moved / own)) if own else np.inf
