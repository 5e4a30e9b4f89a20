# SPDX-License-Identifier: Apache-2.0
"""
A first guess of channels, for people to correct: the best pair of `guess_ranking.py`, or another.

Where no pair stands out, what steps and names and types of messages decide alone, and the guess
says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
import math
import re
import shlex

import numpy as np

from ctsid_core.settings import Settings
from ctsid_core.signals.wrapped import jumps_in_words
from ctsid_ros.config.channels import RESERVED, Channel, Config, Role
from ctsid_ros.decoding.field_path import FieldPath, parse_field, plain
from ctsid_ros.decoding.names import title
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import Bag
from ctsid_ros.recordings.excerpts import unit_of_time
from ctsid_ros.recordings.excited import Stretch, excited, pace, together
from ctsid_ros.recordings.guess_candidates import Candidate
from ctsid_ros.recordings.guess_named import NOBODY, Named
from ctsid_ros.recordings.guess_pairs import Explained
from ctsid_ros.recordings.guess_ranking import (
    Pair,
    Ranking,
    further_commands,
    in_order,
    one_way,
    rank,
    together_moved,
)
from ctsid_ros.recordings.survey import CLOCKS, DECODED, Survey, TopicSurvey
from ctsid_ros.recordings.survey import survey as look_at

OFFERED = 3  # pairs that are shown
_BEST_NAMED = 48  # pairs of which it is looked which signal begins to move first
_MOST_STRETCHES = 3  # that are identified from: more take long and tell little more
_BY_NAMES = ('the data alone do not tell which signal is the input, for the recording is short, '
             'little moves, or a controller acts: the channels are guessed by what steps, their '
             'names, what moves first, and their order: check them, and whether there is an '
             'experiment')
_FEW_LEVELS = 12  # of a command that steps; a measurement that repeats itself has more
# Outputs that may answer at once: of an accelerometer, as ROS, PX4, ArduPilot and people name it.
_AT_ONCE = re.compile('accel|acc_?[xyz]?$', re.IGNORECASE)
_CLEARLY = 0.1  # of the score: a pair that is better by less is no other story
_MOSTLY = 0.9  # of what is explained: more, and no other input is missed
_FEW = 2  # commands that are named though they explain little: of a dozen nobody asks for all
_SEEN = 0.01  # of what is explained: less is nothing
_AS_WELL = 0.5  # of what is explained of an output: another one of the same plant
_DELAYS = 6.0  # so many a window is long: of five the first one, without history, may miss it
_FEEBLE = 0.05  # of the energy of an input: a stretch with less adds more noise than knowledge
# Packages whose messages are in SI units, by their definition; accelerations have other fields.
# A JointState does not tell whether its joints turn or slide.
_SAYS_UNIT = re.compile('(ackermann|geometry|nav|sensor)_msgs/msg/(?!Accel)')
_UNITS = (('angular_velocity', 'rad/s'), ('linear_acceleration', 'm/s^2'), ('torque', 'N m'),
          ('force', 'N'), (r'angular\.', 'rad/s'), (r'linear\.', 'm/s'), ('euler', 'rad'),
          (r'position\.[xyz]$', 'm'), ('steering_angle', 'rad'), ('speed$', 'm/s'))


@dataclass(frozen=True)
class Guess:
    """
    A first guess.

    Parameters
    ----------
    config : Config
    pairs : tuple of Pair
        What was to be chosen from, the best first.
    pick : int
        Which of them was taken, from 1.
    reasons : tuple of str
        A sentence on each thing that was decided, or is doubtful.
    others : tuple of (topic, field, standard deviation)
        What moves as well and was not chosen.
    stretches : tuple of Stretch
        Where the input excites the plant; empty if it does so all the time.
    free : bool
        Whether something was chosen from the pairs; else all of them were named.
    doubts : tuple of str
        Why inputs may be outputs, if the data do not tell, and which may be missing: for the
        report, too.
    """

    config: Config
    pairs: tuple[Pair, ...]
    pick: int
    reasons: tuple[str, ...]
    others: tuple[tuple[str, str, float], ...]
    stretches: tuple[Stretch, ...]
    free: bool = True
    doubts: tuple[str, ...] = ()

    @property
    def pair(self) -> Pair:
        """The pair that was taken."""
        return self.pairs[self.pick - 1]

    @property
    def taken(self) -> tuple[Pair, ...]:
        """The pairs of which the channels are: the one that was taken, or all that were named."""
        return (self.pair,) if self.free else self.pairs

    @property
    def best_stretches(self) -> tuple[Stretch, ...]:
        """The stretches to identify from: those with most energy, in order of time."""
        best = sorted(self.stretches, key=lambda s: -s.energy)[:_MOST_STRETCHES]
        return tuple(s for s in self.stretches if s in best and s.energy > _FEEBLE)


def guess(bag: Bag, survey: Survey, pick: int = 1, named: Named = NOBODY) -> Guess:
    """
    Choose channels and windows for a bag.

    Parameters
    ----------
    bag : Bag
    survey : Survey
        Of this bag.
    pick : int, optional
        Which of the offered pairs to take, from 1.
    named : Named, optional
        The inputs, outputs or both that are wanted; only what is not named is chosen.

    Raises
    ------
    BagError
        If fewer than two scalars move in it, or there are not so many pairs.
    """
    ranking = rank(bag, survey, named.inputs, named.outputs)
    if named.inputs and named.outputs:
        if not ranking.pairs:
            raise BagError('an input and an output have to be different fields')
        pairs, count, by_names = ranking.pairs, 1, False
    else:
        by_names = not ranking.pairs
        pairs = _one_each(ranking.pairs or tuple(together_moved(ranking, *named)), named)[
            :OFFERED] or _by_names(ranking, survey, named)
        count = len(pairs)
    if pick > count:
        raise BagError(f'there {"is" if count == 1 else "are"} only {count} to pick '
                       'from; `ctsid init` without --pick shows them')
    return _spanning_lags(_guess(ranking, survey, pairs, pick, by_names, named), survey.duration)


def _spanning_lags(guessed: Guess, duration: float) -> Guess:
    """Return a guess whose windows are long beside the lags of its outputs, as they are shown."""
    from ctsid_ros.recordings.coherence import lag

    # No dead time is longer than how much later both are most alike.
    late = max(lag(p.input.held, p.output.smooth, p.clock) for p in guessed.taken)
    config = guessed.config
    return replace(guessed, config=replace(
        config, settings=spanning(config.settings, late, duration)))


def offered(bag: Bag, survey: Survey) -> list[tuple[Pair, tuple[Stretch, ...]]]:
    """
    Return the pairs that are offered for a bag, the best first, and where their inputs move.

    Parameters
    ----------
    bag : Bag
    survey : Survey
        Of this bag.

    Raises
    ------
    BagError
        If the bag cannot be read on.
    """
    return [(p, together([excited(p.input.held, p.clock, 1 / p.output.rate, [p.output.smooth])]))
            for p in rank(bag, survey).pairs[:OFFERED]]


def _one_each(pairs: tuple[Pair, ...], named: Named) -> tuple[Pair, ...]:
    """Return one pair for each signal that is to be chosen, where the others are named."""
    if named == NOBODY:
        return pairs
    return tuple({(p.output if named.inputs else p.input): p for p in reversed(pairs)}.values()
                 )[::-1]


def better(bag: Bag, config: Config) -> list[Pair]:
    """
    Return pairs of which the data of a bag say clearly more than of those of a config.

    Those with the same outputs, if there are any; else those with the same inputs; else others.

    Raises
    ------
    BagError
        If the bag cannot be read on.
    """
    ranking = rank(bag, look_at(bag))
    inputs, outputs = (by_names(bag, scalars(own)) for own in (config.inputs, config.outputs))
    used = max((p.score for p in ranking.compared if p.input.key in inputs
                and p.output.key in outputs), default=0.0)
    found = [p for p in ranking.pairs if p.score > used + _CLEARLY]
    asked = [p for p in found if p.output.key in outputs] \
        or [p for p in found if p.input.key in inputs] or found
    return asked[:OFFERED]


def scalars(channels: Sequence[Channel]) -> set[tuple[str, str]]:
    """Return topic and field of each scalar of some channels."""
    return {(c.topic, str(path)) for c in channels for path in (
        [FieldPath(c.path.steps, (part,)) for part in c.path.euler]
        or [FieldPath(leaf) for leaf in c.path.leaves])}


def by_names(bag: Bag, keys: Iterable[tuple[str, str]]) -> set[tuple[str, str]]:
    """Return topics and fields as guesses have them: by name where messages have names."""
    found = set()
    for topic, field in keys:
        named = {index: str(path) for path, index in bag.named_fields(topic, DECODED).items()}
        found.add((topic, named.get(field, field)))
    return found


def _guess(ranking: Ranking, survey: Survey, pairs: tuple[Pair, ...], pick: int, by_names: bool,
           named: Named) -> Guess:
    pair = pairs[pick - 1]
    found = {c.key: c for c in ranking.found}
    inputs = [found[key] for key in named.inputs] or [pair.input]
    outputs = [found[key] for key in named.outputs] or [pair.output]
    taken = [pair]
    for y in outputs if named.outputs and not named.inputs else ():     # each has to follow one
        likely = [p for p in ranking.pairs if p.output is y and p.input not in outputs]
        if likely and not any(p.input in inputs for p in likely):
            taken.append(likely[0])
            inputs.append(likely[0].input)
    chosen = not (named.inputs or pair.input.wanted or pair.input.set_point)
    further, beside, little = _further_commands(inputs, outputs, ranking, chosen)
    by_names &= not further and named == NOBODY
    if further or len(taken) > 1:       # in the order of the recording
        inputs = [c for c in ranking.found if c in (*inputs, *further)]
    reasons = [f'{_BY_NAMES}; {_turned(pair)}'] if by_names else [
        *map(_why, taken), *_followed(pair, ranking.found), *(
            () if named.outputs else _further_outputs(pair, pairs, ranking.compared, inputs))]
    reasons += [*beside, *little]
    period = max(1 / y.rate for y in outputs)
    unit = max(unit_of_time(period), *(pace(u.held, ranking.clock) for u in inputs))
    config = Config(_channels(inputs, outputs, reasons), _settings(survey, outputs, unit))
    others = tuple((*c.key, c.field.std) for c in ranking.found
                   if c not in inputs and c not in outputs)
    return Guess(config, pairs, pick, tuple(reasons), others,
                 together([excited(u.held, ranking.clock, period, [y.smooth for y in outputs])
                           for u in inputs]),
                 free=not (named.inputs and named.outputs),
                 doubts=(*reasons[:by_names], *beside))


def _why(pair: Pair) -> str:
    found = pair.explained
    if math.isnan(found.past):
        return (f'the recording is too short to compare {words(pair.input)} and '
                f'{words(pair.output)} by their motion')
    sentence = (f'{words(pair.input)} explains {100 * found.past:.0f} % of the variance of '
                f'{words(pair.output)}, from its past and in data held out')
    return sentence if found.past > found.future or found.future < _SEEN else (
        f'{sentence}; but its future would explain {100 * found.future:.0f} %: a loop may be '
        f'closed around them, or the roles are the other way round; {_turned(pair)}')


def _further_commands(inputs: Sequence[Candidate], outputs: Sequence[Candidate],
                      ranking: Ranking, chosen: bool
                      ) -> tuple[list[Candidate], list[str], list[str]]:
    """
    Return further inputs, say which commands move an output, too, and which explain little more.

    One that is left out bends what is found of the others: where inputs are to be chosen all are.
    Where they are named, or a set point, it is said how to get one model of all.
    """
    ranking = replace(ranking, found=tuple(c for c in ranking.found if c not in outputs))
    found, said, little = list[Candidate](), list[str](), list[str]()
    for y in outputs:
        others, without, share, gone = further_commands([*inputs, *found], y, ranking)
        if chosen and len(outputs) == 1 and 0 < len(gone) <= _FEW and share < _MOSTLY:
            little.append(
                f'{", ".join(map(words, gone))} would explain little more of {words(y)}, and not '
                'all that moves it is explained; to take what is known to move it: '
                f'{_said([*inputs, *others, *gone], [y])}')
        if others:
            it = 'it' if len(others) == 1 else 'them'
            told = (f'{", ".join(map(words, others))} move{"s" * (it == "it")} {words(y)}, too: '
                    f'{100 * share:.0f} % of its variance are explained with {it}, '
                    f'{100 * without:.0f} % without; ')
            said.append(told + (
                f'all are inputs; without {it}: {_said([*inputs, *found], outputs)}' if chosen
                else f'one model of all: {_said([*inputs, *others], outputs)}'))
            found += others if chosen else []
    return found, said, little


def _said(inputs: Sequence[Candidate], outputs: Sequence[Candidate]) -> str:
    """Return the words that name some inputs and outputs."""
    return shlex.join(word for flag, signals in (('--input', inputs), ('--output', outputs))
                      for one in signals for word in (flag, words(one)))


def _further_outputs(pair: Pair, pairs: Sequence[Pair], compared: Sequence[Pair],
                     inputs: Sequence[Candidate]) -> list[str]:
    """Say how to get one model of all the outputs that inputs move, if they are several."""
    outputs = [p.output for p in pairs if p.input in inputs
               and p.output.acts <= p.output.measures and not _drives(p.output, compared)
               and p.explained.past >= _AS_WELL * pair.explained.past]
    who = f'{", ".join(map(words, inputs))} move{"s" * (len(inputs) == 1)}'
    return [f'{who} {len(outputs)} outputs; one model of them all: '
            + _said(inputs, outputs)] if len(outputs) > 1 else []


def _drives(signal: Candidate, pairs: Sequence[Pair]) -> bool:
    """Whether a signal moves another one, from its past alone, as a controller's command does."""
    return any(p.input is signal and one_way(p.explained) for p in pairs)


def _followed(pair: Pair, found: Sequence[Candidate]) -> list[str]:
    """Say that a set point is one, and which commands there are."""
    if not pair.input.set_point:
        return []
    commands = sorted((c for c in found if c.acts > c.measures and c is not pair.output
                       and not c.set_point),
                      key=lambda c: -c.acts)
    named = '; of the plant alone it is from the command that acts on it' + ''.join(
        f': {_said([c], [pair.output])}' for c in commands[:1])
    return [f'{words(pair.input)} is named like a set point: the model is of the closed loop, '
            f'controller and plant{named}']


def _turned(pair: Pair) -> str:
    """Return how to take a pair the other way round."""
    return f'to turn it round: {_said([pair.output], [pair.input])}'


def words(signal: Candidate) -> str:
    """Return topic and field."""
    return ' '.join(signal.key)


def _by_names(ranking: Ranking, survey: Survey, named: Named) -> tuple[Pair, ...]:
    """Return pairs where the data do not say: what is named like a command, a measurement."""
    found = ranking.found
    inputs, outputs = ([c for c in found if c.key in own]
                       or [c for c in found if c.key not in rest]
                       for own, rest in (named, named[::-1]))
    stepping = {c for c in found if c.stays and len(np.unique(
        c.held[np.isfinite(c.held)])) <= _FEW_LEVELS}

    def order(pair: Pair, factor: float = 1.0) -> tuple[bool, bool, bool, float, float]:
        return (pair.output in stepping, pair.input.key[0] == pair.output.key[0],
                pair.output.field.white, -factor * pair.input.acts * pair.output.measures,
                -pair.score)

    compared = {(p.input, p.output): p for p in ranking.compared}
    likely = sorted((compared.get((u, y)) or Pair(u, y, Explained(), ranking.clock)
                     for u in inputs for y in outputs if u is not y), key=order)[:_BEST_NAMED]
    pairs = sorted(likely, key=lambda p: order(p, in_order(p)))
    if not pairs:
        raise BagError('a model needs an input and an output that move, but '
                       + _what_moves(found, survey) + '; `ctsid info` shows what is there')
    return _one_each(tuple(pairs), named)[:OFFERED]


def _what_moves(found: Sequence[Candidate], survey: Survey) -> str:
    if found:
        return (f'only {found[0].key[1]} of {found[0].key[0]} does (a step before the first '
                'sample is not seen: the recording has to begin before it)')
    if not survey.duration:
        return 'all messages were recorded at one instant: the clock of the recorder stood'
    moving = [(t, f.field) for t in survey.topics for f in t.moving]
    few = ', '.join(f'{field} of {topic.info.name} ({topic.info.count} messages)'
                    for topic, field in moving[:4])
    return f'what changes is a switch, a clock or too short: {few}' if few else \
        'nothing in this bag does'


def _channels(inputs: Sequence[Candidate], outputs: Sequence[Candidate], reasons: list[str]
              ) -> tuple[Channel, ...]:
    both = [*inputs, *outputs]
    late = [c.topic.late if c.topic.stamp == 'header' else 0.0 for c in both]
    apart = max(late) - min(late) > CLOCKS
    if apart:
        reasons.append('the stamps in headers are not all of one clock, or not all messages have '
                       'one: all stamps are those of the recording')
    unusable = dict.fromkeys((c.topic.info.name, c.topic.stamps[0].why) for c in both
                             if c.topic.unusable)
    reasons += [f'the stamps in the headers of {topic} are not used, for {why}: its stamps are '
                'those of the recording' for topic, why in unusable if not apart]
    taken: set[str] = set()
    roles: list[tuple[Candidate, Role]] = [*((c, 'input') for c in inputs),
                                           *((c, 'output') for c in outputs)]
    channels = [Channel(_name(c.topic, c.key[1], taken), role, c.key[0], c.topic.info.type,
                        c.key[1], _unit(c), stamp='log' if apart or c.topic.unusable else 'auto',
                        turn=c.wraps[0]) for c, role in roles]
    reasons += [f'{words(c)} jumps {jumps_in_words(*c.wraps)}: it is unwrapped '
                f'(`{channel.name}.turn: {channel.turn!r}`; 0.0 would leave it as it is)'
                for channel, c in zip(channels, both, strict=True) if channel.turn]
    return tuple(replace(channel, hold='smooth') if channel.role == 'input'
                 and _is_measured(c, outputs) else channel
                 for channel, c in zip(channels, both, strict=True))    # else held


def _is_measured(u: Candidate, outputs: Sequence[Candidate]) -> bool:
    """Whether an input is no command that is held, but measured as the outputs are."""
    # A row of a table has the command that the controller made of it, and a message what was seen.
    logged = u.topic.info.type.startswith('table/') and u.acts > u.measures
    return not u.stays and not logged and (
        u.acts < u.measures or any(u.topic is y.topic for y in outputs))


def _name(topic: TopicSurvey, text: str, taken: set[str]) -> str:
    """Return a short name for a field that is not taken yet."""
    last = re.sub(r'\W+', '_', topic.info.name.strip('/').rpartition('/')[2]) or 'channel'
    words = re.findall(r'[A-Za-z_]\w*|\d+', text.replace('euler', ''))
    named = next((i for i in range(len(words) - 2, 0, -1) if not words[i].isdigit()), 0)
    short = words[-1] if 'euler' in text else '_'.join(words[named:])
    few = len(short) < 3 and not topic.info.type.startswith('table/')
    if short.startswith('data') or few:
        short = f'{last}_{words[-1]}'
    name = re.sub(r'\W+', '_', title(parse_field(text)) or short, flags=re.ASCII)
    name = f'_{name}' if name[0].isdigit() else name
    candidates = [name, f'{last}_{name}', *(f'{name}_{i}' for i in range(2, 1000))]
    name = next(c for c in candidates if c not in taken and c not in RESERVED)
    taken.add(name)
    return name


def _unit(signal: Candidate) -> str:
    """Return the unit that a title or a message type says; a mere name may be in any."""
    kind, text = signal.topic.info.type, plain(signal.key[1])
    if signal.unit or not (signal.path.euler or _SAYS_UNIT.match(kind)):
        return signal.unit
    return next((unit for pattern, unit in _UNITS if re.search(pattern, text)), '')


def _settings(survey: Survey, outputs: Sequence[Candidate], unit: float) -> Settings:
    """Return windows to start with: a tenth of the bag, 10 to 60 units of time."""
    length = min(max(survey.duration / 10.0, 10.0 * unit), 60.0 * unit, survey.duration / 2.0)
    return _windows(Settings(feedthrough=any(_AT_ONCE.search(plain(y.key[1])) for y in outputs)),
                    length)


def spanning(settings: Settings, late: float, duration: float) -> Settings:
    """Return settings whose windows span a dead time [s] often enough, as far as a bag lasts."""
    length = min(_DELAYS * late, duration / 2.0)
    return _windows(settings, length) if length > settings.window_length else settings


def _windows(settings: Settings, length: float) -> Settings:
    length = max(float(f'{length:.2g}'), 0.01)
    return settings.replace(window_length=length,
                            window_stride=float(f'{max(length / 10.0, 0.001):.2g}'))
