# SPDX-License-Identifier: Apache-2.0
"""The drawn sections of one model: what it does beside the data, and how well it is known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import Validation, prediction
from ctsid_core.search.held_out import as_judged
from ctsid_core.search.own_past import AHEAD, HORIZONS
from ctsid_core.settings import Settings
from ctsid_core.signals.actuators import as_acting
from ctsid_core.signals.record import Record
from ctsid_core.signals.samples import GroupCounts
from ctsid_ros.ingest.counts import IngestCounts
from ctsid_ros.replay.along import change_of
from ctsid_ros.report.document import Figure, Gallery, Section
from ctsid_ros.report.outputs import Part, output_figures, raw_figures, sampling_figures
from ctsid_ros.report.poles import pole_figure
from ctsid_ros.report.residual_figures import horizon_figure, horizon_fits, residual_figures
from ctsid_ros.report.responses import Bands, bode_figures, step_figures
from ctsid_ros.report.spectra import spectra, supported_band
from ctsid_ros.report.tables import Table

_COLUMNS = 3
Models = Mapping[str, tuple[StateSpace, Covariance | None]]


@dataclass(frozen=True)
class Shown:
    """
    A record on which a model is shown.

    Parameters
    ----------
    record : Record
        All of it.
    model : StateSpace
        At the trim of this record.
    parts : sequence of Part
    offset : float
        Of its times, after the start of the bag [s].
    which : str
        Words that tell it from others: ', record 2'; or empty.
    """

    record: Record
    model: StateSpace
    parts: Sequence[Part]
    offset: float
    which: str = ''


def output_section(shown: Shown, settings: Settings, estimate: Estimate | None = None) -> Section:
    """Return measured beside simulated outputs; a change of the plant is marked."""
    marks: list[tuple[float, str]] = []
    words: list[str] = []
    if estimate is not None and not shown.which:
        marks, words = _changed(shown, estimate)
    how = shown.parts[0].how
    if how != 'simulated':
        words.append('Predictions explain these data better than any simulation: the outputs '
                     f'are {how}, from what was measured before, and the fits are theirs '
                     '(the first tenth, not drawn, starts the filter). '
                     'Fit by horizon, below, shows how it simulates.')
    return Section(f'Measured and {how.split()[0]}{shown.which}', (
        *words, Gallery(tuple(output_figures(shown.model, shown.record, shown.parts, shown.offset,
                                             settings, marks)))))


def marked(sections: Iterable[Section], estimate: Estimate) -> list[Section]:
    """Return the drawn sections of a model, those of a rejected one with a title that says so."""
    return [replace(one, title=f'{one.title}: rejected model') if not estimate.ok else one
            for one in sections]


def _changed(shown: Shown, estimate: Estimate) -> tuple[list[tuple[float, str]], list[str]]:
    """Return when the plant changed, and that in words."""
    times = shown.parts[0].found.times
    change = change_of(estimate, float(times[0]), float(times[-1]))
    if change is None:
        return [], []
    return [(change.time, 'change')], [
        f'Marked: {replace(change, time=change.time + shown.offset).words}']


def raw_section(record: Record, offset: float, settings: Settings) -> Section:
    """Return the signals of a record without a model."""
    return Section('Signals', (Gallery(tuple(raw_figures(record, offset, settings))),))


def response_sections(models: Models, shown: Shown | None = None,
                      estimate: Estimate | None = None,
                      truth: StateSpace | None = None) -> Iterator[Section]:
    """Yield Bode diagrams, with spectra where there is a record, step responses, and poles."""
    first = next(iter(models.values()))[0]
    bands, words = _bands(first, shown, estimate)
    seen = None if shown is None else spectra(as_acting(shown.record, shown.model.actuators))
    if seen is not None:
        words += ['Dots: the response as spectra of inputs and outputs give it, without a model, '
                  'where the coherence is above 0.3; in a closed loop it is biased. Coherence: '
                  'the share of the power of the output that is of this input.']
    if any(c is not None for _, c in models.values()):
        words += ['The bands around the curves are two standard deviations.']
    columns = min(first.nu, _COLUMNS) if first.ny * first.nu > 1 else 1
    yield Section('Frequency response', (' '.join(words), Gallery(
        tuple(bode_figures(models, bands, seen, truth)), columns)))
    steps = step_figures(models, truth, bands)
    poles = pole_figure(models, truth)
    if len(steps) == 1:
        yield Section('Step response and poles', (Gallery((
            Figure(steps[0].drawing, 'Response to a unit step of the input, from the operating '
                   'point (trim); band: two standard deviations.', steps[0].title), poles), 2),))
        return
    yield Section('Step responses', (
        'Response to a unit step of each input, from the operating point (trim); bands: two '
        'standard deviations.', Gallery(tuple(steps), columns)))
    yield Section('Poles', (Gallery((poles,)),))


def _bands(model: StateSpace, shown: Shown | None, estimate: Estimate | None
           ) -> tuple[Bands, list[str]]:
    excitation = estimate.verdict.excitation if estimate is not None else ()
    if len(excitation) == model.nu:
        return [(x.low, x.high) if x.high > x.low else None for x in excitation], [
            'Shaded: the excited band of each input, as in the table of the verdict. Beyond it '
            'the model extrapolates.']
    band = supported_band(shown.parts[0].found) if shown is not None else None
    return [band] * model.nu, [
        'Shaded: the frequencies at which the model explains more than half of the power of an '
        'output. Beyond them it extrapolates.'] if band else []


def residual_sections(shown: Shown, found: Validation, simulated: Array,
                      fits: Mapping[float, Array] | None = None) -> Iterator[Section]:
    """
    Yield fits by horizon and what correlations tell of the residuals.

    Those of a model that is shown by its predictions are the errors of predictions one sample
    ahead, as in its residual tests: at longer horizons neighbouring errors are never independent.

    Parameters
    ----------
    shown : Shown
    found : Validation
        The simulation, whose residuals are tested unless the model is shown by predictions.
    simulated : ndarray, shape (ny,)
        Its fit, as reported [%].
    fits : mapping, optional
        Fits of predictions by horizon [s]; computed if not given.
    """
    fits = horizon_fits(shown.model, shown.record) if fits is None else fits
    ahead = shown.parts[-1].how != 'simulated'
    errors = prediction(shown.model, shown.record, 1) if ahead else found
    figures = residual_figures(shown.model, shown.record, errors)
    level = found.fit if ahead else simulated
    which = 'outputs predicted one sample ahead' if ahead else \
        'simulated outputs, with their constant offsets refitted'
    own = [horizon_figure(shown.model, fits, level)] if fits else []
    if own or figures:
        title = 'Residuals of predictions' if ahead else 'Residuals'
        yield Section(f'{title}{shown.which}', (
            f'Residuals: measured less {which}. Dashed: what '
            '99 % of chance correlations do not exceed. Correlation with an input at positive '
            'lags (shaded) is dynamics that the model lacks; at negative ones, a closed loop.',
            Gallery((*own, *figures), 3)))


def sampling_section(record: Record, offset: float, counts: IngestCounts) -> Section:
    """Return the intervals between the samples of each signal, and which were dropped."""
    figures = tuple(sampling_figures(record, offset))
    kinds = [f.name for f in fields(GroupCounts) if f.type in ('int', int)]
    rows = tuple((name, *(str(getattr(channel.samples, kind)) for kind in kinds))
                 for name, channel in counts.channels.items())
    table = Table(('channel', *(kind.replace('_', ' ') for kind in kinds)), rows, ('channel',))
    return Section('Sampling', (
        *([Gallery(figures, min(len(figures), _COLUMNS))] if figures else []),
        'Samples that were used, and those that were dropped, by the reason:', table))


def simulated(model: StateSpace, record: Record, what: str, estimate: Estimate,
              fit: Array | None = None) -> Part:
    """
    Return data with what a model makes of them, in the way in which its fits are meant.

    Parameters
    ----------
    model : StateSpace
    record : Record
    what : str
        Which data these are.
    estimate : Estimate
        That the model is of: one that was found by its predictions is drawn so.
    fit : ndarray, optional
        The fits that the report has for these data [%].
    """
    found = as_judged(estimate, model, record)
    how = f'predicted {HORIZONS[AHEAD]} samples ahead' if estimate.by_predictions else 'simulated'
    known = fit is not None and len(fit) == model.ny and bool(np.isfinite(fit).any())
    return Part(f'{what}, {how}', found, fit if known and fit is not None else found.fit, how)
