# SPDX-License-Identifier: Apache-2.0
"""
Table 1 of [HD] by three methods: the paper's form of HD-PBSID, ours, and CT-PBSID.

Each beside the published column of the same name (500 runs). 2001 samples over 10 s, noise per
output, order 3 given. The paper's form: basis up to the edges of the window, no refinement. The
paper does not tell its past and future windows for HD-PBSID; ours are chosen from the data.
CT-PBSID: p = f = 10, Laguerre pole 25 rad/s, as in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from ctsid_core.settings import Settings
from ctsid_ros.studies.experiments import from_rest
from ctsid_ros.studies.monte_carlo import Summary, arguments, of_poles, runs, summary
from ctsid_ros.studies.table1 import PUBLISHED, SNRS, one
from ctsid_ros.tables import Table

METHODS = {
    "paper's HD": Settings(order=3, edges='paper', refine=False, delay=0.0, held_out=0.0),
    'ours': Settings(order=3, delay=0.0, held_out=0.0),
    'CT-PBSID': Settings(method='ct-pbsid', order=3, past=10, future=10, laguerre_pole=25.0,
                         delay=0.0, held_out=0.0),
}
HEAD = ('SNR', 'pole', 'method', 'bias', 'published', 'std', 'published', 'RMSE', 'order 3')


def lines(method: str, found: Summary, snr: int) -> list[tuple[str, ...]]:
    """Return the rows of the table of one method at one SNR."""
    rows: list[tuple[str, ...]] = []
    place = 1 if method == 'CT-PBSID' else 0
    for name, i in of_poles(from_rest(0, snr).model):
        published = PUBLISHED[snr][0 if 'i' not in name else 1]
        beside = ('', '') if method == 'ours' else tuple(
            f'{published[place + 2 * k]:.3g}' for k in (0, 1))
        rows.append((f'{snr} dB', name, method, f'{found.bias[i]:.3g}', beside[0],
                     f'{found.std[i]:.3g}', beside[1], f'{found.rmse[i]:.3g}',
                     f'{100 * found.right:.0f} %'))
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    given = arguments(__doc__, 500, argv)
    rows: list[tuple[str, ...]] = []
    for snr in SNRS:
        for method, settings in METHODS.items():
            done = runs(partial(one, snr=snr, settings=settings), given.seeds,
                        f'{snr} dB, {method}', given.jobs)
            rows += lines(method, summary(done), snr)
    print(f'\n{given.seeds} runs of each\n\n{Table(HEAD, tuple(rows), ("pole", "method")).text()}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
