# SPDX-License-Identifier: Apache-2.0
"""`ctsid export`: a stored model in the form of another tool."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from ctsid_core.errors import DataError
from ctsid_ros.verbs.arguments import ACCEPTED, NO_MODEL, model_file, say

if TYPE_CHECKING:
    from ctsid_ros.export.content import Content

SUFFIXES = {'python-control': ('.py',), 'matlab': ('.mat',), 'c': ('.c',), 'simulink-m': ('.m',),
            'yaml': ('.yaml', '.yml')}
HELP = 'write a stored model as a file of another tool'
EPILOG = """what comes out:
  python-control  Python that makes a control.StateSpace: dead times as Pade approximations,
                  or discrete and exact with --rate
  matlab          .mat file of matrices, dead times, names, units and covariance (Octave too)
  simulink-m      MATLAB script that makes an ss with InputDelay
  c               FILE.c and FILE.h: the exact discrete model at --rate, no malloc
  yaml            the model and its verdict, to read anywhere

examples: ctsid export results/demo/model.json --to c --rate 200 -o roll.c
          ctsid export results/demo/model.json --to python-control --pade 2 -o roll.py

model.json itself is described by a JSON schema, ctsid_core/model/model.schema.json."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('model', metavar='MODEL', type=model_file,
                        help='a model.json, or a folder of results that has one')
    parser.add_argument('--to', required=True, choices=tuple(SUFFIXES), help='the tool')
    parser.add_argument('-o', '--output', required=True, metavar='FILE', help='file to write')
    parser.add_argument('--rate', type=_rate, metavar='HZ',
                        help='of the discrete model (c, python-control) [Hz]')
    parser.add_argument('--pade', type=int, choices=range(11), metavar='N',
                        help='order of the approximation of dead times (python-control), 0 to 10 '
                        '[default 3]')
    parser.add_argument('--rejected', action='store_true',
                        help='write a model that was rejected, too; the exit code is 3 then')
    parser.add_argument('--force', action='store_true', help='replace existing files')


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r} is not a rate in Hz, more than zero')
    return value


def command(args: argparse.Namespace) -> int:
    """Read, convert, write."""
    from ctsid_core.model.storage import load_estimate, write_file
    from ctsid_ros.export.content import Content
    from ctsid_ros.verbs.simulate import model_of

    _check(args)
    estimate = load_estimate(args.model)
    model = model_of(estimate, args.model, 'export', rejected=args.rejected)
    origin = args.model.encode(errors='backslashreplace').decode()  # names of files may be no text
    files = _files(Content(model, estimate, origin), args)
    _refuse_existing(files, force=args.force)
    for path, data in files.items():
        write_file(path, data, force=args.force)
        print(path)
    if estimate.ok:
        if not estimate.good:
            say(f'the verdict on this model is WEAK: {estimate.verdict.reason}')
        return ACCEPTED
    say(f'this model was rejected: {estimate.verdict.reason}')
    return NO_MODEL


def _check(args: argparse.Namespace) -> None:
    """Raise if arguments contradict each other."""
    suffixes = SUFFIXES[args.to]
    if Path(args.output).suffix not in suffixes:
        raise DataError(f'{args.output} is to be written for {args.to}; name it with the suffix '
                        f'{" or ".join(suffixes)}')
    if args.to == 'c' and args.rate is None:
        raise DataError('the C code runs at a fixed rate; say which with --rate HZ')
    if args.rate is not None and args.to not in ('c', 'python-control'):
        raise DataError(f'{args.to} takes the continuous model; leave --rate away')
    if args.pade is not None and (args.to != 'python-control' or args.rate is not None):
        raise DataError('--pade is for continuous models of python-control; everywhere else dead '
                        'times are exact: leave it away')


def _files(content: Content, args: argparse.Namespace) -> dict[Path, bytes]:
    """Return what is to be written, by path."""
    path = Path(args.output)
    if args.to == 'matlab':
        from ctsid_ros.export.mat_file import mat_bytes

        return {path: mat_bytes(content)}
    if args.to == 'c':
        from ctsid_ros.export.c_source import c_files

        header, source = c_files(content, path.stem, args.rate)
        return {path.with_suffix('.h'): header.encode(), path: source.encode()}
    return {path: _text(content, args).encode()}


def _text(content: Content, args: argparse.Namespace) -> str:
    if args.to == 'python-control':
        from ctsid_ros.export.python_control import control_program

        return control_program(content, pade=3 if args.pade is None else args.pade,
                               rate=args.rate)
    if args.to == 'simulink-m':
        from ctsid_ros.export.matlab_text import matlab_script

        return matlab_script(content)
    from ctsid_ros.export.yaml_text import yaml_document

    return yaml_document(content)


def _refuse_existing(files: dict[Path, bytes], *, force: bool) -> None:
    """Raise before anything is written if a file is there; write_file would see one by one."""
    there = [str(path) for path in files if path.exists()]
    if there and not force:
        raise DataError(f'{", ".join(there)} exists already; choose another name, or add --force')
