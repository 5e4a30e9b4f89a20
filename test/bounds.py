# SPDX-License-Identifier: Apache-2.0
"""The Cramer-Rao bound of the poles from the samples in time, of one or several records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from plants import Multisine, Plant

_RANK = 1e-9          # relative singular value below which a direction only turns the states


@dataclass(frozen=True, eq=False)
class Experiment:
    """Samples at times t of a plant under a multisine, each output with white noise sigma."""

    t: np.ndarray
    u: Multisine
    sigma: np.ndarray


def pole_bound(p: Plant, experiments: Sequence[Experiment]) -> np.ndarray:
    """
    Return the least standard deviation |error| of each pole, in the order of `eigvals(p.A)`.

    All of A, B, C and D is unknown, and of each experiment the state at its start and the trim of
    outputs. Derivatives are exact: those of a multisine's steady response by A and B are
    multisines, and what the start adds to them is a free response.
    """
    blocks = [_derivatives(p, e) for e in experiments]
    shared = sum(b[0].shape[1] for b in blocks[:1])
    own = sum(b[1].shape[1] for b in blocks)
    rows = np.zeros((sum(len(b[0]) for b in blocks), shared + own))
    row, column = 0, shared
    for plant_part, free in blocks:
        rows[row:row + len(plant_part), :shared] = plant_part
        rows[row:row + len(plant_part), column:column + free.shape[1]] = free
        row, column = row + len(plant_part), column + free.shape[1]
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0.0] = np.inf
    _, s, right = np.linalg.svd(np.linalg.qr(rows / norm, mode='r'))
    kept = s > _RANK * s[0]
    root = (right[kept] / s[kept, np.newaxis] / norm)[:, :p.A.size]
    _, modes = np.linalg.eig(p.A)
    left = np.linalg.inv(modes)
    change = np.stack([np.outer(left[i], modes[:, i]).ravel() for i in range(len(p.A))])
    return np.linalg.norm(change @ root.T, axis=1)


def _derivatives(p: Plant, e: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives (ny N, ...) by A, B, C, D, and by start and trim, over sigma."""
    n, ny, x = len(p.A), len(p.C), e.u.states(p)
    systems = 1j * e.u.omega[:, np.newaxis, np.newaxis] * np.eye(n) - p.A
    gain = p.C @ np.linalg.solve(systems, np.broadcast_to(np.eye(n), systems.shape))  # (W, ny, n)
    amplitudes = [gain[:, :, i].T * drive for drives in (x.amplitude, e.u.amplitude)
                  for i in range(n) for drive in drives]
    stacked = Multisine(e.u.omega, np.vstack((*amplitudes, x.amplitude, e.u.amplitude))).at(e.t)
    driven, direct = np.split(stacked, [ny * len(amplitudes)], axis=1)
    by_AB = np.swapaxes(driven.reshape(len(e.t), -1, ny), 0, 1)
    by_CD = [np.outer(z, row) for row in np.eye(ny) for z in direct.T]
    poles, modes = np.linalg.eig(p.A)
    decay = np.exp(np.outer(e.t - e.t[0], poles))
    free = np.einsum('yi,ti,ij->jty', p.C @ modes, decay, np.linalg.inv(modes)).real
    trim = [np.broadcast_to(row, (len(e.t), ny)) for row in np.eye(ny)]
    return (np.stack([(c / e.sigma).ravel() for c in (*by_AB, *by_CD)], axis=1),
            np.stack([(c / e.sigma).ravel() for c in (*free, *trim)], axis=1))
