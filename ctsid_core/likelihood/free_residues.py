# SPDX-License-Identifier: Apache-2.0
"""
Output error with residues of any rank: one pole may do the work of several.

Axes of a robot that are alike have the same poles, each as often as there are axes, and the
residue of such a pole has as many ranks. With residues that are free every output is a linear fit
of its own, whatever the rank; only poles and dead times, which are few, have to be looked for.

References
----------
Golub and Pereyra 1973, SIAM J. Numer. Anal. 10; Kaufman 1975, BIT 15.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctsid_core.likelihood.mode_columns import ROUNDING, Columns, columns_of
from ctsid_core.likelihood.output_error import (
    ROUGHLY,
    Free,
    b_and_x0,
    by_delay,
    driven_columns,
    own_columns,
)
from ctsid_core.likelihood.pole_steps import PoleSteps, canonical
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, ComplexArray

_RANK = 1e-9          # relative singular value below which a linear direction is not determined
_STEPS = 10           # of a climb, at most
_DAMPING = 1e-3       # of the first step
_LEAST_DAMPING = 1e-9
_LONGEST = 1.0        # largest change of the logarithm of a pole in one step


@dataclass(frozen=True, eq=False)
class FreeFit:
    """Poles and dead times with the best residues of any rank."""

    poles: ComplexArray     # (m,)
    delay: Array            # (nu,) [s]
    columns: Columns        # of these
    residues: ComplexArray  # (ny, m, nu)
    starts: ComplexArray    # (ny, records, m): free responses
    power: Array            # (ny,): mean square of the errors; outputs have size 1
    cost: float             # -2 log likelihood, up to a constant
    gradient: Array         # by coordinates of poles and free dead times, residues at their best
    curvature: Array


def free_fit(samples: Samples, poles: ComplexArray, delay: Array, free: Free) -> FreeFit:
    """Return the best residues at given poles (m,) [rad/s] and dead times (nu,) [s]."""
    poles = canonical(poles)
    columns = columns_of(samples, poles, delay, direct=free.feedthrough)
    dp, late = _steps(samples, poles).derivatives(), np.flatnonzero(free.delays)
    m, nu, ny, records = len(poles), samples.nu, samples.ny, len(samples.records)
    residues = np.zeros((ny, m, nu), dtype=complex)
    starts = np.zeros((ny, records, m), dtype=complex)
    counts, power = samples.counts.sum(axis=0), np.zeros(ny)
    gradient = np.zeros(len(dp) + len(late))
    curvature = np.zeros((len(gradient),) * 2)
    for streams in zip(*columns.triangles, strict=True):
        design = np.vstack([np.hstack((*driven_columns(t.z, poles, r, records),
                                       own_columns(t, free, r, records)))
                            for r, t in enumerate(streams)])
        size = np.linalg.norm(design, axis=0)
        size[~(size > 0.0)] = 1.0
        basis, s, right = np.linalg.svd(design / size, full_matrices=False)
        known = s > _RANK * s[0]
        basis, y = basis[:, known], np.vstack([t.y for t in streams])
        pull = basis.T @ y
        error = y - basis @ pull
        theta = right[known].T @ (pull / s[known, np.newaxis]) / size[:, np.newaxis]
        for k, i in enumerate(streams[0].channels):
            residues[i], starts[i] = b_and_x0(theta[:, k], poles, nu, records)
            D = theta[len(theta) - own_columns(streams[0], free, 0, records).shape[1]:, k][:nu] \
                if free.feedthrough else np.zeros(nu)
            power[i] = max(float(error[:, k] @ error[:, k]) / counts[i], ROUNDING)
            moved = []
            for r, t in enumerate(streams):
                of_poles = np.sum(t.dz[:, :, :-1] * residues[i], axis=2) \
                    + t.dz[:, :, -1] * starts[i, r]
                moved.append(np.hstack(((of_poles @ dp.T).real, by_delay(
                    t, poles, residues[i], D, columns.first[r], late))))
            J = np.vstack(moved)
            J -= basis @ (basis.T @ J)
            gradient += J.T @ error[:, k] / power[i]
            curvature += J.T @ J / power[i]
    return FreeFit(poles, delay, columns, residues, starts, power, float(counts @ np.log(power)),
                   gradient, curvature)


def climb_free(samples: Samples, best: FreeFit, free: Free) -> FreeFit:
    """Take poles and dead times near the maximum of the likelihood."""
    damping, late = _DAMPING, np.array(free.delays)
    for _ in range(_STEPS):
        steps, gradient, curvature = _steps(samples, best.poles), best.gradient, best.curvature
        n, gain = len(gradient) - int(late.sum()), 0.0
        held = [n + k for k, (g, d) in enumerate(zip(gradient[n:], best.delay[late], strict=True))
                if (d <= 0.0 if g < 0.0 else d >= free.longest)]
        size = np.sqrt(curvature.diagonal())
        size[~(size > 1e-150)] = np.inf
        size[held] = np.inf
        g, C = gradient / size, curvature / size / size[:, np.newaxis]
        for _ in range(4):
            step = np.linalg.solve(C + damping * np.eye(len(g)), g)
            if float(g @ step) < ROUGHLY:
                break
            trial = _moved(samples, best, step / size, steps, free)
            if trial.cost < best.cost:
                gain, best = best.cost - trial.cost, trial
                break
            damping *= 30.0
        if gain < ROUGHLY or samples.effort.over:
            break
        damping = max(0.1 * damping, _LEAST_DAMPING)
    return best


def _moved(samples: Samples, fit: FreeFit, step: Array, steps: PoleSteps, free: Free) -> FreeFit:
    late = np.array(free.delays)
    n, fraction, poles = len(step) - int(late.sum()), 2.0, fit.poles
    for _ in range(10):
        fraction *= 0.5
        poles = steps.moved(fraction * step[:n], free.limit, free.fastest)
        if steps.size_of(poles) <= _LONGEST:
            break
    delay = fit.delay.copy()
    delay[late] = np.clip(delay[late] + fraction * step[n:], 0.0, free.longest)
    return free_fit(samples, poles, delay, free)


def _steps(samples: Samples, poles: ComplexArray) -> PoleSteps:
    """Return how poles move; two that meet part as a pair, for residues have any rank."""
    return PoleSteps.of(poles, 1.0 / samples.length)
