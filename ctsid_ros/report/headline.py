# SPDX-License-Identifier: Apache-2.0
"""What a report says first: the verdict, the command to try next, the numbers that matter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
import shlex

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import Grade
from ctsid_ros.replay.results import MODEL
from ctsid_ros.report.document import Command, Headline, Section
from ctsid_ros.report.tables import Table, fit_words

_CHANNELS = ('guessed', 'of the model')
_LOOK = (Status.GAPS, Status.NO_EXCITATION, Status.NO_RESPONSE, Status.UNRELIABLE)


@dataclass(frozen=True)
class Run:
    """
    What was run, to repeat it and to go on from it.

    Parameters
    ----------
    line : str
        The command line.
    bags : tuple of str
        As a command line names them, with the times of tables.
    params : str or None
        The parameter file.
    model : str
        The model file that was written; empty if none.
    span : (float, float)
        Of the data, after the start of the bag [s].
    """

    line: str
    bags: tuple[str, ...]
    params: str | None
    model: str = ''
    span: tuple[float, float] = (0.0, math.inf)

    def command(self, verb: str, *more: str) -> str:
        """Return a command line on the same data."""
        params = ('--params', self.params) if self.params else ()
        return shlex.join(('ctsid', verb, *self.bags, *params, *more))


def headline(estimate: Estimate, run: Run, facts: Sequence[tuple[str, str]] = ()) -> Headline:
    """Return the verdict of an estimate, and what to try next."""
    model = estimate.model or estimate.rejected_model
    own = [] if model is None else [
        (f'fit of {", ".join(model.output_names)}{", predicted," * by_predictions(estimate)} [%]',
         fit_words(estimate.fit)),
        ('held-out fit [%]', fit_words(estimate.held_out_fit)), ('order', str(model.n))]
    return Headline(estimate.verdict.grade.name, estimate.verdict.reason, _next(estimate, run),
                    (*own, *facts))


def by_predictions(estimate: Estimate) -> bool:
    """Return whether a model was found by its predictions: then its fits are of these."""
    return any(c.name == 'domain' and c.value == 'predictions' for c in estimate.choices)


def _next(estimate: Estimate, run: Run) -> str:
    status = estimate.status
    if estimate.verdict.grade is Grade.GOOD and run.model:
        return f'ctsid simulate {shlex.quote(run.model)} ANOTHER_BAG'
    if estimate.ok:
        return run.command('advise')
    if status is Status.CHANGED:
        share = estimate.statistics.get('change_share', math.nan)
        start, end = run.span
        at = start + share * (end - start)
        return run.command('identify', '--start', f'{start:.1f}', '--duration',
                           f'{at - start:.1f}') if math.isfinite(at) else run.command('replay')
    if status is Status.TOO_SHORT:
        return run.command('identify')
    if status in _LOOK:
        return shlex.join(('ctsid', 'info', *run.bags))
    return run.command('compare')


def repeat_section(run: Run, origin: Mapping[str, object], kept: str = MODEL) -> Section:
    """Return how to repeat a run: the command, versions, hashes; `kept` is the file of models."""
    import platform

    import numpy
    import scipy

    bags = origin.get('bag')
    rows = (('ctsid', str(origin['ctsid'])), ('Python', platform.python_version()),
            ('NumPy', numpy.__version__), ('SciPy', scipy.__version__), *([
                ('bag', ', '.join(map(str, bags)) if isinstance(bags, list) else str(bags)),
                ('SHA-256 of the bag', str(origin['sha256'] or 'not taken: the bag is large')),
                ('parameter file', run.params or f'none: channels {_CHANNELS[not kept]}')]
                if run.bags else []))
    return Section('How to repeat it', (
        *([Command(run.line)] if run.line else []), Table(('what', 'which'), rows,
                                                          ('what', 'which')),
        *([f'Settings and channels are in `{kept}`, all of them, at full precision.']
          if kept else [])), brief=False)
