# SPDX-License-Identifier: Apache-2.0
"""The generated documents are those of the code, and the README keeps its promises."""

from fnmatch import fnmatch
import json
from pathlib import Path
import re
from runpy import run_path

import pytest

from ctsid_core.model.estimate import Status
from ctsid_ros.cli import VERBS, main
from ctsid_ros.config.origin import package_version
from ctsid_ros.messages.interface import OUTPUTS, SERVICES, SHARED

ROOT = Path(__file__).resolve().parent.parent
GENERATED = run_path(str(ROOT / 'docs/generated.py'))['PAGES']


@pytest.mark.parametrize(('words', 'file'), [
    (['params'], 'config/defaults.yaml'),
    (['params', '--markdown'], 'docs/parameters.md'),
])
def test_generated_files_are_up_to_date(words, file, capsys):
    assert main(words) == 0
    assert (ROOT / file).read_text() == capsys.readouterr().out, \
        f'run: ctsid {" ".join(words)} > {file}'


@pytest.mark.parametrize('name', GENERATED)
def test_generated_pages_are_up_to_date(name):
    assert (ROOT / 'docs' / name).read_text() == GENERATED[name](), 'run: make docs'


def test_the_page_of_topics_has_all_that_is_declared():
    page = (ROOT / 'docs/topics.md').read_text()
    for name, of in OUTPUTS.items():
        assert f'| `~/{name}` | `{of.type}` | {of.when} |' in page
    assert all(f'| `~/{name}` |' in page for name in SERVICES)
    assert re.findall(r'^\| `~?/(\w+)`', page, re.M) == [*OUTPUTS, *(
        name.strip('/') for name in SHARED), *SERVICES]


def keys_of(schema: dict, known: dict) -> set[str]:
    """Return the names of all keys below a schema."""
    found = set()
    for key, of in schema.get('properties', {}).items():
        found |= {key} | (keys_of(of, known) if isinstance(of, dict) else set())
    for inner in (schema.get('items'), *schema.get('anyOf', ())):
        found |= keys_of(inner, known) if isinstance(inner, dict) else set()
    name = schema.get('$ref', '').rpartition('/')[2]
    return found | (keys_of(known[name], known) if name else set())


def test_the_page_of_model_json_has_all_keys():
    schema = json.loads((ROOT / 'ctsid_core/model/model.schema.json').read_text())
    page = (ROOT / 'docs/model_json.md').read_text()
    shown = {path.rpartition('.')[2].removesuffix('[]')
             for path in re.findall(r'^\| `([\w.\[\]]+)` \|', page, re.M)}
    assert shown == keys_of(schema, schema['$defs']) | {status.name for status in Status}


def test_the_glossary_explains_every_number_of_a_verdict():
    schema = json.loads((ROOT / 'ctsid_core/model/model.schema.json').read_text())
    glossary = (ROOT / 'docs/glossary.md').read_text()
    for key in schema['$defs']['verdict']['properties']:
        assert f'verdict.{key}' in glossary, key
    known = keys_of(schema, schema['$defs'])
    named = set(re.findall(r'JSON `([\w.\[\]]+)`', glossary))
    assert len(named) > 20
    wrong = [path for path in named if not path.startswith(('statistics.', 'deviations.'))
             and not {part.removesuffix('[]') for part in path.split('.')} <= known]
    assert wrong == []


def test_the_site_is_of_this_version():
    assert run_path(str(ROOT / 'docs/conf.py'))['release'] == package_version()


def test_every_page_can_be_reached():
    listed = re.findall(r'^\w+$', (ROOT / 'docs/index.md').read_text(), re.M)
    pages = {path.stem for path in (ROOT / 'docs').iterdir() if path.suffix in ('.md', '.rst')}
    assert sorted(listed) == sorted(pages - {'index'})


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
    assert set(re.findall(r'(?:^|`)ctsid (--version|\w+)', text, flags=re.MULTILINE)) == {
        *VERBS, '--version'}
    for verb in verbs:
        assert main([verb, '--help']) == 0
        assert verb in capsys.readouterr().out


def test_what_the_lines_of_the_readme_make_is_not_a_change_of_the_checkout():
    made = re.findall(r'^ctsid .*(?:-o|--out) ([\w.]+)', (ROOT / 'README.md').read_text(),
                      re.MULTILINE)
    assert {'params.yaml', 'roll.c', 'models.pdf', 'fleet'} <= {*made}
    lines = [line.strip('/') for line in (ROOT / '.gitignore').read_text().splitlines()]
    for name in (*made, 'roll.h'):
        assert any(fnmatch(name, line) for line in lines), name


def test_the_example_in_python_runs_as_it_stands(capsys):
    example, = re.findall(r'```python\n(.*?)```', (ROOT / 'README.md').read_text(), re.S)
    names = {}
    exec(compile(example, 'README.md', 'exec'), names)
    assert not names['estimate'].model.D.any()
    said = capsys.readouterr().out
    assert said.startswith('GOOD Every test is passed')
    pole, fit = re.findall(r'\[(-?[\d.]+)', said)[::2]
    assert abs(float(pole) + 2.0) < 0.1
    assert float(fit) > 90.0


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
