# SPDX-License-Identifier: Apache-2.0
"""`ctsid advise`: which experiment would make a model as accurate as it is wanted."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace

from ctsid_ros.progress import progress, working
from ctsid_ros.report.document import to_text
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    NO_MODEL,
    add_bag,
    add_changes,
    add_interval,
    add_params,
    add_style,
    better_pairs,
    config_for,
    interval_of,
    named,
    positive_seconds,
    run_of,
    tell,
)

HELP = 'show which further excitation a wanted accuracy of the poles needs'
EPILOG = ('example: ctsid advise flight.mcap --params params.yaml --wanted 2\n'
          '         (what it takes for standard deviations of 2 % of each pole)')


def percentage(text: str) -> float:
    """Parse a positive number of percent."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= 100.0:
        raise argparse.ArgumentTypeError(f'{text!r} is not a number of percent, more than 0 and '
                                         'at most 100')
    return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_bag(parser)
    add_params(parser)
    add_changes(parser)
    add_interval(parser)
    parser.add_argument('--wanted', type=percentage, default=5.0, metavar='PERCENT',
                        help='wanted standard deviation of each pole, relative to its size '
                        '[%%, default 5]')
    parser.add_argument('--more', type=positive_seconds, default=10.0, metavar='S',
                        help='how long further excitation would last [s, default 10]')
    add_style(parser)


def command(args: argparse.Namespace) -> int:
    """Read, identify, print."""
    from ctsid_core.advice.advice import advise
    from ctsid_core.identify import identify
    from ctsid_core.model.verdict import Remedy
    from ctsid_ros.recordings.bag import open_bag
    from ctsid_ros.recordings.playback import read_record
    from ctsid_ros.replay.clock import by_bag_clock, zero_ns
    from ctsid_ros.report.document import next_text
    from ctsid_ros.report.experiment import (
        accuracy_section,
        band_section,
        experiment_section,
        helps,
        verdict_section,
    )
    from ctsid_ros.report.headline import Better, headline

    with open_bag(args.bag, args.time) as bag:
        config = config_for(args, bag)
        with progress('reading', quiet=args.quiet) as advance:
            data = read_record(bag, config, interval_of(args), advance=advance)
        offset = (data.record.epoch_ns - zero_ns(bag, data.record.epoch_ns)) * 1e-9
    span = data.record.start + offset, data.record.end + offset
    with working('identifying a model', quiet=args.quiet):
        estimate = identify(data.record, config.settings)
    advice = advise(estimate, data.record, args.wanted / 100, args.more)
    told = by_bag_clock(estimate, estimate.start_ns - round(span[0] * 1e9))
    better = Better() if estimate.ok else better_pairs(args.bag, args.time, config)
    first = headline(told, run_of(args, span=span), better=better)
    if args.json:
        tell({'verb': 'advise', 'bag': named(args.bag), 'status': estimate.status.name,
              'accepted': estimate.ok, 'reason': told.verdict.reason,
              'next': first.command, **asdict(advice)})
    else:
        own = replace(advice, sentences=tuple(
            words for words in advice.sentences if words != estimate.verdict.reason))
        more = [accuracy_section(own), band_section(own),
                experiment_section(own, rejected=not estimate.ok)]
        print(to_text([verdict_section(told), *(more if helps(estimate, advice) else [])]))
        if not estimate.good and estimate.verdict.remedy is not Remedy.EXCITE:   # that is above
            print(f'\n{next_text(first)}')
    return ACCEPTED if estimate.ok else NO_MODEL
