# SPDX-License-Identifier: Apache-2.0
"""
The example of [TM] section V: a Takenaka-Malmquist chain against Laguerre chains.

Fourth-order G(s), 400 samples at 5 ms, normal noise on straight lines as input, no noise on the
output, N = 8, order 4 given; poles 4, 12, ..., 60 against eight equal ones at 4, 28 or 60. Each
chain is run in three ways: signals between samples as published (polynomials of degree 3 through
neighbouring samples), as they are known to be (input on straight lines, output a cubic spline),
and with the kinks of the input that a spline of the output misses. Beside them: the method with
poles from the data, and HD-PBSID with refinement.

Writes runs.csv, median_errors.csv, and the paper's figures 2 to 4 as SVG.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.takenaka_malmquist import chain
from ctsid_core.gobf_subspace import KINKS, filter_records, observe, realise
from ctsid_core.identify import identify
from ctsid_core.settings import Settings
from ctsid_core.signals import Record, Signal
from ctsid_core.statespace import StateSpace
from ctsid_ros.progress import progress
from ctsid_ros.studies.figure_files import write_drawings
from ctsid_ros.svg import Axes, Curve
from ctsid_ros.tables import Table

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

PERIOD, COUNT, ORDER = 0.005, 400, 4
OMEGA = np.geomspace(0.1, 100.0, 121)
SEQUENCES = {'TM 4..60': np.linspace(4.0, 60.0, 8), 'Laguerre 4': np.full(8, 4.0),
             'Laguerre 28': np.full(8, 28.0), 'Laguerre 60': np.full(8, 60.0)}
WAYS = {'published': (3, 0), 'held': (0, 0), 'kinks': (0, KINKS)}    # polynomial, kinks
RANK_TOLERANCE = 1e-10


def plant() -> StateSpace:
    """Return G(s) of [TM] section V."""
    numerator, denominator = (-0.8471, 0.9081, -5.972, 5.519), (3.115, 5.036, 4.577, 2.254)
    A = np.eye(4, k=1)
    A[3] = -np.array(denominator[::-1])
    return StateSpace(A, np.eye(4)[:, 3:], np.array([numerator[::-1]]))


def example(seed: int) -> Record:
    """Return the record of one run."""
    rng, t = np.random.default_rng(seed), PERIOD * np.arange(COUNT, dtype=float)
    u = Signal(t, rng.standard_normal((COUNT, 1)), 'linear')
    y = plant().simulate((u,), t)
    return Record.from_arrays(t, u.values, t, y, input_hold='linear')


def by_chain(record: Record, poles: Array, way: str) -> StateSpace:
    """Return the estimate by one chain of filters, [TM] eq. 6 to 15."""
    polynomial, kinks = WAYS[way]
    filtered = filter_records([record], chain(poles), (0.0,), trim=False, feedthrough=False,
                               polynomial=polynomial, kinks=kinks)
    found = realise(observe(filtered, RANK_TOLERANCE), ORDER, feedthrough=False)
    return StateSpace(found.A, found.B, found.C, found.D)


def by_identify(record: Record, method: str) -> StateSpace:
    """Return the estimate of `identify` with the order given; a rejected model counts."""
    found = identify(record, Settings(method=method, order=ORDER, feedthrough=False, trim=False,
                                      delay=0.0))
    model = found.model or found.rejected_model
    return model or StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)))


def contenders() -> dict[tuple[str, str], Callable[[Record], StateSpace]]:
    """Return who is compared, by name and way."""
    found: dict[tuple[str, str], Callable[[Record], StateSpace]] = {}
    for way in WAYS:
        for name, poles in SEQUENCES.items():
            found[name, way] = lambda r, p=poles, w=way: by_chain(r, p, w)  # type: ignore[misc]
    found['TM from the data', 'identify'] = lambda r: by_identify(r, 'gobf')
    found['HD-PBSID refined', 'identify'] = lambda r: by_identify(r, 'hd-pbsid')
    return found


def response(model: StateSpace) -> ComplexArray:
    """Return the frequency response over the grid."""
    return model.frequency_response(OMEGA)[:, 0, 0]


def run_all(seeds: int) -> dict[tuple[str, str], ComplexArray]:
    """Return the estimated frequency responses of each contender, (seeds, frequencies)."""
    who = contenders()
    found: dict[tuple[str, str], list[ComplexArray]] = {key: [] for key in who}
    with progress('Takenaka-Malmquist') as advance:
        for seed in range(seeds):
            record = example(seed)
            for key, estimate in who.items():
                found[key].append(response(estimate(record)))
            advance((seed + 1) / seeds, '')
    return {key: np.array(rows) for key, rows in found.items()}


def relative(errors: Array) -> Array:
    """Return root mean square errors over the grid, over that of G, run by run."""
    size = np.sqrt(np.mean(np.abs(response(plant())) ** 2))
    return np.asarray(np.sqrt(np.mean(errors ** 2, axis=1)) / size)


def table(errors: dict[tuple[str, str], Array]) -> Table:
    """Return what the errors |G - estimate|, (seeds, frequencies), amount to."""
    rows = []
    for (name, way), own in errors.items():
        each: Array = relative(own)
        best = errors.get(('TM 4..60', way))
        below = '' if best is None or name.startswith('TM') else \
            f'{100 * np.mean(np.median(best, axis=0) < np.median(own, axis=0)):.0f} %'
        wins = '' if not below or best is None else f'{np.sum(relative(best) < each)}/{len(each)}'
        rows.append((name, way, f'{np.median(each):.2g}', f'{np.max(each):.2g}',
                     f'{np.median(own[:, 0]):.2g}', f'{np.median(own[:, -1]):.2g}', below, wins))
    return Table(('estimate', 'between samples', 'median error', 'largest', 'at 0.1 rad/s',
                  'at 100 rad/s', 'TM below', 'TM wins'), tuple(rows),
                 ('estimate', 'between samples'))


def write(directory: Path, found: dict[tuple[str, str], ComplexArray],
          errors: dict[tuple[str, str], Array]) -> None:
    """Write the numbers and the figures."""
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / 'runs.csv').open('w', newline='', encoding='utf-8') as stream:
        out = csv.writer(stream)
        out.writerow(['estimate', 'between_samples', 'seed', 'relative_error'])
        for (name, way), own in errors.items():
            out.writerows([name, way, seed, repr(float(e))]
                          for seed, e in enumerate(relative(own)))
    with (directory / 'median_errors.csv').open('w', newline='', encoding='utf-8') as stream:
        out = csv.writer(stream)
        out.writerow(['omega_rad_s', *(f'{name} ({way})' for name, way in errors)])
        middle = [np.median(own, axis=0) for own in errors.values()]
        out.writerows([repr(float(x)) for x in row]
                      for row in np.column_stack((OMEGA, *middle)))
    write_drawings(directory / 'figure_2.svg', _samples())
    for way in WAYS:
        first = {name: found[name, way][0] for name in SEQUENCES}
        write_drawings(directory / f'figure_3_{way}.svg', _bode(first, way))
        write_drawings(directory / f'figure_4_{way}.svg', _error_curves(errors, way))


def _samples() -> list[Axes]:
    record = example(0)
    return [Axes([Curve(s.time, s.values[:, 0])], title=f'[TM] figure 2: {what}, seed 0',
                 x_label='time [s]', y_label=what)
            for what, s in (('input', record.inputs[0]), ('output', record.outputs[0]))]


def _bode(own: dict[str, ComplexArray], way: str) -> list[Axes]:
    truth = response(plant())
    parts: list[tuple[str, Callable[[ComplexArray], Array], bool]] = [
        ('magnitude', lambda g: np.abs(g), True),
        ('phase [deg]', lambda g: np.degrees(np.unwrap(np.angle(g))), False)]
    found = []
    for what, of, log in parts:
        curves = [Curve(OMEGA, of(truth), 'G', 0)]
        curves += [Curve(OMEGA, of(g), name, i, 'dashed')
                   for i, (name, g) in enumerate(own.items(), 1)]
        found.append(Axes(curves, title=f'[TM] figure 3, {way}, seed 0', x_log=True, y_log=log,
                          x_label='frequency [rad/s]', y_label=what, height=300.0))
    return found


def _error_curves(errors: dict[tuple[str, str], Array], way: str) -> list[Axes]:
    shown: Sequence[tuple[str, str]] = [(name, way) for name in SEQUENCES] + [
        ('HD-PBSID refined', 'identify')]
    curves = [Curve(OMEGA, np.median(errors[key], axis=0), key[0], i)
              for i, key in enumerate(shown, 1)]
    return [Axes(curves, title=f'[TM] figure 4, {way}', x_log=True, y_log=True,
                 x_label='frequency [rad/s]', y_label='median |G - estimate|', height=360.0)]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table and write CSV and figures."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=20, help='runs')
    parser.add_argument('--out', type=Path, default=Path('takenaka_malmquist'),
                        help='directory of the CSV files and figures')
    given = parser.parse_args(argv)
    found, truth = run_all(given.seeds), response(plant())
    errors = {key: np.abs(rows - truth) for key, rows in found.items()}
    write(given.out, found, errors)
    print(f'{given.seeds} runs; errors of the frequency response over 0.1 to 100 rad/s, over the '
          'size of G;\nTM below: part of the frequencies where the median error of TM is the '
          f'smaller\n\n{table(errors).text()}\n\nCSV and figures: {given.out}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
