# SPDX-License-Identifier: Apache-2.0
"""
The exam: simulated robots as they are recorded, and what identification makes of them.

Linear and not linear, under good and bad sensors, in open and closed loop, moved by seven kinds
of inputs; nothing is set but that there is no feedthrough in closed loop. A model is judged by
how well it simulates another experiment without noise, beside the best of a brute-force output
error (orders 1 to 4, dead time, many starts); robots that do not stay put without their
controller by predictions over 1, 10 and 50 samples, beside a ridge regression of each horizon.
Other seeds are other robots. docs/robots.md explains the columns.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

from ctsid_ros.studies.figure_files import write_table
from ctsid_ros.studies.robots.families import FAMILIES
from ctsid_ros.studies.robots.kept_rows import KeptRows
from ctsid_ros.studies.robots.scoring import Row
from ctsid_ros.studies.robots.sitting import Reach, sat
from ctsid_ros.studies.robots.tables import by_family, by_kind
from ctsid_ros.studies.runner import positive, runs, shown
from ctsid_ros.workers import cores


def one(number: int, family: str, seed: int, folder: Path) -> Row:
    """Return the row of one experiment."""
    return sat(family, seed, number, _reach(folder))


@cache
def _reach(folder: Path) -> Reach:
    return Reach(folder / 'reachable.txt')


def arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, prog='ctsid study robots',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='families:\n' + '\n'.join(f'  {name:18} {of.what}'
                                         for name, of in FAMILIES.items()))
    parser.add_argument('--seed', type=int, default=1, metavar='S',
                        help='of all robots and flights (%(default)s)')
    parser.add_argument('--experiments', type=positive, default=7, metavar='K',
                        help='of each family; 7 have every kind of input (%(default)s)')
    parser.add_argument('--families', nargs='+', choices=FAMILIES, default=list(FAMILIES),
                        metavar='NAME', help='only these')
    parser.add_argument('--jobs', type=positive, default=cores(), metavar='N',
                        help='processes (one for each core)')
    parser.add_argument('--out', type=Path, default=Path('results/studies/robots'),
                        metavar='FOLDER', help='for tables, runs.csv, which an interrupted exam '
                        'takes up again, and reachable.txt, which serves every engine '
                        '(%(default)s)')
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables."""
    given = arguments(argv)
    kept, rows = KeptRows(given.out / 'runs.csv'), list[Row]()
    with shown('robots', len(given.families), given.experiments, given.jobs) as far:
        for family in given.families:
            task = partial(one, family=family, seed=given.seed, folder=given.out)
            rows += runs(task, family, given.experiments, given.jobs, kept, f'seed {given.seed}',
                         far.begin(family))
    for name, table in (('robots_families', by_family(rows)), ('robots_inputs', by_kind(rows))):
        write_table(given.out / name, table)
        print(f'\n{table.text()}')
    print(f'\nResults: {given.out}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
