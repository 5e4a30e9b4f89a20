# SPDX-License-Identifier: Apache-2.0
"""
Windows that are not at rest, nothing set: error over the Cramer-Rao bound, order right how often.

The quadrotor of [HD] 5.2 (10 s, 500 Hz, input low-passed at 8 Hz) and a flexible structure of
6th order (modes at 2, 5 and 9 Hz; 2 inputs low-passed at 15 Hz, 3 outputs; 10 s, 200 Hz), both
running since long before the window. Noise per output. The bound is of the raw samples (unknown
beside the poles are the other entries of the model with D, the state at the first sample, trim,
and noise levels), its mean square over the first forty runs; RMSE is that of the runs with the
right order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.bounds import output_error_bound
from ctsid_ros.studies.experiments import Run, flexible, quadrotor, running
from ctsid_ros.studies.monte_carlo import Outcome, Summary, of_poles, outcome, summary
from ctsid_ros.studies.runner import arguments, conclude, keeping

EXPERIMENTS = [('quadrotor', snr) for snr in (50, 20, 10, 6, 0)]
EXPERIMENTS += [(f'flexible {damping} %', 20) for damping in (0.5, 1.0, 2.0)]
HEAD = ('plant', 'SNR', 'pole', 'bias', 'std', 'RMSE', 'bound', 'RMSE/bound', 'pole_std/RMSE',
        'order right', 'OK', 'runs')


def experiment(seed: int, name: str, snr: float) -> Run:
    """Return one run of a named experiment."""
    if name == 'quadrotor':
        return running(seed, snr, quadrotor())
    damping = 0.01 * float(name.split()[1])
    return running(seed, snr, flexible(damping), rate=200.0, band=15.0)


def one(seed: int, name: str, snr: float) -> Outcome:
    """Return the outcome of one run."""
    return outcome(experiment(seed, name, snr))


def bound(name: str, snr: float, count: int = 40) -> Array:
    """Return the bound of each pole, its mean square over some runs."""
    squares = []
    for seed in range(count):
        run = experiment(seed, name, snr)
        squares.append(output_error_bound(run.model, run.x0, [run.u], run.y.time, run.noise) ** 2)
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def lines(found: Summary, name: str, snr: float) -> list[tuple[str, ...]]:
    """Return the rows of the table for one experiment."""
    least, rows = bound(name, snr), []
    for pole, i in of_poles(experiment(0, name, snr).model):
        rows.append((name, f'{snr} dB', pole, f'{found.bias[i]:.3g}', f'{found.std[i]:.3g}',
                     *found.beside(least, i)))
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    given = arguments(__doc__, 'windows', 200, argv)
    rows: list[tuple[str, ...]] = []
    with keeping(given, len(EXPERIMENTS)) as runs:
        for name, snr in EXPERIMENTS:
            done = runs(partial(one, name=name, snr=snr), f'{name}, {snr} dB')
            rows += lines(summary(done), name, snr)
    conclude(given, 'windows', Table(HEAD, tuple(rows), ('plant', 'pole')))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
