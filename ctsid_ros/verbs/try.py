# SPDX-License-Identifier: Apache-2.0
"""`ctsid try`: all that a bag says about itself, in one go."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
import shlex
from typing import TYPE_CHECKING

from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    add_bag,
    add_budget,
    add_changes,
    add_pick,
    add_results,
    add_signals,
    add_style,
    bag_words,
    say,
    signal_words,
)

if TYPE_CHECKING:
    from ctsid_core.model.estimate import Estimate
    from ctsid_ros.config.channels import Config
    from ctsid_ros.recordings.guess import Guess

HELP = 'look at a bag, choose input and output, identify, and write the report'
EPILOG = """example: ctsid try flight.mcap
example: ctsid try run.csv --input voltage --output speed

Does what `ctsid info`, `ctsid init` and `ctsid identify` do one after the other. The input is used
where it excites the plant. The folder of results has the parameter file as well, to correct and
to go on with."""
PARAMS = 'params.yaml'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    add_signals(parser)
    add_pick(parser)
    add_changes(parser)
    add_budget(parser)
    add_results(parser)
    add_style(parser)


def command(args: argparse.Namespace) -> int:
    """Look, guess, identify, write, print."""
    from ctsid_core.model.storage import load_estimate, write_file
    from ctsid_ros.config.parameter_file import with_parameters
    from ctsid_ros.config.parameter_text import dump_brief
    from ctsid_ros.progress import working
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.guess import guess
    from ctsid_ros.recordings.guess_named import named
    from ctsid_ros.recordings.survey import survey
    from ctsid_ros.replay.results import MODEL, results_folder
    from ctsid_ros.report.document import to_text
    from ctsid_ros.verbs.info import stretch_section, topic_section
    from ctsid_ros.verbs.init import head, next_command, pair_section

    with open_bag(args.bag, args.time) as bag, working('looking at the bag', quiet=args.quiet):
        found = survey(bag)
        guessed = guess(bag, found, args.pick, named(found, args.input, args.output))
    guessed = replace(guessed, config=with_parameters(guessed.config, args.changes))
    if not args.json:
        print(to_text([topic_section(found, args.bag), pair_section(guessed),
                       stretch_section({', '.join(f'{c.topic} {c.field}' for c in
                                        guessed.config.inputs): guessed.stretches})]) + '\n')
    for reason in guessed.reasons:
        say(reason)
    with results_folder(args.out, args.bag, guessed.config.settings.method,
                        force=args.force) as out:
        params = out / PARAMS
        line = next_command(guessed, bag_words(args), str(params))

        def write(config: Config) -> None:
            write_file(params, (head(guessed, line) + dump_brief(config)).encode(), force=True)

        write(guessed.config)
        code = _identify(line, args, out, guessed)
        if code == ACCEPTED:
            write(_spanning(guessed.config, load_estimate(out / MODEL), found.duration))
    if not args.json and (code != ACCEPTED or _has_next(guessed)):
        print(_otherwise(guessed, args))
    return code


def _identify(line: str, args: argparse.Namespace, out: Path, guessed: Guess) -> int:
    """Run the command that `ctsid init` would have named."""
    from ctsid_ros.verbs import identify

    parser = argparse.ArgumentParser()
    identify.add_arguments(parser)
    words = [*shlex.split(line)[2:], '--out', str(out), '--force']
    words += ['--budget', str(args.budget)] if args.budget is not None else []
    own = parser.parse_args([*words, *('--json',) * args.json, *('--quiet',) * args.quiet])
    own.command_line = shlex.join(('ctsid', 'identify', *words))
    own.doubts = guessed.doubts
    own.whole = bool(guessed.stretches)
    return identify.command(own)


def _spanning(config: Config, estimate: Estimate, duration: float) -> Config:
    """Return the parameters, their windows long enough for the dead time that was found."""
    from ctsid_ros.recordings.guess import spanning

    delay = max(estimate.model.delay, default=0.0) if estimate.model else 0.0
    return replace(config, settings=spanning(config.settings, delay, duration))


def _has_next(guessed: Guess) -> bool:
    return guessed.free and guessed.pick < len(guessed.pairs)


def _otherwise(guessed: Guess, args: argparse.Namespace) -> str:
    """Return how to try with other signals, as a line."""
    if _has_next(guessed):
        words = ('ctsid', 'try', *bag_words(args), *signal_words(args),
                 '--pick', str(guessed.pick + 1))
        return f'The next pair of signals: {shlex.join(words)}'
    again = shlex.join(('ctsid', 'try', *bag_words(args)))
    return f'With signals of your own: {again} --input FIELD --output FIELD'
