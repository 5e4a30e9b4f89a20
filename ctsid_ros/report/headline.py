# SPDX-License-Identifier: Apache-2.0
"""What a report says first: the verdict, the command to try next, the numbers that matter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
import re
import shlex

from ctsid_core.model.estimate import Estimate
from ctsid_core.model.verdict import Remedy
from ctsid_core.search.own_past import AHEAD, HORIZONS
from ctsid_ros.replay.results import MODEL
from ctsid_ros.report.document import Command, Headline, Section
from ctsid_ros.report.tables import Table, fit_words, number

_CHANNELS = ('guessed', 'of the model')


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
    interval : tuple of str
        The arguments that choose the span, from the first record to the last; empty if it is all
        of the bag.
    chosen : tuple of str
        Those of `ctsid identify` that choose the records, which may have pauses between them.
    records : tuple of Run
        The same of each of several records by itself.
    changes : tuple of str
        Parameters with other values than in the file, `name=value`.
    """

    line: str
    bags: tuple[str, ...]
    params: str | None
    model: str = ''
    span: tuple[float, float] = (0.0, math.inf)
    interval: tuple[str, ...] = ()
    chosen: tuple[str, ...] = ()
    records: tuple[Run, ...] = ()
    changes: tuple[str, ...] = ()

    def command(self, verb: str, *more: str) -> str:
        """Return a command line on the same data."""
        params = ('--params', self.params) if self.params else ()
        changes = (word for change in self.changes for word in ('--set', change))
        return shlex.join(('ctsid', verb, *self.bags, *params, *changes, *more))


@dataclass(frozen=True)
class Better:
    """
    Pairs of signals of which a recording says more than of those that gave no model.

    Parameters
    ----------
    pairs : tuple of str
        In words.
    kept : tuple of str
        The arguments of `ctsid init` that keep the signal that all of them share with those that
        were chosen; empty if they share none.
    """

    pairs: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()


def headline(estimate: Estimate, run: Run, facts: Sequence[tuple[str, str]] = (),
             better: Better = Better()) -> Headline:
    """
    Return the verdict of an estimate, and what to try next.

    Parameters
    ----------
    estimate : Estimate
    run : Run
    facts : sequence of (str, str)
        Numbers to show beside its own.
    better : Better
        The way out where signals are at fault.
    """
    model = estimate.model      # beside a REJECT the figures of a model would look like a success
    ahead = (f', predicted {HORIZONS[AHEAD]} samples ahead', ', 1 sample ahead') \
        if estimate.by_predictions else ('', '')
    own = [] if model is None else [
        (f'fit of {", ".join(model.output_names)}{ahead[0]} [%]', fit_words(estimate.fit)),
        (f'held-out fit{ahead[1]} [%]', fit_words(estimate.held_out_fit)),
        ('order', str(model.n))]
    purpose, command = other_signals(run, better) \
        if better.pairs and estimate.verdict.remedy is Remedy.SIGNALS else _next(estimate, run)
    return Headline(estimate.verdict.grade.name, estimate.verdict.reason, command,
                    (*own, *_band(estimate), *facts), purpose)


def other_signals(run: Run, better: Better) -> tuple[str, str]:
    """Return that a recording says more of other signals, and the command that takes them."""
    first = '' if better.kept else 'nothing in the recording says more about these: move the ' \
        'inputs more, and record again. '
    what = 'the data say' if better.kept else 'The data say'
    return (f'{first}{what} more about other signals: {"; ".join(better.pairs)}; they are shown, '
            'and the first is written, by',
            shlex.join(('ctsid', 'init', *run.bags, '-o', 'other.yaml', *better.kept)))


def _band(estimate: Estimate) -> list[tuple[str, str]]:
    """Return the frequencies at which the inputs of an accepted model moved."""
    bands = estimate.verdict.excitation if estimate.ok else ()
    return [('excited [Hz]' if len(bands) == 1 else f'excited by {band.name} [Hz]',
             _hertz(band.low, band.high)) for band in bands if band.high >= band.low]


def _hertz(low: float, high: float) -> str:
    ends = [number(w / math.tau, 2) for w in (low, high)]
    return f'only {ends[0]}' if low == high else ' to '.join(ends)


def _next(estimate: Estimate, run: Run) -> tuple[str, str]:
    """Return what to try next, as the reason of the verdict says: what for, and the command."""
    again = run.command('identify', *run.chosen)
    info = shlex.join(('ctsid', 'info', *run.bags))
    match estimate.verdict.remedy:
        case Remedy.TEST:
            if run.model:
                return ('how well it explains a recording that it has not seen, before it is used',
                        f'ctsid simulate {shlex.quote(run.model)} ANOTHER_BAG')
            return 'the model in a file, with a report', again
        case Remedy.EXCITE:
            return ('how much more to move which input, and how fast',
                    run.command('advise', *run.interval))
        case Remedy.LONGER:
            if run.interval:
                return 'all of the recording', run.command('identify')
            return 'how much longer the data have to be', run.command('advise')
        case Remedy.SETTING:
            return _set(estimate.verdict.reason, run)
        case Remedy.RECORD:
            return _recorded(estimate.verdict.reason, run)
        case Remedy.COMPARE:
            return ('what each method makes of the same data',
                    run.command('compare', *run.interval))
        case Remedy.SPLIT:
            return _split(estimate, run)
        case Remedy.WAIT:
            return ('a model of this window and all after it', run.command(
                'identify', '--start', f'{run.span[0]:z.1f}'))
        case Remedy.PART:
            return 'models of short windows: in which parts one is right', run.command('replay')
        case Remedy.SIGNALS:
            return 'which signals are in the recording, at which rates, and when they move', info


def _set(reason: str, run: Run) -> tuple[str, str]:
    """Return how to change a setting: the one that the reason ends with, if it names a value."""
    if not run.params:
        return ('parameters in which to change that, for `ctsid identify ... --params '
                'params.yaml`', shlex.join(('ctsid', 'init', *run.bags, '-o', 'params.yaml')))
    if not (told := re.search(r'set `([^`:]+): ([^`]+)`\.$', reason)):
        return (f'the same once more, with that changed in {run.params}, or by `--set NAME=VALUE`',
                run.command('identify', *run.chosen))
    name, value = told.groups()
    changes = (*(c for c in run.changes if c.partition('=')[0] != name), f'{name}={value}')
    return ('the same once more, with that changed',
            replace(run, changes=changes).command('identify', *run.chosen))


def _recorded(reason: str, run: Run) -> tuple[str, str]:
    """Return how to come to samples without a fault, by the option that its sentence names."""
    if '`stamp' in reason:
        return _set('', run)
    if '`--time' in reason:
        return ('the same, rows at a constant rate (yours in place of 10 Hz)',
                run.command('identify', *run.chosen, '--time', '10Hz'))
    if '`--use-sim-time`' in reason:
        return ('another recording, by the clock of the simulation',
                'ros2 bag record -a --use-sim-time -o ANOTHER_BAG')
    return 'another recording, without that', 'ros2 bag record -a -o ANOTHER_BAG'


def _split(estimate: Estimate, run: Run) -> tuple[str, str]:
    found = estimate.statistics
    returns = 'drift_from' in found
    if number := int(found.get('drift_record' if returns else 'change_record', 0)):
        run = run.records[number - 1]
    start, end = run.span
    if returns:
        begin, back = (start + found[key] * (end - start) for key in ('drift_from', 'drift_to'))
        return ('the same without the time in which gains are others', run.command(
            'identify', '--interval', f'{start:z.1f}:{begin:.1f}',
            '--interval', f'{back:.1f}:{end:.1f}'))
    share = found.get('change_share', math.nan)
    if not math.isfinite(share):
        return 'models of short windows, before and after', run.command('replay')
    if not share:
        return ('the plant of this record; leave it out of the others',
                run.command('identify', *run.interval))
    at = start + share * (end - start)
    return (f'the plant before the change (after it: `--start {at:.1f}` alone)', run.command(
        'identify', '--start', f'{start:z.1f}', '--duration', f'{at - start:.1f}'))


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
