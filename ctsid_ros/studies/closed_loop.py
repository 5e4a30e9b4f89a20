# SPDX-License-Identifier: Apache-2.0
"""
An unstable plant under its controller: error over the closed-loop Cramer-Rao bound.

x'' = -x' + 6 x + u + w (poles 2 and -3), w white of intensity q^2, x measured with white noise
of standard deviation 0.001, under a sampled PD controller of what is measured; its reference is
noise low-passed at 3 Hz of standard deviation 10. 10 s at 500 Hz. Told is that there is no
feedthrough, nothing else. The bound is that of the Kalman filter's likelihood of the raw samples
(unknown beside the poles are the other entries of the model, the filter's gain, the state at the
first sample, trim, and the level of the errors): for each of ten references from the information
expected over the noise, then the mean square.

A controller that acts on states that are not in the record is another matter: inputs then tell
of the process noise what the outputs do not, and whoever takes them as given, Kalman filter or
not, is biased.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.settings import Settings
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.bounds import innovation_bound, stationary_gain
from ctsid_ros.studies.experiments import flown
from ctsid_ros.studies.monte_carlo import Outcome, Summary, of_poles, outcome, summary
from ctsid_ros.studies.runner import arguments, conclude, keeping

LEVELS = (0.0, 0.05, 0.2, 1.0)
HEAD = ('q', 'pole', 'bias', 'std', 'bias/std', 'RMSE', 'bound', 'RMSE/bound', 'pole_std/RMSE',
        'order right', 'OK', 'runs')


def one(seed: int, q: float) -> Outcome:
    """Return the outcome of one run."""
    return outcome(flown(seed, q), Settings(feedthrough=False))


def bound(q: float, references: int = 10, noises: int = 5) -> Array:
    """Return the bound of each pole: the mean square of those of some references."""
    squares = []
    for seed in range(references):
        found = [flown(seed, q, noise_seed=i) for i in range(noises)]
        model, step = found[0].model, float(found[0].y.time[1])
        L, S = stationary_gain(model, q * q * model.B @ model.B.T, found[0].noise, step)
        samples = [(run.u.values, run.y.values, run.x0) for run in found]
        squares.append(innovation_bound(model, L, S, samples, step, 'zoh') ** 2)
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def lines(found: Summary, q: float) -> list[tuple[str, ...]]:
    """Return the rows of the table for one level of process noise."""
    least, rows = bound(q), []
    for pole, i in of_poles(flown(0, q).model):
        rows.append((f'{q:g}', pole, f'{found.bias[i]:.3g}', f'{found.std[i]:.3g}',
                     f'{found.bias[i] / found.std[i]:.2f}', *found.beside(least, i)))
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    given = arguments(__doc__, 'closed-loop', 100, argv)
    rows: list[tuple[str, ...]] = []
    with keeping(given, len(LEVELS)) as runs:
        for q in LEVELS:
            done = runs(partial(one, q=q), f'q = {q:g}')
            rows += lines(summary(done), q)
    conclude(given, 'closed_loop', Table(HEAD, tuple(rows), ('pole',)))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
