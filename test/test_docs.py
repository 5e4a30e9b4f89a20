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


PAGES = sorted([*(ROOT / 'docs').glob('*.md'), *ROOT.glob('*.md'), ROOT / 'benchmarks/README.md'])


def mentions(page: Path) -> list[tuple[str, str]]:
    """Return each `path/file.py:name` or `path/file.py` of a page: its file and its name."""
    found = re.findall(r'`([\w/]+\.py)(?::([\w.]+))?`', page.read_text())
    return [(path, name) for path, name in found if 'NAME' not in path]


@pytest.mark.parametrize('page', PAGES, ids=lambda p: p.name)
def test_code_that_a_page_names_is_there(page):
    wrong = []
    for path, name in mentions(page):
        files = [f for f in (ROOT / path, page.parent / path, ROOT / 'ctsid_core' / path,
                             ROOT / 'ctsid_ros' / path) if f.exists()]
        files = files or list((ROOT / 'ctsid_core').rglob(path)) \
            or list((ROOT / 'ctsid_ros').rglob(path))
        last = name.rpartition('.')[2]
        if not files or (last and not any(
                re.search(rf'(def|class) {last}\b|^ *{last}\b.*[:=]', f.read_text(), re.M)
                for f in files)):
            wrong.append(f'{path}:{name}')
    assert wrong == []
