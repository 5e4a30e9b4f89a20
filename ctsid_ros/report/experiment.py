# SPDX-License-Identifier: Apache-2.0
"""Which further experiment would help, in tables and words."""

from __future__ import annotations

import math

from ctsid_core.advice.advice import Advice, Band, PoleAdvice
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import Remedy
from ctsid_ros.report.document import Bullets, Section
from ctsid_ros.report.tables import Table, number, pole_text

_FORECAST = ('The model is rejected, and what follows is computed with it: it holds as far as the '
             'model does.')


def experiment_section(advice: Advice, *, brief: bool = True, rejected: bool = False) -> Section:
    """Return what would make the model, accepted or rejected, more accurate, as sentences."""
    words = (_FORECAST,) if rejected and advice.poles else ()
    return Section('Which experiment would help', (*words, Bullets(advice.sentences))
                   if advice.sentences else (), brief=brief)


def helps(estimate: Estimate, advice: Advice) -> bool:
    """Return whether more motion is what a model lacks, by its verdict or as its poles tell."""
    return bool(advice.sentences) and (
        estimate.good or estimate.verdict.remedy in (Remedy.EXCITE, Remedy.LONGER)
        or estimate.status is Status.NO_EXCITATION)


def verdict_section(estimate: Estimate) -> Section:
    """Return that a model is rejected, or weak, and why; nothing if it is good."""
    title = 'WEAK' if estimate.ok else f'REJECTED ({estimate.status.name})'
    return Section('', ()) if estimate.good else Section(title, (estimate.verdict.reason,))


def accuracy_section(advice: Advice) -> Section:
    """Return the standard deviations of the poles, and what it takes to reach the wanted ones."""
    rows = tuple((pole_text(p.pole, 3), number(p.std, 2), number(p.wanted, 2),
                  _times(p.longer), _times(p.larger), *_best(p)) for p in advice.poles)
    head = ('pole [rad/s]', 'std', 'wanted std', 'longer data', 'larger input', 'or excite',
            'for [s]')
    return Section('Accuracy of the poles, now and wanted', (Table(head, rows, head[5:6]),)
                   if rows else ())


def _times(factor: float) -> str:
    return '-' if factor <= 1.0 else 'never' if math.isinf(factor) else f'x {number(factor, 3)}'


def _best(p: PoleAdvice) -> tuple[str, str]:
    if p.std <= p.wanted or math.isinf(p.enough):
        return ('-', '-')
    band = p.bands[0]
    return f'{band.input}, {_hertz(band)} Hz', number(p.lasting, 2)


def _hertz(band: Band) -> str:
    return f'{number(band.low / (2 * math.pi), 2)} to {number(band.high / (2 * math.pi), 2)}'


def _divided(ratio: float) -> str:
    return '-' if ratio >= 1.0 else f'/ {number(1 / ratio, 3)}'


def band_section(advice: Advice) -> Section:
    """Return what further excitation of each input in each band would do to each pole."""
    if not advice.poles:
        return Section('', ())
    first = sorted(advice.poles[0].bands, key=lambda b: (b.input, b.low))
    ratios = [{(b.input, b.low): b.ratio for b in p.bands} for p in advice.poles]
    rows = tuple((b.input, _hertz(b), number(100 * b.share, 2),
                  *(_divided(r[b.input, b.low]) for r in ratios)) for b in first)
    head = ('input', 'band [Hz]', 'share of power now [%]',
            *(pole_text(p.pole, 3) for p in advice.poles))
    return Section(f'Standard deviations after {advice.seconds:g} s more in one band', (
        'With the rms value that the input has now, all of it in this band: std divided by',
        Table(head, rows, head[:1])))
