# SPDX-License-Identifier: Apache-2.0
"""The sections of a report: the same words on the terminal, in report.md and in report.html."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
import math
from typing import TYPE_CHECKING

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.estimate import Choice, Estimate, Status
from ctsid_core.model.gains import gains, grows
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import ResidualTests
from ctsid_core.model.verdict import Grade
from ctsid_core.search.own_past import AHEAD, HORIZONS
from ctsid_core.signals.actuators import in_words
from ctsid_ros.report.document import GLOSSARY, Bullets, Section
from ctsid_ros.report.responses import frequencies, response_of, response_std
from ctsid_ros.report.tables import (
    Table,
    fit_words,
    gain_text,
    join,
    label,
    number,
    percent,
    plus_minus,
    pole_text,
    thinned,
)
from ctsid_ros.report.tracks import Mode, match, modes, modes_of

if TYPE_CHECKING:
    from ctsid_ros.config.channels import Channel
    from ctsid_ros.recordings.playback import Played
    from ctsid_ros.replay.replay import Result

_MOST_ROWS = 40  # of the table of windows
_MOST_MODES = 4  # in a row of it
_NEAR_TRUTH = 3.0  # standard deviations
_DISTURBED = (
    'Something that is not among the inputs moves the output for longer than the plant remembers: '
    'wind or a load; an input that was left out; or, where a controller holds the plant, its set '
    'point, of which the input is what the controller makes. The model says how the inputs act; '
    'poles that the inputs hardly move may be those of the disturbance. If something that moved '
    'the plant was recorded, add it to `inputs`.')


def record_section(estimate: Estimate, records: Sequence[tuple[str, float, float]]) -> Section:
    """
    Return the records that were identified together: bag, from and to [s], and how they fit.

    Parameters
    ----------
    estimate : Estimate
    records : sequence of (str, float, float)
        Of each record: its bag, and start and end after the start of the bag [s].
    """
    shares, rows = {r.number: r for r in estimate.records}, []
    for index, (bag, start, end) in enumerate(records, 1):
        own = shares.get(index)
        rows.append((str(index), bag, f'{start:.1f}', f'{end:.1f}',
                     fit_words(own.fit) if own else '-',
                     number(1.0 / own.weight, 2) if own else 'left out'))
    head = ('record', 'bag', 'from [s]', 'to [s]', 'fit [%]', 'noise')
    words = [] if not shares else [
        'One plant; each record has its own constant offsets (trim) and initial state. Those of '
        'the model are of the record that ends last. Noise: its amplitude over the mean of all '
        'records.']
    return Section('Records', (*words, Table(head, tuple(rows), ('bag',))))


def channel_section(played: Played, title: str = 'Signals', *, brief: bool = True,
                    delays: Mapping[str, str] | None = None) -> Section:
    """Return which signals were used, where their stamps came from, and their dead times."""
    rows, known = [], delays or {}
    for c in played.config.channels:
        counts = played.counts.channels[c.name]
        rows.append((c.role, label(c.name, c.unit), c.topic, c.field, c.hold,
                     known.get(c.name, _delay(c)) if c.role == 'input' else '',
                     counts.source, str(played.samples(c))))
    head = ('role', 'signal', 'topic', 'field', 'hold', 'delay [s]', 'stamps', 'samples')
    messages = {c.name for c in played.config.channels if not c.type.startswith('table/')}
    why = [f'`{name}`: stamps from {counts.source}, for {counts.why}.'
           for name, counts in played.counts.channels.items()
           if counts.why.endswith('no header') and name in messages]
    return Section(title, (Table(head, tuple(rows), head[:5] + head[6:7]),
                           *([Bullets(tuple(why))] if why else [])), brief=brief)


def complaint_section(notes: Sequence[str]) -> Section:
    """Return what is wrong with the data."""
    unique = tuple(dict.fromkeys(notes))
    return Section('Notes on the data', (Bullets(unique),) if unique else ())


def choice_section(estimate: Estimate, *, brief: bool = False) -> Section:
    """Return what was chosen from the data, and why."""
    lines = tuple(f'`{c.name}` = {_value(c.value)}{_deviation(c)}: {c.why}'
                  for c in estimate.choices)
    domain = next((c.value for c in estimate.choices if c.name == 'domain'), '')
    words = (_predicted(estimate),) if domain == 'predictions' else \
        (_DISTURBED,) if domain == 'disturbed' else ()
    return Section('Chosen from the data', (Bullets(lines), *words) if lines else (), brief=brief)


def _deviation(choice: Choice) -> str:
    return f' ± {number(choice.deviation, 2)}' if math.isfinite(choice.deviation) else ''


def _predicted(estimate: Estimate) -> str:
    """Say what it means that a model is judged by its predictions."""
    model, known = estimate.model or estimate.rejected_model, estimate.covariance
    why = 'the inputs alone explain too little of the motion'
    if model and grows(model, known):
        why = 'its plant grows by itself and cannot be simulated for long'
    elif model and (found := gains(model, known)) and found.rate.any():
        why = f'its plant integrates, so that what disturbs it stays in the output, and {why}'
    return ('The fits of this model are of predictions, which know the outputs before as well as '
            f'the inputs: {why}.')


def _value(value: object) -> str:
    return number(value) if isinstance(value, float) else str(value)


def mode_table(found: Sequence[Mode]) -> Table:
    """Return poles with standard deviation, natural frequency, damping and time constant."""
    rows = tuple((pole_text(m.pole), number(m.std, 2), plus_minus(m.frequency, m.frequency_std),
                  number(m.frequency / (2 * math.pi), 3), plus_minus(m.damping, m.damping_std, 3),
                  number(1 / abs(m.pole.real), 3) if m.pole.real else '-')
                 for m in found)
    return Table(('pole [rad/s]', 'std', 'natural freq. [rad/s]', '[Hz]', 'damping',
                  'time constant [s]'), rows)


def model_section(estimate: Estimate, title: str, *, verdict: bool = True) -> Section:
    """Return a model, accepted or rejected: its verdict if not yet told, poles and fits."""
    model = estimate.model or estimate.rejected_model
    parts: list[str | Table | Bullets] = [verdict_text(estimate)] if verdict else []
    if estimate.verdict.agreement is not None:
        parts.append(f'Cross-check: {estimate.verdict.agreement.words}')
    if model is None:
        return Section(title, tuple(parts))
    if not estimate.ok:
        parts.append(f'REJECTED ({estimate.status.name}): the model is shown to look at only, not '
                     'to be used:')
    words = f'{model.n} state{"s" if model.n > 1 else ""}, {"with" if model.D.any() else "no"} ' \
            'direct feedthrough'
    if any(model.delay):
        words += f', dead time {_dead_times(estimate, model)} s'
    words = '; '.join((words, *in_words(model.input_names, model.actuators, model.input_units)))
    return Section(title, (*parts, f'{words}. {GLOSSARY}', mode_table(modes_of(estimate)),
                           *verdict_tables(estimate, model), fit_table(estimate, model)))


def verdict_text(estimate: Estimate) -> str:
    """Return the verdict in words."""
    return f'{estimate.verdict.grade.name}. {estimate.verdict.reason}'


def verdict_tables(estimate: Estimate, model: StateSpace) -> list[Table]:
    """Return the numbers behind the verdict."""
    verdict = estimate.verdict
    inputs = tuple((x.name, number(x.low, 3), number(x.high, 3), number(x.frequencies, 2),
                    percent(100 * x.own), number(100 * x.uncertainty, 2))
                   for x in verdict.excitation)
    columns = {'error not white [%]': 100 * verdict.coloured_error,
               'independent [%]': 100 * verdict.independent, 'not linear [%]': verdict.curve_gain}
    if np.isfinite(verdict.fresh_ratio).any():
        columns['error on new over old data'] = verdict.fresh_ratio
    if np.isfinite(verdict.apart).any():
        columns['models apart [%]'] = 100 * verdict.apart
    outputs = tuple((name, *(number(v[i], 2) if i < len(v) else '-' for v in columns.values()))
                    for i, name in enumerate(model.output_names))
    tables = [Table(('input', 'excited from [rad/s]', 'to [rad/s]', 'effective frequencies',
                     'uncorrelated [%]', 'response std [%]'), inputs, ('input',))]
    tables.append(Table(('output', *columns), outputs, ('output',)))
    return tables if inputs else []


def _delay(channel: Channel) -> str:
    return channel.delay if isinstance(channel.delay, str) else number(channel.delay, 3)


def _dead_times(estimate: Estimate, model: StateSpace) -> str:
    std = estimate.delay_std if len(estimate.delay_std) == model.nu else np.zeros(model.nu)
    return ', '.join(plus_minus(d, s, 3) for d, s in zip(model.delay, std, strict=True))


def fit_table(estimate: Estimate, model: StateSpace, **more: Array) -> Table:
    """Return the fits of each output [%]; `more` columns by name."""
    own, held_out = (f' {HORIZONS[AHEAD]} ahead', ' 1 ahead') \
        if estimate.by_predictions else ('', '')
    columns = {f'fit{own} [%]': estimate.fit, f'held-out fit{held_out} [%]': estimate.held_out_fit}
    columns |= {name.replace('_', ' ') + ' [%]': values for name, values in more.items()}
    rows = tuple((name, *(percent(v[i]) if i < len(v) else '-' for v in columns.values()))
                 for i, name in enumerate(model.output_names))
    return Table(('output', *columns), rows, ('output',))


def gain_section(model: StateSpace, covariance: Covariance | None = None) -> Section:
    """Return the gains, where they mean something, with their standard deviations."""
    found = gains(model, covariance)
    if found is None:
        return Section('', ())
    rows = tuple((label(y, model.output_units[i]),
                  *(gain_text(found.value[i, j], found.std[i, j], bool(found.rate[i, j]))
                    for j in range(model.nu)))
                 for i, y in enumerate(model.output_names))
    table = Table(('output', *(label(u, model.input_units[j])
                               for j, u in enumerate(model.input_names))), rows, ('output',))
    if found.rate.any():
        return Section('Gain: output per input', (
            table, 'A pole cannot be told from 0: the plant integrates, or is too slow for these '
            'data to tell. A gain with /s says by how much the output moves in each second, for '
            'each unit of a constant input.'
            + ('' if found.rate.all() else ' Any other is without that pole.')))
    unknown = ('Where the standard deviation is larger than the gain, not even its sign is known: '
               'the data are too short for what happens slowly, or the inputs do not move slowly '
               'enough.',) if found.vague else ()
    return Section('DC gain: output per input', (table, *unknown))


def bode_section(model: StateSpace, points: int = 13, covariance: Covariance | None = None,
                 band: tuple[float, float] | None = None) -> Section:
    """Return the frequency response as a table, with its standard deviations."""
    omega = frequencies(model, band, points)
    std = response_std(model, omega, covariance)
    columns: dict[str, list[str]] = {}
    for i, y in enumerate(model.output_names):
        for j, u in enumerate(model.input_names):
            gain, phase = response_of(model, omega, i, j)
            columns[f'{u} → {y} [dB]'] = _with_std(gain, std[0][:, i, j])
            columns[f'[deg]{" " * len(columns)}'] = _with_std(phase, std[1][:, i, j])
    head = ('frequency [rad/s]', '[Hz]', *columns)
    rows = tuple((number(w), number(w / (2 * math.pi), 3),
                  *(v[k] for v in columns.values())) for k, w in enumerate(omega))
    return Section('Frequency response in numbers', (Table(head, rows),), folded=True)


def _with_std(values: Array, std: Array) -> list[str]:
    """Return values with one decimal, and their deviations with two digits."""
    return ['-' if not math.isfinite(v) else f'{v:.1f}' if math.isnan(s) else
            f'{v:.{_decimals(s)}f} ± {number(s, 2)}' for v, s in zip(values, std, strict=True)]


def _decimals(std: float) -> int:
    """Return how many decimals belong beside a deviation of two digits."""
    return min(max(1 - math.floor(math.log10(std)), 1), 4) if 0 < std < math.inf else 1


def residual_section(tests: ResidualTests, model: StateSpace, *, predicted: bool = False
                     ) -> Section:
    """
    Return the residual tests: p-values of whiteness, and of independence of the inputs.

    Parameters
    ----------
    tests : ResidualTests
    model : StateSpace
    predicted : bool
        Whether the residuals are those of predictions one sample ahead.
    """
    which, why = ('output predicted one sample ahead', 'the model of the noise is not complete') \
        if predicted else ('simulated output', 'with gusts and other process noise this is normal')
    rows = tuple((y, number(tests.whiteness[i], 2),
                  *(number(v, 2) for v in tests.independence[i]))
                 for i, y in enumerate(model.output_names))
    head = ('output', 'residual whiteness p-value',
            *(f'independence of {u}, p-value' for u in model.input_names))
    return Section('Residual tests', (
        'These tests are not judged: with enough samples every real plant fails the first. The '
        f'residuals are the measured minus the {which}. A p-value below 0.01 means '
        f'that they are not white ({why}), or that '
        'they depend on past values of an input (then dynamics from that input are not '
        'modelled, or a controller closes a loop).',
        Table(head, rows, ('output',))), brief=False)


def window_section(results: Sequence[Result], start_ns: int, best: int = 0,
                   sides: Sequence[str] = ()) -> Section:
    """Return the windows along a bag, thinned where they are many; `sides` of changes of each."""
    rows = [_window_row(index, r, start_ns) for index, r in enumerate(results, 1)]
    head = ['window', 'from [s]', 'to [s]', 'verdict', 'order', 'fit [%]', 'next fit [%]',
            'poles of the model [rad/s]']
    if any(sides):
        head.append('plant')
        rows = [(*row, side) for row, side in zip(rows, sides, strict=True)]
    shown = thinned(rows, _MOST_ROWS, best)
    more = [f'{len(shown)} of {len(rows)} windows are shown; all are in `estimates.csv`.'] \
        if len(shown) < len(rows) else []
    return Section('Models along the bag, in numbers',
                   (Table(tuple(head), shown, (head[3], *head[7:])), *more),
                   folded=True)


def _window_row(index: int, result: Result, start_ns: int) -> tuple[str, ...]:
    estimate = result.estimate
    span = (f'{(t - start_ns) * 1e-9:.1f}' for t in (estimate.start_ns, estimate.end_ns))
    found = modes_of(estimate) if estimate.model else []
    poles = ',  '.join(pole_text(m.pole, 3) for m in found[:_MOST_MODES]) if estimate.model \
        else f'none: {estimate.status.name}'
    poles += f',  {len(found) - _MOST_MODES} more' if len(found) > _MOST_MODES else ''
    order = str(estimate.model.n) if estimate.model else '-'
    return (str(index), *span, estimate.verdict.grade.name, order, fit_words(estimate.fit),
            fit_words(result.next_fit), poles)


def status_section(results: Sequence[Result]) -> Section:
    """Return how many windows gave no model, and why."""
    bad = [r.estimate.status for r in results if not r.estimate.ok]
    lines = [f'{bad.count(s)} of {len(results)} windows gave no model ({s.name}). {s.value}'
             for s in Status if s in bad]
    weak = [r.estimate.verdict for r in results if r.estimate.verdict.grade is Grade.WEAK]
    for remedy, count in Counter(v.remedy for v in weak).most_common():
        last = [v.reason for v in weak if v.remedy is remedy][-1]
        lines.append(f'{count} of {len(results)} windows gave a WEAK model, such as: {last}')
    return Section('Windows without a GOOD model', (Bullets(tuple(lines)),) if lines else ())


def truth_section(estimate: Estimate, results: Sequence[Result], truth: StateSpace) -> Section:
    """Return the identified poles beside the true ones, and a closing sentence."""
    found, true = modes_of(estimate), modes(truth)
    pairs = match([m.pole for m in true], [m.pole for m in found])
    every = _nearest_of_all(true, results)
    rows = []
    for i, m in enumerate(true):
        own = found[pairs[i]] if i in pairs else None
        rows.append((pole_text(m.pole), *_beside(m, own),
                     *([pole_text(every[i]) if i in every else '-'] if results else [])))
    head = ('true pole', 'identified', 'std', 'difference', 'difference / std',
            *([f'median of {len(results)} windows'] if results else []))
    extra = [m for j, m in enumerate(found) if j not in pairs.values()]
    verdict = _verdict([(m, found[pairs[i]]) for i, m in enumerate(true) if i in pairs], len(true))
    return Section('Identified beside true poles [rad/s]',
                   (Table(head, tuple(rows)), *_extra_words(extra), verdict))


def _beside(true: Mode, own: Mode | None) -> tuple[str, str, str, str]:
    if own is None:
        return ('-',) * 4
    away = abs(own.pole - true.pole)
    return pole_text(own.pole), number(own.std, 2), number(away, 2), number(away / own.std, 2) \
        if own.std > 0 else '-'


def _nearest_of_all(true: Sequence[Mode], results: Sequence[Result]) -> dict[int, complex]:
    """Return the median over all windows of the poles that match each true one."""
    gathered: dict[int, list[complex]] = {}
    for result in results:
        found = modes(result.estimate.model)
        for i, j in match([m.pole for m in true], [m.pole for m in found]).items():
            gathered.setdefault(i, []).append(found[j].pole)
    return {i: complex(np.median(np.real(p)), np.median(np.imag(p)))
            for i, p in gathered.items()}


def _extra_words(extra: Sequence[Mode]) -> list[str]:
    if not extra:
        return []
    listed = join([f'{pole_text(m.pole, 3)} (std {number(m.std, 2)})' for m in extra])
    return [f'The model has more poles than the truth: {listed}.']


def _verdict(pairs: Sequence[tuple[Mode, Mode]], count: int) -> str:
    known = [abs(own.pole - true.pole) / own.std for true, own in pairs if own.std > 0]
    if len(pairs) < count or len(known) < count:
        return f'{len(pairs)} of {count} true poles or pairs have a counterpart in the model.'
    worst = max(known, default=0.0)
    if worst <= _NEAR_TRUTH:
        return (f'All {count} true poles and pairs are identified; the largest error is '
                f'{worst:.1f} standard deviations, which noise explains.')
    return (f'{sum(k <= _NEAR_TRUTH for k in known)} of {count} true poles and pairs are '
            f'identified within {_NEAR_TRUTH:g} standard deviations; the largest error is '
            f'{worst:.1f}.')


def remark_section(estimate: Estimate, test_fit: Array, *, delay_sought: bool = False) -> Section:
    """Return what else is worth knowing of a model; what to try next, its verdict says alone."""
    lines = tuple(_remarks(estimate, test_fit, delay_sought))
    return Section('Remarks on the model', (Bullets(lines),) if lines else (), brief=False)


def _remarks(estimate: Estimate, test_fit: Array, delay_sought: bool) -> Iterator[str]:
    model, settings = estimate.model or estimate.rejected_model, estimate.settings
    if model is None:
        return
    unseen = test_fit if np.isfinite(test_fit).any() else estimate.held_out_fit
    if np.isfinite(unseen).any() and np.nanmax(estimate.fit - unseen) > 15.0:
        yield 'The fit is far better on the data of the model than on unseen data.'
    if model.n == settings.max_order:
        yield (f'The order is the largest that `max_order` allows ({settings.max_order}): larger '
               'ones were not tried.')
    if (model.poles.real > 0).any():
        yield 'The model is unstable: right for a plant that a controller holds upright.'
    if not any(model.delay) and model.n > 1 and not delay_sought:
        yield ('The model has no dead time, and none was looked for (`delay` of the input): extra '
               'states imitate one.')
