# SPDX-License-Identifier: Apache-2.0
"""`ctsid info`: what is in a bag, how good its stamps are, and what moves."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
import shlex
from typing import TYPE_CHECKING, Any

from ctsid_ros.report.document import Bullets, Section, to_text
from ctsid_ros.report.overview import PAGE, lines
from ctsid_ros.report.tables import Table, number
from ctsid_ros.verbs.arguments import ACCEPTED, add_bag, add_style, bag_words, date, named, tell

if TYPE_CHECKING:
    from ctsid_ros.recordings.excited import Stretch
    from ctsid_ros.recordings.guess_candidates import Key
    from ctsid_ros.recordings.guess_ranking import Pair
    from ctsid_ros.recordings.survey import Survey, TopicSurvey
    from ctsid_ros.recordings.survey_stats import FieldStats, StampStats

    Offers = Sequence[tuple[Pair, Sequence[Stretch]]]

HELP = 'show topics, rates, stamps, fields that could be signals, and excited stretches'
EPILOG = """example: ctsid info flight.mcap
         ctsid info log.ulg --all     (hundreds of fields: more than the one page)"""
_MOST_FIELDS = 12  # of a topic, on the terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    parser.add_argument('--all', action='store_true', help='show every topic, stamp and field, '
                        'however many there are [default: one page]')
    add_style(parser, quiet=False)


def command(args: argparse.Namespace) -> int:
    """Look at the bag and print."""
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.guess import offered
    from ctsid_ros.recordings.survey import survey

    with open_bag(args.bag, args.time) as bag:
        found = survey(bag)
        pairs = offered(bag, found)
    if args.json:
        tell(_document(found, pairs, args.bag))
    else:
        sections = _sections if args.all or lines(found) <= PAGE else _brief
        print(to_text(list(sections(found, pairs, args))))
    return ACCEPTED


def _document(found: Survey, pairs: Offers, bags: list[str]) -> dict[str, Any]:
    topics = [{'name': t.info.name, 'type': t.info.type, 'count': t.info.count,
               'has_header': t.info.has_header, 'rate': t.rate, 'first': t.first, 'last': t.last,
               'stamp': t.stamp if t.stamps else None, 'late': t.late,
               'stamps': [asdict(s) for s in t.stamps], 'fields': [asdict(f) for f in t.fields],
               'undecodable': t.undecodable, 'note': t.note} for t in found.topics]
    return {'verb': 'info', 'bag': bags, 'duration': found.duration, 'start_ns': found.start_ns,
            'messages': found.messages, 'covered': found.covered, 'topics': topics,
            'stretches': [{'input': key, **asdict(s)} for key, own in _by_input(pairs).items()
                          for s in own], 'notes': list(found.notes)}


def topic_section(found: Survey, bags: list[str]) -> Section:
    """Return what a bag is, its topics, and what is odd about it or was guessed."""
    return Section(_title(found, bags), (_topics(found.topics), *_notes(found)))


def _notes(found: Survey) -> tuple[Bullets, ...]:
    return (Bullets(found.notes),) if found.notes else ()


def _title(found: Survey, bags: list[str]) -> str:
    begun = date(found.start_ns)
    return f'{named(bags)}: {found.duration:.1f} s, {found.messages} messages' \
        + (f', recorded {begun}' if begun else '')


def stretch_section(stretches: Mapping[str, Sequence[Stretch]]) -> Section:
    """Return where some inputs, or several together, excite the plant."""
    rows = tuple((name, f'{s.start:.1f}:{s.end:.1f}', f'{s.end - s.start:.1f}',
                  number(s.power, 2), f'{100 * s.energy:.0f}')
                 for name, own in stretches.items() for s in own)
    return Section('Stretches worth identifying (--interval START:END)', (Table(
        ('input', 'interval [s]', 'length [s]', 'power over quiet', 'energy [%]'), rows,
        ('input',)),) if rows else ())


def _by_input(pairs: Offers) -> dict[Key, Sequence[Stretch]]:
    """Return the stretches of each input."""
    return {pair.input.key: own for pair, own in reversed(pairs)}


def _by_name(pairs: Offers) -> dict[str, Sequence[Stretch]]:
    """Return them by topic and field."""
    return {' '.join(key): own for key, own in _by_input(pairs).items()}


def _brief(found: Survey, pairs: Offers, args: argparse.Namespace) -> Iterable[Section]:
    """Yield what matters of a recording with hundreds of fields."""
    from ctsid_ros.recordings.guess_candidates import FEWEST, likely_roles
    from ctsid_ros.report.overview import overview

    likely = {t.info.name: max(max(likely_roles(t, f.field)) for f in t.moving)
              for t in found.topics if t.moving and t.info.count >= FEWEST}
    used = [c.key[0] for pair, _ in pairs for c in (pair.input, pair.output)]
    yield from overview(found, _title(found, args.bag), used,
                        sorted(likely, key=lambda name: -likely[name]))
    yield Section('', _notes(found))
    yield stretch_section(_by_name(pairs))
    yield from _end(_torn(found), found, args)


def _torn(found: Survey) -> list[str]:
    return [f'{t.info.name}: {t.undecodable} messages cannot be decoded or lack some fields '
            f'({t.reason})'
            for t in found.topics if t.undecodable]


def _end(notes: Sequence[str], found: Survey, args: argparse.Namespace) -> Iterable[Section]:
    """Yield what is left to say, and what to do next."""
    yield Section('Notes', (Bullets(tuple(notes)),) if notes else ())
    yield Section('', (f'Next: ctsid init {shlex.join(bag_words(args))} -o params.yaml',)
                  if any(t.moving for t in found.topics) else ())


def _sections(found: Survey, pairs: Offers, args: argparse.Namespace) -> Iterable[Section]:
    yield topic_section(found, args.bag)
    stamps = [(t, s) for t in found.topics for s in t.stamps]
    if stamps:
        yield Section('Time stamps (`stamp: auto` takes the first usable one of a topic)',
                      (Table(('topic', 'source', 'usable', 'period [ms]', 'jitter [ms]', 'gaps',
                              'longest [ms]', 'backward', 'repeated', 'remark'),
                             tuple(_stamp_row(t, s) for t, s in stamps),
                             ('topic', 'source', 'usable', 'remark')),))
    most = None if args.all else _MOST_FIELDS
    moving = [(t, f) for t in found.topics for f in t.moving[:most]]
    if moving:
        more = [f'{t.info.name}: {len(t.moving) - _MOST_FIELDS} more fields move (--all shows '
                'them)' for t in found.topics if most and len(t.moving) > most]
        yield Section('Fields that move', (Table(
            ('topic', 'field', 'min', 'max', 'mean', 'std', 'remark'),
            tuple(_field_row(t, f) for t, f in moving), ('topic', 'field', 'remark')),
            *([Bullets(tuple(more))] if more else [])))
    else:
        yield Section('No field moves: there is nothing to identify from', ())
    yield stretch_section(_by_name(pairs))
    still = [f'{t.info.name}: {len(quiet)} more do not move'
             for t in found.topics if (quiet := [f for f in t.fields if not f.moves])]
    yield from _end([*still, *_torn(found)], found, args)


def _topics(topics: Iterable[TopicSurvey]) -> Table:
    rows = tuple((t.info.name, t.info.type, str(t.info.count), number(t.rate, 4),
                  number(t.first, 3), number(t.last, 4), t.note) for t in topics)
    return Table(('topic', 'type', 'messages', 'rate [Hz]', 'first [s]', 'last [s]', 'remark'),
                 rows, ('topic', 'type', 'remark'))


def _stamp_row(topic: TopicSurvey, s: StampStats) -> tuple[str, ...]:
    remark = s.why
    if s.source == 'header' and topic.late == topic.late:  # not NaN
        remark = '; '.join(filter(None, (
            remark, f'recorded {number(1e3 * topic.late, 3)} ms later (median)')))
    return (topic.info.name, s.source, 'yes' if s.usable else 'NO', _ms(s.period), _ms(s.jitter),
            str(s.gaps), _ms(s.longest), str(s.backward), str(s.repeated), remark)


def _ms(value: float) -> str:
    return number(1e3 * value, 3)


def _field_row(topic: TopicSurvey, f: FieldStats) -> tuple[str, ...]:
    remarks = [text for is_so, text in (
        (f.white, 'looks like noise alone'),
        (f.finite < 1, f'{100 * (1 - f.finite):.1f} % not finite')) if is_so]
    return (topic.info.name, f.field, *(number(v, 4) for v in (f.low, f.high, f.mean, f.std)),
            ', '.join(remarks))
