# SPDX-License-Identifier: Apache-2.0
"""`ctsid study`: Monte Carlo studies of known plants, printed beside what was published."""

from __future__ import annotations

import argparse
from importlib import import_module

HELP = 'repeat a Monte Carlo study and print it beside what was published'
EPILOG = ('example: ctsid study hd-vs-ct --seeds 100\n'
          '         (Table 1 of the HD-PBSID paper by three methods)')
STUDIES = {
    'hd-vs-ct': 'hd_vs_ct',                 # [HD] Table 1, three methods
    'table1': 'table1',                     # [HD] Table 1 beside the Cramer-Rao bound
    'windows': 'windows',                   # windows that are not at rest
    'closed-loop': 'closed_loop',           # an unstable plant under its controller
    'tm': 'takenaka_malmquist',             # the example of [TM]
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('name', choices=STUDIES, help='which study')
    parser.add_argument('more', nargs=argparse.REMAINDER, metavar='...',
                        help='of the study itself, --seeds for example; `ctsid study NAME --help` '
                        'lists them')


def command(args: argparse.Namespace) -> int:
    """Run the study."""
    study = import_module(f'ctsid_ros.studies.{STUDIES[args.name]}')
    code: int = study.main(args.more)
    return code
