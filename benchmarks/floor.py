# SPDX-License-Identifier: Apache-2.0
"""
Time of a whole identification over its floor.

The floor is the projection done directly: the Hermite functions at every sample, and one product
of (channels x samples) by (samples x functions). ctsid goes by way of frequencies, so that a whole
identification of many samples may cost less than its floor. Stamps are uniform and shared in the
first table; in the second every channel has its own, as on a robot.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import os
import time

os.environ |= {'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}

from common import DURATION, experiment, interleaved, machine, noisy, sweep, table  # noqa: E402
import numpy as np  # noqa: E402

from ctsid_core import Record, Settings, identify  # noqa: E402
from ctsid_core.bases.hermite import hermite_lines, time_scale  # noqa: E402
from ctsid_core.bases.hermite_functions import (  # noqa: E402
    frequency_grid,
    frequency_table,
    hermite_functions,  # noqa: E402
)
from ctsid_core.bases.records import choose_nmax  # noqa: E402
from ctsid_core.signals.record import Signal  # noqa: E402

COUNTS = (1000, 2000, 5000, 10000, 20000)
ORDERS = (100, 250, 300, 500, 1000)
AIMS = ((2000, 250), (10000, 300))      # where 'all given' is to cost at most AIM floors
AIM = 2.0
HEAD = ('samples', 'nmax', 'floor', 'all given', 'order given', 'automatic', 'once per nmax')


def uniform(count: int) -> Record:
    """Return the experiment at uniform stamps that all channels share; the input is linear."""
    t = np.linspace(0.0, DURATION, count)
    return Record.from_arrays(t, sweep(t), t, noisy(experiment(t), 20.0, 0))


def own_stamps(count: int) -> Record:
    """Return the experiment with a held input and each output jittered by itself."""
    rng = np.random.default_rng(1)
    stamps = []
    for _ in range(3):
        t = np.linspace(0.0, DURATION, count)
        t[1:-1] += rng.uniform(-0.45, 0.45, count - 2) * (t[1] - t[0])
        stamps.append(t)
    outputs = [Signal(t, noisy(experiment(t), 20.0, i)[:, i:i + 1], 'smooth')
               for i, t in enumerate(stamps[1:])]
    return Record.from_signals([Signal(stamps[0], sweep(stamps[0])[:, np.newaxis], 'zoh')],
                               outputs)


def floor(record: Record, nmax: int) -> Callable[[], object]:
    """Return the floor of a record: one evaluation at each set of stamps, one product."""
    alpha = time_scale(nmax, 0.5 * record.duration, Settings())
    groups: dict[bytes, list[Signal]] = {}
    for signal in (*record.inputs, *record.outputs):
        groups.setdefault(signal.time.tobytes(), []).append(signal)
    middle = 0.5 * (record.start + record.end)
    work = [((same[0].time - middle) / alpha,
             np.ascontiguousarray(np.hstack([signal.values for signal in same]).T))
            for same in groups.values()]
    return lambda: [values @ hermite_functions(nmax, x).T for x, values in work]


def row(count: int, record: Record, nmax: int, rounds: int) -> tuple[str, ...]:
    """Measure one record; nmax = 0 leaves it to the identification."""
    used = nmax or choose_nmax(record)[0]
    given = Settings(order=2, nmax=used, beta=3.0, gamma=20.0, past=3, refine=False,
                     held_out=0.0)
    order, nothing = Settings(order=2, nmax=nmax), Settings(nmax=nmax)
    once = _once(used)
    seconds = interleaved({
        'floor': floor(record, used), 'given': lambda: identify(record, given),
        'order': lambda: identify(record, order),
        'nothing': lambda: identify(record, nothing)}, rounds)
    base = seconds['floor']
    return (str(count), f'{used}{"" if nmax else "*"}', f'{1e3 * base:.2f}',
            *(f'{1e3 * seconds[case]:.1f} ({seconds[case] / base:.1f})'
              for case in ('given', 'order', 'nothing')), f'{1e3 * once:.0f}')


def _once(nmax: int) -> float:
    """Return the seconds of what depends on nmax alone and is kept between windows."""
    for kept in (hermite_lines, frequency_grid, frequency_table):
        kept.cache_clear()
    begin = time.process_time()
    hermite_lines(nmax)
    frequency_table(nmax)
    return time.process_time() - begin


def reachable(count: int, nmax: int) -> bool:
    """Whether the basis stays below the Nyquist frequency of so many samples."""
    return 2.0 * nmax / (0.5 * DURATION) < np.pi * count / DURATION


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--counts', type=int, nargs='+', default=COUNTS, metavar='N')
    parser.add_argument('--orders', type=int, nargs='+', default=ORDERS, metavar='NMAX')
    parser.add_argument('--rounds', type=int, default=15, help='per row [%(default)s]')
    options = parser.parse_args(arguments)
    print(f'Whole identification over its floor, 1 input, 2 outputs, order 2.\n{machine()}')
    print(f'Milliseconds of the processor, medians of {options.rounds} interleaved rounds; in '
          'brackets: floors.')
    print('all given: order, nmax, beta, gamma, past; no refinement, no part held out.\n'
          'order given, automatic: the order, or nothing but nmax; * nmax found as well.\n')
    rows = [row(count, uniform(count), nmax, options.rounds) for count in options.counts
            for nmax in (*options.orders, 0) if reachable(count, nmax)]
    print(table(HEAD, rows))
    for count, nmax in AIMS:
        for found in (r for r in rows if r[:2] == (str(count), str(nmax))):
            ratio = float(found[3].partition('(')[2].rstrip(')'))
            print(f'Aim: all given at most {AIM:g} floors at {count} samples, nmax {nmax}: '
                  f'{ratio:.1f}, {"reached" if ratio <= AIM else "NOT reached"}.')
    print('\nEvery channel with its own jittered stamps, input held:\n')
    print(table(HEAD, [row(count, own_stamps(count), nmax, options.rounds)
                       for count, nmax in AIMS
                       if count in options.counts and nmax in options.orders]))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
