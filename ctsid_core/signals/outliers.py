# SPDX-License-Identifier: Apache-2.0
"""
Corrupt samples of a record: those far from their neighbours (`spikes.py`).

Their places are bridged: their values are not used, but their stamps stay, so that the other
samples are interpolated and weighted as they would be without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array, Mask
from ctsid_core.signals.record import Record, Signal
from ctsid_core.signals.spikes import (
    MOST,
    SURE,
    Channel,
    distance,
    find,
    followed,
    resolution,
    standing_out,
    weights_of,
)

FEWEST = 50             # samples of a channel that is looked at
SURE_INPUT = 10.0       # the same for inputs, of which no model can tell whether they are honest


@dataclass(frozen=True, eq=False)
class Spikes:
    """Corrupt samples of one signal."""

    mask: Mask      # (N, m): which samples are corrupt
    instead: Array  # (N, m): the values, with corrupt samples bridged from their neighbours
    off: Array      # (N, m): the values less these
    # channels with so many far samples that none was taken for corrupt
    too_many: tuple[int, ...] = ()

    @property
    def any(self) -> bool:
        """Whether there are corrupt samples."""
        return bool(self.mask.any())


def no_spikes(values: Array) -> Spikes:
    """Return that no sample is corrupt."""
    return Spikes(np.zeros(values.shape, dtype=bool), values, np.zeros(values.shape))


def spikes(time: Array, values: Array, sure: float = SURE, *,
           inputs: Array | None = None, closely: bool = False,
           check: Callable[[], None] = lambda: None) -> Spikes:
    """
    Find the corrupt samples of channels (N, m) that share their increasing stamps (N,).

    They lie beyond `sure` robust standard deviations; `inputs` (N, nu) are held ones, that
    channels may follow at once; `closely`: look for small bursts even if no sample stands out;
    `check` is called often. Of white Gaussian noise with 10000 samples, about one record in 170
    has a suspect; it then has to pass the judgement, too.
    """
    if len(time) < FEWEST:
        return no_spikes(values)
    mask = np.zeros(values.shape, dtype=bool)
    weights = weights_of(time)
    too_many, instead = [], values
    for j, row in enumerate(np.ascontiguousarray(values.T)):
        check()
        stands_out = standing_out(*distance(row, weights), sure)
        direct = np.zeros_like(row)
        if stands_out and inputs is not None and inputs.shape[1]:
            direct = followed(row, inputs, weights)
            stands_out = standing_out(*distance(row - direct, weights), sure)
        if not (stands_out or closely):
            continue
        found, filled = find(Channel(time, weights, sure, resolution(row)), row - direct, check)
        if np.count_nonzero(found) > MOST * len(row):
            too_many.append(j)
        elif found.any():
            instead = instead.copy() if instead is values else instead
            mask[:, j] = found
            instead[:, j] = np.where(found, filled + direct, row)
    return Spikes(mask, instead, values - instead, tuple(too_many))


def report(kind: str, names: Sequence[str], signals: Sequence[Signal], found: Sequence[Spikes],
           record: Record) -> tuple[list[str], dict[str, float]]:
    """
    Return sentences on which samples of which channels are corrupt, and their numbers.

    Numbers by 'corrupt_samples.' and the name. `kind` is 'input' or 'output', `names` are of all
    channels. Samples within the interval of the record count; times are from its start.
    """
    notes, counts, rest = [], {}, iter(names)
    held = '; if it is a command that is held, set its `hold: zoh`'
    for signal, spiky in zip(signals, found, strict=True):
        inside = signal.rows(record.start, record.end)
        times = signal.time[inside] - record.start
        for j, name in zip(range(signal.width), rest, strict=False):
            bad = spiky.mask[inside, j]
            if bad.any():
                counts[f'corrupt_samples.{name}'] = float(np.count_nonzero(bad))
                notes.append(f'{kind} {name}: {np.count_nonzero(bad)} of {len(bad)} samples '
                             'stand out of their neighbours or of what the model leaves, as '
                             'corrupt ones do, and were not used: '
                             + _places(times[bad]) + held * (kind == 'input'))
            if j in spiky.too_many:
                notes.append(f'{kind} {name}: more than {100 * MOST:g} % of the samples lie far '
                             'from their neighbours; these are not a few corrupt ones, and all '
                             'were used')
    return notes, counts


def _places(times: Array) -> str:
    if len(times) <= 10:
        return 'at ' + ', '.join(f'{t:.4g}' for t in times) + ' s'
    return f'between {times[0]:.4g} and {times[-1]:.4g} s'
