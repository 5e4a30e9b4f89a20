# SPDX-License-Identifier: Apache-2.0
"""
Spikes: single samples or short bursts that are far off, and no honest motion.

A sample is compared with what its neighbours predict (a cubic through two on either side, at the
ends of a record the nearest four, over their own stamps) or, where that scatters less, with the
median. Whatever lies beyond some robust standard deviations is a suspect. Runs of suspects are
judged by a polynomial through the good samples on both sides: it must pass these much closer than
the suspects, the run must stand out at its edges, and without it nothing may stand out any more. A
step, a kink or a fast motion fails there by itself, because no smooth curve joins its two sides.
At the ends there is one side only: there a few samples that move as nothing else in the record
does are corrupt.

Places of corrupt samples are bridged: their values are not used, but their stamps stay, so that
the other samples are interpolated and weighted as they would be without.

A sensor that is driven beyond its range shows its largest or smallest value, to the last bit, and
how the plant moves then it does not tell. Into that value it goes at full speed, and out of it: a
plant that comes to rest does so by what the sensor resolves. Zero is no end of a range, but where
things rest; and what is hardly ever between its ends, a valve or a switch, is no sensor of that
kind.

Sources: the median absolute deviation and its use against spikes are Hampel's (1974), J. American
Statistical Association 69; a test against a fit without the suspects is that of Barnett and Lewis,
Outliers in Statistical Data, chapter 7; the estimator that ignores them is Huber's (1964), Annals
of Mathematical Statistics 35.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array, Mask, Places
from ctsid_core.signals.as_measured import least
from ctsid_core.signals.record import Record, Signal, with_each

_FEWEST = 50            # samples of a channel that is looked at
_MOST = 0.05            # part of a channel's samples beyond which they are not 'a few'
SURE = 6.0              # robust standard deviations off the curve beyond which samples are bad
SURE_INPUT = 10.0       # the same for inputs, of which no model can tell whether they are honest
_SUSPECT = 5.0          # the same from which on a sample is suspected
_PERHAPS = 3.5          # the same if there is another reason to look closer
_LONGEST = 24           # samples of a run of suspects
_SIDE = 8               # good samples on either side that judge it
_DEGREES = (1, 3, 5)    # of the curve through them: the one that passes them best
_APART = (2, 6)         # suspects so near belong to one run; at first, and then
_EDGE = 4               # samples of a run that may be the edge of a burst of about twice as many
_BESIDE = 3             # good samples on each side: fewer, and the other side judges alone ...
_ALONE = 3              # ... so many corrupt ones at most
_BLOCK = 64             # samples over which the local scale is taken
_WHITE = 1.15           # the median predicts if it scatters less than this times the cubic
_ROUNDS = 4             # smaller spikes come to light when the larger ones are gone
_SHARP = 0.3            # of how far off a run is, that its edges show
_REST = 0.3             # of what stands out before, that may do so without the run
_REWEIGHTED = 8         # rounds of reweighted least squares
_ENDS = 10              # samples like the one before, where the range of a sensor ends, ...
_AT_ONCE = 3.0          # ... which is reached, and left, by so many of its steps
_BETWEEN = 0.2          # of the samples are between its ends
MAD = 1.4826            # of a median absolute deviation: that of a normal distribution
_STILL = 0.25           # part of differences that vanish, beyond which the others give the scale


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
    if len(time) < _FEWEST:
        return no_spikes(values)
    mask = np.zeros(values.shape, dtype=bool)
    weights = _weights_of(time)
    too_many, instead = [], values
    for j, row in enumerate(np.ascontiguousarray(values.T)):
        check()
        stands_out = _standing_out(*_distance(row, weights), sure)
        direct = np.zeros_like(row)
        if stands_out and inputs is not None and inputs.shape[1]:
            direct = _followed(row, inputs, weights)
            stands_out = _standing_out(*_distance(row - direct, weights), sure)
        if not (stands_out or closely):
            continue
        found, filled = _find(_Channel(time, weights, sure, _resolution(row)), row - direct, check)
        if np.count_nonzero(found) > _MOST * len(row):
            too_many.append(j)
        elif found.any():
            instead = instead.copy() if instead is values else instead
            mask[:, j] = found
            instead[:, j] = np.where(found, filled + direct, row)
    return Spikes(mask, instead, values - instead, tuple(too_many))


def within_range(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return a record without samples of outputs at the end of a sensor's range, and notes."""
    def of(signal: Signal, names: tuple[str, ...]) -> tuple[Signal, str]:
        ends = _at_end(signal.values)
        bad = ends.any(axis=1)
        if not bad.any() or np.count_nonzero(~bad) < max(_FEWEST, _BETWEEN * len(bad)):
            return signal, ''
        return signal.of(~bad), '; '.join(
            f'output {name}: {np.count_nonzero(own)} of {len(own)} samples are at the end of its '
            f'range, and were not used: {_places(signal.time[own] - record.start)}'
            for name, own in zip(names, ends.T, strict=True) if own.any()
        ) + '; move it less, or set a larger range'
    return with_each(record, of, outputs_alone=True)


def _at_end(values: Array) -> Mask:
    """Return which samples of channels (N, m) are where the range of the sensor ends."""
    found = np.zeros(values.shape, dtype=bool)
    for j, y in enumerate(values.T if len(values) else ()):
        step = np.abs(np.diff(y))
        for end in {float(np.min(y)), float(np.max(y))} - {0.0}:
            at = y == end
            into, out = step[at[1:] & ~at[:-1]], step[at[:-1] & ~at[1:]]
            if np.count_nonzero(at[1:] & at[:-1]) >= _ENDS and len(into) and len(out) and min(
                    np.median(into), np.median(out)) > _AT_ONCE * least(step):
                found[:, j] |= at
    return found


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
                notes.append(f'{kind} {name}: more than {100 * _MOST:g} % of the samples lie far '
                             'from their neighbours; these are not a few corrupt ones, and all '
                             'were used')
    return notes, counts


def _places(times: Array) -> str:
    if len(times) <= 10:
        return 'at ' + ', '.join(f'{t:.4g}' for t in times) + ' s'
    return f'between {times[0]:.4g} and {times[-1]:.4g} s'


@dataclass(frozen=True, eq=False)
class _Channel:
    """What judges the samples of one channel."""

    time: Array     # (N,)
    weights: Array  # (4, N), see `_weights_of`
    sure: float     # robust standard deviations beyond which a sample is corrupt
    least: float    # how far off a corrupt sample is at least

    def sharp(self, x: Array, without: Array, run: slice, local: float) -> bool:
        """Return whether a run stands out sharply, and nothing does any more without it."""
        beside = np.arange(max(run.start - 2, 0), min(run.stop + 2, len(x)))
        gain = _gain(self.weights[:, beside])
        before, after = (_prediction_residual(values, self.weights, beside)
                         for values in (x, without))
        return bool(np.max(np.abs(before)) > _SHARP * np.max(np.abs(x[run] - without[run]))
                    and np.max(np.abs(after / gain)) < max(
                        _SUSPECT * local, _REST * np.max(np.abs(before / gain))))


def _standing_out(off: Array, scale: float, white: bool, sure: float) -> bool:
    """Return whether any sample lies far off for its surroundings."""
    limit = _SUSPECT * sure / SURE
    if not np.max(np.abs(off)) > limit * scale:
        return False
    return bool((np.abs(off) > limit * _local(off, scale, white)).any())


def _find(channel: _Channel, x: Array, check: Callable[[], None]) -> tuple[Mask, Array]:
    """Return which samples of a channel are corrupt, and the channel without them."""
    bad, filled = np.zeros(len(x), dtype=bool), x.copy()
    for _ in range(_ROUNDS):
        before = np.count_nonzero(bad)
        for apart in _APART:
            off, scale, white = _distance(filled, channel.weights)
            local = _local(off, scale, white)
            suspect = (np.abs(off) > _PERHAPS * channel.sure / SURE * local) & ~bad
            # What still stands out beside corrupt samples: were they the wrong ones?
            rechecked = bad if apart == _APART[-1] else np.zeros_like(bad)
            good = ~(suspect | bad)
            for first, last in _runs(suspect | rechecked, apart):
                if not suspect[first:last + 1].any():
                    continue
                check()
                wide = slice(first, last + 1)
                given = np.concatenate((filled[:first], np.where(
                    rechecked[wide], x[wide], filled[wide]), filled[last + 1:]))
                verdicts = [v for run in _hypotheses(first, last, len(x)) if (
                    v := _judge(channel, given, run, good, local, white)) is not None]
                if verdicts:
                    _, run, far, without = min(verdicts, key=lambda v: v[0])
                    bad[wide] &= ~rechecked[wide]
                    filled[wide] = given[wide]
                    bad[run] |= far
                    filled[run] = np.where(far, without, filled[run])
        if np.count_nonzero(bad) == before or np.count_nonzero(bad) > _MOST * len(x):
            break
    return bad, filled


def _weights_of(t: Array) -> Array:
    """Return what predicts a sample from the four nearest ones: Lagrange's cubic, (4, N)."""
    own = np.arange(len(t))
    a, b, c, d = t[_nearest(own, len(t))] - t
    ab, ac, ad, bc, bd, cd = b - a, c - a, d - a, c - b, d - b, d - c
    return np.array([b * c * d / (ab * ac * ad), -a * c * d / (ab * bc * bd),
                     a * b * d / (ac * bc * cd), -a * b * c / (ad * bd * cd)])


def _nearest(places: Places, count: int) -> Places:
    """Return the four samples that predict each: two on either side, at the ends what there is."""
    first = np.clip(places - 2, 0, count - 5)
    near = first + np.arange(4)[:, np.newaxis]
    return np.asarray(near + (near >= places))


def _prediction_residual(x: Array, weights: Array, places: Places | None = None) -> Array:
    """Return how far samples, or those at some places, are from what the nearest ones predict."""
    places = np.arange(len(x)) if places is None else places
    near = x[_nearest(places, len(x))]
    return np.asarray(x[places] - np.einsum('ki,ki->i', weights[:, places], near))


def _gain(weights: Array) -> Array:
    """Return the size of residuals of white noise of size 1."""
    return np.asarray(np.sqrt(1.0 + np.einsum('ki,ki->i', weights, weights)))


def _distance(x: Array, weights: Array) -> tuple[Array, float, bool]:
    """Return how far each sample lies off, the robust scale of this, whether noise is white."""
    # In units of the white noise that would show the same.
    off, plain = _prediction_residual(x, weights) / _gain(weights), x - np.median(x)
    scale, white = _scale(off[2:-2]), _scale(plain)
    if white < _WHITE * scale:
        return plain, white, True
    return off, scale, False


def _scale(off: Array) -> float:
    """Return the robust standard deviation; of what is not zero if much is (held, quantised)."""
    size = np.abs(off)
    scale = MAD * float(np.median(size))
    if not scale > 0.0:
        moving = size[size > 0.0]
        scale = MAD * float(np.median(moving)) if len(moving) > _STILL * len(off) else np.inf
    return scale


def _local(off: Array, scale: float, white: bool) -> Array:
    """Return the scale at each sample: that of its surroundings where it is larger."""
    size, count = np.abs(off), max(len(off) // _BLOCK, 1)
    if not white:
        size[:2] = size[-2:] = 0.0      # what the samples beside them say, once more
    width, longer = divmod(len(off), count)                # blocks of two widths, side by side
    bounds = longer * (width + 1)
    own = MAD * np.concatenate([np.median(size[:bounds].reshape(longer, width + 1), axis=1),
                                 np.median(size[bounds:].reshape(-1, width), axis=1)])
    padded = np.pad(own, 1, mode='edge')
    largest = np.maximum(np.maximum(padded[:-2], padded[2:]), np.maximum(own, scale))
    return np.repeat(largest, width + (np.arange(count) < longer))


def _followed(x: Array, inputs: Array, weights: Array) -> Array:
    """Return what of a channel follows inputs at once, and jumps as they do."""
    # Their gain is found from the jumps by Huber's estimator: spikes have little say.
    gain = _gain(weights)
    columns = np.array([_prediction_residual(u, weights) / gain for u in inputs.T]).T
    off = _prediction_residual(x, weights) / gain
    weight = np.ones(len(off))
    for _ in range(_REWEIGHTED):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(columns * root[:, np.newaxis], off * root, rcond=1e-10)[0]
        rest = np.abs(off - columns @ found)
        limit = max(2.0 * MAD * float(np.median(rest)), np.finfo(float).tiny)
        weight = limit / np.maximum(rest, limit)
    return np.asarray(inputs @ found)


def _resolution(x: Array) -> float:
    """Return three usual changes of a channel that is held or quantised; 0 of any other."""
    change = np.abs(np.diff(x))
    moving = change[change > 0.0]
    if len(moving) > (1.0 - _STILL) * len(change) or not len(moving):
        return 0.0
    return 3.0 * float(np.quantile(moving, 0.75))


def _runs(suspect: Mask, apart: int) -> list[tuple[int, int]]:
    """Return first and last sample of each run of suspects that is not too long."""
    places = np.flatnonzero(suspect)
    if not len(places):
        return []
    parts = np.split(places, np.flatnonzero(np.diff(places) > apart) + 1)
    return [(int(p[0]), int(p[-1])) for p in parts if p[-1] - p[0] < _LONGEST]


def _hypotheses(first: int, last: int, count: int) -> list[slice]:
    """Return where corrupt samples may be: in a run, or at an edge of a burst that it is."""
    runs = [slice(first, last + 1)]
    if last - first < _EDGE:
        runs += [slice(first, min(first + 2 * _EDGE, count)),
                 slice(max(last + 1 - 2 * _EDGE, 0), last + 1)]
    return runs


def _judge(channel: _Channel, x: Array, run: slice, good: Mask, local: Array,
           white: bool) -> tuple[float, slice, Mask, Array] | None:
    """Compare a run with a curve through the good samples beside it; None if none is corrupt."""
    # Returns how far it scatters, the run, which samples are corrupt, and the run without them.
    before = run.start - 1 - np.flatnonzero(good[max(run.start - 4 * _SIDE, 0):run.start][::-1])
    after = run.stop + np.flatnonzero(good[run.stop:run.stop + 4 * _SIDE])
    one_sided = not white and min(len(before), len(after)) < _BESIDE
    if len(before) + len(after) < _SIDE:
        return None
    side = np.concatenate((before[:_SIDE][::-1], after[:_SIDE]))
    scale = float(np.max(local[run]))
    curve, spread = min((_curve(channel.time, x, side, run, degree, scale)
                         for degree in _DEGREES[:1 if white else None]),
                        key=lambda pair: float(np.max(pair[1])))
    far = np.abs(x[run] - curve) > np.maximum(channel.sure * spread, channel.least)
    # One side does not tell what is no motion: more, as of a step, or what moves so elsewhere.
    if one_sided:
        far &= np.abs(x[run] - curve) > max(float(np.max(np.abs(np.diff(part)), initial=0.0))
                                            for part in (x[:run.start], x[run.stop:]))
        if np.count_nonzero(far) > _ALONE:
            return None
    without = x.copy()
    without[run] = np.where(far, curve, x[run])
    if not (far.any() and (white or channel.sharp(x, without, run, scale))):
        return None
    return float(np.max(spread)), run, far, without[run]


def _curve(t: Array, x: Array, side: Places, run: slice, degree: int,
           least: float) -> tuple[Array, Array]:
    """Return the curve through good samples at those of a run, and the deviation from it."""
    centre, width = 0.5 * (t[side[0]] + t[side[-1]]), 0.5 * (t[side[-1]] - t[side[0]])
    columns, own = (np.vander((t[k] - centre) / width, degree + 1) for k in (side, run))
    inverse = np.linalg.pinv(columns)
    found = inverse @ x[side]
    rest = x[side] - columns @ found
    spread = max(float(np.sqrt(rest @ rest / max(len(side) - degree - 1, 1))), least)
    return own @ found, spread * np.sqrt(1.0 + np.sum((own @ inverse) ** 2, axis=1))
