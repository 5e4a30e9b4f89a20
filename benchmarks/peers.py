# SPDX-License-Identifier: Apache-2.0
"""
Accuracy and time of ctsid beside other free subspace packages, on one experiment.

Second-order plant of [HD] 5.1 (poles -2 and -4), plain linear sweep 0 to 8 Hz over 10 s, 2000
samples, white noise at 20 dB in every output. All contenders see the same noise, one after the
other, seed by seed. Peers are told the order. Rows with * show a peer at its best: decimation
and horizon chosen knowing the truth. Below the table: what is aimed at with nothing set, over
more seeds, at 20 and at 6 dB.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import contextlib
from dataclasses import dataclass, field
from importlib.util import find_spec
import io
import itertools
import os
import time
import warnings

os.environ |= {'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}

from common import (  # noqa: E402
    DURATION,
    POLES,
    Array,
    experiment,
    least_deviation,
    machine,
    noisy,
    sweep,
    table,
)
from contenders import CONTENDERS, ORDER, SLOW, Contender, Poles  # noqa: E402
import numpy as np  # noqa: E402

COUNT = 2000
SNR = 20.0                      # dB
LOW_SNR = 6.0                   # dB
AIMS = (0.026, 0.076)           # mean distance from -2 and -4 rad/s with nothing set
RIGHT = {SNR: 95, LOW_SNR: 80}  # % of runs in which the order is right
RIVAL = 'SLICOT PO-MOESP, s = 60'
HEAD = ('who', 'error of -2', 'of -4', 'worst', 'ms', 'order found', 'failed')


@dataclass
class Tally:
    """What a contender did over the seeds: pole errors where the order was right, seconds."""

    errors: list[Array] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)


def pole_errors(poles: Poles) -> Array:
    """Return the distances of the true poles from the found ones, paired for the least sum."""
    pairs = [np.abs(np.array(p) - POLES) for p in itertools.permutations(poles, len(POLES))]
    return min(pairs, key=lambda distances: float(distances.sum()))


def race(contenders: Sequence[Contender], seeds: int, snr: float = SNR) -> dict[str, Tally]:
    """Run all contenders on the same data, in turn, once per seed."""
    t = np.linspace(0.0, DURATION, COUNT)
    u, clean = sweep(t), experiment(t)
    tallies = {c.name: Tally() for c in contenders}
    for contender in contenders:                # imports and caches are nobody's running time
        _attempt(contender, t, u, noisy(clean, snr, seeds), Tally())
    for seed in range(seeds):
        y = noisy(clean, snr, seed)
        for contender in contenders:
            _attempt(contender, t, u, y, tallies[contender.name])
    return tallies


def _attempt(contender: Contender, t: Array, u: Array, y: Array, tally: Tally) -> None:
    with _quiet():
        begin = time.perf_counter()
        try:
            poles, order = contender.run(t.copy(), u.copy(), y.copy())
        except Exception as error:  # noqa: BLE001 -- whatever a peer raises is its result
            tally.failures.append(f'{type(error).__name__}: {error}')
            return
        tally.seconds.append(time.perf_counter() - begin)
    if order is not None:
        tally.right.append(order == ORDER)
    if not np.isfinite(poles).all():
        tally.failures.append(f'poles are {poles}')
    elif len(poles) == ORDER:
        tally.errors.append(pole_errors(poles))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what peers print and warn of out of the table."""
    with (contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()),
          warnings.catch_warnings(), np.errstate(all='ignore')):
        warnings.simplefilter('ignore')
        yield


def line(name: str, tally: Tally, seeds: int) -> tuple[str, ...]:
    """Return the row of one contender."""
    order = f'{100 * np.mean(tally.right):.0f} %' if tally.right else ''
    failed = f'{len(tally.failures)}/{seeds}' if tally.failures else ''
    if not tally.errors:
        return name, '', '', '', '', order, failed
    means, worst = np.mean(tally.errors, axis=0), np.max(tally.errors)
    return (name, *(f'{value:.3g}' for value in means), f'{worst:.3g}',
            f'{1e3 * np.median(tally.seconds):.1f}', order, failed)


def aims(tallies: dict[str, Tally], seeds: int) -> list[str]:
    """Say how this project does with nothing set, and what was aimed at."""
    own, lines = CONTENDERS[0], []
    for snr, wanted in RIGHT.items():
        tally = race([own], seeds, snr)[own.name]
        text = (f'{snr:g} dB: order right in {100 * sum(tally.right) / seeds:.0f} % of {seeds} '
                f'runs (aim: {wanted} %)')
        if snr == SNR and tally.errors:
            means = zip(np.mean(tally.errors, axis=0), AIMS, strict=True)
            text += ', mean distance ' + ', '.join(f'{m:.4f} (aim: {a:g})' for m, a in means)
        lines.append(text)
    for name, aim in ((RIVAL, 'below 1'), (SLOW.name, 'below 0.01')):
        if name in tallies and tallies[name].seconds and tallies[own.name].seconds:
            ratio = np.median(tallies[own.name].seconds) / np.median(tallies[name].seconds)
            lines.append(f'time over that of {name}: {ratio:.3g} (aim: {aim})')
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=20, help='runs of each [%(default)s]')
    parser.add_argument('--aim-seeds', type=int, default=100,
                        help='runs with nothing set that are held against the aims [%(default)s]')
    parser.add_argument('--jax-sysid', action='store_true',
                        help='also jax-sysid, if installed: some 12 s per run')
    options = parser.parse_args(arguments)
    wanted = (*CONTENDERS, SLOW) if options.jax_sysid else CONTENDERS
    present = [c for c in wanted if not c.module or find_spec(c.module)]
    print(f'ctsid and its peers: {COUNT} samples, {SNR:g} dB, {options.seeds} seeds.\n{machine()}')
    print('Mean distance of the poles from -2 and -4 rad/s, the largest of all, median time.\n'
          'order found: how often the own choice of the order is right (poles count where ctsid\n'
          'is right; peers are told). * decimation and horizon chosen knowing the truth.\n')
    tallies = race(present, options.seeds)
    deviation = least_deviation(np.linspace(0.0, DURATION, COUNT), SNR)
    bound = [f'{value:.3g}' for value in np.sqrt(2.0 / np.pi) * deviation]
    rows = [('least possible (Cramer-Rao bound)', *bound, '', '', '', '')]
    print(table(HEAD, [*rows, *(line(name, t, options.seeds) for name, t in tallies.items())]))
    for missing in sorted({c.module for c in wanted} - {c.module for c in present}):
        print(f'Skipped: the module {missing} is not installed.')
    for name, tally in tallies.items():
        for failure in sorted(set(tally.failures)):
            print(f'Failed: {name}: {failure}')
    if options.aim_seeds:
        print('\nAims, with nothing set:')
        print('\n'.join(aims(tallies, options.aim_seeds)))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
