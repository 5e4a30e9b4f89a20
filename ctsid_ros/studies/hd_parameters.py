# SPDX-License-Identifier: Apache-2.0
"""
Figures 8 to 11 of [HD]: error of the eigenvalues against samples, nmax, beta and gamma, 20 dB.

The experiment of section 5.1 (`ctsid study hd-robustness`); one parameter is varied, the others
are 2001 samples, nmax = 250, beta = 3, gamma = 20. By the paper's form of HD-PBSID, and by ours
with the same parameter given and no other. Means of the errors with one standard deviation to
each side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ctsid_core.settings import Settings
from ctsid_ros.report.drawing import Axes
from ctsid_ros.report.static import write_drawings
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.clouds import error_bars
from ctsid_ros.studies.experiments import from_rest, second_order
from ctsid_ros.studies.hd_robustness import METHODS
from ctsid_ros.studies.monte_carlo import Outcome, Summary, of_poles, outcome, summary
from ctsid_ros.studies.runner import Task, arguments, conclude, keeping

SNR = 20.0
HEAD = ('varied', 'value', 'method', 'bias of -2', 'std', 'bias of -4', 'std', 'order 2')


@dataclass(frozen=True)
class Sweep:
    """One figure: what is varied, over which values, and how far errors are shown [rad/s]."""

    figure: int
    what: str
    values: tuple[float, ...]
    shown: float
    log: bool = True


SWEEPS = (
    Sweep(8, 'samples', (100, 200, 500, 1000, 2000, 5000, 10000), 1.0),
    Sweep(9, 'nmax', (10, 20, 30, 50, 70, 100, 150, 250, 400, 600, 1000), 1.0),
    Sweep(10, 'beta', tuple(range(1, 11)), 0.4, log=False),
    Sweep(11, 'gamma', (1, 1.5, 2, 3, 5, 10, 15, 20, 25, 30, 35, 40), 0.4, log=False),
)


def one(seed: int, what: str, value: float, settings: Settings) -> Outcome:
    """Return the outcome of one run."""
    if what == 'samples':
        return outcome(from_rest(seed, SNR, int(value), plant=second_order), settings)
    changed = settings.replace(**{what: int(value) if what == 'nmax' else float(value)})
    return outcome(from_rest(seed, SNR, plant=second_order), changed)


def swept(runs: Callable[[Task, str], list[Outcome]], sweep: Sweep) -> dict[str, list[Summary]]:
    """Return what the runs of one figure amount to, by method, value by value."""
    return {method: [summary(runs(
        partial(one, what=sweep.what, value=value, settings=settings),
        f'{sweep.what} {value:g}, {method}')) for value in sweep.values]
        for method, settings in METHODS.items()}


def drawn(sweep: Sweep, found: dict[str, list[Summary]]) -> list[Axes]:
    """Return the drawing of each eigenvalue."""
    drawings = []
    for name, i in of_poles(second_order()):
        parts = [(method, np.array([s.mean[i].real for s in each]),
                  np.array([s.std[i] for s in each]), color)
                 for color, (method, each) in enumerate(found.items(), 1)]
        drawings.append(error_bars(
            np.array(sweep.values, float), parts, log=sweep.log, x_label=sweep.what,
            title=f'[HD] figure {sweep.figure}: eigenvalue {name}, {SNR:g} dB',
            y_label='error [rad/s]', y_limits=(-sweep.shown, sweep.shown)))
    return drawings


def lines(sweep: Sweep, found: dict[str, list[Summary]]) -> list[tuple[str, ...]]:
    """Return the rows of the table of one figure."""
    slow, fast = (i for _, i in sorted(of_poles(second_order()), key=lambda p: -float(p[0])))
    return [(sweep.what, f'{value:g}', method,
             *(f'{x:.3g}' for i in (slow, fast) for x in (s.bias[i], s.std[i])),
             f'{100 * s.right:.0f} %')
            for method, each in found.items() for value, s in zip(sweep.values, each, strict=True)]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, write it and the figures."""
    given = arguments(__doc__, 'hd-parameters', 100, argv)
    rows = []
    with keeping(given, sum(len(s.values) for s in SWEEPS) * len(METHODS)) as runs:
        for sweep in SWEEPS:
            found = swept(runs, sweep)
            rows += lines(sweep, found)
            write_drawings(given.out / f'hd_figure_{sweep.figure}.svg', drawn(sweep, found))
    conclude(given, 'hd_parameters', Table(HEAD, tuple(rows), ('varied', 'method')))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
