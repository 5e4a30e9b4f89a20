# SPDX-License-Identifier: Apache-2.0
"""`ctsid init`: a parameter file to start from."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import shlex
import textwrap
from typing import TYPE_CHECKING

from ctsid_ros.report.tables import number
from ctsid_ros.report.words import cell, printable
from ctsid_ros.verbs.arguments import ACCEPTED, add_bag, bag_words, say

if TYPE_CHECKING:
    from ctsid_ros.recordings.guess import Guess

HELP = 'write a commented parameter file with a first guess of the channels'
EPILOG = 'example: ctsid init flight.mcap -o params.yaml'
_MOST_OTHERS = 30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    parser.add_argument('-o', '--output', metavar='FILE', default='-',
                        help='parameter file to write [default: standard output]')
    parser.add_argument('--force', action='store_true', help='replace the file if it exists')


def command(args: argparse.Namespace) -> int:
    """Guess, and write."""
    from ctsid_ros.config.parameter_text import dump_config
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.guess import guess
    from ctsid_ros.recordings.survey import survey

    with open_bag(args.bag, args.time) as bag:
        guessed = guess(survey(bag))
    name = 'params.yaml' if args.output == '-' else args.output
    text = _head(guessed, bag_words(args), name) + dump_config(guessed.config)
    if args.output == '-':
        print(text, end='')
        return ACCEPTED
    from ctsid_core.model.storage import write_file

    write_file(args.output, text.encode(), force=args.force)
    for reason in guessed.reasons:
        say(reason)
    say(f'wrote {args.output}; look it over, then run:\n  {_next(bag_words(args), name)}')
    return ACCEPTED


def _next(words: Sequence[str], name: str) -> str:
    return f'ctsid identify {shlex.join(words)} --params {shlex.quote(name)}'


def _head(guessed: Guess, words: Sequence[str], name: str) -> str:
    """Return comments: what was guessed and why, and what else moves."""
    lines = _comment('A first guess, to be corrected: which channels act on the robot (inputs) '
                     'and which are measured (outputs). Try it:')
    lines += ['#', f'#   {_next(words, name)}', '#']
    for reason in guessed.reasons:
        lines += _comment(f'- {reason[0].upper()}{reason[1:]}.')
    others = guessed.others[:_MOST_OTHERS]
    if others:
        lines += ['#', *_comment('These move as well (standard deviation in brackets):'), '#']
        lines += [f'#   {cell(topic)}  {cell(path)}  ({number(std, 3)})'
                  for topic, path, std in others]
        if len(guessed.others) > len(others):
            lines.append(f'#   ... and {len(guessed.others) - len(others)} more: ctsid info')
    return '\n'.join([*lines, '#', ''])


def _comment(text: str) -> list[str]:
    return textwrap.wrap(printable(text), 99, initial_indent='# ', subsequent_indent='# ',
                         break_long_words=False, break_on_hyphens=False)
