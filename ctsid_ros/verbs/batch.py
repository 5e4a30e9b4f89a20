# SPDX-License-Identifier: Apache-2.0
"""`ctsid batch`: many bags, each replayed by a task of its own, and a table over all."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from ctsid_core.errors import StorageError
from ctsid_ros.progress import progress
from ctsid_ros.replay.results import PAGE, REPORT, make_folder, write_report
from ctsid_ros.report.document import Section, to_markdown, to_text
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    INTERRUPTED,
    NO_MODEL,
    add_budget,
    add_changes,
    add_style,
    changed,
    read_params,
    say,
    steps,
    tell,
)

if TYPE_CHECKING:
    from ctsid_ros.batch.store import Store
    from ctsid_ros.batch.summary import Flight
    from ctsid_ros.batch.task import Task
    from ctsid_ros.progress import Advance

HELP = 'identify many bags, each by itself, on all cores or a cluster'
EPILOG = """example: ctsid batch flights --params params.yaml --out results/fleet
example: ctsid batch 'flights/*/*.mcap' --params params.yaml --out results/fleet --jobs 8
example: ctsid batch all.txt --params params.yaml --out fleet --scheduler tcp://10.0.0.1:8786

Each bag is replayed in sliding windows, as by `ctsid replay`, and leaves a Parquet file with a row
per window in DIR/rows; bags.csv and report.html are about all bags. What is done is not done
again: after Ctrl-C, a crash or a full disk, run the same command. A bag that cannot be read has a
row that says why. Needs `pip install distributed pyarrow`; docs/batch.md has more."""
TABLE = 'bags.csv'
FAILED = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', nargs='+', metavar='BAGS', help='bags, folders with bags at any '
                        'depth (or logs and tables, where there is no bag), '
                        "patterns in quotes ('flights/*/*.mcap'), or .txt files with one "
                        'of these on each line')
    parser.add_argument('--params', required=True, metavar='FILE',
                        help='ROS parameter file with channels and settings; `ctsid init` writes '
                        'one')
    parser.add_argument('--out', required=True, metavar='DIR', help='folder for the results')
    where = parser.add_mutually_exclusive_group()
    where.add_argument('--jobs', type=steps, metavar='N',
                       help='processes of this computer [default: one for each core]')
    where.add_argument('--scheduler', default='', metavar='ADDRESS',
                       help='a cluster of Dask to work on instead, like tcp://10.0.0.1:8786')
    parser.add_argument('--vehicle', default='', metavar='PATTERN', help='regular expression that '
                        'finds the vehicle in the path of a bag: its first group [default: the '
                        'name of the folder that the bag is in]')
    parser.add_argument('--retry', action='store_true',
                        help='try bags again that could not be read or were given up')
    parser.add_argument('--force', action='store_true', help='replace what has been made with '
                        'other parameters, or by another version')
    add_changes(parser)
    add_budget(parser)
    add_style(parser)


def command(args: argparse.Namespace) -> int:
    """Find out what is not done, do it, and tell of all."""
    _check_packages()
    from ctsid_ros.batch.bags import check_pattern, find_bags
    from ctsid_ros.batch.store import Store
    from ctsid_ros.batch.task import Recipe, Task

    check_pattern(args.vehicle)
    config = changed(args, read_params(args.params))
    bags, recipe = find_bags(args.bag), Recipe.of(config)
    out = make_folder(args.out, bags, config.settings.method, force=True).resolve()
    store = Store(out, recipe, force=args.force, retry=args.retry)
    done = store.done(bags)
    tasks = [Task(bag, str(store.folder), recipe) for bag in bags if bag not in done]
    if done and tasks:
        say(f'{len(done)} of {len(bags)} bags are done already')
    interrupted = _perform(tasks, args) if tasks else False
    flights = _flights(store, bags, args.vehicle)
    if flights:
        _tell(flights, out, args, interrupted=interrupted)
    if interrupted:
        say(f'interrupted: {len(store.done(bags))} of {len(bags)} bags are done; run the same '
            'command to go on')
        return INTERRUPTED
    return ACCEPTED if any(f.best for f in flights) else \
        FAILED if all(f.failure for f in flights) else NO_MODEL


def _check_packages() -> None:
    from importlib.util import find_spec

    missing = [name for name in ('distributed', 'pyarrow') if find_spec(name) is None]
    if missing:
        raise StorageError(f'a batch needs {" and ".join(missing)}, not installed here: pip '
                           f'install {" ".join(missing)} (the extra `batch` of ctsid)')


def _perform(tasks: Sequence[Task], args: argparse.Namespace) -> bool:
    """Do the tasks; return whether it was interrupted."""
    from ctsid_ros.batch.scheduling import cluster, performed
    from ctsid_ros.batch.task import rounds
    from ctsid_ros.workers import cores

    jobs = min(args.jobs or cores(), len(tasks))
    where = f'at {args.scheduler}' if args.scheduler else \
        f'in {jobs} process{"es" * (jobs > 1)}'
    count = 0
    if not args.quiet:
        say(f'{len(tasks)} bag{"s" * (len(tasks) > 1)} to identify {where}')
    try:
        with progress(f'identifying bags {where}', quiet=args.quiet) as advance, \
                cluster(jobs, args.scheduler) as client:
            if not (args.quiet or sys.stderr.isatty()):     # there a bar tells
                say(f'{Path(tasks[0].bag).name} begins')
            for task in (done for own in rounds(tasks) for done in performed(client, own)):
                count += 1
                _advance(advance, count, len(tasks), task)
    except KeyboardInterrupt:
        return True
    except StorageError as error:
        raise StorageError(f'{error}. {count} of {len(tasks)} bags were done in this run: run the '
                           'same command again, and it goes on from there') from None
    return False


def _advance(advance: Advance, count: int, total: int, task: Task) -> None:
    advance(count / total, f'{count} of {total} bags, last {Path(task.bag).name}')


def _flights(store: Store, bags: Sequence[str], pattern: str) -> list[Flight]:
    from ctsid_ros.batch.summary import flight

    return [flight(bag, path, pattern) for bag, path in store.rows(bags).items()]


def _tell(flights: Sequence[Flight], out: Path, args: argparse.Namespace, *, interrupted: bool
          ) -> None:
    from ctsid_ros.batch.summary import batch_headline, explained, odd_ones, sections, table, words
    from ctsid_ros.report.document import Command
    from ctsid_ros.report.page import to_html

    odd = odd_ones(flights)
    parts = sections(flights, odd)
    title = f'Models of {len(flights)} bags'
    more = [explained(), Section('How to repeat it', (Command(args.command_line),), brief=False)]
    first = batch_headline(flights, odd, args.params, args.bag)
    write_report(out, {TABLE: table(flights, odd),
                       REPORT: to_markdown(title, [*parts, *more], first),
                       PAGE: to_html(title, [*parts, *more], first)})
    if args.json:
        tell({'verb': 'batch', 'results': out, 'interrupted': interrupted,
              'verdict': first.grade, 'reason': first.sentence, 'bags': words(flights),
              'outliers': odd})
    else:
        print(to_text(parts))
        print(f'\nResults: {out}/ ({PAGE} has the plots, {TABLE} a row for each bag, rows/ one '
              'for each window)')
