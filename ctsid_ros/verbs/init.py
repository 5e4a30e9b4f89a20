# SPDX-License-Identifier: Apache-2.0
"""`ctsid init`: a parameter file to start from."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import math
import re
import shlex
import sys
import textwrap
from typing import TYPE_CHECKING

from ctsid_ros.report.document import Bullets, Command, Section, to_text
from ctsid_ros.report.tables import Table, number
from ctsid_ros.report.words import cell, printable
from ctsid_ros.verbs.arguments import ACCEPTED, add_bag, add_pick, add_signals, bag_words, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ctsid_ros.recordings.guess import Guess
    from ctsid_ros.recordings.guess_ranking import Pair

HELP = 'write a parameter file with the most promising input and output of a bag'
EPILOG = """example: ctsid init flight.mcap -o params.yaml
         (shows the three best pairs, and writes the first)
example: ctsid init flight.mcap -o params.yaml --pick 2 --force
         (writes the second)
example: ctsid init log.ulg -o params.yaml --input 'vehicle_torque_setpoint xyz[0:3]'
                                           --output 'vehicle_angular_velocity xyz[0:3]'
         (writes these; only holds, stamps and windows are looked for)
example: ctsid init flight.mcap -o params.yaml --output '/imu angular_velocity.x'
         (shows and writes the inputs that explain this output best)

How the pairs are found, and what the columns mean: docs/choosing_signals.md."""
_MOST_OTHERS = 8
_QUOTED, _NO_BREAK = re.compile(r"(?<!\w)'[^']*'(?!\w)"), '\N{NO-BREAK SPACE}'
_BACKWARDS = (
    'Later input: what the input is after the output. No plant answers to that. Where it explains '
    'as much, a controller computes the input from the output (then move its set point), or the '
    'two are the wrong way round.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    parser.add_argument('-o', '--out', metavar='FILE', default='-',
                        help='parameter file to write [default: standard output]')
    add_signals(parser)
    parser.add_argument('--force', action='store_true', help='replace the file if it exists')
    add_pick(parser)


def command(args: argparse.Namespace) -> int:
    """Guess, show, and write."""
    from ctsid_ros.config.parameter_text import dump_brief
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.guess import guess
    from ctsid_ros.recordings.guess_named import named
    from ctsid_ros.recordings.survey import survey

    with open_bag(args.bag, args.time) as bag:
        found = survey(bag)
        for note in found.notes:
            say(note)
        guessed = guess(bag, found, args.pick, named(found, args.input, args.output))
    name = 'params.yaml' if args.out == '-' else args.out
    line = next_command(guessed, bag_words(args), name)
    text = head(guessed, line) + dump_brief(guessed.config)
    if args.out == '-':
        print(to_text([pair_section(guessed)]), file=sys.stderr)
        print(text, end='')
        return ACCEPTED
    from ctsid_core.model.storage import write_file

    write_file(args.out, text.encode(), force=args.force)
    print(to_text([pair_section(guessed), Section('', (
        f'Wrote {args.out} with {_taken(guessed)}; look it over, then run:',
        Command(line)))]))
    for reason in guessed.reasons:
        say(reason)
    return ACCEPTED


def next_command(guessed: Guess, bags: Sequence[str], params: str) -> str:
    """Return the command that identifies what was guessed, where the input excites it."""
    intervals = [word for s in guessed.best_stretches
                 for word in ('--interval', f'{s.start:.1f}:{s.end:.1f}')]
    return shlex.join(('ctsid', 'identify', *bags, '--params', params, *intervals))


def _taken(guessed: Guess) -> str:
    """Say what is in the file."""
    channels = (guessed.config.inputs, guessed.config.outputs)
    if guessed.free:
        return f'pair {guessed.pick}'
    return ' and '.join(f'{len(own)} {role}{"s" * (len(own) > 1)}'
                        for own, role in zip(channels, ('input', 'output'), strict=True))


def pair_section(guessed: Guess) -> Section:
    """Return the pairs that were found, with the figures behind them."""
    rows = tuple(_row(i, pair, any(pair is one for one in guessed.taken))
                 for i, pair in enumerate(guessed.pairs, 1))
    remarks = tuple(f'pair {i}: {cell(pair.input.key[0])} drives {cell(pair.nearer)}, which is '
                    'nearer to the plant' for i, pair in enumerate(guessed.pairs, 1)
                    if pair.nearer)
    return Section('Inputs and outputs, the most promising pair first', (
        Table(('pair', 'input', 'output', 'explained [%]', 'by later input [%]', 'coherence',
               'lag [s]', 'frequencies', 'both [s]', 'rates [Hz]'), rows, ('input', 'output')),
        *([Bullets(remarks)] if remarks else []), *([_BACKWARDS] if any(
            pair.explained.future >= pair.explained.past for pair in guessed.pairs) else [])))


def _row(index: int, pair: Pair, taken: bool) -> tuple[str, ...]:
    from ctsid_ros.recordings.coherence import lag, mean_coherence

    u, y, clock = pair.input, pair.output, pair.clock
    found = pair.explained
    return (f'{index}{" *" if taken else ""}', ' '.join(u.key), ' '.join(y.key),
            _whole(100 * found.past), _whole(100 * found.future),
            number(mean_coherence(u.held, y.smooth, clock), 2),
            number(lag(u.held, y.smooth, clock), 2), _whole(pair.frequencies),
            _whole(found.overlap),
            f'{number(u.rate, 3)} / {number(y.rate, 3)}')


def _whole(value: float) -> str:
    return '-' if math.isnan(value) else f'{value:.0f}'


def head(guessed: Guess, line: str) -> str:
    """Return comments: what was guessed and why, and what else moves."""
    lines = ['# A first guess, to be corrected. Try it:', '#', f'#   {printable(line)}', '#']
    for reason in guessed.reasons:
        lines += _comment(f'- {reason}.')
    for i, pair in enumerate(guessed.pairs, 1):
        if guessed.free and i != guessed.pick:
            lines += _comment(f'- Other pair (--pick {i}): {" ".join(pair.input.key)} -> '
                              f'{" ".join(pair.output.key)}' + (
                                  '.' if math.isnan(pair.explained.past) else
                                  f', {100 * pair.explained.past:.0f} % explained.'))
    others = guessed.others[:_MOST_OTHERS]
    if others:
        lines += ['#', '# These move as well (standard deviation in brackets):']
        lines += [f'#   {cell(topic)}  {cell(path)}  ({number(std, 3)})'
                  for topic, path, std in others]
        if len(guessed.others) > len(others):
            lines.append(f'#   ... and {len(guessed.others) - len(others)} more: ctsid info')
    return '\n'.join([*lines, '#', ''])


def _comment(text: str) -> list[str]:
    # What is quoted is to be copied: it stays in one line.
    whole = _QUOTED.sub(lambda found: found[0].replace(' ', _NO_BREAK), printable(text))
    lines = textwrap.wrap(whole, 99, initial_indent='# ', subsequent_indent='# ',
                          break_long_words=False, break_on_hyphens=False)
    return [line.replace(_NO_BREAK, ' ') for line in lines]
