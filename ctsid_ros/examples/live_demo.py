# SPDX-License-Identifier: Apache-2.0
"""
The live demonstration: a robot flies, is identified, changes, and is identified again.

    python -m ctsid_ros.examples.live_demo --params config/live_demo.yaml

Simulated robot, identifier and gain tuner run as processes of their own, in a ROS domain of their
own on this computer. Half way through the flight a payload is attached; on a busy computer the
flight lasts until enough windows are identified. Exit codes: 0 no GOOD model was wrong, the change
was noticed, and models were GOOD again soon after it; 1 it was not so, or it could not run; 130
interrupted.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import io
import os
import sys

from ctsid_ros.blas import use_one_thread
from ctsid_ros.examples.demo_processes import processes
from ctsid_ros.examples.domain import claim_domain

SEED = 1
HEAVIEST = 5.0  # payload that the simulated robot takes [kg]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; return the exit code."""
    args = _parser().parse_args(argv)
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal that has no ± shows a ?
        sys.stdout.reconfigure(errors='replace', line_buffering=True)
    use_one_thread()
    try:
        domain, claim = claim_domain()
    except OSError as error:
        print(f'live_demo: error: {error}', file=sys.stderr)
        return 1
    own = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    os.environ |= own
    try:
        from ctsid_ros.examples.demo_node import Plan, fly
    except ImportError as error:
        print(f'live_demo: error: {error}; this needs ROS 2: source it, or in the folder of '
              "ctsid: pip install '.[ros]'", file=sys.stderr)
        return 1
    print('to watch it in another terminal, in this environment: '
          f'{" ".join(f"{name}={value}" for name, value in own.items())} ctsid watch')
    with claim, processes() as started:
        try:
            good = fly(started, Plan(args.params, args.duration, args.payload, args.seed))
        except KeyboardInterrupt:
            return 130
        except (RuntimeError, TimeoutError) as error:
            print(f'live_demo: error: {error}\n{started.logs()}', file=sys.stderr)
            return 1
    return 0 if good else 1


def _mass(text: str) -> float:
    if 0.0 < (mass := float(text)) <= HEAVIEST:
        return mass
    raise argparse.ArgumentTypeError(f'{text} is not a mass from above 0 to {HEAVIEST:g} kg')


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='live_demo', description='A simulated robot is identified while it flies and a '
        'payload is attached to it.')
    parser.add_argument('--params', metavar='FILE', required=True,
                        help='parameter file of the identifier: config/live_demo.yaml')
    parser.add_argument('--duration', type=float, default=30.0, metavar='S',
                        help='of the flight at least [s, default 30]; the payload comes half way')
    parser.add_argument('--payload', type=_mass, default=0.5, metavar='KG',
                        help='mass of the payload [kg, up to 5, default 0.5]')
    parser.add_argument('--seed', type=int, default=SEED, metavar='N',
                        help=f'of the flight [default {SEED}; 0: another each time]')
    return parser


if __name__ == '__main__':
    sys.exit(main())
