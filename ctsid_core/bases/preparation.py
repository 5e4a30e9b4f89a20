# SPDX-License-Identifier: Apache-2.0
"""What of a record can be used: the interval, and the channels that move."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.linear.types import Array, Mask
from ctsid_core.model.estimate import Status
from ctsid_core.model.simulation import input_polynomials
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.settings import Settings
from ctsid_core.signals.as_measured import as_measured
from ctsid_core.signals.gaps import FEWEST, missing
from ctsid_core.signals.record import LARGEST, Record, Signal, placed, with_each
from ctsid_core.signals.spikes import (
    SURE,
    SURE_INPUT,
    Spikes,
    no_spikes,
    report,
    spikes,
    within_range,
)

_CONSTANT = 1e-9        # a channel whose range is below this part of its size does not move


@dataclass(frozen=True)
class Usable:
    """A record with the channels that move, and where they belong among all channels."""

    record: Record                 # of the moving channels, from where their inputs are known
    whole: Record                  # as it was given, or a part between pauses
    u: tuple[int, ...]             # places of the moving inputs among all
    y: tuple[int, ...]
    # Taken off the samples so that large offsets do not cost digits; zero without trim. The trim
    # is estimated all the same: these only shift its origin.
    u_level: Array
    y_level: Array
    notes: tuple[str, ...]
    corrupt_u: tuple[Spikes, ...]  # of the signals of `record`
    corrupt_y: tuple[Spikes, ...]

    def corrupt(self) -> tuple[list[str], dict[str, float]]:
        """Return a sentence per channel with corrupt samples, and their numbers by name."""
        notes, counts = [], {'corrupt_samples': 0.0}
        for kind, all_names, places, signals, found in (
                ('input', self.whole.input_names, self.u, self.record.inputs, self.corrupt_u),
                ('output', self.whole.output_names, self.y, self.record.outputs, self.corrupt_y)):
            more, channels = report(kind, [all_names[j] for j in places], signals, found,
                                    self.whole.recording)
            notes += more
            counts |= channels
            counts['corrupt_samples'] += sum(channels.values())
        return notes, counts

    def with_honest(self, honest: Sequence[Mask]) -> Usable:
        """Return the record with samples (N, m) of each output signal that are not corrupt."""
        outputs, corrupt = _as_measured(self.record.outputs, self.corrupt_y, honest)
        return replace(self, record=replace(self.record, outputs=outputs), corrupt_y=corrupt)

    def with_input(self, signal: int, channel: int) -> Usable:
        """Return the record with a channel of an input signal as it was measured."""
        honest = [np.zeros_like(spiky.mask) for spiky in self.corrupt_u]
        honest[signal][:, channel] = True
        inputs, corrupt = _as_measured(self.record.inputs, self.corrupt_u, honest)
        return replace(self, record=replace(self.record, inputs=inputs), corrupt_u=corrupt)


def _as_measured(signals: Sequence[Signal], corrupt: Sequence[Spikes], honest: Sequence[Mask]
                 ) -> tuple[tuple[Signal, ...], tuple[Spikes, ...]]:
    """Return signals with samples (N, m) of each as they were measured, and what is corrupt."""
    given = list(zip(signals, corrupt, honest, strict=True))
    return (tuple(replace(s, values=s.values + np.where(own, spiky.off, 0.0))
                  for s, spiky, own in given),
            tuple(replace(spiky, mask=spiky.mask & ~own) for _, spiky, own in given))


def computable(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record without values that are no measurements but torn bits, and notes on them."""
    def whole(signal: Signal, names: tuple[str, ...]) -> tuple[Signal, str]:
        good = (np.abs(signal.values) <= LARGEST).all(axis=1)
        return (signal, '') if good.all() else (
            signal.of(good),
            f'{np.count_nonzero(~good)} of {len(good)} samples of {", ".join(names)} are larger '
            f'than {LARGEST:g}, and were not used; check that sensor')
    return with_each(record, whole)


def moving(record: Record, settings: Settings) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the places of the inputs that act within a record, and of the outputs that move."""
    record = replace(record, start=_known_from(record, settings))
    return (_moving(record, record.inputs, settings.delays(record.nu))[1],
            _moving(record, record.outputs)[1])


def usable(record: Record, settings: Settings,
           keep: tuple[tuple[int, ...], tuple[int, ...]] = ((), ()),
           check: Callable[[], None] = lambda: None) -> Usable | Status:
    """
    Return what of a record can be used, or the status that says why nothing can.

    Places of inputs and outputs in `keep` are kept even if they do not move. `check` is called
    often. Raises `SettingsError` if `settings.delay` does not fit the number of inputs.
    """
    start = _known_from(record, settings)
    if start >= record.end:
        return Status.TOO_SHORT
    notes = []
    if start > record.start:
        notes.append(f'the first {start - record.start:.3g} s were left out: an input has no '
                     'known value there, because of its dead time')
    shorter = replace(record, start=start) if start > record.start else record
    inputs, u, fixed_u = _moving(shorter, shorter.inputs, settings.delays(record.nu), keep[0])
    outputs, y, fixed_y = _moving(shorter, shorter.outputs, keep=keep[1])
    for kind, names, fixed in (('input', record.input_names, fixed_u),
                               ('output', record.output_names, fixed_y)):
        notes += [f'{kind} {names[j]} is constant over the window; the model leaves it out'
                  for j in fixed]
    if sparse(shorter):
        return Status.TOO_SHORT
    if not outputs:
        return Status.NO_RESPONSE
    if not inputs:
        return Status.NO_EXCITATION
    for signal in record.recording.outputs:
        if (share := missing(signal, record.recording)) > 0.0:
            notes.append(f'{100 * share:.2g} % of the window has no samples of '
                         f'{", ".join(signal.names) or "an output"}')
    inputs, corrupt_u = _despiked(inputs, ('smooth',), SURE_INPUT, (None,) * len(inputs), check)
    outputs, corrupt_y = _despiked(outputs, ('smooth', 'linear'), SURE,
                                   _held_at(record, outputs, settings), check)
    inputs, u_level = _centred(inputs, settings.trim)
    outputs, y_level = _centred(outputs, settings.trim)
    sent = [s.columns([j]) for s in record.sent for j in range(s.width)]
    return Usable(replace(shorter, inputs=tuple(inputs), outputs=tuple(outputs), sent=tuple(
        sent[j] for j in u if sent)), record, u, y,
                  u_level, y_level, tuple(notes), corrupt_u, corrupt_y)


def sparse(record: Record) -> list[str]:
    """Return the inputs of which there is no sample, and outputs of which there are too few."""
    return _names(record.inputs, [not len(s.time) for s in record.inputs], record.input_names) + \
        _names(record.outputs, [_few(s, record) for s in record.outputs], record.output_names)


def is_short(record: Record) -> bool:
    """Return whether there are too few samples of any channel: it is not that one is missing."""
    return all(_few(s, record) for s in (*record.inputs, *record.outputs))


def _few(signal: Signal, record: Record) -> bool:
    return len(signal.time[signal.rows(record.start, record.end)]) < (
        FEWEST if record.part_of is None else 1)


def _names(signals: Sequence[Signal], chosen: Sequence[bool], names: Sequence[str]) -> list[str]:
    return [name for (_, channels), one in zip(placed(signals), chosen, strict=True) if one
            for name in names[channels]]


def corrupt_outputs(record: Record, settings: Settings) -> dict[int, Array]:
    """Return the times of the corrupt samples of each output that has any [s]."""
    whole, (record, _) = record, computable(record)
    found = {i: np.setdiff1d(one.time, other.time)
             for (one, channels), other in zip(placed(whole.outputs), record.outputs, strict=True)
             if len(other.time) < len(one.time) for i in range(channels.start, channels.stop)}
    part = usable(as_measured(record)[0], settings)
    if not isinstance(part, Usable):
        return found
    columns = ((signal.time, bad) for signal, spiky in zip(
        part.record.outputs, part.corrupt_y, strict=True) for bad in spiky.mask.T)
    for i, (time, bad) in zip(part.y, columns, strict=True):
        if bad.any():
            found[i] = np.union1d(found.get(i, np.empty(0)), time[bad])
    return found


def without_corrupt(record: Record, settings: Settings, *models: StateSpace
                    ) -> tuple[Record, tuple[str, ...]]:
    """
    Return a record without corrupt samples of its outputs and repeated ones, and notes on them.

    For tests of a model on data: one spike of a sensor would else decide on the fit of a model
    that is right. Identification finds them by itself. With `models` they are those that stand
    out of what each of these leaves; those of inputs are bridged where that leaves less of each.
    """
    record, told = as_measured(record)
    record, ends = within_range(record)
    found, notes = corrupt_outputs(record, settings), [*told, *ends]
    if models:
        likely, more = _with_likely_inputs(_without(record, found)[0], models)
        record = replace(record, inputs=likely.inputs) if more else record
        found, *others = (_unexplained(record, model) for model in models)
        for other in others:
            found = {i: np.intersect1d(times, other[i]) for i, times in found.items()
                     if i in other}
        notes += more
    record, more = _without(record, found)
    return record, (*notes, *more)


def _without(record: Record, found: Mapping[int, Array]) -> tuple[Record, list[str]]:
    """Return a record without samples of outputs at some times of each, and notes on them."""
    outputs, notes = [], []
    for signal, place in placed(record.outputs):
        times = [found[i] for i in range(place.start, place.stop) if i in found]
        bad = np.isin(signal.time, np.concatenate(times or [np.empty(0)]))
        outputs.append(signal.of(~bad) if bad.any() else signal)
        if bad.any():
            names = ', '.join(record.output_names[place])
            notes.append(f'{np.sum(bad)} corrupt samples of {names} are left out of the fits')
    return (replace(record, outputs=tuple(outputs)) if notes else record), notes


def _unexplained(record: Record, model: StateSpace) -> dict[int, Array]:
    """Return the times of samples that stand out of what a model leaves, as spikes do."""
    simulated, found = simulation(model, record, trim='refit'), {}
    for i, error in enumerate((simulated.y - simulated.y_hat).T):
        known = np.isfinite(error)
        times = simulated.times[known]
        spiky = spikes(times, error[known, np.newaxis], closely=True).mask[:, 0]
        if spiky.any():
            found[i] = times[spiky]
    return found


def _with_likely_inputs(record: Record, models: Sequence[StateSpace]) -> tuple[Record, list[str]]:
    """Return a record with each input channel as it was measured, or bridged: as models say."""
    bridged, found = _despiked(list(record.inputs), ('smooth',), SURE_INPUT,
                               (None,) * len(record.inputs), lambda: None)
    notes: list[str] = []
    if not any(own.any for own in found):
        return record, notes

    def left(record: Record) -> Array:
        return np.array([np.nansum(100.0 - simulation(model, record, trim='refit').fit)
                         for model in models])
    best = replace(record, inputs=tuple(bridged))
    error, raw = left(best), left(record)
    # All are bridged at first, as in identification: two may be corrupt at the same time.
    for k, (own, (_, channels)) in enumerate(zip(found, placed(record.inputs), strict=True)):
        for place, name in enumerate(record.input_names[channels]):
            count = int(np.sum(own.mask[:, place]))
            if not count:
                continue
            values = best.inputs[k].values.copy()
            values[:, place] = record.inputs[k].values[:, place]
            other = replace(best, inputs=(*best.inputs[:k], replace(
                best.inputs[k], values=values), *best.inputs[k + 1:]))
            if np.any((now := left(other)) < error):
                best, error = other, now
            else:
                notes.append(f'{count} corrupt samples of input {name} are bridged from those '
                             'beside them: the model explains more without')
    return (best, notes) if np.all(error < raw) else (record, [])


def _held_at(record: Record, signals: list[Signal],
             settings: Settings) -> tuple[Array | None, ...]:
    """Return the held inputs, after their dead times, at the stamps of each signal."""
    if not settings.feedthrough:
        return (None,) * len(signals)
    delays = settings.delays(record.nu)
    held = [(signal, delays[channels]) for signal, channels in placed(record.inputs)
            if signal.hold == 'zoh']
    late = sum((own for _, own in held), ())
    return tuple(input_polynomials([u for u, _ in held], late, s.time)[0] for s in signals)


def _despiked(signals: list[Signal], holds: tuple[str, ...], sure: float,
              inputs: tuple[Array | None, ...],
              check: Callable[[], None]) -> tuple[list[Signal], tuple[Spikes, ...]]:
    """Return the signals without spikes; those of other holds as they are: theirs are real."""
    found = tuple(spikes(s.time, s.values, sure, inputs=direct, check=check)
                  if s.hold in holds else no_spikes(s.values)
                  for s, direct in zip(signals, inputs, strict=True))
    return [replace(s, values=own.instead) if own.any else s
            for s, own in zip(signals, found, strict=True)], found


def _centred(signals: list[Signal], trim: bool) -> tuple[list[Signal], Array]:
    """Return the signals less the means of their channels, and these; unchanged without trim."""
    if not trim:
        return signals, np.zeros(sum(s.width for s in signals))
    levels = [s.values.mean(axis=0) for s in signals]
    return ([replace(s, values=s.values - level)
             for s, level in zip(signals, levels, strict=True)], np.concatenate(levels))


def _known_from(record: Record, settings: Settings) -> float:
    """Return the time from which all inputs, delayed, are known [s]."""
    delays, start = settings.delays(record.nu), record.start
    for signal, channels in placed(record.inputs):
        delay = max(delays[channels])
        if delay > 0.0 and len(signal.time):
            start = max(start, float(signal.time[0]) + delay)
    return start


def _moving(record: Record, signals: tuple[Signal, ...], delays: tuple[float, ...] = (),
            keep: tuple[int, ...] = ()) -> tuple[list[Signal], tuple[int, ...], list[int]]:
    """Return the signals without constant channels, and the places of moving and constant ones."""
    # As they act: later by the delays of all channels [s], if there are any.
    kept_signals: list[Signal] = []
    kept: list[int] = []
    fixed: list[int] = []
    for signal, channels in placed(signals):
        moves, places = np.zeros(signal.width, dtype=bool), np.r_[channels]
        late = np.array(delays[channels] or (0.0,) * signal.width)
        for d in set(late.tolist()):
            inside = signal.rows(record.start - d, record.end - d)
            values = signal.values[max(inside.start - 1, 0):inside.stop + 1]
            if len(values):
                rows = np.ascontiguousarray(values.T)   # reductions along rows are far quicker
                low, high = rows.min(axis=1), rows.max(axis=1)
                moves |= (late == d) & (
                    high - low > np.maximum(_CONSTANT * np.maximum(np.abs(low), np.abs(high)),
                                            1.0 / LARGEST))
        moves |= np.isin(places, keep)
        kept += places[moves].tolist()
        fixed += places[~moves].tolist()
        if moves.any():
            kept_signals.append(signal if moves.all() else
                                signal.columns(np.flatnonzero(moves).tolist()))
    return kept_signals, tuple(kept), fixed
