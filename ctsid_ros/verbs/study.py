# SPDX-License-Identifier: Apache-2.0
"""`ctsid study`: Monte Carlo studies of known plants, printed beside what was published."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
import shlex

HELP = 'repeat a Monte Carlo study and print it beside what was published'
# Of the two papers; all of them by `all`.
PAPERS = {
    'hd-basis': ('hd_basis', '[HD] figures 1 to 3: the basis (nothing random)'),
    'hd-robustness': ('hd_robustness', '[HD] figures 4 to 7: Bode curves and eigenvalues'),
    'hd-parameters': ('hd_parameters', '[HD] figures 8 to 11: samples, nmax, beta, gamma'),
    'hd-vs-ct': ('hd_vs_ct', '[HD] figures 12, 13 and Table 1: three methods'),
    'hd-unsaid': ('hd_unsaid', 'what [HD] leaves unsaid: samples, SNR, p and f'),
    'tm': ('takenaka_malmquist', '[TM] figures 1 to 4: the example of section V'),
}
OURS = {
    'table1': ('table1', '[HD] Table 1 beside the Cramer-Rao bound, nothing set'),
    'windows': ('windows', 'windows that are not at rest'),
    'closed-loop': ('closed_loop', 'an unstable plant under its controller'),
    'robots': ('robots.study', 'the exam: many simulated robots, and what is reachable on each'),
}
STUDIES = PAPERS | OURS
EPILOG = '\n'.join([
    'studies:', *(f'  {name:14} {what}' for name, (_, what) in STUDIES.items()),
    f'  {"all":14} those of the papers ({", ".join(PAPERS)})', '',
    '[HD] and [TM] are the papers on HD-PBSID and on Takenaka-Malmquist chains: docs/papers.md.',
    'A study that is interrupted goes on where it was when it is called again; each writes its',
    'single runs, tables (Markdown and CSV) and figures (SVG) to a folder. Its own options',
    '(--seeds, --jobs, --out) are explained by `ctsid study NAME --help`. On two cores hd-vs-ct',
    'takes three minutes, all of them ten.', '',
    'example: ctsid study hd-vs-ct --seeds 100'])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('name', choices=[*STUDIES, 'all'], metavar='NAME', help='which study')
    parser.add_argument('more', nargs=argparse.REMAINDER, metavar='...',
                        help='--seeds, --jobs, --out: of the study')


def command(args: argparse.Namespace) -> int:
    """Run the study."""
    if args.name != 'all':
        return _run(args.name, args.more)
    given = _of_all(args.more)
    for name in PAPERS:
        print(f'\n{name}: {PAPERS[name][1]}')
        many = [] if name == 'hd-basis' else [
            word for option in ('seeds', 'jobs') if getattr(given, option)
            for word in (f'--{option}', str(getattr(given, option)))]
        code = _run(name, [*many, '--out', str(given.out / name)])
        if code:
            return code
    return 0


def _run(name: str, more: list[str]) -> int:
    code: int = import_module(f'ctsid_ros.studies.{STUDIES[name][0]}').main(more)
    if code == 0:
        from ctsid_ros.studies.report_page import write_page

        page = write_page(_folder(name, more), f'{name}: {STUDIES[name][1]}',
                          shlex.join(('ctsid', 'study', name, *more)))
        print(f'Page: {page}' if page else 'There is nothing to show on a page.')
    return code


def _folder(name: str, more: list[str]) -> Path:
    """Return the folder of a study, as it understands its own options."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument('--out', type=Path, default=Path('results/studies') / name)
    out: Path = parser.parse_known_args(more)[0].out
    return out


def _of_all(more: list[str]) -> argparse.Namespace:
    positive = import_module('ctsid_ros.studies.runner').positive
    parser = argparse.ArgumentParser(prog='ctsid study all', description='All studies of the '
                                     'two papers, one after the other.')
    parser.add_argument('--seeds', type=positive, metavar='N',
                        help='runs of each experiment (each study has its own number)')
    parser.add_argument('--jobs', type=positive, metavar='N', help='processes (one for each core)')
    parser.add_argument('--out', type=Path, default=Path('results/studies'), metavar='FOLDER',
                        help='a folder of each study is made in it (%(default)s)')
    return parser.parse_args(more)
