# SPDX-License-Identifier: Apache-2.0
"""
Figures 4 to 7 of [HD]: Bode curves and eigenvalues of many runs at 50, 20, 10 and 6 dB.

The second-order plant of section 5.1, 10 s from rest, a sweep of 0 to 8 Hz built from Hermite
functions up to order 250, 2001 samples, noise per output, order 2 given; nmax = 250, beta = 3,
gamma = 20. By the paper's form of HD-PBSID (basis up to the edges of the window, no refinement;
past and future windows, which the paper does not tell, chosen from the data) and by ours with
nothing but the order given. The Cramer-Rao bound stands beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.settings import Settings
from ctsid_ros.report.static import write_drawings
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.bounds import output_error_bound
from ctsid_ros.studies.clouds import bode, eigenvalues
from ctsid_ros.studies.experiments import from_rest, second_order
from ctsid_ros.studies.monte_carlo import Outcome, of_poles, outcome, summary
from ctsid_ros.studies.runner import arguments, conclude, keeping

SNRS = (50, 20, 10, 6)
METHODS = {
    "paper's form": Settings(order=2, nmax=250, beta=3.0, gamma=20.0, edges='paper', trim=False,
                             refine=False, delay=0.0, held_out=0.0),
    'ours': Settings(order=2, delay=0.0, held_out=0.0),
}
HEAD = ('SNR', 'pole', 'method', 'bias', 'std', 'RMSE', 'RMSE/bound', 'real poles', 'runs')
BODE_FILES = {50: '4a', 20: '4b', 10: '5a', 6: '5b'}
PLANE_FILES = {50: '6a', 20: '6b', 10: '7a', 6: '7b'}
_OMEGA = np.geomspace(0.1, 100.0, 40)


def one(seed: int, snr: float, settings: Settings) -> Outcome:
    """Return the outcome of one run."""
    return outcome(from_rest(seed, snr, plant=second_order), settings)


def bound(snr: float) -> Array:
    """Return the Cramer-Rao bound of each pole [rad/s]."""
    run = from_rest(0, snr, plant=second_order)
    return output_error_bound(run.model, run.x0, [run.u], run.y.time, run.noise)


def lines(done: Sequence[Outcome], snr: float, method: str) -> list[tuple[str, ...]]:
    """Return the rows of the table of one method at one SNR."""
    found, least = summary(done), bound(snr)
    real = np.mean([bool(np.all(o.model.poles.imag == 0.0)) for o in done if o.model is not None])
    return [(f'{snr} dB', name, method, f'{found.bias[i]:.3g}', f'{found.std[i]:.3g}',
             f'{found.rmse[i]:.3g}', f'{found.rmse[i] / least[i]:.2f}', f'{100 * real:.1f} %',
             str(len(done))) for name, i in of_poles(second_order())]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, write it and the figures."""
    given = arguments(__doc__, 'hd-robustness', 500, argv)
    rows, plant = [], second_order()
    with keeping(given, len(SNRS) * len(METHODS)) as runs:
        for snr in SNRS:
            done = {method: runs(partial(one, snr=snr, settings=settings), f'{snr} dB, {method}')
                    for method, settings in METHODS.items()}
            for method in METHODS:
                rows += lines(done[method], snr, method)
            drawn = [[bode(done[method], plant, _OMEGA, output,
                           f'[HD] figure {BODE_FILES[snr]}: {snr} dB, {method}', color)
                      for color, method in enumerate(METHODS, 1)] for output in (0, 1)]
            write_drawings(given.out / f'hd_figure_{BODE_FILES[snr]}.svg', [
                [pair[part] for pair in row] for row in drawn for part in (0, 1)])
            write_drawings(given.out / f'hd_figure_{PLANE_FILES[snr]}.svg', eigenvalues(
                [(method, done[method]) for method in METHODS], plant.poles,
                f'[HD] figure {PLANE_FILES[snr]}: {snr} dB', (-9.0, 0.0, 2.0)))
    conclude(given, 'hd_robustness', Table(HEAD, tuple(rows), ('pole', 'method')))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
