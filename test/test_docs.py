# SPDX-License-Identifier: Apache-2.0
"""The generated documents are those of the code, and the README keeps its promises."""

from pathlib import Path
import re

import pytest

from ctsid_ros.cli import main

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize(('words', 'file'), [
    (['params'], 'config/defaults.yaml'),
    (['params', '--markdown'], 'docs/parameters.md'),
])
def test_generated_files_are_up_to_date(words, file, capsys):
    assert main(words) == 0
    assert (ROOT / file).read_text() == capsys.readouterr().out, \
        f'run: ctsid {" ".join(words)} > {file}'


def test_readme_is_short_and_its_links_exist():
    text = (ROOT / 'README.md').read_text()
    assert len(text.splitlines()) <= 120
    links = re.findall(r'\]\(([^)#:]+)\)', text)
    assert links
    for link in links:
        assert (ROOT / link).exists(), link


def test_readme_commands_are_verbs_of_the_tool(capsys):
    text = (ROOT / 'README.md').read_text()
    verbs = set(re.findall(r'^ctsid (\w+)', text, flags=re.MULTILINE))
    assert {'info', 'init', 'identify', 'replay', 'simulate'} <= verbs
    for verb in verbs:
        assert main([verb, '--help']) == 0
        assert verb in capsys.readouterr().out
