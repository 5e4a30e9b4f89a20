# SPDX-License-Identifier: Apache-2.0
"""
The command `ctsid`.

stdout carries the result, stderr everything else. Exit codes: 0 a model was accepted, GOOD or
WEAK (or there was nothing to accept), 1 it could not run, 2 usage, 3 it ran but no model is
acceptable, 130 interrupted (the results so far are written).
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
from typing import TYPE_CHECKING

from ctsid_ros.blas import use_one_thread

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence
    from types import FrameType

use_one_thread()  # before NumPy is imported, hence here and not in main()

VERBS = ('info', 'init', 'try', 'identify', 'replay', 'batch', 'simulate', 'advise', 'compare',
         'study', 'show', 'export', 'plot', 'watch', 'params')  # modules of ctsid_ros.verbs
_EPILOG = """first steps:
  ctsid try BAG                               all of the next three in one go
  ctsid info BAG                              what is in it
  ctsid init BAG -o params.yaml               the most promising input and output, to edit
  ctsid identify BAG --params params.yaml     one model of the whole bag
  ctsid replay BAG --params params.yaml       models in sliding windows along it
  ctsid batch BAGS --params P.yaml --out DIR  many bags, each by itself, and a page over all
  ctsid simulate MODEL OTHER_BAG              how well a model simulates another bag
  ctsid export MODEL --to c --rate 200 -o F.c the model as C, .mat, Simulink, YAML, ...
  ctsid advise BAG --params params.yaml       which excitation a better model needs
  ctsid compare BAG --params params.yaml      all methods and orders; or models: A B BAG
  ctsid plot MODEL... -o models.pdf           models in one figure
  ctsid watch                                 what a running node hears and finds, live
  ctsid params                                every parameter with its meaning
  ctsid study hd-vs-ct                        the published Monte Carlo study, repeated

exit codes: 0 model accepted, 1 could not run, 2 usage, 3 no acceptable model, 130 interrupted

The words of the reports (fit, verdict, response std, ...) are explained in docs/glossary.md."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; return the exit code."""
    if argv is not None:
        return _run(argv)
    if sys.platform != 'win32' and signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, _leave)
    try:
        from ctsid_ros.interrupts import interruptible  # before all that takes long to load

        with interruptible():
            return _run(sys.argv[1:])
    except KeyboardInterrupt:  # too early, or too late, to be told
        return 130


def _leave(number: int, frame: FrameType | None) -> None:
    """End the program at once: an exception could be swallowed while modules are imported."""
    os._exit(130)


def _run(argv: Sequence[str]) -> int:
    import io

    from ctsid_core.errors import CtsidError
    from ctsid_ros.errors import lacks_bag_package

    if argv and not argv[0].startswith('-') and argv[0] not in VERBS:
        return _unknown(argv[0])
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal that has no ± shows a ?
        sys.stdout.reconfigure(errors='replace')
    try:
        if not argv:
            _parser(argv).print_help(sys.stderr)
            return 2
        args = _parser(argv).parse_args(argv)
        args.command_line = shlex.join(('ctsid', *argv))
        code: int = args.command(args)
        sys.stdout.flush()
    except SystemExit as stop:  # argparse has printed why
        return stop.code if isinstance(stop.code, int) else 2
    except KeyboardInterrupt:
        print('ctsid: interrupted', file=sys.stderr)
        return 130
    except BrokenPipeError:  # `ctsid info BAG | head`: the reader has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except (CtsidError, OSError) as error:
        from ctsid_ros.report.words import lines

        print(f'ctsid: error: {lines(str(error))}', file=sys.stderr)
        return 1
    except ImportError as error:
        missing = lacks_bag_package(error, 'reading bags')
        if not missing:
            raise
        print(f'ctsid: error: {missing}', file=sys.stderr)
        return 1
    return code


def _unknown(word: str) -> int:
    from difflib import get_close_matches

    near = get_close_matches(word, VERBS, n=1, cutoff=0.5)
    hint = f'nearest: {near[0]}' if near else f'the verbs are {", ".join(VERBS)}'
    print(f'usage: ctsid [-h] [--version] VERB ...\nctsid: error: {word!r} is no verb; {hint} '
          '(ctsid --help)', file=sys.stderr)
    return 2


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of a command line, with the verbs that it needs."""
    import argparse
    from importlib import import_module

    class Version(argparse.Action):
        """Look the version up only when it is asked for."""

        def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
            from ctsid_ros.config.origin import package_version

            print(f'ctsid {package_version()}')
            parser.exit()

    parser = argparse.ArgumentParser(
        prog='ctsid', description='Identifies continuous-time state-space models from bags; '
        'each topic keeps its own time stamps, nothing is resampled.', epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action=Version, nargs=0,
                        help="show program's version number and exit")
    verbs = parser.add_subparsers(metavar='VERB', required=True)
    for name in _wanted(argv):
        verb = import_module(f'ctsid_ros.verbs.{name}')
        own = verbs.add_parser(name, help=verb.HELP, epilog=verb.EPILOG,
                               description=f'{verb.HELP[0].upper()}{verb.HELP[1:]}.',
                               formatter_class=argparse.RawDescriptionHelpFormatter)
        verb.add_arguments(own)
        own.set_defaults(command=verb.command)
    return parser


def _wanted(argv: Sequence[str]) -> Sequence[str]:
    """Return the verb that a command line names, or all for their list; each takes its time."""
    if argv[:1] == ['--version']:
        return ()
    return argv[:1] if argv and argv[0] in VERBS else VERBS


if __name__ == '__main__':
    sys.exit(main())
