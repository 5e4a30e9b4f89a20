# SPDX-License-Identifier: Apache-2.0
"""
The example of [TM] section V: a Takenaka-Malmquist chain against Laguerre chains.

Fourth-order G(s), 400 samples at 5 ms, normal noise on straight lines as input, no noise on the
output, N = 8, order 4 given; poles 4, 12, ..., 60 against eight equal ones at 4, 28 or 60. Each
chain is run in three ways: signals between samples as published (polynomials of degree 3 through
neighbouring samples), as they are known to be (input on straight lines, output a cubic spline),
and with the kinks of the input that a spline of the output misses. Beside them: `identify` by the
same method with poles from the data, and by HD-PBSID, with the order given and with nothing set.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ctsid_core.bases.takenaka_malmquist import chain
from ctsid_core.identify import identify
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.simulation import Pieces, input_polynomials
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_core.subspace.gobf import KINKS, filter_records
from ctsid_ros.report.drawing import Axes, Curve
from ctsid_ros.report.static import write_drawings
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.clouds import phase
from ctsid_ros.studies.figure_files import write_csv
from ctsid_ros.studies.filtered_inputs import realised
from ctsid_ros.studies.local_polynomials import local_polynomials
from ctsid_ros.studies.monte_carlo import Outcome, compared
from ctsid_ros.studies.network import draw_network
from ctsid_ros.studies.runner import Task, arguments, conclude, keeping

PERIOD, COUNT, ORDER = 0.005, 400, 4
OMEGA = np.geomspace(0.1, 100.0, 121)
SEQUENCES = {'TM 4..60': np.linspace(4.0, 60.0, 8), 'Laguerre 4': np.full(8, 4.0),
             'Laguerre 28': np.full(8, 28.0), 'Laguerre 60': np.full(8, 60.0)}
SPREAD = 'TM 4..60'
WAYS: dict[str, tuple[Pieces, int]] = {                             # between samples, kinks
    'published': (local_polynomials(3), 0), 'held': (input_polynomials, 0),
    'kinks': (input_polynomials, KINKS)}
METHODS = {'gobf': 'gobf', 'HD-PBSID': 'hd-pbsid'}
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


def by_chain(seed: int, name: str, way: str) -> Outcome:
    """Return the outcome of one run by one chain of filters, [TM] eq. 6 to 15."""
    pieces, kinks = WAYS[way]
    filtered = filter_records([example(seed)], chain(SEQUENCES[name]), (0.0,), trim=False,
                              feedthrough=False, pieces=pieces, kinks=kinks)
    found = realised(filtered, ORDER, feedthrough=False, rank_tolerance=RANK_TOLERANCE)
    return compared(StateSpace(found.A, found.B, found.C, found.D), plant().poles)


def by_identify(seed: int, method: str, order: int | None) -> Outcome:
    """Return the outcome of one run by `identify`; a rejected model counts."""
    settings = Settings(method=method)
    if order:
        settings = settings.replace(order=order, feedthrough=False, trim=False, delay=0.0)
    found = identify(example(seed), settings)
    return compared(found.model or found.rejected_model, plant().poles,
                    np.asarray(found.pole_std), found.verdict.grade.name)


def tasks() -> dict[tuple[str, str], Task]:
    """Return who is compared, by name and way."""
    found: dict[tuple[str, str], Task] = {
        (name, way): partial(by_chain, name=name, way=way) for way in WAYS for name in SEQUENCES}
    for name, method in METHODS.items():
        for way, order in (('order given', ORDER), ('nothing set', None)):
            found[name, way] = partial(by_identify, method=method, order=order)
    return found


def response(model: StateSpace | None) -> ComplexArray:
    """Return the frequency response over the grid, zero without a model."""
    return np.zeros(len(OMEGA), complex) if model is None else \
        model.frequency_response(OMEGA)[:, 0, 0]


def relative(errors: Array) -> Array:
    """Return root mean square errors over the grid, over that of G, run by run."""
    size = np.sqrt(np.mean(np.abs(response(plant())) ** 2))
    return np.asarray(np.sqrt(np.mean(errors ** 2, axis=1)) / size)


def table(done: dict[tuple[str, str], list[Outcome]],
          errors: dict[tuple[str, str], Array]) -> Table:
    """Return what the errors |G - estimate|, (seeds, frequencies), amount to."""
    rows = []
    for (name, way), own in errors.items():
        each: Array = relative(own)
        best = errors.get((SPREAD, way))
        below = '' if best is None or name == SPREAD else \
            f'{100 * np.mean(np.median(best, axis=0) < np.median(own, axis=0)):.0f} %'
        wins = '' if not below or best is None else f'{np.sum(relative(best) < each)}/{len(each)}'
        right = sum(o.order == ORDER for o in done[name, way])
        rows.append((name, way, f'{np.median(each):.2g}', f'{np.max(each):.2g}',
                     f'{np.median(own[:, 0]):.2g}', f'{np.median(own[:, -1]):.2g}', below, wins,
                     f'{right}/{len(own)}'))
    return Table(('estimate', 'between samples', 'median error', 'largest', 'at 0.1 rad/s',
                  'at 100 rad/s', 'TM below', 'TM wins', 'order 4'), tuple(rows),
                 ('estimate', 'between samples'))


def _filters() -> list[Axes]:
    curves = [Curve(OMEGA, np.abs(np.sqrt(2.0 * pole) / (1j * OMEGA + pole)),
                    f'{pole:g}' if pole in (4.0, 60.0) else '', i % 5 + 1)
              for i, pole in enumerate(SEQUENCES[SPREAD])]
    return [Axes(curves, title='Size of the eight filters: poles 4, 12, ..., 60', x_log=True,
                 y_log=True, x_label='frequency [rad/s]', y_label='|M_k|')]


def _samples() -> list[Axes]:
    record = example(0)
    return [Axes([Curve(s.time, s.values[:, 0])], title=f'[TM] figure 2: {what}, seed 0',
                 x_label='time [s]', y_label=what)
            for what, s in (('input', record.inputs[0]), ('output', record.outputs[0]))]


def _bode(own: dict[str, ComplexArray], way: str) -> list[Axes]:
    truth = response(plant())
    size = [Curve(OMEGA, np.abs(truth), 'G', 0)]
    size += [Curve(OMEGA, np.abs(g), name, i, 'dashed') for i, (name, g) in
             enumerate(own.items(), 1)]
    turns = [Curve(OMEGA, phase(truth, truth), '', 0)]
    turns += [Curve(OMEGA, phase(g, truth), '', i, 'dashed') for i, g in
              enumerate(own.values(), 1)]
    return [Axes(size, title=f'[TM] figure 3, {way}, seed 0', x_log=True, y_log=True,
                 x_label='frequency [rad/s]', y_label='magnitude', height=300.0),
            Axes(turns, x_log=True, x_label='frequency [rad/s]', y_label='phase [deg]',
                 height=300.0)]


def _error_curves(errors: dict[tuple[str, str], Array], way: str) -> list[Axes]:
    shown = [(name, way, name) for name in SEQUENCES]
    shown += [('HD-PBSID', 'order given', 'HD-PBSID')]
    curves = [Curve(OMEGA, np.median(errors[name, how], axis=0), label, i)
              for i, (name, how, label) in enumerate(shown, 1)]
    return [Axes(curves, title=f'[TM] figure 4, {way}', x_log=True, y_log=True,
                 x_label='frequency [rad/s]', y_label='median |G - estimate|', height=360.0)]


def draw(out: Path, models: dict[tuple[str, str], ComplexArray],
         errors: dict[tuple[str, str], Array]) -> None:
    """Draw the figures of the paper."""
    draw_network(out / 'tm_figure_1.svg', 4)
    write_drawings(out / 'tm_filters.svg', _filters())
    write_drawings(out / 'tm_figure_2.svg', _samples())
    for way in WAYS:
        shown = {name: models[name, way][0] for name in SEQUENCES}
        write_drawings(out / f'tm_figure_3_{way}.svg', _bode(shown, way))
        write_drawings(out / f'tm_figure_4_{way}.svg', _error_curves(errors, way))


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, write it and the figures."""
    given = arguments(__doc__, 'tm', 20, argv)
    wanted, truth = tasks(), response(plant())
    with keeping(given, len(wanted)) as runs:
        done = {key: runs(task, ', '.join(key)) for key, task in wanted.items()}
    models = {key: np.array([response(o.model) for o in own]) for key, own in done.items()}
    errors = {key: np.asarray(np.abs(rows - truth)) for key, rows in models.items()}
    found = table(done, errors)
    middle = [tuple(f'{x:.4g}' for x in row) for row in np.column_stack(
        (OMEGA, *(np.median(own, axis=0) for own in errors.values())))]
    write_csv(given.out / 'tm_median_errors.csv', (
        ('omega [rad/s]', *(f'{name}, {way}' for name, way in errors)), *middle))
    draw(given.out, models, errors)
    conclude(given, 'tm', found, f'{given.seeds} runs; errors of the frequency response over '
             '0.1 to 100 rad/s, over the size of G;\nTM below: part of the frequencies where the '
             'median error of TM is the smaller')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
