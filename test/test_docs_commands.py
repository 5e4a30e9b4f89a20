# SPDX-License-Identifier: Apache-2.0
"""
Every command of the pages for users runs, in the order of the pages, on the example bag.

Blocks of `sh` and `python` run as they stand; `console`, `text` and `matlab` are for reading. The
yaml of a page is the file that its commands name.
"""

from __future__ import annotations

from importlib.util import find_spec
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

import pytest

from ctsid_ros.cli import main

ROOT = Path(__file__).resolve().parent.parent
PAGES = ('tutorial', 'signals', 'experiment', 'closed_loop', 'which_fit', 'rejected',
         'matlab_python', 'consuming', 'duration')


def blocks(page: str) -> list[tuple[str, str]]:
    """Return language and text of each block of a page."""
    text = (ROOT / f'docs/{page}.md').read_text(encoding='utf-8')
    return re.findall(r'^```(sh|python|yaml)\n(.*?)^```', text, re.M | re.S)


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """A folder like that of the repository, with `ctsid` on the path."""
    made = tmp_path_factory.mktemp('reader')
    for name in ('bags', 'config', 'docs'):
        (made / name).symlink_to(ROOT / name)
    (made / 'bin').mkdir()
    program = made / 'bin/ctsid'
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m ctsid_ros.cli "$@"\n')
    program.chmod(0o755)
    return made


def run(folder: Path, *words: str) -> subprocess.CompletedProcess:
    env = os.environ | {'PATH': f'{folder / "bin"}{os.pathsep}{os.environ["PATH"]}',
                        'PYTHONPATH': str(ROOT), 'OPENBLAS_NUM_THREADS': '1'}
    if spec := find_spec('nlohmann_json'):
        env['CMAKE_INCLUDE_PATH'] = str(Path(spec.origin).parent / 'include')
    return subprocess.run(words, cwd=folder, env=env, text=True, capture_output=True,
                          check=False)


@pytest.mark.slow
def test_every_command_of_the_pages_runs(folder):
    # What `make demo` leaves.
    assert main(['replay', str(ROOT / 'bags/quadrotor_roll'), '--params',
                 str(ROOT / 'config/quadrotor_roll.yaml'), '--duration', '13', '--quiet',
                 '--out', str(folder / 'results/demo')]) == 0
    for page in PAGES:
        for language, text in blocks(page):
            if language == 'yaml' and page == 'rejected':
                (folder / 'wrong.yaml').write_text(text)
            elif language == 'python':
                ran = run(folder, sys.executable, '-c', text)
                assert ran.returncode == 0, f'{page}: {text}\n{ran.stderr}'
            elif language == 'sh':
                for command in text.replace('\\\n', ' ').splitlines():
                    if command.startswith(('cmake', 'build/')) and not shutil.which('cmake'):
                        continue
                    ran = run(folder, 'sh', '-c', command)
                    wanted = (0, 3) if 'results/wrong' in command or \
                        command.endswith('rate 30') else (0,)
                    assert ran.returncode in wanted, f'{page}: {command}\n{ran.stderr}'


def test_the_tutorial_ends_with_the_gains_that_it_promises(folder):
    """One model of the bag, of the poles that are told, and gains that are accepted."""
    text = (ROOT / 'docs/tutorial.md').read_text(encoding='utf-8')
    command, = (b for language, b in blocks('tutorial') if '--test-from 30' in b)
    design, = (b for language, b in blocks('tutorial') if language == 'python')
    promised, = re.findall(r'It prints `([^`]*)`', text)
    found = run(folder, 'sh', '-c', command)
    assert '4 states' in found.stdout, found.stdout + found.stderr
    ran = run(folder, sys.executable, '-c', design)
    assert ran.stdout.splitlines()[0] == promised, ran.stdout + ran.stderr
