# SPDX-License-Identifier: Apache-2.0
"""A running node for a terminal: what it has said so far, as a picture or as lines."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.verdict import Grade
from ctsid_ros.messages.health import Health, Level
from ctsid_ros.report.tables import fit_words, number, percent, pole_text
from ctsid_ros.report.tracks import told
from ctsid_ros.report.words import cell, printable

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table
    from rich.text import Text

INGEST, IDENTIFICATION = 'ingest', 'identification'     # parts of the diagnostics of a node
_STRIP = 60         # windows
_SILENT = 4.0       # s without diagnostics, which come once a second
_BAR = 24           # characters
_LONG_AGO = 1e5     # s: older ones are of another clock
_PAINT = {Grade.GOOD: 'green', Grade.WEAK: 'yellow', Grade.REJECT: 'red'}
_LEVELS = {Level.OK: 'green', Level.WARN: 'yellow', Level.ERROR: 'red', Level.STALE: 'dim'}
_RATE, _MESSAGES = ' rate [1/s]', ' messages'
_KINDS = {'late': 'came too late', 'astray': 'had stamps far from all others',
          'bad_stamp': 'had stamps that cannot be', 'duplicate': 'had the stamp of another',
          'non_finite': 'were not finite', 'wrong_width': 'had another length'}


@dataclass(frozen=True)
class Moved:
    """
    A mode and where it went.

    Parameters
    ----------
    mode : int
        Its number: the same mode has the same one in all windows.
    pole : complex
    std : float
    arrow : str
        Whether its natural frequency went up, down, or stayed within two standard deviations,
        since the window before.
    """

    mode: int
    pole: complex
    std: float
    arrow: str


@dataclass
class Watched:
    """
    What a node has said.

    Parameters
    ----------
    name : str
        Its full name.
    """

    name: str
    heard: float = -math.inf    # when the last diagnostics came [s]
    health: dict[str, Health] = field(default_factory=dict)
    strip: deque[Grade] = field(default_factory=lambda: deque(maxlen=_STRIP))
    estimate: Estimate | None = None
    modes: tuple[Moved, ...] = ()
    fresh_fit: Array = field(default_factory=lambda: np.empty(0))
    window: int = 0
    computing: float = math.nan
    others: set[str] = field(default_factory=set)   # further nodes of the same kind
    _poles: dict[int, tuple[complex, float]] = field(default_factory=dict)

    def diagnostics(self, said: Sequence[Health], now: float) -> None:
        """Take a message of /diagnostics."""
        for health in said:
            name, _, part = health.name.rpartition(': ')
            if part in (INGEST, IDENTIFICATION) and name == self.name:
                self.health[part], self.heard = health, now
            elif part == INGEST:
                self.others.add(name)

    def model(self, estimate: Estimate, metadata: Mapping[str, Any]) -> None:
        """Take a message of ~/model."""
        self.estimate = estimate
        self.strip.append(estimate.verdict.grade)
        self.window = int(metadata.get('window', 0))
        self.computing = float(metadata.get('computing_seconds', math.nan))
        self.fresh_fit = np.asarray(metadata.get('fresh_fit', np.empty(0)))
        found = [(int(mode), complex(pole), float(std)) for mode, pole, std in zip(
            metadata.get('modes', ()), metadata.get('eigenvalues', ()),
            metadata.get('eigenvalue_std', ()), strict=False)]
        self.modes = tuple(Moved(mode, pole, std, self._arrow(mode, pole, std))
                           for mode, pole, std in found)
        if found:
            self._poles = {mode: (pole, std) for mode, pole, std in found}

    def _arrow(self, mode: int, pole: complex, std: float) -> str:
        if mode not in self._poles:
            return 'new'
        before, its = self._poles[mode]
        away = abs(pole) - abs(before)
        least = 2.0 * math.hypot(*(0.0 if math.isnan(s) else s for s in (std, its)))
        return '→' if abs(away) <= least else '↑' if away > 0.0 else '↓'

    @property
    def answered(self) -> bool:
        """Whether the node has said anything."""
        return bool(self.health) or self.estimate is not None

    def line(self) -> str:
        """Return the last window as one line."""
        if self.estimate is None:
            return ''
        verdict = self.estimate.verdict
        poles = ', '.join(f'{pole_text(told(m.pole, self.estimate), 3)} {m.arrow}'
                          for m in self.modes if m.pole.imag >= 0.0)
        return printable(f'window {self.window}: {verdict.grade.name}, fit '
                         f'{fit_words(self.estimate.fit)} %, on new data '
                         f'{fit_words(self.fresh_fit)} %, poles {poles or "none"}, '
                         f'{self.computing:.2f} s. {verdict.reason}')


def picture(watched: Watched, now: float, clock: float = math.nan) -> RenderableType:
    """
    Return all of it for a terminal.

    Parameters
    ----------
    watched : Watched
    now : float
        By the clock of `Watched.heard` [s].
    clock : float
        By the clock of the stamps [s], if it is known.
    """
    from rich.console import Group

    parts = [_head(watched, now), _strip(watched, clock), _topics(watched), _window(watched),
             _model(watched)]
    return Group(*[part for part in parts if part is not None])


def _head(watched: Watched, now: float) -> Text:
    from rich.text import Text

    text = Text(cell(watched.name), style='bold')
    for part, health in watched.health.items():
        text.append(f'\n{part}: ', style='dim')
        text.append(printable(health.message, 300), style=_LEVELS[health.level])
    if watched.health and now - watched.heard > _SILENT:
        text.append(f'\nno word from the node for {now - watched.heard:.0f} s: has it ended?',
                    style='bold red')
    return text


def _strip(watched: Watched, clock: float) -> Text | None:
    from rich.text import Text

    if not watched.strip:
        return None
    text = Text('\nverdicts  ')
    for grade in watched.strip:
        text.append(grade.name[0], style=f'bold {_PAINT[grade]}')
    # What is latched may be of long ago; stamps may be of another clock.
    age = clock - 1e-9 * watched.estimate.end_ns if watched.estimate else math.nan
    ended = f', which ended {age:.0f} s ago' if 0.0 <= age < _LONG_AGO else ''
    return text.append(f'  window {watched.window}{ended}  (G good, W weak, R reject)',
                       style='dim')


def _table(*heads: str) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 2, 0, 0))
    for k, head in enumerate(heads):
        table.add_column(Text(head), justify='right' if k else 'left', no_wrap=bool(k),
                         overflow='ellipsis')
    return table


def _add(table: Table, row: Sequence[str], style: str | None = None) -> None:
    from rich.text import Text

    table.add_row(*(Text(cell(value)) for value in row), style=style)


def _topics(watched: Watched) -> Table | None:
    """Return rates and losses by topic."""
    values = watched.health[INGEST].values if INGEST in watched.health else {}
    topics = [key.removesuffix(_RATE) for key in values if key.endswith(_RATE)]
    if not topics:
        return None
    table = _table('topic', 'rate [1/s]', 'messages', 'lost', 'age [s]')
    for topic in topics:
        lost = str(values.get(f'{topic} lost', ''))
        _add(table, (topic, number(_number(values.get(f'{topic}{_RATE}'))),
                     str(values.get(f'{topic}{_MESSAGES}', '')), lost,
                     _seconds(values.get(f'{topic} age [s]'))),
            'yellow' if lost not in ('', '0') else None)
    for key, value in values.items():
        name, _, kind = key.removesuffix(' in the last window').rpartition(' ')
        if key.endswith('in the last window') and kind in _KINDS and str(value) != '0':
            _add(table, (f'{name}: in the last window {value} samples {_KINDS[kind]}',
                         '', '', '', ''), 'yellow')
    return table


def _window(watched: Watched) -> Text | None:
    """Return how full the next window is, and the computing time against its budget."""
    from rich.text import Text

    ingest, own = ({key: cell(str(value)) for key, value in watched.health[part].values.items()}
                   if part in watched.health else {} for part in (INGEST, IDENTIFICATION))
    if not own:
        return None
    text = Text()
    filled = _number(ingest.get('window filled [%]'))
    if math.isfinite(filled):
        text.append(f'window    {_bar(filled / 100.0)} {filled:3.0f} % full')
    text.append(f'   {own.get("windows", 0)} windows, {own.get("skipped windows", 0)} skipped',
                style='yellow' if own.get('skipped windows', '0') != '0' else '')
    budget = _number(own.get('budget [s]'))
    used = _number(own.get('computing time [s]'))
    if math.isfinite(used) and budget > 0.0:
        text.append(f'\ncomputing {_bar(used / budget)} {_seconds(used)} s of {_seconds(budget)}'
                    f' s', style='red' if used > 1.25 * budget else '')
        latency = _number(own.get('latency [s]'))
        if math.isfinite(latency):
            text.append(f'   published {_seconds(latency)} s after its last sample')
    if 'under way for [s]' in own:
        text.append(f'\nwindow {own["window under way"]} under way for '
                    f'{_seconds(own["under way for [s]"])} s', style='dim')
    return text


def _bar(share: float) -> str:
    done = round(_BAR * min(max(share, 0.0), 1.0))
    return '█' * done + '░' * (_BAR - done)


def _number(value: object) -> float:
    try:
        return float(str(value))
    except ValueError:
        return math.nan


def _seconds(value: object) -> str:
    seconds = _number(value)
    return f'{seconds:.2f}' if math.isfinite(seconds) else '-'


def _model(watched: Watched) -> RenderableType | None:
    """Return fits, and the modes with arrows."""
    from rich.console import Group
    from rich.text import Text

    estimate = watched.estimate
    model = estimate.model or estimate.rejected_model if estimate is not None else None
    if estimate is None or model is None:
        return None
    fits = _table('output', 'fit [%]', 'held out [%]', 'on new data [%]')
    for i, name in enumerate(model.output_names):
        _add(fits, (name, *(percent(float(v[i])) if i < len(v) else '-' for v in (
            estimate.fit, estimate.held_out_fit, watched.fresh_fit))))
    if not watched.modes:
        return fits
    modes = _table('mode', 'pole [rad/s]', 'std', 'natural freq. [rad/s]', '', 'damping')
    for m in watched.modes:
        if m.pole.imag >= 0.0:
            pole = told(m.pole, estimate)
            size = abs(pole)
            own = {m.mode, *(one.mode for one in watched.modes if one.pole == m.pole.conjugate())}
            _add(modes, (', '.join(map(str, sorted(own))), pole_text(pole), number(m.std, 2),
                         number(size), m.arrow,
                         number(-pole.real / size, 3) if size else '-'))
    words = ('modes have the numbers of their eigenvalues, a pair two, and keep them; a missing '
             'number was of an earlier window')
    return Group(fits, modes, Text(words, style='dim'))
