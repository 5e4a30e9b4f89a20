# SPDX-License-Identifier: Apache-2.0
"""
Pairs of input and output of a bag, the most promising first.

Most counts what the past of the input explains of the output's motion in unseen data, then which
of the two comes first, how long they overlap, whose stamps are better; names and types of
messages come last.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsid_core.linear.types import Array
from ctsid_ros.decoding.field_path import plain
from ctsid_ros.recordings.bag import Bag
from ctsid_ros.recordings.excerpts import Clock
from ctsid_ros.recordings.guess_candidates import (
    BATTERY,
    FEWEST,
    FORCE_FIELD,
    NEUTRAL,
    Candidate,
    Key,
    candidates,
)
from ctsid_ros.recordings.guess_pairs import (
    STEPS,
    Comparison,
    Explained,
    begins_before,
    effective_frequencies,
    without_slow,
)
from ctsid_ros.recordings.survey import Survey

_MOST_INPUTS, _MOST_OUTPUTS = 32, 80  # that are compared with each other
_MOST_PAIRS = 48  # that are looked at closely
_MOST_COMMANDS = 8  # that may move an output beside its input: one does that leaves less than so
_LEFT, _TOLD_MORE = 0.7, 0.01  # much of what is left without it, and explains so much more
_HALF = 0.5  # of a motion, that all commands together explain, or of the changes of one of them
_LIKELY = 0.1  # score below which a pair is not offered: its model would be rejected
_COPY, _SAME = 0.97, 0.99  # correlations of signals that are offered once, that are the same
_AS_LIKELY = 0.8  # a copy is preferred for its stamps if it is as likely a command, or nearly
_ECHO = 0.9995  # of an input and what only repeats it
_SHIFTS = np.arange(-0.25, 0.2501, 0.025)  # s: by which a copy may be late
_TIE = 0.92  # factor if past and future explain the same: in a loop they nearly do
_CAUSAL = 0.1  # the past explains more than the future by so much, where that alone tells a plant
_LONG = 20.0  # s of overlap that are enough
_NO_HEADER = 0.97  # factor for stamps of the recording: among copies the stamped one is first
_APART = 0.97  # factor for different name spaces: among twins the pair of one robot is first
# nats that are told of a motion: half a proof. With 15 all of 25 tangled recordings are right,
# with 30 24 of them; PX4 in simulation begins with a torque with 10, 15, 20 and 30.
_TOLD = 15.0
_CERTAIN = 0.999  # most that is explained: echoes would tell without limit
_NEARER, _DRIVES = 0.8, 0.3  # what the command nearer to the plant has to explain of that before,
_BEHIND = 0.7  # and the factor for that before
_EFFECT_FIRST = 0.3  # for an output that begins to move before its input, if no name says more
_SIBLINGS, _CROWD = 2, 0.8  # others of its message that explain as much, and the factor for these


@dataclass(frozen=True)
class Pair:
    """
    An input and an output.

    Parameters
    ----------
    input, output : Candidate
    explained : Explained
    clock : Clock
        Of their values.
    frequencies : float
        Over how many lines the spectrum of the input is spread; NaN if not known.
    score : float
        The share of the output's motion that is explained, times factors of at most 1.
    nearer : str
        Topic of a command that this input drives, if that explains the output as well.
    """

    input: Candidate
    output: Candidate
    explained: Explained
    clock: Clock
    frequencies: float = float('nan')
    score: float = 0.0
    nearer: str = ''


@dataclass(frozen=True)
class Ranking:
    """
    What could be identified from a bag.

    Parameters
    ----------
    pairs : tuple of Pair
        The most promising first; of those that differ by copies of a signal only one.
    compared : tuple of Pair
        All that were looked at closely, with copies.
    found : tuple of Candidate
        All scalars that could be signals.
    clock : Clock
        Of their values.
    """

    pairs: tuple[Pair, ...]
    compared: tuple[Pair, ...]
    found: tuple[Candidate, ...]
    clock: Clock


def rank(bag: Bag, survey: Survey, named_inputs: Collection[Key] = (),
         named_outputs: Collection[Key] = ()) -> Ranking:
    """
    Rank the pairs of inputs and outputs of a bag.

    Parameters
    ----------
    bag : Bag
    survey : Survey
    named_inputs, named_outputs : collection of (str, str), optional
        Topics and fields that alone are to be inputs, outputs. Where both are given, all pairs of
        them are ranked, whatever the data say.

    Raises
    ------
    BagError
        If the bag cannot be read on.
    """
    found, clock = candidates(bag, survey, {*named_inputs, *named_outputs})
    found = _as_they_act(found, clock)
    spread = {c: effective_frequencies(c.held, clock) for c in found}
    lines = {c: effective_frequencies(c.smooth, clock) for c in found}
    inputs = [c for c in found if c.key in named_inputs] or sorted(
        (c for c in found if c.key not in named_outputs),
        key=lambda c: -c.acts * _enough(spread[c]))[:_MOST_INPUTS]
    outputs = [c for c in found if c.key in named_outputs] or sorted(
        (c for c in found if c.key not in named_inputs), key=lambda c: -c.measures)[:_MOST_OUTPUTS]
    listed = list(dict.fromkeys((*inputs, *outputs)))
    comparison = Comparison(clock, [c.smooth for c in listed]) if len(listed) > 1 else None
    chosen = bool(named_inputs and named_outputs)
    if comparison is None or not comparison.possible:
        pairs = [Pair(u, y, Explained(), clock, spread[u]) for u in inputs for y in outputs]
        return Ranking(tuple(pairs) if chosen else (), (), tuple(found), clock)
    if chosen:
        numbers = [listed.index(y) for y in outputs]
        pairs = [pair for u in inputs
                 for pair in _looked_at(u, listed, numbers, comparison, clock, spread[u],
                                   lines)]
        return Ranking(tuple(sorted(pairs, key=lambda p: -p.score)), tuple(pairs), tuple(found),
                       clock)
    shares = np.array([comparison.screened(u.held) for u in inputs])
    alike = Alike(listed, clock)
    pairs = [pair for i, chosen in _promising(inputs, listed, outputs, shares, alike,
                                         spread, lines)
             for pair in _looked_at(inputs[i], listed, chosen, comparison, clock,
                                    spread[inputs[i]], lines)]
    pairs = [replace(pair, score=in_order(pair) * pair.score) for pair in pairs]
    pairs = [_in_crowd(pair, pairs) for pair in pairs]
    pairs = [_behind(pair, pairs, listed, inputs, shares) for pair in pairs]
    pairs = [_same_motion(pair, pairs) for pair in pairs]
    pairs = sorted(pairs, key=lambda p: -p.score)
    likely = [p for p in pairs if p.score >= _LIKELY]
    return Ranking(tuple(_once(likely, alike)), tuple(pairs), tuple(found), clock)


def _as_they_act(found: list[Candidate], clock: Clock) -> list[Candidate]:
    """
    Return commands that are 0 where they are silent, if so they explain more of another topic.

    A driver stops a base when it hears no more, and a recording does not say so.
    """
    silent = [c for c in found if c.acts > c.measures
              and not np.array_equal(c.held, c.stopped, equal_nan=True)]
    comparison = Comparison(clock, [c.smooth for c in found] if silent else [])

    def told(c: Candidate, values: Array) -> float:
        others = [y.topic is not c.topic for y in found]
        return float(np.max(comparison.screened(values)[others], initial=0.0))
    return [replace(c, held=c.stopped) if c in silent and told(c, c.stopped) > told(c, c.held)
            else c for c in found]


class Further(NamedTuple):
    """Commands that move an output beside its inputs; shares of its motion, in unseen data."""

    kept: list[Candidate]
    without: float = 0.0                # what inputs explain without them, ...
    share: float = 0.0                  # ... and with them
    gone: tuple[Candidate, ...] = ()    # further ones, that explain little more


def further_commands(inputs: Sequence[Candidate], y: Candidate, ranking: Ranking) -> Further:
    """
    Return further commands that move an output.

    Of all commands of their own those go, one after the other, whose past explains little beside
    that of the others.
    """
    comparison = Comparison(ranking.clock, [y.smooth])
    if not comparison.possible:
        return Further([])

    def left(further: Sequence[Candidate]) -> float:
        """Return what is left by the inputs and further ones."""
        beside = [c.held for c in (*inputs[1:], *further)]
        return 1.0 - comparison.explained(inputs[0].held, [0], beside)[0].past

    kept = list(islice((c for c in _commands(ranking, inputs) if c is not y and not _told(
        c, inputs[0], y, ranking.clock)), _MOST_COMMANDS))
    each = tuple(kept)
    rest = alone = left([])
    while kept:
        rest, lost = left(kept), {}
        for c in kept:
            without = left([one for one in kept if one is not c])
            lost[c] = rest / max(min(_LEFT * without, without - _TOLD_MORE), 1e-300)
        if max(lost.values()) < 1.0:
            break
        # Of several that tell the same the last one goes.
        kept.remove(max(reversed(kept), key=lambda c: round(lost[c], 1)))
    return Further(kept, 1.0 - alone, 1.0 - (rest if kept else alone),
                   tuple(c for c in each if c not in kept))


def together_moved(ranking: Ranking, named_inputs: Collection[Key] = (),
                   named_outputs: Collection[Key] = ()) -> list[Pair]:
    """
    Return pairs of the outputs that all commands together explain, the most of it first.

    Each with the command that explains most of it alone, where no single one explains enough: of
    four wheels each tells a quarter of a base's motion.
    """
    commands = [c for c in _commands(ranking) if not named_inputs or c.key in named_inputs]
    outputs = [y for y in ranking.found if y.key in named_outputs] or [
        y for y in ranking.found if y not in commands and y.measures >= y.acts]
    commands = [c for c in commands if c not in outputs][:_MOST_COMMANDS]
    comparison = Comparison(ranking.clock, [y.smooth for y in outputs])
    if not commands or not outputs or not comparison.possible:
        return []
    alone = np.array([comparison.screened(c.held) for c in commands])
    found = comparison.explained(commands[0].held, range(len(outputs)),
                                 [c.held for c in commands[1:]])
    pairs = [Pair(c := commands[int(np.argmax(alone[:, j]))], y, comparison.explained(
        c.held, [j])[0], ranking.clock, score=one.past * y.measures)
        for j, (y, one) in enumerate(zip(outputs, found, strict=True)) if one.past >= _HALF]
    return sorted(pairs, key=lambda p: -p.score)


def _commands(ranking: Ranking, inputs: Sequence[Candidate] = ()) -> list[Candidate]:
    """Return what is named like a command, or held, the likeliest first; beside some inputs."""
    wanted = inputs and inputs[0].wanted
    return sorted((c for c in ranking.found if c not in inputs and not BATTERY.search(c.key[1])
                   and (c.acts > NEUTRAL or c.stays and c.acts >= c.measures)
                   and (wanted or not (c.wanted or c.set_point))), key=lambda c: -c.acts)


def _told(c: Candidate, u: Candidate, y: Candidate, clock: Clock) -> bool:
    """
    Whether an input and what an output was tell how a signal changes: it is none of its own.

    It repeats, filters or sums these, or a controller makes one of the other.
    """
    changes, was = np.diff(c.held, prepend=np.nan), np.append(np.nan, y.held[:-1])
    return Comparison(clock, [changes]).explained(u.held, [0], [was])[0].past >= _HALF


class Alike:
    """
    How far the signals of a list are copies of each other.

    They are compared where the slower one has a new sample: between those it only repeats.

    Parameters
    ----------
    listed : sequence of Candidate
    clock : Clock
    """

    def __init__(self, listed: Sequence[Candidate], clock: Clock) -> None:
        self._signals = np.nan_to_num(np.array([without_slow(c.held, clock) for c in listed]))
        self._numbers = {c: i for i, c in enumerate(listed)}
        self._fresh = [fresh_ticks(c.held) for c in listed]
        self._shifts = np.unique(np.round(_SHIFTS / clock.step).astype(int))
        self._known: dict[tuple[int, int], float] = {}

    def __call__(self, one: Candidate, other: Candidate) -> float:
        """Return the largest correlation of two, one shifted a little."""
        pair = sorted((self._numbers[one], self._numbers[other]),
                      key=lambda i: (len(self._fresh[i]), i))
        slow, fast = pair
        if slow == fast:
            return 1.0
        if (slow, fast) not in self._known:
            rows = self._fresh[slow]
            x, at = self._signals[slow][rows], np.add.outer(self._shifts, rows)
            y = self._signals[fast][np.clip(at, 0, len(self._signals[fast]) - 1)]
            size = np.sqrt(np.sum(x ** 2) * np.sum(y ** 2, axis=1))
            self._known[slow, fast] = float(np.max(np.abs(y @ x) / np.maximum(size, 1e-300)))
        return self._known[slow, fast]


def fresh_ticks(values: Array) -> NDArray[np.intp]:
    """Return the ticks at which a held signal has changed."""
    return np.flatnonzero(np.diff(values, prepend=np.nan) != 0) if len(values) else np.empty(
        0, np.intp)


def _promising(inputs: Sequence[Candidate], listed: Sequence[Candidate],
               outputs: Sequence[Candidate], shares: Array, alike: Alike,
               spread: Mapping[Candidate, float], lines: Mapping[Candidate, float]
               ) -> Iterator[tuple[int, list[int]]]:
    """Yield numbers of inputs, each with those of the outputs that are worth a closer look."""
    likely = []
    for i, u in enumerate(inputs):
        for j, y in enumerate(listed):
            score = _score(u, y, Explained(shares[i, j], shares[i, j], _both(u, y)),
                           min(spread[u], lines[y]))
            if y in outputs and score > 0.5 * _LIKELY and _apart(u, y, listed):
                likely.append((score, i, j))
    likely = sorted(likely, reverse=True)[:_MOST_PAIRS]
    for i, u in enumerate(inputs):
        chosen = [j for _, number, j in likely if number == i and alike(u, listed[j]) < _ECHO]
        if chosen:
            yield i, chosen


def _both(u: Candidate, y: Candidate) -> float:
    return max(min(u.last, y.last) - max(u.first, y.first), 0.0)


def _apart(u: Candidate, y: Candidate, listed: Sequence[Candidate]) -> bool:
    """
    Whether two scalars can be input and output.

    Those of one message are one sensor's, and know each other by kinematics, unless one of them
    is a force, or there is no other topic.
    """
    if u.key[0] != y.key[0]:
        return True
    forced = bool(FORCE_FIELD.search(plain(u.key[1]))) > bool(
        FORCE_FIELD.search(plain(y.key[1])))
    return u is not y and (forced or len({c.key[0] for c in listed}) == 1)


def _looked_at(u: Candidate, listed: Sequence[Candidate], chosen: Sequence[int],
               comparison: Comparison, clock: Clock, frequencies: float,
               lines: Mapping[Candidate, float]) -> list[Pair]:
    found = comparison.explained(u.held, chosen)
    return [Pair(u, listed[j], e, clock, frequencies,
                 _score(u, listed[j], e, min(frequencies, lines[listed[j]])))
            for j, e in zip(chosen, found, strict=True)]


def _score(u: Candidate, y: Candidate, found: Explained, lines: float) -> float:
    """Return the score of a pair whose spectra are both spread over so many lines."""
    first = float(np.clip(_TIE + 0.8 * (found.past - found.future), 0.2, 1.0))
    samples = found.overlap * (y.rate if u.acts > u.measures else min(u.rate, y.rate))
    if samples < FEWEST:
        return 0.0  # so few samples are explained by anything
    past = 1.0 - (1.0 - found.past) * (samples - 1) / (samples - STEPS - 1)  # adjusted R^2
    stamps = np.prod([1.0 if c.topic.stamp == 'header' else _NO_HEADER for c in (u, y)])
    spaces = [c.key[0].split('/')[1] for c in (u, y) if c.key[0].count('/') > 1]
    together = _APART if len(spaces) == 2 and spaces[0] != spaces[1] else 1.0
    told = -lines * np.log(1.0 - np.clip(found.past, 0.0, _CERTAIN))
    return float(max(past, 0.0) * first * min(found.overlap / _LONG, 1.0) * stamps * together
                 * _enough(told) * u.acts * y.measures)


def _enough(told: float) -> float:
    """Return how much of a proof it is if so much is told of a motion [nats]."""
    return told / (told + _TOLD)


def in_order(pair: Pair) -> float:
    """
    Return a factor for an output that moves before its input, where names do not tell.

    The first level of a command that is held acts from the beginning, though it moves later.
    """
    u, y = pair.input, pair.output
    told = u.acts * y.measures > y.acts * u.measures or (u.stays and not y.stays)
    return 1.0 if told or not begins_before(y.smooth, u.smooth) else _EFFECT_FIRST


def _in_crowd(pair: Pair, pairs: Sequence[Pair]) -> Pair:
    """Put one of several motors behind what commands them all."""
    siblings = [p for p in pairs if p.input.topic is pair.input.topic and p is not pair
                and p.output is pair.output
                and p.explained.past >= _NEARER * pair.explained.past]
    return replace(pair, score=_CROWD * pair.score) if len(siblings) >= _SIBLINGS else pair


def _behind(pair: Pair, pairs: Sequence[Pair], listed: Sequence[Candidate],
            inputs: Sequence[Candidate], shares: Array) -> Pair:
    """Put a setpoint or a stick behind the command that it drives, if that explains as much."""
    number = inputs.index(pair.input)
    for other in pairs:
        if (pair.input.wanted and not other.input.wanted
                and other.input.acts > other.input.measures
                and other.output.topic is pair.output.topic
                and other.explained.past >= _NEARER * pair.explained.past
                and shares[number, listed.index(other.input)] >= _DRIVES):
            return replace(pair, score=_BEHIND * pair.score, nearer=other.input.key[0])
    return pair


def _same_motion(pair: Pair, pairs: Sequence[Pair]) -> Pair:
    """
    Put two measurements of one motion behind what moves both: an angle explains its rate.

    They tell each other forwards as well as backwards, which a plant does only in a loop; and
    another input tells both of them from its past alone.
    """
    u, found = pair.input, pair.explained
    if one_way(found) or u.acts > u.measures:
        return pair
    moved = {p.input for p in pairs if p.output is u and one_way(p.explained)}
    both = any(p.input in moved and p.output is pair.output and one_way(p.explained)
               and p.explained.past >= _NEARER * found.past for p in pairs)
    return replace(pair, score=_BEHIND * pair.score) if both else pair


def one_way(found: Explained) -> bool:
    """Whether the past of an input tells clearly more than its future."""
    return found.past - found.future >= _CAUSAL


def _once(pairs: Sequence[Pair], alike: Alike) -> list[Pair]:
    """Return of the pairs that differ by copies the first only, those of siblings behind."""
    kept: list[Pair] = []
    siblings: list[Pair] = []
    for pair in pairs:
        same = [k for k in (*kept, *siblings) if alike(pair.output, k.output) > _COPY]
        twin = next((k for k in same if alike(pair.input, k.input) > _COPY), None)
        if twin:
            for own in (kept, siblings):
                own[:] = [_better_stamped(k, pair, alike) if k is twin else k for k in own]
            continue
        brother = any(k.input.topic is pair.input.topic for k in same)
        (siblings if brother else kept).append(pair)
    return [*kept, *siblings]


def _better_stamped(pair: Pair, twin: Pair, alike: Alike) -> Pair:
    """Return a pair, or that of a copy of its input with stamps of its own, but of no stick."""
    u, copy = pair.input, twin.input
    same = alike(u, copy) > _SAME and twin.output is pair.output
    likely = copy.acts >= _AS_LIKELY * u.acts and (u.wanted or not copy.wanted)
    stamped = copy.topic.stamp == 'header' != u.topic.stamp
    return replace(twin, score=pair.score) if same and likely and stamped else pair
