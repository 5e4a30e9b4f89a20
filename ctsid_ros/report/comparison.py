# SPDX-License-Identifier: Apache-2.0
"""Models beside each other: of several methods, of several orders, or stored ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import csv
from dataclasses import dataclass
import io
import math
from typing import Any

import numpy as np

from ctsid_core.judge.cross_check import DEVIATIONS, EFFICIENT, RELATIVE
from ctsid_core.judge.rules import KNOWN
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import UNKNOWN, Agreement
from ctsid_core.search.held_out import as_judged
from ctsid_core.search.own_past import AHEAD, HORIZONS
from ctsid_core.signals.record import Record
from ctsid_ros.report.document import GLOSSARY, Bullets, Explorer, Figure, Gallery, Section
from ctsid_ros.report.drawing import MOST_MODELS, Axes, Curve, Drawing
from ctsid_ros.report.explorer import Item, facts, series
from ctsid_ros.report.model_page import Shown, response_sections
from ctsid_ros.report.outputs import Part, compared_figures
from ctsid_ros.report.tables import Table, fit_words, number, percent, plus_minus, pole_text
from ctsid_ros.report.tracks import told
from ctsid_ros.report.words import spreadsheet


@dataclass(frozen=True)
class Contender:
    """
    One of the models that are compared.

    Parameters
    ----------
    name : str
        Of the method, or of the file.
    estimate : Estimate
    agreement : Agreement or None
        With the first that has a model; None for that one and those before it.
    seconds : float
        Of processor time, if it was identified now.
    part : Part or None
        What it makes of the data that all are compared on: this is drawn.
    simulated, ahead : ndarray, shape (ny,), optional
        Of stored models: fits of its simulation and of its predictions on these data [%].
    """

    name: str
    estimate: Estimate
    agreement: Agreement | None = None
    seconds: float = math.nan
    part: Part | None = None
    simulated: Array | None = None
    ahead: Array | None = None

    @property
    def model(self) -> StateSpace | None:
        """The model, accepted or not."""
        return self.estimate.model or self.estimate.rejected_model


def leader(found: Sequence[Contender]) -> Contender:
    """Return the first that was accepted, or else the first with a model, or else the first."""
    with_model = [c for c in found if c.model is not None]
    return next((c for c in with_model if c.estimate.ok), (*with_model, *found)[0])


def reference(found: Sequence[Contender]) -> str | None:
    """Return the name of the one that the others are compared with."""
    return next((c.name for c in found if c.model is not None), None)


def agreeing(found: Sequence[Contender]) -> str:
    """Return how many agree with the reference, and of how many that cannot be told."""
    answers = [c.agreement.answer for c in found if c.agreement is not None]
    unknown = answers.count(UNKNOWN)
    return f'{answers.count("yes")} of {len(answers)}' + (
        f', of {unknown} it cannot be told' if unknown else '')


def table_section(found: Sequence[Contender], kind: str) -> Section:
    """Return a row of numbers for each; `kind` is what they are: method, model."""
    columns = _columns(found)
    rows = tuple((c.name, *(shown(c) for shown in columns.values())) for c in found)
    words = [] if reference(found) is None else [
        f'Difference: of the frequency response from that of {reference(found)}, over its size, '
        'rms over the excited band, with the standard deviation of both. A model agrees where '
        f'both are at most {100 * KNOWN:g} %, as the verdict asks of the response to an input. It '
        f'does not where the largest difference is beyond {100 * RELATIVE:g} % and beyond chance '
        f'({DEVIATIONS:g} standard deviations, {EFFICIENT:g} for HD-PBSID), its dead time is '
        f'another one, or only one of both diverges. Else these data cannot tell. {GLOSSARY}']
    return Section(f'{kind.capitalize()}s side by side', (
        Table((kind, *columns), rows, (kind, 'verdict', 'agrees')), *words))


def _columns(found: Sequence[Contender]) -> dict[str, Any]:
    """Return what is shown of each contender, by the heading of the column."""
    columns = {'verdict': lambda c: c.estimate.verdict.grade.name,
               'order': lambda c: str(c.model.n) if c.model else '-'}
    own = ''
    if any(c.simulated is not None for c in found):
        own = 'own '
        columns |= {'simulation fit on these data [%]': lambda c: _fits(c.simulated),
                    f'predicted {HORIZONS[AHEAD]} samples [%]': lambda c: _fits(c.ahead)}
    columns |= {f'{own}fit [%]': lambda c: fit_words(c.estimate.fit),
                f'{own}held-out fit [%]': lambda c: fit_words(c.estimate.held_out_fit),
                'agrees': lambda c: _differs(c.agreement)[0],
                'difference [%]': lambda c: _differs(c.agreement)[1],
                'largest [%]': lambda c: _differs(c.agreement)[2],
                'largest / std': lambda c: _differs(c.agreement)[3]}
    if any(math.isfinite(c.seconds) for c in found):
        columns['time [s]'] = lambda c: number(c.seconds, 2)
    return columns


def _fits(values: Array | None) -> str:
    return '-' if values is None else fit_words(values)


def _differs(a: Agreement | None) -> tuple[str, str, str, str]:
    if a is None or math.isnan(a.relative):
        return '-', '-', '-', '-'
    return (a.answer, f'{percent(100.0 * a.difference)} ± {percent(100.0 * a.difference_std)}',
            percent(100.0 * a.relative), number(a.deviations, 2))


def pole_section(found: Sequence[Contender], kind: str) -> Section:
    """Return the poles of each; a pair in one row."""
    rows = tuple((c.name, *_pole(c, k)) for c in found if c.model
                 for k in range(c.model.n) if c.model.poles[k].imag <= 0.0)
    return Section('Poles in numbers', (Table(
        (kind, 'pole [rad/s]', 'std', 'dead time [s]'), rows, (kind,)),) if rows else ())


def _pole(c: Contender, k: int) -> tuple[str, str, str]:
    assert c.model is not None
    std, late = c.estimate.pole_std, c.estimate.delay_std
    late = late if len(late) == c.model.nu else np.full(c.model.nu, math.nan)
    dead = ', '.join(plus_minus(d, s, 3) for d, s in zip(c.model.delay, late, strict=True)) \
        if k == 0 or not any(c.model.poles[:k].imag <= 0.0) else ''
    return (pole_text(told(c.model.poles[k], c.estimate)),
            number(float(std[k]), 2) if len(std) > k else '-', dead)


def verdict_section(found: Sequence[Contender]) -> Section:
    """Return the reason of each verdict, and how each agrees with the reference."""
    return Section('Verdicts', (Bullets(tuple(
        f'{c.name}: {c.estimate.verdict.reason}' for c in found)), Bullets(tuple(
            c.agreement.words for c in found if c.agreement is not None))))


def drawn_sections(found: Sequence[Contender], record: Record | None = None, offset: float = 0.0
                   ) -> Iterator[Section]:
    """
    Yield the drawings in which all models lie over each other.

    Parameters
    ----------
    found : sequence of Contender
        Of the same inputs and outputs.
    record : Record, optional
        What their parts are of.
    offset : float
        Of its times, after the start of the bag [s].
    """
    shown, lead = [c for c in found if c.model is not None][:MOST_MODELS], leader(found)
    parts = {c.name: c.part for c in shown if c.part is not None}
    beside = None
    if record is not None and parts:
        how = next(iter(parts.values())).how
        yield Section(f'Measured and {how.split()[0]}', (
            Gallery(tuple(compared_figures(record, parts, offset))),))
        assert lead.model is not None
        beside = Shown(record, lead.model, (*parts.values(),), offset)
    if shown:
        yield from response_sections(
            {c.name: (c.model, c.estimate.covariance) for c in shown if c.model is not None},
            beside, lead.estimate)


@dataclass(frozen=True)
class Order:
    """
    The model of one order, with fits that can be compared with those of other orders.

    Parameters
    ----------
    estimate : Estimate
    fit, held_out_fit : ndarray, shape (ny,)
        Of the kind that the chosen order is judged by: simulation, or prediction [%]. NaN where
        this order was not.
    """

    estimate: Estimate
    fit: Array
    held_out_fit: Array


def order_of(estimate: Estimate, record: Record, chosen: Estimate) -> Order:
    """
    Return an order beside the chosen one.

    One that was found by simulation and the other by predictions: then its own fit is computed
    anew, as that of the chosen one is meant.
    """
    model = estimate.model or estimate.rejected_model
    if model is None or chosen.by_predictions == estimate.by_predictions:
        return Order(estimate, estimate.fit, estimate.held_out_fit)
    return Order(estimate, as_judged(chosen, model, record).fit, np.full(model.ny, math.nan))


def order_sections(orders: Mapping[int, Order], chosen: int) -> list[Section]:
    """
    Return fits by order, and the place where a click shows the model of an order.

    Parameters
    ----------
    orders : mapping of int to Order
        In rising order; empty if none were tried.
    chosen : int
        The order that `identify` chose.
    """
    if not orders:
        return []
    rows = tuple((str(n), o.estimate.verdict.grade.name, fit_words(o.fit),
                  fit_words(o.held_out_fit), ',  '.join(_poles(o.estimate)),
                  'chosen' if n == chosen else '') for n, o in orders.items())
    left = ('verdict', 'poles [rad/s]', '')
    kind = f' Own fits are of predictions {HORIZONS[AHEAD]} samples ahead, held-out fits of ' \
           'predictions of the next sample.' if chosen in orders and \
        orders[chosen].estimate.by_predictions else ''
    return [Section('Which order', (
        'Own: the fit on the data that a model is of; it rises with the order. Held out: the fit '
        'of a second model, of a part of the data, on the rest; it stops rising where further '
        'states describe noise. Take the lowest order at which both have come to rest. A click '
        'on an order shows its model below. (Without a held-out fit: an order that was found '
        f'in another way than the chosen one, by simulation or by predictions.){kind}',
        Gallery((_fit_figure(orders, chosen),)),
        Table(('order', 'verdict', 'fit [%]', 'held-out fit [%]', 'poles [rad/s]', ''), rows,
              left))),
        Section('One order', (Explorer([*orders].index(chosen) if chosen in orders else 0,
                                       'order'),))]


def _poles(estimate: Estimate) -> list[str]:
    model = estimate.model or estimate.rejected_model
    return [] if model is None else [
        pole_text(told(p, estimate), 3) for p in model.poles if p.imag <= 0.0]


def _fit_figure(orders: Mapping[int, Order], chosen: int) -> Figure:
    """Draw the fits, own and held out, over the order: a click chooses one."""
    x = np.array([*orders], dtype=float)
    names = next((m.output_names for o in orders.values()
                  if (m := o.estimate.model or o.estimate.rejected_model)), ())
    curves, apart = [], MOST_MODELS // 2 if len(names) <= MOST_MODELS // 2 else 0    # colours
    for i, name in enumerate(names[:MOST_MODELS]):
        own, held = (np.array([v[i] if i < len(v) else math.nan for v in values]) for values in (
            [o.fit for o in orders.values()], [o.held_out_fit for o in orders.values()]))
        whose = f', {name}' if len(names) > 1 else ''
        curves += [Curve(x, own, f'own{whose}', i + 1, 'both'),
                   Curve(x, held, f'held out{whose}', i + 1 + apart, 'dashed')]
    known = np.concatenate([c.y[np.isfinite(c.y)] for c in curves] or [np.empty(0)])
    low = float(np.clip(np.min(known, initial=100.0), 0.0, 100.0))
    room = 0.1 * (100.0 - low) or 1.0
    return Figure(Drawing((Axes(
        curves, 'fit [%]', 'order', marks=[(float(chosen), 'chosen')], x_step=1.0,
        x_limits=(x[0] - 0.5, x[-1] + 0.5), y_limits=(max(low - room, -5.0), 100.0 + 0.3 * room),
        height=190.0),), wide=True, picks=True))


def order_series(orders: Mapping[int, Order], chosen: int) -> dict[str, Any] | None:
    """Return what a click on an order shows; None if none were tried."""
    return series([Item(f'Order {n}' + ' (chosen)' * (n == chosen), float(n), o.estimate,
                        facts(o.estimate, {})) for n, o in orders.items()]) if orders else None


def as_csv(found: Sequence[Contender], kind: str) -> str:
    """Return a row for each as CSV, at full precision."""
    names = next((c.model.output_names for c in found if c.model), ())
    shown = [spreadsheet(name or f'y{i}') for i, name in enumerate(names, 1)]
    stream = io.StringIO(newline='')
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow([kind, 'verdict', 'status', 'order', *(f'fit_{y} [%]' for y in shown),
                     *(f'held_out_fit_{y} [%]' for y in shown),
                     *(f'fit_on_these_data_{y} [%]' for y in shown), 'agrees',
                     'difference [%]', 'difference_std [%]', 'largest [%]', 'largest / std',
                     'time [s]'])
    for c in found:
        seen = np.empty(0) if c.simulated is None else c.simulated
        a = c.agreement
        fits = [v for row in (c.estimate.fit, c.estimate.held_out_fit, seen)
                for v in _padded(row, len(shown))]
        apart = [100.0 * a.difference, 100.0 * a.difference_std, 100.0 * a.relative,
                 a.deviations] if a else [math.nan] * 4
        writer.writerow([spreadsheet(c.name), c.estimate.verdict.grade.name,
                         c.estimate.status.name, c.model.n if c.model else '', *_exact(fits),
                         _differs(a)[0].strip('-'), *_exact([*apart, c.seconds])])
    return stream.getvalue()


def _exact(values: Sequence[float]) -> list[str]:
    return ['' if math.isnan(v) else repr(float(v)) for v in values]


def _padded(values: Array, count: int) -> list[float]:
    return [float(v) for v in values[:count]] + [math.nan] * (count - len(values))


def document(c: Contender) -> dict[str, object]:
    """Return one of them for JSON."""
    a = c.agreement
    return {'status': c.estimate.status.name,
            'verdict': c.estimate.verdict.grade.name, 'reason': c.estimate.verdict.reason,
            'order': c.model.n if c.model else None,
            'poles': list(c.model.poles) if c.model else [], 'pole_std': c.estimate.pole_std,
            'delay': c.model.delay if c.model else [],
            'fit': c.estimate.fit, 'held_out_fit': c.estimate.held_out_fit,
            **({} if c.simulated is None else {
                'fit_on_these_data': c.simulated, 'predicted_fit': c.ahead}),
            'agrees': None if a is None or a.answer == UNKNOWN else a.agrees,
            'agreement': a.words if a else '',
            **({'difference': a.difference, 'difference_std': a.difference_std,
                'differs': a.relative, 'deviations': a.deviations} if a else
               dict.fromkeys(('difference', 'difference_std', 'differs', 'deviations'),
                             0.0 if c.model else math.nan)),
            'input': a.input if a else '', 'frequency': a.frequency if a else math.nan}
