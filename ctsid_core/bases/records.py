# SPDX-License-Identifier: Apache-2.0
"""
Several records of one plant, side by side, and how many Hermite functions each needs.

The equations hold line by line, so that lines of several records stand beside each other as those
of one do. Each record has a trim, states at its ends, a basis and corrupt samples of its own, and
all share the plant. Lines of different records are made equally noisy by the time that a line
stands for.

The span of h_0 .. h_nmax is (nearly) the disc of radius R = sqrt(2 nmax + 1) in the
time-frequency plane: a window of half-length tau reaches R^2 / tau rad/s, at its centre. Two and
a half times that product keeps the band over nearly all of the window.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.hermite import Projection, joined, project_record
from ctsid_core.bases.preparation import Usable, moving, usable
from ctsid_core.bases.quadrature import smooth_values
from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Status
from ctsid_core.settings import Settings
from ctsid_core.signals.gaps import after_start, between_pauses, by_clock, in_words
from ctsid_core.signals.record import Record, Signal

_REACH = 2.5            # times tau omega / 2
_NYQUIST = 0.8          # part of the slowest signal's Nyquist frequency that is used
_SMALLEST, _LARGEST = 200, 1500     # highest order of the functions
_MOST_PARTS = 10        # of a long record
_ABOVE_NOISE = 4.0      # power over the noise floor that counts as signal
_DYNAMIC_RANGE = 1e-8   # power below this part of the peak is not looked for
_FINENESS = 12.0        # steps per octave of nmax, so that windows alike share a basis
_SMOOTHING = 31         # periodogram lines averaged, so that noise alone stays below the threshold


@dataclass(frozen=True)
class Unusable:
    """Why nothing of the records can be used."""

    status: Status
    notes: tuple[str, ...] = ()  # on each of several records


@dataclass(frozen=True)
class Joint:
    """What can be used of the records."""

    parts: tuple[Usable, ...]      # not empty; the same channels of each record
    numbers: tuple[int, ...]       # of which of the given records these are, counted from 1
    remarks: tuple[str, ...] = ()  # what the user should know beyond the notes of the parts

    @property
    def several(self) -> bool:
        """Whether they are of several records."""
        return len(set(self.numbers)) > 1

    @property
    def last(self) -> int:
        """Place of the record that ends last: a model's trim is that of this one."""
        ends = [p.whole.epoch_ns + round(p.whole.end * 1e9) for p in self.parts]
        return max(range(len(ends)), key=lambda i: (ends[i], i))

    @property
    def length(self) -> float:
        """Length of the longest record [s]."""
        return max(p.record.duration for p in self.parts)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know, with the numbers of the records if not of all alike."""
        return (*self.remarks, *self.numbered([p.notes for p in self.parts]))

    def numbered(self, notes: Sequence[Sequence[str]]) -> tuple[str, ...]:
        """Join the notes on each record; those on some records only get their numbers."""
        common = set.intersection(*map(set, notes)) if self.several else set().union(*notes)
        found = [note if note in common else f'record {number}: {note}'
                 for number, own in zip(self.numbers, notes, strict=True) for note in own]
        return tuple(dict.fromkeys(found))

    def corrupt(self) -> tuple[list[str], dict[str, float]]:
        """Return a sentence per channel with corrupt samples, and their numbers by name."""
        found = [p.corrupt() for p in self.parts]
        counts: dict[str, float] = {}
        for _, own in found:
            for name, count in own.items():
                counts[name] = counts.get(name, 0.0) + count
        return list(self.numbered([notes for notes, _ in found])), counts

    def project(self, settings: Settings, check: Callable[[], None] = lambda: None) -> Projection:
        """Project the records on bases of their own, side by side; `check` is called often."""
        band = max(output_band(p.record) for p in self.parts) \
            if len(self.parts) > 1 and not settings.nmax else 0.0
        sizes = [(settings.nmax, settings.parts or 1) if settings.nmax else
                 choose_nmax(p.record, band) for p in self.parts]
        return joined([project_record(p.record, settings.replace(parts=parts), nmax, check)
                       for p, (nmax, parts) in zip(self.parts, sizes, strict=True)])

    def early(self, settings: Settings) -> Joint:
        """Return the records without their last parts, `held_out` long."""
        return replace(self, parts=tuple(replace(p, record=p.record.between(
            p.record.start, p.record.end - settings.held_out * p.record.duration,
            lead=max(settings.delays(p.record.nu), default=0.0))) for p in self.parts))


def join_records(records: Sequence[Record], settings: Settings,
                 check: Callable[[], None] = lambda: None, *,
                 lost: bool = False) -> Joint | Unusable:
    """
    Return what can be used of records of the same channels, or why nothing can.

    A record is in parts where it pauses. A channel moves if it moves in any of them. A record that
    is too short is left out and noted. What held inputs were sent while they are silent may be
    `lost`. `check` is called often. Raises `SettingsError` if
    `settings.delay` does not fit the number of inputs.
    """
    divided = [between_pauses(record, lost) for record in records]
    given = [(number, part) for number, own in enumerate(divided, 1) for part in own]
    remarks = [by_clock(note, 0.0, f'record {number}') if len(records) > 1 else note
               for number, own in enumerate(divided, 1) if (note := in_words(own))]
    moves = [moving(record, settings) for _, record in given]
    keep = tuple(tuple(sorted(set().union(*(own[i] for own in moves)))) for i in (0, 1))
    parts, numbers, left = [], [], []
    for (number, record), own in zip(given, moves, strict=True):
        part = usable(record, settings, (keep[0], keep[1]), check)
        if isinstance(part, Status):
            left.append(part)
            if len(given) > 1:
                name = part_in_words(record, number if len(records) > 1 else 0)
                remarks.append(f'{name} was left out: {part.value}')
            continue
        parts.append(part)
        numbers.append(number)
        remarks += [f'record {number}: {kind} {names[j]} does not move in it'
                    for i, (kind, names) in enumerate((('input', record.input_names),
                                                       ('output', record.output_names)))
                    for j in keep[i] if j not in own[i] and record.part_of is None]
    if not parts:
        return Unusable(left[0], tuple(remarks))
    return Joint(tuple(parts), tuple(numbers), tuple(remarks))


def part_in_words(record: Record, number: int) -> str:
    """Return which record this is, or what part of it; `number` is 0 if there is one only."""
    if record.part_of is None:
        return f'record {number}'
    start = record.part_of.start
    words = f'what was recorded {after_start(record.start - start, record.end - start)}'
    return by_clock(words, 0.0, f'record {number}') if number else words


def check_alike(records: Sequence[Record]) -> None:
    """
    Raise `DataError` unless records can be of one plant.

    There is one at least, none is given twice, and channels agree in number, names and units.
    """
    if not records:
        raise DataError('no record was given; `identify` wants one, or a list of them')
    first = records[0]
    for number, record in enumerate(records, 1):
        if not isinstance(record, Record):
            raise DataError(f'record {number} is of type {type(record).__name__}; a Record is '
                            'wanted: make one with Record.from_arrays or Record.from_signals')
        if any(_same_samples(record, other) for other in records[:number - 1]):
            raise DataError(f'record {number} was given twice, and would count as twice the data; '
                            'give each record once')
        for what in ('input', 'output'):
            own, wanted = (getattr(r, f'{what}_names') for r in (record, first))
            if len(own) != len(wanted):
                raise DataError(f'record {number} has {len(own)} {what}s, record 1 has '
                                f'{len(wanted)}; records of one plant have the same channels')
            if own != wanted:
                raise DataError(f'record {number} has the {what}s {", ".join(own)}, record 1 has '
                                f'{", ".join(wanted)}; give the same channels in the same order')
            parts = [', '.join(str(s.width) for s in getattr(r, f'{what}s'))
                     for r in (record, first)]
            if parts[0] != parts[1]:
                raise DataError(f'record {number} has {what} signals of {parts[0]} channels, '
                                f'record 1 of {parts[1]}; group channels into signals in the '
                                'same way')
            units = (getattr(r, f'{what}_units') for r in (record, first))
            for name, unit, other in zip(wanted, *units, strict=True):
                if unit != other:
                    raise DataError(f'{what} {name} is in {unit!r} in record {number}, but in '
                                    f'{other!r} in record 1; convert one of them')


def _same_samples(one: Record, other: Record) -> bool:
    """Return whether two records are of the same samples."""
    return one is other or one.epoch_ns == other.epoch_ns and all(
        np.array_equal(a.time, b.time) and np.array_equal(a.values, b.values)
        for a, b in zip(one.outputs, other.outputs, strict=False))


def choose_nmax(record: Record, band: float = 0.0) -> tuple[int, int]:
    """
    Return the highest order of the Hermite functions, and the number of parts.

    Of each part of a long record; `band` is up to which the outputs rise above their noise in
    other records [rad/s].
    """
    tau = 0.5 * record.duration
    band = max(band, output_band(record))
    slowest = max((s.period for s in (*record.inputs, *record.outputs) if s.hold != 'zoh'),
                  default=record.duration / 20.0)
    highest = _NYQUIST * np.pi / slowest
    wanted = max(_REACH * 0.5 * tau * band, _SMALLEST)
    product = min(wanted, 0.5 * tau * highest)
    parts = int(min(np.ceil(product / _LARGEST), _MOST_PARTS))
    nmax = 2.0 ** (np.floor(_FINENESS * np.log2(min(product / parts, _LARGEST))) / _FINENESS)
    return max(int(nmax), 8), parts


def output_band(record: Record) -> float:
    """Return the frequency up to which the outputs of a record rise above their noise [rad/s]."""
    return max(signal_band(s, record.start, record.end) for s in record.outputs)


def signal_band(signal: Signal, start: float, end: float) -> float:
    """Return the frequency up to which a signal rises above its noise in [start, end] [rad/s]."""
    # Periodogram of the interpolated signal with a window of low side lobes; the noise floor is
    # the median of the upper quarter of the frequencies, where no plant responds.
    inside = signal.between(start, end, context=0)
    count = len(inside.time)
    if count < 16:
        return float(np.pi / signal.period)
    grid = np.linspace(inside.time[0], inside.time[-1], count)
    values = smooth_values(inside.time, inside.values.T, grid)
    values = values - values.mean(axis=1, keepdims=True)
    power = np.abs(np.fft.rfft(values * np.kaiser(count, 16.0), axis=1)) ** 2
    width = min(_SMOOTHING, max(power.shape[1] // 8, 1))
    kernel = np.ones(width) / width
    smooth = np.array([np.convolve(row, kernel, mode='same') for row in power])
    step = 2.0 * np.pi / float(grid[-1] - grid[0])
    return step * max(_last_above(row) for row in smooth)


def _last_above(power: Array) -> int:
    floor = np.median(power[-max(len(power) // 4, 1):])
    above = np.flatnonzero(power > max(_ABOVE_NOISE * floor, _DYNAMIC_RANGE * np.max(power)))
    return int(above[-1]) if len(above) else 0
