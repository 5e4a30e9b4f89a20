# SPDX-License-Identifier: Apache-2.0
"""`ctsid params`: every parameter with its default, or their reference."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from ctsid_ros.verbs.arguments import ACCEPTED

if TYPE_CHECKING:
    from ctsid_ros.config.channels import Config

HELP = 'print all parameters with their defaults, as a commented parameter file'
EPILOG = 'example: ctsid params > params.yaml'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--markdown', action='store_true',
                        help='print the reference of the parameters instead')
    parser.add_argument('--work-rate', action='store_true',
                        help='measure the work per second of this computer instead, to which '
                        'budgets can be fitted by the environment variable CTSID_WORK_RATE')


def command(args: argparse.Namespace) -> int:
    """Print them."""
    if args.work_rate:
        return _print_rate()
    from ctsid_ros.config.parameter_text import dump_config, parameters_markdown

    print(parameters_markdown() if args.markdown else dump_config(example()), end='')
    return ACCEPTED


def _print_rate() -> int:
    from time import process_time

    from ctsid_core.effort import VARIABLE, work_rate
    from ctsid_core.likelihood.kernel import built

    compiled = built()                              # without it everything takes twice as long
    kernel = 'with the compiled kernel' if compiled else \
        'without the compiled kernel: install a C compiler, and ctsid again'
    print(f'{VARIABLE}={measured_rate(process_time) * (1.0 if compiled else 0.5):.2g}  # work per '
          f'second, measured now, {kernel}; {work_rate():.2g} counts')
    return ACCEPTED


def measured_rate(clock: Callable[[], float]) -> float:
    """Return the work per second of this computer, by a clock of processor time [s]."""
    import numpy as np

    rows, columns = 1000, 40
    matrix = np.random.default_rng(0).standard_normal((rows, columns))
    times = []
    for _ in range(101):
        start = clock()
        np.linalg.qr(matrix, mode='r')
        times.append(clock() - start)
    return 2.0 * rows * columns ** 2 / max(float(np.median(times)), 1e-9)


def example() -> Config:
    """Return the defaults, with channels that stand for the user's own."""
    from ctsid_ros.config.channels import Channel, Config

    return Config((
        Channel('torque', 'input', '/command/torque', 'geometry_msgs/msg/WrenchStamped',
                'wrench.torque.x', 'N m'),
        Channel('rate', 'output', '/imu', 'sensor_msgs/msg/Imu', 'angular_velocity.x', 'rad/s')))
