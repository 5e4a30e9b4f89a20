# SPDX-License-Identifier: Apache-2.0
"""
Sampled signals with their own time stamps, and records that join inputs and outputs.

Orientation is fixed: time first. `time` has shape (N,), `values` (N, m).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array, Mask
from ctsid_core.settings import HOLDS, Hold

LARGEST = 1e120     # sums of squares of larger values, and one over those, are infinite


@dataclass(frozen=True, eq=False)  # arrays have no truth value: equal means identical
class Signal:
    """
    Channels that share their time stamps.

    Parameters
    ----------
    time : ndarray, shape (N,)
        Strictly increasing stamps relative to the record's epoch [s].
    values : ndarray, shape (N, m)
        One column per channel.
    hold : {'zoh', 'linear', 'smooth'}
        What is known between the samples: held, on straight lines, or smooth (cubic spline).
    names, units : tuple of str, length m
    repeated : float
        Share of the samples that are missing here, for they came with other values under the stamp
        of another one.

    Raises
    ------
    DataError
        If shapes do not fit, stamps do not increase, or anything is not finite.
    """

    time: Array
    values: Array
    hold: Hold = 'smooth'
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    repeated: float = 0.0

    def __post_init__(self) -> None:
        t, x = self.time, self.values
        if self.hold not in HOLDS:
            raise DataError(f'hold is {self.hold!r}; choose one of {HOLDS}')
        if t.ndim != 1 or x.ndim != 2:
            raise DataError(f'time has shape {t.shape} and values {x.shape}; wanted are (N,) and '
                            '(N, channels)')
        if len(t) != len(x):
            raise DataError(f'{len(t)} stamps but {len(x)} samples (shape {x.shape}; time goes '
                            'first: transpose the values if they are channels by time)')
        for what, entries in (('names', self.names), ('units', self.units)):
            if entries and len(entries) != x.shape[1]:
                raise DataError(f'{len(entries)} {what} for {x.shape[1]} channels')
        _check_numbers(t, x)

    @property
    def width(self) -> int:
        """Number of channels m."""
        return int(self.values.shape[1])

    @cached_property
    def period(self) -> float:
        """Median interval between stamps [s]; infinite for fewer than two samples."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else np.inf

    @property
    def held(self) -> float:
        """How long a value is held [s]: the period; 0 if it is not held, or the only one."""
        return self.period if self.hold == 'zoh' and len(self.time) > 1 else 0.0

    def rows(self, start: float, end: float) -> slice:
        """Return the places of the samples in [start, end]."""
        return slice(int(np.searchsorted(self.time, start, side='left')),
                     int(np.searchsorted(self.time, end, side='right')))

    def of(self, rows: slice | Mask) -> Signal:
        """Return some of the samples."""
        return replace(self, time=self.time[rows], values=self.values[rows])

    def columns(self, which: Sequence[int]) -> Signal:
        """Return some of the channels."""
        names, units = (tuple(words[j] for j in which) if words else ()
                        for words in (self.names, self.units))
        return replace(self, values=self.values[:, list(which)], names=names, units=units)

    def between(self, start: float, end: float, context: int = 3) -> Signal:
        """
        Return the samples in [start, end] and up to `context` more on each side.

        The context lets a held value or a spline be known at the very ends of an interval.
        """
        inside = self.rows(start, end)
        return self.of(slice(max(inside.start - context, 0), inside.stop + context))


@dataclass(frozen=True, eq=False)
class Record:
    """
    Inputs and outputs of one interval, each with its own stamps (the field's *iddata*).

    Parameters
    ----------
    inputs, outputs : tuple of Signal
        Samples may reach beyond the interval: they serve as context at its ends.
    start, end : float
        The interval, relative to `epoch_ns` [s].
    epoch_ns : int
        Absolute time of relative time 0 [ns].
    faults : tuple of str
        What whoever made it knows to be wrong with its samples, a sentence each, with the cure: a
        model of it is WEAK at most.
    part_of : Record, optional
        The record that it is a part of, between its pauses.
    sent : tuple of Signal
        The inputs as they were sent, where what acts of them is another.
    """

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    start: float
    end: float
    epoch_ns: int = 0
    faults: tuple[str, ...] = ()
    part_of: Record | None = None
    sent: tuple[Signal, ...] = ()

    @classmethod
    def from_arrays(
        cls, t_u: ArrayLike, u: ArrayLike, t_y: ArrayLike, y: ArrayLike, *,
        input_hold: Hold = 'linear', output_hold: Hold = 'smooth',
        input_names: Sequence[str] = (), output_names: Sequence[str] = (),
        input_units: Sequence[str] = (), output_units: Sequence[str] = (), epoch_ns: int = 0,
    ) -> Record:
        """
        Join an input and an output array, each with its own stamps.

        Parameters
        ----------
        t_u, t_y : array_like, shapes (N_u,), (N_y,)
            Stamps [s], strictly increasing; they need not be uniform nor shared.
        u, y : array_like, shapes (N_u, nu), (N_y, ny); or (N_u,), (N_y,) for one channel
        input_hold, output_hold : {'zoh', 'linear', 'smooth'}
            What is known between the samples.
        input_names, output_names, input_units, output_units : sequence of str
        epoch_ns : int
            Absolute time of t = 0 [ns].

        Raises
        ------
        DataError
            If shapes, stamps or values are not usable, or u and y do not overlap in time.
        """
        signal_u = _signal('u', t_u, u, input_hold, input_names, input_units)
        signal_y = _signal('y', t_y, y, output_hold, output_names, output_units)
        return cls.from_signals((signal_u,), (signal_y,), epoch_ns=epoch_ns)

    @classmethod
    def from_signals(cls, inputs: Sequence[Signal], outputs: Sequence[Signal], *,
                     epoch_ns: int = 0) -> Record:
        """
        Join signals over the longest interval on which every one of them is known.

        Raises `DataError` if there is no such interval, or there is no output.
        """
        if not outputs:
            raise DataError('a record needs at least one output signal; `outputs` is empty')
        start, end = common_interval((*inputs, *outputs))
        return cls(tuple(inputs), tuple(outputs), start, end, epoch_ns)

    @property
    def nu(self) -> int:
        """Number of input channels."""
        return sum(s.width for s in self.inputs)

    @property
    def ny(self) -> int:
        """Number of output channels."""
        return sum(s.width for s in self.outputs)

    @property
    def recording(self) -> Record:
        """The record with all its parts."""
        return self.part_of or self

    @property
    def duration(self) -> float:
        """Length of the interval [s]."""
        return self.end - self.start

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the input channels; u1, u2, ... where none were given."""
        return _all_names(self.inputs, 'u')

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the output channels; y1, y2, ... where none were given."""
        return _all_names(self.outputs, 'y')

    @property
    def input_units(self) -> tuple[str, ...]:
        """Units of the input channels; '' where none were given."""
        return tuple(unit for s in self.inputs for unit in s.units or ('',) * s.width)

    @property
    def output_units(self) -> tuple[str, ...]:
        """Units of the output channels; '' where none were given."""
        return tuple(unit for s in self.outputs for unit in s.units or ('',) * s.width)

    @property
    def commands(self) -> tuple[Signal, ...]:
        """The inputs as they were sent."""
        return self.sent or self.inputs

    def known_from(self, delay: Sequence[float]) -> float:
        """Return when all that acts is known: dead times (nu,) after inputs' first values [s]."""
        return max((float(s.time[0]) + max(delay[channels]) for s, channels in placed(self.inputs)
                    if len(s.time)), default=self.start)

    def between(self, start: float, end: float, *, lead: float = 0.0) -> Record:
        """
        Return the part of the record in [start, end], with some samples of context.

        Times are relative [s]; inputs are kept from `lead` earlier as well (for dead time) [s].
        Raises `DataError` if nothing of the record lies between.
        """
        start, end = max(start, self.start), min(end, self.end)
        if not start < end:
            raise DataError(f'nothing of the record [{self.start:g}, {self.end:g}] s lies '
                            f'between {start:g} and {end:g} s')
        return replace(
            self, start=start, end=end,
            inputs=tuple(s.between(start - lead, end) for s in self.inputs),
            outputs=tuple(s.between(start, end) for s in self.outputs))


def with_each(record: Record, change: Callable[[Signal, tuple[str, ...]], tuple[Signal, str]],
              *, outputs_alone: bool = False) -> tuple[Record, tuple[str, ...]]:
    """
    Return a record with every signal, or every output, changed, and a sentence on each that was.

    `change` takes a signal and the names of its channels, and returns what it becomes and the
    sentence; an empty one if it is as before. If all are, so is the record.
    """
    notes: list[str] = []

    def of(signals: tuple[Signal, ...], names: tuple[str, ...]) -> tuple[Signal, ...]:
        found = [change(signal, names[channels]) for signal, channels in placed(signals)]
        notes.extend(note for _, note in found if note)
        return tuple(signal for signal, _ in found)
    inputs = record.inputs if outputs_alone else of(record.inputs, record.input_names)
    outputs = of(record.outputs, record.output_names)
    return (replace(record, inputs=inputs, outputs=outputs) if notes else record), tuple(notes)


def placed(signals: Sequence[Signal]) -> list[tuple[Signal, slice]]:
    """Return signals, each with the places that its channels have among those of all."""
    ends = np.cumsum([signal.width for signal in signals], dtype=int).tolist()
    return [(signal, slice(end - signal.width, end))
            for signal, end in zip(signals, ends, strict=True)]


def common_interval(signals: Sequence[Signal]) -> tuple[float, float]:
    """
    Return the longest interval on which every signal is known [s].

    A signal is known from its first to its last stamp; a held one for one more median interval.
    Raises `DataError` if a signal has no sample, or the signals do not overlap.
    """
    spans = []
    for signal in signals:
        if len(signal.time) == 0:
            raise DataError(f'{_label(signal)} has no sample')
        spans.append((signal.time[0], signal.time[-1] + signal.held))
    start, end = max(s for s, _ in spans), min(e for _, e in spans)
    if not start < end:
        listed = '; '.join(f'{_label(signal)}: [{s:g}, {e:g}] s'
                           for signal, (s, e) in zip(signals, spans, strict=True))
        raise DataError(f'the signals do not overlap in time ({listed}); check that their stamps '
                        'come from the same clock')
    return float(start), float(end)


def _label(signal: Signal) -> str:
    return f'signal {", ".join(signal.names)!r}' if signal.names else 'a signal'


def _all_names(signals: Sequence[Signal], letter: str) -> tuple[str, ...]:
    names: list[str] = []
    for signal in signals:
        names += signal.names or [f'{letter}{len(names) + i + 1}' for i in range(signal.width)]
    return tuple(names)


def _signal(letter: str, time: ArrayLike, values: ArrayLike, hold: Hold,
            names: Sequence[str], units: Sequence[str]) -> Signal:
    t, x = _numbers(f't_{letter}', time), _numbers(letter, values)
    if x.ndim == 1:
        x = x[:, np.newaxis]
    try:
        return Signal(t, x, hold, tuple(names), tuple(units))
    except DataError as error:
        raise DataError(f'`{letter}`, `t_{letter}`: {error}') from None


def _numbers(name: str, given: ArrayLike) -> Array:
    try:
        array = np.asarray(given)
        # What NumPy would convert without a word: texts, complex numbers, dates (to nanoseconds).
        if array.dtype.kind not in 'biufO':
            raise TypeError(f'its type is {array.dtype}')
        return array.astype(float, copy=False)
    except (TypeError, ValueError) as error:
        raise DataError(f'`{name}` is not an array of real numbers: {error}; convert it (times '
                        'are in seconds)') from error


def _check_numbers(t: Array, x: Array) -> None:
    if not np.isfinite(t).all():
        raise DataError(f'stamp {int(np.argmin(np.isfinite(t)))} is not finite; remove it')
    if not np.isfinite(x).all():
        row = int(np.argmin(np.isfinite(x).all(axis=1)))
        raise DataError(f'sample {row} is not finite: {x[row]}; remove it (samples need not be '
                        'uniform in time)')
    step = np.diff(t)
    if len(step) and not (step > 0).all():
        row = int(np.argmax(step <= 0))
        raise DataError(f'stamps must increase, but stamp {row + 1} is {t[row + 1]!r} after '
                        f'{t[row]!r}; sort the samples and keep one per stamp')
