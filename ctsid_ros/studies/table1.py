# SPDX-License-Identifier: Apache-2.0
"""
Table 1 of [HD]: bias and standard deviation of the eigenvalues of a quadrotor model.

Our columns beside those published for HD-PBSID and CT-PBSID (500 runs), and the Cramer-Rao bound
of the same samples (order given; unknown are the other entries of the model with D, the state at
the first sample, trim, and noise levels). 2001 samples over 10 s, noise per output.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from ctsid_core.linear.types import Array
from ctsid_core.settings import Settings
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.bounds import output_error_bound
from ctsid_ros.studies.experiments import from_rest
from ctsid_ros.studies.figure_files import write_table
from ctsid_ros.studies.monte_carlo import Outcome, Summary, of_poles, outcome, summary
from ctsid_ros.studies.runner import arguments, keeping

SNRS = (50, 20, 10, 6)
# By SNR, of -5 and of -1 +- i: bias of HD-PBSID and CT-PBSID, standard deviation of both.
PUBLISHED = {
    50: ((0.010883, 0.000437, 0.021611, 0.001531), (0.002407, 5.949e-05, 0.006298, 0.000290)),
    20: ((0.024859, 0.096078, 0.1201, 0.088157), (0.006865, 0.006385, 0.061848, 0.0116)),
    10: ((0.086345, 2.4266, 0.37473, 7.6673), (0.040319, 0.20973, 0.21217, 0.34462)),
    6: ((0.15362, 44.717, 0.60203, 271.48), (1.8876, 1.928, 0.51834, 1.8059)),
}
HEAD = ('SNR', 'pole', 'bias', 'HD', 'CT', 'std', 'HD', 'CT', 'worst ratio', 'RMSE', 'bound',
        'RMSE/bound', 'order 3', 'runs')


def one(seed: int, snr: float, settings: Settings | None) -> Outcome:
    """Return the outcome of one run."""
    return outcome(from_rest(seed, snr), settings)


def bound(snr: float) -> Array:
    """Return the bound of each pole."""
    run = from_rest(0, snr)
    return output_error_bound(run.model, run.x0, [run.u], run.y.time, run.noise)


def worst_ratio(found: Summary, snr: int, place: int) -> float:
    """Return our bias or standard deviation over the smaller published one: the larger ratio."""
    real = abs(from_rest(0, snr).model.poles[place].imag) < 0.5
    bias_hd, bias_ct, std_hd, std_ct = PUBLISHED[snr][0 if real else 1]
    return float(max(found.bias[place] / min(bias_hd, bias_ct),
                     found.std[place] / min(std_hd, std_ct)))


def lines(found: Summary, snr: int) -> list[tuple[str, ...]]:
    """Return the rows of the table for one SNR."""
    model, least, rows = from_rest(0, snr).model, bound(snr), []
    for name, i in of_poles(model):
        bias_hd, bias_ct, std_hd, std_ct = PUBLISHED[snr][0 if 'i' not in name else 1]
        cells = (found.bias[i], bias_hd, bias_ct, found.std[i], std_hd, std_ct)
        rows.append((f'{snr} dB', name, *(f'{x:.3g}' for x in cells),
                     f'{worst_ratio(found, snr, i):.2f}', f'{found.rmse[i]:.3g}',
                     f'{least[i]:.3g}', f'{found.rmse[i] / least[i]:.2f}',
                     f'{100 * found.right:.0f} %', str(found.runs)))
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, with the order given and with nothing set."""
    given = arguments(__doc__, 'table1', 100, argv)
    ways = (('order 3 given', Settings(order=3)), ('nothing set', None))
    with keeping(given, len(ways) * len(SNRS)) as runs:
        for title, settings in ways:
            rows: list[tuple[str, ...]] = []
            for snr in SNRS:
                done = runs(partial(one, snr=snr, settings=settings), f'{snr} dB, {title}')
                rows += lines(summary(done), snr)
            worst = max(float(row[8]) for row in rows), max(float(row[11]) for row in rows)
            table = Table(HEAD, tuple(rows), ('pole',))
            write_table(given.out / f'table1_{title.replace(" ", "_")}', table)
            print(f'\n{title}, {given.seeds} runs\n\n{table.text()}\n')
            print(f'  largest ratio to a published figure {worst[0]:.2f}, to the bound '
                  f'{worst[1]:.2f}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
